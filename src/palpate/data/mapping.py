"""Manifest columns as SQL expressions over a table, e.g. ``video = substr(path, 1, 15)``.

An expression is one of polars' SQL (:func:`polars.sql_expr`) over text cells. A text that is
exactly the name of a column means that column, whatever characters it has. An expression may also
use other mapped columns; columns of the table go first. See ``docs/concepts/data.md``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from palpate.core import PalpateError

#: What polars raises for expressions that it cannot parse or compute.
ERRORS = (pl.exceptions.PolarsError, pl.exceptions.PanicException, ValueError, TypeError)
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

    def apply(self, table: pl.DataFrame) -> dict[str, list[str | None]]:
        """Compute the targets.

        Args:
            table: (n rows); it must have ``columns``, as texts.

        Returns:
            Target -> (n,) texts: None where the expression is null, ``""`` where it is empty.
        """
        computed: dict[str, list[str | None]] = {}
        for target, expression in self.expressions.items():
            try:
                values = table.with_columns(expression.cast(pl.String).alias(target))[target]
            except ERRORS as error:
                raise _unusable(target, self.texts[target], error) from None
            computed[target] = values.str.strip_chars().to_list()
            if target not in table.columns:
                table = table.with_columns(values)
        return computed


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
