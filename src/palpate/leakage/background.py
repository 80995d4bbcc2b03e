"""Tactile images without the sensor: what the contact adds to the image of the passive gel.

Untouched gel (its colors, its markers) makes all frames of one sensor similar, so a tactile
thumbnail t is compared by what is left after its background b:

1. *Registration.* b is moved by the offset of at most 2 of 32 pixels at which the luminance of
both,
   band-passed, correlates best: an image that was cropped elsewhere than its background would keep
   every marker twice. Markers are about a pixel wide, so the move is a cubic spline (a linear one
   flattens them by up to a third, and what is left outweighs a faint print). Rows and columns that
   b does not reach have no weight, and are filled with the blurred difference next to them.
2. *Gain.* For each channel r = (t - mean) - g (b - mean) with g in [0.85, 1.15] by least squares,
   pixels weighted by 1 / (1 + e / 4 median e), e the squared residual of the round before: the
   contact itself must not set the gain.

A tactile image without a background takes the pixelwise median of its video's frames; if those are
fewer than 8, of its sensor's, else of all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.leakage.correlation import (
    REACH,
    Floats,
    Ints,
    Shifts,
    band_pass,
    best_offset,
    blur_matrix,
)
from palpate.leakage.thumbnails import SIDE

QUARTERS = Shifts.of(0.25)
#: Moves to a pixel, and by how much a move may reach beyond the background's outermost pixels.
FINEST, BEYOND = 16, 0.3
GAIN = (0.85, 1.15)
ROUNDS = 3
#: Frames that a median needs, and how many it takes at most.
FEWEST, MOST = 8, 200
#: Gray levels squared: keeps the gain at 1 where the background is flat.
_RIDGE = 0.05
_BLUR = blur_matrix(1.5)
#: (65, 32, 32) matrices that move a column of pixels by -2 ... 2 in sixteenths, edges repeated.
_MOVES = np.stack(
    [
        ndimage.shift(np.eye(SIDE), (-d / FINEST, 0), order=3, mode="nearest")
        for d in range(-REACH * FINEST, REACH * FINEST + 1)
    ]
).astype(np.float32)


def planar(pixels: NDArray[np.uint8]) -> Floats:
    """(n, 32, 32, 3) bytes as (n, 3, 32, 32) float32."""
    return np.ascontiguousarray(np.moveaxis(pixels, -1, 1), dtype=np.float32)


def remove_background(tactile: Floats, background: Floats) -> Floats:
    """What the contact adds.

    Args:
        tactile: (n, 3, 32, 32) YCbCr, 0 to 255.
        background: (n, 3, 32, 32), each the background of its tactile image.

    Returns:
        (n, 3, 32, 32) signed gray levels, each channel's weighted mean near 0.
    """
    only_luma = np.array([1, 0, 0], np.float32)[:, None, None]
    luma = [band_pass(x * only_luma) for x in (tactile, background)]
    steps = np.round(best_offset(luma[0], luma[1], QUARTERS) * FINEST).astype(np.int64)
    down, right = _MOVES[steps[:, 0] + REACH * FINEST], _MOVES[steps[:, 1] + REACH * FINEST]
    moved = down[:, None] @ background @ right.transpose(0, 2, 1)[:, None]
    known = _known((steps / FINEST).astype(np.float32))
    weight, residual = known, tactile - moved
    total = lambda x: x.sum(axis=(2, 3), keepdims=True)  # noqa: E731
    for _ in range(ROUNDS):
        t = tactile - total(weight * tactile) / total(weight)
        b = moved - total(weight * moved) / total(weight)
        ridge = _RIDGE * total(weight)
        gain = np.clip((total(weight * b * t) + ridge) / (total(weight * b * b) + ridge), *GAIN)
        residual = t - gain * b
        error = np.square(residual).sum(axis=1, keepdims=True)
        weight = known / (1 + error / (4 * np.median(error, axis=(2, 3), keepdims=True) + 1e-3))
    blurred = (_BLUR @ (known * residual) @ _BLUR.T) / (_BLUR @ known @ _BLUR.T + np.float32(1e-6))
    return np.where(known > 0, residual, blurred).astype(np.float32, copy=False)


def _known(offsets: Floats) -> Floats:
    """(n, 1, 32, 32): 1 where a background moved by ``offsets`` (n, 2) pixels reaches, else 0."""
    at = np.arange(SIDE) + offsets[:, :, None]
    inside = (at >= -BEYOND) & (at <= SIDE - 1 + BEYOND)
    return (inside[:, 0, :, None] & inside[:, 1, None, :])[:, None].astype(np.float32)


@dataclass(frozen=True)
class Backgrounds:
    """The background of each tactile image.

    Attributes:
        row: (n,) for each sample its row in ``pixels``.
        pixels: (b, 32, 32, 3) YCbCr.
        recorded: (n,) whether it is the sample's background file and not a median.
        medians: how many samples took the median of their video, of their sensor, of all.
    """

    row: Ints
    pixels: NDArray[np.uint8]
    recorded: NDArray[np.bool_]
    medians: tuple[int, int, int]


def backgrounds(
    tactile: Ints, recorded: Ints, pixels: NDArray[np.uint8], videos: Ints, sensors: Ints
) -> Backgrounds:
    """Give each sample its recorded background or a median.

    Args:
        tactile: (n,) rows of the tactile images in ``pixels``; -1 where unreadable.
        recorded: (n,) rows of their backgrounds; -1 where there is none.
        pixels: (u, 32, 32, 3).
        videos: (n,) codes; -1 where unknown.
        sensors: (n,) codes; -1 where unknown.
    """
    used = np.unique(recorded[recorded >= 0])
    row = np.where(recorded >= 0, np.searchsorted(used, recorded), -1).astype(np.int64)
    images, counts = [pixels[used]], [0, 0, 0]
    missing = (recorded < 0) & (tactile >= 0)
    number = len(used)
    for level, codes in enumerate((videos, sensors, np.zeros_like(videos))):
        for code in np.unique(codes[missing & (codes >= 0)]).tolist():
            members = np.unique(tactile[(codes == code) & (tactile >= 0)])
            if len(members) < FEWEST and level < 2:
                continue
            if len(members) > MOST:
                members = members[np.linspace(0, len(members) - 1, MOST).astype(np.int64)]
            wanted = missing & (codes == code)
            images.append(np.median(pixels[members], axis=0).astype(np.uint8)[None])
            row[wanted], missing[wanted] = number, False
            number += 1
            counts[level] += int(wanted.sum())
    return Backgrounds(
        row, np.concatenate(images), recorded >= 0, (counts[0], counts[1], counts[2])
    )
