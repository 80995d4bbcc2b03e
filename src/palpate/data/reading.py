"""Samples from whatever names them: a manifest, a frame list, a table, or a folder of a known data set; nothing is written."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, Problem, Progress, quiet
from palpate.data.formats import FORMATS
from palpate.data.formats.base import finished
from palpate.data.formats.pairs import TACTILE, VISION
from palpate.data.images import SUFFIXES
from palpate.data.imported import raise_if, require_some
from palpate.data.listing import LINE, read_list
from palpate.data.manifest import Manifest
from palpate.data.texts import decoded, lines_of

TABLES = (".csv", ".tsv", ".jsonl", ".json", ".parquet")


def read_samples(
    path: Path, *, skip_bad: bool = False, root: Path | None = None, progress: Progress = quiet
) -> tuple[Manifest, list[Problem]]:
    """The samples that a path names.

    Args:
        path: ``manifest.parquet`` or its folder; a frame list (``video/frame.jpg,label`` a line); a table with the columns ``vision``
            or ``tactile``; the folder of a data set of a known format; or a folder of pictures of one modality, photos unless it is named as touches are.
        skip_bad: leave bad rows out and list them, instead of raising.
        root: where the paths of a table start.
        progress: told what is being done.

    Returns:
        The samples, and what was left out. Samples of a list or of raw videos have no pictures.

    Raises:
        PalpateError: if there is no such path, or it is nothing of these.
        ProblemsError: with every bad row, unless ``skip_bad``.
    """
    path = Path(path)
    if not path.exists():
        raise PalpateError(
            "Samples must be a manifest, a list, a table or a folder",
            f"nothing at {path}",
            "Check the path",
        )
    if is_manifest(path):
        return Manifest.load(path), []
    if path.is_file() and (path.suffix.lower() not in TABLES or is_list(path)):
        found = read_list(path, skip_bad=skip_bad)
        return found.manifest, found.skipped
    name = (
        "pairs" if path.is_file() else next((n for n, f in FORMATS.items() if f.detect(path)), "")
    )
    options: dict[str, Any] = (
        {"root": root} if root is not None and path.is_file() and name == "pairs" else {}
    )
    if path.is_dir() and name in ("", "pairs"):
        sides: list[str] = [
            s
            for s, names in (("vision", VISION), ("tactile", TACTILE))
            if any((path / n).is_dir() for n in names)
        ]
        if not sides and not any(
            p.suffix.lower() in SUFFIXES for p in (*path.glob("*"), *path.glob("*/*"))
        ):
            raise PalpateError(
                f"{path} must hold a manifest, pictures, or a data set of a known format",
                "none of them",
                "Import it first: palpate import",
            )
        name = "pairs"
        if (
            len(sides) < 2
        ):  # pictures of one modality: photos, unless the folder's name says that they are touches
            options["side"] = (
                sides[0] if sides else "tactile" if path.name.lower() in TACTILE else "vision"
            )
    # Pictures are not decoded here: who looks at them reports those that cannot be read.
    if "check" in inspect.signature(FORMATS[name].scan).parameters:
        options["check"] = "none"
    scan = FORMATS[name].scan(path, progress=progress, **options)
    rows = finished(scan, "none", progress)
    raise_if(scan.problems, skip_bad)
    require_some(len(rows), path, scan.problems)
    facts = {**FORMATS[name].facts.of_manifest(), "format": name, **scan.facts}
    return Manifest.from_rows((row for _, row in rows), scan.base.resolve(), facts), scan.problems


def is_manifest(path: Path) -> bool:
    """Whether this is a manifest file or a folder that holds one."""
    if path.is_dir():
        return (path / "manifest.parquet").is_file()
    if path.suffix.lower() != ".parquet":
        return False
    try:
        with open(path, "rb") as file:
            return str(pl.read_parquet_metadata(file).get("palpate.format", "")).startswith(
                "palpate-manifest/"
            )
    except (
        Exception
    ):  # polars raises several kinds for a file that is not Parquet; whoever reads it next says so
        return False


def is_list(path: Path) -> bool:
    """Whether the first line that is not empty is a row of a frame list."""
    with open(path, "rb") as file:
        head = decoded(file.read(1 << 16))
    line = next((line.strip() for line in lines_of(head) if line.strip()), "")
    return re.match(LINE, line) is not None
