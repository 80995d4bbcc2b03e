"""Photos as they are sent: at most 768 pixels a side, JPEG of quality 90, no metadata.

A crop is a rectangle in shares of width and height. It follows the whole photo as a second image.
"""

from __future__ import annotations

import io
import threading
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from palpate.core import PalpateError
from palpate.data.images import BROKEN, read_image

SIDE, QUALITY = 768, 90
Crop = tuple[float, float, float, float]
# One photo at a time: a photo is read in many small steps, and threads that take turns after each
# of them need half as much time again.
_LOCK = threading.Lock()


def checked_crop(crop: Sequence[float] | None) -> Crop | None:
    """Return a crop as four shares.

    Raises:
        PalpateError: if it is no rectangle inside the photo.
    """
    if crop is None:
        return None
    box = tuple(map(float, crop))
    if len(box) != 4 or not (0 <= box[0] < box[2] <= 1 and 0 <= box[1] < box[3] <= 1):
        must = "must be left, top, right and bottom in shares of the photo, from 0 to 1"
        got = " ".join(f"{value:g}" for value in box)
        raise PalpateError(must, got, "", argument="crop", example={"crop": [0.3, 0.3, 0.7, 0.7]})
    return box


def prepared(path: Path, crop: Crop | None) -> tuple[bytes, ...]:
    """The JPEG files that are sent for a photo.

    Raises:
        PalpateError: if the photo is missing, truncated or none.
    """
    with _LOCK:
        photo = read_image(path)
        return tuple(_jpeg(photo.crop(box)) for box in _boxes(photo.size, crop))


def sent_size(path: Path, crop: Crop | None) -> list[tuple[int, int]]:
    """Width and height of what is sent for a photo, by its header; of a square if it has none."""
    try:
        with Image.open(path) as image:
            size = image.size
    except BROKEN:
        size = (SIDE, SIDE)
    sizes: list[tuple[int, int]] = []
    for left, top, right, bottom in _boxes(size, crop):
        scale = min(1.0, SIDE / max(right - left, bottom - top))
        sizes.append((round(scale * (right - left)), round(scale * (bottom - top))))
    return sizes


def _boxes(size: tuple[int, int], crop: Crop | None) -> list[tuple[int, int, int, int]]:
    """Pixels of the whole photo and of the crop."""
    width, height = size
    boxes = [(0, 0, width, height)]
    if crop is not None:
        left, top = int(crop[0] * width), int(crop[1] * height)
        right, bottom = round(crop[2] * width), round(crop[3] * height)
        boxes.append((left, top, max(left + 1, right), max(top + 1, bottom)))
    return boxes


def _jpeg(image: Image.Image) -> bytes:
    if max(image.size) > SIDE:
        image.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    image.save(data, "JPEG", quality=QUALITY, exif=b"", icc_profile=None)
    return data.getvalue()
