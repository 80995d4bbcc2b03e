"""From the cells of a table to rows of a manifest: map expressions, whole numbers, names of classes, parts of a split."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from palpate.core import PARTS, PalpateError, Problem, ProblemsError
from palpate.data.listing import INCONCLUSIVE, SPELLING, read_categories
from palpate.data.mapping import Cell, Expression
from palpate.data.tables import sign_of
from palpate.data.texts import decoded

#: What tools call the parts of a split.
PART_NAMES = {
    **{part: part for part in PARTS},
    "training": "train",
    "validation": "val",
    "valid": "val",
    "dev": "val",
    "testing": "test",
}
#: What the columns of a split keep whole; where only some rows have a value, a person should look.
GROUPS = ("video", "object", "session")
#: What other tools write for an empty cell, in lower case.
NULL_WORDS = ("na", "nan", "none", "null")
Row = dict[str, Any]


def manifest_rows(
    maps: Mapping[str, Expression],
    column: Callable[[str], Sequence[Cell]],
    count: int,
    where: Callable[[int], str],
    classes: Mapping[int, str] | None,
    problems: list[Problem],
) -> tuple[list[tuple[int, Row]], int]:
    """Evaluates map expressions over the rows of a table.

    ``frame``, ``start`` and ``end`` become integers; with ``classes`` the material's number becomes its name, and rows of number -1
    (inconclusive) are left out; ``split`` becomes the name of a part.

    Args:
        maps: target -> expression.
        column: the cells of a column, (count,).
        count: number of rows.
        where: row -> its place.
        classes: number -> name, or None to take materials as they are.
        problems: what is wrong is added here.

    Returns:
        (row number, its cells that are not empty) of the good rows, and how many were inconclusive.
    """
    values: list[tuple[str, list[Cell]]] = []
    bad: dict[int, list[Problem]] = {}
    for target, expression in maps.items():
        found, failed = expression.values(column, count)
        values.append((target, found))
        for k, text in failed.items():
            bad.setdefault(k, []).append(
                Problem(where(k), "bad-map", f"{target} has no value: {text}")
            )
    known = set(classes.values()) if classes is not None else set[str]()
    rows: list[tuple[int, Row]] = []
    inconclusive = 0
    for k in range(count):
        row: Row = {target: cells[k] for target, cells in values if cells[k] is not None}
        wrong = [*bad.get(k, ()), *(Problem(where(k), *p) for p in _numbers(row))]
        material = row.get("material")
        if classes is not None and material is not None and material not in known:
            number = _whole(material)
            if number == INCONCLUSIVE:
                inconclusive += 1
                continue
            if number is not None and number in classes:
                row["material"] = classes[number]
            else:
                wrong.append(
                    Problem(
                        where(k),
                        "unknown-label",
                        f"the class {material!r} is not in the table of classes",
                    )
                )
        if "split" in row:
            part = PART_NAMES.get(row["split"].lower())
            if part is None:
                wrong.append(
                    Problem(
                        where(k),
                        "unknown-part",
                        f"the split {row['split']!r} is none of {', '.join(PARTS)}",
                    )
                )
            row["split"] = part
        problems += wrong
        if not wrong:
            rows.append((k, row))
    return rows, inconclusive


def read_classes(path: Path) -> dict[int, str]:
    """Reads a table of classes: ``Name: id`` lines, or CSV of id and name in either order, with or without a header.

    Raises:
        PalpateError: if the file is missing or names no class.
        ProblemsError: with every line that is not a class.
    """
    path = Path(path)
    if not path.is_file():
        raise PalpateError(
            "The table of classes must be a file",
            f"no file {path}",
            "Check the path given as --classes",
        )
    text = decoded(path.read_bytes())
    lines = [line for line in text.splitlines() if line.strip()]
    if lines and all(re.search(r":\s*[\"']?[+-]?\d+", line) for line in lines):
        return read_categories(path)
    names: dict[int, str] = {}
    problems: list[Problem] = []
    reader = csv.reader(
        io.StringIO(text, newline=""), delimiter=sign_of(path, lines[0] if lines else "")
    )
    for first, cells in enumerate(c for c in reader if any(c)):
        pair = [c.strip() for c in cells]
        label = [_whole(c) for c in pair]
        at = next((i for i, n in enumerate(label) if n is not None), None)
        number = None if at is None else label[at]
        if len(pair) != 2 or number is None or at is None or not pair[1 - at]:
            if first:
                problems.append(
                    Problem(
                        f"{path}:{reader.line_num}",
                        "bad-line",
                        f"{', '.join(pair)!r} is not an id and a name",
                    )
                )
        elif number in names:
            problems.append(
                Problem(
                    f"{path}:{reader.line_num}",
                    "duplicate-id",
                    f"the id {number} names {names[number]!r} already",
                )
            )
        else:
            names[number] = SPELLING.get(pair[1 - at], pair[1 - at])
    if problems:
        raise ProblemsError(problems, "Write one 'Name: id' or 'id,name' a line")
    if not names:
        raise PalpateError(
            f"{path} must list classes as 'Name: id' or 'id,name'", "none", "Write one a line"
        )
    return names


def odd_groups(source: Path, rows: Sequence[tuple[str, Row]]) -> list[Problem]:
    """Tells of group columns that some rows have and others lack, and of words in them that mean null elsewhere; each with the first row."""
    found: list[Problem] = []
    for name in GROUPS:
        without = [where for where, row in rows if name not in row]
        if 0 < len(without) < len(rows):
            text = f"{len(without)} of {len(rows)} rows have no {name}, so no split by {name} can place them; the first is {without[0]}"
            found.append(Problem(str(source), "null-group", text))
        worded = [where for where, row in rows if str(row.get(name, "")).lower() in NULL_WORDS]
        if worded:
            text = f"{len(worded)} of {len(rows)} rows have the {name} NA, NaN, None or null, taken as a name; the first is {worded[0]}"
            found.append(
                Problem(
                    str(source), "word-for-null", f"{text}. An empty cell means that there is none"
                )
            )
    return found


def _numbers(row: Row) -> Iterator[tuple[str, str]]:
    """Makes integers of the cells that are some; yields what is wrong with the others as (kind, text)."""
    for name in ("frame", "start", "end"):
        if name in row:
            number = _whole(row[name])
            if number is None or number < 0:
                yield "bad-frame", f"the {name} {row[name]!r} is not a whole number from 0"
            else:
                row[name] = number


def _whole(text: str) -> int | None:
    """The integer that a text is (``7``, ``007``, ``7.0``), or None."""
    found = re.fullmatch(r"([+-]?[0-9]{1,18})(?:\.0+)?", text)
    return int(found[1]) if found else None
