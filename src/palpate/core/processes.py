"""Worker processes: spawned, quiet on Ctrl-C, and ended with their parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any

from palpate.core.messages import PalpateError


@contextmanager
def worker_pool(
    workers: int, initializer: Callable[..., None] | None = None, arguments: tuple[Any, ...] = ()
) -> Generator[ProcessPoolExecutor]:
    """A pool of worker processes of one thread, which call ``initializer(*arguments)`` first.

    They are spawned: a fork of a process with threads can deadlock. So arguments are pickled.

    Raises:
        PalpateError: if a worker dies, mostly because the calling script has no ``__main__`` guard.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _start_worker, (initializer, arguments)) as pool:
        try:
            yield pool
        except BrokenProcessPool:
            fix = "Use one worker, or call this under: if __name__ == '__main__'"
            raise PalpateError("Worker processes must be able to start", "one died", fix) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _start_worker(initializer: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    # Ignore SIGINT in workers; the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    exit_with_parent()
    if initializer is not None:
        initializer(*arguments)


def exit_with_parent() -> None:
    """Exit when the parent process ends, even by SIGKILL; no effect without a parent."""
    parent = multiprocessing.parent_process()
    if parent is not None:

        def watch() -> None:
            wait([parent.sentinel])
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()
