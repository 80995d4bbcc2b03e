"""Caches and checkpoints, which palpate reads back: checked before they are believed.

The digest of such a file, ``NAME``, lies beside it in ``NAME.sha256``, one line of 64 hex digits:
SHA-256 over the digests of its blocks of 64 MiB. The lines below it are of earlier versions of the
file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

from palpate.core.files import atomic_path, content_of, digest_lines, write_text
from palpate.core.messages import PalpateError, Progress

T = TypeVar("T")
#: Bytes of a file that are digested at a time, each by a thread.
BLOCK = 64 << 20
#: Digests that are kept of files before: of one whose successor was killed before its renaming.
BEFORE = 8


@contextmanager
def sealed_path(path: Path) -> Generator[Path]:
    """As :func:`atomic_path`, for a file that palpate itself reads back: see :func:`is_whole`.

    Its digest goes to ``NAME.sha256`` before it is renamed, above those of the files before it:
    whichever is there after a kill is known.
    """
    with atomic_path(path) as part:
        yield part
        lines = [_digest_once(part), *_sealed(path)[:BEFORE]]
        write_text(_seal(path), "\n".join(lines) + "\n")


def is_whole(path: Path) -> bool:
    """Whether a file is, byte for byte, what :func:`sealed_path` wrote; a process reads it once."""
    with suppress(OSError):
        return _digest_once(path) in _sealed(path)
    return False


def cached(
    file: Path, make: Callable[[Path], object], load: Callable[[Path], T], progress: Progress
) -> T:
    """Load a cached file; ``make`` writes one that is absent, or damaged, which is said."""
    if not is_whole(file):
        if file.exists():
            progress(f"{file} is damaged: making it again", 0, 0)
        with sealed_path(file) as part:
            make(part)
    return load(file)


def _seal(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


def _sealed(path: Path) -> list[str]:
    """The digests that a file may have; none where they cannot be read."""
    with suppress(OSError, PalpateError):
        return content_of(_seal(path)).decode("utf-8", "replace").split()
    return []


def _digest_once(path: Path) -> str:
    stat = path.stat()
    return _digest_blocks(path, stat.st_ino, stat.st_size, stat.st_mtime_ns)


@lru_cache(1024)
def _digest_blocks(path: Path, *stamp: int) -> str:
    """Return the SHA-256 over those of the blocks of a file; ``stamp`` changes when it does."""

    def block(start: int) -> str:
        with open(path, "rb") as file:
            file.seek(start)
            return hashlib.sha256(file.read(BLOCK)).hexdigest()

    with ThreadPoolExecutor(4) as pool:
        return digest_lines(pool.map(block, range(0, path.stat().st_size, BLOCK)))
