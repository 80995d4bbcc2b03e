"""The command ``palpate``.

This file is all that ``palpate --help`` loads: neither torch nor polars. Each verb is a module that
is imported when it is called. Standard output and error do not change what a command does: a reader
that goes away (``palpate score ... | head``), a stream that was closed before the start, or an
encoding without arrows: files are written all the same, and the exit status stays what it is. Only
a full disk behind ``>`` is an error.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from palpate.cli.verbs import INTERRUPTED, OK, USER_ERROR, VERBS


def usage(group: str = "") -> str:
    """Return the text of ``palpate --help``, or of one group of verbs (``"train"``)."""
    from palpate._version import __version__

    verbs = {name: verb for name, verb in VERBS.items() if name.startswith(group)}
    width = max(map(len, verbs))
    listed = "\n".join(f"  {name:<{width}}  {verb.help}" for name, verb in verbs.items())
    if group:
        return f"usage: palpate {group}VERB [options]\n\n{listed}\n"
    return (
        f"palpate {__version__}: tactile images from photos, splits that do not leak, scores "
        "with intervals.\n\n"
        f"usage: palpate VERB [options]\n\n{listed}\n\n"
        "  palpate VERB --help    options and an example of one verb\n"
        "  palpate --version      the version\n\n"
        f"Start here: palpate demo      Is my split leaking? {VERBS['audit'].example}\n"
    )


def main(argv: list[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 done, or no leak found; 1 a check failed, or a split leaks; 2 a user's mistake, explained
        in one line; 3 cannot tell; 70 a bug in palpate; 130 stopped by Ctrl-C, SIGTERM or
        a terminal that closes.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores one of them
            with suppress(ValueError):  # not in the main thread
                signal.signal(number, signal.default_int_handler)
    try:
        with resilient_streams():
            try:
                return _run(sys.argv[1:] if argv is None else argv)
            finally:
                sys.stdout.flush()
    except KeyboardInterrupt:  # also while the libraries load
        sys.stderr.write(
            "\npalpate: stopped. Run the same command again: with an output or a cache it "
            "resumes.\n"
        )
        return INTERRUPTED
    except OSError as error:  # a full disk behind standard output; verbs explain their own files
        sys.stderr.write(
            f"palpate: standard output must be writable. Got {error.strerror}. "
            "Free some space, or redirect it elsewhere.\n"
        )
        return USER_ERROR


def _run(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage())
        return OK if args else USER_ERROR
    if args[0] == "--version":
        from palpate._version import __version__

        sys.stdout.write(f"palpate {__version__}\n")
        return OK
    if " ".join(args[:2]) in VERBS:
        args = [" ".join(args[:2]), *args[2:]]
    group = f"{args[0]} "
    grouped = args[0] not in VERBS and any(name.startswith(group) for name in VERBS)
    if grouped and args[1:] in ([], ["-h"], ["--help"]):
        sys.stdout.write(usage(group))
        return OK if args[1:] else USER_ERROR
    from palpate.cli.terminal import run_verb

    return run_verb(args[0], args[1:])


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
