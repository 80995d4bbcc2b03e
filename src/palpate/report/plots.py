"""Inline SVG: interval bars on one axis a column, and histograms of gaps and of scores.

Colors come from the page's CSS (classes), so light, dark and print agree. Histograms have no
``viewBox``: their lengths are percentages, so text keeps its size on a phone and on a desk.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from markupsafe import Markup, escape

from palpate.core import Score
from palpate.report.labels import count, number, score_text
from palpate.report.records import Signal
from palpate.report.results import Audit

WIDTH, HEIGHT, PAD = 148, 22, 7  # pixels of an interval bar
LEFT, RIGHT = 13.0, 99.0  # percent of a histogram's width
PANEL, TOP, BETWEEN = 70.0, 44.0, 30.0  # pixels of a histogram's panels
#: Most bars in a histogram of scores; finer bins are joined.
MAX_BARS = 48


@dataclass(frozen=True)
class Axis:
    """A common axis: bounds and the ticks to label, in units of the score."""

    low: float
    high: float
    ticks: Sequence[float]
    digits: int
    width: float = WIDTH

    def x(self, value: float) -> float:
        """Return pixels from the left edge; values outside are put on the edge."""
        share = (value - self.low) / (self.high - self.low)
        return round(PAD + min(1.0, max(0.0, share)) * (self.width - 2 * PAD), 2)


def nice_step(span: float, parts: int) -> float:
    """Return the least 1, 2, 5 times a power of ten that cuts ``span`` into at most ``parts``."""
    power = 10.0 ** math.floor(math.log10(span / parts))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= span / parts * (1 - 1e-9))


def ticks_of(low: float, high: float, parts: int) -> tuple[list[float], int]:
    """Return round numbers in [low, high] and their decimals."""
    step = nice_step(high - low, parts)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return [round(k * step, 12) for k in range(first, last + 1)], digits


def axis_over(values: Iterable[float | None], parts: int = 3, width: float = WIDTH) -> Axis | None:
    """Return the axis that holds all finite ``values``, with zero if they come near it.

    Args:
        values: in units of the score.
        parts: most parts that its ticks cut it into.
        width: in pixels.
    """
    finite = [v for v in values if v is not None and math.isfinite(v)]
    if not finite:
        return None
    low, high = min(finite), max(finite)
    if 0 < low < 0.4 * high:
        low = 0.0
    elif 0.4 * low < high < 0:
        high = 0.0
    if high - low <= 1e-12 * max(abs(high), abs(low), 1e-300):
        margin = abs(high) * 0.1 or 1.0
        low, high = low - margin, high + margin
    margin = 0.02 * (high - low)
    low, high = low - margin, high + margin
    return Axis(low, high, *ticks_of(low, high, parts), width)


def axis_of(scores: Iterable[Score], parts: int = 3, width: float = WIDTH) -> Axis | None:
    """Return the axis that holds values, intervals, nulls and floors of scores."""
    values = (v for s in scores for v in (s.value, s.floor, *(s.interval or ()), *(s.null or ())))
    return axis_over(values, parts, width)


def bar(
    axis: Axis | None,
    value: float | None,
    interval: tuple[float, float] | None,
    null: tuple[float, float] | None = None,
    mark: float | None = None,
    *,
    at: tuple[float, float] = (0, 0),
    hollow: bool = False,
) -> Markup:
    """Draw a value with its interval and null band on ``axis``, and a mark: the floor, or chance.

    The same numbers are next to it as text, so it is hidden from screen readers. ``at`` is where it
    is in another drawing. A value beyond the axis is an arrow.
    """
    if axis is None:
        return Markup("")
    mid = HEIGHT / 2
    parts = [f'<line class="rail" x1="{PAD}" x2="{axis.width - PAD}" y1="{mid}" y2="{mid}"/>']
    if null:
        a, b = sorted(map(axis.x, null))
        parts.append(
            f'<rect class="null" x="{a - 0.75:.2f}" y="3" width="{b - a + 1.5:.2f}" '
            f'height="{HEIGHT - 6}" rx="1.5"/>'
        )
    if mark is not None:
        x = axis.x(mark)
        parts.append(f'<line class="floor" x1="{x}" x2="{x}" y1="1" y2="{HEIGHT - 1}"/>')
    if interval:
        a, b = map(axis.x, interval)
        parts.append(f'<path class="interval" d="M{a} {mid}H{b}M{a} {mid - 4}v8M{b} {mid - 4}v8"/>')
    if value is not None and axis.low <= value <= axis.high:
        name = "value hollow" if hollow else "value"
        parts.append(f'<circle class="{name}" cx="{axis.x(value)}" cy="{mid}" r="4"/>')
    elif value is not None:
        tip = 6 if value > axis.high else -6
        parts.append(f'<path class="value" d="M{axis.x(value)} {mid - 5}l{tip} 5l{-tip} 5z"/>')
    return _svg("bar", axis.width, HEIGHT, parts, at=at)


def share_bar(share: float) -> Markup:
    """Draw a share in [0, 1] as a bar as wide as its place; a leak of any size can be seen."""
    rail = '<rect class="rest" width="100%" height="10" rx="2"/>'
    leak = f'<rect class="leaked" width="{max(100 * share, 0.8):.3f}%" height="10" rx="2"/>'
    return _svg("share", "100%", 10, [rail, leak] if share > 0 else [rail])


def axis_row(axis: Axis | None, at: tuple[float, float] = (0, 0)) -> Markup:
    """Draw the labeled axis below a column of bars."""
    if axis is None:
        return Markup("")
    parts = [f'<line class="rail" x1="{PAD}" x2="{axis.width - PAD}" y1="1" y2="1"/>']
    for tick in axis.ticks:
        x, text = axis.x(tick), number(tick, axis.digits)
        half = 3.6 * len(text)  # of the label at 12 px
        label = min(max(x, half), axis.width - half)
        parts.append(f'<line class="tick" x1="{x}" x2="{x}" y1="1" y2="5"/>')
        parts.append(f'<text x="{label:.2f}" y="17" text-anchor="middle">{text}</text>')
    return _svg("bar axis", axis.width, 20, parts, at=at)


def _svg(
    name: str,
    width: float | str,
    height: float,
    parts: Iterable[str],
    *,
    label: str = "",
    at: tuple[float, float] = (0, 0),
) -> Markup:
    role = f'role="img" aria-label="{escape(label)}"' if label else 'aria-hidden="true"'
    size = f'width="{width}" height="{height:.0f}" {role} focusable="false"'
    size += f' x="{at[0]:g}" y="{at[1]:g}"' * any(at)
    return Markup(f'<svg class="{name}" {size}>{"".join(parts)}</svg>')


@dataclass(frozen=True)
class Bars:
    """One histogram: a name, heights of its bars with what each is, and the top of its scale."""

    name: str
    heights: Sequence[float]
    titles: Sequence[str]
    kinds: Sequence[str]
    top: str


def _histogram(
    panels: Sequence[Bars],
    positions: Sequence[float],
    *,
    ticks: Sequence[tuple[float, str]],
    marker: tuple[float, str] | None,
    xlabel: str,
    label: str,
) -> Markup:
    """Draw panels above one another; ``positions`` of edges, ticks and marker lie in [0, 1]."""

    def at(share: float) -> float:
        return LEFT + share * (RIGHT - LEFT)

    parts: list[str] = []
    bottom = TOP
    for k, panel in enumerate(panels):
        bottom = TOP + PANEL + k * (PANEL + BETWEEN)
        for y, text in ((bottom - PANEL, panel.top), (bottom, "0")):
            parts.append(f'<line class="grid" x1="{LEFT}%" x2="{RIGHT}%" y1="{y}" y2="{y}"/>')
            parts.append(_text("ylabel", LEFT - 1.5, y + 4, text, "end"))
        scale = PANEL / (max(panel.heights) or 1.0)
        for height, title, kind, (a, b) in zip(
            panel.heights, panel.titles, panel.kinds, pairwise(positions), strict=True
        ):
            if height:
                tall, edge = max(1.0, scale * height), 0.06 * (b - a)
                size = f'width="{at(b - edge) - at(a + edge):.3f}%" height="{tall:.1f}"'
                corner = f'x="{at(a + edge):.3f}%" y="{bottom - tall:.1f}"'
                rect = f'<rect class="{kind}" {corner} {size}><title>{escape(title)}</title></rect>'
                parts.append(rect)
        parts.append(_text("panel", LEFT, bottom - PANEL - 7, panel.name, "start"))
    for share, text in ticks:
        x, anchor = at(share), "end" if share > 0.95 else "middle"
        line = f'<line class="tick" x1="{x:.3f}%" x2="{x:.3f}%" y1="{bottom}" y2="{bottom + 4}"/>'
        parts += [line, _text("", x, bottom + 18, text, anchor)]
    parts.append(_text("xlabel", RIGHT, bottom + 36, xlabel, "end"))
    if marker:
        x, (anchor, shift) = at(marker[0]), ("end", -1) if marker[0] > 0.55 else ("start", 1)
        line = f'<line class="median" x1="{x:.3f}%" x2="{x:.3f}%" y1="4" y2="{bottom}"/>'
        parts += [line, _text("median-label", x + shift, 14, marker[1], anchor)]
    return _svg("histogram", "100%", bottom + 42, parts, label=label)


def _text(name: str, x: float, y: float, text: str, anchor: str) -> str:
    corner = f'x="{x:.3f}%" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{name}" {corner}>{escape(text)}</text>'


def gap_histogram(audit: Audit) -> Markup:
    """Draw the gaps between test frames and their nearest train frame; '' if there are none.

    All bars are equally wide, with the edges (frames) labeled below; the median is a dashed line.
    """
    edges, counts = list(audit.gap_edges), list(audit.gap_counts)
    if sum(map(bool, counts)) < 2:  # one bar says no more than the numbers below it
        return Markup("")
    positions = np.linspace(0, 1, len(edges)).tolist()
    every = max(1, math.ceil(len(counts) / 5))
    labeled = [k for k in range(len(edges)) if k % every == 0 and len(counts) - k >= every]
    labeled.append(len(counts))
    marker = None
    if audit.gap_median is not None:
        median = float(np.interp(audit.gap_median, edges, positions))
        marker = (median, f"median {number(audit.gap_median, 0)}")
    label = f"Histogram of gaps for {audit.name}: {count(sum(counts))} test samples, "
    label += f"{count(edges[0])} to {count(edges[-1])} frames"
    titles = [
        f"{count(a)} to {count(b)} frames: {count(n)}"
        for (a, b), n in zip(pairwise(edges), counts, strict=True)
    ]
    panel = Bars("test samples", counts, titles, ["column"] * len(counts), count(max(counts)))
    return _histogram(
        [panel],
        positions,
        ticks=[(positions[k], count(edges[k])) for k in labeled],
        marker=marker,
        xlabel="frames to the nearest train frame",
        label=label + (f", {marker[1]}" if marker else ""),
    )


def bins_of(signal: Signal) -> tuple[list[float], list[int], list[int]] | None:
    """Return edges and both histograms of a calibrated signal as they are drawn, or None.

    Empty bins at the ends are cut, and neighbors joined to at most :data:`MAX_BARS`.
    """
    edges, matches = np.asarray(signal.edges), np.asarray(signal.matches)
    unrelated = np.asarray(signal.unrelated if len(signal.unrelated) else np.zeros_like(matches))
    if not (matches.sum() + unrelated.sum()):
        return None
    inside = int(np.searchsorted(edges, signal.threshold, "right")) - 1
    full = [*np.flatnonzero(matches + unrelated), min(max(inside, 0), len(matches) - 1)]
    first, last = min(full), max(full) + 1
    step = math.ceil((last - first) / MAX_BARS)
    starts = np.arange(first, last, step)
    join: Callable[[np.ndarray], list[int]] = lambda n: np.add.reduceat(n[:last], starts).tolist()
    return [*edges[starts].tolist(), float(edges[last])], join(unrelated), join(matches)


def score_histogram(signal: Signal, label: str, data: str = "train") -> Markup:
    """Draw scores of unrelated pairs above those of test samples, with the threshold.

    Each panel has its own scale, in shares of its own samples; '' if nothing was calibrated.

    Args:
        signal: ``edges`` (scores), ``unrelated`` and ``matches`` (counts), ``threshold``.
        label: the drawing in words, for those who do not see it.
        data: what the test samples were compared with.
    """
    bins = bins_of(signal)
    if bins is None:
        return Markup("")
    edges, unrelated, matches = bins
    low, high = edges[0], edges[-1]

    def share(value: float) -> float:
        return (min(max(value, low), high) - low) / (high - low)

    strong = ["column" if a >= signal.threshold else "below" for a in edges[:-1]]
    panels: list[Bars] = []
    rows = [(f"test against {data}", matches, strong)]
    if sum(unrelated):
        rows.insert(0, ("unrelated samples", unrelated, ["apart"] * len(unrelated)))
    for name, counts, kinds in rows:
        titles = [
            f"{score_text(a)} to {score_text(b)}: {count(n)}"
            for (a, b), n in zip(pairwise(edges), counts, strict=True)
        ]
        top = f"{100 * max(counts) / (sum(counts) or 1):.2g}\u00a0%"
        panels.append(Bars(f"{name} ({count(sum(counts))})", counts, titles, kinds, top))
    ticks, digits = ticks_of(low, high, 6)
    marker = (share(signal.threshold), f"flagged from {score_text(signal.threshold)}")
    xlabel = "score of the best match; 1 = the same"
    marks = [(share(t), number(t, digits)) for t in ticks]
    positions = [share(edge) for edge in edges]
    return _histogram(panels, positions, ticks=marks, marker=marker, xlabel=xlabel, label=label)
