"""Manifest columns as SQL expressions over a table, e.g. ``video = substr(path, 1, 15)``.

An expression is one of polars' SQL (:func:`polars.sql_expr`) over text cells. A text that is
exactly the name of a column means that column, whatever characters it has. An expression may also
use other mapped columns; columns of the table go first. See ``docs/concepts/data.md``.
"""

from __future__ import annotations

import json
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from palpate.core import PalpateError

#: What polars raises for expressions that it cannot parse or compute.
ERRORS = (
    *(pl.exceptions.PolarsError, pl.exceptions.PanicException),
    *(ValueError, TypeError, RecursionError),
)
#: Bytes of the longest text that an expression may make, besides ten times those of its cells.
LONGEST = 1 << 12
#: The parts that an expression may have, as polars calls them: none sees another row, and none but
#: ``PadStart``, ``PadEnd``, ``Replace`` makes text that is longer than its parts together.
PARTS = set(
    """Column Literal BinaryExpr Cast Ternary
    Abs Ceil Coalesce Contains ConcatHorizontal EndsWith FillNull Find Floor Get IsIn IsNotNull
    IsNull LenBytes LenChars Length Lowercase MaxHorizontal MinHorizontal Not PadEnd PadStart
    Replace Reverse Sign Slice Split Sql StartsWith StripChars StripCharsEnd StripCharsStart
    Strptime Titlecase Truncate Uppercase""".split()  # noqa: SIM905 - readable as a list of words
)
EXACT = {"Plus": operator.add, "Minus": operator.sub, "Mul": operator.mul, "Multiply": operator.mul}
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
        limit = LONGEST + 10 * max(
            (_bytes(table, pl.col(name)) for name in self.columns), default=0
        )
        for target, expression in self.expressions.items():
            values = _values(target, self.texts[target], expression, table, limit)
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


def _values(
    target: str, text: str, expression: pl.Expr, table: pl.DataFrame, limit: int
) -> pl.Series:
    """(n,) texts: of cells as texts, else of numbers where all cells of a column are some."""
    failed: BaseException | None = None
    for cells in (table, None):
        if cells is None:
            cells = table.with_columns(map(_as_numbers, table))
        try:
            _longest(expression, cells, limit, {})
            return cells.with_columns(expression.alias(target))[target].cast(pl.String)
        except ERRORS as error:
            failed = failed or error
    raise _unusable(target, text, failed or "") from None


def _bytes(cells: pl.DataFrame, expression: pl.Expr) -> int:
    return cells.select(expression.cast(pl.String).str.len_bytes().max()).item() or 0


def _longest(expression: pl.Expr, cells: pl.DataFrame, limit: int, seen: dict[str, int]) -> int:
    """Bytes of the longest text that an expression may make of a row, by those of its parts.

    Args:
        expression: what is looked at.
        cells: the table.
        limit: bytes of the longest text that is allowed.
        seen: JSON of parts -> theirs; ``split_part`` has one three times.

    Raises:
        ValueError: if a part is none of ``PARTS``, may make a longer text, or overflows.
    """
    text = expression.meta.serialize(format="json")
    if text in seen:
        return seen[text]
    node = json.loads(text)
    match node:
        case {"Function": {"function": inner}}:
            pass
        case {"BinaryExpr": {"op": op}}:
            inner = {"BinaryExpr": op}
        case _:
            inner = next(iter(node))
    names = list[Any]()  # a family, one of it, its options
    while isinstance(inner, dict):
        name, inner = next(iter(inner.items()))
        names.append(name)
    names = [*names, inner][: 3 if names[:1] == ["Sql"] else 2]
    if PARTS.isdisjoint(names[:2]):
        raise ValueError(f"it is no function of the cells of one row: {names[-1]}")
    parts, name = expression.meta.pop()[::-1], names[-1]
    lengths = [_longest(part, cells, limit, seen) for part in parts]
    kind = cells.lazy().select(expression).collect_schema().dtypes()[0]
    if name in EXACT and kind.is_integer():
        exact = EXACT[name](*(part.cast(pl.Int64).cast(pl.Int128) for part in parts))
        if not cells.select((exact == expression).all()).item():
            raise ValueError("a number is too large for its type; cast to bigint")
    most = max(lengths, default=len(text))
    if not parts and kind == pl.String:
        most = _bytes(cells, expression)
    elif name in ("PadStart", "PadEnd"):
        most = max(most, 4 * (cells.select(parts[1].max().cast(pl.Int64)).item() or 0))
    elif name == "Replace":
        options = node["Function"]["function"]["StringExpr"]["Replace"]
        shortest, groups = 1, 0  # of the patterns; the most that a replacement repeats
        if options["literal"]:
            shortest = cells.select(parts[1].str.len_bytes().min()).item() or 1
        else:
            groups = cells.select(parts[2].str.count_matches("$", literal=True).max()).item() or 0
        matches = 1 if options["n"] == 1 else lengths[0] // shortest + 1
        most = lengths[0] * (1 + groups) + matches * lengths[2]
    elif name in ("Plus", "ConcatHorizontal"):
        most = sum(lengths) + len(parts) * len(str(inner))  # with what is between them
    if most > limit:
        raise ValueError(f"it may make texts of more than {limit:,} bytes")
    seen[text] = 40 if kind.is_numeric() or kind == pl.Boolean else most
    return seen[text]


def _as_numbers(column: pl.Series) -> pl.Series:
    """A column of integers or decimals as such; others as they are."""
    for pattern, kind in ((r"^[+-]?[0-9]{1,18}$", pl.Int64), (r"^[+-]?[0-9.]{1,18}$", pl.Float64)):
        if column.dtype == pl.String and column.count() and column.str.contains(pattern).all():
            return column.cast(kind, strict=False)
    return column


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
