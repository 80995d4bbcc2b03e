"""Lists of samples whose images are not at hand: what their names alone say.

=====================================================  =============================================
source                                                 samples
=====================================================  =============================================
lines ``path`` or ``path,label`` of images             one a line
lines ``video start end [label]``, or a table of such  each frame from start to end, both included
JSON ``{"train": [[object, contact], ...], ...}``      one an item; a name instead of a number is a
                                                       video, and the second its frame
JSON or a table with paths of images                   one a row; nested keys are columns like
                                                       ``image.path``
=====================================================  =============================================

What the paths say more is read from those of all lists together (:mod:`palpate.data.recordings`).
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import polars as pl

from palpate.core import PalpateError, Problem, Split, require
from palpate.data.foreign import require_native
from palpate.data.formats.intervals import NEEDED, ORDER
from palpate.data.manifest import PATH, ROLES, SCHEMA, Manifest
from palpate.data.mapping import compile_maps
from palpate.data.recordings import USUAL
from palpate.data.rows import is_there, manifest_rows, read_classes, relocated, without_repeats
from palpate.data.scanning import require_some
from palpate.data.tables import (
    TABLES,
    Table,
    content_of,
    decoded,
    header_of,
    headless_names,
    is_image,
    lines_of,
    open_table,
    table_of,
)
from palpate.data.templates import Template

#: ``video start end [label]``, separated by spaces, tabs, commas or semicolons.
INTERVAL = re.compile(r"\s*([^\s,;]+)[\s,;]+(\d{1,9})[\s,;]+(\d{1,9})(?:[\s,;]+([^\s,;]+))?\s*")
#: Frames that the intervals of one list may have together.
MOST_FRAMES = 20_000_000


def read_names(
    source: Any, options: Mapping[str, Any] = MappingProxyType({})
) -> tuple[Manifest, list[Problem], Split | None] | None:
    """Read a list of samples whose images are not at hand.

    Args:
        source: a file, a polars or pandas frame, or dictionaries.
        options: ``columns`` (manifest column -> map expression), ``names`` of the columns of a
            table without a header, ``classes``, ``root``, and the templates ``vision`` or
            ``tactile`` of its paths.

    Returns:
        The samples, without images unless they are there; what is wrong with the list; and the
        split that it states. None if it is no such list.
    """
    for name in sorted(set(options) - {"columns", "names", "classes", "root", *ROLES}):
        must, got = "must be left out for a list or table", repr(options[name])
        raise PalpateError(must, got, "", argument=name)
    if not isinstance(source, (str, Path)):
        return _paths(Path("row"), table_of(source), False, options)
    path = Path(source)
    require_native(path)
    names = options["names"].split(",") if options.get("names") else []
    if not names and _is_interval(path):
        for name in sorted(set(options) - {"root"}):
            must, got = "must be left out for lines of video, start and end", repr(options[name])
            require(not options[name], name, must, got)
        return _intervals(path)
    if path.suffix.lower() not in TABLES and not names and not headless_names(path):
        return None
    nested = path.suffix.lower() in (".json", ".jsonl")
    require(not (nested and names), "names", "must be left out for JSON", path.name)
    header = header_of(path)
    if set(NEEDED) <= set(header):
        return _intervals(path) if not any(path.parent.glob("*/*")) else None
    table = open_table(path, [name.strip() for name in names])
    return _paths(path, table, nested and bool(table.names), options)


def _first_line(path: Path) -> str:
    """The first line that is not empty."""
    with open(path, "rb") as file:
        head = decoded(file.read(1 << 12))
    return next((line.strip() for line in lines_of(head) if line.strip()), "")


def _is_interval(path: Path) -> bool:
    """Whether the first line that is not empty is an interval."""
    match = INTERVAL.fullmatch(_first_line(path))
    return match is not None and not is_image(match[1])


def _intervals(path: Path) -> tuple[Manifest, list[Problem], None]:
    """Every frame of every interval."""
    lines, header = lines_of(decoded(content_of(path))), header_of(path)
    order = list(range(4))
    if header and not _is_interval(path):
        lines[0] = ""
        label = "material" if "material" in header else "label"
        order = [header.index(name) if name in header else 9 for name in (*NEEDED, label)]
    rows: list[tuple[str, int, int, str | None]] = []
    problems: list[Problem] = []
    for number, line in enumerate(lines, 1):
        cells = re.split(r"[\s,;]+", line.strip())
        video, first, last, label = (cells[k] if k < len(cells) else None for k in order)
        numeric = all(re.fullmatch(r"\d{1,18}", cell or "") for cell in (first, last))
        if video and numeric and int(first or 0) <= int(last or 0):
            rows.append((video, int(first or 0), int(last or 0), label))
        elif line.strip():
            text = f"{line!r} is not {' '.join(ORDER)} with a start up to the end"
            problems.append(Problem(f"{path}:{number}", "bad-interval", text))
    if (count := sum(last - first + 1 for _, first, last, _ in rows)) > MOST_FRAMES:
        must, got = f"{path} must have at most {MOST_FRAMES:,} frames", f"{count:,}"
        raise PalpateError(must, got, "Check the ends of the intervals")
    schema = {"video": pl.String, "first": pl.Int64, "last": pl.Int64, "material": pl.String}
    table = pl.DataFrame(rows, schema, orient="row").with_columns(
        contact=pl.format("{}#{}-{}", "video", "first", "last"),
        frame=pl.int_ranges("first", pl.col("last") + 1),
    )
    frames = table.explode("frame").unique(["video", "frame"], maintain_order=True)
    frames = frames.with_columns(id=pl.format("{}/{}", "video", "frame"))
    return _manifest(path, frames, path.parent, declared=True), problems, None


def _paths(
    path: Path, table: Table, nested: bool, options: Mapping[str, Any]
) -> tuple[Manifest, list[Problem], Split | None] | None:
    """One sample a row, named by its columns and by the path of its image."""
    maps = dict(options.get("columns", {}))
    compiled = compile_maps(maps, table.names, [*SCHEMA, "split"])
    columns = list(dict.fromkeys([*compiled.columns, *_path_columns(table.names)]))
    columns = [name for name in columns if name not in table.nested]
    frame = table.read(columns)
    cells = compiled.apply(frame)
    side, paths = _named_images(frame, cells, options)
    distinct = {f"of {name}": frame[name].to_list() for name in columns} | cells
    kept = without_repeats({**distinct, PATH: paths} if paths else distinct, table)
    paths, cells = kept.get(PATH), {name: kept[name] for name in cells}
    root = Path(options.get("root") or path.parent)
    images = [p for p in paths or () if p]
    there = any(is_there(root, p) for p in images) or bool(relocated(images, root))
    stated = {"id", "video", "object"} & cells.keys()
    mapped = there and {"vision", "tactile"} & cells.keys()
    plain = mapped or (not paths and "split" not in cells)
    if not (paths or stated) or (plain and not nested):
        return None
    cells = {name: values for name, values in cells.items() if name not in ("background", PATH)}
    classes = None if options.get("classes") is None else read_classes(Path(options["classes"]))
    for name in ("vision", "tactile") if not there else ():
        cells.pop(name, None)
    rows, _ = manifest_rows(cells, len(table.lines), table.where, classes, table.problems)
    require_some(len(rows), path, table.problems)
    template = Template.parse(options[side], side) if side and options.get(side) else None
    odd: list[Problem] = []
    for k, row in rows:
        if image := paths[k] if paths else None:
            row[PATH] = image
            if template and template.match(image) is None:
                text = f"{image!r} is not like the template {options[side]}"
                odd.append(Problem(table.where(k), "no-match", text))
        if "frame" in row:
            row["frame"] = int(row["frame"])
        row.setdefault("id", _id(row, table.where(k)))
    table.problems += odd if len(odd) > (1 - USUAL) * len(rows) else []
    samples = pl.DataFrame([row for _, row in rows], infer_schema_length=None)
    doubled = samples.filter(pl.col("id").is_duplicated())["id"].unique()
    if len(doubled):
        samples = samples.unique("id", keep="first", maintain_order=True)
        text = f"{len(doubled)} ids occur twice or more, first {doubled.sort()[0]!r}"
        table.problems.append(Problem(str(path), "duplicate-id", text))
    manifest = _manifest(path, samples, root, declared=bool(stated) and not nested)
    split = None
    if "split" in samples.columns:
        stated_split = samples.drop_nulls("split")
        parts = dict(zip(stated_split["id"], stated_split["split"], strict=True))
        split = Split(parts, {"name": path.stem, "method": "official"}, manifest.digest)
    return manifest, table.problems, split


def _id(row: Mapping[str, Any], where: str) -> str:
    if "video" in row and "frame" in row:
        return f"{row['video']}/{row['frame']}"
    return posixpath.splitext(row[PATH])[0] if row.get(PATH) else where


def _path_columns(names: Sequence[str], side: str = "") -> list[str]:
    """Columns that may hold paths: tactile by their name first, then photos, then others.

    With a side, those of the side first, then those that may be of it, then those of the other.
    """

    def place(name: str) -> int:
        words = set(re.findall("[a-z]+", name.lower()))
        role = next((r for r in ("tactile", "vision") if words & set(ROLES[r])), "")
        order = (side, "", *ROLES) if side else ("tactile", "vision", "")
        return order.index(role)

    return sorted(names, key=place)


def _named_images(
    frame: pl.DataFrame, cells: Mapping[str, Sequence[str | None]], options: Mapping[str, Any]
) -> tuple[str, Sequence[str | None] | None]:
    """The side that a template is given for, and the column of paths of images."""
    side = next((s for s in ("tactile", "vision") if options.get(s)), "")
    columns = {name: cells[name] for name in (side, "tactile", "vision") if name in cells}
    columns |= {n: frame[n].to_list() for n in _path_columns(frame.columns) if n not in columns}
    for name in _path_columns([*columns], side) if side else columns:
        values = columns[name]
        some = [value for value in values if value is not None]
        if 2 * sum(map(is_image, some)) > len(some):
            return side, values
    return side, None


def _manifest(path: Path, samples: pl.DataFrame, root: Path, *, declared: bool) -> Manifest:
    """A manifest of the rows of a list."""
    empty = (pl.lit(None, kind).alias(c) for c, kind in SCHEMA.items() if c not in samples.columns)
    more = [PATH] if PATH in samples.columns else []
    table = samples.with_columns(empty).with_columns(pl.col(c).cast(k) for c, k in SCHEMA.items())
    facts = {"dataset": path.stem} if declared else {"source": path.name}
    return Manifest(table.select([*SCHEMA, *more]), root, facts)
