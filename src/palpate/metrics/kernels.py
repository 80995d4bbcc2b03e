"""Sums of the Gaussian kernel over blocks of pairs, by segment; the N x N matrix never exists.

``k(x, y) = exp(-||x - y||^2 / (2 sigma^2))``. On unit-norm features with sigma = 10 it lies in [0.98, 1], so a sum of k in
float32 loses what matters. In every MMD estimator a constant added to k cancels; therefore all sums here are of ``k - 1 = expm1(-||x - y||^2 / (2 sigma^2))``:

* features are centred, divided by sigma and rounded *once*; ``z`` is what came out;
* one matrix product of ``[z, -||z||^2/2, 1]`` and ``[z', 1, -||z'||^2/2]`` gives the exponent, with norms of the same rounded ``z``;
* ``expm1`` in place, sums in float64. The diagonal is exactly 0, so sums over all pairs and over pairs i != j are the same number.

A *segment* is a cell of (set, class, half): sums are kept for each sample against each segment. A *unit* is what a jackknife leaves
out (a video; a frame where no videos are known): sums over pairs inside one unit are kept as well. From these two tables (N x S each)
follow every metric, every leave-one-unit-out value and the sums without same-video pairs, in O(S^2) each and with no further kernel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Up to this many rows float64 costs nothing; few pairs would not average float32 rounding away.
FLOAT64_BELOW = 1024
#: Blocks are not made smaller than this for speed; the caller may ask for less.
SMALL_BLOCK = 256
#: float32 keeps 1e-6 (x1000) while exponents are small: ||z||^2 <= 0.25, i.e. sigma >= 2 for unit-norm features.
FLOAT32_RADIUS = 0.25


@dataclass(frozen=True)
class Totals:
    """Sums by pair of segments.

    Attributes:
        n: (S,) samples.
        sums: (S, S) sum of k - 1 over ordered pairs.
        same: (S, S) the part of ``sums`` from pairs inside one unit.
        pairs: (S, S) how many ordered pairs lie inside one unit, a sample with itself included.
    """

    n: Array
    sums: Array
    same: Array
    pairs: Array

    def merge(self, to: Index, segments: int) -> Totals:
        """Segments joined: segment s becomes ``to[s]``; -1 drops it."""
        m = _one_hot(to, segments)
        return Totals(self.n @ m, m.T @ self.sums @ m, m.T @ self.same @ m, m.T @ self.pairs @ m)


@dataclass(frozen=True)
class PairSums:
    """Sums of k - 1 of each sample with each segment.

    Attributes:
        rows: (N, S) sum over the samples of a segment.
        same: (N, S) the part of ``rows`` from samples of the same unit.
        squares: (N, S) sum of (k - 1)^2, or None where not asked for.
        segment: (N,) the sample's own segment, 0 <= segment < S.
        unit: (N,) the sample's unit, any integers.
    """

    rows: Array
    same: Array
    squares: Array | None
    segment: Index
    unit: Index

    @property
    def segments(self) -> int:
        """S."""
        return self.rows.shape[1]

    @cached_property
    def units(self) -> int:
        """Number of different units."""
        return len(np.unique(self.unit))

    def merge(self, to: Index, segments: int) -> PairSums:
        """Segments joined: segment s becomes ``to[s]``; -1 drops it and its samples."""
        m, keep = _one_hot(to, segments), to[self.segment] >= 0
        squares = None if self.squares is None else self.squares[keep] @ m
        return PairSums(self.rows[keep] @ m, self.same[keep] @ m, squares, to[self.segment][keep], self.unit[keep])

    def _part(self, at: Index | slice) -> tuple[Array, Array, Array]:
        """(n, sums, same) of some samples against all segments, by segment of the sample."""
        m = _one_hot(self.segment[at], self.segments)
        return m.sum(axis=0), m.T @ self.rows[at], m.T @ self.same[at]

    @cached_property
    def _by_unit(self) -> list[Index]:
        return _split_by(self.unit)

    @cached_property
    def totals(self) -> Totals:
        """Sums over all samples."""
        n, sums, same = self._part(slice(None))
        units, number = np.unique(self.unit, return_inverse=True)
        count = np.bincount(number * self.segments + self.segment, minlength=len(units) * self.segments).astype(np.float64)
        count = count.reshape(len(units), self.segments)
        return Totals(n, sums, same, count.T @ count)

    def leave_one_out(self) -> Iterator[Totals]:
        """The totals without each unit in turn: ``sums - C - C' + B``, C the unit against all, B the unit against itself."""
        full = self.totals
        for at in self._by_unit:
            n, against_all, inside = self._part(at)
            sums = full.sums - against_all - against_all.T + inside
            yield Totals(full.n - n, sums, full.same - inside, full.pairs - np.outer(n, n))


def _split_by(key: Index) -> list[Index]:
    """Positions of equal keys together, one array a key."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1) if len(order) else []


def _one_hot(to: Index, segments: int) -> Array:
    m = np.zeros((len(to), segments))
    kept = np.flatnonzero(to >= 0)
    m[kept, to[kept]] = 1
    return m


def pair_sums(
    x: NDArray[np.floating[Any]],
    segment: Index,
    unit: Index,
    *,
    segments: int,
    sigma: float,
    block: int = 2048,
    squares: bool = False,
) -> PairSums:
    """Kernel sums of all samples with all segments.

    Args:
        x: (N, d) float32 or float64.
        segment: (N,) in [0, segments).
        unit: (N,) any integers.
        segments: S.
        sigma: bandwidth.
        block: most rows of a block; a block holds block^2 kernel values.
        squares: also sum (k - 1)^2.
    """
    z = _scaled(x, sigma)
    rows, square = _sweep(z, segment, segments, block, squares)
    same = np.zeros_like(rows)
    _, number, size = np.unique(unit, return_inverse=True, return_counts=True)
    shared = np.flatnonzero(size[number] > 1)
    for part in _split_by(unit[shared]):
        at = shared[part]
        same[at] = _sweep(z[at], segment[at], segments, block, False)[0]
    return PairSums(rows, same, square, np.asarray(segment, dtype=np.intp), np.asarray(unit, dtype=np.intp))


def _scaled(x: NDArray[np.floating[Any]], sigma: float, slab: int = 4096) -> NDArray[np.floating[Any]]:
    """(x - mean) / sigma, formed in float64 and rounded once to the dtype in which the exponents will be formed."""
    mean = x.mean(axis=0, dtype=np.float64)
    slabs = [slice(i, i + slab) for i in range(0, len(x), slab)]
    radius = max((float((((x[at] - mean) / sigma) ** 2).sum(axis=1).max()) for at in slabs), default=0.0)
    wide = x.dtype == np.float64 or len(x) <= FLOAT64_BELOW or radius > FLOAT32_RADIUS
    z = np.empty(x.shape, dtype=np.float64 if wide else np.float32)
    for at in slabs:
        z[at] = (x[at] - mean) / sigma
    return z


def _sweep(z: NDArray[np.floating[Any]], segment: Index, segments: int, block: int, squares: bool) -> tuple[Array, Array | None]:
    """Row sums (N, S) of expm1(-||z - z'||^2 / 2) and, if asked, of its square; blocks on and above the diagonal only."""
    order = np.argsort(segment, kind="stable")
    cuts = np.searchsorted(segment[order], np.arange(segments + 1))
    n, d = z.shape
    block = max(1, min(block, max(SMALL_BLOCK, -(-n // 8))))  # an eighth of the rows: little of the diagonal blocks is done twice
    right = np.ones((n, d + 2), dtype=z.dtype)  # [z, 1, -||z||^2 / 2]
    right[:, :d] = z[order]
    right[:, d + 1] = -0.5 * np.einsum("ij,ij->i", right[:, :d], right[:, :d], dtype=np.float64)
    swap = np.r_[:d, d + 1, d]  # [z, -||z||^2 / 2, 1]
    rows, square = np.zeros((n, segments)), np.zeros((n, segments)) if squares else None

    def add(at: slice, first: int, k: NDArray[np.floating[Any]]) -> None:  # k: the rows `at` against columns from `first` on
        last = first + k.shape[1]
        for s in range(int(np.searchsorted(cuts, first, side="right")) - 1, segments):
            a, b = max(int(cuts[s]), first) - first, min(int(cuts[s + 1]), last) - first
            if a >= k.shape[1]:
                break
            if a < b:
                rows[at, s] += k[:, a:b].sum(axis=1, dtype=np.float64)
                if square is not None:
                    square[at, s] += np.einsum("ij,ij->i", k[:, a:b], k[:, a:b])

    for i in range(0, n, block):
        left = right[i : i + block, swap]
        for j in range(i, n, block):
            k = left @ right[j : j + block].T
            np.expm1(k, out=k)
            if i == j:
                np.fill_diagonal(k, 0)
            add(slice(i, i + block), j, k)
            if i != j:
                add(slice(j, j + block), i, k.T)
    back = np.empty_like(order)
    back[order] = np.arange(n)
    return rows[back], None if square is None else square[back]
