"""Figures of a paper as files: strips of scores as SVG, images as PNG.

They are white, whatever the page is; a figure has no title, which belongs into its caption.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup
from PIL import Image, ImageDraw, ImageFont, ImageOps

from palpate.core import atomic_path, write_text
from palpate.report import audits
from palpate.report.families import REAL, families
from palpate.report.first_screen import COLUMNS, TELLING, telling_columns
from palpate.report.page import gallery_images, in_turns, material_of, pair_images
from palpate.report.results import Audit, Results
from palpate.report.strips import COLORS, panels_of, strips_svg
from palpate.report.tables import file_names, grid, of_study
from palpate.report.thumbnails import Wanted, read_image

#: Samples and pairs side by side.
SAMPLES, PAIRS = 8, 6
#: Pixels of an image, between two, and of the letters.
SIDE, GAP, LETTERS = 256, 10, 26


@dataclass(frozen=True)
class Picture:
    """Images in rows and columns: a heading for each column, a label for each row."""

    headings: Sequence[str]
    rows: Sequence[tuple[str, Sequence[Wanted]]]
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
        with atomic_path(path := folder / f"{name}.png") as part:
            _grid(picture, base).save(part, "png")
        files.append(path)
    return files


def _drawings(results: Results) -> dict[str, Markup]:
    drawings: dict[str, Markup] = {}
    columns = telling_columns(families(results.scores))
    if panels := panels_of(grid(columns, {REAL, *results.controls})):
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
        ("No contact", [Wanted(background, "", "") for _, background, _ in items]),
        ("Real", [Wanted(tactile, "", "") for *_, tactile in items]),
        ("Contact", [Wanted(tactile, "", "", background) for _, background, tactile in items]),
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
    rows = [(n, [column.get(n, Wanted(None, "", n)) for column in columns]) for n in labels]
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
        for k, wanted in enumerate(row):
            image.paste(_field(wanted, base, picture.crop), (left + k * (SIDE + GAP), y))
    return image


def _field(wanted: Wanted, base: Path, crop: bool) -> Image.Image:
    """An image in a square: its center, or all of it on white."""
    try:
        if wanted.path is None:
            raise FileNotFoundError
        image, tiny = read_image(base, wanted.path, 4 * SIDE, less=wanted.less, like=wanted.like)
    except Exception:  # as for thumbnails
        field = Image.new("RGB", (SIDE, SIDE), COLORS["paper"])
        ImageDraw.Draw(field).rectangle((0, 0, SIDE - 1, SIDE - 1), outline=COLORS["line"], width=3)
        return field
    # Small images keep their pixels, as on the page.
    filtering = Image.Resampling.NEAREST if tiny else Image.Resampling.LANCZOS
    if crop:
        return ImageOps.fit(image, (SIDE, SIDE), filtering)
    return ImageOps.pad(image, (SIDE, SIDE), filtering, COLORS["paper"])
