"""From the text cells of a table to rows of a manifest."""

from __future__ import annotations

import posixpath
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PARTS, Problem, require
from palpate.data.manifest import PART_NAMES
from palpate.data.mapping import LINE
from palpate.data.tables import INCONCLUSIVE, read_categories

#: Columns that a split keeps whole; where only some rows have a value, a person should look.
GROUPS = ("video", "object", "session")
INTEGERS = ("frame", "start", "end")
#: A text that is a whole number (``7``, ``007``, ``7.0``).
WHOLE = r"^\+?(-?[0-9]{1,18})(?:\.0+)?$"
#: Paths that are looked for, to see where those of another machine start.
TRIED = 100
Row = dict[str, Any]
#: The line of a row -> its place in words (``file:line``).
Place = Callable[[int], str]


def manifest_rows(
    rows: pl.DataFrame, place: Place, classes: Mapping[int, str] | None, problems: list[Problem]
) -> tuple[pl.DataFrame, int]:
    """Rows of a manifest from mapped cells.

    ``frame``, ``start`` and ``end`` become integers; with ``classes`` the number of a material
    becomes its name, and rows of number -1 (inconclusive) are skipped; ``split`` becomes the name
    of a part.

    Args:
        rows: manifest columns as texts and the column ``LINE``, as :meth:`ColumnMaps.apply` gives
            them.
        place: line -> its place.
        classes: number -> name, or None to take materials as they are.
        problems: what is wrong is added here.

    Returns:
        The good rows, and how many were inconclusive.
    """
    columns = [name for name in rows.columns if name != LINE]
    count, failed = len(rows), set[int]()

    def report(name: str, kind: str, wrong: pl.Expr, words: str) -> None:
        for line, cell in rows.filter(wrong).select(LINE, name).iter_rows():
            problems.append(Problem(place(line), kind, f"the {name} {cell!r} is {words}"))
            failed.add(line)

    if classes is not None and "material" in columns:
        number = pl.col("material").str.extract(WHOLE).cast(pl.Int64)
        named = pl.col("material").is_in(list(classes.values()))
        rows = rows.filter((named | number.ne_missing(INCONCLUSIVE)).fill_null(True))
        listed = named | number.is_in(list(classes)).fill_null(False)
        report("material", "unknown-label", ~listed, "not in the table of classes")
        name = number.replace_strict(classes, default=None, return_dtype=pl.String)
        rows = rows.with_columns(material=pl.when(named).then("material").otherwise(name))
    inconclusive = count - len(rows)
    for name in columns:
        report(name, "bad-map", pl.col(name) == "", "empty: its expression gives nothing here")
    for name in (name for name in INTEGERS if name in columns):
        number = pl.col(name).str.extract(WHOLE).cast(pl.Int64)
        wrong = (pl.col(name) != "") & (number < 0).fill_null(True)
        report(name, "bad-frame", wrong, "not a whole number from 0")
        rows = rows.with_columns(number)
    if "split" in columns:
        part = pl.col("split").str.to_lowercase()
        wrong = ~part.is_in(list(PART_NAMES))
        report("split", "unknown-part", wrong, f"none of {', '.join(PARTS)}")
        rows = rows.with_columns(part.replace_strict(PART_NAMES, default=None))
    return rows.filter(~pl.col(LINE).is_in(list(failed))) if failed else rows, inconclusive


def records(rows: pl.DataFrame, place: Place) -> list[tuple[str, Row]]:
    """(place, cells that are not null) of each row."""
    return [
        (place(row.pop(LINE)), {name: cell for name, cell in row.items() if cell is not None})
        for row in rows.iter_rows(named=True)
    ]


def read_classes(path: Path | None) -> dict[int, str] | None:
    """Read a table of classes, as :func:`read_categories`, if there is one."""
    if path is None:
        return None
    must, got = "must be a table of classes", f"no file {path}"
    require(Path(path).is_file(), "classes", must, got, fix="Check the path")
    return read_categories(Path(path))


def without_repeats(rows: pl.DataFrame, place: Place, problems: list[Problem]) -> pl.DataFrame:
    """The rows without those that are equal to an earlier one but for their line."""
    columns = [name for name in rows.columns if name != LINE]
    if not columns or rows.n_unique(columns) == len(rows):
        return rows
    first = pl.col(LINE).first().over(columns)
    again = rows.select(LINE, first=first).filter(pl.col(LINE) != pl.col("first"))
    for line, before in again.iter_rows():
        text = f"repeats the row {place(before)}: all cells that are read are equal"
        problems.append(Problem(place(line), "duplicate-row", text))
    return rows.filter(~pl.col(LINE).is_in(again[LINE].implode()))


def spelled(path: str) -> str:
    """A path or name in one spelling: one kind of slash, no capitals, one form of letters."""
    text = path.strip().replace("\\", "/").casefold()
    return unicodedata.normalize("NFC", text).removeprefix("./")


def relocated(written: Iterable[str], root: Path) -> dict[str, str]:
    """Paths of another machine -> where their files are below the root.

    The longest end that all paths of one beginning (``/home``, ``C:``) have below the root, or the
    whole paths below a folder in it; backslashes separate folders where nothing has such a name,
    and a name in another spelling is that of the only file with it. Two paths never become one.
    Paths that are right as they are written, or found nowhere or in two folders, are left out.
    """
    distinct = list(dict.fromkeys(written))
    odd = (path for path in distinct if not path.isascii())
    if all(is_there(root, path) for path in (*some(distinct), *odd)):
        return {}
    by_head: dict[str, list[str]] = {}
    for path in distinct:
        if ".." in path and ".." in _parts(path):
            continue
        absolute = re.match(r"[/\\]+[^/\\]*|[A-Za-z]:", path)
        by_head.setdefault(absolute[0] if absolute else "", []).append(path)
    places: dict[str, str] = {}
    for paths in by_head.values():
        places |= _ends(paths, root)
    uses = Counter(places.values())
    return {path: below for path, below in places.items() if path != below and uses[below] == 1}


def _ends(paths: Sequence[str], root: Path) -> dict[str, str]:
    """Path -> its file below the root, by one length of the ends of all; empty without one."""

    @cache
    def names(folder: str) -> dict[str, str]:
        """Spelling -> the name in a folder that has it."""
        with suppress(OSError):
            every = [path.name for path in (root / folder).iterdir()]
            spellings = Counter(map(spelled, every))
            once = {spelled(name): name for name in every if spellings[spelled(name)] == 1}
            return once | dict(zip(every, every, strict=True))
        return {}

    def below(folder: str, end: Sequence[str]) -> str:
        for part in end:
            name = names(folder).get(part) or names(folder).get(spelled(part))
            if name is None:
                return ""
            folder = posixpath.join(folder, name)
        return folder if is_there(root, folder) else ""

    def located(folders: Iterable[str], end: Sequence[str]) -> tuple[str, str]:
        """(folder, file) of an end: in the root, or in the only folder that has it."""
        found = [(folder, file) for folder in folders if (file := below(folder, end))]
        return found[0] if found and (not found[0][0] or len(found) == 1) else ("", "")

    tried = [_parts(path) for path in some(paths)]
    folders = ["", *sorted(name for name in names("") if (root / name).is_dir())[:TRIED]]
    best, cut, starts = len(tried) // 2, 0, set[str]()
    for k in range(min(map(len, tried), default=0)):
        # ``test/1.png`` is not ``train/1.png``: no folder replaces one that is written.
        found = [located([""] if k else folders, parts[k:]) for parts in tried]
        count = sum(bool(file) for _, file in found)
        if count > best and len({tuple(_parts(path)[k:]) for path in paths}) == len(paths):
            best, cut, starts = count, k, {folder for folder, _ in found}
    every = {path: located(sorted(starts), _parts(path)[cut:])[1] for path in paths if starts}
    return {path: file for path, file in every.items() if file}


def _parts(path: str) -> list[str]:
    return [part for part in re.split(r"[/\\]+", path) if part not in ("", ".")]


def is_there(root: Path, path: str) -> bool:
    """Whether a path below a root is a file; one that no disk can hold is none."""
    with suppress(OSError, ValueError):
        return (root / path).is_file()
    return False


def some(items: Sequence[str]) -> Sequence[str]:
    """As many items, evenly, as are looked for on the disk."""
    return items[:: max(1, len(items) // TRIED)]


def odd_groups(source: Path, rows: Sequence[tuple[str, Row]]) -> list[Problem]:
    """Report group columns that only some rows have, and contacts of one name in several groups,
    which a contact cannot be.
    """
    columns = {name: [row.get(name) for _, row in rows] for name in ("contact", *GROUPS)}
    table = pl.DataFrame(columns, dict.fromkeys(columns, pl.String))
    problems: list[Problem] = []
    for name in GROUPS:
        without = table[name].is_null().arg_true()
        if 0 < len(without) < len(rows):
            text = f"{len(without)} of {len(rows)} rows have no {name}, so no split by {name} can "
            text += f"place them; the first is {rows[without[0]][0]}"
            below = table[name].is_null() & table[name].shift(1).is_not_null()
            gaps, full = int(below.sum()), len(rows) - len(without)
            merged = table[name][0] is not None and 2 * gaps > full and len(without) > full
            text += ". Merged cells keep their value in the first row alone: fill them" * merged
            problems.append(Problem(str(source), "null-group", text))
    for name in GROUPS:
        groups = table.select("contact", name).drop_nulls().unique().group_by("contact").agg(name)
        shared = groups.filter(pl.col(name).list.len() > 1).sort("contact")
        for contact, values in shared.head(1).iter_rows():
            text = f"{len(shared)} contacts have one name in several {name}s and are taken as one: "
            text += (
                f"{contact!r} in {', '.join(sorted(values)[:3])}. Map the contact to a name with "
            )
            text += f"its {name}, e.g. {name} || '/' || contact, in your column names"
            return [*problems, Problem(str(source), "shared-contact", text)]
    return problems
