"""Tables in a folder of images, or next to it under its name: what they say of its images.

A column names images by their paths below the folder, by the names of their files alone, or it has
the values of a field (``object``, ``video`` ...) or the names of folders. Capitals, the kind of
slash and the suffix of an image make no difference. The column and the form that fit most rows are
taken, if they fit half of them; a name that several images have names none. The other columns fill
what the samples lack. A table that fits nothing is reported.
"""

from __future__ import annotations

import posixpath
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from palpate.core import PalpateError, Split, few
from palpate.data.manifest import PART_NAMES, SIDES, is_image
from palpate.data.mapping import LINE
from palpate.data.rows import TRIED, is_there, relocated, some, spelled
from palpate.data.tables import TABLES, Table, headless_names, names_images, open_table, pairings
from palpate.data.templates import walk

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
#: Suffixes of lists, besides those of tables.
LISTS = (".txt", ".lst")


def adjacent_tables(folder: Path) -> list[tuple[Path, str]]:
    """The tables and lists in a folder and below it, and the table next to it that has its name.

    Returns:
        Files, and the folder that each lies in, below the first and with a slash. Of a kind that
        samples have one each of there are none.
    """
    names = walk(folder, (*TABLES, *LISTS))[0]
    often = Counter(Path(name).suffix.lower() for name in names)
    own = [name for name in names if often[Path(name).suffix.lower()] <= TRIED]
    tables = [(folder / name, name[: name.rfind("/") + 1]) for name in own]
    tables = [t for t in tables if t[0].suffix.lower() in TABLES or headless_names(t[0])]
    named = folder.resolve()
    return tables + [(p, "") for s in TABLES if (p := named.with_name(named.name + s)).is_file()]


def tables_of_pairs(
    folder: Path, stated: Mapping[str, str]
) -> dict[Path, tuple[str, list[dict[str, str]]]]:
    """The tables next to the images of a folder that pair photos and tactile images of it.

    Args:
        folder: the folder.
        stated: map expressions, of which the sides are columns if there are any.

    Returns:
        File -> the folder that its paths start in; and columns by which it may be read, one or, if
        nothing says which one shows what, several; none where the columns have the sides' names.
    """
    pairs: dict[Path, tuple[str, list[dict[str, str]]]] = {}
    for path, below in adjacent_tables(folder):
        with suppress(PalpateError):
            table = open_table(path)
            ways = [dict(stated)] if stated else pairings(table)
            columns = {way[side] for way in ways for side in SIDES}
            cells = table.read([*columns]) if columns <= {*table.names} else pl.DataFrame()
            named = {SYNONYMS[n.lower()]: n for n in table.names if n.lower() in SYNONYMS}
            own = [{} if way["vision"] == "vision" else named | way for way in ways]
            for start in dict.fromkeys((below, "")) if columns and len(cells) else ():
                if all(_names_files(cells[name].drop_nulls(), folder / start) for name in columns):
                    pairs.setdefault(path, (start, own))
    return pairs


def _names_files(paths: pl.Series, root: Path) -> bool:
    return any(is_there(root, path) for path in some(paths.to_list())) or bool(
        relocated(paths, root)
    )


def join_tables(result: Scan, rows: Sequence[tuple[str, Cells]]) -> None:
    """Fill the rows of a folder from the tables next to them; the parts of lists become splits."""
    keys = cache(lambda below: _keys(rows, _key(below)))
    for path, below in adjacent_tables(result.base):
        try:
            table = open_table(path)
            names = list(dict.fromkeys(n for n in table.names if n and n not in table.nested))
            frame = table.read(names)
            for name in filter(lambda name: names_images(frame[name]), names):
                places = relocated(frame[name].drop_nulls(), result.base / below)
                frame = frame.with_columns(pl.col(name).replace(places)) if places else frame
        except PalpateError as error:
            result.suspect(path, "unread-table", f"not read: {error.got}")
            continue
        if (part := PART_NAMES.get(path.stem.lower())) and "split" not in names:
            frame = frame.with_columns(split=pl.lit(part))
        _join(result, rows, keys(below), table, frame)
    if len(result.splits) == 1:
        result.splits = {"Orig": result.splits.popitem()[1]}


def _join(
    result: Scan,
    rows: Sequence[tuple[str, Cells]],
    keys: Mapping[str, Mapping[str, list[int]]],
    table: Table,
    frame: pl.DataFrame,
) -> None:
    path = Path(table.name)
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
        _add_split(result, path, split)
    text = f"{', '.join(dict.fromkeys(targets.values())) or 'nothing'} of {len(filled)} of "
    text += f"{len(rows)} samples, by its column {column}"
    result.suspect(path, "joined-table", text)
    text = f"{len(contradicting)} cells differ from earlier rows, which are taken"
    result.suspect(path, "two-values", text, contradicting)
    text = f"{len(unknown)} rows name no image of this folder by {column}"
    result.suspect(path, "of-no-image", text, unknown)


def _add_split(result: Scan, path: Path, split: Mapping[str, str]) -> None:
    """Add a split of a table; lists that are named as parts are of one."""
    name = "Orig" if path.stem.lower() in PART_NAMES else path.stem
    before = result.splits.get(name, Split({}, {"files": []}))
    twice = {i for i, part in split.items() if before.parts.get(i, part) != part}
    text = f"{len(twice)} samples are of another part, too, and so of none"
    result.suspect(path, "two-parts", text, sorted(twice))
    parts = {i: part for i, part in {**before.parts, **split}.items() if i not in twice}
    rule = {"method": "official", "files": [*before.rule["files"], path.name]}
    result.splits[name] = Split(parts, rule)


def _keys(rows: Sequence[tuple[str, Cells]], below: str) -> dict[str, dict[str, list[int]]]:
    """Form of a name -> name -> the rows below a folder that it names; of several images none."""
    forms: dict[str, dict[str, list[int]]] = {}

    def add(form: str, name: str, k: int) -> None:
        places = forms.setdefault(form, {}).setdefault(name, [])
        if k not in places[-1:]:
            places.append(k)

    for k, (_, row) in enumerate(rows):
        paths = [_key(row[side]) for side in SIDES if row.get(side)]
        paths = [path.removeprefix(below) for path in paths if path.startswith(below)]
        for path in paths:
            *folders, name = path.split("/")
            add("path", path, k)
            add("file name", name, k)
            for depth, folder in enumerate(folders):
                add(f"folder {depth}", folder, k)
        for name in ("id", *FIELDS) if paths else ():
            if row.get(name) is not None:
                add(name, _key(row[name]), k)
    for form in forms.keys() & {"path", "file name", "id"}:
        forms[form] = {name: places for name, places in forms[form].items() if len(places) == 1}
    return forms


def _key(name: str) -> str:
    """A name or path as another person may have written it."""
    text = spelled(name)
    return posixpath.splitext(text)[0] if is_image(text) else text
