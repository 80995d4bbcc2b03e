"""Line drawings that a page shows and that files for print hold: shapes and words, written twice.

:meth:`Drawing.to_svg` writes SVG, with the page's own colors or with those of print, and
:meth:`Drawing.to_png` draws the same with PIL. Lines differ by color, by dashes and by markers, so
that a drawing reads without its colors.
"""

from __future__ import annotations

import io
import math
import textwrap
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

from markupsafe import Markup, escape
from PIL import Image, ImageDraw, ImageFont

#: Colors of print; the page has variables of these names, for light and dark. Those of lines keep
#: apart for color-blind readers (after Okabe and Ito, darker for white paper).
COLORS = {
    "paper": "#ffffff",
    "ink": "#15191e",
    "soft": "#545d68",
    "line": "#d9dee3",
    "line1": "#0072b2",
    "line2": "#d55e00",
    "line3": "#007a5a",
    "line4": "#a3438a",
    "line5": "#8a6a00",
    "line6": "#4b5157",
}
#: Dashes and gaps of lines, in units of the drawing.
DASHES: tuple[tuple[float, ...], ...] = ((), (7, 3), (2, 3), (9, 3, 2, 3))
#: Corners of the markers in a circle of radius 1, as turns; a disc, and signs without color.
MARKERS = (
    [k / 16 for k in range(16)],
    [0.125, 0.375, 0.625, 0.875],
    [0.25, 0.5833, 0.9167],
    [0.0, 0.25, 0.5, 0.75],
    [0.0833, 0.4167, 0.75],
)
#: Fonts of PNG files, the first that is installed; without any, PIL's own, which has ASCII alone.
FONTS = ("DejaVuSans.ttf", "Arial.ttf", "Helvetica.ttc", "LiberationSans-Regular.ttf")
BOLD = ("DejaVuSans-Bold.ttf", "Arial Bold.ttf", "Arial_Bold.ttf", "LiberationSans-Bold.ttf")
#: Signs that PIL's own font lacks.
ASCII = {"−": "-", "–": "-", "↑": "(higher is better)", "↓": "(lower is better)", "→": "->"}
#: PNG files have this many pixels a unit, and are drawn twice as large.
PIXELS, SMOOTH = 4, 2
#: Width of a letter as a share of the size: that of digits in a wide font (DejaVu Sans).
LETTER = 0.66


@dataclass(frozen=True)
class Shape:
    """A line through ``points``, or a filled area; ``ink`` names its color.

    Attributes:
        points: x and y in units of the drawing.
        fill: whether it is an area.
        width: of a line, in units.
        dash: of a line: one of :data:`DASHES`.
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
    size: float = 12.0


@dataclass(frozen=True)
class Drawing:
    """Shapes and words, the last on top; ``label`` is all of it in words."""

    width: float
    height: float
    parts: Sequence[Shape | Words]
    label: str

    def to_svg(self, *, themed: bool = False) -> Markup:
        """Return SVG, by default a file for print; ``themed`` with the colors of the page."""
        body = "".join(_svg(part, themed) for part in self.parts)
        size = f'viewBox="0 0 {self.width:g} {self.height:g}"'
        about = f'role="img" aria-label="{escape(self.label)}"'
        if themed:
            return Markup(f'<svg class="drawing" {size} {about} focusable="false">{body}</svg>')
        space = f'xmlns="http://www.w3.org/2000/svg" width="{self.width:g}" '
        space += f'height="{self.height:g}" font-family="Helvetica, Arial, sans-serif"'
        paper = f'<rect width="100%" height="100%" fill="{COLORS["paper"]}"/>'
        title = f"<title>{escape(self.label)}</title><desc>Drawn by palpate</desc>"
        return Markup(f"<svg {space} {size} {about}>{title}{paper}{body}</svg>\n")

    def to_png(self) -> bytes:
        """Return the drawing as a PNG file for print: 4 pixels a unit, on white."""
        scale = PIXELS * SMOOTH
        size = (round(self.width * scale), round(self.height * scale))
        image = Image.new("RGB", size, COLORS["paper"])
        for part in self.parts:
            if isinstance(part, Shape):
                _draw(image, part, scale)
            else:
                _write(image, part, scale)
        image = image.reduce(SMOOTH)
        data = io.BytesIO()
        image.save(data, "png", dpi=(96 * PIXELS, 96 * PIXELS))
        return data.getvalue()


def marker(k: int, x: float, y: float, ink: str, radius: float = 4.2) -> list[Shape]:
    """Return the ``k``-th marker at a point: filled, or for ``k`` over their number hollow."""
    turns = MARKERS[k % len(MARKERS)]
    points = [
        (x + radius * math.cos(math.tau * t), y - radius * math.sin(math.tau * t)) for t in turns
    ]
    if k // len(MARKERS) % 2:
        return [Shape(points, "paper", fill=True), Shape(points, ink, width=1.6, closed=True)]
    return [Shape(points, ink, fill=True)]


def text_width(text: str, size: float = 12.0) -> float:
    """Return about how wide a text is, in units; no text is wider by much."""
    wide = sum(1.0 if unicodedata.east_asian_width(c) in "WF" else LETTER for c in text)
    return size * wide


def lines_of(text: str, width: float, size: float = 12.0, most: int = 3) -> list[str]:
    """Return a text cut into lines of at most ``width`` units; a longer one ends in ``...``."""
    letters = max(4, int(width / (LETTER * size)))
    lines = textwrap.wrap(text, letters)
    if len(lines) > most:
        lines = [*lines[: most - 1], f"{lines[most - 1][: letters - 3].rstrip()}..."]
    return lines or [""]


def _svg(part: Shape | Words, themed: bool) -> str:
    paint = f"var(--{part.ink})" if themed else COLORS[part.ink]
    if isinstance(part, Words):
        look = f"fill:{paint};font-size:{part.size:g}px;font-weight:{600 if part.bold else 400}"
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


def _draw(image: Image.Image, shape: Shape, scale: int) -> None:
    points = [(x * scale, y * scale) for x, y in shape.points]
    if shape.opacity < 1:
        _tint(image, points, shape)
        return
    pen = ImageDraw.Draw(image)
    if shape.fill:
        pen.polygon(points, fill=COLORS[shape.ink])
        return
    width = max(1, round(shape.width * scale))
    for run in dashed([*points, points[0]] if shape.closed else points, shape.dash, scale):
        pen.line(run, fill=COLORS[shape.ink], width=width, joint="curve")


def _tint(image: Image.Image, points: Sequence[tuple[float, float]], shape: Shape) -> None:
    """Lay a transparent area over the image."""
    left, top = (math.floor(min(p[k] for p in points)) for k in (0, 1))
    right, bottom = (math.ceil(max(p[k] for p in points)) + 1 for k in (0, 1))
    mask = Image.new("L", (right - left, bottom - top), 0)
    moved = [(x - left, y - top) for x, y in points]
    ImageDraw.Draw(mask).polygon(moved, fill=round(255 * shape.opacity))
    image.paste(Image.new("RGB", mask.size, COLORS[shape.ink]), (left, top), mask)


def dashed(
    points: Sequence[tuple[float, float]], dash: Sequence[float], scale: float
) -> list[list[tuple[float, float]]]:
    """Return the pieces of a line that are drawn; all of it without dashes."""
    if not dash:
        return [list(points)]
    pattern = [scale * d for d in dash] * (1 + len(dash) % 2)
    pieces: list[list[tuple[float, float]]] = [[points[0]]]
    k, left = 0, pattern[0]
    for (x0, y0), (x1, y1) in pairwise(points):
        length, done = math.hypot(x1 - x0, y1 - y0), 0.0
        while length - done > left:
            done += left
            place = (x0 + (x1 - x0) * done / length, y0 + (y1 - y0) * done / length)
            if k % 2 == 0:
                pieces[-1].append(place)
            else:
                pieces.append([place])
            k = (k + 1) % len(pattern)
            left = pattern[k]
        left -= length - done
        if k % 2 == 0:
            pieces[-1].append((x1, y1))
    return [piece for piece in pieces if len(piece) > 1]


def _write(image: Image.Image, words: Words, scale: int) -> None:
    font, whole = font_of(words.size * scale, words.bold)
    text = words.text if whole else in_ascii(words.text)
    anchor = {"start": "ls", "middle": "ms", "end": "rs"}[words.anchor]
    place = (words.x * scale, words.y * scale)
    ImageDraw.Draw(image).text(place, text, font=font, fill=COLORS[words.ink], anchor=anchor)


@cache
def font_of(size: float, bold: bool = False) -> tuple[Any, bool]:
    """Return a font, and whether it has more than ASCII."""
    for name in BOLD if bold else FONTS:
        try:
            return ImageFont.truetype(name, size), True
        except OSError:
            continue
    return ImageFont.load_default(size), False


def in_ascii(text: str) -> str:
    """Return a text in ASCII: accents fall, other signs become ``?``."""
    known = unicodedata.normalize("NFKD", "".join(ASCII.get(c, c) for c in text))
    return "".join(c if c.isascii() else "?" for c in known if not unicodedata.combining(c))
