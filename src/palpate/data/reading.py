"""Load samples from a manifest, list, table, data frame or data-set folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, quiet, require, require_regular
from palpate.data.foreign import require_native
from palpate.data.formats import intervals, pairs, scanned
from palpate.data.imported import Imported, imported_of, splits_of
from palpate.data.listed import SIDES, read_table
from palpate.data.listing import is_list, read_list
from palpate.data.manifest import Manifest, is_manifest
from palpate.data.recordings import name_recordings
from palpate.data.scanning import raise_if
from palpate.data.tables import TABLES, headless_names


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
        name, form, scan = scanned(path, "pairs" if "side" in options else format, options)
    except PalpateError as error:
        if not error.choices:
            raise
        # A folder whose names do not say what its images show is one of photos.
        name, form, scan = scanned(path, format, options | {"side": "vision"})
        scan.facts["side_assumed"] = "vision"
    facts = {**form.facts.of_manifest(), "format": name}
    return imported_of(scan, path, facts, skip_bad=skip_bad, check="none", progress=progress)


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
    if intervals.has_recordings(path, options.get("root")):
        return None
    _require_only({"root", "columns", "classes"}, options, "a list of intervals alone")
    imported = intervals.by_name(path, options.get("columns"), options.get("classes"))
    raise_if(imported.skipped, skip_bad)
    return imported


def _of_table(source: Any, options: Mapping[str, Any], *, images: bool, skip_bad: bool) -> Imported:
    """The samples of a table or list, with its images if one of these is there, or all must."""
    _require_only({"columns", "names", "classes", "root", *SIDES}, options, "a list or table")
    side = next((side for side in ("tactile", "vision") if side in options), "")
    own = {name: value for name, value in options.items() if name not in SIDES}
    listed = read_table(source, side=side, **own)
    if listed.sides and (images or listed.at_hand):
        must = "must come with a folder, or a list whose images are not at hand"
        require(not side, side, must, listed.table.name, fix="Leave it out")
        facts = {**pairs.FACTS.of_manifest(), "format": "pairs"}
        scan = pairs.scan_of(listed)
        return imported_of(scan, listed.table.name, facts, skip_bad=skip_bad, check="none")
    imported = listed.by_name(options.get(side))
    raise_if(imported.skipped, skip_bad)
    return imported


def _require_only(accepted: set[str], options: Mapping[str, Any], kind: str) -> None:
    """Raise for an option that a kind of source does not take."""
    for name in sorted(set(options) - accepted):
        fix = f"It takes {', '.join(f'`{option}`' for option in sorted(accepted))}"
        require(False, name, f"must be left out for {kind}", repr(options[name]), fix=fix)
