"""Cases shared among processes, which are replaced when they die or hang."""

import contextlib
import io
import multiprocessing
import os
import re
import resource
import sys
import tempfile
import traceback
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import TypeVar

from fuzz import cases, seeds
from fuzz.bare import hide

Job = TypeVar("Job", int, str)


def serve(pipe: Connection, seed: int, base: Path, work: Path, bare: bool) -> None:
    """Run the cases whose numbers arrive, or commands, within the limit of memory."""
    if bare:
        hide()
    else:
        import torch  # noqa: F401  (its own size does not count)
    os.environ["PATH"] = f"{base / 'bin'}{os.pathsep}{os.environ['PATH']}"

    def watch(event: str, args: tuple[object, ...]) -> None:
        if event in ("socket.connect", "socket.getaddrinfo"):
            cases.NETWORK.append(repr(args))

    sys.addaudithook(watch)
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)  # what C libraries print
    os.dup2(sink, 2)
    while True:
        job = pipe.recv()
        used = re.search(r"VmData:\s+(\d+) kB", Path("/proc/self/status").read_text())
        assert used is not None
        limit = int(used[1]) * 1024 + cases.BYTES  # what earlier cases left does not count
        resource.setrlimit(resource.RLIMIT_DATA, (limit, resource.RLIM_INFINITY))
        try:
            pipe.send(cases.check(seed, job, base, work))
        except Exception:
            pipe.send(([], [f"the fuzzer itself: {traceback.format_exc()[-900:]}"]))


class Worker:
    """A process that runs cases, and is replaced when it dies or hangs."""

    def __init__(self, *settings: object) -> None:
        self.settings = settings
        self.process: multiprocessing.process.BaseProcess | None = None

    def check(self, job: int | str) -> tuple[list[str], list[str]]:
        if self.process is None:
            context = multiprocessing.get_context("spawn")
            self.pipe, end = context.Pipe()
            self.process = context.Process(target=serve, args=(end, *self.settings))
            self.process.start()
            end.close()
            limit = 3 * cases.SECONDS  # with the start
        else:
            limit = cases.SECONDS
        self.pipe.send(job)
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
    jobs: Iterable[Job],
    seed: int,
    workers: int = 2,
    base: Path | None = None,
    *,
    bare: bool = False,
) -> Iterator[tuple[Job, list[str], list[str]]]:
    """Yield (job, arguments, failures) of each number of a case or command on whole inputs.

    ``base`` holds the inputs already; ``bare`` is an environment without extras.
    """
    with tempfile.TemporaryDirectory(prefix="palpate-fuzz-") as place:
        if base is None:
            base = Path(place) / "base"
            with contextlib.redirect_stdout(io.StringIO()):
                seeds.build(base)
        idle: SimpleQueue[Worker] = SimpleQueue()
        every = [Worker(seed, base, Path(place) / "work", bare) for _ in range(workers)]
        for worker in every:
            idle.put(worker)

        def check(job: Job) -> tuple[Job, list[str], list[str]]:
            worker = idle.get()
            try:
                return job, *worker.check(job)
            finally:
                idle.put(worker)

        pool = ThreadPoolExecutor(workers)
        try:
            yield from pool.map(check, jobs)
        finally:
            pool.shutdown(cancel_futures=True)
            for worker in every:
                worker.stop()
