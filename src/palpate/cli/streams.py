"""Standard output and error that cannot change what a command does.

A reader that goes away (``palpate score ... | head``), a stream that was closed before the start, or a terminal that has no arrow among its
letters: files are written all the same, and the exit status stays what it is. A disk that fills behind ``>`` is still told.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, TextIO


class Steady:
    """A text stream whose reader may go away, and whose letters may be few."""

    def __init__(self, stream: TextIO | None, *, told: bool = True) -> None:
        self.told = (
            told  # whether a full disk is an error: behind standard error there is nobody to tell
        )
        self.stream: TextIO = open(os.devnull, "w", encoding="utf-8") if stream is None else stream  # noqa: SIM115

    def write(self, text: str) -> int:
        """As the stream's; letters that it has not become question marks."""
        try:
            self._attempt(text)
        except UnicodeEncodeError:
            coding = getattr(self.stream, "encoding", None) or "ascii"
            self._attempt(text.encode(coding, "replace").decode(coding))
        return len(text)

    def _attempt(self, text: str) -> None:
        try:
            self.stream.write(text)
        except OSError as error:
            self._give_up(error)

    def flush(self) -> None:
        """As the stream's."""
        try:
            self.stream.flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        """What is still held, and what comes, goes nowhere: else it would fail again when the process ends."""
        nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        try:
            os.dup2(nowhere.fileno(), self.stream.fileno())
            nowhere.close()
        except (
            OSError,
            ValueError,
            AttributeError,
        ):  # a stream in memory, or a closed one, has no file
            self.stream = nowhere
        if self.told and not isinstance(error, BrokenPipeError):
            raise error

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def steady() -> Generator[None]:
    """Both standard streams are :class:`Steady` inside, and written out at the end."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = now = Steady(before[0]), Steady(before[1], told=False)  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        for stream in now:
            stream.flush()
