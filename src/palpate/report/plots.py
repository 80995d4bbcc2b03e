"""Inline SVG: interval bars on one axis a column, and the histogram of gaps.

Every drawing takes its colours from the page's CSS (classes, no inline colour), so light, dark and print agree.
The interval bar maps x to ``pad + (x - low) / (high - low) * (width - 2 pad)`` pixels. The histogram has no
``viewBox``: its lengths are percentages, so text keeps its size on a phone and on a desk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from markupsafe import Markup, escape

from palpate.core import Audit, Score
from palpate.report.text import count, number

WIDTH, HEIGHT, PAD = 148, 22, 7
_LEFT, _RIGHT = 13.0, 99.0  # per cent of the histogram's width


@dataclass(frozen=True)
class Axis:
    """A common axis: bounds and the ticks to label, in units of the score."""

    low: float
    high: float
    ticks: Sequence[float]
    digits: int

    def x(self, value: float) -> float:
        """Pixels from the left edge of the drawing; values outside are put on the edge."""
        share = (value - self.low) / (self.high - self.low)
        return round(PAD + min(1.0, max(0.0, share)) * (WIDTH - 2 * PAD), 2)


def nice_step(span: float, parts: int) -> float:
    """The smallest of 1, 2, 5 times a power of ten that cuts ``span`` > 0 into at most ``parts`` steps."""
    raw = span / parts
    power = 10.0 ** math.floor(math.log10(raw))
    return next((m * power for m in (1, 2, 5) if m * power >= raw * (1 - 1e-9)), 10 * power)


def axis_of(scores: Sequence[Score]) -> Axis | None:
    """The axis that holds values, intervals, nulls and floors of one column; None if nothing is defined.

    Zero is put on the axis whenever the data comes near it.
    """
    seen: list[float] = []
    for s in scores:
        seen += [v for v in (s.value, s.floor, *(s.interval or ()), *(s.null or ())) if v is not None and math.isfinite(v)]
    if not seen:
        return None
    low, high = min(seen), max(seen)
    if 0 < low < 0.4 * high:
        low = 0.0
    if low > 0.4 * high and high < 0:
        high = 0.0
    if high - low <= 1e-12 * max(abs(high), abs(low), 1e-300):
        margin = abs(high) * 0.1 or 1.0
        low, high = low - margin, high + margin
    step = nice_step(high - low, 3)
    ticks = [round(k * step, 12) for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]
    margin = 0.02 * (high - low)
    return Axis(low - margin, high + margin, ticks, max(0, -math.floor(math.log10(step) + 1e-9)))


def interval_bar(score: Score, axis: Axis) -> Markup:
    """The score as a dot, its interval as a line, its null as a band and its floor as a dashed tick.

    The same numbers stand beside it as text, so it is hidden from screen readers.
    """
    mid = HEIGHT / 2
    parts = [f'<line class="rail" x1="{PAD}" x2="{WIDTH - PAD}" y1="{mid}" y2="{mid}"/>']
    if score.null and all(math.isfinite(v) for v in score.null):
        a, b = (axis.x(v) for v in score.null)
        parts.append(f'<rect class="null" x="{min(a, b) - 0.75:.2f}" y="3" width="{abs(b - a) + 1.5:.2f}" height="{HEIGHT - 6}" rx="1.5"/>')
    if score.floor is not None and math.isfinite(score.floor):
        x = axis.x(score.floor)
        parts.append(f'<line class="floor" x1="{x}" x2="{x}" y1="1" y2="{HEIGHT - 1}"/>')
    if score.interval and all(math.isfinite(v) for v in score.interval):
        a, b = (axis.x(v) for v in score.interval)
        parts.append(f'<path class="interval" d="M{a} {mid}H{b}M{a} {mid - 4}v8M{b} {mid - 4}v8"/>')
    if score.value is not None and math.isfinite(score.value):
        parts.append(f'<circle class="value" cx="{axis.x(score.value)}" cy="{mid}" r="4"/>')
    return Markup(f'<svg class="bar" width="{WIDTH}" height="{HEIGHT}" aria-hidden="true" focusable="false">{"".join(parts)}</svg>')


def axis_row(axis: Axis) -> Markup:
    """The labelled axis below a column of interval bars."""
    parts = [f'<line class="rail" x1="{PAD}" x2="{WIDTH - PAD}" y1="1" y2="1"/>']
    for tick in axis.ticks:
        x = axis.x(tick)
        text = number(tick, axis.digits)
        half = 3.6 * len(text)  # of the label at 12 px; kept inside the drawing
        at = min(max(x, half), WIDTH - half)
        parts.append(f'<line class="tick" x1="{x}" x2="{x}" y1="1" y2="5"/>')
        parts.append(f'<text x="{at:.2f}" y="17" text-anchor="middle">{text}</text>')
    return Markup(f'<svg class="bar axis" width="{WIDTH}" height="20" aria-hidden="true" focusable="false">{"".join(parts)}</svg>')


def _edge_position(edges: Sequence[int], value: float) -> float | None:
    """Per cent of the width at which ``value`` lies, linear inside each bin; None if it lies outside the edges."""
    bins = len(edges) - 1
    for k, (a, b) in enumerate(pairwise(edges)):
        if a <= value <= b:
            return _LEFT + (k + ((value - a) / (b - a) if b > a else 0.0)) / bins * (_RIGHT - _LEFT)
    return None


def _marks(edges: Sequence[int]) -> list[int]:
    """Which edges to label: at most six, the first and the last among them."""
    bins = len(edges) - 1
    every = max(1, math.ceil(bins / 5))
    marks = [k for k in range(0, bins, every) if bins - k >= every or k == 0]
    return [*marks, bins]


def _tick(value: int, step: int) -> str:
    return f"{value // 1000:,}k" if value and step % 1000 == 0 else count(value)


def uneven(edges: Sequence[int]) -> bool:
    """Whether bins differ in width; the last may be cut short."""
    return len({b - a for a, b in pairwise(edges[:-1])}) > 1


def gap_histogram(audit: Audit) -> Markup:
    """Bars of the gaps between test frames and their nearest train frame; '' if the audit has none.

    One bar a bin, all equally wide, with the edges labelled below; the median is a dashed line.

    Args:
        audit: ``gap_edges`` (frames) one longer than ``gap_counts`` (test samples).
    """
    edges, counts = list(audit.gap_edges), list(audit.gap_counts)
    if not counts or len(edges) != len(counts) + 1 or max(counts) <= 0:
        return Markup("")
    top, bottom = 30.0, 172.0
    step = max(1.0, nice_step(max(counts), 3))
    ceiling = step * math.ceil(max(counts) / step)
    wide = (_RIGHT - _LEFT) / len(counts)
    y = lambda v: bottom - (bottom - top) * v / ceiling  # noqa: E731
    parts: list[str] = []
    for k in range(int(ceiling / step) + 1):
        parts.append(f'<line class="grid" x1="{_LEFT}%" x2="{_RIGHT}%" y1="{y(k * step):.1f}" y2="{y(k * step):.1f}"/>')
        parts.append(
            f'<text class="ylabel" x="{_LEFT - 1.5}%" y="{y(k * step) + 4:.1f}" text-anchor="end">{_tick(int(k * step), int(step))}</text>'
        )
    for k, n in enumerate(counts):
        last = k == len(counts) - 1
        said = f"{count(edges[k])} to {count(edges[k + 1])} frames{'' if last else ' (exclusive)'}: {count(n)}"
        parts.append(
            f'<rect class="column" x="{_LEFT + (k + 0.06) * wide:.3f}%" width="{0.88 * wide:.3f}%" '
            f'y="{y(n):.1f}" height="{bottom - y(n):.1f}"><title>{said}</title></rect>'
        )
    for k in _marks(edges):
        x = _LEFT + k * wide
        anchor = "end" if k == len(counts) else "middle"
        parts.append(f'<line class="tick" x1="{x:.3f}%" x2="{x:.3f}%" y1="{bottom}" y2="{bottom + 4}"/>')
        parts.append(f'<text x="{x:.3f}%" y="{bottom + 18}" text-anchor="{anchor}">{count(edges[k])}</text>')
    middle = audit.gap_median
    if middle is not None and (x := _edge_position(edges, middle)) is not None:
        anchor, shift = ("end", -1) if x > 60 else ("start", 1)
        parts.append(f'<line class="median" x1="{x:.3f}%" x2="{x:.3f}%" y1="14" y2="{bottom}"/>')
        parts.append(f'<text class="median-label" x="{x + shift:.3f}%" y="20" text-anchor="{anchor}">median {number(middle, 0)}</text>')
    parts.append(f'<text class="xlabel" x="{_RIGHT}%" y="{bottom + 36}" text-anchor="end">frames to the nearest train frame</text>')
    label = escape(
        f"Histogram of gaps for {audit.name}: {count(sum(counts))} test samples, {count(edges[0])} to {count(edges[-1])} frames"
        + (f", median {number(middle, 0)}" if middle is not None else "")
    )
    return Markup(f'<svg class="histogram" width="100%" height="214" role="img" aria-label="{label}">{"".join(parts)}</svg>')
