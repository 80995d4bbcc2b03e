"""Thumbnails as ``data:`` URIs that fit a budget of bytes.

Images of at most 96 pixels stay without loss (WebP; the page magnifies them without smoothing),
larger ones become JPEG. Where the whole does not fit, first the small ones become JPEG, then all
shrink, then the last rows are skipped. An image that is missing or broken keeps its place and its
name.
"""

from __future__ import annotations

import base64
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from palpate.core import ImageError, Progress, decoded, image_bytes, open_image, quiet, track

TINY = 96
#: (longest side in pixels, quality), best first.
SIZES = ((256, 88), (192, 86), (160, 84), (128, 82), (96, 78), (64, 72), (48, 64), (32, 60))
#: Below this side, rows that are folded anyway are skipped before images shrink further.
KEEP_ALL = 128
#: Bytes of markup around the images of one row, roughly.
ROW_MARKUP = 1_500


class Wanted(NamedTuple):
    """An image to show.

    Attributes:
        path: None if there is none.
        alt: what it is in words.
        label: its column's name.
        less: image to subtract, amplified; '' for what varies slowly over the image itself.
        like: image that says how much to amplify, in the place of this one.
    """

    path: str | None
    alt: str
    label: str
    less: str | None = None
    like: str | None = None


class Thumbnail(NamedTuple):
    """An image as the page shows it; without ``uri`` a placeholder, and ``problem`` says why.

    ``tiny`` images are magnified without smoothing.
    """

    uri: str = ""
    width: int = 0
    height: int = 0
    tiny: bool = False
    problem: str = ""


@dataclass(frozen=True)
class Album:
    """The rows of images that fit: key -> (wanted, thumbnail) of each; ``side`` in pixels."""

    rows: Mapping[Hashable, Sequence[tuple[Wanted, Thumbnail]]]
    side: int

    @property
    def broken(self) -> int:
        """The number of files that could not be read."""
        images = (image for row in self.rows.values() for image in row)
        return len({w.path for w, thumbnail in images if w.path and thumbnail.problem})


def fit(
    rows: Mapping[Hashable, Sequence[Wanted]],
    base: Path,
    budget: int,
    essential: int,
    progress: Progress = quiet,
) -> Album:
    """Make the largest thumbnails with which the rows fit.

    Args:
        rows: what to show, the most important first.
        base: folder that relative paths start from.
        budget: bytes for all rows together, markup included.
        essential: rows to keep even if images must become smaller than 128 pixels.
        progress: called after each row.
    """
    fitting: dict[Hashable, Sequence[tuple[Wanted, Thumbnail]]] = {}
    side = 0
    for side, quality in SIZES:
        fitting, used = {}, 0
        for key, wanted in track(list(rows.items()), f"images of {side} px", progress):
            images = [
                (w, thumbnail(base, w.path, side, quality, less=w.less, like=w.like))
                for w in wanted
            ]
            used += ROW_MARKUP + sum(len(image.uri) for _, image in images)
            if used > budget:
                break
            fitting[key] = images
        if len(fitting) >= (len(rows) if side > KEEP_ALL else min(essential, len(rows))):
            break
    return Album(fitting, side)


@lru_cache(maxsize=4096)
def thumbnail(
    base: Path,
    name: str | None,
    side: int,
    quality: int,
    *,
    less: str | None = None,
    like: str | None = None,
) -> Thumbnail:
    """Return one image with at most ``side`` pixels a side; the rest as in :class:`Wanted`."""
    if name is None:
        return Thumbnail(problem="not recorded")
    try:
        image, tiny = read_image(base, name, side, less=less, like=like)
    except ImageError as error:
        return Thumbnail(problem=str(error))
    exact = tiny and side == SIZES[0][0] and less is None
    kind, subsampling = "webp" if exact else "jpeg", 0 if quality >= 86 else 2
    data = image_bytes(image, kind, lossless=exact, quality=quality, subsampling=subsampling)
    uri = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return Thumbnail(uri, image.width, image.height, tiny)


def read_image(
    base: Path, name: str, side: int, *, less: str | None = None, like: str | None = None
) -> tuple[Image.Image, bool]:
    """Return an image with at most ``side`` pixels a side, and whether its file has at most 96.

    Args:
        base: folder that relative paths start from.
        name: path of the file.
        side: in pixels.
        less: as in :class:`Wanted`.
        like: as in :class:`Wanted`.

    Raises:
        ImageError: if a file cannot be read, with the reason.
    """
    with open_image(base / name) as file:
        tiny = max(file.size) <= TINY
        image, _ = decoded(file, (2 * side, 2 * side))
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    if less is None:
        return image, tiny
    pattern = image
    if like and (base / like).is_file():
        pattern = read_image(base, like, side)[0].resize(image.size)
    return amplified(image, base / less if less else None, pattern), tiny


def amplified(image: Image.Image, background: Path | None, pattern: Image.Image) -> Image.Image:
    """Return what differs from the background, amplified as ``pattern`` needs it.

    The strongest hundredth of the pattern's differences is then 110 gray levels from 128; those of
    less than two gray levels are amplified like those of two. Without a background what varies
    slowly over each image takes its place.
    """

    def contact_of(image: Image.Image) -> NDArray[np.float32]:
        if background is None:
            ground = image.filter(ImageFilter.GaussianBlur(max(image.size) / 12))
        else:
            with open_image(background) as file:
                ground = decoded(file)[0].resize(image.size)
        contact = np.asarray(image, np.float32) - np.asarray(ground, np.float32)
        return contact - np.median(contact, axis=(0, 1)).astype(np.float32)

    gain = 110 / max(float(np.quantile(np.abs(contact_of(pattern)), 0.99)), 2.0)
    gray = np.clip(128 + gain * contact_of(image), 0, 255)
    return Image.fromarray(gray.round().astype(np.uint8))
