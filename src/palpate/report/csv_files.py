"""Tables, curves and claims of a study, and scores, as CSV files: numbers in full precision."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from palpate.core import Score, write_text
from palpate.report.results import Results
from palpate.report.study import Curve
from palpate.report.study_tables import Sheet, file_names, sheets


def save_csv(results: Results, folder: Path) -> list[Path]:
    """Write one file a table (``table-...``) and a curve (``curve-...``), and all others.

    A column of scores is three: value, ``low`` and ``high`` of the interval. A curve has the
    columns ``line, x, value, low, high``. ``claims.csv`` has the claims, ``scores.csv`` the rows of
    :meth:`~palpate.report.results.Results.to_frame`.

    Raises:
        PalpateError: if nothing can be written there.
    """
    texts: dict[str, str] = {}
    tables = sheets(results)
    names = file_names("table", [table.title for table in tables])
    texts |= {f"{n}.csv": _csv(_table(table)) for n, table in zip(names, tables, strict=True)}
    names = file_names("curve", [curve.title for curve in results.curves])
    texts |= {
        f"{n}.csv": _csv(_curve(curve)) for n, curve in zip(names, results.curves, strict=True)
    }
    if results.claims:
        claims = [(c.claim, c.source, c.verdict, c.why) for c in results.claims]
        texts["claims.csv"] = _csv([("claim", "source", "verdict", "why"), *claims])
    if results.scores:
        frame = results.to_frame()
        texts["scores.csv"] = _csv([frame.columns, *frame.iter_rows()])
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]


def _csv(rows: Iterable[Sequence[Any]]) -> str:
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows(map(_safe, row) for row in rows)
    return file.getvalue()


def _safe(value: Any) -> Any:
    """Words that a spreadsheet would take for a formula, behind an apostrophe; never numbers."""
    return f"'{value}" if isinstance(value, str) and value[:1] in tuple("=+-@") else value


def _table(table: Sheet) -> Iterable[Sequence[Any]]:
    controls = any(row.control for row in table.rows)
    head: list[str] = []
    for column in table.heads:
        label = column.label
        head += [label, f"{label} low", f"{label} high"] if column.scores else [label]
    yield [*head, *["control"] * controls]
    for row in table.rows:
        cells: list[Any] = []
        for column, cell in zip(table.heads, row.cells, strict=True):
            numbers = [cell.value, "", ""] if cell.score is None else _numbers(cell.score)
            cells += numbers if column.scores else [cell.value]
        yield [*cells, *[str(row.control).lower()] * controls]


def _curve(curve: Curve) -> Iterable[Sequence[Any]]:
    yield ("line", "x", "value", "low", "high")
    for line in curve.lines:
        for x, score in line.points:
            yield (line.label, x, *_numbers(score))


def _numbers(score: Score) -> list[float | None]:
    return [score.value, *(score.interval or (None, None))]
