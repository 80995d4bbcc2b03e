"""Which images an encoder was trained on.

An image is known by the first eight bytes of SHA-256 over its pixels as the encoder sees them:
decoded, cut and resized, before normalization. Names play no part, as two data sets may both have a
``0001.jpg``. 100,000 images take 800 kB; that any of 100,000 others has the digest of one of these
by chance has the probability 100,000^2 / 2^64 = 5e-10.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from palpate.core import PalpateError

#: Digests of images, (n,) uint64.
Digests = NDArray[np.uint64]
FILE = "seen.safetensors"


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
        save_file({"digests": seen}, folder / FILE)


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
    must = f"{folder / FILE} must hold the digests of the {count:,} images of the training"
    try:
        seen = load_file(folder / FILE)["digests"]
    except (OSError, KeyError, SafetensorError) as error:
        raise PalpateError(must, str(error), "Fetch the encoder again") from None
    if len(seen) != count or seen.dtype != np.uint64:
        raise PalpateError(must, f"{len(seen):,}", "Fetch the encoder again")
    return seen
