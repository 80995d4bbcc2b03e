"""Similarity of two pictures: the peak of their normalized cross-correlation over small shifts.

A picture is a thumbnail of 32 x 32 pixels in YCbCr, band-passed: with G_s a Gaussian blur of s pixels (edges repeated),

    x = G_1 p - G_4 G_1 p.

What varies slower than G_4 (light, exposure, vignette) is gone, and what is finer than G_1 (noise, JPEG blocks, shifts below a pixel) counts little.
Of the query the interior T (2 pixels cut off on each side, each channel's mean removed) is laid over the other picture B at every offset d of -2 ... 2
pixels in half pixels:

    s = max_d  sum_c <T_c, B_c(d)>  /  ( |T|  |B(d) - mean| ),

which is 1 for equal pictures and does not change with gain, offset or a shift of up to 1/16 of the side. <T, B(d)> is the inverse Fourier transform of
conj(F T) F B at 81 places, two small matrix products; the norm of the window of B comes from running sums, between whole pixels by interpolation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from palpate.core import Progress, quiet

SIDE = 32
REACH = 2
CHROMA = 1.0
LOW, HIGH, LOCAL = 1.0, 4.0, 3.0
BLOCK = 2048

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

_INNER = SIDE - 2 * REACH
_EYE = np.eye(SIDE)
_FINE = ndimage.gaussian_filter1d(_EYE, LOW, axis=0, mode="nearest").astype(np.float32)
_COARSE = (ndimage.gaussian_filter1d(_EYE, HIGH, axis=0, mode="nearest") @ _FINE).astype(np.float32)

_LOCAL = ndimage.gaussian_filter1d(_EYE, LOCAL, axis=0, mode="nearest").astype(np.float32)


@dataclass(frozen=True)
class Shifts:
    """Offsets at which pictures are compared, and the matrices that take a cross-spectrum there.

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
        twice = np.where(
            (half == 0) | (half == SIDE // 2), 1.0, 2.0
        )  # a real picture's other half of the spectrum
        rows = np.exp(2j * np.pi * np.outer(at, np.fft.fftfreq(SIDE)))
        columns = np.exp(2j * np.pi * np.outer(half / SIDE, at)) * (twice / SIDE**2)[:, None]
        return cls(at.astype(np.float32), rows.astype(np.complex64), columns.astype(np.complex64))


HALVES = Shifts.of(0.5)


def band_pass(pictures: Floats) -> Floats:
    """What two pictures are compared by.

    Args:
        pictures: (n, 3, 32, 32) YCbCr, or differences of such.

    Returns:
        (n, 3, 32, 32), the filter of this file's head.
    """
    out: Floats = np.asarray(
        _FINE @ pictures @ _FINE.T - _COARSE @ pictures @ _COARSE.T, np.float32
    )
    out[:, 1:] *= CHROMA
    return out


def even(x: Floats, floor: float) -> Floats:
    """Divides by the local contrast, so that one strong edge does not outweigh the rest: x / sqrt(G_3 |x|^2 + floor^2), with |x|^2 the sum over channels."""
    contrast = _LOCAL @ np.square(x).sum(axis=1, keepdims=True) @ _LOCAL.T
    return x / np.sqrt(contrast + np.float32(floor * floor))


def smooth(pictures: Floats) -> Floats:
    """The same without taking out what varies slowly, but for each channel's mean: (n, 3, 32, 32)."""
    out = _FINE @ pictures @ _FINE.T
    out -= out.mean(axis=(2, 3), keepdims=True)
    out[:, 1:] *= CHROMA
    return out


def rms(pictures: Floats) -> Floats:
    """Root mean square over channels and pixels: (n,)."""
    return np.sqrt(np.mean(np.square(pictures, dtype=np.float32), axis=(1, 2, 3))).astype(
        np.float32
    )


def _spectrum(x: Floats) -> NDArray[np.complex64]:
    return np.asarray(fft.rfft2(x), np.complex64)


def query_spectra(x: Floats) -> tuple[NDArray[np.complex64], Floats]:
    """Conjugate spectra (n, 3, 32, 17) of the interiors, and their norms (n,)."""
    inner = x[:, :, REACH:-REACH, REACH:-REACH]
    t = np.zeros_like(x)
    t[:, :, REACH:-REACH, REACH:-REACH] = inner - inner.mean(axis=(2, 3), keepdims=True)
    return np.conj(_spectrum(t)), np.sqrt(np.square(t).sum(axis=(1, 2, 3)))


def base_spectra(x: Floats, shifts: Shifts = HALVES) -> tuple[NDArray[np.complex64], Floats]:
    """Spectra (n, 3, 32, 17), and the norms of the windows (n, k, k) at all offsets."""
    energy = (
        _boxes(np.square(x, dtype=np.float64)) - _boxes(x.astype(np.float64)) ** 2 / _INNER**2
    ).sum(axis=1)
    at = shifts.offsets.astype(np.float64) + REACH
    low = np.minimum(at.astype(np.int64), 2 * REACH - 1)
    part = at - low
    energy = energy[:, low] * (1 - part)[:, None] + energy[:, low + 1] * part[:, None]
    energy = energy[:, :, low] * (1 - part) + energy[:, :, low + 1] * part
    return _spectrum(x), np.sqrt(np.maximum(energy, 0)).astype(np.float32)


def _boxes(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over the windows at whole offsets: (..., 5, 5)."""
    sums = np.zeros((*x.shape[:-2], SIDE + 1, SIDE + 1))
    np.cumsum(np.cumsum(x, axis=-1), axis=-2, out=sums[..., 1:, 1:])
    n = _INNER
    return sums[..., n:, n:] - sums[..., :-n, n:] - sums[..., n:, :-n] + sums[..., :-n, :-n]


def correlations(
    query: tuple[NDArray[np.complex64], Floats],
    base: tuple[NDArray[np.complex64], Floats],
    shifts: Shifts = HALVES,
) -> Floats:
    """Normalized cross-correlation at all offsets, (n, k, k), of spectra that stand pair by pair (or broadcast)."""
    cross = np.einsum("pcij,pcij->pij", query[0], base[0])
    peaks = (shifts.rows @ cross @ shifts.columns).real
    return peaks / (query[1][:, None, None] * base[1] + np.float32(1e-6))


def best_offset(x: Floats, y: Floats, shifts: Shifts) -> Floats:
    """For each pair the offset (n, 2), down and right in pixels, at which they correlate best.

    Between the offsets of ``shifts`` it is the peak of the parabola through the highest value and its two neighbors along each axis.
    """
    values = correlations(query_spectra(x), base_spectra(y, shifts), shifts)
    rows, last = np.arange(len(x)), len(shifts.offsets) - 1
    place = np.stack(np.divmod(values.reshape(len(x), -1).argmax(axis=1), last + 1), axis=1)
    out = shifts.offsets[place]
    for axis in (0, 1):
        lines = values[rows, :, place[:, 1]] if axis == 0 else values[rows, place[:, 0]]
        at = place[:, axis]
        before, top, after = (lines[rows, np.clip(at + d, 0, last)] for d in (-1, 0, 1))
        bend = before - 2 * top + after
        curved = (at > 0) & (at < last) & (bend < -1e-6)
        out[:, axis] += np.where(curved, (before - after) / np.where(curved, 2 * bend, 1), 0) * (
            shifts.offsets[1] - shifts.offsets[0]
        )
    return out


def similarities(
    plates: NDArray[np.int8], i: Ints, j: Ints, *, progress: Progress = quiet
) -> Floats:
    """S of pairs of pictures.

    Args:
        plates: (n, 3, 32, 32) band-passed pictures, of any scale.
        i: (p,) the queries; fastest if equal ones stand together.
        j: (p,) what they are laid over.
        progress: told about pairs.

    Returns:
        (p,) in [-1, 1]; 0 where a picture is flat.
    """
    out = np.zeros(len(i), np.float32)
    for part in _blocks(len(i)):
        progress("comparing pictures", part.start, len(i))
        first, at = np.unique(i[part], return_inverse=True)
        spectra, norms = query_spectra(plates[first].astype(np.float32))
        other, place = np.unique(j[part], return_inverse=True)
        others, windows = base_spectra(plates[other].astype(np.float32))
        values = correlations((spectra[at], norms[at]), (others[place], windows[place]))
        out[part] = np.clip(values.max(axis=(1, 2)), -1, 1)
    progress("comparing pictures", len(i), len(i))
    return out


def against_all(
    plates: NDArray[np.int8], i: Ints, j: Ints, *, progress: Progress = quiet
) -> Iterator[tuple[slice, Floats]]:
    """S of every query with every one of a few pictures, in blocks of queries.

    Args:
        plates: (n, 3, 32, 32).
        i: (q,) queries.
        j: (m,) pictures that all of them are laid over; kept as spectra (about 14 kB each).
        progress: told about queries.

    Yields:
        (slice of queries, (queries in it, m)).
    """
    others, windows = base_spectra(plates[j].astype(np.float32))
    step = max(1, BLOCK // max(1, len(j)))
    for start in range(0, len(i), step):
        progress("comparing with unrelated pictures", start, len(i))
        part = slice(start, min(start + step, len(i)))
        spectra, norms = query_spectra(plates[i[part]].astype(np.float32))
        values = np.empty((len(norms), len(j)), np.float32)
        for k in range(len(norms)):
            values[k] = correlations((spectra[k : k + 1], norms[k : k + 1]), (others, windows)).max(
                axis=(1, 2)
            )
        yield part, np.clip(values, -1, 1)
    progress("comparing with unrelated pictures", len(i), len(i))


def _blocks(count: int) -> Iterator[slice]:
    for start in range(0, count, BLOCK):
        yield slice(start, min(start + BLOCK, count))
