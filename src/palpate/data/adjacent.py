"""Tables in a folder of images, or next to it under its name: what they say of its images.

A column names images by their paths below the folder, by the names of their files alone, or it has
the values of a field (``object``, ``video`` ...) or the names of folders. Capitals, the kind of
slash and the suffix of an image make no difference. The column and the form that fit most rows are
taken, if they fit half of them; a name that several images have names none. The other columns fill
what the samples lack. A table that fits nothing is reported.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from palpate.core import PalpateError, Split, few
from palpate.data.images import SUFFIXES
from palpate.data.manifest import PART_NAMES, ROLES, SIDES
from palpate.data.mapping import LINE
from palpate.data.rows import is_there, relocated, some
from palpate.data.tables import TABLES, Table, open_table

if TYPE_CHECKING:
    from palpate.data.scanning import Cells, Scan

#: Other names of the columns that a table may fill.
SYNONYMS = {
    **dict.fromkeys(("label", "class", "category"), "material"),
    **dict.fromkeys(("caption", "description", "prompt"), "text"),
    "part": "split",
}
FILLED = ("object", "session", "material", "text", "sensor", "domain", "video", "contact", "split")
#: Fields that a column may name, and the share of rows that a column must name images in.
FIELDS, SHARE = ("object", "video", "session", "contact"), 0.5


def adjacent_tables(folder: Path) -> list[Path]:
    """The tables in a folder, and the one next to it that has its name."""
    own = sorted(p for p in folder.iterdir() if p.suffix.lower() in TABLES and p.is_file())
    named = folder.resolve()
    return own + [p for s in TABLES if (p := named.with_name(named.name + s)).is_file()]


def tables_of_pairs(folder: Path) -> dict[Path, dict[str, str]]:
    """The tables next to the images of a folder that pair photos and tactile images of it.

    Returns:
        File -> side -> its column; none where the columns have the names of the sides.
    """
    pairs: dict[Path, dict[str, str]] = {}
    for path in adjacent_tables(folder):
        with suppress(PalpateError):
            table = open_table(path)
            own = {side: side for side in SIDES if side in table.names}
            columns = own if len(own) == len(SIDES) else _columns_of_sides(table)
            if len(columns) == len(SIDES):
                cells = table.read([*columns.values()])
                below = path.parent == folder if columns == own else _pairs_images(cells, folder)
                tactile = cells[columns["tactile"]].drop_nulls()
                if len(tactile) and (below or relocated(tactile, folder)):
                    named = {SYNONYMS[n.lower()]: n for n in table.names if n.lower() in SYNONYMS}
                    pairs[path] = {} if columns == own else named | columns
    return pairs


def _columns_of_sides(table: Table) -> dict[str, str]:
    """Side -> the only column that a word of the side names."""
    words = {name: {*re.findall("[a-z]+", name.lower())} for name in table.names}
    named = {side: [n for n in words if words[n] & {*ROLES[side]}] for side in SIDES}
    return {side: names[0] for side, names in named.items() if len(names) == 1}


def _pairs_images(cells: pl.DataFrame, folder: Path) -> bool:
    """Whether each column of a table names images that are below a folder."""
    columns = [cells[name].drop_nulls().to_list() for name in cells.columns if name != LINE]
    return all(any(is_there(folder, path) for path in some(paths)) for paths in columns)


def join_tables(result: Scan, rows: Sequence[tuple[str, Cells]]) -> None:
    """Fill the rows of a folder from the tables next to them; the parts of lists become splits."""
    for path in adjacent_tables(result.base):
        try:
            table = open_table(path)
            names = list(dict.fromkeys(n for n in table.names if n and n not in table.nested))
            frame = table.read(names)
        except PalpateError as error:
            result.suspect(path, "unread-table", f"not read: {error.got}")
            continue
        _join(result, rows, path, table, frame)
    if len(result.splits) == 1:
        result.splits = {"Orig": result.splits.popitem()[1]}


def _join(
    result: Scan, rows: Sequence[tuple[str, Cells]], path: Path, table: Table, frame: pl.DataFrame
) -> None:
    keys = _keys(rows)
    targets = {c: SYNONYMS.get(c.lower(), c.lower()) for c in frame.columns if c != LINE}
    naming = {
        column: frame[column].drop_nulls().unique().map_elements(_key, pl.String)
        for column, target in targets.items()
        if target in FIELDS or target not in FILLED
    }
    fits = {
        (column, form): sum(map(index.__contains__, names))
        for form, index in keys.items()
        for column, names in naming.items()
    }
    best = max(fits, key=lambda pair: fits[pair], default=("", ""))
    column, form = best
    if not fits.get(best) or fits[best] < SHARE * len(naming[column]):
        got = f"not read, as no column of {few(table.names)} names the images of this folder"
        result.suspect(path, "unread-table", got)
        return
    result.suspicious += [*table.suspicious, *table.problems]
    targets = {c: target for c, target in targets.items() if target in FILLED and c != column}
    filled: set[int] = set()
    cells: dict[tuple[int, str], str] = {}  # (row, column) -> the first value
    unknown: list[str | None] = []
    contradicting: list[str] = []
    parts: dict[str, str] = {}
    for record in frame.iter_rows(named=True):
        named = keys[form].get(_key(record[column] or ""), [])
        filled.update(named)
        if not named:
            unknown.append(record[column])
        for k, (name, target) in product(named, targets.items()):
            row, value = rows[k][1], record[name]
            if value is None:
                continue
            if (first := cells.setdefault((k, name), value)) != value:
                contradicting.append(f"{row['id']} is {first} and {value}")
            elif target == "split":
                parts[row["id"]] = PART_NAMES.get(value.lower(), "")
            elif row.get(target) is None:
                row[target] = value
    if split := {i: part for i, part in parts.items() if part}:
        result.splits[path.stem] = Split(split, {"method": "official", "files": [path.name]})
    text = f"{', '.join(dict.fromkeys(targets.values())) or 'nothing'} of {len(filled)} of "
    text += f"{len(rows)} samples, by its column {column}"
    result.suspect(path, "joined-table", text)
    text = f"{len(contradicting)} cells differ from earlier rows, which are taken"
    result.suspect(path, "two-values", text, contradicting)
    text = f"{len(unknown)} rows name no image of this folder by {column}"
    result.suspect(path, "of-no-image", text, unknown)


def _keys(rows: Sequence[tuple[str, Cells]]) -> dict[str, dict[str, list[int]]]:
    """Form of a name -> name -> the rows that it names; names of several images are left out."""
    forms: dict[str, dict[str, list[int]]] = {}

    def add(form: str, name: str, k: int) -> None:
        places = forms.setdefault(form, {}).setdefault(name, [])
        if k not in places[-1:]:
            places.append(k)

    for k, (_, row) in enumerate(rows):
        for path in (_key(row[side]) for side in ("vision", "tactile") if row.get(side)):
            *folders, name = path.split("/")
            add("path", path, k)
            add("file name", name, k)
            for depth, folder in enumerate(folders):
                add(f"folder {depth}", folder, k)
        for name in ("id", *FIELDS):
            if row.get(name) is not None:
                add(name, _key(row[name]), k)
    for form in forms.keys() & {"path", "file name", "id"}:
        forms[form] = {name: places for name, places in forms[form].items() if len(places) == 1}
    return forms


def _key(name: str) -> str:
    """A name or path as another person may have written it."""
    text = name.strip().replace("\\", "/").casefold().removeprefix("./")
    return posixpath.splitext(text)[0] if text.endswith(SUFFIXES) else text
