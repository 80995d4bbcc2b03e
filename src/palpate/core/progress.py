"""Progress without a terminal: the rooms count, the command line draws.

A room that works for long takes ``progress: Progress = quiet`` and calls
``progress("decoding", 3, 100)``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Protocol, TypeVar

T = TypeVar("T")


class Progress(Protocol):
    """Called with the task, the amount done, the total (0 = unknown), and a short remark."""

    def __call__(self, task: str, done: int, total: int, remark: str = "", /) -> None:
        """Report once."""


def quiet(task: str, done: int, total: int, remark: str = "") -> None:
    """Show nothing."""


def track(items: Iterable[T], task: str, progress: Progress) -> Iterator[T]:
    """Yield ``items`` and report after each."""
    count = len(items) if isinstance(items, Sequence) else 0
    progress(task, 0, count)
    for done, item in enumerate(items, 1):
        yield item
        progress(task, done, count)
