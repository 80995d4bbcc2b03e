"""Threads of the search: one BLAS thread a worker.

The blocks of a sweep are small, and a BLAS that splits a small product over threads spends its time waiting for them, the more so on a
busy machine. Where threadpoolctl is installed (scikit-learn brings it), BLAS is held to one thread while a search runs and as many
workers as BLAS had threads take cells instead (``OMP_NUM_THREADS`` and its like are honored); without it one worker leaves BLAS as it
is. Results do not depend on it.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar

T = TypeVar("T")


@cache
def _controller() -> Any:
    try:
        from threadpoolctl import ThreadpoolController
    except ImportError:
        return None
    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_blas_thread() -> Generator[int, None, None]:
    """Holds BLAS to one thread; gives how many workers may run instead."""
    controller = _controller()
    if controller is None:
        yield 1
        return
    workers = max([1, *(library["num_threads"] for library in controller.info())])
    with controller.limit(limits=1):
        yield workers


def limited(items: Iterator[T]) -> Iterator[T]:
    """The same items, each made under :func:`one_blas_thread`; the consumer's own code runs with BLAS as it was."""
    while True:
        with one_blas_thread():
            try:
                item = next(items)
            except StopIteration:
                return
        yield item
