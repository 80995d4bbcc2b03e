"""The images that an encoder was trained on, known by their prepared 8-bit pixels.

A digest is the first eight bytes of the pixels' SHA-256. Names play no part, as two data sets may
both have a ``0001.jpg``. 100,000 digests take 800 kB; that any of 100,000 other images has one of
them by chance has the probability 100,000^2 / 2^64 = 5e-10.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from palpate.core import PalpateError, require, require_regular

#: Digests of images, (n,) uint64.
Digests = NDArray[np.uint64]
#: Their file in the folder of an encoder.
SEEN = "seen.safetensors"
FETCH_AGAIN = "Fetch the encoder again"


def digest_images(images: NDArray[np.uint8]) -> Digests:
    """Digests (n,) of images (n, h, w, c) in memory or in a mapped file, in their order."""
    names = (hashlib.sha256(image.tobytes()).digest()[:8] for image in images)
    return np.frombuffer(b"".join(names), np.uint64)


def union(*sets: Digests | None) -> Digests:
    """The sorted distinct digests of several sets; None is an empty one."""
    return np.unique(np.concatenate([np.empty(0, np.uint64), *(s for s in sets if s is not None)]))


def save_seen(seen: Digests | None, folder: Path) -> None:
    """Write the digests into the folder of an encoder; None writes nothing."""
    if seen is not None:
        save_file({"digests": seen}, folder / SEEN)


def load_seen(folder: Path, count: int | None) -> Digests | None:
    """Read what :func:`save_seen` wrote.

    Args:
        folder: of the encoder.
        count: how many there must be, by the card; None for a card without a count.

    Raises:
        PalpateError: if the file is missing, damaged, or holds another number.
    """
    if count is None:
        return None
    require_regular(folder / SEEN)
    must = f"{folder / SEEN} must hold the digests of the {count:,} images of the training"
    try:
        seen = load_file(folder / SEEN)["digests"]
    except (OSError, KeyError, SafetensorError) as error:
        raise PalpateError(must, str(error), FETCH_AGAIN) from None
    complete = len(seen) == count and seen.dtype == np.uint64
    require(complete, None, must, f"{len(seen):,}", fix=FETCH_AGAIN)
    return seen
