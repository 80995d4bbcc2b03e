"""Drawings of a study: curves, and strips of many subjects on one axis."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile

from palpate.core import Score
from palpate.report.drawing import DASHES, MARKERS, Drawing, Shape, Words, lines_of, marker
from palpate.report.drawing import text_width as wide
from palpate.report.notes import digits_of, number
from palpate.report.plots import Axis, axis_of, ticks_of
from palpate.report.study import Curve, Line
from palpate.report.study_tables import Row, Sheet

#: Units of a curve: the whole width, the plot's height, and the places of its edges.
WIDTH, PLOT, TOP, RIGHT = 400.0, 200.0, 26.0, 392.0
#: Colors of lines; dashes and markers go on when they begin again.
INKS = tuple(f"line{k}" for k in range(1, 7))
#: Units of a strip: label, axis and number.
STRIP, LABEL, AXIS, ROW = 640.0, 212.0, 240.0, 20.0
#: Most different x that are all labeled.
LABELED = 8


@dataclass(frozen=True)
class Scale:
    """One axis of a curve: units of the drawing at a value, and the values to label."""

    at: Callable[[float], float]
    ticks: Sequence[tuple[float, str]]


def curve_drawing(curve: Curve) -> Drawing:
    """Draw a curve: lines with markers, intervals as bands, and a legend below.

    A point without a finite score interrupts its line; an interval without a neighbor is a bar.
    """
    lines = [(k, line, _points(line)) for k, line in enumerate(curve.lines)]
    scores = [(x, score) for _, _, points in lines for x, score in points]
    bottom = TOP + PLOT
    y = _y_scale([score for _, score in scores], bottom)
    left = 12 + max((wide(text) for _, text in y.ticks), default=0)
    x = _x_scale([value for value, _ in scores], curve.log_x, left)
    parts: list[Shape | Words] = []
    for value, text in y.ticks:
        parts.append(Shape([(left, y.at(value)), (RIGHT, y.at(value))], "line"))
        parts.append(Words(left - 6, y.at(value) + 4, text, "end"))
    for value, text in x.ticks:
        parts.append(Shape([(x.at(value), bottom), (x.at(value), bottom + 4)], "soft"))
        parts.append(Words(_middle(x.at(value), text), bottom + 17, text, "middle"))
    parts.append(Words(2, 13, lines_of(curve.y, WIDTH - 4, most=1)[0], ink="ink"))
    label = lines_of(curve.x, RIGHT, most=1)[0]
    parts.append(Words(RIGHT, bottom + 33, label, "end", ink="ink"))
    drawn = [(k, points) for k, _, points in lines]
    for k, points in drawn:
        parts += _bands(k, points, x, y, 0.16 if len(drawn) < 4 else 0.08)
    for k, points in drawn:
        parts += _line(k, points, x, y)
    legend, height = _legend([line.label for line in curve.lines], bottom + 48)
    names = ", ".join(line.label for line in curve.lines)
    about = f"{curve.title}: {curve.y} over {curve.x}. Lines: {names}."
    return Drawing(WIDTH, height, [*parts, *legend], about)


def _points(line: Line) -> list[tuple[float, Score]]:
    return [(x, score) for x, score in sorted(line.points, key=lambda p: p[0]) if math.isfinite(x)]


def _y_scale(scores: Sequence[Score], bottom: float) -> Scale:
    """Bounds as those of a column of strips: all intervals, and zero if it is near."""
    axis = axis_of([Score("", "", s.value, s.interval) for s in scores])
    low, high = (axis.low, axis.high) if axis else (0.0, 1.0)
    ticks, digits = ticks_of(low, high, 5)
    at: Callable[[float], float] = lambda v: bottom - (v - low) / (high - low) * PLOT
    return Scale(at, [(tick, number(tick, digits)) for tick in ticks])


def _x_scale(values: Sequence[float], log: bool, left: float) -> Scale:
    """The values themselves are labeled where they are few, else round numbers."""
    several = sorted(set(values)) or [0.0, 1.0]
    log = log and several[0] > 0
    form: Callable[[float], float] = math.log10 if log else float
    low, high = form(several[0]), form(several[-1])
    if high - low < 1e-12:
        low, high = low - 0.5, high + 0.5
    start, end = left + 8, RIGHT - 8
    at: Callable[[float], float] = lambda v: start + (form(v) - low) / (high - low) * (end - start)
    if len(several) <= LABELED:
        ticks = [(v, f"{v:g}") for v in several]
    elif log:
        powers = range(math.ceil(low - 1e-9), math.floor(high + 1e-9) + 1)
        ticks = [(10.0**p, f"{10.0**p:g}") for p in powers]
    else:
        steps, digits = ticks_of(low, high, 6)
        ticks = [(v, number(v, digits)) for v in steps]
    return Scale(at, _apart(ticks, at))


def _apart(
    ticks: Sequence[tuple[float, str]], at: Callable[[float], float]
) -> list[tuple[float, str]]:
    """The labels that lie on no other one, from the left."""
    kept: list[tuple[float, str]] = []
    edge = -math.inf
    for value, text in ticks:
        middle, half = _middle(at(value), text), wide(text) / 2
        if middle - half > edge + 4:
            kept.append((value, text))
            edge = middle + half
    return kept


def _middle(x: float, text: str) -> float:
    """Where the middle of a label is, so that it ends within the drawing."""
    return min(x, WIDTH - wide(text) / 2)


def _bands(
    k: int, points: Sequence[tuple[float, Score]], x: Scale, y: Scale, opacity: float
) -> list[Shape]:
    parts: list[Shape] = []
    for run in _runs(points, lambda s: s.value is not None and s.interval is not None):
        edges = [(x.at(v), *map(y.at, s.interval or ())) for v, s in run]
        if len(run) > 1:
            around = [(px, low) for px, low, _ in edges]
            around += [(px, high) for px, _, high in reversed(edges)]
            parts.append(Shape(around, INKS[k % len(INKS)], fill=True, opacity=opacity))
        else:
            ((px, low, high),) = edges
            ends = [[(px - 4, v), (px + 4, v)] for v in (low, high)]
            parts += [
                Shape(line, INKS[k % len(INKS)], width=1.4)
                for line in ([(px, low), (px, high)], *ends)
            ]
    return parts


def _line(k: int, points: Sequence[tuple[float, Score]], x: Scale, y: Scale) -> list[Shape]:
    ink, parts, marks = INKS[k % len(INKS)], [], []
    for run in _runs(points, lambda s: s.value is not None and math.isfinite(s.value)):
        places = [(x.at(v), y.at(float(s))) for v, s in run]
        if len(run) > 1:
            parts.append(Shape(places, ink, width=2, dash=DASHES[k % len(DASHES)]))
        marks += [shape for place in places for shape in marker(k, *place, ink)]
    return [*parts, *marks]


def _runs(
    points: Sequence[tuple[float, Score]], usable: Callable[[Score], bool]
) -> list[list[tuple[float, Score]]]:
    """Neighbors that are usable, together."""
    runs: list[list[tuple[float, Score]]] = [[]]
    for point in points:
        if usable(point[1]):
            runs[-1].append(point)
        elif runs[-1]:
            runs.append([])
    return [run for run in runs if run]


def _legend(labels: Sequence[str], top: float) -> tuple[list[Shape | Words], float]:
    """A sample of each line with its label, in two columns where all labels are short."""
    room = (WIDTH / 2 if all(wide(label) < 160 for label in labels) else WIDTH) - 48
    across = 2 if room < WIDTH / 2 else 1
    parts: list[Shape | Words] = []
    y = top
    for first in range(0, len(labels), across):
        deepest = 1
        for k in range(first, min(first + across, len(labels))):
            left = (k - first) * WIDTH / 2 + 4
            ink = INKS[k % len(INKS)]
            sample = [(left, y + 5), (left + 32, y + 5)]
            parts.append(Shape(sample, ink, width=2, dash=DASHES[k % len(DASHES)]))
            parts += marker(k, left + 16, y + 5, ink)
            texts = lines_of(labels[k], room)
            parts += [
                Words(left + 40, y + 9 + 15 * n, text, ink="ink") for n, text in enumerate(texts)
            ]
            deepest = max(deepest, len(texts))
        y += 15 * deepest + 4
    return parts, y + 2


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
        if rows and len({score.metric for _, score, _ in rows}) == 1:
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
        parts.append(
            Words(0, y + 12, lines_of(panel.title, STRIP, most=1)[0], ink="ink", bold=True)
        )
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
    yield Words(0, mid + 4, lines_of(label, LABEL - 6, most=1)[0], ink="ink")
    text = "undefined"
    if axis is not None:
        yield Shape([(LABEL, mid), (LABEL + AXIS, mid)], "line")
        yield from _band(score, axis, mid)
    if axis is not None and score.value is not None and math.isfinite(score.value):
        text = number(score.value, digits)
        if score.interval:
            low, high = (_place(axis, v) for v in score.interval)
            yield Shape([(low, mid), (high, mid)], "line1", width=1.8)
            for end in (low, high):
                yield Shape([(end, mid - 4), (end, mid + 4)], "line1", width=1.4)
            text += f" [{', '.join(number(v, digits) for v in score.interval)}]"
        yield from _dot(axis, float(score), control, mid)
    yield Words(LABEL + AXIS + 12, mid + 4, text, ink="ink")


def _dot(axis: Axis, value: float, control: bool, mid: float) -> Iterable[Shape]:
    x, way = _place(axis, value), (value > axis.high) - (value < axis.low)
    if way:
        yield Shape([(x, mid - 5), (x + 8 * way, mid), (x, mid + 5)], "line1", fill=True)
    else:
        yield from marker(len(MARKERS) if control else 0, x, mid, "line1")


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
