"""Anyone's data: a table of image paths, or a folder whose templates say what its images are.

**A table** is CSV, TSV, JSON lines, a JSON array or Parquet (:mod:`palpate.data.tables`) with one
sample a row. The columns ``vision`` and ``tactile`` hold image paths relative to the root (default:
the table's folder); one of the two is enough, but then for all rows. Any other manifest column may
be there, and so may ``split`` (train, val or test); other columns are ignored, and map expressions
(:mod:`palpate.data.mapping`) make columns of differently named ones. Empty cells are null. An
absent ``id`` is made from ``video`` and ``frame``, else from the tactile (or vision) path.

**A folder** has a template (:mod:`palpate.data.templates`) for each side, given or found from the
names of the files (:mod:`palpate.data.detection`)::

    {object}/press_{contact}/photo/{frame}.jpg
    {object}/press_{contact}/touch/{frame}.jpg

Fields become columns, also new ones, and equal fields join the sides. The id is made of all fields.
A ``contact`` or ``video`` of one name is several, named by those fields, too, where an ``object``,
``session``, ``material`` (or ``video``) before it differs.
Map expressions may use the fields and ``path``, the path of the tactile (or vision) image.
"""

from __future__ import annotations

import os
import posixpath
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from palpate.core import PalpateError, Progress, few, quiet, require
from palpate.data.adjacent import join_tables, tables_of_pairs
from palpate.data.detection import (
    SIDES,
    TARGETS,
    Side,
    joined,
    name_apart,
    parsed,
    templates_of,
    walked,
)
from palpate.data.formats.layout import require_folder
from palpate.data.frames import VIDEOS
from palpate.data.images import SUFFIXES
from palpate.data.manifest import PART_NAMES
from palpate.data.mapping import compile_maps
from palpate.data.rows import manifest_rows, odd_groups, read_classes, relocated, without_repeats
from palpate.data.scanning import Facts, Format, Scan
from palpate.data.tables import TABLES, header_of, open_table
from palpate.data.templates import FIX, Fields, Matches, Template, assign

if TYPE_CHECKING:
    from palpate.data.formats.published import Layout

LOOKS_FOR = (
    f"a table ({', '.join(TABLES)}) with the columns vision and tactile, or a folder of images"
)
FACTS = Facts(
    name="your own data",
    samples="as many as the table has rows",
    group="the column video, if there is one",
)
#: Folders that are looked into for a published layout.
PEEKS = 60
#: No file system has names of more bytes.
LONGEST_NAME = 255
MAP = {"columns": {"vision": "YOUR_COLUMN"}}


def detect(source: Path) -> bool:
    """Whether this is a table file, or a folder with images below it."""
    if source.is_file():
        suffix = source.suffix.lower()
        return suffix in TABLES and (suffix != ".json" or bool(header_of(source)))
    files = (
        name for _, _, names in islice(os.walk(source, followlinks=True), 500) for name in names
    )
    return any(name.lower().endswith(SUFFIXES) for name in files)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a table or a folder of images is read by.

    Attributes:
        vision: template of the photos of a folder; without any template the names are searched.
        tactile: template of its tactile images.
        background: template of its tactile images without contact.
        root: folder that the table's paths are relative to.
        columns: manifest column (or ``split``) -> map expression over the columns of the table, or
            over the fields of a folder.
        names: columns of a table without a header line, separated by commas.
        classes: table of classes, whose numbers are in the column of the material; rows of -1 are
            skipped as inconclusive.
        side: what the images of a folder show, if all show one thing.
    """

    vision: str | None = None
    tactile: str | None = None
    background: str | None = None
    root: Path | None = None
    columns: Mapping[str, str] | None = None
    names: str | None = None
    classes: Path | None = None
    side: Side | None = None


def scan(source: Path, options: Options, *, progress: Progress = quiet) -> Scan:
    """Read the rows of a table, or the images of a folder."""
    source = Path(source)
    maps = dict(options.columns or {})
    labels = None if options.classes is None else read_classes(Path(options.classes))
    is_table = source.is_file()
    if not is_table:
        require_folder(source, FACTS.name)
    texts = {column: getattr(options, column) for column in (*SIDES, "background")}
    foreign = {"side": options.side, **texts}
    foreign = foreign if is_table else {"root": options.root, "names": options.names}
    if wrong := [name for name, value in foreign.items() if value is not None]:
        must = f"must come with a {'folder' if is_table else 'table'}"
        raise PalpateError(must, str(source), "Leave it out", argument=wrong[0])
    base = source.parent if is_table else source
    result = Scan(base if options.root is None else Path(options.root))
    progress("reading rows", 0, 1)
    if is_table:
        result.facts["layout"] = f"table {source.suffix.lower()[1:] or 'csv'}"
        _read_table(result, source, maps, options.names, labels)
    else:
        templates = {column: text for column, text in texts.items() if text is not None}
        tables = [] if templates or options.side or maps else tables_of_pairs(source)
        for path in tables:
            first = len(result.rows)
            _read_table(result, path, maps, None, labels)
            result.suspect(path, "table-first", "the images are those of this table")
            for _, row in result.rows[first:]:
                if part := PART_NAMES.get(path.stem.lower()):
                    row.setdefault("split", part)
        if not tables:
            _read_folder(result, templates, options.side, maps, labels)
    progress("reading rows", 1, 1)
    result.suspicious += odd_groups(source, result.rows)
    absent = [name for name in SIDES if result.rows and name not in result.rows[0][1]]
    if absent and is_table:
        text = f"no column {absent[0]}, so the samples have one image each; map one if there is one"
        result.suspect(source, "one-sided", text)
    worded = any("text" in row for _, row in result.rows)
    result.facts["text_source"] = f"column {maps.get('text', 'text')}" if worded else "none"
    result.facts["dataset"] = source.resolve().stem
    if any("split" in row for _, row in result.rows) and not result.splits:
        result.split_name = "Orig"
        result.split_rule = {"method": "official", "column": maps.get("split", "split")}
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan, record=Options)


def format_of(layout: Layout) -> Format:
    """The format of a published layout."""
    templates = layout.templates

    def detect(source: Path) -> bool:
        """Whether the tactile template matches one of the first files, and constants are there."""
        constant = (text for text in templates.values() if "{" not in text)
        if not all((source / text).is_file() for text in constant):
            return False
        tactile = Template.parse(templates["tactile"])
        folders = islice(os.walk(source, followlinks=True), PEEKS)
        paths = (Path(folder, name) for folder, _, names in folders for name in names)
        return any(tactile.match(path.relative_to(source).as_posix()) for path in paths)

    def scan(source: Path, *, progress: Progress = quiet) -> Scan:
        result = Scan(require_folder(source, layout.facts.name))
        progress("reading rows", 0, 1)
        _read_folder(result, dict(templates), None, layout.columns, None, published=True)
        result.facts.pop("templates", None)
        worded = any("text" in row for _, row in result.rows)
        result.facts |= {"text_source": "table" if worded else "none"}
        result.facts |= {"layout": templates["tactile"]}
        if "template_vision" not in result.facts:
            result.facts["vision"] = "none in this layout"
        progress("reading rows", 1, 1)
        return result

    return Format(layout.facts, detect, " and ".join(templates.values()), scan)


def _read_table(
    result: Scan,
    path: Path,
    maps: Mapping[str, str],
    names: str | None,
    classes: Mapping[int, str] | None,
) -> None:
    """Add the rows of a table."""
    table = open_table(path, None if names is None else [name.strip() for name in names.split(",")])
    broken = bool(table.problems) and not table.names
    compiled = compile_maps({} if broken else maps, table.names, TARGETS)
    sides = [side for side in SIDES if side in compiled.expressions]
    if not sides and not table.problems:
        columns = ", ".join(table.names)
        got = f"no tactile among {columns}, and no vision" if columns else "an empty file"
        must = f"{path} must have the columns vision and tactile, or one of them"
        raise PalpateError(must, got, "Map your columns to them", example=MAP)
    cells = without_repeats(compiled.apply(table.read(compiled.columns)), table)
    result.problems += table.problems
    result.suspicious += table.suspicious
    sides = [side for side in sides if any(cells[side])] or sides  # a column may be empty
    rows, result.inconclusive = manifest_rows(
        cells, len(table.lines), table.where, classes, result.problems
    )
    images = [(row, c) for _, row in rows for c in (*SIDES, "background") if c in row]
    places = relocated((row[column] for row, column in images), result.base)
    for row, column in images:
        row[column] = places.get(row[column], row[column])
    if places:
        written, below = next(iter(places.items()))
        text = f"{len(places)} paths are read by their end: {written!r} is {below!r}"
        result.suspect(path, "other-paths", text)
    for k, row in rows:
        lacking = " and no ".join(side for side in sides if side not in row)
        names_in_paths = "/".join(row.get(side, "") for side in sides).split("/")
        if lacking:
            result.problem(table.where(k), "empty-cell", f"no {lacking} path")
        elif any(len(name.encode()) > LONGEST_NAME for name in names_in_paths):
            text = "a name in a path is longer than file systems allow"
            result.problem(table.where(k), "bad-path", text)
        else:
            result.rows.append((table.where(k), row))


def _read_folder(
    result: Scan,
    texts: Mapping[str, str],
    side: Side | None,
    maps: Mapping[str, str],
    classes: Mapping[int, str] | None,
    *,
    published: bool = False,
) -> None:
    """Add the images of a folder, by its templates; map expressions go first.

    Of a ``published`` layout a side may be lacking.
    """
    files = walked(result, (*SUFFIXES, *VIDEOS))
    videos = [path for path in files if path.lower().endswith(VIDEOS)]
    text = "videos, which are read with a template of their own"
    result.suspect(result.base, "unmatched", text, videos)
    files = [path for path in files if path.lower().endswith(SUFFIXES)]
    result.facts |= {"templates": "stated"} if texts else {}
    templates = parsed(texts or templates_of(files, result.base, side))
    matches = {s: _distinct(result, found) for s, found in assign(files, templates).items()}
    if published:
        templates = {side: t for side, t in templates.items() if matches[side] or side == "tactile"}
    for side_, template in templates.items():
        got = f"{template.text}, which matches none of {few(files)}"
        require(bool(matches[side_]), side_, "must match images", got, fix=FIX)
    rows, fields = joined(result, files, templates, matches, "images")
    first = next(iter(templates))
    if "background" in templates:
        without = [row[first] for row in rows if "background" not in row]
        result.suspect(result.base, "no-background", "images without a background", without)
    ids = ["/".join(row[name] for name in fields if name in row) for row in rows]
    if fields and "id" not in fields and len(set(ids)) == len(ids):  # else they are the paths
        rows = [row | {"id": i} for row, i in zip(rows, ids, strict=True)]
    name_apart(rows, fields)
    places = [row[first] for row in rows]
    names = dict.fromkeys((*fields, *templates, "id"))
    table = pl.DataFrame(
        {"path": places} | {name: [row.get(name) for row in rows] for name in names},
        schema=dict.fromkeys(("path", *names), pl.String),
    )
    compiled = compile_maps(maps, table.columns, (*TARGETS, *result.more))
    cells = compiled.apply(table)
    numbered, result.inconclusive = manifest_rows(
        cells, len(places), places.__getitem__, classes, result.problems
    )
    result.rows += [(places[k], row) for k, row in numbered]
    join_tables(result, result.rows)


def _distinct(result: Scan, matches: Matches) -> Matches:
    """The files of one side without those that differ from an earlier one by the suffix alone."""
    first: dict[str, tuple[str, Fields]] = {}
    for path, fields in matches:
        if (before := first.setdefault(posixpath.splitext(path)[0], (path, fields)))[0] != path:
            result.problem(path, "duplicate-id", f"{before[0]} has the same stem")
    return list(first.values())
