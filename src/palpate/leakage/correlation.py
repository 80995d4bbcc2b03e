"""Similarity of two images: the peak of their normalized cross-correlation over small shifts.

An image is a thumbnail of 32 x 32 pixels in YCbCr, band-passed: with G_s a Gaussian blur of s
pixels (edges repeated),

    x = G_1 p - G_4 G_1 p.

Without what varies slower than G_4 (light, exposure, vignette) and what is finer than G_1 (noise,
JPEG blocks, shifts below a pixel). Of the query the interior T (2 pixels cut off on each side, each
channel's mean removed) is laid over the other image B at every offset d of -2 ... 2 pixels in half
pixels:

    s = max_d  sum_c <T_c, B_c(d)>  /  ( |T|  |B(d) - mean| ),

which is 1 for equal images and does not change with gain, offset or a shift of up to 1/16 of the
side. <T, B(d)> is the inverse Fourier transform of conj(F T) F B at 81 places, two small matrix
products; the norm of the window of B comes from running sums, between whole pixels by
interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from palpate.core import Progress, quiet
from palpate.leakage.thumbnails import SIDE

REACH = 2
LOW, HIGH, LOCAL = 1.0, 4.0, 3.0
#: Pairs of images at a time.
BLOCK = 2048

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Spectra = tuple[NDArray[np.complex64], Floats]

_INNER = SIDE - 2 * REACH


def blur_matrix(sigma: float) -> Floats:
    """(32, 32): a Gaussian blur of a column of pixels, edges repeated."""
    eye = np.eye(SIDE)
    return ndimage.gaussian_filter1d(eye, sigma, axis=0, mode="nearest").astype(np.float32)


_FINE, _LOCAL = blur_matrix(LOW), blur_matrix(LOCAL)
_COARSE = blur_matrix(HIGH) @ _FINE


@dataclass(frozen=True)
class Shifts:
    """Offsets at which images are compared, and the matrices that take a cross-spectrum there.

    Attributes:
        offsets: (k,) in pixels, the same for both axes.
        rows: (k, 32) and columns (17, k): the inverse real Fourier transform at those places.
    """

    offsets: Floats
    rows: NDArray[np.complex64]
    columns: NDArray[np.complex64]

    @classmethod
    def of(cls, step: float) -> Shifts:
        """Offsets of -2 ... 2 pixels in steps of ``step``."""
        at = np.arange(-REACH, REACH + step / 2, step)
        half = np.arange(SIDE // 2 + 1)
        # The other half of a real image's spectrum is the same.
        twice = np.where((half == 0) | (half == SIDE // 2), 1.0, 2.0)
        rows = np.exp(2j * np.pi * np.outer(at, np.fft.fftfreq(SIDE)))
        columns = np.exp(2j * np.pi * np.outer(half / SIDE, at)) * (twice / SIDE**2)[:, None]
        return cls(at.astype(np.float32), rows.astype(np.complex64), columns.astype(np.complex64))


HALVES = Shifts.of(0.5)


def band_pass(images: Floats) -> Floats:
    """(n, 3, 32, 32) YCbCr, or differences of such, through the filter of this file's head."""
    return np.asarray(_FINE @ images @ _FINE.T - _COARSE @ images @ _COARSE.T, np.float32)


def smooth(images: Floats) -> Floats:
    """The same with what varies slowly, but without each channel's mean."""
    blurred = np.asarray(_FINE @ images @ _FINE.T, np.float32)
    return blurred - blurred.mean(axis=(2, 3), keepdims=True)


def even(x: Floats, floor: float) -> Floats:
    """Divide by the local contrast, so that one strong edge does not outweigh everything else.

    x / sqrt(G_3 |x|^2 + floor^2), with |x|^2 the sum over channels.
    """
    contrast = _LOCAL @ np.square(x).sum(axis=1, keepdims=True) @ _LOCAL.T
    return x / np.sqrt(contrast + np.float32(floor * floor))


def rms(images: Floats) -> Floats:
    """(n,) root mean square over channels and pixels."""
    return np.sqrt(np.square(images, dtype=np.float32).mean(axis=(1, 2, 3)))


def query_spectra(x: Floats) -> Spectra:
    """Conjugate spectra (n, 3, 32, 17) of the interiors, and their norms (n,)."""
    inner = x[:, :, REACH:-REACH, REACH:-REACH]
    t = np.zeros_like(x)
    t[:, :, REACH:-REACH, REACH:-REACH] = inner - inner.mean(axis=(2, 3), keepdims=True)
    spectrum = np.asarray(fft.rfft2(t), np.complex64)
    return np.conj(spectrum), np.sqrt(np.square(t).sum(axis=(1, 2, 3)))


def base_spectra(x: Floats, shifts: Shifts = HALVES) -> Spectra:
    """Spectra (n, 3, 32, 17), and the norms of the windows (n, k, k) at all offsets."""
    wide = x.astype(np.float64)
    energy = (_boxes(wide**2) - _boxes(wide) ** 2 / _INNER**2).sum(axis=1)
    at = shifts.offsets.astype(np.float64) + REACH
    low = np.minimum(at.astype(np.int64), 2 * REACH - 1)
    part = at - low
    energy = energy[:, low] * (1 - part)[:, None] + energy[:, low + 1] * part[:, None]
    energy = energy[:, :, low] * (1 - part) + energy[:, :, low + 1] * part
    norms = np.sqrt(np.maximum(energy, 0)).astype(np.float32)
    return np.asarray(fft.rfft2(x), np.complex64), norms


def _boxes(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 5, 5) sums over the windows at whole offsets."""
    sums = np.zeros((*x.shape[:-2], SIDE + 1, SIDE + 1))
    sums[..., 1:, 1:] = x.cumsum(axis=-1).cumsum(axis=-2)
    n = _INNER
    return sums[..., n:, n:] - sums[..., :-n, n:] - sums[..., n:, :-n] + sums[..., :-n, :-n]


def correlations(query: Spectra, base: Spectra, shifts: Shifts = HALVES) -> Floats:
    """(n, k, k) normalized cross-correlations at all offsets, pair by pair (or broadcast)."""
    cross = np.einsum("pcij,pcij->pij", query[0], base[0])
    peaks = (shifts.rows @ cross @ shifts.columns).real
    return peaks / (query[1][:, None, None] * base[1] + np.float32(1e-6))


def best_offset(x: Floats, y: Floats, shifts: Shifts) -> Floats:
    """(n, 2) for each pair the offset, down and right in pixels, at which they correlate best.

    Between the offsets of ``shifts`` it is the peak of the parabola through the highest value and
    its two neighbors along each axis.
    """
    values = correlations(query_spectra(x), base_spectra(y, shifts), shifts)
    rows, last = np.arange(len(x)), len(shifts.offsets) - 1
    place = np.stack(np.divmod(values.reshape(len(x), -1).argmax(axis=1), last + 1), axis=1)
    offset = shifts.offsets[place]
    for axis in (0, 1):
        lines = values[rows, :, place[:, 1]] if axis == 0 else values[rows, place[:, 0]]
        at = place[:, axis]
        before, top, after = (lines[rows, np.clip(at + d, 0, last)] for d in (-1, 0, 1))
        bend = before - 2 * top + after
        curved = (at > 0) & (at < last) & (bend < -1e-6)
        step = shifts.offsets[1] - shifts.offsets[0]
        offset[:, axis] += step * np.where(
            curved, (before - after) / np.where(curved, 2 * bend, 1), 0
        )
    return offset


def similarities(
    images: NDArray[np.int8], i: Ints, j: Ints, *, progress: Progress = quiet
) -> Floats:
    """Similarity of pairs of images.

    Args:
        images: (n, 3, 32, 32) band-passed, of any scale.
        i: (p,) queries.
        j: (p,) the images that they are laid over.
        progress: called with the number of pairs done.

    Returns:
        (p,) in [-1, 1]; 0 where an image is flat.
    """
    similarity = np.zeros(len(i), np.float32)
    for start in range(0, len(i), BLOCK):
        progress("comparing images", start, len(i))
        part = slice(start, start + BLOCK)
        first, at = np.unique(i[part], return_inverse=True)
        second, place = np.unique(j[part], return_inverse=True)
        spectra, norms = query_spectra(images[first].astype(np.float32))
        others, windows = base_spectra(images[second].astype(np.float32))
        values = correlations((spectra[at], norms[at]), (others[place], windows[place]))
        similarity[part] = np.clip(values.max(axis=(1, 2)), -1, 1)
    progress("comparing images", len(i), len(i))
    return similarity


def similarity_grid(
    images: NDArray[np.int8], i: Ints, j: Ints, *, progress: Progress = quiet
) -> Floats:
    """(len(i), len(j)) similarity of every query with every one of a few images."""
    others = base_spectra(images[j].astype(np.float32))
    grid = np.empty((len(i), len(j)), np.float32)
    for start in range(0, len(i), BLOCK):
        part = i[start : start + BLOCK]
        spectra, norms = query_spectra(images[part].astype(np.float32))
        for k in range(len(part)):
            values = correlations((spectra[k : k + 1], norms[k : k + 1]), others)
            grid[start + k] = np.clip(values.max(axis=(1, 2)), -1, 1)
        progress("comparing with unrelated images", start + len(part), len(i))
    return grid
