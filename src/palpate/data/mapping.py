"""Manifest columns as SQL expressions over the columns of a table, e.g. ``video = substr(path, 1,
15)``.

An expression is one of polars' SQL (:func:`polars.sql_expr`) over text cells. A text that is
exactly the name of a column means that column, whatever characters it has. An expression may also
use other mapped columns; columns of the table go first. See ``docs/concepts/mapping.md``.
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
FIX = "Use SQL functions on columns: substr, split_part, replace, regexp_replace, left, right, ||"
#: The former expression language -> the same in SQL; groups are ``{0}``, ``{1}``; ``{start}``
#: counts from 1.
_X = r"((?:\w|\"[^\"]+\"|\((?:[^()]|\([^()]*\))*\))+)"
_INNER = r"\(((?:[^()]|\((?:[^()]|\([^()]*\))*\))*)"
_OLD_SPELLINGS: tuple[tuple[str, str], ...] = (
    (_X + r"\[(\d*):(\d+)\]", "substr({0}, {start}, {length})"),
    (_X + r"\[(\d+):\]", "substr({0}, {start})"),
    (_X + r"\[-(\d+):\]", "right({0}, {1})"),
    (_X + r"\[(\d+)\]", "substr({0}, {start}, 1)"),
    (r"\bpart" + _INNER + r",\s*(-\d+)\)", "split_part({0}, '/', {1})"),
    (r"\bpart" + _INNER + r",\s*(\d+)\)", "split_part({0}, '/', {start})"),
    (r"\bname" + _INNER + r"\)", "split_part({0}, '/', -1)"),
    (r"\bstem" + _INNER + r"\)", r"regexp_replace(split_part({0}, '/', -1), '\.[^.]*$', '')"),
    (r"\bparent" + _INNER + r"\)", "regexp_replace({0}, '/[^/]*$', '')"),
    (r"\bint" + _INNER + r"\)", "{0}"),
    (_X + r"\s*~\s*/\^?((?:[^/\\]|\\.)+?)\$?/", r"regexp_replace({0}, '^.*?{1}.*$', '\1')"),
)


@dataclass(frozen=True)
class ColumnMaps:
    """Manifest columns as expressions over the columns of a table.

    Attributes:
        expressions: target -> expression, in an order in which each can be computed.
        columns: columns of the table that they read.
        texts: target -> the expression as it was written.
    """

    expressions: Mapping[str, pl.Expr]
    columns: tuple[str, ...]
    texts: Mapping[str, str]

    def source(self, target: str) -> str | None:
        """The column that a target is, if it is nothing but one."""
        expression = self.expressions.get(target)
        names = [] if expression is None else expression.meta.root_names()
        if expression is None or len(names) != 1 or names[0] not in self.columns:
            return None
        return names[0] if expression.meta.eq(pl.col(names[0])) else None

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

        Raises:
            PalpateError: if an expression cannot be computed.
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
        raise PalpateError(
            f"must map columns among {', '.join(targets)}",
            repr(unknown[0]),
            "Write it as manifest column = expression over yours",
            argument="columns",
        )
    texts = {name: name for name in targets if name in columns} | dict(maps)
    pending = {target: _parsed(target, text, columns) for target, text in texts.items()}
    ordered: dict[str, pl.Expr] = {}
    while pending:
        known = {*columns, *ordered}
        ready = {t: e for t, e in pending.items() if known.issuperset(e.meta.root_names())}
        if not ready:
            target, expression = next(iter(pending.items()))
            missing = [name for name in expression.meta.root_names() if name not in known]
            circular = f"{missing[0]}, which depends on {target} itself"
            unknown_name = f"no {missing[0]} among {', '.join(columns)}"
            got = circular if missing[0] in maps else unknown_name
            raise _unusable(target, texts[target], got)
        ordered |= ready
        pending = {t: e for t, e in pending.items() if t not in ready}
    return ColumnMaps(ordered, _columns(ordered, columns), texts)


def sql_spelling(text: str) -> str:
    """An expression of the former language (``path[:15]``, ``stem(path)``) in SQL; other texts as
    they are.
    """
    for _ in range(9):  # expressions within expressions
        before = text
        for pattern, form in _OLD_SPELLINGS:
            text = re.sub(pattern, lambda m, form=form: _rewritten(m, form), text)
        if text == before:
            break
    return text


def text_of(value: Any) -> str | None:
    """A cell as text without surrounding space; empty, null and NaN are None."""
    if isinstance(value, str):
        return value.strip() or None
    return None if value is None or value != value else str(value)


def _rewritten(match: re.Match[str], form: str) -> str:
    start, end = (int(g) if g and g.isdecimal() else 0 for g in (*match.groups(), "", "")[1:3])
    return form.format(*match.groups(), start=start + 1, length=end - start)


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
    got = error if isinstance(error, str) else (str(error) or type(error).__name__).splitlines()[0]
    new = sql_spelling(text)
    return PalpateError(
        "must map each column to a column or an SQL expression",
        f"{target}={text}: {got}",
        FIX if new == text else f"Write {target}={new}",
        argument="columns",
    )
