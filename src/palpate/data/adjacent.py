"""Tables in a folder of images, or next to it under its name: what they say of its images.

A column names images by their paths below the folder, with or without the suffix, by the names of
their files alone, or it has the values of a field (``object``, ``video`` ...). The column and the
form that fit most rows are taken, if they fit half of them; a name that several images have names
none. The other columns fill what the samples lack. A table that fits nothing is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import polars as pl

from palpate.core import PalpateError, Split, few
from palpate.data.manifest import PART_NAMES
from palpate.data.mapping import LINE
from palpate.data.rows import relocated
from palpate.data.tables import TABLES, Table, header_of, open_table

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


def tables_of_pairs(folder: Path) -> list[Path]:
    """The tables next to the images of a folder that name photos and tactile images of it."""
    pairs: list[Path] = []
    for path in adjacent_tables(folder):
        with suppress(PalpateError):
            if {"vision", "tactile"} <= set(header_of(path)):
                cells = open_table(path).read(["vision", "tactile"])["tactile"].drop_nulls()
                below = path.parent == folder or relocated(cells, folder)
                pairs += [path] if below and len(cells) else []
    return pairs


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
    fits = {
        (column, form): sum(value in index for value in frame[column].drop_nulls().unique())
        for form, index in keys.items()
        for column in frame.columns
        if column != LINE
    }
    best = max(fits, key=lambda pair: fits[pair], default=("", ""))
    column, form = best
    if not frame.height or fits.get(best, 0) < SHARE * frame[column].drop_nulls().n_unique():
        got = f"not read, as no column of {few(table.names)} names the images of this folder"
        result.suspect(path, "unread-table", got)
        return
    result.suspicious += [*table.suspicious, *table.problems]
    targets = {c: SYNONYMS.get(c.lower(), c.lower()) for c in frame.columns if c != column}
    targets = {c: target for c, target in targets.items() if target in FILLED}
    filled: set[int] = set()
    parts: dict[str, str] = {}
    for record in frame.iter_rows(named=True):
        for k in keys[form].get(record[column] or "", ()):
            row = rows[k][1]
            filled.add(k)
            for name, target in targets.items():
                value = record[name]
                if target == "split" and value is not None:
                    parts[row["id"]] = PART_NAMES.get(value.lower(), "")
                elif value is not None and row.get(target) is None:
                    row[target] = value
    if split := {i: part for i, part in parts.items() if part}:
        result.splits[path.stem] = Split(split, {"method": "official", "files": [path.name]})
    text = f"{', '.join(dict.fromkeys(targets.values())) or 'nothing'} of {len(filled)} of "
    text += f"{len(rows)} samples, by its column {column}"
    result.suspect(path, "joined-table", text)


def _keys(rows: Sequence[tuple[str, Cells]]) -> dict[str, dict[str, list[int]]]:
    """Form of a name -> name -> the rows that it names; names of several images are left out."""
    forms: dict[str, dict[str, list[int]]] = {}

    def add(form: str, name: Any, k: int) -> None:
        places = forms.setdefault(form, {}).setdefault(str(name), [])
        if k not in places[-1:]:
            places.append(k)

    for k, (_, row) in enumerate(rows):
        paths = [PurePosixPath(row[c]) for c in ("vision", "tactile") if row.get(c)]
        for path in paths:
            add("path", path, k)
            add("path without suffix", path.with_suffix(""), k)
            add("file name", path.name, k)
            add("file name without suffix", path.stem, k)
        add("id", row.get("id"), k)
        for name in FIELDS:
            if row.get(name) is not None:
                add(name, row[name], k)
    for form, index in forms.items():
        if form not in FIELDS:
            forms[form] = {name: places for name, places in index.items() if len(places) == 1}
    return forms
