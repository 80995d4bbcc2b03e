"""Standard output and error that do not change what a command does.

A reader that goes away (``palpate score ... | head``), a stream that was closed before the start,
or an encoding without arrows: files are written all the same, and the exit status stays what it is.
Only a full disk behind ``>`` is an error.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, TextIO


class ResilientStream:
    """A text stream whose reader may go away, and whose encoding may lack letters.

    Args:
        stream: the stream, or None where it was closed before the start.
        strict: raise other errors than a reader that went away.
    """

    def __init__(self, stream: TextIO | None, *, strict: bool) -> None:
        self.strict = strict
        self.stream: TextIO = _devnull() if stream is None else stream

    def write(self, text: str) -> int:
        """Write; letters that the encoding lacks become question marks."""
        encoding = getattr(self.stream, "encoding", None) or "utf-8"
        text = text.encode(encoding, "replace").decode(encoding)
        try:
            self.stream.write(text)
        except OSError as error:
            self._discard(error)
        return len(text)

    def flush(self) -> None:
        """Flush."""
        try:
            self.stream.flush()
        except OSError as error:
            self._discard(error)

    def _discard(self, error: OSError) -> None:
        """Send buffered and later text to nowhere: it would fail again when the process ends."""
        devnull = _devnull()
        try:
            os.dup2(devnull.fileno(), self.stream.fileno())
        except (OSError, ValueError, AttributeError):  # a stream in memory has no file
            self.stream = devnull
        if self.strict and not isinstance(error, BrokenPipeError):
            raise error

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _devnull() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")


@contextmanager
def resilient_streams() -> Generator[None]:
    """Make both standard streams a :class:`ResilientStream` inside."""
    streams = sys.stdout, sys.stderr
    wrapped = ResilientStream(sys.stdout, strict=True), ResilientStream(sys.stderr, strict=False)
    sys.stdout, sys.stderr = wrapped  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr = streams
        for stream in wrapped:
            stream.flush()
