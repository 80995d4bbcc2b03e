"""Touch without the sensor: what the contact adds to the picture of the passive gel.

Untouched gel (its colors, its markers) makes all frames of one sensor look alike, so a tactile thumbnail t is compared by what is left after its background b:

1. *Registration.* b is moved by the offset of at most 2 of 32 pixels at which the luminance of both, band-passed, correlates best (quarters, then the
   peak of a parabola, to a sixteenth): a picture that was cropped elsewhere than its background would keep every marker twice. Markers are about a pixel
   wide, so the move is a cubic spline; linear interpolation would flatten them by up to a third, and what is left of them outweighs a faint print. Rows
   and columns that b does not reach are unknown: they have no weight, and are filled with the blurred difference beside them.
2. *Gain.* For each channel r = (t - mean) - g (b - mean) with g in [0.85, 1.15] by least squares, pixels weighted by 1 / (1 + e / 4 median e), e the
   squared residual of the round before: the contact itself must not set the gain.

A touch without a background of its own takes the pixelwise median of its video's frames; if those are fewer than 8, of its sensor's, else of all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.leakage.verify import REACH, SIDE, Floats, Ints, Shifts, band_pass, best_offset

QUARTERS = Shifts.of(0.25)
#: Moves to a pixel, and by how much a move may reach beyond the background's outermost pixels.
FINEST, BEYOND = 16, 0.3
GAIN = (0.85, 1.15)
ROUNDS = 3
#: Frames that a median needs, and how many it takes at most.
FEWEST, MOST = 8, 200
#: Gray levels squared: keeps the gain at 1 where the background is flat.
_RIDGE = 0.05


def _moves() -> Floats:
    """(65, 32, 32): matrices that move a column of pixels by -2 ... 2 in sixteenths, cubic between pixels, edges repeated."""
    eye = np.eye(SIDE)
    moved = [
        ndimage.shift(eye, (-d / FINEST, 0), order=3, mode="nearest")
        for d in range(-REACH * FINEST, REACH * FINEST + 1)
    ]
    return np.stack(moved).astype(np.float32)


_MOVES = _moves()
_BESIDE = ndimage.gaussian_filter1d(np.eye(SIDE), 1.5, axis=0, mode="nearest").astype(np.float32)


def planar(pixels: NDArray[np.uint8]) -> Floats:
    """(n, 32, 32, 3) bytes as (n, 3, 32, 32) float32."""
    return np.ascontiguousarray(np.moveaxis(pixels, -1, 1), dtype=np.float32)


def remove_background(touch: Floats, background: Floats) -> Floats:
    """What the contact adds.

    Args:
        touch: (n, 3, 32, 32) YCbCr, 0 to 255.
        background: (n, 3, 32, 32), each the background of its touch.

    Returns:
        (n, 3, 32, 32) signed gray levels, each channel's weighted mean near 0.
    """
    luma = [
        band_pass(np.concatenate([x[:, :1], np.zeros_like(x[:, 1:])], axis=1))
        for x in (touch, background)
    ]
    steps = np.round(best_offset(luma[0], luma[1], QUARTERS) * FINEST).astype(np.int64)
    down, right = _MOVES[steps[:, 0] + REACH * FINEST], _MOVES[steps[:, 1] + REACH * FINEST]
    moved = down[:, None] @ background @ right.transpose(0, 2, 1)[:, None]
    known = _known((steps / FINEST).astype(np.float32))
    weight = known
    left = touch - moved
    for _ in range(ROUNDS):
        total = weight.sum(axis=(2, 3), keepdims=True)
        t = touch - (weight * touch).sum(axis=(2, 3), keepdims=True) / total
        b = moved - (weight * moved).sum(axis=(2, 3), keepdims=True) / total
        weighted = weight * b
        across = (weighted * t).sum(axis=(2, 3), keepdims=True) + _RIDGE * total
        gain = np.clip(
            across / ((weighted * b).sum(axis=(2, 3), keepdims=True) + _RIDGE * total), *GAIN
        )
        left = t - gain * b
        error = np.square(left).sum(axis=1, keepdims=True)
        weight = known / (1 + error / (4 * np.median(error, axis=(2, 3), keepdims=True) + 1e-3))
    beside = (_BESIDE @ (known * left) @ _BESIDE.T) / (
        _BESIDE @ known @ _BESIDE.T + np.float32(1e-6)
    )
    return np.where(known > 0, left, beside).astype(np.float32, copy=False)


def _known(offsets: Floats) -> Floats:
    """(n, 1, 32, 32): 1 where a background that is read ``offsets`` (n, 2) pixels further down and right reaches, else 0."""
    at = np.arange(SIDE) + offsets[:, :, None]
    inside = (at >= -BEYOND) & (at <= SIDE - 1 + BEYOND)
    return (inside[:, 0, :, None] & inside[:, 1, None, :])[:, None].astype(np.float32)


@dataclass(frozen=True)
class Backgrounds:
    """The background of each touch.

    Attributes:
        row: (n,) for each sample its row in ``pixels``.
        pixels: (b, 32, 32, 3) YCbCr.
        own: (n,) whether it is the sample's own background and not a median.
        medians: how many samples took the median of their video, of their sensor, of all.
    """

    row: Ints
    pixels: NDArray[np.uint8]
    own: NDArray[np.bool_]
    medians: tuple[int, int, int]


def backgrounds(
    touch: Ints, own: Ints, pixels: NDArray[np.uint8], videos: Ints, sensors: Ints
) -> Backgrounds:
    """Gives each sample its own background or a median.

    Args:
        touch: (n,) rows of the tactile pictures in ``pixels``; -1 where unreadable.
        own: (n,) rows of their backgrounds; -1 where there is none.
        pixels: (u, 32, 32, 3).
        videos: (n,) codes; -1 where unknown.
        sensors: (n,) codes; -1 where unknown.
    """
    used, row = np.unique(own, return_inverse=True)
    shift = int(used.size > 0 and used[0] < 0)
    pictures = [pixels[used[shift:]]]
    row = row.astype(np.int64) - shift
    count, counts = len(used) - shift, [0, 0, 0]
    missing = (own < 0) & (touch >= 0)
    for level, codes in enumerate((videos, sensors, np.zeros_like(videos))):
        for code in np.unique(codes[missing & (codes >= 0)]).tolist():
            members = np.unique(touch[(codes == code) & (touch >= 0)])
            if len(members) < FEWEST and level < 2:
                continue
            if len(members) > MOST:
                members = members[np.linspace(0, len(members) - 1, MOST).astype(np.int64)]
            wanted = missing & (codes == code)
            pictures.append(np.median(pixels[members], axis=0).astype(np.uint8)[None])
            row[wanted], missing[wanted] = count, False
            count += 1
            counts[level] += int(wanted.sum())
    return Backgrounds(row, np.concatenate(pictures), own >= 0, (counts[0], counts[1], counts[2]))
