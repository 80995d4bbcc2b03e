"""Whether a set of images shows anything: contacts, or views that differ.

Untouched gel varies by its light, by slow drift and by noise. Of at most ``SAMPLED`` images x (48 x
48, RGB) minus their background, or minus the median image, with the gain that fits it best, the
power P(k) of the cosine transform is compared between the scale of contacts and that of pixels:

    ratio = sqrt(mean P(6 <= k < 20) / mean P(k >= 36)),    k the higher of both frequencies.

White noise has ratio 1, whatever its strength; light and drift lie below k = 6. A set shows nothing
where 99 % of its images stay under ``LIMIT``. Measured (99 %): drift and noise alone 1.14, the five
real clips 2.2 to 4.1, the procedural world 5.5 with markers and 9.5 without. Gels that differ
between videos, and noise that a codec has smoothed, count as something.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import PalpateError, Progress, quiet
from palpate.data.images import in_threads, read_image
from palpate.data.manifest import Manifest

#: Images that are looked at, evenly over the set, and how few are too few to say anything.
SAMPLED, FEWEST = 400, 20
SIDE = 48
LIMIT, SHARE = 1.5, 0.99
#: Least noise that is divided by, in gray levels: equal images have none.
NOISE = 0.05

#: Orthonormal cosine transform: a frequency a row.
_LENGTHS = np.sqrt([1 / SIDE, *[2 / SIDE] * (SIDE - 1)])
_ANGLES = np.pi / SIDE * np.outer(np.arange(SIDE), np.arange(SIDE) + 0.5)
COSINES = (_LENGTHS[:, None] * np.cos(_ANGLES)).astype(np.float32)

Floats = NDArray[np.float32]


def shows_nothing(parts: Sequence[Manifest], column: str, progress: Progress = quiet) -> bool:
    """Whether the images of a column differ by light, drift and noise alone.

    Backgrounds are used if all samples have one.

    Returns:
        False if there are fewer than ``FEWEST`` images that are readable and of 48 pixels or more.
    """
    tables = [m.table.select(column, "background").drop_nulls(column) for m in parts]
    rows = [
        tuple(name and m.path(name) for name in row)
        for m, table in zip(parts, tables, strict=True)
        for row in table.iter_rows()
    ]
    rows = [rows[k] for k in np.unique(np.linspace(0, len(rows) - 1, SAMPLED).astype(int)) if rows]
    recorded = column == "tactile" and all(background for _, background in rows)
    pairs = rows if recorded else [(path, path) for path, _ in rows]
    files = sorted({path for pair in pairs for path in pair if path})
    small = dict(in_threads(_thumbnail, files, "looking for contact", progress))
    readable = [(small[a], small[b]) for a, b in pairs if a and b]
    readable = [(x, ground) for x, ground in readable if x is not None and ground is not None]
    if len(readable) < FEWEST:
        return False
    images, grounds = (np.stack(side) for side in zip(*readable, strict=True))
    ratio = structure(images, grounds if recorded else np.median(images, axis=0, keepdims=True))
    return bool(np.quantile(ratio, SHARE) < LIMIT)


def structure(images: Floats, grounds: Floats) -> Floats:
    """(n,) the ratio at the head of this file.

    Args:
        images: (n, 48, 48, 3).
        grounds: (n, 48, 48, 3) or (1, 48, 48, 3), what is subtracted.
    """
    x, ground = (a - a.mean((1, 2), keepdims=True) for a in (images, grounds))
    gain = (x * ground).sum((1, 2), keepdims=True)
    gain /= np.maximum((ground**2).sum((1, 2), keepdims=True), 1)
    rest, shape = x - gain * ground, (len(x), SIDE, -1)
    for _ in range(2):  # the transform of one axis, which becomes the other
        rest = (COSINES @ rest.reshape(shape)).reshape(x.shape).swapaxes(1, 2)
    power, k = rest**2, np.maximum(*np.mgrid[:SIDE, :SIDE])
    contact, pixels = (power[:, band].mean((1, 2)) for band in ((k >= 6) & (k < 20), k >= 36))
    return np.sqrt(contact) / np.maximum(np.sqrt(pixels), NOISE)


def _thumbnail(path: Path) -> Floats | None:
    """The image at 48 x 48; None if it is smaller or cannot be read."""
    try:
        image = read_image(path, (SIDE, SIDE))
    except PalpateError:  # the signals name it
        return None
    if min(image.size) < SIDE:
        return None
    return np.asarray(image.convert("RGB").resize((SIDE, SIDE), Image.Resampling.BOX), np.float32)
