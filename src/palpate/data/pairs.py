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
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, Problem, Progress, inside, quiet
from palpate.data.images import SUFFIXES, Check, check_image, in_threads
from palpate.data.imported import Imported, raise_if, removing_on_error, require_some
from palpate.data.manifest import IMAGE_COLUMNS, SCHEMA, Manifest

VISION = ("vision", "rgb", "image", "images")
TACTILE = ("tactile", "touch", "gelsight", "digit")
TABLES = (".csv", ".tsv", ".jsonl", ".parquet")
NEEDED = ("vision", "tactile")
LOOKED_FOR = (
    f"a table ({', '.join(TABLES)}) with the columns vision and tactile, or a folder with {'|'.join(VISION)}/ and {'|'.join(TACTILE)}/"
)
Found = tuple[str, dict[str, Any]]


def detect(source: Path) -> bool:
    """Whether this is a table file, or a folder with one vision and one touch folder."""
    if source.is_file():
        return source.suffix.lower() in TABLES
    return source.is_dir() and all(any((source / name).is_dir() for name in names) for names in (VISION, TACTILE))


def import_pairs(
    source: Path,
    out: Path,
    *,
    root: Path | None = None,
    columns: Mapping[str, str] | None = None,
    skip_bad: bool = False,
    check: Check = "decode",
    progress: Progress = quiet,
) -> Imported:
    """Reads pairs and writes ``out/manifest.parquet``; images stay where they are.

    Args:
        source: a table or a folder.
        out: folder to write to.
        root: folder that the table's paths are relative to.
        columns: manifest column -> column of the table, where the names differ (``{"video": "clip"}``).
        skip_bad: leave bad rows out and list them, instead of raising.
        check: how images are checked.
        progress: told how many images are checked.

    Raises:
        PalpateError: if the source is missing or of another form, or lacks a needed column.
        ProblemsError: with every bad row and file at once; nothing is written.
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
    rows = _unique(_checked_paths(rows, base, problems), problems)
    rows = _checked_images(rows, base, check, problems, progress)
    problems.sort(key=_place)
    raise_if(problems, skip_bad)
    require_some(len(rows), source, problems)
    words = any(row.get("text") for _, row in rows)
    facts = {"dataset": source.stem, "layout": layout, "text_source": f"column {(columns or {}).get('text', 'text')}" if words else "none"}
    with removing_on_error(out) as created:
        return Imported(Manifest.from_rows((row for _, row in rows), base.resolve(), facts), problems).save(out, created)


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


def _checked_paths(rows: Sequence[Found], base: Path, problems: list[Problem]) -> list[Found]:
    """Rows whose paths stay inside the root and exist, written relative to it."""
    known: dict[str, tuple[str, str] | None] = {}
    root = base.resolve()
    good: list[Found] = []
    for where, row in rows:
        fine = True
        for name in IMAGE_COLUMNS:
            given = row.get(name)
            if given is None:
                continue
            if given not in known:
                path = inside(base, given)
                known[given] = (
                    ("outside-root", f"the path {given!r} leaves the root {base}") if path is None
                    else None if path.is_file() else ("missing-file", f"no file {given!r} in {base}")
                )  # fmt: skip
            if (found := known[given]) is not None:
                problems.append(Problem(where, found[0], f"{name}: {found[1]}"))
                fine = False
            elif given.startswith(("/", "./")) or "//" in given or "/../" in given or Path(given).is_absolute():
                row[name] = (root / given).resolve().relative_to(root).as_posix()
        if fine:
            good.append((where, row))
    return good


def _unique(rows: Sequence[Found], problems: list[Problem]) -> list[Found]:
    """Rows with their ids, each standing once; the first keeps it."""
    seen: dict[str, str] = {}
    good: list[Found] = []
    for where, row in rows:
        if row.get("id") is None:
            named = row.get("video") is not None and row.get("frame") is not None
            row["id"] = f"{row['video']}/{row['frame']}" if named else str(Path(row["tactile"]).with_suffix("").as_posix())
        if (before := seen.setdefault(row["id"], where)) != where:
            problems.append(Problem(where, "duplicate-id", f"the id {row['id']!r} stands at {before} already"))
        else:
            good.append((where, row))
    return good


def _checked_images(rows: Sequence[Found], base: Path, how: Check, problems: list[Problem], progress: Progress) -> list[Found]:
    """Rows whose images are whole; a file in use by many rows is checked once and told once, with its first row."""
    if how == "none":
        return list(rows)
    first: dict[str, str] = {}
    uses: Counter[str] = Counter()
    for where, row in rows:
        for name in IMAGE_COLUMNS:
            if row.get(name) is not None:
                first.setdefault(row[name], where)
                uses[row[name]] += 1
    bad: set[str] = set()
    for done, (name, reason) in enumerate(in_threads(lambda n: check_image(base / n, how), first), 1):
        if reason:
            bad.add(name)
            rest = f" (used by {uses[name]} rows)" if uses[name] > 1 else ""
            problems.append(Problem(first[name], "bad-image", f"{name}: {reason}{rest}"))
        progress("checking images", done, len(first))
    return [(where, row) for where, row in rows if not any(row.get(name) in bad for name in IMAGE_COLUMNS)]


def _place(problem: Problem) -> tuple[str, int, str]:
    name, _, line = problem.where.rpartition(":")
    return (name, int(line), problem.kind) if line.isdecimal() else (problem.where, 0, problem.kind)
