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
from palpate.core.images import SUFFIXES
from palpate.data.adjacent import adjacent_tables, join_tables, tables_of_pairs
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
from palpate.data.formats.layout import first_files, require_folder
from palpate.data.frames import VIDEOS
from palpate.data.listed import Listed, read_table
from palpate.data.manifest import IMAGE_COLUMNS, PART_NAMES, is_image
from palpate.data.mapping import LINE, compile_maps
from palpate.data.rows import manifest_rows, odd_groups, read_classes, records
from palpate.data.scanning import Facts, Format, Scan
from palpate.data.tables import TABLES, header_of, headless_names
from palpate.data.templates import FIX, Fields, Matches, Template, assign, walk

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


def detect(source: Path) -> bool:
    """Whether this is a table file, or a folder with images below it."""
    if source.is_file():
        suffix = source.suffix.lower()
        tabular = suffix in TABLES and (suffix != ".json" or bool(header_of(source)))
        return tabular or bool(headless_names(source))
    return any(map(is_image, first_files(source)))


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
    is_table = source.is_file()
    if not is_table:
        require_folder(source, FACTS.name)
    templates = {c: text for c in IMAGE_COLUMNS if (text := getattr(options, c)) is not None}
    foreign = {"root": options.root, "names": options.names}
    foreign = {"side": options.side, **templates} if is_table else foreign
    for name, value in foreign.items():
        must = f"must come with a {'folder' if is_table else 'table'}"
        require(value is None, name, must, str(source), fix="Leave it out")
    progress("reading rows", 0, 1)
    if is_table:
        listed = read_table(
            source,
            columns=options.columns,
            names=options.names,
            classes=options.classes,
            root=options.root,
        )
        result = scan_of(listed)
    else:
        result = _of_folder(source, options, templates)
    progress("reading rows", 1, 1)
    return result


def scan_of(listed: Listed) -> Scan:
    """The scan of a table whose images must be files."""
    result, path = listed.scan, Path(listed.table.name)
    listed.add_images()
    result.facts["layout"] = f"table {path.suffix.lower()[1:] or 'csv'}"
    _describe(result, path, listed.mapped)
    sides = {side for _, row in result.rows for side in SIDES if side in row}
    if absent := [side for side in SIDES if sides and side not in sides]:
        text = f"no column {absent[0]}, so the samples have one image each; map one if there is one"
        result.suspect(path, "one-sided", text)
    return result


def _of_folder(source: Path, options: Options, templates: Mapping[str, str]) -> Scan:
    """The images of a folder, by the tables in it that pair them, else by their names."""
    result, maps = Scan(source), options.columns or {}
    by_names = templates or options.side or (maps and not {*SIDES} <= maps.keys())
    tables = {} if by_names else tables_of_pairs(source, maps)
    undecided = [path for path, (_, ways) in tables.items() if len(ways) > 1]
    for path, (below, ways) in tables.items() if not undecided else ():
        first, classes = len(result.rows), options.classes
        listed = read_table(path, columns=ways[0], classes=classes, scan=result, below=below)
        listed.add_images()
        result.suspect(path, "table-first", "the images are those of this table")
        part = PART_NAMES.get(path.stem.lower())
        for _, row in result.rows[first:] if part else ():
            row.setdefault("split", part)
    if result.rows:
        named = {posixpath.normpath(r[c]) for _, r in result.rows for c in IMAGE_COLUMNS if c in r}
        left = [name for name in walk(source, SUFFIXES)[0] if name not in named]
        result.suspect(source, "unmatched", "images that no table names", left)
    elif not result.problems:
        labels = read_classes(options.classes)
        try:
            _read_folder(result, templates, options.side, maps, labels)
        except PalpateError as error:
            beside = [
                f"{path.name} ({few(header_of(path))})" for path, _ in adjacent_tables(source)
            ]
            error.got += f"; next to {few(beside)}, of which no columns pair them" * bool(beside)
            if not undecided:
                raise
        if undecided and not all(f"template_{side}" in result.facts for side in SIDES):
            path, (_, ways) = undecided[0], tables[undecided[0]]
            must = f"{source} must be read by its table {path.name}"
            got = f"the columns {few(ways[0].values())} of images, without a word of what they show"
            choices = [{"columns": {side: way[side] for side in SIDES}} for way in ways]
            raise PalpateError(must, got, "Choose one of these", choices=choices)
    _describe(result, source, maps)
    return result


def _describe(result: Scan, source: Path, maps: Mapping[str, str]) -> None:
    """Add what is odd of the rows of a scan, and facts about them."""
    result.suspicious += odd_groups(source, result.rows)
    result.state_texts(f"column {maps.get('text', 'text')}")
    result.facts["dataset"] = source.resolve().stem
    if any("split" in row for _, row in result.rows) and not result.splits:
        result.split_rule = {"column": maps.get("split", "split")}


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
        _read_folder(result, templates, None, layout.columns, None, published=True)
        result.facts.pop("templates", None)
        result.state_texts("table")
        result.facts |= {"layout": templates["tactile"]}
        if "template_vision" not in result.facts:
            result.facts["vision"] = "none in this layout"
        progress("reading rows", 1, 1)
        return result

    return Format(layout.facts, detect, " and ".join(templates.values()), scan)


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
    files = [*filter(is_image, files)]
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
    cells = compiled.apply(table.with_row_index(LINE))
    good, result.inconclusive = manifest_rows(cells, places.__getitem__, classes, result.problems)
    result.rows += records(good, places.__getitem__)
    join_tables(result, result.rows)


def _distinct(result: Scan, matches: Matches) -> Matches:
    """The files of one side without those that differ from an earlier one by the suffix alone."""
    first: dict[str, tuple[str, Fields]] = {}
    for path, fields in matches:
        if (before := first.setdefault(posixpath.splitext(path)[0], (path, fields)))[0] != path:
            result.problem(path, "duplicate-id", f"{before[0]} has the same stem")
    return list(first.values())
