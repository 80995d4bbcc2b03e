"""Images of a study: all of one size, encoded anew, so that no file gives its method away.

The center square of every image, as generators see it, is resized to ``size`` pixels and written as
JPEG without metadata. Very large images are decoded at a fraction where they are JPEG.
"""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter, ImageOps
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from palpate.core import PalpateError
from palpate.data.images import BROKEN, LARGEST, opened, read_image, rgb, square

QUALITY = 92
#: Pixels of the largest image that is scaled down: a byte or three each.
LARGEST_SCALED = 400_000_000
#: Modes that Pillow does not reduce -> those that hold as much, and are reduced.
WIDER = {"1": "L", "P": "RGBA", "I;16": "I"}


def load_square(path: Path, size: int) -> NDArray[np.uint8]:
    """Read the center square of an image file: (size, size, 3), 0 to 255.

    Raises:
        PalpateError: if the file is missing, broken, or of more than ``LARGEST_SCALED`` pixels.
    """
    large = _opened_large(path)
    if large is None:
        _require_decodable(path)
    return square(read_image(path) if large is None else _reduced(large, size), size)


def _require_decodable(path: Path) -> None:
    """Check that :func:`read_image` takes so many pixels; other faults are left to it."""
    try:
        opened(path).close()
    except Image.DecompressionBombError as error:
        fix = f"Save it as PNG or JPEG of at most {LARGEST_SCALED:,} pixels, or smaller"
        raise PalpateError(f"The image {path} must be small enough", str(error), fix) from None
    except BROKEN:
        pass


def _opened_large(path: Path) -> Image.Image | None:
    """A JPEG or PNG of more pixels than :func:`read_image` takes, not decoded yet; else None."""
    for kind in (JpegImageFile, PngImageFile):
        try:
            image = kind(path)  # unlike Image.open without a limit of its own
        except BROKEN:
            continue
        return image if LARGEST < image.width * image.height <= LARGEST_SCALED else None
    return None


def _reduced(image: Image.Image, size: int) -> Image.Image:
    """A large image at a fraction of its size, in RGB."""
    try:
        image.draft("RGB", (2 * size, 2 * size))
        factor = max(1, min(image.size) // (2 * size))
        wide = image.convert(WIDER[image.mode]) if image.mode in WIDER else image
        return rgb(ImageOps.exif_transpose(wide.reduce(factor)))
    except BROKEN as error:
        must = f"The image {image.filename} must be whole and readable"  # type: ignore[attr-defined]
        raise PalpateError(must, str(error), "Fetch the file again") from None


def data_uri(image: NDArray[np.uint8], quality: int = QUALITY) -> str:
    """Encode an image (h, w, 3) as JPEG without metadata, as a data URI."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def estimated_gel(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The sensor without contact: the mean of (n, h, w, 3) images without any detail."""
    mean = Image.fromarray(images.mean(axis=0).round().astype(np.uint8))
    return np.asarray(mean.filter(ImageFilter.GaussianBlur(images.shape[1] / 8)))
