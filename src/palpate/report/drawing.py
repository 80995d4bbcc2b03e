"""Line drawings for print: shapes and words, written as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

#: Colors by name.
COLORS = {
    "paper": "#ffffff",
    "ink": "#15191e",
    "soft": "#545d68",
    "line": "#d9dee3",
    "mark": "#0072b2",
}
#: Width of a letter as a share of the size: that of digits in a wide font (DejaVu Sans).
LETTER = 0.66
#: Size of letters, in units.
SIZE = 12


@dataclass(frozen=True)
class Shape:
    """A line through ``points``, or a filled area; ``ink`` names its color.

    Attributes:
        points: x and y in units of the drawing.
        fill: whether it is an area.
        width: of a line, in units.
        dash: dashes and gaps of a line, in units.
        opacity: of an area, in [0, 1].
        closed: whether a line ends where it begins.
    """

    points: Sequence[tuple[float, float]]
    ink: str
    fill: bool = False
    width: float = 1.0
    dash: Sequence[float] = ()
    opacity: float = 1.0
    closed: bool = False


@dataclass(frozen=True)
class Words:
    """Text on one line; ``x`` is its ``anchor`` (start, middle, end), ``y`` its base line."""

    x: float
    y: float
    text: str
    anchor: str = "start"
    ink: str = "soft"
    bold: bool = False


@dataclass(frozen=True)
class Drawing:
    """Shapes and words, the last on top; ``label`` is all of it in words."""

    width: float
    height: float
    parts: Sequence[Shape | Words]
    label: str

    def to_svg(self) -> Markup:
        """Return a file for print."""
        body = "".join(map(_svg, self.parts))
        size = f'viewBox="0 0 {self.width:g} {self.height:g}"'
        about = f'role="img" aria-label="{escape(self.label)}"'
        space = f'xmlns="http://www.w3.org/2000/svg" width="{self.width:g}" '
        space += f'height="{self.height:g}" font-family="Helvetica, Arial, sans-serif"'
        paper = f'<rect width="100%" height="100%" fill="{COLORS["paper"]}"/>'
        title = f"<title>{escape(self.label)}</title><desc>Drawn by palpate</desc>"
        return Markup(f"<svg {space} {size} {about}>{title}{paper}{body}</svg>\n")


def dot(x: float, y: float, ink: str, *, hollow: bool) -> list[Shape]:
    """Return a disc at a point, filled or hollow."""
    turns = [k / 16 for k in range(16)]
    points = [(x + 4.2 * math.cos(math.tau * t), y - 4.2 * math.sin(math.tau * t)) for t in turns]
    if hollow:
        return [Shape(points, "paper", fill=True), Shape(points, ink, width=1.6, closed=True)]
    return [Shape(points, ink, fill=True)]


def cut_to(text: str, width: float) -> str:
    """Return a text of at most ``width`` units; a longer one ends in ``...``."""
    letters = max(4, int(width / (LETTER * SIZE)))
    return text if len(text) <= letters else f"{text[: letters - 3].rstrip()}..."


def _svg(part: Shape | Words) -> str:
    paint = COLORS[part.ink]
    if isinstance(part, Words):
        look = f"fill:{paint};font-size:{SIZE}px;font-weight:{600 if part.bold else 400}"
        place = f'x="{part.x:.2f}" y="{part.y:.2f}" text-anchor="{part.anchor}"'
        return f'<text {place} style="{look}">{escape(part.text)}</text>'
    path = "M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in part.points)
    path += "Z" if part.fill or part.closed else ""
    if part.fill:
        opacity = f";opacity:{part.opacity:g}" if part.opacity < 1 else ""
        return f'<path d="{path}" style="fill:{paint}{opacity}"/>'
    dash = f";stroke-dasharray:{' '.join(f'{d:g}' for d in part.dash)}" if part.dash else ""
    look = f"fill:none;stroke:{paint};stroke-width:{part.width:g};stroke-linejoin:round"
    return f'<path d="{path}" style="{look}{dash}"/>'
