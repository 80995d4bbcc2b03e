"""Anyone's data: a table of image paths, two folders of equal file names, or one folder of images.

**A table** is CSV, TSV, JSON lines, a JSON array or Parquet (:mod:`palpate.data.tables`) with one
sample a row. The columns ``vision`` and ``tactile`` hold image paths relative to the root (default:
the table's folder); one of the two is enough, but then for all rows. Any other manifest column may
be there, and so may ``split`` (train, val or test); other columns are ignored, and map expressions
(:mod:`palpate.data.mapping`) make columns of differently named ones. Empty cells are null. An
absent ``id`` is made from ``video`` and ``frame``, else from the tactile (or vision) path.

**Two folders**::

    root/
      vision/  (or rgb, image, images)         a.jpg  rec/b_7.jpg
      tactile/ (or touch, gelsight, digit)     a.png  rec/b_7.jpg     equal stems at any depth

**One folder** of images of one kind, named by ``side``, is a set to search for near-duplicates. In
both layouts the folder of a file is its video, and a stem that ends in an integer gives the frame;
map expressions may override this, from the column ``path``: the path below the folder of images.
"""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Literal

import polars as pl

from palpate.core import PalpateError, Progress, quiet
from palpate.data.formats.base import Cells, Facts, Format, Scan
from palpate.data.formats.layout import Images, paired, require_folder
from palpate.data.images import SUFFIXES
from palpate.data.manifest import SCHEMA
from palpate.data.mapping import compile_maps
from palpate.data.rows import manifest_rows, odd_groups, read_classes
from palpate.data.tables import TABLES, header_of, open_table

Side = Literal["vision", "tactile"]
VISION = ("vision", "rgb", "image", "images")
TACTILE = ("tactile", "touch", "gelsight", "digit")
SIDES = {"vision": VISION, "tactile": TACTILE}
#: What may be mapped.
TARGETS = (*SCHEMA, "split")
LOOKS_FOR = (
    f"a table ({', '.join(TABLES)}) with the columns vision and tactile, or a folder with "
    f"{'|'.join(VISION)}/ and {'|'.join(TACTILE)}/, or a folder of images"
)
FACTS = Facts(
    name="your own data",
    samples="as many as the table has rows",
    group="the column video, if there is one",
)
#: No file system has names of more bytes.
LONGEST_NAME = 255
MAP = {"columns": {"vision": "YOUR_COLUMN"}}


def detect(source: Path) -> bool:
    """Whether this is a table file, a folder with two sides, or a folder with images below it."""
    if source.is_file():
        suffix = source.suffix.lower()
        return suffix in TABLES and (suffix != ".json" or bool(header_of(source)))
    if all(_folders(source, side) for side in SIDES):
        return True
    files = (name for _, _, names in islice(os.walk(source), 50) for name in names)
    return any(name.lower().endswith(SUFFIXES) for name in files)


def scan(
    source: Path,
    *,
    root: Path | None = None,
    columns: Mapping[str, str] | None = None,
    names: str | None = None,
    classes: Path | None = None,
    side: Side | None = None,
    progress: Progress = quiet,
) -> Scan:
    """Read the rows of a table, or the files of one folder or two.

    Args:
        source: a table or a folder.
        root: folder that the table's paths are relative to.
        columns: manifest column (or ``split``) -> map expression over the columns of the table.
        names: columns of a table without a header line, separated by commas.
        classes: table of classes, whose numbers are in the column of the material; rows of -1 are
            skipped as inconclusive.
        side: what the images of a single folder show.
        progress: called before and after reading.

    Raises:
        PalpateError: if the source is missing or of another form, lacks a needed column, or an
            expression cannot be read.
        ProblemsError: on bad lines in the table of classes.
    """
    source = Path(source)
    maps = dict(columns or {})
    labels = None if classes is None else read_classes(Path(classes))
    is_table = source.is_file()
    if not is_table:
        require_folder(source, FACTS.name)
    foreign = {"side": side} if is_table else {"root": root, "names": names}
    if given := [name for name, value in foreign.items() if value is not None]:
        must = f"must come with a {'folder' if is_table else 'table'}"
        raise PalpateError(must, str(source), "Leave it out", argument=given[0])
    progress("reading rows", 0, 1)
    layout = "folders" if side is None else f"folder of {side} images"
    layout = f"table {source.suffix.lower()[1:] or 'csv'}" if is_table else layout
    base = source.parent if is_table else source
    result = Scan(base if root is None else Path(root), {"layout": layout})
    if is_table:
        _read_table(result, source, maps, names, labels)
    else:
        single = {} if side is None else {p: {side: p} for p in _images(result, ".").files.values()}
        _add_files(result, _pairs(result) if side is None else single, maps, labels)
    progress("reading rows", 1, 1)
    result.suspicious += odd_groups(source, result.rows)
    absent = [name for name in SIDES if result.rows and name not in result.rows[0][1]]
    if absent and side is None:
        text = f"no column {absent[0]}, so the samples have one image each; map one if there is one"
        result.suspect(source, "one-sided", text)
    worded = any("text" in row for _, row in result.rows)
    result.facts["text_source"] = f"column {maps.get('text', 'text')}" if worded else "none"
    result.facts["dataset"] = source.stem
    if any("split" in row for _, row in result.rows):
        result.split_name = "Orig"
        result.split_rule = {"method": "official", "column": maps.get("split", "split")}
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan)


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
    cells = compiled.apply(table.read(compiled.columns))
    result.problems += table.problems
    rows, result.inconclusive = manifest_rows(
        cells, len(table.lines), table.where, classes, result.problems
    )
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


def _add_files(
    result: Scan,
    files: Mapping[str, Cells],
    maps: Mapping[str, str],
    classes: Mapping[int, str] | None,
) -> None:
    """Add image files by their path below the folder of images; map expressions go first."""
    paths = list(files)
    sides = [side for side in SIDES if any(side in row for row in files.values())]
    columns = {"path": paths, **{side: [row[side] for row in files.values()] for side in sides}}
    compiled = compile_maps(maps, list(columns), TARGETS)
    compiled = compiled.without([target for target in TARGETS if target not in maps])
    cells = compiled.apply(pl.DataFrame(columns, schema=dict.fromkeys(columns, pl.String)))
    places = [str(row.get("tactile") or row["vision"]) for row in files.values()]
    rows, result.inconclusive = manifest_rows(
        cells, len(paths), places.__getitem__, classes, result.problems
    )
    for k, row in rows:
        stem = posixpath.splitext(paths[k])[0]
        defaults: Cells = {"id": stem}
        if "/" in stem:
            defaults["video"] = posixpath.dirname(stem)
        if number := re.search(r"\d{1,18}$", stem):
            defaults["frame"] = int(number[0])
        result.rows.append((places[k], {**defaults, **files[paths[k]], **row}))


def _pairs(result: Scan) -> dict[str, Cells]:
    """Path of the tactile image below its folder -> the paths of both images below the source."""
    sides: list[Images[str]] = []
    for side, names in SIDES.items():
        folders = _folders(result.base, side)
        if len(folders) != 1:
            must = f"{result.base} must hold one folder of {side} images ({', '.join(names)})"
            got = f"{len(folders)} of them: {', '.join(folders)}" if folders else "none of them"
            fix = "Rename the folder; for one folder of images of one kind say what they show"
            raise PalpateError(must, got, fix, example={"side": "tactile"})
        sides.append(_images(result, folders[0]))
    vision, tactile = sides
    return {
        tactile.files[stem]: {"vision": vision.path(stem), "tactile": tactile.path(stem)}
        for stem in paired(result, tactile, vision)
    }


def _folders(source: Path, side: str) -> list[str]:
    return [name for name in SIDES[side] if (source / name).is_dir()]


def _images(result: Scan, place: str) -> Images[str]:
    """Path without suffix -> path of the images at any depth below a folder."""
    files: dict[str, str] = {}
    for path in _walk(result.base / place):
        stem = posixpath.splitext(path)[0]
        if (before := files.setdefault(stem, path)) != path:
            where, text = posixpath.join(place, path), f"{before} has the same stem"
            result.problem(posixpath.normpath(where), "duplicate-id", text)
    return Images(place, dict(sorted(files.items())))


def _walk(base: Path) -> Iterator[str]:
    """Images below a folder, relative to it; hidden ones are skipped, links are followed once."""
    seen: set[str] = set()
    for folder, below, files in os.walk(base, followlinks=True):
        real = os.path.realpath(folder)
        below[:] = sorted(n for n in below if real not in seen and not n.startswith("."))
        prefix = Path(folder).relative_to(base)
        for name in sorted(files) if real not in seen else ():
            if name.lower().endswith(SUFFIXES) and not name.startswith("."):
                yield (prefix / name).as_posix()
        seen.add(real)
