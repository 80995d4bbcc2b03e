"""Kernel sums from blocks of pairs, each block once; the N x N matrix never exists.

* Rows are centered and rounded *once*; ``z`` is what came out. One product and norms of the same rounded ``z`` give the exponent of the
  Gaussian; ``expm1`` in place.
* Samples are sorted so that items are contiguous; a block is summed run by run, in float64. What float32 rounds are single values,
  and their errors average out over the pairs.
* Blocks below the diagonal are the transposes of those above. They are worked off in threads, and added up in a fixed order: the result does
  not depend on how many threads there are.

Memory: ``block^2`` numbers a thread, N x S for the row sums, and one sorted copy of the features.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError
from palpate.metrics.arrays import Ops, ops_of
from palpate.metrics.kernels import Array, Index, Kernel
from palpate.metrics.sums import PairSums, split_by

#: Up to this many rows float64 costs nothing; few pairs would not average float32 rounding away.
FLOAT64_BELOW = 1024
#: In segments of effectively fewer rows than the first number, features may reach only so much of the kernel's limit (0.2 is sigma >= 9 for
#: unit norm); where copies leave fewer than ``FEW``, none.
ROOM, FEW = ((16, 0.04), (512, 0.2)), 16
#: Blocks are not made smaller than this for speed; the caller may ask for less.
SMALL_BLOCK = 256
#: Up to this many items their sums with one another are kept (34 MB).
MOST_ITEMS = 2048
SLAB, SMALL = 4096, 512


@dataclass(frozen=True)
class Sweep:
    """What one pass over the pairs found.

    Attributes:
        sums: by item and segment.
        spread: (K, 3) of the doubly centered kernel of each of the sets asked for: see :func:`centered_squares`.
    """

    sums: PairSums
    spread: Array


def blocked_sums(
    x: Any,
    segment: Index,
    unit: Index,
    *,
    segments: int,
    kernel: Kernel,
    block: int = 1024,
    spread: list[Index] | None = None,
) -> Sweep:
    """Kernel sums of all samples with all segments.

    Args:
        x: (N, d) float32 or float64; NumPy, or another library's array on any device.
        segment: (N,) in [0, segments).
        unit: (N,) any integers.
        segments: S.
        kernel: what is summed.
        block: most rows of a block; a block holds block^2 kernel values.
        spread: sets of segments for ``Sweep.spread``, each ascending and without gaps; ``[]`` or None for none.
    """
    ops = ops_of(x)
    order = np.lexsort((unit, segment))
    z = centered(x, order, kernel, ops, segment)
    segment, unit = segment[order].astype(np.intp), unit[order].astype(np.intp)
    start = (
        np.flatnonzero(np.r_[True, (np.diff(segment) != 0) | (np.diff(unit) != 0)])
        if len(order)
        else np.zeros(0, np.intp)
    )
    own = kernel.diagonal(z, ops)
    joined = len(start) <= MOST_ITEMS
    wanted = [np.isin(segment, s) for s in spread or []]
    if joined:  # (unit, segment) items: sums of items with items
        cell = np.repeat(np.arange(len(start)), np.diff(np.r_[start, len(order)]))
        run = _Run(z, cell, len(start), kernel, block, ops, wanted)
        n, diagonal = (
            np.bincount(cell, weights, len(start)).astype(np.float64) for weights in (None, own)
        )
        sums = PairSums.from_block(run.items, n, diagonal, segment[start], unit[start], segments)
        return Sweep(sums, run.spread)
    run = _Run(z, segment, segments, kernel, block, ops, wanted, by_row=True)
    same = np.zeros_like(run.rows)
    _, number, size = np.unique(unit, return_inverse=True, return_counts=True)
    shared = np.flatnonzero(size[number] > 1)
    for part in split_by(unit[shared]):
        at = shared[part]  # ascending, so segments stay sorted
        same[at] = _Run(z[at], segment[at], segments, kernel, block, ops, [], by_row=True).rows
    sums = PairSums(np.ones(len(order)), run.rows, same, own, segment, unit)
    return Sweep(sums, run.spread)


def centered(x: Any, order: Index, kernel: Kernel, ops: Ops, segment: Index) -> Any:
    """Rows of ``x`` in this order, formed in float64 and rounded once to the type that the sums need.

    Rows of a stationary kernel are centered, which changes no value, and all are in units of the kernel. float32 rounding must average away
    over the distinct rows of each segment (N,).
    """
    if type(ops) is not Ops:  # on a device: one expression
        wide = ops.xp.astype(
            ops.xp.take(x, ops.xp.asarray(order, device=ops.device), axis=0), ops.xp.float64
        )  # type: ignore[attr-defined]
        z = ((wide - ops.xp.mean(wide, axis=0)) if kernel.stationary else wide) / kernel.unit  # type: ignore[attr-defined]
        single = x.dtype != ops.xp.float64 and _single(
            kernel.unit**2 * ops.numpy(ops.squares(z)), segment[order], kernel
        )  # type: ignore[attr-defined]
        return ops.xp.astype(z, ops.xp.float32) if single else z  # type: ignore[attr-defined]
    slabs = [slice(i, i + SLAB) for i in range(0, len(order), SLAB)]
    mean = x.mean(axis=0, dtype=np.float64) if kernel.stationary else np.zeros(x.shape[1])
    squares = (
        np.concatenate([((x[at] - mean) ** 2).sum(axis=1) for at in slabs])
        if slabs
        else np.zeros(0)
    )
    single = _single(squares, segment, kernel) and x.dtype != np.float64
    z, room = (
        np.empty(x.shape, dtype=np.float32 if single else np.float64),
        np.empty((min(SMALL, len(order)), x.shape[1])),
    )
    for i in range(
        0, len(order), SMALL
    ):  # through one small buffer: fresh memory costs more than the arithmetic
        rows = room[: len(order[i : i + SMALL])]
        np.subtract(x[order[i : i + SMALL]], mean, out=rows)
        rows /= kernel.unit
        z[i : i + SMALL] = rows
    return z


def _single(squares: Array, segment: Index, kernel: Kernel) -> bool:
    """Whether float32 keeps 1e-6, given squared norms of rows and their segments.

    The limit of a kernel is where it does over many rows; float64 has 2^29 times as much room, and a coarser value is better than none up to
    there. Rows of equal norm are taken for copies of one another, whose rounding does not average away: rows count as their effective
    number (sum w)^2 / sum w^2 (Kish 1965), w copies of each.

    Raises:
        PalpateError: on rows so far from their mean that a product cannot tell distances of a bandwidth in float64.
    """
    radius = float(squares.max(initial=0.0))
    if not radius <= kernel.radius_limit * 2.0**31:
        far = radius**0.5
        got = (
            f"a row {far:.3g} from the mean, {far / (4 * kernel.radius_limit**0.5):.2g} bandwidths"
        )
        raise PalpateError(
            "The bandwidth must be wide enough for rounding to tell the rows' distances",
            got,
            "Leave out what lies so far away, or pass a wider sigma",
        )
    if not kernel.single or len(squares) <= FLOAT64_BELOW:
        return False
    norms = squares.astype(np.float32)
    order = np.lexsort((norms, segment))
    new = np.flatnonzero(np.r_[True, (np.diff(norms[order]) != 0) | (np.diff(segment[order]) != 0)])
    copies, of = np.diff(np.r_[new, len(order)]), segment[order][new]
    rows, twice = (np.bincount(of, weights=copies.astype(np.float64) ** p) for p in (1, 2))
    rows, effective = rows[rows > 0], (rows**2 / np.maximum(twice, 1))[rows > 0]
    if (effective < np.minimum(rows, FEW)).any():
        return False
    return radius <= kernel.radius_limit * next(
        (share for least, share in ROOM if effective.min() < least), 1.0
    )


class _Run:
    """One sweep over the blocks on and above the diagonal."""

    def __init__(
        self,
        z: Any,
        cell: Index,
        cells: int,
        kernel: Kernel,
        block: int,
        ops: Ops,
        sets: list[NDArray[np.bool_]],
        *,
        by_row: bool = False,
    ) -> None:
        self.kernel, self.ops, n = kernel, ops, len(cell)
        self.left, self.right = kernel.factors(z, ops)
        self.shift = kernel.shift(z, ops)
        self.radius = max(
            (float(ops.numpy(ops.squares(z[k : k + SLAB])).max()) for k in range(0, n, SLAB)),
            default=0.0,
        )
        block = max(
            1, min(block, max(SMALL_BLOCK, -(-n // 8)))
        )  # an eighth of the rows: little of the diagonal blocks is done twice
        self.blocks = [slice(i, min(i + block, n)) for i in range(0, n, block)]
        self.starts = [np.flatnonzero(np.r_[True, np.diff(cell[at]) != 0]) for at in self.blocks]
        self.cells = [cell[at][first] for at, first in zip(self.blocks, self.starts, strict=True)]
        self.rows = np.zeros((n, cells)) if by_row else np.zeros((0, cells))
        self.items = np.zeros((0, 0)) if by_row else np.zeros((cells, cells))
        self.sets = sets
        edges = [(int(np.argmax(s)), int(s.sum())) if s.any() else (0, 0) for s in sets]
        self.ranges = [slice(a, a + b) for a, b in edges]  # each set is one run of sorted rows
        self.row_sums, self.squares = (
            [np.zeros(r.stop - r.start) for r in self.ranges],
            np.zeros(len(sets)),
        )
        pairs = [(i, j) for i in range(len(self.blocks)) for j in range(i, len(self.blocks))]
        for (i, j), found in zip(pairs, ops.each(self._block, pairs), strict=True):
            self._add(i, j, *found)
        self.spread = np.array(
            [centered_squares(q, r) for q, r in zip(self.squares, self.row_sums, strict=True)]
            if sets
            else np.zeros((0, 3)),
            dtype=np.float64,
        )

    def _block(
        self, pair: tuple[int, int]
    ) -> tuple[Array, Array | None, list[tuple[int, Array, Array | None, float]]]:
        i, j = pair
        rows, columns = self.blocks[i], self.blocks[j]
        shift = None if self.shift is None else (self.shift[rows], self.shift[columns])
        k = self.kernel.values(
            self.left[rows] @ self.right[columns].T, self.ops, self.radius, shift
        )
        if i == j:
            k = self.ops.clear_diagonal(k)
        across = (
            self.ops.sum_columns(k, self.starts[j])
            if len(self.rows)
            else self.ops.sum_rows(k, self.starts[i])
        )
        back = self.ops.sum_rows(k, self.starts[i]).T if i != j and len(self.rows) else None
        inside: list[tuple[int, Array, Array | None, float]] = []
        for s, run in enumerate(self.ranges):
            a, b = (
                slice(max(run.start, at.start) - at.start, min(run.stop, at.stop) - at.start)
                for at in (rows, columns)
            )
            if a.start < a.stop and b.start < b.stop:
                part = k[a, b]
                ones = self.ops.ones(part.shape[1], part), self.ops.ones(part.shape[0], part)
                sums = (
                    self.ops.numpy(part @ ones[0]),
                    None if i == j else self.ops.numpy(ones[1] @ part),
                )
                inside.append(
                    (s, *sums, float(self.ops.row_squares(part).sum()) * (1 if i == j else 2))
                )
        return (
            across if len(self.rows) else np.add.reduceat(across, self.starts[j], axis=1),
            back,
            inside,
        )

    def _add(
        self,
        i: int,
        j: int,
        across: Array,
        back: Array | None,
        inside: list[tuple[int, Array, Array | None, float]],
    ) -> None:
        if len(self.rows):
            self.rows[self.blocks[i], self.cells[j]] += across
            if back is not None:
                self.rows[self.blocks[j], self.cells[i]] += back
        else:
            self.items[np.ix_(self.cells[i], self.cells[j])] += across
            if i != j:
                self.items[np.ix_(self.cells[j], self.cells[i])] += across.T
        for s, right, down, squares in inside:
            start = self.ranges[s].start
            for at, sums in ((self.blocks[i], right), (self.blocks[j], down)):
                if sums is not None:
                    first = max(at.start, start) - start
                    self.row_sums[s][first : first + len(sums)] += sums
            self.squares[s] += squares


def centered_squares(squares: float, row_sums: Array) -> tuple[float, float, float]:
    """Of the doubly centered kernel the sum of squares over i != j, its trace, and the sum of the squares of its diagonal.

    From sum_ij k^2 and row sums of a matrix whose diagonal is 0: ``Kc_ij = k_ij - r_i - r_j + r`` with r the row means, and ``Kc_ii = r - 2 r_i``.
    """
    n = len(row_sums)
    if n < 2:
        return np.nan, np.nan, np.nan
    r = row_sums / n
    mean = r.mean()
    diagonal = mean - 2 * r
    own = float((diagonal**2).sum())
    return (
        max(float(squares - 2 * n * (r**2).sum() + n**2 * mean**2) - own, 0.0),
        float(diagonal.sum()),
        own,
    )
