"""From the text cells of a table to rows of a manifest."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PARTS, Problem, require
from palpate.data.manifest import PART_NAMES
from palpate.data.tables import INCONCLUSIVE, Table, read_categories, whole

#: Columns that a split keeps whole; where only some rows have a value, a person should look.
GROUPS = ("video", "object", "session")
INTEGERS = ("frame", "start", "end")
#: Paths that are looked for, to see where those of another machine start.
TRIED = 100
Row = dict[str, Any]
Cells = Mapping[str, Sequence[str | None]]


def manifest_rows(
    cells: Cells,
    count: int,
    where: Callable[[int], str],
    classes: Mapping[int, str] | None,
    problems: list[Problem],
) -> tuple[list[tuple[int, Row]], int]:
    """Rows of a manifest from mapped cells.

    ``frame``, ``start`` and ``end`` become integers; with ``classes`` the number of a material
    becomes its name, and rows of number -1 (inconclusive) are skipped; ``split`` becomes the name
    of a part.

    Args:
        cells: manifest column -> (count,) texts, as :meth:`ColumnMaps.apply` gives them.
        count: number of rows.
        where: row -> its place.
        classes: number -> name, or None to take materials as they are.
        problems: what is wrong is added here.

    Returns:
        (row number, its cells that are not null) of the good rows, and how many were inconclusive.
    """
    names = set(classes.values()) if classes is not None else set[str]()
    rows: list[tuple[int, Row]] = []
    inconclusive = 0
    for k in range(count):
        row: Row = {name: texts[k] for name, texts in cells.items() if texts[k] is not None}
        empty = [name for name, cell in row.items() if not cell]
        wrong = [("bad-map", f"the expression for {name} is empty here") for name in empty]
        wrong += _make_integers(row)
        material = row.get("material")
        if classes is not None and material is not None and material not in names:
            number = whole(material)
            if number == INCONCLUSIVE:
                inconclusive += 1
                continue
            if number not in classes:
                text = f"the class {material!r} is not in the table of classes"
                wrong.append(("unknown-label", text))
            row["material"] = classes.get(-1 if number is None else number)
        if "split" in row:
            part = PART_NAMES.get(row["split"].lower())
            if part is None:
                text = f"the split {row['split']!r} is none of {', '.join(PARTS)}"
                wrong.append(("unknown-part", text))
            row["split"] = part
        problems += [Problem(where(k), *problem) for problem in wrong]
        if not wrong:
            rows.append((k, row))
    return rows, inconclusive


def _make_integers(row: Row) -> Iterator[tuple[str, str]]:
    """Make integers of the cells that must be some; yield what is wrong as (kind, text)."""
    for name in INTEGERS:
        if row.get(name):
            number = whole(row[name])
            if number is None or number < 0:
                yield "bad-frame", f"the {name} {row[name]!r} is not a whole number from 0"
            row[name] = number


def read_classes(path: Path) -> dict[int, str]:
    """Read a table of classes, as :func:`read_categories`."""
    must, got = "must be a table of classes", f"no file {path}"
    require(path.is_file(), "classes", must, got, fix="Check the path")
    return read_categories(path)


def without_repeats(cells: Cells, table: Table) -> Cells:
    """The cells without the rows that are equal to an earlier one; those become problems.

    Rows of ``table`` that go leave its lines, too.
    """
    frame = pl.DataFrame(cells).with_row_index("row")
    first = frame.group_by(list(cells)).agg(first=pl.col("row").min()) if cells else frame
    if not cells or len(first) == len(frame):
        return cells
    pairs = frame.join(first, on=list(cells), how="left", nulls_equal=True, maintain_order="left")
    for row, before in pairs.select("row", "first").filter(pl.col("row") != pl.col("first")).rows():
        text = f"repeats the row {table.where(before)}: all cells that are read are equal"
        table.problems.append(Problem(table.where(row), "duplicate-row", text))
    keep = pairs["row"] == pairs["first"]
    table.lines = pl.Series(table.lines).filter(keep).to_list()
    return {name: pl.Series(texts).filter(keep).to_list() for name, texts in cells.items()}


def relocated(written: Iterable[str], root: Path) -> dict[str, str]:
    """Paths of another machine -> where their files are below the root.

    The longest end that all paths of one beginning (``/home``, ``C:``) have below the root, or
    below a folder in it; backslashes separate folders where nothing has such a name. Two paths
    never become one. Paths that are right as they are written, or found nowhere, are left out.
    """
    distinct = list(dict.fromkeys(written))
    if all(is_there(root, path) for path in _some(distinct)):
        return {}
    by_head: dict[str, dict[str, Sequence[str]]] = {}
    for path in distinct:
        parts = [part for part in re.split(r"[/\\]+", path) if part not in ("", ".")]
        absolute = re.match(r"[/\\]|[A-Za-z]:", path)
        if parts and ".." not in parts:
            by_head.setdefault(parts[0] if absolute else "", {})[path] = parts
    places: dict[str, str] = {}
    for paths in by_head.values():
        places |= _found(paths, root)
    return {path: below for path, below in places.items() if path != below}


def _found(paths: Mapping[str, Sequence[str]], root: Path) -> dict[str, str]:
    """Path -> its end that is a file below the root, by one rule for all; empty without one."""
    some = _some(list(paths))
    folders = (
        sorted(entry.name for entry in root.iterdir() if entry.is_dir()) if root.is_dir() else []
    )
    best, rule = len(some) // 2, (0, "")
    for start in ("", *(f"{name}/" for name in folders[:TRIED])):
        for k in range(min(map(len, paths.values()))):
            count = sum(is_there(root, start + "/".join(paths[p][k:])) for p in some)
            apart = len({tuple(parts[k:]) for parts in paths.values()}) == len(paths)
            if count > best and apart:
                best, rule = count, (k, start)
        if best > len(some) // 2:
            return {p: rule[1] + "/".join(parts[rule[0] :]) for p, parts in paths.items()}
    return {}


def is_there(root: Path, path: str) -> bool:
    """Whether a path below a root is a file; one that no disk can hold is none."""
    with suppress(OSError, ValueError):
        return (root / path).is_file()
    return False


def _some(items: Sequence[str]) -> Sequence[str]:
    return items[:: max(1, len(items) // TRIED)]


def odd_groups(source: Path, rows: Sequence[tuple[str, Row]]) -> list[Problem]:
    """Report group columns that only some rows have, and contacts of one name in several groups."""
    problems: list[Problem] = []
    count = len(rows)
    for name in GROUPS:
        without = [where for where, row in rows if name not in row]
        if 0 < len(without) < count:
            text = f"{len(without)} of {count} rows have no {name}, so no split by {name} can place"
            text += f" them; the first is {without[0]}"
            problems.append(Problem(str(source), "null-group", text))
    return problems + _shared_contacts(source, rows)


def _shared_contacts(source: Path, rows: Sequence[tuple[str, Row]]) -> list[Problem]:
    """Report contacts of one name in several videos (or objects ...), which a contact cannot be."""
    for name in GROUPS:
        groups: dict[str, set[str]] = {}
        for _, row in rows:
            if "contact" in row and name in row:
                groups.setdefault(row["contact"], set()).add(row[name])
        if shared := [contact for contact, values in groups.items() if len(values) > 1]:
            few = ", ".join(sorted(groups[shared[0]])[:3])
            text = f"{len(shared)} contacts have one name in several {name}s and are taken as one: "
            text += f"{shared[0]!r} in {few}. Map the contact to a name with its {name}, e.g. "
            text += f"{name} || '/' || contact, in your column names"
            return [Problem(str(source), "shared-contact", text)]
    return []
