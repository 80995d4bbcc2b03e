"""Pairs of anyone's own data: a table of image paths, or two folders of equal file names.

**A table** is CSV, TSV, JSONL or Parquet with one sample a row. The columns ``vision`` and ``tactile`` hold image paths
relative to the root (default: the table's folder); any other manifest column may be there, and other columns are
ignored. Empty cells are null. An absent ``id`` is made from ``video`` and ``frame``, else from the tactile path.

**A folder** holds ``vision/`` (or ``rgb``, ``image``, ``images``) and ``tactile/`` (or ``touch``, ``gelsight``,
``digit``) with files of equal stems, ``a.jpg`` and ``a.png`` being a pair; both may have one level of folders, one a
video. A stem that ends in an integer gives the frame.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, Problem, Progress, quiet
from palpate.data.formats.base import Facts, Found, Scan
from palpate.data.images import SUFFIXES
from palpate.data.manifest import SCHEMA

VISION = ("vision", "rgb", "image", "images")
TACTILE = ("tactile", "touch", "gelsight", "digit")
TABLES = (".csv", ".tsv", ".jsonl", ".parquet")
NEEDED = ("vision", "tactile")
LOOKED_FOR = (
    f"a table ({', '.join(TABLES)}) with the columns vision and tactile, or a folder with {'|'.join(VISION)}/ and {'|'.join(TACTILE)}/"
)
FACTS = Facts(
    "pairs of one's own",
    "unknown",
    "unknown",
    "unknown",
    "unknown",
    None,
    "as many as the table has rows",
    "the column video, if there is one",
)


def detect(source: Path) -> bool:
    """Whether this is a table file, or a folder with one vision and one touch folder."""
    if source.is_file():
        return source.suffix.lower() in TABLES
    return source.is_dir() and all(any((source / name).is_dir() for name in names) for names in (VISION, TACTILE))


def scan(source: Path, *, root: Path | None = None, columns: Mapping[str, str] | None = None, progress: Progress = quiet) -> Scan:
    """Reads the rows of a table, or pairs up the files of two folders.

    Args:
        source: a table or a folder.
        root: folder that the table's paths are relative to.
        columns: manifest column -> column of the table, where the names differ (``{"video": "clip"}``).
        progress: unused; reading a table is quick.

    Raises:
        PalpateError: if the source is missing or of another form, or lacks a needed column.
    """
    source = Path(source)
    problems: list[Problem] = []
    if source.is_dir():
        if columns:
            raise PalpateError("Columns can be renamed in a table only", f"the folder {source}", "Leave --map out")
        base, layout = source, "folders"
        rows = _folder_rows(source, problems)
    elif source.is_file():
        base, layout = Path(root) if root is not None else source.parent, f"table {source.suffix.lower()[1:]}"
        rows = _table_rows(source, dict(columns or {}), problems)
    else:
        raise PalpateError("The source of an import must exist", f"nothing at {source}", "Check the path")
    words = any(row.get("text") for _, row in rows)
    facts = {"dataset": source.stem, "layout": layout, "text_source": f"column {(columns or {}).get('text', 'text')}" if words else "none"}
    return Scan(rows, base, problems, facts=facts)


def _table_rows(path: Path, columns: dict[str, str], problems: list[Problem]) -> list[Found]:
    """(place, manifest row) of each readable row of a table."""
    if unknown := sorted(set(columns) - set(SCHEMA)):
        raise PalpateError(
            f"Renamed columns must be among {', '.join(SCHEMA)}", repr(unknown[0]), "Write it as manifest column = your column"
        )
    readers: dict[str, Callable[[Path, list[Problem]], Iterator[Found]]] = {
        ".csv": _csv_rows, ".tsv": _csv_rows, ".jsonl": _json_rows, ".parquet": _parquet_rows,
    }  # fmt: skip
    read = readers.get(path.suffix.lower())
    if read is None:
        raise PalpateError(f"A table of pairs must be one of {', '.join(TABLES)}", path.name, "Convert it, or rename it")
    names = {name: columns.get(name, name) for name in SCHEMA}
    found = list(read(path, problems))
    there = {name for _, row in found for name in row}
    must = [names[name] for name in SCHEMA if name in NEEDED or name in columns]
    if found and (absent := [name for name in must if name not in there]):
        raise PalpateError(
            f"{path} must have the columns {', '.join(must)}",
            f"no {', '.join(absent)} among {', '.join(sorted(there))}",
            "Rename it, or map it: --map vision=YOUR_COLUMN",
        )
    rows: list[Found] = []
    for where, given in found:
        row: dict[str, Any] = {name: _cell(given.get(theirs)) for name, theirs in names.items()}
        if row["frame"] is not None:
            if re.fullmatch(r"\d+(\.0+)?", row["frame"]) is None:
                problems.append(Problem(where, "bad-frame", f"the frame {row['frame']!r} is not an integer"))
                continue
            row["frame"] = int(row["frame"].split(".")[0])
        if lacking := [name for name in NEEDED if row[name] is None]:
            problems.append(Problem(where, "empty-cell", f"no {' and no '.join(lacking)} path"))
            continue
        rows.append((where, row))
    return rows


def _csv_rows(path: Path, problems: list[Problem]) -> Iterator[Found]:
    lines = path.read_bytes().decode("utf-8-sig", errors="replace").splitlines(keepends=True)
    reader = csv.reader(lines, delimiter="\t" if path.suffix.lower() == ".tsv" else ",")
    header: list[str] | None = None
    start = 1
    try:
        for cells in reader:
            where, start = f"{path}:{start}", reader.line_num + 1
            if not any(cell.strip() for cell in cells):
                continue
            if header is None:
                header = [cell.strip() for cell in cells]
            elif len(cells) != len(header):
                problems.append(Problem(where, "bad-row", f"{len(cells)} cells under {len(header)} columns"))
            else:
                yield where, dict(zip(header, cells, strict=True))
    except csv.Error as error:
        problems.append(Problem(f"{path}:{start}", "bad-row", str(error)))


def _json_rows(path: Path, problems: list[Problem]) -> Iterator[Found]:
    for number, line in enumerate(path.read_bytes().decode("utf-8-sig", errors="replace").split("\n"), 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except json.JSONDecodeError as error:
            problems.append(Problem(f"{path}:{number}", "bad-row", f"not JSON: {error.msg}"))
            continue
        if isinstance(row, dict):
            yield f"{path}:{number}", row
        else:
            problems.append(Problem(f"{path}:{number}", "bad-row", "not a JSON object"))


def _parquet_rows(path: Path, problems: list[Problem]) -> Iterator[Found]:
    """Places count rows from 1, as Parquet has no lines."""
    try:
        table = pl.read_parquet(path)
    except Exception as error:  # polars raises several kinds for a file that is not Parquet
        problems.append(Problem(str(path), "bad-table", f"not Parquet: {str(error).splitlines()[0]}"))
        return
    for number, row in enumerate(table.iter_rows(named=True), 1):
        yield f"{path}:{number}", row


def _cell(value: Any) -> str | None:
    """A cell as text; empty, null and NaN are None."""
    text = "" if value is None or value != value else str(value).strip()
    return text or None


def _folder_rows(folder: Path, problems: list[Problem]) -> list[Found]:
    """Pairs of equal stems below the vision and the touch folder; unpaired and ambiguous files are problems."""
    sides: dict[str, dict[str, Path]] = {}
    for side, names in (("vision", VISION), ("tactile", TACTILE)):
        there = [folder / name for name in names if (folder / name).is_dir()]
        if len(there) != 1:
            got = f"{len(there)} of them: {', '.join(p.name for p in there)}" if there else "none of them"
            raise PalpateError(f"{folder} must hold one folder of {side} images ({', '.join(names)})", got, "Rename the folder")
        sides[side] = _stems(there[0], folder, problems)
    rows: list[Found] = []
    for stem in sorted(set(sides["vision"]) | set(sides["tactile"])):
        pair = {side: files.get(stem) for side, files in sides.items()}
        video, _, name = stem.rpartition("/")
        number = re.search(r"\d+$", name)
        for side, other in (("vision", "tactile"), ("tactile", "vision")):
            path = pair[other]
            if pair[side] is None and path is not None:
                problems.append(Problem(_relative(path, folder), "unpaired", f"no {side} image of the name {stem!r}"))
        if pair["vision"] is not None and pair["tactile"] is not None:
            vision, tactile = _relative(pair["vision"], folder), _relative(pair["tactile"], folder)
            frame = int(number[0]) if number else None
            rows.append((tactile, {"id": stem, "video": video or None, "frame": frame, "vision": vision, "tactile": tactile}))
    return rows


def _stems(base: Path, folder: Path, problems: list[Problem]) -> dict[str, Path]:
    """``[video/]stem`` -> file, for the images in ``base`` and one level below it."""
    found: dict[str, Path] = {}
    for path in sorted([*base.iterdir(), *base.glob("*/*")]):
        if path.suffix.lower() not in SUFFIXES or path.name.startswith(".") or not path.is_file():
            continue
        stem = path.relative_to(base).with_suffix("").as_posix()
        if stem in found:
            problems.append(Problem(_relative(path, folder), "duplicate-id", f"{found[stem].name} has the same stem"))
        else:
            found[stem] = path
    return found


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()
