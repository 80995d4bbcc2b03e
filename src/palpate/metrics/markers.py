"""Marker motion: how far the printed markers of a gel moved between its no-contact image and a
touch.

Markers are printed on the gel's skin and move with it, so their displacement shows the forces: the
mean vector is the shear, the divergence grows with the normal load, the curl with a twist about the
normal. Everything here is in % of the image's width, x to the right and y down.

* *Ink*: ``max(0, 1 - luma / around)``, around the median luma in a window of a sixth of the side.
  A marker is a connected area of ink above 0.18; its center is that of its ink, the pixels next to
  it included, so that it is known to a fiftieth of a pixel. Markers at the edge are left out.
* *Matching*: an affine map from the gel's markers to the nearest ones, refitted robustly. Markers
  form a lattice, so that a motion of half its pitch has two readings: where one start gives a large
  motion, others (shifts, a dilation) are tried, and that of the least distance, in position and in
  amount of ink, is taken. Then each marker is matched to the nearest one around where its neighbors
  went, and kept if it agrees with their median.
* *No markers*: fewer than eight matches, or spots as irregular as dirt.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from palpate.metrics.images import Array, as_unit

Mask = NDArray[np.bool_]

#: A marker is darker than this share of the median luma in a window of a sixth of the side.
MARKER = 0.82
LUMA = np.array([0.299, 0.587, 0.114])
#: Markers that must be matched.
FEWEST = 8
#: Ink of a marker in pixels of an image of 64 rows.
INK = (0.4, 40.0)
#: Interquartile range over median of the distances to the nearest marker; .77 at random places.
IRREGULAR = 0.5
#: Motion up to which one start is enough, and those tried beyond, all as shares of the pitch.
SURE, SHIFTS, DILATIONS = 0.3, (0.0, -0.4, 0.4), (0.0, 0.1)
#: What counts against an affine map, in shares of the pitch: a difference in ink by the factor e,
#: the most of it, a marker without a match, the way that the markers go.
OF_INK, MOST_OF_INK, LOST, OF_WAY = 0.1, 0.2, 0.6, 0.05
#: How near to where its neighbors went, or the map before, a marker is looked for, and how well it
#: must agree with them, in shares of the pitch.
NEAR, AGREES = (0.5, 0.35), 0.12


@dataclass(frozen=True)
class MarkerMotion:
    """The displacement of the markers that are visible in both images.

    Attributes:
        at: (m, 2) centers in the no-contact image, x and y in % of the width.
        moves: (m, 2) displacement, x right and y down in % of the width.
    """

    at: Array
    moves: Array

    @property
    def mean(self) -> Array:
        """(2,) the mean displacement, the net shear [% of the width]."""
        return self.moves.mean(axis=0)

    @property
    def rms(self) -> float:
        """Root mean square length of the displacements [% of the width]."""
        return float(np.sqrt((self.moves**2).sum(axis=1).mean()))

    @property
    def divergence(self) -> float:
        """Mean dx'/dx + dy'/dy, of an affine fit [%]: markers are pushed apart by a load."""
        gradient = self._gradient
        return 100 * float(gradient[0, 0] + gradient[1, 1])

    @property
    def curl(self) -> float:
        """Mean dy'/dx - dx'/dy, of an affine fit [%]: twice the rotation, clockwise positive."""
        gradient = self._gradient
        return 100 * float(gradient[0, 1] - gradient[1, 0])

    @property
    def _gradient(self) -> Array:
        """(2, 2) derivatives by x and y (rows) of the displacement in x and y."""
        return _solved(_affine(self.at, self.at), self.moves)[1:]


def marker_motion(tactile: NDArray[Any], background: NDArray[Any]) -> MarkerMotion | None:
    """The displacement of the markers between a gel without contact and in a touch.

    Args:
        tactile: (h, w, 3 or 1), uint8 or float in [0, 1].
        background: the same shape: the gel without contact.

    Returns:
        The motion, or None where the gel has no markers, or too few are found again.
    """
    seen = (luma_and_around(as_unit(image)) for image in (tactile, background))
    return motion_of(*seen)


def motion_of(tactile: tuple[Array, Array], background: tuple[Array, Array]) -> MarkerMotion | None:
    """:func:`marker_motion` of what :func:`luma_and_around` gives of both images."""
    (gel, ink), (image, other) = _spots(*background), _spots(*tactile)
    if min(len(gel), len(image)) < FEWEST:
        return None
    distance = _distances(gel, gel)
    np.fill_diagonal(distance, np.inf)
    low, pitch, high = np.quantile(distance.min(axis=1), (0.25, 0.5, 0.75))
    if high - low > IRREGULAR * pitch:
        return None
    gel, image = gel / pitch, image / pitch
    guess = _affine_motion(gel, image, np.log(ink), np.log(other))
    at, moves, off = gel[:0], gel[:0], gel[:0, 0]
    for reach in NEAR:
        rows, to = _matches(_distances(gel + guess, image), reach)
        if len(rows) < FEWEST:
            return None
        at, moves = gel[rows], image[to] - gel[rows]
        guess = _smooth(gel, at, moves)
        off = np.linalg.norm(moves - guess[rows], axis=1)
    kept = off < max(AGREES, 3 * 1.4826 * float(np.median(off)))
    percent = 100 * pitch / background[0].shape[1]
    return MarkerMotion(percent * at[kept], percent * moves[kept]) if kept.sum() >= FEWEST else None


def marker_mask(image: Array) -> Mask:
    """The pixels (h, w) of an image (h, w, c) in [0, 1] that are a marker."""
    return is_marker(*luma_and_around(image))


def is_marker(gray: Array, around: Array) -> Mask:
    """:func:`marker_mask` of what :func:`luma_and_around` gives."""
    return gray < MARKER * around


def luma_and_around(image: Array) -> tuple[Array, Array]:
    """Luma (h, w) of an image, and its median in a window around each pixel."""
    gray = image @ LUMA if image.shape[2] == 3 else image[..., 0]
    # a median over a sixth of the side changes slowly, and costs the fourth power of the side
    step = max(1, min(gray.shape) // 64)
    small = gray[::step, ::step]
    width = min(small.shape) // 6 | 1
    windows = sliding_window_view(np.pad(small, width // 2, mode="symmetric"), (width, width))
    middle = width * width // 2  # twice as fast as scipy's median filter, and the same
    around = np.partition(windows.reshape(*small.shape, -1), middle, axis=2)[..., middle]
    return gray, around.repeat(step, 0).repeat(step, 1)[: gray.shape[0], : gray.shape[1]]


def _spots(gray: Array, around: Array) -> tuple[Array, Array]:
    """Centers (m, 2) of the markers of an image, x and y in pixels, and the ink (m,) of each."""
    labeled: Any = scipy.ndimage.label(is_marker(gray, around))  # wrongly typed in scipy
    areas, count = labeled
    ink = np.clip(1 - gray / np.maximum(around, 1e-3), 0, 1)
    areas = np.where(areas > 0, areas, scipy.ndimage.maximum_filter(areas, 3)).ravel()
    y, x = (axis.ravel() for axis in np.indices(gray.shape))
    sums = [np.bincount(areas, ink.ravel() * of, count + 1)[1:].astype(float) for of in (1.0, x, y)]
    centers = np.stack(sums[1:], axis=1) / sums[0][:, None]
    side = min(gray.shape)
    amount, edge = sums[0] * (64 / side) ** 2, side / 40
    inside = (centers > edge) & (centers < np.array(gray.shape[::-1]) - 1 - edge)
    kept = (amount > INK[0]) & (amount < INK[1]) & inside.all(axis=1)
    return centers[kept], sums[0][kept]


def _distances(a: Array, b: Array) -> Array:
    return np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))


def _matches(distance: Array, reach: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns that are each other's nearest, and nearer than ``reach``."""
    to = distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[to] == np.arange(len(to))
    rows = np.flatnonzero(mutual & (distance.min(axis=1) < reach))
    return rows, to[rows]


def _affine(at: Array, around: Array) -> Array:
    """(m, 3) columns of an affine map of ``at``: 1, and x and y from the middle of ``around``."""
    return np.column_stack([np.ones(len(at)), at - around.mean(axis=0)])


def _affine_motion(gel: Array, image: Array, ink: Array, other: Array) -> Array:
    """(m, 2) where each marker of the gel goes by the best affine map; in units of the pitch."""
    differs = np.minimum(OF_INK * np.abs(ink[:, None] - other[None]), MOST_OF_INK)
    columns, best, least = _affine(gel, gel), np.zeros_like(gel), np.inf
    for dilation, dy, dx in itertools.product(DILATIONS, SHIFTS, SHIFTS):
        guess, cost = np.array([dx, dy]) + dilation * columns[:, 1:], np.inf
        for _ in range(4):
            far = _distances(gel + guess, image) + differs
            rows, to = _matches(far, LOST)
            if len(rows) < FEWEST:
                break
            guess = columns @ _robust(columns[rows], image[to] - gel[rows])
            length = float(np.sqrt((guess**2).sum(axis=1).mean()))
            cost = far[rows, to].sum() + LOST * (len(gel) - len(rows)) + OF_WAY * length * len(gel)
        if cost < least:
            best, least = guess, cost
            if np.abs(guess).max() < SURE:
                break
    return best


def _solved(columns: Array, moved: Array) -> Array:
    return np.asarray(np.linalg.lstsq(columns, moved, rcond=None)[0], float)


def _robust(columns: Array, moved: Array) -> Array:
    """(3, 2) least squares in which what lies off counts less (Cauchy weights, four rounds)."""
    weights, fit = np.ones((len(moved), 1)), np.zeros((3, 2))
    for _ in range(4):
        fit = _solved(columns * weights, moved * weights)
        off = np.linalg.norm(moved - columns @ fit, axis=1, keepdims=True)
        weights = 1 / np.hypot(1, off / max(2 * 1.4826 * float(np.median(off)), 1e-6))
    return fit


def _smooth(to: Array, at: Array, moves: Array) -> Array:
    """(n, 2) medians of ``moves`` at the places ``to``, weighted by a Gaussian of 1.5 pitches."""
    weights = np.exp(-((_distances(to, at) / 1.5) ** 2) / 2) + 1e-6
    result = np.empty((len(to), 2))
    for axis in (0, 1):
        order = np.argsort(moves[:, axis])
        shares = np.cumsum(weights[:, order], axis=1)
        result[:, axis] = moves[order, axis][(shares >= shares[:, -1:] / 2).argmax(axis=1)]
    return result
