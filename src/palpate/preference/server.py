"""The server of a study: the page, and the votes of invited raters in one SQLite file.

    GET /            the page; ``?token=`` is a rater's invitation, of which only a hash is kept
    GET /study.json  what this rater sees
    GET /votes       the votes of this rater, to go on with another device
    POST /vote       {"study", "rater", "trial", "choice", "ms", "at", "undone"}
                     -> {"stored": true}, or {"stored": "already"} for a vote that is there

The last three take the token as ``Authorization: Bearer``. A vote is answered after it is on disk
(:mod:`palpate.preference.store`); votes that arrive together share one transaction. Its key is
(rater, trial), so that a vote sent again counts once, and only a later ``undone`` replaces it.
Nothing but the routes above exists, and no request names a file.

A connection has ``LONGEST_WAIT`` seconds for a request with an invitation; of too many that wait,
of one address or of all, the oldest is closed for the newest. So raters are served while others
hold connections open.
"""

from __future__ import annotations

import asyncio
import datetime
import json
import re
import socket
import sqlite3
import time
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, closing, suppress
from pathlib import Path
from typing import Any, cast

from palpate.core import MissingExtraError, PalpateError, locked
from palpate.preference.page import policy, study_page
from palpate.preference.plan import Plan, last_day
from palpate.preference.store import Vote, VoteStore, hashed
from palpate.preference.votes import DATABASE, LONGEST_MS, MOST_UNDONE

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.requests import ClientDisconnect, Request
    from starlette.responses import HTMLResponse, JSONResponse, Response
    from starlette.routing import Route
    from uvicorn.protocols.http.h11_impl import H11Protocol
except ImportError as error:
    name = str(error.name).partition(".")[0]
    raise MissingExtraError(name, "preference", "The server of a study") from None

#: Longest body of a request, in bytes, and the longest wait for it, in seconds.
LARGEST_BODY, LONGEST_WAIT = 4096, 10.0
#: Connections that wait for a request with an invitation: of all addresses, and of one.
MOST_WAITING, MOST_OF_ADDRESS = 256, 64
#: Requests a second of one rater; a page that was offline may send all its votes at once.
RATE = 5.0
#: Seconds after which a page tries again when the disk is full or it came too often.
AGAIN = {"Retry-After": "5"}
HEADERS = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
PAGE_HEADERS = HEADERS | {
    "Content-Security-Policy": f"{policy(served=True)}; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
}
#: What a vote is made of.
FIELDS = dict.fromkeys(("study", "rater", "trial", "choice", "at"), str) | {
    "ms": int,
    "undone": int,
}


class _Connection(H11Protocol):
    """A connection that is closed at its ``deadline``, unless a rater's request is being answered.

    Attributes:
        deadline: while it waits for a request with an invitation.
    """

    deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Wait for a request, and end the oldest others that do so where they are too many."""
        super().connection_made(transport)
        self.app_state = {**self.app_state, "connection": self}
        self.wait()
        connections = cast("set[_Connection]", self.connections)
        waiting = {c.deadline.when(): c for c in connections if c.deadline}
        host = lambda connection: connection.client and connection.client[0]
        own = {when: c for when, c in waiting.items() if host(c) == host(self)}
        for crowd, most in ((own, MOST_OF_ADDRESS), (waiting, MOST_WAITING)):
            if len(crowd) > most:
                crowd[min(crowd)].end()

    def wait(self) -> None:
        """Give it time for its next request."""
        self.admit()
        self.deadline = self.loop.call_later(LONGEST_WAIT, self.end)

    def admit(self) -> None:
        """Give its request the time that it takes."""
        if self.deadline:
            self.deadline.cancel()
        self.deadline = None

    def end(self) -> None:
        """Close it when what is under way has been sent, or is not read."""
        self.admit()
        self.transport.close()
        self.loop.call_later(LONGEST_WAIT, self.transport.abort)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self.wait()


class _Study:
    """One study being served: routes, and the thread that alone uses the file."""

    def __init__(self, public: Mapping[str, Any], store: VoteStore) -> None:
        self.public, self.store, self.raters = public, store, store.raters()
        self.page = study_page(self.public, served=True)
        common = {k: v for k, v in self.public.items() if k != "raters"}
        self.common = json.dumps(common, separators=(",", ":"))[:-1]
        self.trials = {
            rater: {row["trial"] for row in rows} for rater, rows in public["raters"].items()
        }
        self.budget = {rater: (self.burst(rater), 0.0) for rater in self.raters.values()}
        self.disk = ThreadPoolExecutor(1)
        self.arrived: asyncio.Queue[tuple[Vote, asyncio.Future[bool]]] = asyncio.Queue()

    def burst(self, rater: str) -> float:
        """Requests that a rater may send at once: all votes twice."""
        return 2.0 * len(self.trials[rater]) + 20

    def application(self) -> Starlette:
        """Return the four routes; nothing else exists."""
        routes = [
            Route("/", self.show),
            Route("/study.json", self.study),
            Route("/votes", self.votes),
            Route("/vote", self.vote, methods=["POST"]),
        ]
        handlers: dict[Any, Callable[[Request, Any], Response]] = {HTTPException: _error}
        app = Starlette(routes=routes, exception_handlers=handlers, lifespan=self._running)
        app.router.redirect_slashes = False
        return app

    @asynccontextmanager
    async def _running(self, _: Starlette) -> AsyncGenerator[None]:
        writer = asyncio.create_task(self._write())
        yield
        writer.cancel()
        self.disk.shutdown()
        self.store.close()  # before the server hands on the signal that ended it

    async def _write(self) -> None:
        """Store what arrived meanwhile in one transaction, then answer: one wait for the disk."""
        while True:
            batch = [await self.arrived.get()]
            while not self.arrived.empty():
                batch.append(self.arrived.get_nowait())
            votes = [vote for vote, _ in batch]
            try:
                new = await self._on_disk(self.store.store, votes)
            except sqlite3.Error as error:
                for _, answer in batch:
                    answer.set_exception(error)
            else:
                for (_, answer), first in zip(batch, new, strict=True):
                    answer.set_result(first)

    async def _on_disk(self, function: Callable[..., Any], argument: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self.disk, function, argument)

    def rater(self, request: Request, token: str | None) -> str:
        """Return whose token a request has, and let its connection live.

        Raises:
            HTTPException: 403 for no invitation, 429 for too many requests.
        """
        rater = self.raters.get(hashed(token)) if token else None
        if rater is None:
            raise HTTPException(403, "no such invitation")
        request.state.connection.admit()
        left, since = self.budget[rater]
        now = time.monotonic()
        left = min(self.burst(rater), left + RATE * (now - since)) if since else left
        self.budget[rater] = (max(0.0, left - 1), now)
        if left < 1:
            raise HTTPException(429, "too many requests", AGAIN)
        return rater

    def _bearer(self, request: Request) -> str:
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        return self.rater(request, token if scheme == "Bearer" else None)

    async def show(self, request: Request) -> Response:
        """Answer ``GET /``."""
        self.rater(request, request.query_params.get("token"))
        return HTMLResponse(self.page, headers=PAGE_HEADERS)

    async def study(self, request: Request) -> Response:
        """Answer ``GET /study.json``."""
        rater = self._bearer(request)
        own = json.dumps({rater: self.public["raters"][rater]}, separators=(",", ":"))
        body = f'{self.common},"ended":{json.dumps(self._ended())},"raters":{own}}}'
        return Response(body, media_type="application/json", headers=HEADERS)

    async def votes(self, request: Request) -> Response:
        """Answer ``GET /votes``."""
        votes = await self._on_disk(self.store.votes, self._bearer(request))
        return JSONResponse({"votes": votes}, headers=HEADERS)

    async def vote(self, request: Request) -> Response:
        """Answer ``POST /vote``."""
        rater = self._bearer(request)
        vote = self._checked(await _body(request), rater)
        if self._ended():
            raise HTTPException(410, "the study has ended")
        now = datetime.datetime.now(datetime.UTC)
        answer: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        self.arrived.put_nowait((vote | {"received": now.isoformat(timespec="seconds")}, answer))
        try:
            new = await answer
        except sqlite3.Error as error:
            raise HTTPException(507, f"the vote could not be stored: {error}", AGAIN) from None
        return JSONResponse({"stored": True if new else "already"}, headers=HEADERS)

    def _ended(self) -> bool:
        until, now = self.public["until"], datetime.datetime.now(datetime.UTC)
        return until is not None and now.date().isoformat() > until

    def _checked(self, body: bytes, rater: str) -> dict[str, Any]:
        try:
            vote: Any = json.loads(body)
        except (ValueError, RecursionError):
            raise HTTPException(400, "the body is no JSON") from None
        if not isinstance(vote, dict) or vote.keys() != FIELDS.keys():
            raise HTTPException(400, f"a vote has the fields {', '.join(FIELDS)}")
        if wrong := [name for name, kind in FIELDS.items() if type(vote[name]) is not kind]:
            raise HTTPException(400, f"{wrong[0]} is of a wrong type")
        if vote["rater"] != rater:
            raise HTTPException(403, "the invitation is another rater's")
        holds = {
            "study": vote["study"] == self.public["study"],
            "trial": vote["trial"] in self.trials[rater],
            "choice": vote["choice"] in self.public["choices"],
            "ms": 0 <= vote["ms"] < LONGEST_MS,
            "undone": 0 <= vote["undone"] < MOST_UNDONE,
            "at": _is_time(vote["at"]),
        }
        if wrong := [name for name, good in holds.items() if not good]:
            raise HTTPException(400, f"{wrong[0]} is not one of this study")
        return vote


def _is_time(text: str) -> bool:
    """Whether a text is a time in UTC, as browsers write it; Python alone takes more forms."""
    form = r"\d{4}-\d\d-\d\dT(?!24)\d\d:\d\d:\d\d(\.\d{1,6})?Z"
    try:
        datetime.datetime.fromisoformat(text)
    except ValueError:
        return False
    return re.fullmatch(form, text, re.ASCII) is not None


async def _body(request: Request) -> bytes:
    """Read at most ``LARGEST_BODY`` bytes."""
    body = b""
    try:
        async with asyncio.timeout(LONGEST_WAIT):
            async for part in request.stream():
                body += part
                if len(body) > LARGEST_BODY:
                    raise HTTPException(413, f"a vote has at most {LARGEST_BODY} bytes")
    except (TimeoutError, ClientDisconnect):
        raise HTTPException(408, "the body did not come") from None
    return body


def _error(request: Request, error: HTTPException) -> Response:
    headers = HEADERS | dict(error.headers or {})
    if request.url.path == "/" and error.status_code == 403:
        text = "<!DOCTYPE html><title>No invitation</title><p>Open the link of your invitation."
        return HTMLResponse(text, 403, headers=PAGE_HEADERS)
    return JSONResponse({"error": error.detail}, error.status_code, headers=headers)


def serve(
    study: str | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    invite: int = 0,
    reinvite: Sequence[str] = (),
    until: str | None = None,
    ready: Callable[[str, Mapping[str, str]], None] = lambda url, tokens: None,
) -> None:
    """Serve a study until it is stopped (Ctrl-C, SIGTERM); votes go to ``study.db`` in its folder.

    Args:
        study: its folder; the images of its plan are all that is ever sent.
        host: address to listen at; the default is reached from this machine alone.
        port: 0 for any free one.
        invite: number of raters to invite now, in the order of the plan.
        reinvite: raters whose link is lost: they get another, and the former opens nothing.
        until: ISO date of the last day (UTC) whose votes count, instead of the plan's.
        ready: called with the URL and the new tokens by rater, before the first request. Tokens
            are kept nowhere else.

    Raises:
        MissingExtraError: without the extra ``preference``.
        PalpateError: if another server has the study, the file of votes is of another one, a rater
            cannot be invited, ``until`` is no date, or the address is taken.
    """
    folder, public = Path(study), Plan.load(study).public()
    folder = folder if folder.is_dir() else folder.parent
    public["until"] = last_day(public["until"] if until is None else until)
    with (
        locked(folder),  # of two servers the first to end would count the votes of both
        closing(VoteStore(folder / DATABASE, public["study"])) as store,
        listening(host, port) as listener,
    ):
        tokens = store.invite(list(public["raters"]), invite, reinvite)
        address = f"[{host}]" if ":" in host else host
        app = _Study(public, store).application()
        ready(f"http://{address}:{listener.getsockname()[1]}/", tokens)
        config = uvicorn.Config(
            app,
            http=_Connection,
            ws="none",
            access_log=False,  # it would hold the tokens
            log_level="warning",
            server_header=False,
            lifespan="on",
            limit_concurrency=1000,
            timeout_graceful_shutdown=5,
        )
        with suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listener])


def listening(host: str, port: int) -> socket.socket:
    """Return a listening socket, which knows its protocol: asyncio sends at once only on these."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(1024)
    except (OSError, OverflowError) as error:
        listener.close()
        got = f"{host}, port {port}: {error}"
        fix = "Stop what listens there, or choose another port or address"
        raise PalpateError("The server needs a free address", got, fix) from None
    return listener
