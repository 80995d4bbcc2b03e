"""Manifest columns as SQL expressions over a table, e.g. ``video = substr(path, 1, 15)``.

An expression is one of polars' SQL (:func:`polars.sql_expr`) over text cells. A text that is
exactly the name of a column means that column, whatever characters it has. An expression may also
use other mapped columns; columns of the table go first. See ``docs/concepts/data.md``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from palpate.core import PalpateError

#: What polars raises for expressions that it cannot parse or compute.
ERRORS = (pl.exceptions.PolarsError, pl.exceptions.PanicException, ValueError, TypeError)
#: Bytes of the longest text that an expression may make of a row, and signs that it may pad to.
LONGEST, LONGEST_PAD = 1 << 16, 255
PADS = re.compile(r"(?i)\b[lr]pad\s*\(.*?,\s*([0-9]+)")
#: A cast to an integer; what rounding may change.
INTEGER = re.compile(r"(?i)(\bas|::)\s*(?:tiny|small|big)?int(?:eger)?[0-9]*\b")
SLACK = 100
#: A further column of every table: the line of each row.
LINE = "palpate_line"
FIX = "Use SQL functions on columns: substr, split_part, replace, regexp_replace, left, right, ||"


@dataclass(frozen=True)
class ColumnMaps:
    """Manifest columns as expressions over the columns of a table."""

    #: Target -> expression, in an order in which each can be computed.
    expressions: Mapping[str, pl.Expr]
    columns: tuple[str, ...]  # columns of the table that they read
    texts: Mapping[str, str]  # target -> the expression as it was written

    def source(self, target: str) -> str | None:
        """The column that a target is, if it is nothing but one."""
        expression = self.expressions.get(target)
        if expression is None:
            return None
        return next((n for n in self.columns if expression.meta.eq(pl.col(n))), None)

    def without(self, targets: Sequence[str]) -> ColumnMaps:
        """The maps of the other targets."""
        left = {t: e for t, e in self.expressions.items() if t not in targets}
        return ColumnMaps(left, _columns(left, self.columns), self.texts)

    def apply(self, table: pl.DataFrame) -> pl.DataFrame:
        """Compute the targets.

        Args:
            table: (n rows); it must have ``columns``, as texts.

        Returns:
            (n rows) the targets as texts: null where the expression is null, ``""`` where it is
            empty; and the column ``LINE``, if the table has it.
        """
        computed = [table[LINE]] if LINE in table.columns else []
        for target, expression in self.expressions.items():
            values = _values(target, self.texts[target], expression, table)
            computed.append(values.str.strip_chars())
            if target not in table.columns:
                table = table.with_columns(values)
        return pl.DataFrame(computed)


def compile_maps(
    maps: Mapping[str, str], columns: Sequence[str], targets: Sequence[str]
) -> ColumnMaps:
    """Parse map expressions.

    Args:
        maps: target -> expression, or the name of a column.
        columns: of the table.
        targets: what may be mapped; those that are columns by name and are not mapped are taken as
            they are.

    Raises:
        PalpateError: on an unknown target, or an expression that cannot be parsed or names an
            unknown column.
    """
    if unknown := sorted(set(maps) - set(targets)):
        must = f"must map columns among {', '.join(targets)}"
        fix = "Write it as manifest column = expression over yours"
        raise PalpateError(must, repr(unknown[0]), fix, argument="columns")
    texts = {name: name for name in targets if name in columns} | dict(maps)
    pending = {target: _parsed(target, text, columns) for target, text in texts.items()}
    ordered: dict[str, pl.Expr] = {}
    while pending:
        available = {*columns, *ordered}
        ready = {t: e for t, e in pending.items() if available.issuperset(e.meta.root_names())}
        if not ready:
            target, expression = next(iter(pending.items()))
            missing = next(n for n in expression.meta.root_names() if n not in available)
            circular = f"{missing}, which depends on {target} itself"
            got = circular if missing in maps else f"no {missing} among {', '.join(columns)}"
            raise _unusable(target, texts[target], got)
        ordered |= ready
        pending = {t: e for t, e in pending.items() if t not in ready}
    return ColumnMaps(ordered, _columns(ordered, columns), texts)


def _values(target: str, text: str, expression: pl.Expr, table: pl.DataFrame) -> pl.Series:
    """(n,) texts: of cells as texts, else of numbers where all cells of a column are some."""
    failed: BaseException | None = None
    if any(int(width) > LONGEST_PAD for width in PADS.findall(text)):
        raise _unusable(target, text, f"it pads to more than {LONGEST_PAD} signs")
    for cells in (table, None):
        if cells is None:
            cells = table.with_columns(map(_as_numbers, table))
        try:
            two = cells.head(2)
            if expression.meta.root_names() and two.select(expression).height < two.height:
                raise _unusable(target, text, "it makes one value of all rows")
            first = cells.head(1).with_columns(expression.alias(target))[target]
            if (first.cast(pl.String).str.len_bytes() > LONGEST).any():
                raise _unusable(target, text, f"it makes texts of more than {LONGEST:,} bytes")
            values = cells.with_columns(expression.alias(target))[target]
        except ERRORS as error:
            failed = failed or error
            continue
        if values.dtype.is_integer() and _overflows(text, cells, values):
            raise _unusable(target, text, "a number is too large for its type; cast to bigint")
        return values.cast(pl.String)
    raise _unusable(target, text, failed or "") from None


def _as_numbers(column: pl.Series) -> pl.Series:
    """A column of integers or decimals as such; others as they are."""
    for pattern, kind in ((r"^[+-]?[0-9]{1,18}$", pl.Int64), (r"^[+-]?[0-9.]{1,18}$", pl.Float64)):
        if column.dtype == pl.String and column.count() and column.str.contains(pattern).all():
            return column.cast(kind, strict=False)
    return column


def _overflows(text: str, cells: pl.DataFrame, values: pl.Series) -> bool:
    """Whether integers differ from what the expression gives in floating point."""
    try:
        exact = pl.sql_expr(INTEGER.sub(r"\1 double", text)).cast(pl.Float64)
        floats = cells.drop(LINE, strict=False).with_columns(pl.col(pl.Int64).cast(pl.Float64))
        difference = (floats.select(exact).to_series() - values).abs()
    except ERRORS:
        return False
    return bool((difference > SLACK + 1e-6 * values.cast(pl.Float64).abs()).any())


def text_of(value: Any) -> str | None:
    """A cell as text without surrounding space; empty, null and NaN are None."""
    if isinstance(value, str):
        return value.strip() or None
    return None if value is None or value != value else str(value)


def _parsed(target: str, text: str, columns: Sequence[str]) -> pl.Expr:
    if text.strip() in columns:
        return pl.col(text.strip())
    try:
        return pl.sql_expr(text)
    except ERRORS as error:
        raise _unusable(target, text, error) from None


def _columns(expressions: Mapping[str, pl.Expr], columns: Sequence[str]) -> tuple[str, ...]:
    used = (name for e in expressions.values() for name in e.meta.root_names())
    return tuple(dict.fromkeys(name for name in used if name in columns))


def _unusable(target: str, text: str, error: BaseException | str) -> PalpateError:
    got = f"{target}={text}: {(str(error) or type(error).__name__).splitlines()[0]}"
    must = "must map each column to a column or an SQL expression"
    return PalpateError(must, got, FIX, argument="columns")
