"""Inline SVG: interval bars on one axis a column, the histogram of gaps, and the two histograms of a calibrated signal.

Every drawing takes its colors from the page's CSS (classes, no inline color), so light, dark and print agree.
The interval bar maps x to ``pad + (x - low) / (high - low) * (width - 2 pad)`` pixels. The histograms have no
``viewBox``: their lengths are percentages, so text keeps its size on a phone and on a desk.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from markupsafe import Markup, escape

from palpate.core import Score
from palpate.report.results import Audit, Signal
from palpate.report.text import count, number, score_text

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
    """The axis that holds values, intervals, nulls and floors of one column; None if nothing is defined."""
    seen: list[float] = []
    for s in scores:
        seen += [
            v for v in (s.value, s.floor, *(s.interval or ()), *(s.null or ())) if v is not None
        ]
    return axis_over(seen)


def axis_over(values: Sequence[float]) -> Axis | None:
    """The axis that holds all finite ``values``; None if there are none. Zero is put on it whenever they come near it."""
    seen = [v for v in values if math.isfinite(v)]
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
    ticks = [
        round(k * step, 12)
        for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ]
    margin = 0.02 * (high - low)
    return Axis(low - margin, high + margin, ticks, max(0, -math.floor(math.log10(step) + 1e-9)))


def interval_bar(score: Score, axis: Axis) -> Markup:
    """The score as a dot, its interval as a line, its null as a band and its floor as a dashed tick."""
    return bar(axis, score.value, score.interval, null=score.null, floor=score.floor)


def bar(
    axis: Axis,
    value: float | None,
    interval: tuple[float, float] | None,
    *,
    null: tuple[float, float] | None = None,
    floor: float | None = None,
) -> Markup:
    """A value with what belongs to it on ``axis``; what is None or not finite is left out.

    The same numbers stand beside it as text, so it is hidden from screen readers.
    """
    mid = HEIGHT / 2
    parts = [f'<line class="rail" x1="{PAD}" x2="{WIDTH - PAD}" y1="{mid}" y2="{mid}"/>']
    if null and all(math.isfinite(v) for v in null):
        a, b = (axis.x(v) for v in null)
        parts.append(
            f'<rect class="null" x="{min(a, b) - 0.75:.2f}" y="3" width="{abs(b - a) + 1.5:.2f}" height="{HEIGHT - 6}" rx="1.5"/>'
        )
    if floor is not None and math.isfinite(floor):
        x = axis.x(floor)
        parts.append(f'<line class="floor" x1="{x}" x2="{x}" y1="1" y2="{HEIGHT - 1}"/>')
    if interval and all(math.isfinite(v) for v in interval):
        a, b = (axis.x(v) for v in interval)
        parts.append(f'<path class="interval" d="M{a} {mid}H{b}M{a} {mid - 4}v8M{b} {mid - 4}v8"/>')
    if value is not None and math.isfinite(value):
        parts.append(f'<circle class="value" cx="{axis.x(value)}" cy="{mid}" r="4"/>')
    return Markup(
        f'<svg class="bar" width="{WIDTH}" height="{HEIGHT}" aria-hidden="true" focusable="false">{"".join(parts)}</svg>'
    )


def axis_row(axis: Axis) -> Markup:
    """The labeled axis below a column of interval bars."""
    parts = [f'<line class="rail" x1="{PAD}" x2="{WIDTH - PAD}" y1="1" y2="1"/>']
    for tick in axis.ticks:
        x = axis.x(tick)
        text = number(tick, axis.digits)
        half = 3.6 * len(text)  # of the label at 12 px; kept inside the drawing
        at = min(max(x, half), WIDTH - half)
        parts.append(f'<line class="tick" x1="{x}" x2="{x}" y1="1" y2="5"/>')
        parts.append(f'<text x="{at:.2f}" y="17" text-anchor="middle">{text}</text>')
    return Markup(
        f'<svg class="bar axis" width="{WIDTH}" height="20" aria-hidden="true" focusable="false">{"".join(parts)}</svg>'
    )


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


def _reach(edges: Sequence[int], least: float | None, middle: float, most: float | None) -> str:
    """A line from the least to the greatest value with a dot at the middle, above the bars; '' if one is unknown."""
    places = [_edge_position(edges, v) for v in (least, middle, most) if v is not None]
    if len(places) < 3 or None in places:
        return ""
    a, m, b = places
    ends = "".join(
        f'<line class="reach" x1="{x:.3f}%" x2="{x:.3f}%" y1="20" y2="28"/>' for x in (a, b)
    )
    return f'<line class="reach" x1="{a:.3f}%" x2="{b:.3f}%" y1="24" y2="24"/>{ends}<circle class="value" cx="{m:.3f}%" cy="24" r="3.5"/>'


def gap_histogram(audit: Audit) -> Markup:
    """Bars of the gaps between test frames and their nearest train frame; '' if the audit has none.

    One bar a bin, all equally wide, with the edges labeled below; the median is a dashed line, and a line above the bars
    reaches from the least gap to the most.

    Args:
        audit: ``gap_edges`` (frames) one longer than ``gap_counts`` (test samples).
    """
    edges, counts = list(audit.gap_edges), list(audit.gap_counts)
    if not counts or len(edges) != len(counts) + 1 or max(counts) <= 0:
        return Markup("")
    top, bottom = 38.0, 172.0
    step = max(1.0, nice_step(max(counts), 3))
    ceiling = step * math.ceil(max(counts) / step)
    wide = (_RIGHT - _LEFT) / len(counts)
    y = lambda v: bottom - (bottom - top) * v / ceiling  # noqa: E731
    parts: list[str] = []
    for k in range(int(ceiling / step) + 1):
        parts.append(
            f'<line class="grid" x1="{_LEFT}%" x2="{_RIGHT}%" y1="{y(k * step):.1f}" y2="{y(k * step):.1f}"/>'
        )
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
        parts.append(
            f'<line class="tick" x1="{x:.3f}%" x2="{x:.3f}%" y1="{bottom}" y2="{bottom + 4}"/>'
        )
        parts.append(
            f'<text x="{x:.3f}%" y="{bottom + 18}" text-anchor="{anchor}">{count(edges[k])}</text>'
        )
    middle = audit.gap_median
    if middle is not None and (x := _edge_position(edges, middle)) is not None:
        anchor, shift = ("end", -1) if x > 60 else ("start", 1)
        parts.append(f'<line class="median" x1="{x:.3f}%" x2="{x:.3f}%" y1="8" y2="{bottom}"/>')
        parts.append(
            f'<text class="median-label" x="{x + shift:.3f}%" y="14" text-anchor="{anchor}">median {number(middle, 0)}</text>'
        )
        parts.append(_reach(edges, audit.gap_min, middle, audit.gap_max))
    parts.append(
        f'<text class="xlabel" x="{_RIGHT}%" y="{bottom + 36}" text-anchor="end">frames to the nearest train frame</text>'
    )
    label = escape(
        f"Histogram of gaps for {audit.name}: {count(sum(counts))} test samples, {count(edges[0])} to {count(edges[-1])} frames"
        + (f", median {number(middle, 0)}" if middle is not None else "")
    )
    return Markup(
        f'<svg class="histogram" width="100%" height="214" role="img" aria-label="{label}">{"".join(parts)}</svg>'
    )


#: Most bars in a histogram of scores; finer bins are joined.
BARS = 48
_PANEL, _TOP, _BETWEEN = (
    70.0,
    44.0,
    30.0,
)  # pixels: height of a panel, above the first, between the two


@dataclass(frozen=True)
class Bins:
    """The two histograms of a calibrated signal over the same bins, cut to where anything lies.

    Attributes:
        edges: ascending scores, one more than there are bins.
        unrelated, matches: counts of unrelated matches and of test samples; ``unrelated`` may be empty.
    """

    edges: Sequence[float]
    unrelated: Sequence[int]
    matches: Sequence[int]

    @property
    def even(self) -> bool:
        """Whether all bins are equally wide, so that heights are shares."""
        widths = [b - a for a, b in pairwise(self.edges)]
        return max(widths) - min(widths) <= 1e-6 * max(widths)


def bins_of(signal: Signal) -> Bins | None:
    """The signal's histograms as they are drawn: at most :data:`BARS` bins, none empty at the ends; None if there are none.

    Neighboring bins are joined where there are too many; the bin of the threshold is always kept.
    """
    edges, unrelated, found = list(signal.edges), list(signal.unrelated), list(signal.matches)
    fits = (
        len(edges) == len(found) + 1
        and len(unrelated) in (0, len(found))
        and all(a < b for a, b in pairwise(edges))
    )
    if (
        not fits
        or not found
        or not all(map(math.isfinite, (*edges, signal.threshold)))
        or sum(found) + sum(unrelated) <= 0
    ):
        return None
    size = len(found)
    full = [k for k in range(size) if found[k] or (unrelated and unrelated[k])]
    full += [min(max(bisect_right(edges, signal.threshold) - 1, 0), size - 1)]
    first, last = min(full), max(full) + 1
    step = math.ceil((last - first) / BARS)
    first = max(0, first - (first - last) % step)  # whole steps, so that even bins stay even
    last = min(size, last + (first - last) % step)
    starts = list(range(first, last, step))
    join = lambda counts: [sum(counts[k : min(k + step, last)]) for k in starts] if counts else []  # noqa: E731
    return Bins([*(edges[k] for k in starts), edges[last]], join(unrelated), join(found))


def _heights(counts: Sequence[int], bins: Bins) -> list[float]:
    """The share of all counts in each bin; in bins of unequal width, per width."""
    total = sum(counts) or 1
    return [
        n / total / (1.0 if bins.even else b - a)
        for n, (a, b) in zip(counts, pairwise(bins.edges), strict=True)
    ]


def score_histogram(signal: Signal, said: str, other: str = "train") -> Markup:
    """Scores of unrelated matches above, of the test samples' best matches below, on one axis with the threshold; '' if there are none.

    Each panel has its own scale, in shares of its own samples. Bars of test samples are strong from the threshold on; the bin
    that the threshold cuts is drawn in both strengths.

    Args:
        signal: ``edges`` (scores), ``unrelated`` and ``matches`` (counts), ``threshold``.
        said: the drawing in words, for those who do not see it.
        other: what the test samples were compared with.
    """
    bins = bins_of(signal)
    if bins is None:
        return Markup("")
    low, high = bins.edges[0], bins.edges[-1]
    at = lambda v: _LEFT + (min(max(v, low), high) - low) / (high - low) * (_RIGHT - _LEFT)  # noqa: E731
    panels = [("unrelated samples", "apart", bins.unrelated)] if bins.unrelated else []
    panels.append((f"test against {other}", "found", bins.matches))
    parts: list[str] = []
    bottom = _TOP
    for k, (name, kind, counts) in enumerate(panels):
        bottom = _TOP + _PANEL + k * (_PANEL + _BETWEEN)
        parts += _panel(
            f"{name} ({count(sum(counts))})", kind, counts, bins, bottom, at, signal.threshold
        )
    digits = _digits(step := nice_step(high - low, 6))
    for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1):
        x = at(k * step)
        anchor = "end" if x > 95 else "middle"
        parts.append(
            f'<line class="tick" x1="{x:.3f}%" x2="{x:.3f}%" y1="{bottom}" y2="{bottom + 4}"/>'
        )
        parts.append(
            f'<text x="{x:.3f}%" y="{bottom + 18}" text-anchor="{anchor}">{number(k * step, digits)}</text>'
        )
    parts.append(
        f'<text class="xlabel" x="{_RIGHT}%" y="{bottom + 36}" text-anchor="end">score of the best match; 1 = the same</text>'
    )
    x = at(signal.threshold)
    anchor, shift = ("end", -1) if x > 60 else ("start", 1)
    label = f"flagged from {score_text(signal.threshold)}"
    parts.append(f'<line class="median" x1="{x:.3f}%" x2="{x:.3f}%" y1="4" y2="{bottom}"/>')
    parts.append(
        f'<text class="median-label" x="{x + shift:.3f}%" y="14" text-anchor="{anchor}">{label}</text>'
    )
    height = bottom + 42
    return Markup(
        f'<svg class="histogram" width="100%" height="{height:.0f}" role="img" aria-label="{escape(said)}">{"".join(parts)}</svg>'
    )


def _digits(step: float) -> int:
    return max(0, -math.floor(math.log10(step) + 1e-9))


def _panel(
    name: str,
    kind: str,
    counts: Sequence[int],
    bins: Bins,
    bottom: float,
    at: Callable[[float], float],
    threshold: float,
) -> list[str]:
    """One histogram of scores: its name, its scale and its bars; a bin that is not empty is at least a pixel high."""
    heights = _heights(counts, bins)
    step = nice_step(max(heights) or 1.0, 4)
    ceiling = step * math.ceil(max(heights) / step - 1e-9) or 1.0
    top = bottom - _PANEL
    parts = [
        f'<line class="grid" x1="{_LEFT}%" x2="{_RIGHT}%" y1="{y}" y2="{y}"/>'
        for y in (top, bottom)
    ]
    if bins.even:
        parts.append(
            f'<text class="ylabel" x="{_LEFT - 1.5}%" y="{top + 4}" text-anchor="end">{number(100 * ceiling, _digits(100 * step))}\u00a0%</text>'
        )
        parts.append(
            f'<text class="ylabel" x="{_LEFT - 1.5}%" y="{bottom + 4}" text-anchor="end">0</text>'
        )
    for n, share, (a, b) in zip(counts, heights, pairwise(bins.edges), strict=True):
        if not n:
            continue
        tall = max(1.0, _PANEL * share / ceiling)
        pieces = [(a, b, kind)]
        if kind == "found":
            cut = min(max(threshold, a), b)
            pieces = [(a, cut, "below"), (cut, b, "column")]
        for start, end, name_of in pieces:
            if end > start:
                edge = 0.06 * (at(b) - at(a))
                x, wide = (
                    at(start) + edge * (start == a),
                    at(end) - at(start) - edge * ((start == a) + (end == b)),
                )
                parts.append(
                    f'<rect class="{name_of}" x="{x:.3f}%" width="{max(wide, 0.05):.3f}%" y="{bottom - tall:.1f}" height="{tall:.1f}">'
                    f"<title>{score_text(a)} to {score_text(b)}: {count(n)}</title></rect>"
                )
    parts.append(f'<text class="panel" x="{_LEFT}%" y="{top - 7}">{escape(name)}</text>')
    return parts
