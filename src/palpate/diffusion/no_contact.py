"""The no-contact image that each sample is given: the manifest's, else one stock gel for all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress, quiet
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.encoders.rows import evenly

MEDIAN = 500  # images that a stock gel is the median of, at most


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
    stock = np.median(images[evenly(len(images), MEDIAN)], axis=0).astype(np.uint8)
    return np.broadcast_to(stock, images.shape)
