"""Load samples from a manifest, list, table, data frame or data-set folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, Problem, Progress, Split, quiet, require, require_regular
from palpate.data.foreign import require_native
from palpate.data.formats import intervals, pairs, scanned
from palpate.data.formats.layout import find_videos
from palpate.data.imported import Imported, imported_of, splits_of
from palpate.data.listed import NAMING, Listed, read_table
from palpate.data.listing import is_list, read_list
from palpate.data.manifest import IMAGE_COLUMNS, PATH, SIDES, Manifest, is_manifest
from palpate.data.mapping import LINE
from palpate.data.recordings import USUAL, name_recordings
from palpate.data.scanning import raise_if, require_some
from palpate.data.tables import TABLES, headless_names
from palpate.data.templates import Template


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
        images: raise if samples have no image files because their frames are inside videos, or the
            files that a table names are not there. Frame lists and tables without image columns
            never have images.
        skip_bad: skip bad rows instead of raising.
        progress: progress callback.
        options: options of the format, e.g. ``root`` and ``columns`` of a table.

    Raises:
        PalpateError: if there is no such source, it is nothing of these, or its images must be
            imported first.
        ProblemsError: with every bad row, unless ``skip_bad``.
    """
    manifest = read(
        source, format=format, images=images, skip_bad=skip_bad, progress=progress, **options
    ).manifest
    without = not manifest.table["vision"].count() and not manifest.table["tactile"].count()
    if images and without and "format" in manifest.facts:  # lists and tables have no format
        got = f"{source}, whose images are inside videos or tables"
        fix = f"Import it first: palpate import {source} -o DIR"
        raise PalpateError("must have its images as files", got, fix, argument="source")
    return name_recordings([manifest])[0]


def read(
    source: Any,
    *,
    format: str = "auto",  # noqa: A002
    images: bool = False,
    skip_bad: bool = False,
    progress: Progress = quiet,
    **options: Any,
) -> Imported:
    """Read samples as :func:`load` does, with what is wrong with them and the splits they state.

    Args:
        source: as in :func:`load`.
        format: likewise.
        images: whether the images of tables must be there; else samples of a table of whose images
            none is there are named by its cells alone. Frames inside videos have no images.
        skip_bad: skip bad rows instead of raising.
        progress: progress callback.
        options: likewise.

    Raises:
        PalpateError: as :func:`load`.
        ProblemsError: likewise.
    """
    options = {name: value for name, value in options.items() if value is not None}
    if isinstance(source, Manifest):
        return Imported(source)
    if not isinstance(source, str | Path):
        return _of_table(source, options, images=images, skip_bad=skip_bad)
    path = Path(source)
    require_regular(path)
    if format == "auto" and path.exists():
        require_native(path)
        if is_manifest(path):
            _require_only({"root"}, options, "a manifest")
            return Imported(Manifest.load(path, options.get("root")), splits=splits_of(path))
        if path.is_file() and (named := _of_file(path, options, images, skip_bad)):
            return named
    # Images are not decoded here: broken ones are reported when they are read.
    options |= {"check": "none", "progress": progress}
    try:
        scan = scanned(path, "pairs" if "side" in options else format, options)[-1]
    except PalpateError as error:
        if not error.choices or any("columns" in choice for choice in error.choices):
            raise
        # A folder whose names do not say what its images show is one of photos.
        scan = scanned(path, format, options | {"side": "vision"})[-1]
        scan.facts["side_assumed"] = "vision"
    return imported_of(scan, path, skip_bad=skip_bad, check="none", progress=progress)


def _of_file(
    path: Path, options: Mapping[str, Any], images: bool, skip_bad: bool
) -> Imported | None:
    """The samples of a list or table; None if it is next to the recordings that it lists."""
    is_interval = is_table = False
    if not (set(options) <= {"root"} and is_list(path)):
        is_interval = "names" not in options and intervals.detect(path)
        is_table = path.suffix.lower() in TABLES or "names" in options or bool(headless_names(path))
    if not (is_interval or is_table):
        listed = read_list(path, skip_bad=skip_bad)
        return Imported(listed.manifest, listed.skipped, inconclusive=listed.inconclusive)
    if not is_interval:
        return _of_table(path, options, images=images, skip_bad=skip_bad)
    if find_videos(Path(options.get("root", path.parent))):
        return None
    _require_only({"root", "columns", "classes"}, options, "a list of intervals alone")
    imported = intervals.by_name(path, options.get("columns"), options.get("classes"))
    raise_if(imported.skipped, skip_bad)
    return imported


def _of_table(source: Any, options: Mapping[str, Any], *, images: bool, skip_bad: bool) -> Imported:
    """The samples of a table or list, with its images if one of these is there, or all must."""
    _require_only({"columns", "names", "classes", "root", *SIDES}, options, "a list or table")
    side = next((side for side in ("tactile", "vision") if side in options), "")
    own = (item for item in options.items() if item[0] not in SIDES)
    listed = read_table(source, side=side, **dict(own))
    if listed.sides and (images or listed.at_hand):
        must = "must come with a folder, or a list whose images are not at hand"
        require(not side, side, must, listed.table.name, fix="Leave it out")
        scan = pairs.scan_of(listed)
        scan.facts = {**pairs.FACTS.of_manifest(), "format": "pairs", **scan.facts}
        return imported_of(scan, listed.table.name, skip_bad=skip_bad, check="none")
    imported = _by_name(listed, options.get(side))
    raise_if(imported.skipped, skip_bad)
    return imported


def _by_name(listed: Listed, template: str | None) -> Imported:
    """The samples without their images, each named by its columns or the path of its image.

    Args:
        listed: what a table or list says.
        template: of the paths; that it does not match some is a problem if they are many.

    Raises:
        PalpateError: if no column names samples.
    """
    problems = listed.scan.problems
    stated = not {"id", "video", "object"}.isdisjoint(listed.rows.columns)
    usable = stated or PATH in listed.rows.columns or bool(problems)
    must = f"must have at least one of the columns {', '.join(NAMING)}"
    got = ", ".join(listed.table.names) or "no columns"
    require(usable, "source", must, got, fix="Map a column to one of them")
    require_some(len(listed.rows), listed.table.name, problems)
    rows = listed.rows.drop(IMAGE_COLUMNS, strict=False)
    if template and PATH in rows.columns:
        problems += _unlike(listed, Template.parse(template), template)
    names = {
        "id": pl.col("id"),
        "frame": pl.concat_str("video", "frame", separator="/"),
        PATH: pl.col(PATH).str.replace(r"([^/])\.[^./]*$", "$1"),
        LINE: pl.concat_str(pl.lit(f"{listed.table.name}:"), LINE),
    }
    if "video" not in rows.columns:
        del names["frame"]
    rows = rows.with_columns(id=pl.coalesce(names[c] for c in names if c in rows.columns))
    first = rows["id"].is_first_distinct()
    for line, name in rows.filter(~first).select(LINE, "id").iter_rows():
        text = f"the id {name!r} is in an earlier row already"
        problems.append(Problem(listed.table.place(line), "duplicate-id", text))
    rows = rows.filter(first)
    problems.sort(key=Problem.sort_key)
    path = Path(listed.table.name)
    named_by_path = not stated or path.suffix.lower() in (".json", ".jsonl")
    facts = {"source": path.name} if named_by_path else {"dataset": path.stem}
    facts |= {"path_column": listed.paths} if listed.paths not in ("", PATH) else {}
    facts |= {"images_absent": "yes"} if PATH in rows.columns and not listed.at_hand else {}
    table = rows.drop(LINE, "split", strict=False)
    manifest = Manifest.of_table(table, listed.scan.base, facts)
    splits: dict[str, Split] = {}
    if "split" in rows.columns:
        parts = dict(rows.drop_nulls("split").select("id", "split").iter_rows())
        rule = {"method": "official", "column": listed.mapped.get("split", "split")}
        splits["Orig"] = Split(parts, rule, manifest.digest)
    scan = listed.scan
    return Imported(manifest, problems, splits, scan.inconclusive, scan.suspicious)


def _unlike(listed: Listed, template: Template, text: str) -> list[Problem]:
    """Problems of the paths that a template does not match, if they are many."""
    rows = listed.rows.select(LINE, PATH).drop_nulls()
    odd = [(line, path) for line, path in rows.iter_rows() if template.match(path) is None]
    return [
        Problem(listed.table.place(line), "no-match", f"{path!r} is not like the template {text}")
        for line, path in odd
        if len(odd) > (1 - USUAL) * len(listed.rows)
    ]


def _require_only(accepted: set[str], options: Mapping[str, Any], kind: str) -> None:
    """Raise for an option that a kind of source does not take."""
    for name in sorted(set(options) - accepted):
        fix = f"It takes {', '.join(f'`{option}`' for option in sorted(accepted))}"
        require(False, name, f"must be left out for {kind}", repr(options[name]), fix=fix)
