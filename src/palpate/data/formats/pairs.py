"""Anyone's own data: a table of image paths, two folders of equal file names, or one folder of images of one kind.

**A table** is CSV, TSV, JSON lines, a JSON array or Parquet (:mod:`palpate.data.tables`) with one sample a row. The columns
``vision`` and ``tactile`` hold image paths relative to the root (default: the table's folder); one of the two is enough, but then
for all rows. Any other manifest column may be there, and so may ``split`` (train, val or test); other columns are ignored, and
map expressions (:mod:`palpate.data.mapping`) make columns of differently named ones. Empty cells are null. An absent ``id``
is made from ``video`` and ``frame``, else from the tactile (or vision) path.

**Two folders**: ``vision/`` (or ``rgb``, ``image``, ``images``) and ``tactile/`` (or ``touch``, ``gelsight``, ``digit``) with files of
equal stems, ``a.jpg`` and ``a.png`` being a pair, at any depth. **One folder** of images of one kind, named by ``side``, is a set to
search for near-duplicates. In both the folder that holds a file is its video, and a stem that ends in an integer gives
the frame; map expressions may say otherwise, from the column ``path``: the path below the folder of images.
"""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Literal

import polars as pl

from palpate.core import PalpateError, Problem, Progress, quiet
from palpate.data.formats.base import Facts, Found, Scan
from palpate.data.images import SUFFIXES
from palpate.data.manifest import SCHEMA
from palpate.data.mapping import compile_maps
from palpate.data.rows import Row, manifest_rows, odd_groups, read_classes
from palpate.data.tables import TABLES, header_of, open_table

Side = Literal["vision", "tactile"]
VISION = ("vision", "rgb", "image", "images")
TACTILE = ("tactile", "touch", "gelsight", "digit")
SIDES: tuple[tuple[Side, Side], ...] = (("vision", "tactile"), ("tactile", "vision"))
#: What may be mapped.
TARGETS = (*SCHEMA, "split")
LOOKED_FOR = (
    f"a table ({', '.join(TABLES)}) with the columns vision and tactile, or a folder with {'|'.join(VISION)}/ and {'|'.join(TACTILE)}/, "
    "or a folder of images"
)
FACTS = Facts(
    "data of one's own",
    "unknown",
    "unknown",
    "unknown",
    "unknown",
    None,
    "as many as the table has rows",
    "the column video, if there is one",
)


def detect(source: Path) -> bool:
    """Whether this is a table file, a folder with a vision and a touch folder, or a folder of images (or of folders of them)."""
    if source.is_file():
        return source.suffix.lower() in TABLES and (
            source.suffix.lower() != ".json" or bool(header_of(source))
        )
    if not source.is_dir():
        return False
    return all(
        any((source / name).is_dir() for name in names) for names in (VISION, TACTILE)
    ) or _has_images(source)


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
    """Reads the rows of a table, or the files of one folder or two.

    Args:
        source: a table or a folder.
        root: folder that the table's paths are relative to.
        columns: manifest column (or ``split``) -> map expression over the columns of the table (``{"video": "clip[:15]"}``).
        names: columns of a table without a header line, separated by commas.
        classes: table of classes, whose numbers stand in the column of the material; -1 leaves the row out as inconclusive.
        side: what the images of a single folder show.
        progress: told what is being done.

    Raises:
        PalpateError: if the source is missing or of another form, lacks a needed column, or an expression cannot be read.
        ProblemsError: on bad lines in the table of classes.
    """
    source = Path(source)
    maps = dict(columns or {})
    known = None if classes is None else read_classes(Path(classes))
    problems: list[Problem] = []
    progress("reading rows", 0, 1)
    if source.is_file():
        if side is not None:
            raise PalpateError(
                "side says what a folder of images shows",
                f"the table {source.name}",
                f"Leave it out; map a column: {side}=...",
            )
        base, layout = (
            Path(root) if root is not None else source.parent,
            f"table {source.suffix.lower()[1:] or 'csv'}",
        )
        rows, inconclusive = _table_rows(source, maps, names, known, problems)
    elif source.is_dir():
        if root is not None or names is not None:
            raise PalpateError(
                "Only a table has a root and names of columns",
                f"the folder {source}",
                "Leave root and names out",
            )
        base, layout = source, "folders" if side is None else f"folder of {side} images"
        files = _pairs(source, problems) if side is None else _single(source, side, problems)
        rows, inconclusive = _file_rows(files, source, maps, known, problems)
    else:
        raise PalpateError(
            "The source of an import must exist", f"nothing at {source}", "Check the path"
        )
    progress("reading rows", 1, 1)
    suspicious = odd_groups(source, rows)
    if rows and side is None and (lone := [name for name, _ in SIDES if name not in rows[0][1]]):
        text = f"no column {lone[0]}, so the samples have one image each; if there should be two, map it: --map {lone[0]}=YOUR_COLUMN"
        suspicious.append(Problem(str(source), "one-sided", text))
    words = any("text" in row for _, row in rows)
    facts = {
        "dataset": source.stem,
        "layout": layout,
        "text_source": f"column {maps.get('text', 'text')}" if words else "none",
    }
    found = Scan(rows, base, problems, suspicious, facts, inconclusive=inconclusive)
    if any("split" in row for _, row in rows):
        found.own, found.rules = (
            "Orig",
            {"Orig": {"method": "official", "column": maps.get("split", "split")}},
        )
    return found


def _table_rows(
    path: Path,
    maps: Mapping[str, str],
    names: str | None,
    classes: Mapping[int, str] | None,
    problems: list[Problem],
) -> tuple[list[Found], int]:
    """(place, manifest row) of each usable row of a table, and how many rows are inconclusive."""
    table = open_table(path, None if names is None else [name.strip() for name in names.split(",")])
    if not table.names:
        maps = {} if table.problems else maps
    expressions = compile_maps(maps, table.names, TARGETS)
    sides = [side for side, _ in SIDES if side in expressions.expressions]
    if not sides and not table.problems:
        got = (
            f"no tactile among {', '.join(table.names)}, and no vision"
            if table.names
            else "an empty file"
        )
        raise PalpateError(
            f"{path} must have the columns vision and tactile, or one of them",
            got,
            "Map it: --map vision=YOUR_COLUMN",
        )
    cells = expressions.apply(table.read(expressions.columns))
    problems += table.problems
    found, inconclusive = manifest_rows(cells, len(table.lines), table.where, classes, problems)
    rows: list[Found] = []
    for k, row in found:
        if lacking := [side for side in sides if side not in row]:
            problems.append(
                Problem(table.where(k), "empty-cell", f"no {' and no '.join(lacking)} path")
            )
            continue
        if long := [
            side
            for side in sides
            if len(row[side]) > 80 and any(len(p.encode()) > 255 for p in row[side].split("/"))
        ]:
            problems.append(
                Problem(
                    table.where(k),
                    "bad-path",
                    f"no file system holds a name as long as that of the {long[0]} path",
                )
            )
            continue
        rows.append((table.where(k), row))
    return rows, inconclusive


def _file_rows(
    files: Sequence[tuple[str, Row]],
    folder: Path,
    maps: Mapping[str, str],
    classes: Mapping[int, str] | None,
    problems: list[Problem],
) -> tuple[list[Found], int]:
    """Rows of image files by their paths below the folder of images, with what map expressions say in place of the folder's rule."""
    sides = [side for side, _ in SIDES if any(side in row for _, row in files)]
    cells = {
        "path": [path for path, _ in files],
        **{side: [row[side] for _, row in files] for side in sides},
    }
    where = lambda k: str(files[k][1].get("tactile") or files[k][1]["vision"])  # noqa: E731
    expressions = compile_maps(maps, list(cells), TARGETS).without(
        [t for t in TARGETS if t not in maps]
    )
    mapped = expressions.apply(pl.DataFrame(cells, schema=dict.fromkeys(cells, pl.String)))
    found, inconclusive = manifest_rows(mapped, len(files), where, classes, problems)
    rows: list[Found] = []
    for k, row in found:
        path, images = files[k]
        stem = posixpath.splitext(path)[0]
        number = re.search(r"\d{1,18}$", stem)
        place: Row = (
            {"id": stem}
            | ({"video": posixpath.dirname(path)} if "/" in path else {})
            | ({"frame": int(number[0])} if number else {})
        )
        rows.append((where(k), {**place, **images, **row}))
    return rows, inconclusive


def _pairs(folder: Path, problems: list[Problem]) -> list[tuple[str, Row]]:
    """(path of the touch below its folder, paths of the two images below ``folder``); unpaired files are problems."""
    files: dict[Side, dict[str, str]] = {}
    tops: dict[Side, str] = {}
    for (side, _), names in zip(SIDES, (VISION, TACTILE), strict=True):
        there = [name for name in names if (folder / name).is_dir()]
        if len(there) != 1:
            got = f"{len(there)} of them: {', '.join(there)}" if there else "none of them"
            fix = "Rename the folder, or name another format; for one folder of images of one kind: --as vision or --as tactile"
            raise PalpateError(
                f"{folder} must hold one folder of {side} images ({', '.join(names)})", got, fix
            )
        tops[side] = there[0]
        files[side] = _stems(folder / there[0], there[0], problems)
    rows: list[tuple[str, Row]] = []
    for stem in sorted({*files["vision"], *files["tactile"]}):
        pair: Row = {
            side: f"{tops[side]}/{files[side][stem]}" for side in files if stem in files[side]
        }
        for side, other in SIDES:
            if side not in pair:
                problems.append(
                    Problem(pair[other], "unpaired", f"no {side} image of the name {stem!r}")
                )
        if len(pair) == 2:
            rows.append((files["tactile"][stem], pair))
    return rows


def _single(folder: Path, side: Side, problems: list[Problem]) -> list[tuple[str, Row]]:
    """(path, image) of every image below a folder, in order of paths."""
    return [(path, {side: path}) for _, path in sorted(_stems(folder, "", problems).items())]


def _stems(base: Path, top: str, problems: list[Problem]) -> dict[str, str]:
    """Path without suffix -> path, of the images at any depth below ``base``; both are relative to it."""
    found: dict[str, str] = {}
    for path in _images(base):
        stem = posixpath.splitext(path)[0]
        if stem in found:
            where = f"{top}/{path}" if top else path
            problems.append(
                Problem(
                    where, "duplicate-id", f"{posixpath.basename(found[stem])} has the same stem"
                )
            )
        else:
            found[stem] = path
    return found


def _images(base: Path) -> Iterator[str]:
    """Images below a folder, relative to it, a folder's own before those further down; hidden ones are left out, links followed once."""
    seen: set[str] = set()
    for place, folders, files in os.walk(base, followlinks=True):
        if (real := os.path.realpath(place)) in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        prefix = Path(place).relative_to(base).as_posix()
        for name in sorted(files):
            if name.lower().endswith(SUFFIXES) and not name.startswith("."):
                yield name if prefix == "." else f"{prefix}/{name}"


def _has_images(folder: Path) -> bool:
    """Whether one of the first folders of a tree holds an image."""
    return any(
        name.lower().endswith(SUFFIXES)
        for _, _, files in islice(os.walk(folder), 50)
        for name in files
    )
