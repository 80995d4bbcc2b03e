"""No-contact images of gels: which each sample is given, and what speaks against one by itself.

A sample has the manifest's, or all have one stock gel. Against an image speaks:

- *It shows contact.* Light falls on a gel smoothly, and markers are gray: of the opponent colors
  (channel minus mean of the channels), markers left out, a polynomial of degree 4 leaves hardly
  anything. A contact turns the surface towards and away from colored lights, and leaves more.
  Gels of the world leave up to 2.4 gray levels, those of the real clips of Touch and Go 2.7 to 3.6;
  87 % of the contacts of the world, and every listed one of the clips, leave more than 4
  (``benchmarks/gel_contacts.py``, commit 2254ad9).
- *It is of another sensor.* The lights of another one come from other sides: the relative opponent
  colors of 4 x 4 cells, their mean left out, differ from those of the stock gel. GelSights of the
  world differ by up to 3, the real ones by up to 7.4 from the world's, DIGITs by more than 12.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray
from PIL import Image

from palpate.core import Note, Progress, quiet
from palpate.data.images import cached_images, read_image, square
from palpate.data.manifest import Manifest
from palpate.encoders.rows import evenly_spaced
from palpate.metrics.markers import marker_mask

MEDIAN = 500  # images that a stock gel is the median of, at most
#: Gray levels that a smooth fit may leave of a gel without contact.
SMOOTH = 4.0
#: Difference of the light, on the scale of 0 to 128, from which it is another sensor.
OTHER_LIGHT = 10.0
_SIZE, _CELLS, _DEGREE = 64, 4, 4


def has_gels(part: Manifest) -> bool:
    """Whether the samples name no-contact images."""
    return any(part.column("background"))


def gels_of(
    part: Manifest,
    size: int,
    cache: Path | None = None,
    progress: Progress = quiet,
    like: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """The no-contact image of each sample, bytes (n, size, size, 3).

    Where no sample has one, all get one stock gel: the first of ``like``, or the median of up to
    500 of the tactile images.

    Raises:
        PalpateError: if some samples have one and others have not.
    """
    if has_gels(part):
        return cached_images(part, "background", size, cache, progress)
    if like is not None:
        return np.broadcast_to(like[0], (len(part), size, size, 3))
    images = cached_images(part, "tactile", size, cache, progress)
    stock = np.median(images[evenly_spaced(len(images), MEDIAN)], axis=0).astype(np.uint8)
    return np.broadcast_to(stock, images.shape)


def gel_notes(file: Path, stock: NDArray[np.uint8] | None) -> list[Note]:
    """What speaks against the no-contact image of a user.

    Args:
        file: the image.
        stock: the no-contact image (h, w, 3) of the generator's own sensor, or None.
    """
    pixels = square(read_image(file), _SIZE)
    if (left := unevenness(pixels)) > SMOOTH:
        return [Note("gel-contact", {"gel": file.name, "left": left})]
    if stock is not None and light_difference(pixels, stock) > OTHER_LIGHT:
        return [Note("gel-sensor", {"gel": file.name})]
    return []


def unevenness(gel: NDArray[np.uint8]) -> float:
    """Gray levels of color that a smooth fit leaves of an image (64, 64, 3)."""
    image = gel / 255.0
    away = ~np.asarray(scipy.ndimage.binary_dilation(marker_mask(image)), bool)
    if away.mean() < 0.5:  # no gel is mostly markers
        away[:] = True
    y, x = np.mgrid[-1 : 1 : image.shape[0] * 1j, -1 : 1 : image.shape[1] * 1j]
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    smooth = np.stack([x[away] ** i * y[away] ** j for i, j in powers], axis=1)
    colors = (image - image.mean(axis=2, keepdims=True))[away]
    left = colors - smooth @ np.linalg.lstsq(smooth, colors, rcond=None)[0]
    return 255 * float(np.sqrt((left**2).sum(axis=1).mean()))


def light_difference(gel: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """How differently two gels are lit: 0 for the same lights, of whatever brightness."""
    return float(np.sqrt(((_light(gel) - _light(other)) ** 2).mean()))


def _light(gel: NDArray[np.uint8]) -> NDArray[np.float64]:
    small = Image.fromarray(gel).resize((_CELLS, _CELLS), Image.Resampling.BOX)
    cells = np.asarray(small, np.float64)
    mean = cells.mean(axis=2, keepdims=True)
    colors = 128 * (cells - mean) / np.maximum(mean, 1)
    return colors - colors.mean(axis=(0, 1))
