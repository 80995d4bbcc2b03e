"""The geometry behind the exact neighbor search: principal axes, a safe lower bound, cells, identical rows.

Rows x are shifted by a mean, rotated to principal axes and divided by the largest norm. None of it changes which rows are near: a shift
and a rotation keep distances, and the scale is the same for all. With P the leading p axes and rho(x) the norm of what they leave out,

    |Px - Py|^2 + (rho(x) - rho(y))^2  <=  |x - y|^2                                                 (1)

(the reverse triangle inequality in the axes left out). The left side minus a squared threshold t_x^2 is ONE dot product of p + 3 numbers,

    < (-2 Px, -2 rho(x), |x|^2 - t_x^2, 1),  (Py, rho(y), 1, |y|^2) >  <=  0   where y may be within t_x of x,

so a block of pairs costs one small sgemm and one comparison. float32 rounds it; with L terms and u = 2^-24 the error is at most (L + 4) u
(2|x|^2 + 2|y|^2 + t^2) (Higham, "Accuracy and Stability of Numerical Algorithms", 3.1), and rounding the coordinates moves each row by at
most u|x|. Both are taken off |x|^2 and |y|^2 and added to t^2, so that the test errs on the side of keeping a pair; what is kept is
measured again in float64 on the rows as they were given (:func:`squared_distances`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError, rng_for

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

CHUNK = 8192  # rows that are worked on at a time in float64
CELL_AXES = (
    29  # leading axes in which cells are made; with the three extra columns a multiple of 16
)
FIT_ROWS = 20_000
_U = 2.0**-24
_ETA = 1e-6  # (t + e)^2 <= (1 + eta) t^2 + (1 + 1/eta) e^2
_TINY = 1e-36  # swallows products that underflow
_ENDLESS = 1e30  # stands for an infinite threshold; rows have norms of at most one


def checked_rows(name: str, rows: object) -> Floats:
    """The rows as contiguous float32.

    Args:
        name: what the user calls them.
        rows: (n, d) numbers, d >= 1.

    Raises:
        PalpateError: on another shape or kind, or on a number that is not finite (naming the first such row).
    """
    array = np.asarray(rows)
    if array.ndim != 2 or not array.shape[1] or array.dtype.kind not in "fiub":
        raise PalpateError(
            f"{name} must be a matrix of numbers, (rows, dimensions >= 1)",
            f"{array.dtype} {array.shape}",
            "Pass one vector a row",
        )
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=np.float32)
    for start in range(0, len(array), CHUNK):
        bad = ~np.isfinite(array[start : start + CHUNK]).all(axis=1)
        if bad.any():
            row = start + int(bad.argmax())
            column = int((~np.isfinite(array[row])).argmax())
            raise PalpateError(
                f"{name} must hold finite float32 numbers",
                f"{array[row, column]} in row {row}, column {column}",
                "Drop that row, or mend what made it",
            )
    return array


def checked_labels(name: str, labels: object, rows: int) -> Ints | None:
    """Group labels as int64, one a row, or None.

    Raises:
        PalpateError: on another length or kind.
    """
    if labels is None:
        return None
    array = np.asarray(labels)
    if array.shape != (rows,) or (array.dtype.kind not in "iu" and rows):
        raise PalpateError(
            f"{name} must be one integer a row ({rows})",
            f"{array.dtype} {array.shape}",
            "Number the groups 0, 1, 2, ...; -1 where unknown",
        )
    return array.astype(np.int64)


def squared_distances(x: Floats, i: Ints, y: Floats, j: Ints) -> Doubles:
    """|x[i] - y[j]|^2 of each pair, in float64; depends on the two rows alone, not on which pairs are asked together."""
    out = np.empty(len(i))
    step = max(1, (1 << 19) // x.shape[1])
    for start in range(0, len(i), step):
        at = slice(start, start + step)
        gap = np.subtract(x[i[at]], y[j[at]], dtype=np.float64)
        out[at] = np.einsum("ij,ij->i", gap, gap)
    return out


@dataclass(frozen=True)
class Space:
    """Principal axes of some rows.

    Attributes:
        mean: (d,) what is taken off.
        axes: (d, d) orthogonal, a column an axis, the axis of largest variance first.
        norm: the largest norm after the shift: the unit of length.
    """

    mean: Doubles
    axes: Doubles
    norm: float

    @staticmethod
    def of(*parts: Floats) -> Space:
        """Fits the axes to (a regular sample of) the first rows given, and the norm to all."""
        first = parts[0]
        some = first[:: max(1, len(first) // FIT_ROWS)].astype(np.float64)
        mean = some.mean(axis=0)
        some -= mean
        values, axes = np.linalg.eigh(some.T @ some)
        largest = 0.0
        for rows in parts:
            for start in range(0, len(rows), CHUNK):
                gap = rows[start : start + CHUNK] - mean
                largest = max(largest, float(np.einsum("ij,ij->i", gap, gap).max(initial=0.0)))
        return Space(
            mean,
            np.ascontiguousarray(axes[:, np.argsort(-values, kind="stable")]),
            float(np.sqrt(largest)) or 1.0,
        )

    def rotate(self, rows: Floats) -> Floats:
        """(n, d) coordinates along the axes, of norm at most one; worked out in float64, rounded once."""
        out = np.empty(rows.shape, dtype=np.float32)
        for start in range(0, len(rows), CHUNK):
            out[start : start + CHUNK] = (
                (rows[start : start + CHUNK] - self.mean) @ self.axes
            ) / self.norm
        return out


def _slack(p: int, d: int) -> float:
    """What the rounding of the dot product and of the coordinates may cost, per |x|^2 + |y|^2."""
    return 2 * (p + 8) * _U + 2 * (1 + 1 / _ETA) * (2 * _U + d * 2.0**-52) ** 2


def _leading(z: Floats, p: int, columns: int) -> tuple[Floats, int, Doubles]:
    """An array for p axes, the norm of the rest where there is a rest, and two more columns; how many are filled; |z|^2."""
    d = z.shape[1]
    p = min(p, d)
    width = p + (p < d)
    out = np.empty((len(z), width + columns), dtype=np.float32)
    squares = np.empty(len(z))
    for start in range(0, len(z), CHUNK):
        rows = z[start : start + CHUNK]
        at = slice(start, start + len(rows))
        out[at, :p] = rows[:, :p]
        squares[at] = np.einsum("ij,ij->i", rows, rows, dtype=np.float64)
        if p < d:
            out[at, p] = np.sqrt(np.einsum("ij,ij->i", rows[:, p:], rows[:, p:], dtype=np.float64))
    return out, width, squares


def base_side(z: Floats, p: int) -> Floats:
    """The right factor of the bound for rows z (n, d) rotated: (Py, rho, 1, |y|^2), slack taken off."""
    out, width, squares = _leading(z, p, 2)
    out[:, width] = 1
    out[:, width + 1] = squares * (1 - _slack(p, z.shape[1]))
    return out


def query_side(z: Floats, p: int, squared: Doubles) -> Floats:
    """The left factor for rows z (n, d) rotated, with a squared threshold each (in units of norm^2; infinity keeps every pair)."""
    out, width, squares = _leading(z, p, 2)
    out[:, :width] *= -2
    out[:, width] = squares * (1 - _slack(p, z.shape[1])) - widened(squared, out.shape[1])
    out[:, width + 1] = 1
    return out


def center_side(center: Floats, d: int) -> Floats:
    """The left factor for a center in :data:`CELL_AXES` axes: gives its squared distance from base rows, slack taken off."""
    square = float(np.dot(center.astype(np.float64), center))
    return np.r_[
        -2 * center, np.float32(square * (1 - _slack(CELL_AXES, d))), np.float32(1)
    ].astype(np.float32)


def widened(squared: Doubles, columns: int) -> Doubles:
    """Squared thresholds (units of norm^2) with the slack that the test needs at so many columns; infinity becomes a large number."""
    return np.minimum(squared * (1 + 2 * _ETA + columns * 4 * _U), _ENDLESS) + _TINY


@dataclass(frozen=True)
class Cells:
    """Rows sorted into cells round centers (a few Lloyd steps from evenly spaced rows), in the space of bound (1) with :data:`CELL_AXES`
    axes.

    Attributes:
        centers: (c, w) centers.
        order: (n,) rows, cell after cell, ascending within a cell.
        starts: (c + 1,) where each cell starts in ``order``.
    """

    centers: Floats
    order: Ints
    starts: Ints

    @staticmethod
    def of(z: Floats) -> Cells:
        """Makes about sqrt(n) cells, at most 256, of rotated rows z (n, d)."""
        points = _leading(z, CELL_AXES, 0)[0]
        count = int(np.clip(np.sqrt(len(z)), 1, 256))
        centers = points[np.linspace(0, len(z) - 1, count).astype(np.int64)]
        some = points[:: max(1, len(z) // (64 * count))]
        for _ in range(4):
            labels = _closest(some, centers)
            sizes = np.bincount(labels, minlength=count)
            order = np.argsort(labels, kind="stable")
            kept = np.flatnonzero(sizes)
            sums = np.add.reduceat(
                some[order].astype(np.float64), np.r_[0, np.cumsum(sizes[kept])[:-1]], axis=0
            )
            centers[kept] = sums / sizes[kept, None]
        labels = _closest(points, centers)
        starts = np.r_[0, np.cumsum(np.bincount(labels, minlength=count))].astype(np.int64)
        return Cells(centers, np.argsort(labels, kind="stable"), starts)

    def assign(self, z: Floats) -> tuple[Ints, Doubles]:
        """The cell of the nearest center for rotated rows z (n, d), and the distance from that center."""
        points = _leading(z, CELL_AXES, 0)[0]
        labels = _closest(points, self.centers)
        return labels, np.sqrt(squared_distances(points, np.arange(len(z)), self.centers, labels))


def _closest(points: Floats, centers: Floats) -> Ints:
    half = 0.5 * np.einsum("ij,ij->i", centers, centers)
    out = np.empty(len(points), dtype=np.int64)
    for start in range(0, len(points), 2048):
        out[start : start + 2048] = (half - points[start : start + 2048] @ centers.T).argmin(axis=1)
    return out


def _hashes(rows: Floats, labels: Ints | None) -> NDArray[np.uint64]:
    """A 64-bit multilinear hash of each row's bits (and label); minus zero counts as zero."""
    rng = rng_for(0, "identical rows")
    odd = rng.integers(0, 2**63, size=rows.shape[1], dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    out = np.empty(len(rows), dtype=np.uint64)
    for start in range(0, len(rows), CHUNK):
        bits = (rows[start : start + CHUNK] + np.float32(0)).view(np.uint32).astype(np.uint64)
        out[start : start + CHUNK] = ((bits + np.uint64(1)) * odd).sum(axis=1, dtype=np.uint64)
    if labels is not None:
        out += labels.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return out


def identical_rows(rows: Floats, labels: Ints | None = None) -> tuple[Ints, Ints]:
    """Finds identical rows (with identical labels).

    Args:
        rows: (n, d) finite.
        labels: (n,) or None.

    Returns:
        ``first`` (n,): the lowest row that is identical, and ``rank`` (n,): how many identical rows come before. Two rows with the same
        ``first`` are identical; should two different
        rows share a hash of 64 bits, some identical rows may be told apart, which costs time and never a result.
    """
    n = len(rows)
    keys = _hashes(rows, labels)
    order = np.argsort(keys, kind="stable")
    same = np.zeros(n, dtype=bool)
    alike = np.flatnonzero(keys[order[1:]] == keys[order[:-1]]) + 1
    for start in range(0, len(alike), CHUNK):
        at = alike[start : start + CHUNK]
        a, b = order[at], order[at - 1]
        equal = (rows[a] == rows[b]).all(axis=1)
        same[at] = equal if labels is None else equal & (labels[a] == labels[b])
    heads = np.flatnonzero(~same)
    run = np.cumsum(~same) - 1
    first, rank = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    first[order] = order[heads][run]
    rank[order] = np.arange(n) - heads[run]
    return first, rank
