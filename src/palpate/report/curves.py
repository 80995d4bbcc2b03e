"""Drawings of scores: strips of many subjects on one axis."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile

from palpate.core import Score
from palpate.report.drawing import Drawing, Shape, Words, cut_to, dot
from palpate.report.notes import digits_of, number
from palpate.report.plots import Axis, axis_of, ticks_of
from palpate.report.study_tables import Row, Sheet

#: Units of a strip: label, axis and number.
STRIP, LABEL, AXIS, ROW = 640.0, 212.0, 240.0, 20.0


@dataclass(frozen=True)
class Panel:
    """The scores of one metric by subject: label, score, whether it is a control."""

    title: str
    rows: Sequence[tuple[str, Score, bool]]


def panels_of(table: Sheet) -> list[Panel]:
    """Return the columns of a table as panels: those whose scores are of one metric."""
    panels: list[Panel] = []
    for k, head in enumerate(table.heads):
        rows = [
            (_label(row), score, row.control)
            for row in table.rows
            if (score := row.cells[k].score) is not None
        ]
        if rows and len({(score.measure, score.kind) for _, score, _ in rows}) == 1:
            panels.append(Panel(f"{head.label} {head.arrow}".strip(), rows))
    return panels


def _label(row: Row) -> str:
    """The words before the first score."""
    words = takewhile(lambda value: not isinstance(value, Score), (c.value for c in row.cells))
    return ", ".join(word for word in words if isinstance(word, str))


def strips_drawing(title: str, panels: Sequence[Panel]) -> Drawing:
    """Draw each panel on an axis of its own: value, interval, null and floor of each subject.

    The axis holds the methods and their floor; a control beyond it is an arrow at the edge.
    Controls are hollow. A score without a finite value has no mark, and the word ``undefined``.
    """
    parts: list[Shape | Words] = []
    y = 4.0
    for panel in panels:
        methods = [score for _, score, control in panel.rows if not control]
        axis = axis_of(methods) or axis_of(score for _, score, _ in panel.rows)
        digits = digits_of(score for _, score, _ in panel.rows)
        parts.append(Words(0, y + 12, cut_to(panel.title, STRIP), ink="ink", bold=True))
        y += ROW
        for row in panel.rows:
            parts += _strip(row, axis, digits, y)
            y += ROW
        parts += _strip_axis(axis, y)
        y += 34
    kinds = [score for panel in panels for _, score, _ in panel.rows]
    legend = ["dot: score", *["hollow: control"] * any(c for p in panels for *_, c in p.rows)]
    legend += ["arrow: beyond the axis"] * any(c for p in panels for *_, c in p.rows)
    legend += ["line: interval"] * any(s.interval for s in kinds)
    legend += ["gray: null band"] * any(s.null for s in kinds)
    legend += ["dashed: floor"] * any(s.floor is not None for s in kinds)
    parts.append(Words(0, y + 4, "; ".join(legend)))
    return Drawing(STRIP, y + 12, parts, f"{title}: {', '.join(p.title for p in panels)}")


def _strip(
    row: tuple[str, Score, bool], axis: Axis | None, digits: int, y: float
) -> Iterable[Shape | Words]:
    label, score, control = row
    mid = y + ROW / 2
    yield Words(0, mid + 4, cut_to(label, LABEL - 6), ink="ink")
    text = "undefined"
    if axis is not None:
        yield Shape([(LABEL, mid), (LABEL + AXIS, mid)], "line")
        yield from _band(score, axis, mid)
    if axis is not None and score.value is not None and math.isfinite(score.value):
        text = number(score.value, digits)
        if score.interval:
            low, high = (_place(axis, v) for v in score.interval)
            yield Shape([(low, mid), (high, mid)], "mark", width=1.8)
            for end in (low, high):
                yield Shape([(end, mid - 4), (end, mid + 4)], "mark", width=1.4)
            text += f" [{', '.join(number(v, digits) for v in score.interval)}]"
        yield from _dot(axis, float(score), control, mid)
    yield Words(LABEL + AXIS + 12, mid + 4, text, ink="ink")


def _dot(axis: Axis, value: float, control: bool, mid: float) -> Iterable[Shape]:
    x, way = _place(axis, value), (value > axis.high) - (value < axis.low)
    if way:
        yield Shape([(x, mid - 5), (x + 8 * way, mid), (x, mid + 5)], "mark", fill=True)
    else:
        yield from dot(x, mid, "mark", hollow=control)


def _band(score: Score, axis: Axis, mid: float) -> Iterable[Shape]:
    if score.null:
        a, b = sorted(_place(axis, v) for v in score.null)
        box = [(a - 0.75, mid - 7), (b + 0.75, mid - 7), (b + 0.75, mid + 7), (a - 0.75, mid + 7)]
        yield Shape(box, "soft", fill=True, opacity=0.25)
    if score.floor is not None:
        x = _place(axis, score.floor)
        yield Shape([(x, mid - ROW / 2), (x, mid + ROW / 2)], "ink", width=1.4, dash=(3, 2))


def _place(axis: Axis, value: float) -> float:
    share = (value - axis.low) / (axis.high - axis.low)
    return LABEL + AXIS * min(1.0, max(0.0, share))


def _strip_axis(axis: Axis | None, y: float) -> Iterable[Shape | Words]:
    if axis is None:
        return
    ticks, digits = ticks_of(axis.low, axis.high, 4)
    yield Shape([(LABEL, y), (LABEL + AXIS, y)], "soft")
    for tick in ticks:
        x = _place(axis, tick)
        yield Shape([(x, y), (x, y + 4)], "soft")
        yield Words(x, y + 16, number(tick, digits), "middle")
