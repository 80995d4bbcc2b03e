"""Tables: CSV, TSV, JSON lines, JSON arrays, Parquet, data frames, lists of dictionaries.

Cells are read as texts; each row keeps its place for messages. CSV and TSV are UTF-8 (or UTF-16
with a byte-order mark), with any line ends; a ``.csv`` whose header has semicolons but no commas is
split at those. A file without any character of UTF-8 beyond ASCII, but with other bytes, is one of
Windows (cp1252). A quoted cell may span lines; its row counts by its first. Rows of another width,
lines that are not JSON, bytes that are not UTF-8 and quotation marks that stay open are problems of
their line; blank lines are ignored. Items of a JSON array, rows of Parquet and of data frames are
counted from 1. Only the requested columns are kept.
"""

from __future__ import annotations

import codecs
import csv
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import permutations
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, Problem, ProblemsError, content_of, require
from palpate.core.images import SUFFIXES
from palpate.data.manifest import (
    PART_NAMES,
    PATH,
    ROLE_OF,
    SIDES,
    is_image,
    read_parquet,
    reading_parquet,
)
from palpate.data.mapping import LINE, text_of

csv.field_size_limit(1 << 30)  # by default a long text is an error, for the whole process
TABLES = (".csv", ".tsv", ".jsonl", ".json", ".parquet")
#: Number of the class of contact whose material is unclear.
INCONCLUSIVE = -1
#: Names that the published category table misspells.
SPELLING = {"Ruber": "Rubber"}
#: Types of columns that are neither texts nor numbers, besides nested ones.
UNREAD = (pl.Binary, pl.Object)
#: The encoding of texts that Excel saves as plain CSV.
WINDOWS = "cp1252"
CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f]")
#: Signs that no cell can hold: bytes that were not UTF-8, and the zero character.
UNFIT = "[\ufffd\x00]"
#: Halves of characters, which JSON can write.
HALVES = re.compile("[\ud800-\udfff]")
#: Names that polars takes as patterns of names.
PATTERN = re.compile(r"\*|\^.*\$", re.DOTALL)
#: Where a row was read, and the texts in the requested columns.
Record = tuple[Any, ...]
_Records = Callable[[Sequence[str]], pl.DataFrame | Iterable[Record]]


@dataclass
class Table:
    """A table whose columns are known and whose rows are read on request."""

    name: str  # the file, or how an in-memory table is called in messages
    names: list[str]  # its columns
    problems: list[Problem]  # what is wrong with its rows; complete after :meth:`read`
    records: _Records  # from the requested columns to (line, texts)
    suspicious: list[Problem] = field(default_factory=list)  # read, but a person should look
    nested: set[str] = field(default_factory=set)  # columns that hold lists
    bare: bool = False  # it has no header: its columns are named by what they hold

    def read(self, columns: Sequence[str]) -> pl.DataFrame:
        """Read the rows.

        Returns:
            (rows) with the requested columns as texts, null where empty, and the column ``LINE``.
            Bad rows are skipped and join ``problems``.
        """
        if double := [name for name in columns if self.names.count(name) > 1]:
            must = f"Columns of {self.name} must have different names"
            raise PalpateError(must, f"{double[0]} twice or more", "Rename one of them")
        for name in columns:  # polars would take such a name as several columns
            must = f"Columns of {self.name} must have plain names"
            require(not PATTERN.fullmatch(name), None, must, repr(name), fix="Rename it")
        schema = {LINE: pl.Int64} | dict.fromkeys(columns, pl.String)
        rows = self.records(columns)
        if not isinstance(rows, pl.DataFrame):
            rows = pl.DataFrame(list(rows), schema, orient="row")
        if not columns:  # polars compares no condition of no column with rows of several chunks
            return rows
        cells = [pl.col(name).str.strip_chars() for name in columns]
        rows = rows.with_columns(pl.when(cell != "").then(cell) for cell in cells)
        unfit = pl.any_horizontal(pl.col(pl.String).str.contains(UNFIT))
        for line in rows.filter(unfit)[LINE]:
            text = "the row holds bytes that are not UTF-8, or a zero character: save the file as"
            self.problems.append(Problem(self.place(line), "bad-encoding", f"{text} UTF-8"))
        return rows.filter(~unfit.fill_null(False))

    def place(self, line: int) -> str:
        """``file:line``."""
        return f"{self.name}:{line}"


def open_table(path: Path, names: Sequence[str] | None = None) -> Table:
    """Open a table file.

    Args:
        path: the file.
        names: columns of a text that has no header line, of any suffix.

    Raises:
        PalpateError: if the file is missing, or of another form.
    """
    suffix = path.suffix.lower()
    fix = "Check the path"
    require(path.is_file(), None, "The table must be a file", f"no file {path}", fix=fix)
    must = "must be left out for tables that name their columns"
    require(not names or suffix not in TABLES[2:], "names", must, path.name)
    if suffix == ".parquet":
        return _parquet(path)
    if suffix in (".jsonl", ".json"):
        return _json(path)
    bare = [] if names else headless_names(path)
    names = names or bare
    must = f"A table must be one of {', '.join(TABLES)}"
    require(bool(names) or suffix in TABLES, None, must, path.name, fix="Convert it, or rename it")
    table = _csv(path, names)
    table.bare = bool(bare)
    return table


def table_of(data: Any, name: str = "row") -> Table:
    """A polars or pandas frame, or dictionaries, as a table with rows ``row:1``, ``row:2`` ...

    Raises:
        PalpateError: if the data is of another type.
    """
    if isinstance(data, pl.DataFrame):
        return _of_frame(name, data.schema, data.select)
    if hasattr(data, "to_dict") and hasattr(data, "columns"):  # pandas, which is not a dependency
        data = data.to_dict("records")
    if isinstance(data, Sequence) and data and all(isinstance(row, Mapping) for row in data):
        return _of_objects(name, list(enumerate(data, 1)), [])
    must = "must be a path, a polars or pandas frame, or a list of dictionaries"
    got = type(data).__name__
    if isinstance(data, Sequence):
        got = f"a {got} of {type(data[0]).__name__}" if data else f"an empty {got}"
    raise PalpateError(must, got, "Pass one of these", argument="source")


def header_of(path: Path) -> list[str]:
    """The columns that the first row of a table shows; empty if it cannot be read. Never raises."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".parquet":
            return list(_schema(path))
        if suffix in (".csv", ".tsv"):
            return _head(path)[0]
        text = _start_of(path)
        first = json.JSONDecoder().raw_decode(text, text.index("{"))[0]
        return [str(name) for name in first] if suffix in TABLES else []
    except Exception:  # whatever the file is, it is not a table
        return []


def _start_of(path: Path) -> str:
    with open(path, "rb") as file:
        return decoded(file.read(1 << 16))


def first_line(path: Path) -> str:
    """The first line of a text that is not blank, without the space around it."""
    return next(filter(None, map(str.strip, lines_of(_start_of(path)))), "")


def _head(path: Path) -> list[list[str]]:
    """The cells of the first rows that are not blank, up to one that is no row."""
    rows: list[list[str]] = []
    with suppress(csv.Error):
        for row in _cells(path, list(io.StringIO(_start_of(path), newline=""))):
            rows += [[cell.strip() for cell in row]] if any(row) else []
    return rows


def delimiter_of(path: Path, text: str) -> str:
    """What separates the cells of a CSV file."""
    head = re.split("[\r\n]", text.lstrip("\r\n"), maxsplit=1)[0]
    signs = "\t" if path.suffix.lower() == ".tsv" else ",;\t|"
    spaced = is_image(head.split(" ")[0]) and " " in head.strip()
    return next((sign for sign in signs if sign in head), " " if spaced else signs[0])


def headless_names(path: Path) -> list[str]:
    """Columns of a list without a header, whose first line names images; empty for others.

    An image is ``vision`` or ``tactile`` where there are several and the words of most paths say
    so, else a ``path``; what is no image is a ``label``.
    """
    rows = _head(path) if path.suffix.lower() not in TABLES[2:] else []
    first = rows[0] if rows else []
    images = list(map(is_image, first))
    names: list[str] = []
    for k, image in enumerate(images if any(images) else ()):
        side = side_of(row[k] for row in rows if len(row) > k) if sum(images) > 1 else ""
        name = (side or PATH) if image else "label"
        names.append(name if name not in names else f"{name}_{len(names) + 1}")
    return names


def side_of(texts: Iterable[str]) -> str:
    """What most words of some names or paths say that they show; empty without such a word."""
    words = re.findall("[a-z]+", " ".join(texts).lower())
    roles = Counter(ROLE_OF[word] for word in words if word in ROLE_OF)
    return max(roles, key=lambda role: roles[role], default="")


def names_images(cells: pl.Series) -> bool:
    """Whether most of some texts have the suffix of an image."""
    ends = "|".join(map(re.escape, SUFFIXES))
    return 2 * (cells.str.contains(rf"(?i)(?:{ends})$").sum() or 0) > cells.count()


def pairings(table: Table) -> list[dict[str, str]]:
    """Which columns of a table may be the sides: side -> column.

    One where words of the columns, else of their paths, say it; else all that they do not exclude.
    """
    cells = table.read([n for n in dict.fromkeys(table.names) if n and n not in table.nested])
    images = [n for n in cells.columns if n != LINE and names_images(cells[n])]
    sides = {n: side_of([n]) or side_of(cells[n].drop_nulls().head(99)) for n in images}
    images = [*SIDES] if {*SIDES} <= {*images} else images
    pairs: list[dict[str, str]] = [
        dict(zip(SIDES, two, strict=True)) for two in permutations(images, 2)
    ]
    stated = [pair for pair in pairs if all(sides[n] == side for side, n in pair.items())]
    possible = [pair for pair in pairs if all(sides[n] in (side, "") for side, n in pair.items())]
    return stated or possible


def decoded(data: bytes) -> str:
    """Decode UTF-8, UTF-16 with a byte-order mark, or cp1252; other bytes become U+FFFD."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    if b"\0" in data[:2] and data[:2] != b"\0\0":  # UTF-16 without a mark
        return data.decode("utf-16-be" if data[:1] == b"\0" else "utf-16-le", errors="replace")
    text = data.decode("utf-8-sig", errors="replace")
    if "\ufffd" in text and is_windows(data):
        return data.decode(WINDOWS)
    return text


def is_windows(data: bytes) -> bool:
    """Whether bytes are a text of Windows: no characters of UTF-8 and no control characters."""
    bare = data.decode("utf-8", errors="ignore")
    if not bare.isascii() or CONTROL.search(bare):
        return False
    with suppress(UnicodeDecodeError):
        return data.decode(WINDOWS) != bare
    return False


def lines_of(text: str) -> list[str]:
    """The lines of a text by any of the ends LF, CR LF and CR, and by no other sign."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """CSV with a header and bare line feeds; None is an empty cell."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def _csv(path: Path, names: Sequence[str] | None) -> Table:
    data = content_of(path)
    text = decoded(data)
    table = csv_table(path, text, names)
    if not text.isascii() and is_windows(data):
        first = next(line for line in text.splitlines() if not line.isascii())
        words = f"not UTF-8, and read as {WINDOWS}, the encoding of Windows: {first[:80]!r}"
        table.suspicious.append(Problem(str(path), "encoding", words))
    return table


def csv_table(path: Path, text: str, names: Sequence[str] | None) -> Table:
    """The table of the text of a CSV file, whose columns are its first row or ``names``."""
    problems: list[Problem] = []
    rows = _csv_rows(path, text, problems)
    header = list(names or [cell.strip() for cell in (rows["cells"][0] if len(rows) else [])])
    rows, width = rows.slice(0 if names else 1), pl.col("cells").list.len()
    for line, count in rows.filter(width != len(header)).select(LINE, width).iter_rows():
        words = f"{count} cells under {len(header)} columns"
        problems.append(Problem(f"{path}:{line}", "bad-row", words))
    rows = rows.filter(width == len(header))

    def records(columns: Sequence[str]) -> pl.DataFrame:
        cells = (pl.col("cells").list.get(header.index(name)).alias(name) for name in columns)
        return rows.select(LINE, *cells)

    return Table(str(path), header, problems, records)


def _csv_rows(path: Path, text: str, problems: list[Problem]) -> pl.DataFrame:
    """First line (``LINE``) and ``cells`` of each row that is not blank."""
    lines = list(io.StringIO(text, newline=""))
    sign = _cells(path, lines).dialect.delimiter
    if '"' in text or sign == " ":
        rows = list(_quoted_rows(path, lines, problems))
        return pl.DataFrame(rows, {LINE: pl.Int64, "cells": pl.List(pl.String)}, orient="row")
    row = pl.col("row").str.strip_chars_end("\r\n")
    table = pl.DataFrame({"row": lines}, {"row": pl.String}).with_columns(row)
    table = table.with_row_index(LINE, offset=1).cast({LINE: pl.Int64})
    blank = pl.col("row").str.replace_all(sign, "", literal=True).str.strip_chars() == ""
    return table.filter(~blank).select(LINE, cells=pl.col("row").str.split(sign))


def _quoted_rows(
    path: Path, lines: Sequence[str], problems: list[Problem]
) -> Iterator[tuple[int, list[str]]]:
    """The same of lines with quotation marks."""
    reader = _cells(path, lines)
    first = 1
    try:
        for cells in reader:
            last = reader.line_num
            inner = lines[first:last]  # what a quoted cell took in
            quotes = "".join(lines[first - 1 : last]).count('"') if inner else 0
            if inner and (quotes % 2 or _rows_inside(inner, reader.dialect, len(cells))):
                swallowed = f"a quotation mark stays open up to line {last}"
                problems.append(Problem(f"{path}:{first}", "open-quote", swallowed))
            elif "".join(cells).strip():
                yield first, cells
            first = last + 1
    except csv.Error as error:
        broken = f"{error}; is a quotation mark open? No row after it was read"
        problems.append(Problem(f"{path}:{first}", "bad-row", broken))


def _cells(path: Path, lines: Sequence[str]) -> Any:
    """A reader of the cells of some lines."""
    sign = delimiter_of(path, "\n".join(lines[:9]))
    return csv.reader(lines, delimiter=sign, skipinitialspace=sign == " ")


def _rows_inside(lines: Sequence[str], dialect: Any, width: int) -> bool:
    """Whether lines, but for the last, are rows of a table by themselves."""
    return len(lines) > 1 and all(len(row) == width for row in csv.reader(lines[:-1], dialect))


def _json(path: Path) -> Table:
    """JSON lines, or a JSON array of objects, by the suffix."""
    text, problems = decoded(content_of(path)), list[Problem]()
    rows: list[tuple[int, Any]] = []
    array = path.suffix.lower() == ".json"
    for number, line in enumerate([text] if array else text.split("\n"), 1):
        if line.strip():
            try:
                rows.append((number, json.loads(line)))
            except (ValueError, RecursionError) as error:
                at = number + getattr(error, "lineno", 1) - 1
                reason = f"not JSON: {getattr(error, 'msg', 'nested too deep')}"
                problems.append(Problem(f"{path}:{at}", "bad-row", reason))
    if array and rows:
        data = rows[0][1]
        flat = isinstance(data, list) and _any_value_beside(data, (list, Mapping))
        rows = list(enumerate(data if flat else _items(data), 1))
        if not flat and (not rows or rows[0][1] == data):
            must, got = f"{path} must hold a JSON list of objects", repr(text.strip()[:20])
            raise PalpateError(must, got, "Write [{...}, {...}], or JSON lines")
    return _of_objects(str(path), rows, problems)


def _items(data: Any, split: str | None = None, *, row: bool = False) -> Iterator[dict[str, Any]]:
    """The objects, pairs or paths in nested lists, with the part whose key they are under.

    An object of a list is a ``row``, also without a value of its own besides what it nests; so is
    the sibling of an object with one, and an object whose keys name both sides.
    """
    if isinstance(data, Mapping) and _all_images([*data, *data.values()]):
        for pair in data.items():
            yield _numbered(pair) | {"split": split}
    elif isinstance(data, Mapping):
        row |= {*SIDES} <= {side_of([str(key)]) for key in data}
        parts = {key: PART_NAMES.get(str(key).lower()) for key in data}
        below = [item for value in data.values() if isinstance(value, list) for item in value]
        nested = all(isinstance(value, (list, Mapping)) for value in data.values())
        is_list = nested and not (split or row or _scalars(below))
        if is_list or all(parts.values()):
            rows = _any_value_beside(data.values(), (list, Mapping))
            for key, value in data.items():
                yield from _items(value, parts[key], row=rows)
        else:
            yield dict(data) | ({"split": split} if split else {})
    elif isinstance(data, list) and _scalars(data) and len(data) >= 2 and not is_image(data[0]):
        group = "object" if str(data[0]).isdecimal() else "video"
        pair = {group: data[0], "id": "/".join(map(str, data)), "split": split}
        yield pair | ({"frame": data[1]} if group == "video" else {})
    elif isinstance(data, list):
        rows = _any_value_beside(data, list)
        if all(isinstance(item, list) and len(item) == 2 and _all_images(item) for item in data):
            first, second = ({re.sub("[0-9]+", "", item[k]) for item in data} for k in (0, 1))
            data = map(_numbered, data) if first.isdisjoint(second) else data  # else two frames
        for item in data:
            yield from _items(item, split, row=rows)
    elif isinstance(data, str):
        yield {PATH: data, "split": split}


def _any_value_beside(items: Iterable[Any], kinds: Any) -> bool:
    """Whether an object of some items has a value of none of these kinds."""
    values = (value for item in items if isinstance(item, Mapping) for value in item.values())
    return not all(isinstance(value, kinds) for value in values)


def _scalars(items: Sequence[Any]) -> bool:
    return bool(items) and all(isinstance(item, (str, int)) for item in items)


def _all_images(items: Sequence[Any]) -> bool:
    return bool(items) and all(isinstance(item, str) and is_image(item) for item in items)


def _numbered(items: Sequence[Any], name: str = "image") -> dict[str, Any]:
    return {f"{name}_{k}": item for k, item in enumerate(items, 1)}


def _flat(item: Mapping[str, Any], prefix: str = "") -> list[dict[str, Any]]:
    """Rows of the cells of nested objects under names like ``image.path``.

    Two or three images in a list are a column each; objects in a list with images are a row each.
    """
    rows: list[dict[str, Any]] = [{}]
    for key, value in item.items():
        name = f"{prefix}{key}"
        cells = [{name: value}]
        if isinstance(value, Mapping):
            cells = _flat(value, f"{name}.")
        elif isinstance(value, list) and len(value) in (2, 3) and _all_images(value):
            cells = [_numbered(value, name)]
        elif isinstance(value, list) and len(rows) == 1:
            inner = [row for i in value if isinstance(i, Mapping) for row in _flat(i, f"{name}.")]
            if inner and all(any(map(is_image, row.values())) for row in inner):
                cells = inner
        rows = [row | more for row in rows for more in cells]
    return rows


def _of_objects(name: str, rows: Sequence[tuple[int, Any]], problems: list[Problem]) -> Table:
    wrong = [line for line, row in rows if not isinstance(row, Mapping)]
    problems += [Problem(f"{name}:{line}", "bad-row", "not a JSON object") for line in wrong]
    objects = [(n, cells) for n, row in rows if isinstance(row, Mapping) for cells in _flat(row)]
    names = list(dict.fromkeys(str(key) for _, row in objects for key in row))
    lists = {str(k) for _, row in objects for k, cell in row.items() if isinstance(cell, list)}

    def records(columns: Sequence[str]) -> Iterator[Record]:
        for line, row in objects:
            cells = [row.get(name) for name in columns]
            if odd := [k for k, cell in enumerate(cells) if isinstance(cell, list | dict | bytes)]:
                kind = type(cells[odd[0]]).__name__
                text = f"{columns[odd[0]]} holds a {kind} instead of a text or number"
                problems.append(Problem(f"{name}:{line}", "bad-row", text))
            else:
                yield (line, *[HALVES.sub("\ufffd", text_of(cell) or "") for cell in cells])

    return Table(name, names, problems, records, nested=lists)


def _schema(path: Path) -> dict[str, pl.DataType]:
    """Columns of a Parquet file; polars would take brackets in its name for a pattern."""
    with open(path, "rb") as file, reading_parquet():
        return dict(pl.read_parquet_schema(file))


def _parquet(path: Path) -> Table:
    def read(columns: Sequence[str]) -> pl.DataFrame:
        try:
            return read_parquet(path, columns)
        except Exception as error:  # polars raises several kinds
            must, got = f"{path} must be a whole Parquet file", str(error).splitlines()[0]
            raise PalpateError(must, got, "Write it again, a large one in parts") from None

    try:
        with reading_parquet():
            schema = _schema(path)
            pl.read_parquet(path, n_rows=1, glob=False)
    except Exception as error:  # polars raises several kinds for a file that is not Parquet
        reason = f"not Parquet: {str(error).splitlines()[0]}"
        return Table(str(path), [], [Problem(str(path), "bad-table", reason)], lambda columns: [])
    return _of_frame(str(path), schema, read)


def _of_frame(
    name: str, schema: Mapping[str, pl.DataType], read: Callable[[Sequence[str]], pl.DataFrame]
) -> Table:
    kinds = {c: k for c, k in schema.items() if k.is_nested() or k.base_type() in UNREAD}

    def records(columns: Sequence[str]) -> Iterator[Record]:
        odd = next((column for column in columns if column in kinds), "")
        must = f"Columns of {name} must hold texts or numbers"
        got = f"{odd} of type {kinds.get(odd)}"
        fix = "For images inside the table use the format hf on its folder"
        require(not odd, None, must, got, fix=fix)
        for line, cells in enumerate(read(columns).iter_rows(), 1):
            yield (line, *map(text_of, cells))

    return Table(name, list(schema), [], records, nested=set(kinds))


def read_categories(path: Path) -> dict[int, str]:
    """Read a table of classes: ``Name: id`` lines, or CSV of id and name in either order.

    Quotes and remarks in brackets after a ``Name: id`` are ignored; a CSV may have a header.

    Returns:
        id -> name, the inconclusive class (-1) included if it is listed; known misspellings are
        corrected.
    """
    text = text_in(path)
    names: dict[int, str] = {}
    problems: list[Problem] = []
    sign = delimiter_of(path, text)
    for number, line in enumerate(text.splitlines(), 1):
        bare = re.sub(r"\([^)]*\)|[\"'“”‘’]", "", line).strip().rstrip(",").strip()
        name, colon, label = (part.strip() for part in bare.rpartition(":"))
        if not colon:
            cells = [cell.strip() for cell in next(csv.reader([line], delimiter=sign), [])]
            cells.sort(key=lambda cell: whole(cell) is not None)  # the name goes first
            name, label = cells if len(cells) == 2 else ("", "")
        k = whole(label)
        if k is None or not name:
            if bare and (number > 1 or sign not in line):  # the first line may be a header
                text = f"{line!r} is neither 'Name: id' nor 'id,name'"
                problems.append(Problem(f"{path}:{number}", "bad-line", text))
        elif k in names:
            text = f"the id {k} names {names[k]!r} already"
            problems.append(Problem(f"{path}:{number}", "duplicate-id", text))
        else:
            name = " ".join(name.split())
            names[k] = SPELLING.get(name, name)
    fix = "Write one 'Name: id' or 'id,name' a line"
    if problems:
        raise ProblemsError(problems, fix)
    require(bool(names), None, f"{path} must list classes", "none; is it empty?", fix=fix)
    return names


def whole(text: str) -> int | None:
    """The integer that a text is (``7``, ``007``, ``7.0``), or None."""
    match = re.fullmatch(r"([+-]?[0-9]{1,18})(?:\.0+)?", text)
    return int(match[1]) if match else None


def text_in(path: Path) -> str:
    """The file as text; what is neither UTF-8 nor UTF-16 becomes U+FFFD."""
    got = f"the folder {path}" if path.is_dir() else f"no file {path}"
    require(path.is_file(), None, "The list must be a file", got, fix="Check the path")
    return decoded(content_of(path))
