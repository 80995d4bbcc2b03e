"""Cases shared among processes, which are replaced when they die or hang."""

import contextlib
import io
import multiprocessing
import os
import re
import resource
import tempfile
import traceback
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue

from fuzz import cases, seeds


def serve(pipe: Connection, seed: int, base: Path, work: Path) -> None:
    """Run the cases whose numbers arrive, within the limit of memory."""
    import torch  # noqa: F401  (its own size does not count)

    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)  # what C libraries print
    os.dup2(sink, 2)
    while True:
        number = pipe.recv()
        used = re.search(r"VmData:\s+(\d+) kB", Path("/proc/self/status").read_text())
        assert used is not None
        limit = int(used[1]) * 1024 + cases.BYTES  # what earlier cases left does not count
        resource.setrlimit(resource.RLIMIT_DATA, (limit, resource.RLIM_INFINITY))
        try:
            pipe.send(cases.check(seed, number, base, work))
        except Exception:
            pipe.send(([], [f"the fuzzer itself: {traceback.format_exc()[-900:]}"]))


class Worker:
    """A process that runs cases, and is replaced when it dies or hangs."""

    def __init__(self, *settings: object) -> None:
        self.settings = settings
        self.process: multiprocessing.process.BaseProcess | None = None

    def check(self, number: int) -> tuple[list[str], list[str]]:
        if self.process is None:
            context = multiprocessing.get_context("spawn")
            self.pipe, end = context.Pipe()
            self.process = context.Process(target=serve, args=(end, *self.settings))
            self.process.start()
            end.close()
            limit = 3 * cases.SECONDS  # with the start
        else:
            limit = cases.SECONDS
        self.pipe.send(number)
        try:
            if self.pipe.poll(limit):
                return self.pipe.recv()
            problem = "hangs"
        except (EOFError, OSError):
            self.process.join()
            problem = f"the process dies with {self.process.exitcode}"
        self.stop()
        return [], [problem]

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.process = None


def run(
    numbers: range, seed: int, workers: int = 2, base: Path | None = None
) -> Iterator[tuple[int, list[str], list[str]]]:
    """Yield (number, arguments, failures) of each case; ``base`` holds the inputs already."""
    with tempfile.TemporaryDirectory(prefix="palpate-fuzz-") as place:
        if base is None:
            base = Path(place) / "base"
            with contextlib.redirect_stdout(io.StringIO()):
                seeds.build(base)
        idle: SimpleQueue[Worker] = SimpleQueue()
        every = [Worker(seed, base, Path(place) / "work") for _ in range(workers)]
        for worker in every:
            idle.put(worker)

        def check(number: int) -> tuple[int, list[str], list[str]]:
            worker = idle.get()
            try:
                return number, *worker.check(number)
            finally:
                idle.put(worker)

        pool = ThreadPoolExecutor(workers)
        try:
            yield from pool.map(check, numbers)
        finally:
            pool.shutdown(cancel_futures=True)
            for worker in every:
                worker.stop()
