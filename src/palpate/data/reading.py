"""Load samples from a manifest, list, table, data frame or data-set folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Problem, Progress, quiet, require, require_regular
from palpate.data.foreign import require_native
from palpate.data.formats import Format, recognized, require_options
from palpate.data.listing import LINE, read_list
from palpate.data.manifest import IMAGE_COLUMNS, SCHEMA, Manifest, is_manifest
from palpate.data.mapping import compile_maps
from palpate.data.naming import read_names
from palpate.data.recordings import name_recordings
from palpate.data.rows import manifest_rows, read_classes
from palpate.data.scanning import Scan, finished, manifest_of, raise_if, require_some
from palpate.data.tables import TABLES, Table, decoded, header_of, lines_of, open_table, table_of

#: Columns of which a table needs at least one.
NAMING = ("id", "video", *IMAGE_COLUMNS[:2])


def load(
    source: Any,
    *,
    format: str = "auto",  # noqa: A002
    images: bool = True,
    skip_bad: bool = False,
    progress: Progress = quiet,
    **options: Any,
) -> Manifest:
    """Load samples without writing anything, with the recordings that their names show.

    Args:
        source: a manifest file or the folder of an import; a frame list (``video/frame.jpg,label``
            per line); a table file; a polars or pandas frame, or a list of dictionaries, with
            manifest columns; or the folder of a data set of any known format, or of images of one
            modality (``side``: ``vision`` or ``tactile``).
        format: name of the format, or ``auto``.
        images: raise if samples have no image files because their frames are inside videos or
            tables. Frame lists and tables without image columns never have images.
        skip_bad: skip bad rows instead of raising.
        progress: progress callback.
        options: options of the format, e.g. ``root`` and ``columns`` of a table.

    Raises:
        PalpateError: if there is no such source, it is nothing of these, or its images must be
            imported first.
        ProblemsError: with every bad row, unless ``skip_bad``.
    """
    imported = isinstance(source, str | Path) and is_manifest(Path(source))
    if imported:
        _require_left_out(options, {"root"}, "a manifest")
    manifest, _ = read_samples(
        source, format=format, skip_bad=skip_bad, progress=progress, **options
    )
    without = not manifest.table["vision"].count() and not manifest.table["tactile"].count()
    if images and without and "format" in manifest.facts:  # lists and tables have no format
        got = f"{source}, whose images are inside videos or tables"
        fix = f"Import it first: palpate import {source} -o DIR"
        raise PalpateError("must have its images as files", got, fix, argument="source")
    return name_recordings([manifest])[0]


def read_samples(
    source: Any,
    *,
    format: str = "auto",  # noqa: A002
    skip_bad: bool = False,
    progress: Progress = quiet,
    **options: Any,
) -> tuple[Manifest, list[Problem]]:
    """Load samples as :func:`load` does; frames inside videos or tables have no images.

    Returns:
        The samples, and what was skipped.
    """
    options = {name: value for name, value in options.items() if value is not None}
    if isinstance(source, Manifest):
        return source, []
    if not isinstance(source, (str, Path)):
        # Rows whose images are not at hand are those of a list on disk.
        named = None if "root" in options else read_names(source, options)
        if named is None:
            return _of_table(table_of(source), Path(), skip_bad, options)
        raise_if(named[1], skip_bad)
        return named[:2]
    path = Path(source)
    require_regular(path)
    if format == "auto" and path.exists():
        require_native(path)
        if is_manifest(path):
            return Manifest.load(path, options.get("root")), []
        if path.is_file() and (path.suffix.lower() not in TABLES or is_list(path)):
            if named := read_names(path, options) if set(options) - {"root"} else None:
                raise_if(named[1], skip_bad)
                return named[:2]
            listed = read_list(path, skip_bad=skip_bad)
            return listed.manifest, listed.skipped
    chosen = "pairs" if "side" in options else format
    name, form = recognized(path, chosen, options)
    columns = {*header_of(path), *options.get("columns", {})} if path.is_file() else set[str]()
    if name == "pairs" and path.is_file() and columns.isdisjoint(("vision", "tactile")):
        names = options.pop("names", None)
        return _of_table(open_table(path, names), path.parent, skip_bad, options)
    # Images are not decoded here: broken ones are reported when they are read.
    more = {"check": "none", "progress": progress}
    scan = _scanned(form, path, require_options(name, form, options | more))
    facts = {**form.facts.of_manifest(), "format": name, **scan.facts}
    return _of_scan(scan, path, facts, skip_bad, progress)


def is_list(path: Path) -> bool:
    """Whether the first line that is not empty is a row of a frame list."""
    with open(path, "rb") as file:
        head = decoded(file.read(1 << 16))
    line = next((line.strip() for line in lines_of(head) if line.strip()), "")
    return re.match(LINE, line) is not None


def _require_left_out(options: Mapping[str, Any], accepted: set[str], kind: str) -> None:
    """Raise for an option that a kind of source does not take."""
    for name in sorted(set(options) - accepted):
        raise PalpateError(f"must be left out for {kind}", repr(options[name]), "", argument=name)


def _scanned(form: Format, path: Path, options: dict[str, Any]) -> Scan:
    """Scan a source; a folder whose names do not say what its images show is one of photos."""
    try:
        return form.read(path, options)
    except PalpateError as error:
        if not error.choices:
            raise
        scan = form.read(path, options | {"side": "vision"})
        scan.facts["side_assumed"] = "vision"
        return scan


def _of_table(
    table: Table, root: Path, skip_bad: bool, options: dict[str, Any]
) -> tuple[Manifest, list[Problem]]:
    """Samples of a data frame, or of a table without images."""
    _require_left_out(options, {"columns", "root", "classes"}, "a table")
    maps = compile_maps(options.get("columns", {}), table.names, [*SCHEMA, "split"])
    must = f"must have at least one of the columns {', '.join(NAMING)}"
    got = ", ".join(table.names) or "no columns"
    fix = "Map a column to one of them"
    require(any(name in maps.expressions for name in NAMING), "source", must, got, fix=fix)
    classes = None if "classes" not in options else read_classes(Path(options["classes"]))
    cells = maps.apply(table.read(maps.columns))
    rows, _ = manifest_rows(cells, len(table.lines), table.where, classes, table.problems)
    facts = {"dataset": Path(table.name).stem}
    base = Path(options.get("root", root))
    places = [(table.where(k), row) for k, row in rows]
    scan = Scan(base, rows=places, problems=table.problems)
    return _of_scan(scan, table.name, facts, skip_bad, quiet)


def _of_scan(
    scan: Scan, source: object, facts: dict[str, str], skip_bad: bool, progress: Progress
) -> tuple[Manifest, list[Problem]]:
    rows = finished(scan, "none", progress)
    raise_if(scan.problems, skip_bad)
    require_some(len(rows), source, scan.problems)
    return manifest_of(scan, rows, facts), scan.problems
