"""NumPy and any library of the array-API standard (torch on CPU or CUDA, CuPy) by the same few
calls.

NumPy works on blocks in as many threads as BLAS would use; another library runs the same blocks on
its device, and only their sums come back.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from array_api_compat import array_namespace, device

from palpate.metrics.inputs import Array, Index, to_host

T = TypeVar("T")
R = TypeVar("R")


def host(x: Any) -> Array:
    """As a float64 NumPy array."""
    return np.asarray(to_host(x), dtype=np.float64)


def like(values: Any, x: Any) -> Any:
    """NumPy ``values`` in the type, library and device of ``x``."""
    return array_namespace(x).asarray(np.asarray(values), dtype=x.dtype, device=device(x))


def rows_at(x: Any, index: Index) -> Any:
    """``x[index]``, a copy; contiguous rows of an array on disk are read in one piece."""
    if isinstance(x, np.ndarray):
        return x[index]
    xp = array_namespace(x)
    return xp.take(x, xp.asarray(index, device=device(x)), axis=0)


def blas_threads() -> int:
    """Threads that BLAS may use: what ``threadpoolctl`` reports, at most the cores there are."""
    from threadpoolctl import threadpool_info

    allowed = [int(pool["num_threads"]) for pool in threadpool_info() if pool["user_api"] == "blas"]
    usable = getattr(os, "sched_getaffinity", None)
    cores = len(usable(0)) if usable else os.cpu_count() or 1
    return max(1, min([cores, *allowed]))


def in_threads(job: Callable[[T], R], items: Iterable[T], x: Any) -> Iterator[R]:
    """``map(job, items)`` in the same order; for NumPy in threads with one BLAS thread each.

    A block is a product and several passes over its result; BLAS threads would speed up the product
    alone.
    """
    from threadpoolctl import threadpool_limits

    if not isinstance(x, np.ndarray):
        with full_precision():
            yield from map(job, items)
        return
    workers = blas_threads()
    if workers < 2:
        yield from map(job, items)
        return
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(workers) as pool:
        waiting: list[Any] = []
        for item in items:  # a few ahead: finished blocks must not pile up
            waiting.append(pool.submit(job, item))
            if len(waiting) > 2 * workers:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()


@contextmanager
def full_precision() -> Generator[None]:
    """No TensorFloat-32 in torch's products: its ten bits are too few."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
