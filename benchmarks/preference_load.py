"""2,000 votes of 50 raters at once, while the server of the study is killed three times.

python benchmarks/preference_load.py [--raters 50] [--votes 40] [--kills 3]

The server runs in its own process and gets ``kill -9`` after a quarter, a half and three quarters
of the votes; every rater sends the next vote when the last is acknowledged, and the same vote again
until it is. Milliseconds are those of answered requests at the client, which shares the two cores.
Fails if an acknowledged vote is lost or changed, if one is counted twice, or if the median is over
50 ms. What it measured:

| machine | acknowledged | lost | double | sent again | median ms | 95 % | wall s |
|---|---|---|---|---|---|---|---|
| 2 cores, busy with other work, 5 runs, 11/2026 | 2,000 | 0 | 0 | 900-1,050 | 18-20 | 42-53 | 2 |
| 2 cores, load of 6, 3 runs, 11/2026 | 2,000 | 0 | 0 | 2,083-2,918 | 74-91 | 177-185 | 7-9 |
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import sqlite3
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from forge.people import pair_study
from forge.servers import Serving

MOST_MS = 50.0


class Client:
    """One rater: a connection that is kept, and what the server acknowledged.

    Args:
        server: where to send to.
        rater: code.
        times: seconds of answered requests; shared.
    """

    def __init__(self, server: Serving, rater: str, times: list[float]) -> None:
        self.server, self.rater, self.times = server, rater, times
        self.acknowledged: dict[str, str] = {}
        self.again = 0
        self.stream: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def send(self, vote: dict) -> int:
        """Status of the answer to a vote.

        Raises:
            OSError, EOFError: if there is none.
        """
        if self.stream is None:
            self.stream = await asyncio.open_connection("127.0.0.1", self.server.port)
        reader, writer = self.stream
        body = json.dumps(vote).encode()
        token = self.server.tokens[self.rater]
        head = f"POST /vote HTTP/1.1\r\nHost: study\r\nAuthorization: Bearer {token}\r\n"
        start = time.perf_counter()
        writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
        answer = await reader.readuntil(b"\r\n\r\n")
        length = int(answer.lower().partition(b"content-length: ")[2].split(b"\r")[0])
        await reader.readexactly(length)
        self.times.append(time.perf_counter() - start)
        return int(answer.split()[1])

    async def rate(self, votes: int) -> None:
        """Send all votes, each until it is acknowledged."""
        draw = random.Random(self.rater)
        for k in range(votes):
            vote = self.server.vote(self.rater, k, draw.choice(("left", "right", "same")))
            while True:
                try:
                    if await self.send(vote) == 200:
                        break
                except (OSError, EOFError, asyncio.IncompleteReadError):
                    if self.stream:
                        self.stream[1].close()
                    self.stream = None
                self.again += 1
                await asyncio.sleep(0.05)
            self.acknowledged[vote["trial"]] = vote["choice"]


async def killed(server: Serving, clients: list[Client], total: int, kills: int) -> None:
    """Kill and restart the server at equal shares of the votes."""
    for k in range(1, kills + 1):
        while sum(len(c.acknowledged) for c in clients) < total * k / (kills + 1):
            await asyncio.sleep(0.005)
        server.kill()
        await asyncio.to_thread(server.start, port=server.port)


async def load(server: Serving, votes: int, kills: int) -> tuple[list[Client], list[float]]:
    """All raters at once; the clients and the seconds of answered requests."""
    times: list[float] = []
    clients = [Client(server, rater, times) for rater in server.tokens]
    rating = [client.rate(votes) for client in clients]
    await asyncio.gather(killed(server, clients, len(clients) * votes, kills), *rating)
    return clients, times


def measure(folder: Path, raters: int, votes: int, kills: int) -> dict[str, float]:
    """Votes acknowledged, stored, lost and double, votes sent again, and milliseconds."""
    public, _ = pair_study(votes, raters)
    with Serving(folder, public) as server:
        start = time.perf_counter()
        clients, times = asyncio.run(load(server, votes, kills))
        seconds = time.perf_counter() - start
    with sqlite3.connect(server.database) as disk:
        rows = disk.execute("SELECT rater, trial, choice FROM votes").fetchall()
    stored = {(rater, trial): choice for rater, trial, choice in rows}
    sent = {(c.rater, trial): choice for c in clients for trial, choice in c.acknowledged.items()}
    return {
        "acknowledged": len(sent),
        "stored": len(rows),
        "lost": sum(stored.get(key) != choice for key, choice in sent.items()),
        "double": len(rows) - len(stored) + len(stored.keys() - sent.keys()),
        "again": sum(client.again for client in clients),
        "median_ms": 1000 * float(np.median(times)),
        "p95_ms": 1000 * float(np.quantile(times, 0.95)),
        "seconds": seconds,
    }


def main() -> int:
    """Print one row; 1 if a vote is lost or double, or answers are slow."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    for name, default in (("raters", 50), ("votes", 40), ("kills", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = vars(parser.parse_args())
    with tempfile.TemporaryDirectory() as folder:
        row = measure(Path(folder), **options)
    print(json.dumps({name: round(value, 1) for name, value in row.items()}))
    whole = row["stored"] == row["acknowledged"] == options["raters"] * options["votes"]
    return int(not whole or row["lost"] or row["double"] or row["median_ms"] > MOST_MS)


if __name__ == "__main__":
    sys.exit(main())
