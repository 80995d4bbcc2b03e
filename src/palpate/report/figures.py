"""Figures of a paper as files: strips of scores as SVG, images as PNG.

Strips are the bars of the page, on one axis a metric. Figures are white, whatever the page is, and
have no title, which belongs into the caption.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape
from PIL import Image, ImageDraw, ImageFont, ImageOps

from palpate.core import ImageError, Score, save_image, write_text
from palpate.report import audits
from palpate.report.first_screen import COLUMNS, TELLING, telling_columns
from palpate.report.labels import digits_of, file_names, with_interval
from palpate.report.page import gallery_images, in_turns, material_of, pair_images
from palpate.report.plots import HEIGHT, axis_of, axis_row, bar
from palpate.report.results import Audit, Results
from palpate.report.study import of_study
from palpate.report.tables import FLOOR, REAL, Row, Table, families, grid
from palpate.report.thumbnails import ImageRequest, read_image

#: Samples and pairs side by side.
SAMPLES, PAIRS = 8, 6
#: Pixels of an image, between two, and of the letters.
SIDE, GAP, LETTERS = 256, 10, 26
#: Colors of a figure, whatever the page's are.
COLORS = {
    "paper": "#ffffff",
    "ink": "#15191e",
    "soft": "#545d68",
    "line": "#d9dee3",
    "mark": "#0072b2",
}
DARK = {
    "paper": "#111418",
    "ink": "#f1f4f7",
    "soft": "#aab4be",
    "line": "#3a434c",
    "mark": "#5ccfd0",
}
RULES = """.paper {{ fill: {paper} }}
text {{ fill: {soft}; font: 12px Helvetica, Arial, sans-serif }}
.ink {{ fill: {ink} }} .title {{ fill: {ink}; font-weight: 600 }}
.rail {{ stroke: {line} }} .tick {{ stroke: {soft} }} .null {{ fill: {soft}; opacity: .25 }}
.floor {{ stroke: {ink}; stroke-width: 1.4; stroke-dasharray: 3 2 }}
.interval {{ stroke: {mark}; stroke-width: 1.8; fill: none }} .value {{ fill: {mark} }}
.hollow {{ fill: {paper}; stroke: {mark}; stroke-width: 1.6 }}"""
#: Dark where the viewer is; what knows no schemes draws the first.
STYLE = (
    f"{RULES.format(**COLORS)}\n@media (prefers-color-scheme: dark) {{ {RULES.format(**DARK)} }}"
)
#: Units of a figure, of its labels and axes, of the lines and letters of its text.
WIDTH, LABEL, AXIS, LINE, LETTER = 640, 212, 240.0, 18, 8


@dataclass(frozen=True)
class Picture:
    """Images in rows and columns: a heading for each column, a label for each row."""

    headings: Sequence[str]
    rows: Sequence[tuple[str, Sequence[ImageRequest]]]
    crop: bool = True


def save_figures(results: Results, folder: Path, *, base: Path) -> list[Path]:
    """Write every figure of ``results`` into ``folder``.

    Strips (of scores, and of tables of a study with intervals) are SVG; samples, what the
    background is of an image, and leaking pairs are PNG.

    Args:
        results: what to draw.
        folder: made if it is not there; files of the same names are replaced.
        base: folder that relative image paths start from.

    Returns:
        The files.

    Raises:
        PalpateError: if nothing can be written there, or scores of different settings would share a
            column.
    """
    drawings = _drawings(results)  # scores are checked before anything is written
    files: list[Path] = []
    for name, drawing in drawings.items():
        write_text(path := folder / f"{name}.svg", str(drawing))
        files.append(path)
    for name, picture in _pictures(results).items():
        save_image(path := folder / f"{name}.png", _grid(picture, base))
        files.append(path)
    return files


def _drawings(results: Results) -> dict[str, Markup]:
    drawings: dict[str, Markup] = {}
    columns = telling_columns(families(results.scores, results.controls))
    if panels := panels_of(grid(columns)):
        drawings["strips-scores"] = strips_svg("Scores", panels)
    tables = list(map(of_study, results.tables))
    for name, table in zip(file_names("strips", [t.title for t in tables]), tables, strict=True):
        panels = [p for p in panels_of(table) if any(s.interval for _, s, _ in p.rows)]
        rank = {measure: k for k, measure in enumerate(TELLING)}
        panels.sort(key=lambda panel: rank.get(panel.rows[0][1].measure, len(rank)))
        if panels := panels[:COLUMNS]:
            drawings[name] = strips_svg(table.title, panels)
    return drawings


def _pictures(results: Results) -> dict[str, Picture]:
    pictures: dict[str, Picture] = {}
    samples = gallery_images(results.gallery)[:SAMPLES]
    if samples:
        headings = [material_of(item.sample) for item, _ in samples]
        rows = zip(*(images for _, images in samples), strict=True)
        pictures["samples"] = Picture(headings, [(row[0].label, row) for row in rows])
    if background := _background(results):
        pictures["background"] = background
    leaking = [audit for audit in results.audits if audit.leaked_fraction]
    for name, audit in zip(file_names("pairs", [a.name for a in leaking]), leaking, strict=True):
        if pairs := _pairs(audit):
            pictures[name] = pairs
    return pictures


def _background(results: Results) -> Picture | None:
    """How much of a tactile image is the sensor's: without contact, with it, and what differs."""
    items = [
        (item.sample, background, item.sample.tactile)
        for item in in_turns(results.gallery)
        if (background := item.background or item.sample.background) and item.sample.tactile
    ][:SAMPLES]
    rows = [
        ("No contact", [ImageRequest(background, "", "") for _, background, _ in items]),
        ("Real", [ImageRequest(tactile, "", "") for *_, tactile in items]),
        (
            "Contact",
            [ImageRequest(tactile, "", "", background) for _, background, tactile in items],
        ),
    ]
    return Picture([material_of(sample) for sample, *_ in items], rows) if items else None


def _pairs(audit: Audit) -> Picture | None:
    lists = [pair_list for pair_list in audits.pair_lists(audit) if pair_list.has_images]
    if not lists:
        return None
    nearest = [pair_list for pair_list in lists if pair_list.kind in ("", "time gap")]
    pairs = (nearest or lists)[0].pairs[:PAIRS]
    headings = [audits.pair_facts(pair, "")[0] for pair in pairs]
    columns = [{w.label: w for w in pair_images(pair, audits.head_of(audit))} for pair in pairs]
    labels = list(dict.fromkeys(label for column in columns for label in column))
    rows = [(n, [column.get(n, ImageRequest(None, "", n)) for column in columns]) for n in labels]
    return Picture(headings, rows, crop=False)


def _grid(picture: Picture, base: Path) -> Image.Image:
    """Draw the images; one that is missing or broken is an empty field."""
    try:
        font: Any = ImageFont.truetype("DejaVuSans.ttf", LETTERS)
    except OSError:  # PIL's own lacks letters with accents
        font = ImageFont.load_default(LETTERS)

    def text(words: str, room: float) -> str:
        while font.getlength(words) > room and len(words) > 1:
            words = words[:-2].rstrip() + "."
        return words

    left = max(round(font.getlength(label)) for label, _ in picture.rows) + 3 * GAP
    top = LETTERS + 2 * GAP
    size = (left + len(picture.headings) * (SIDE + GAP), top + len(picture.rows) * (SIDE + GAP))
    image = Image.new("RGB", size, COLORS["paper"])
    pen = ImageDraw.Draw(image)
    for k, heading in enumerate(picture.headings):
        middle = left + k * (SIDE + GAP) + SIDE // 2
        pen.text((middle, top - GAP), text(heading, SIDE), COLORS["ink"], font, "ms")
    for r, (label, row) in enumerate(picture.rows):
        y = top + r * (SIDE + GAP)
        corner = (left - 2 * GAP, y + SIDE // 2)
        pen.text(corner, label, COLORS["ink"], font, "rm")
        for k, request in enumerate(row):
            image.paste(_field(request, base, picture.crop), (left + k * (SIDE + GAP), y))
    return image


def _field(request: ImageRequest, base: Path, crop: bool) -> Image.Image:
    """An image in a square: its center, or all of it on white."""
    try:
        image, tiny = read_image(base, request, 4 * SIDE)
    except ImageError:
        field = Image.new("RGB", (SIDE, SIDE), COLORS["paper"])
        ImageDraw.Draw(field).rectangle((0, 0, SIDE - 1, SIDE - 1), outline=COLORS["line"], width=3)
        return field
    # Small images keep their pixels, as on the page.
    filtering = Image.Resampling.NEAREST if tiny else Image.Resampling.LANCZOS
    if crop:
        return ImageOps.fit(image, (SIDE, SIDE), filtering)
    return ImageOps.pad(image, (SIDE, SIDE), filtering, COLORS["paper"])


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
            (_label(row), score, row.control or row.cells[0].value in (REAL, FLOOR))
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
        axis = axis_of(methods, 4, AXIS) or axis_of(scores, 4, AXIS)
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
    values = (
        f"{panel.title} of {name}: {with_interval(score, digits_of([score]))}"
        for panel in panels
        for name, score, _ in panel.rows
    )
    about = f"<title>{label}</title><desc>{escape('; '.join(values))}</desc>"
    about += f"<style>{STYLE}</style>"
    paper = '<rect class="paper" width="100%" height="100%"/>'
    return Markup(f"{head}{about}{paper}{''.join(parts)}</svg>\n")


def _text(x: float, y: float, text: str, width: float, name: str) -> str:
    """Text of at most ``width`` units; a longer one ends in ``...``."""
    letters = int(width // LETTER)
    text = text if len(text) <= letters else f"{text[: letters - 3].rstrip()}..."
    return f'<text class="{name}" x="{x:g}" y="{y:g}">{escape(text)}</text>'
