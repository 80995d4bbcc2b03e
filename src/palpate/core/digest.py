"""Digests: SHA-256 over canonical forms, so that equal content has an equal name anywhere."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from palpate.core.plain import plain


def canonical_json(value: Any) -> str:
    """Return ``value`` as JSON with sorted keys and no spaces; dataclasses and paths are accepted.

    Raises:
        ValueError: for NaN or infinity, which JSON cannot hold.
    """
    return json.dumps(
        value,
        sort_keys=True,
        separators=(",", ":"),
        default=plain,
        allow_nan=False,
        ensure_ascii=False,
    )


def digest_json(value: Any) -> str:
    """Return the SHA-256 (64 hex digits) of the canonical JSON of ``value``."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def digest_lines(lines: Iterable[str]) -> str:
    """Return the SHA-256 of the lines, each ended by a newline, in the order given."""
    state = hashlib.sha256()
    for line in lines:
        state.update(f"{line}\n".encode())
    return state.hexdigest()


def digest_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_folder(folder: Path, pattern: str = "**/*") -> str:
    """Return the SHA-256 over names and bytes of the files in ``folder`` that match ``pattern``."""
    files = sorted(p for p in folder.glob(pattern) if p.is_file())
    return digest_lines(f"{p.relative_to(folder).as_posix()} {digest_file(p)}" for p in files)


def short(digest: str) -> str:
    """Return the first 12 digits: enough for people and folder names."""
    return digest[:12]
