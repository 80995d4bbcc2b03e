"""Images of a study: all of one size, encoded anew, so that no file gives its method away.

The center square of every image, as generators see it, is resized to ``size`` pixels and written as
JPEG without metadata.
"""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from palpate.data.images import read_image, square

QUALITY = 92


def load_square(path: Path, size: int) -> NDArray[np.uint8]:
    """Read the center square of an image file: (size, size, 3), 0 to 255.

    Raises:
        PalpateError: if the file is missing or broken.
    """
    return square(read_image(path), size)


def data_uri(image: NDArray[np.uint8], quality: int = QUALITY) -> str:
    """Encode an image (h, w, 3) as JPEG without metadata, as a data URI."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def estimated_gel(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The sensor without contact: the mean of (n, h, w, 3) images without any detail."""
    mean = Image.fromarray(images.mean(axis=0).round().astype(np.uint8))
    return np.asarray(mean.filter(ImageFilter.GaussianBlur(images.shape[1] / 8)))
