"""Stamps: what stands for a thing on disk, or a function, in the digest of a stage.

A stage is built again when a stamp changes: that of a model with its weights, that of data with the
sizes and times of their files, that of a function with its source.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate.core import digest_file, digest_folder, digest_json, digest_lines, read_json, require
from palpate.encoders.models import Part, shipped_folder


def model_stamp(part: Part, source: str | None) -> str | None:
    """What names a given model: the digest of its folder or file, or its hub id."""
    if source is None:
        return None
    if (shipped := shipped_folder(source, part)) is not None:
        record = read_json(shipped / "palpate.json", "model record")  # with digests of weights
        for card in {"card", "training"} & {*record}:  # what is trained from it carries the rest
            record[card] = {k: v for k, v in record[card].items() if k not in ("title", "summary")}
        return digest_json(record)
    if Path(source).is_file():
        return digest_file(Path(source))
    return digest_folder(Path(source)) if Path(source).is_dir() else source


def data_stamp(source: Path) -> str:
    """Names, sizes and modification times of the files of a data set: changes when it does."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    return digest_lines(
        f"{p.relative_to(source)} {(s := p.stat()).st_size} {s.st_mtime_ns}" for p in files
    )


def function_stamp(function: Callable[..., Any]) -> str:
    """What names a function: its module, its name, and the digest of its source.

    Raises:
        PalpateError: if it has no source, or holds values of another function.
    """
    try:
        text = hashlib.sha256(inspect.getsource(function).encode()).hexdigest()
    except (OSError, TypeError):
        text = ""
    must = "What a study reads or makes its images with must be a function of a file"
    bare = bool(text) and not getattr(function, "__closure__", None)
    require(bare, None, must, f"{function!r}"[:200], fix="Write it in a module")
    return f"{function.__module__}.{function.__qualname__} {text}"
