"""Thumbnails as ``data:`` URIs that fit a budget of bytes.

Images of at most 96 pixels a side are kept without loss (WebP; the page magnifies them without
smoothing), larger ones become JPEG. If the page is too large with them, first the small images
become JPEG, then all images shrink, then the last rows are skipped. A missing or broken image is
drawn as a placeholder with its name.
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

#: Pixels of the longest side of a file that is kept without loss.
TINY = 96
#: (longest side in pixels, JPEG quality), best first.
SIZES = ((256, 88), (192, 86), (160, 84), (128, 82), (96, 78), (64, 72), (48, 64), (32, 60))
#: From this quality on JPEG keeps the full resolution of color.
FULL_COLOR = 86
#: From this side in pixels down, rows that the page folds are skipped before images shrink further.
KEEP_ALL = 128
#: Estimated bytes of HTML around the images of one row.
ROW_MARKUP = 1_500


class ImageRequest(NamedTuple):
    """An image that a page or a figure asks for.

    Attributes:
        path: the file; None if the sample has no such image.
        alt: what it shows, in words.
        label: heading of its column.
        subtract: file of an image without contact: the difference from it is drawn, amplified (see
            :func:`amplified`); '' subtracts a blurred copy of the image itself; None draws the
            image as it is.
        gain_from: file whose difference sets the amplification, so that a real and a generated
            image are amplified alike; None: the image itself.
    """

    path: str | None
    alt: str
    label: str
    subtract: str | None = None
    gain_from: str | None = None


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
    """The rows of images that fit on the page.

    Attributes:
        rows: key of a row -> its images, each as it was asked for and as it is shown.
        side: most pixels a side of the thumbnails.
    """

    rows: Mapping[Hashable, Sequence[tuple[ImageRequest, Thumbnail]]]
    side: int

    @property
    def broken(self) -> int:
        """The number of files that could not be read."""
        images = (image for row in self.rows.values() for image in row)
        return len({r.path for r, thumbnail in images if r.path and thumbnail.problem})


def fit(
    rows: Mapping[Hashable, Sequence[ImageRequest]],
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
        essential: number of first rows that stay even if images must be smaller than 128 pixels;
            the others are then skipped.
        progress: called after each row.
    """
    fitting: dict[Hashable, Sequence[tuple[ImageRequest, Thumbnail]]] = {}
    side = 0
    for side, quality in SIZES:
        fitting, used = {}, 0
        for key, requests in track(list(rows.items()), f"images of {side} px", progress):
            images = [(request, thumbnail(base, request, side, quality)) for request in requests]
            used += ROW_MARKUP + sum(len(image.uri) for _, image in images)
            if used > budget:
                break
            fitting[key] = images
        enough = len(rows) if side > KEEP_ALL else min(essential, len(rows))
        if len(fitting) >= enough:
            break
    return Album(fitting, side)


@lru_cache(maxsize=4096)  # the page tries several budgets
def thumbnail(base: Path, request: ImageRequest, side: int, quality: int) -> Thumbnail:
    """Encode one image with at most ``side`` pixels a side; JPEG has ``quality``, 0 to 100."""
    try:
        image, tiny = read_image(base, request, side)
    except ImageError as error:
        return Thumbnail(problem=str(error))
    # At smaller sizes bytes are short, and differences are amplified noise: JPEG serves for both.
    lossless = tiny and side == SIZES[0][0] and request.subtract is None
    kind = "webp" if lossless else "jpeg"
    subsampling = 0 if quality >= FULL_COLOR else 2
    data = image_bytes(image, kind, lossless=lossless, quality=quality, subsampling=subsampling)
    uri = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return Thumbnail(uri, image.width, image.height, tiny)


def read_image(base: Path, request: ImageRequest, side: int) -> tuple[Image.Image, bool]:
    """Read a requested image with at most ``side`` pixels a side.

    Returns:
        The image, 8-bit RGB, and whether its file has at most 96 pixels a side.

    Raises:
        ImageError: if there is none or a file cannot be read, with the reason.
    """
    if request.path is None:
        raise ImageError("not recorded")
    image, tiny = _reduced(base / request.path, side)
    if request.subtract is None:
        return image, tiny
    gain_image = image
    if request.gain_from and (base / request.gain_from).is_file():
        gain_image = _reduced(base / request.gain_from, side)[0].resize(image.size)
    background = base / request.subtract if request.subtract else None
    return amplified(image, background, gain_image), tiny


def _reduced(path: Path, side: int) -> tuple[Image.Image, bool]:
    with open_image(path) as file:
        tiny = max(file.size) <= TINY
        image, _ = decoded(file, (2 * side, 2 * side))
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    return image, tiny


def amplified(image: Image.Image, background: Path | None, gain_image: Image.Image) -> Image.Image:
    """Return 128 + gain · d(image), with d(x) = x - background less its median per channel.

    The gain brings the 99th percentile of ``|d(gain_image)|`` to 110 gray levels; where that is
    under 2 gray levels (no contact, only noise) it counts as 2. Without a ``background`` each image
    less a blurred copy of itself is taken, which removes what varies slowly.
    """

    def difference(image: Image.Image) -> NDArray[np.float32]:
        if background is None:
            base = image.filter(ImageFilter.GaussianBlur(max(image.size) / 12))
        else:
            with open_image(background) as file:
                base = decoded(file)[0].resize(image.size)
        contact = np.asarray(image, np.float32) - np.asarray(base, np.float32)
        return contact - np.median(contact, axis=(0, 1)).astype(np.float32)

    gain = 110 / max(float(np.quantile(np.abs(difference(gain_image)), 0.99)), 2.0)
    gray = np.clip(128 + gain * difference(image), 0, 255)
    return Image.fromarray(gray.round().astype(np.uint8))
