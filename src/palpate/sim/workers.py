"""Videos rendered one after another or by several processes, always reported in order."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.reduction import ForkingPickler

from palpate.core import PalpateError
from palpate.core.processes import follow_parent
from palpate.sim.materials import MATERIALS, Material
from palpate.sim.plan import VideoPlan

Job = Callable[[VideoPlan], str]


def render_all(job: Job, plans: Sequence[VideoPlan], workers: int) -> Iterator[str]:
    """Yields ``job(plan)`` for all plans, in order; the first error stops everything.

    Raises:
        PalpateError: as the job does, or if the processes could not start.
    """
    if min(workers, len(plans)) < 2:
        yield from map(job, plans)
        return
    _require_importable()
    context = multiprocessing.get_context(
        "spawn"
    )  # a forked copy of a process with threads may hang
    with ProcessPoolExecutor(workers, context, _start_worker, (dict(MATERIALS),)) as pool:
        try:
            yield from _started(pool, job, plans, chunk=max(1, min(4, len(plans) // (2 * workers))))
        except BrokenProcessPool:
            raise PalpateError(
                "The worker processes must be able to start",
                "one that died",
                "Pass workers=1, or call write_world under: if __name__ == '__main__'",
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _require_importable() -> None:
    """Refuses materials that cannot be sent to another process.

    Raises:
        PalpateError: naming the first.
    """
    for name, material in MATERIALS.items():
        try:
            ForkingPickler.dumps(material)
        except Exception as error:  # pickle raises what it likes
            must = f"The function of the material {name!r} must be importable for several workers"
            raise PalpateError(
                must, str(error), "Define it at the top of a module, or pass workers=1"
            ) from None


def _started(
    pool: ProcessPoolExecutor, job: Job, plans: Sequence[VideoPlan], chunk: int
) -> Iterator[str]:
    """``pool.map``, whose processes start deaf to Ctrl-C: a terminal sends it to all of them, and each would print a traceback."""
    if threading.current_thread() is not threading.main_thread():  # only there can signals be set
        return pool.map(job, plans, chunksize=chunk)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return pool.map(job, plans, chunksize=chunk)
    finally:
        signal.signal(signal.SIGINT, before)


def _start_worker(materials: dict[str, Material]) -> None:
    """Gives a new process the table of this one, so that materials which a user added are known there; it ends when this one is killed."""
    follow_parent()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    MATERIALS.clear()
    MATERIALS.update(materials)
