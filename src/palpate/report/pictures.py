"""Thumbnails as ``data:`` URIs, made to fit a budget of bytes.

Every picture is at most ``side`` pixels long. Pictures of at most 96 pixels stay lossless PNG (the page magnifies
them without smoothing), larger ones become JPEG. When the whole does not fit the budget, first the side shrinks, then
the last rows are left out; both are told. A picture that is missing or broken keeps its place and its name.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from palpate.core import Progress, quiet, track

TINY = 96
#: (longest side in pixels, JPEG quality), best first.
LADDER: tuple[tuple[int, int], ...] = (
    (256, 88),
    (192, 86),
    (160, 84),
    (128, 82),
    (96, 78),
    (64, 72),
    (48, 64),
    (32, 60),
)
#: Above this side everything is shown; from here on, rows that are folded anyway are given up before pictures shrink further.
KEEP_ALL = 128
#: Markup around the pictures of one row, in bytes: an estimate that the writer corrects after rendering.
ROW_MARKUP = 1_500


@dataclass(frozen=True)
class Wanted:
    """A picture to show: its path (None = there is none), what it is in words, and its column's name."""

    path: str | None
    alt: str
    label: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture as the page draws it. Without ``uri`` it is a placeholder, and ``problem`` says why.

    Attributes:
        width, height: of the thumbnail, in pixels.
        tiny: whether the file itself is at most 96 pixels long, so that magnifying must not smooth it.
    """

    alt: str
    label: str = ""
    uri: str | None = None
    width: int = 0
    height: int = 0
    tiny: bool = False
    name: str = ""
    problem: str = ""


@dataclass(frozen=True)
class Album:
    """Rows of pictures that fit the budget: ``rows`` may be shorter than what was asked for."""

    rows: Sequence[Sequence[Picture]]
    side: int
    broken: int


def to_rgb(image: Image.Image) -> Image.Image:
    """An upright 8-bit RGB copy; 16-bit and float grays are stretched from their own range, transparency becomes white."""
    image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I") or image.mode == "F":
        values = np.asarray(image, dtype=np.float64)
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        unit = np.nan_to_num((values - low) / (high - low)) if high > low else np.zeros_like(values)
        image = Image.fromarray((255 * unit).round().astype(np.uint8))
    if "A" in image.getbands() or "transparency" in image.info:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return image.convert("RGB")


def thumbnail(path: Path, side: int, quality: int) -> tuple[str, int, int, bool]:
    """One picture as a ``data:`` URI.

    Args:
        path: the image file.
        side: longest side of the thumbnail, pixels.
        quality: JPEG quality.

    Returns:
        URI, width, height, and whether the file is tiny.

    Raises:
        Exception: whatever PIL raises for a file that is missing or broken.
    """
    with Image.open(path) as file:
        tiny = max(file.size) <= TINY
        file.draft("RGB", (2 * side, 2 * side))
        image = to_rgb(file)
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    if tiny and side >= KEEP_ALL:
        image.save(data, "PNG", optimize=True)
        kind = "png"
    else:
        # Not optimize=True: libjpeg then needs one buffer for the whole picture, and Pillow's is too small for noisy ones.
        image.save(data, "JPEG", quality=quality, subsampling=0 if quality >= 86 else 2)
        kind = "jpeg"
    return (
        f"data:image/{kind};base64,{base64.b64encode(data.getvalue()).decode()}",
        image.width,
        image.height,
        tiny,
    )


class Darkroom:
    """Makes pictures and remembers them, so that a second rendering costs nothing.

    Args:
        base: folder that relative paths start from.
    """

    def __init__(self, base: Path) -> None:
        self._base = base
        self._made: dict[tuple[str, int], tuple[str, int, int, bool] | str] = {}

    def picture(self, wanted: Wanted, side: int, quality: int) -> Picture:
        """The picture, or its placeholder."""
        if wanted.path is None:
            return Picture(wanted.alt, wanted.label, problem="not recorded")
        key = (wanted.path, side)
        if key not in self._made:
            self._made[key] = self._try(self._base / wanted.path, side, quality)
        made = self._made[key]
        if isinstance(made, str):
            return Picture(wanted.alt, wanted.label, name=wanted.path, problem=made)
        uri, width, height, tiny = made
        return Picture(wanted.alt, wanted.label, uri, width, height, tiny, wanted.path)

    @staticmethod
    def _try(path: Path, side: int, quality: int) -> tuple[str, int, int, bool] | str:
        try:
            return thumbnail(path, side, quality)
        except FileNotFoundError:
            return "file missing"
        except Exception:  # a damaged file makes PIL raise almost anything, and one bad picture must not cost the page
            return "file unreadable"

    def develop(
        self,
        rows: Sequence[Sequence[Wanted]],
        budget: int,
        essential: int,
        progress: Progress = quiet,
    ) -> Album:
        """The largest pictures with which the rows fit.

        Args:
            rows: what to show, the most important first.
            budget: bytes for all rows together, markup included.
            essential: how many rows to keep even if all pictures must become smaller than 128 pixels.
            progress: told after each row.

        Returns:
            The album; at the smallest side, rows beyond the budget are dropped from the end.
        """
        fitting: list[list[Picture]] = []
        side = LADDER[0][0]
        for side, quality in LADDER:
            fitting, used = [], 0
            for row in track(rows, f"pictures of {side} px", progress):
                made = [self.picture(w, side, quality) for w in row]
                used += ROW_MARKUP + sum(len(p.uri or "") for p in made)
                if used > budget:
                    break
                fitting.append(made)
            if len(fitting) >= (len(rows) if side > KEEP_ALL else min(essential, len(rows))):
                break
        broken = {p.name for row in fitting for p in row if p.uri is None and p.name}
        return Album(fitting, side, len(broken))
