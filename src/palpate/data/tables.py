"""Tables of anyone's data: CSV, TSV, JSON lines, JSON arrays and Parquet, as columns of text with the line of every row.

CSV and TSV are UTF-8 (or UTF-16 with a byte-order mark), with any line ends; a ``.csv`` whose header has semicolons but no
commas is split at those. A quoted cell may span lines; its row counts by its first. Rows of another width, lines that are not
JSON, bytes that are not UTF-8 and quotation marks that stay open are problems of their line; blank lines are nothing.
Parquet has no lines: its rows are counted from 1. Only the columns asked for are kept.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, Problem
from palpate.data.mapping import Cell, text_of
from palpate.data.texts import decoded

TABLES = (".csv", ".tsv", ".jsonl", ".json", ".parquet")
Row = dict[str, Any]
_Cells = dict[str, list[Cell]]
_Load = Callable[[Sequence[str]], tuple[list[int], _Cells]]


@dataclass
class Table:
    """A table whose columns are known and whose cells are read when they are asked for.

    Attributes:
        path: the file.
        names: its columns.
        problems: what is wrong with its rows; complete after :meth:`read`.
        lines: (rows,) line of each row that was read.
        cells: column -> (rows,) texts, None where empty.
    """

    path: Path
    names: list[str]
    problems: list[Problem]
    load: _Load
    lines: list[int]
    cells: _Cells

    def read(self, needed: Sequence[str]) -> Table:
        """Reads the rows, keeping the columns in ``needed``.

        Raises:
            PalpateError: if one of them stands twice in the header, or holds no texts and numbers.
        """
        if twice := [name for name in needed if self.names.count(name) > 1]:
            raise PalpateError(
                f"A column of {self.path} must stand once",
                f"{twice[0]} twice or more",
                "Rename one of them",
            )
        self.lines, self.cells = self.load(list(dict.fromkeys(needed)))
        return self

    def where(self, k: int) -> str:
        """``file:line`` of row ``k``."""
        return f"{self.path}:{self.lines[k]}"


def open_table(path: Path, names: Sequence[str] | None = None) -> Table:
    """Opens a table and finds out its columns.

    Args:
        path: the file.
        names: columns of a CSV or TSV file that has no header line; the file may then have any suffix.

    Raises:
        PalpateError: if the file is missing, or of another form.
    """
    path = Path(path)
    if not path.is_file():
        raise PalpateError("The table must be a file", f"no file {path}", "Check the path")
    suffix = path.suffix.lower()
    if names and suffix in (".jsonl", ".json", ".parquet"):
        raise PalpateError(
            "Only CSV and TSV files can be without names of columns", path.name, "Leave names out"
        )
    opener: Callable[[Path, list[Problem]], tuple[list[str], _Load]] | None = {
        ".jsonl": _json_lines,
        ".json": _json_array,
        ".parquet": _parquet,
    }.get(suffix)
    problems: list[Problem] = []
    if opener is not None:
        header, load = opener(path, problems)
    elif names or suffix in TABLES:
        header, load = _csv(path, problems, list(names) if names else None)
    else:
        raise PalpateError(
            f"A table must be one of {', '.join(TABLES)}", path.name, "Convert it, or rename it"
        )
    return Table(path, header, problems, load, [], {})


def header_of(path: Path) -> list[str]:
    """The columns of a table as far as its first row shows them; empty if it cannot be read. Quick, and never raises."""
    suffix = Path(path).suffix.lower()
    try:
        if suffix == ".parquet":
            return list(_schema(path))
        with open(path, "rb") as file:
            head = decoded(file.read(1 << 16))
        if suffix in (".csv", ".tsv"):
            return next(
                (
                    [c.strip() for c in cells]
                    for cells in csv.reader(
                        io.StringIO(head, newline=""), delimiter=sign_of(path, head)
                    )
                    if any(cells)
                ),
                [],
            )
        start = head.find("{") if suffix in (".jsonl", ".json") else -1
        first = json.JSONDecoder().raw_decode(head, start)[0] if start >= 0 else {}
        return [str(name) for name in first] if isinstance(first, dict) else []
    except Exception:  # whatever the file is, it is not a table
        return []


def sign_of(path: Path, text: str) -> str:
    """What separates the cells of a CSV file."""
    if path.suffix.lower() == ".tsv":
        return "\t"
    head = re.split("[\r\n]", text.lstrip("\r\n"), maxsplit=1)[0]
    return next((sign for sign in ",;\t" if sign in head), ",")


def _unfit(text: str) -> bool:
    """Whether a text can be no cell: bytes that were not UTF-8, halves of characters, the zero character."""
    return "\ufffd" in text or "\x00" in text or re.search("[\ud800-\udfff]", text) is not None


def _csv(path: Path, problems: list[Problem], names: list[str] | None) -> tuple[list[str], _Load]:
    text = decoded(path.read_bytes())
    odd = "\ufffd" in text or "\x00" in text
    records = _records(path, text, problems)
    header = names or [cell.strip() for cell in next(records, (0, []))[1]]

    def load(needed: Sequence[str]) -> tuple[list[int], _Cells]:
        stores: list[list[Cell]] = [[] for _ in needed]
        places = [(header.index(name), store) for name, store in zip(needed, stores, strict=True)]
        lines: list[int] = []
        for line, cells in records:
            if len(cells) != len(header):
                problems.append(
                    Problem(
                        f"{path}:{line}",
                        "bad-row",
                        f"{len(cells)} cells under {len(header)} columns",
                    )
                )
            elif odd and any(map(_unfit, cells)):
                problems.append(
                    Problem(
                        f"{path}:{line}",
                        "bad-encoding",
                        "the row holds bytes that are not UTF-8, or a zero byte",
                    )
                )
            else:
                lines.append(line)
                for i, store in places:
                    cell = text_of(cells[i])
                    store.append(
                        store[-1] if store and store[-1] == cell else cell
                    )  # one copy of what repeats
        return lines, dict(zip(needed, stores, strict=True))

    return header, load


def _records(path: Path, text: str, problems: list[Problem]) -> Iterator[tuple[int, list[str]]]:
    """(first line, cells) of each record that is not blank."""
    quotes = 0

    def lines() -> Iterator[str]:
        nonlocal quotes
        for line in io.StringIO(text, newline=""):
            quotes += line.count('"')
            yield line

    reader = csv.reader(lines(), delimiter=sign_of(path, text))
    start = 1
    try:
        for cells in reader:
            first, start = start, reader.line_num + 1
            # A mark that stays open takes in all that follows it.
            if reader.line_num > first and quotes % 2:
                problems.append(
                    Problem(
                        f"{path}:{first}",
                        "open-quote",
                        f"a quotation mark stays open up to line {reader.line_num}",
                    )
                )
            elif any(cell.strip() for cell in cells):
                yield first, cells
            quotes = 0
    except csv.Error as error:
        problems.append(
            Problem(
                f"{path}:{start}",
                "bad-row",
                f"{error}; is a quotation mark open? No row after it was read",
            )
        )


def _json_lines(path: Path, problems: list[Problem]) -> tuple[list[str], _Load]:
    def items() -> Iterator[tuple[int, Any]]:
        for number, line in enumerate(decoded(path.read_bytes()).split("\n"), 1):
            if line.strip():
                try:
                    yield number, json.loads(line)
                except (json.JSONDecodeError, RecursionError) as error:
                    problems.append(
                        Problem(f"{path}:{number}", "bad-row", f"not JSON: {_said(error)}")
                    )

    return _of_objects(path, items(), problems)


def _json_array(path: Path, problems: list[Problem]) -> tuple[list[str], _Load]:
    """A list of objects; each is decoded by itself, so that its line is known."""
    text = decoded(path.read_bytes())

    def items() -> Iterator[tuple[int, Any]]:
        decoder = json.JSONDecoder()
        at, line, counted = len(text) - len(text.lstrip()), 1, 0
        if not text.startswith("[", at):
            raise PalpateError(
                f"{path} must hold a JSON list of objects",
                repr(text[at : at + 20]),
                "Write [{...}, {...}], or JSON lines",
            )
        while True:
            at = _past(text, at + 1)
            line, counted = line + text.count("\n", counted, at), at
            if text.startswith("]", at):
                return
            try:
                item, at = decoder.raw_decode(text, at)
            except (json.JSONDecodeError, RecursionError) as error:
                problems.append(
                    Problem(
                        f"{path}:{line}",
                        "bad-row",
                        f"not JSON: {_said(error)}; no row after it was read",
                    )
                )
                return
            yield line, item
            at = _past(text, at)
            if not text.startswith((",", "]"), at):
                problems.append(
                    Problem(
                        f"{path}:{line}",
                        "bad-row",
                        "no comma or bracket after the object; no row after it was read",
                    )
                )
                return
            at -= text.startswith("]", at)

    return _of_objects(path, items(), problems)


def _past(text: str, at: int) -> int:
    """The place of the next sign that is not space."""
    found = re.compile(r"\s*").match(text, at)
    return found.end() if found else at


def _said(error: Exception) -> str:
    return error.msg if isinstance(error, json.JSONDecodeError) else "nested too deep"


def _of_objects(
    path: Path, items: Iterator[tuple[int, Any]], problems: list[Problem]
) -> tuple[list[str], _Load]:
    rows: list[tuple[int, Row]] = []
    names: dict[str, None] = {}
    for line, item in items:
        if isinstance(item, dict):
            rows.append((line, item))
            names.update(dict.fromkeys(item))
        else:
            problems.append(Problem(f"{path}:{line}", "bad-row", "not a JSON object"))

    def load(needed: Sequence[str]) -> tuple[list[int], _Cells]:
        stores: list[list[Cell]] = [[] for _ in needed]
        lines: list[int] = []
        for line, row in rows:
            cells = [row.get(name) for name in needed]
            if nested := [
                name
                for name, cell in zip(needed, cells, strict=True)
                if isinstance(cell, (list, dict))
            ]:
                problems.append(
                    Problem(
                        f"{path}:{line}",
                        "bad-row",
                        f"{nested[0]} is a list or an object, where a text or number must stand",
                    )
                )
            elif any(isinstance(cell, str) and _unfit(cell) for cell in cells):
                problems.append(
                    Problem(
                        f"{path}:{line}",
                        "bad-encoding",
                        "the row holds bytes that are not UTF-8, or a zero character",
                    )
                )
            else:
                lines.append(line)
                for cell, store in zip(cells, stores, strict=True):
                    store.append(text_of(cell))
        return lines, dict(zip(needed, stores, strict=True))

    return list(names), load


def _schema(path: Path) -> dict[str, pl.DataType]:
    """Columns of a Parquet file, opened here since polars would take brackets in its name for a pattern."""
    with open(path, "rb") as file:
        return dict(pl.read_parquet_schema(file))


def _parquet(path: Path, problems: list[Problem]) -> tuple[list[str], _Load]:
    try:
        schema = _schema(path)
    except Exception as error:  # polars raises several kinds for a file that is not Parquet
        problems.append(
            Problem(str(path), "bad-table", f"not Parquet: {str(error).splitlines()[0]}")
        )
        return [], lambda needed: ([], {name: [] for name in needed})

    def load(needed: Sequence[str]) -> tuple[list[int], _Cells]:
        if unfit := [
            name
            for name in needed
            if schema[name].is_nested() or schema[name].base_type() in (pl.Binary, pl.Object)
        ]:
            got = f"{unfit[0]} of type {schema[unfit[0]]}"
            raise PalpateError(
                f"Columns of {path} must hold texts or numbers",
                got,
                "For images inside the table: --format hf on its folder",
            )
        try:
            table = pl.read_parquet(path, columns=list(needed), glob=False)
        except Exception as error:
            problems.append(
                Problem(str(path), "bad-table", f"not Parquet: {str(error).splitlines()[0]}")
            )
            return [], {name: [] for name in needed}
        cells = {name: [text_of(cell) for cell in table[name].to_list()] for name in needed}
        odd = frozenset(
            {
                k
                for column in cells.values()
                for k, cell in enumerate(column)
                if cell is not None and "\x00" in cell
            }
        )
        problems.extend(
            Problem(f"{path}:{k + 1}", "bad-encoding", "the row holds a zero character")
            for k in sorted(odd)
        )
        keep = [k for k in range(table.height) if k not in odd]
        return [k + 1 for k in keep], {
            name: [column[k] for k in keep] for name, column in cells.items()
        } if odd else cells

    return list(schema), load
