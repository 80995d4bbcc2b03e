"""Strips of scores as an SVG file for print: the bars of the page, on one axis a metric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

from markupsafe import Markup, escape

from palpate.core import Score
from palpate.report.numbers import digits_of, with_interval
from palpate.report.plots import HEIGHT, axis_of, axis_row, bar, ticks_of
from palpate.report.tables import Row, Table

#: Colors of a figure, whatever the page's are.
COLORS = {
    "paper": "#ffffff",
    "ink": "#15191e",
    "soft": "#545d68",
    "line": "#d9dee3",
    "mark": "#0072b2",
}
STYLE = """text { fill: #545d68; font: 12px Helvetica, Arial, sans-serif }
.ink { fill: #15191e } .title { fill: #15191e; font-weight: 600 }
.rail { stroke: #d9dee3 } .tick { stroke: #545d68 } .null { fill: #545d68; opacity: .25 }
.floor { stroke: #15191e; stroke-width: 1.4; stroke-dasharray: 3 2 }
.interval { stroke: #0072b2; stroke-width: 1.8; fill: none } .value { fill: #0072b2 }
.hollow { fill: #ffffff; stroke: #0072b2; stroke-width: 1.6 }"""
#: Units of a figure, of its labels and axes, of the lines and letters of its text.
WIDTH, LABEL, AXIS, LINE, LETTER = 640, 212, 240.0, 18, 8


@dataclass(frozen=True)
class Panel:
    """The scores of one metric by subject: label, score, whether it is a control."""

    title: str
    rows: Sequence[tuple[str, Score, bool]]


def panels_of(table: Table) -> list[Panel]:
    """Return the columns of a table as panels: those whose scores are of one measure."""
    panels: list[Panel] = []
    for k, head in enumerate(table.heads):
        rows = [
            (_label(row), score, row.control)
            for row in table.rows
            if (score := row.cells[k].score) is not None
        ]
        if rows and len({(score.measure, score.kind) for _, score, _ in rows}) == 1:
            panels.append(Panel(str(head), rows))
    return panels


def _label(row: Row) -> str:
    """The words before the first score."""
    words = takewhile(lambda value: not isinstance(value, Score), (c.value for c in row.cells))
    return ", ".join(word for word in words if isinstance(word, str))


def strips_svg(title: str, panels: Sequence[Panel]) -> Markup:
    """Draw each panel on an axis of its own: value, interval, null and floor of each subject.

    The axis holds the methods and their floor; a control beyond it is an arrow at the edge.
    Controls are hollow. A score without a value has no mark, and the word ``undefined``.
    """
    parts: list[str] = []
    y = 4
    for panel in panels:
        scores = [score for _, score, _ in panel.rows]
        methods = [score for _, score, control in panel.rows if not control]
        if axis := axis_of(methods) or axis_of(scores):
            ticks, digits = ticks_of(axis.low, axis.high, 4)
            axis = replace(axis, ticks=ticks, digits=digits, width=AXIS)
        parts.append(_text(0, y + 12, panel.title, WIDTH, "title"))
        y += LINE
        for label, score, control in panel.rows:
            fields = score.value, score.interval, score.null, score.floor
            parts.append(_text(0, y + 15, label, LABEL, "ink"))
            parts.append(bar(axis, *fields, at=(LABEL, y), hollow=control))
            text = with_interval(score, digits_of(scores))
            parts.append(_text(LABEL + AXIS + 12, y + 15, text, LABEL, "ink"))
            y += HEIGHT
        parts.append(axis_row(axis, at=(LABEL, y)))
        y += 2 * LINE
    rows = [row for panel in panels for row in panel.rows]
    controls = any(control for *_, control in rows)
    legend = ["dot: score", *["hollow: control", "arrow: beyond the axis"] * controls]
    legend += ["line: interval"] * any(s.interval for _, s, _ in rows)
    legend += ["gray: null band"] * any(s.null for _, s, _ in rows)
    legend += ["dashed: floor"] * any(s.floor is not None for _, s, _ in rows)
    parts.append(_text(0, y + 4, "; ".join(legend), WIDTH, "legend"))
    label = escape(f"{title}: {', '.join(panel.title for panel in panels)}")
    size = f'width="{WIDTH}" height="{y + 12}" viewBox="0 0 {WIDTH} {y + 12}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="{label}">'
    about = f"<title>{label}</title><desc>Drawn by palpate</desc><style>{STYLE}</style>"
    paper = f'<rect width="100%" height="100%" fill="{COLORS["paper"]}"/>'
    return Markup(f"{head}{about}{paper}{''.join(parts)}</svg>\n")


def _text(x: float, y: float, text: str, width: float, name: str) -> str:
    """Text of at most ``width`` units; a longer one ends in ``...``."""
    letters = int(width // LETTER)
    text = text if len(text) <= letters else f"{text[: letters - 3].rstrip()}..."
    return f'<text class="{name}" x="{x:g}" y="{y:g}">{escape(text)}</text>'
