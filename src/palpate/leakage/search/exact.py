"""Exact nearest neighbors by pruning: a guess for each query, then one sweep that keeps only what could beat it.

1. *Guess*: queries are taken cell by cell (:class:`~palpate.leakage.search.space.Cells`) and compared in full with the nearest cells'
   rows until each has k allowed neighbors. The k-th distance t_x found so far bounds the true one from above.
2. *Sweep*: for the queries of one block, a base row y survives when its distance to the cell's center c satisfies |y - c| <= max_x (|x -
   c| + t_x), and then when bound (1) of ``search.space`` on the leading p axes does not exceed t_x. p is chosen by counting survivors on
   a sample: few axes cost little and prune little. When the queries are the base itself, each unordered pair is swept once, for both of
   its rows: a row is no candidate any more once it was a query, and t_x^2 becomes t_x^2 + max(0, t_y^2 - t^2) >= max(t_x^2, t_y^2), with
   t the least threshold of the block, still a sum of a part of x and a part of y.
3. *Measure*: survivors are measured in float64 on the rows as given and merged by (distance, row).

Both tests err on the side of keeping, so the result is that of brute force, whatever the blocks, cells and p.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress
from palpate.leakage.search.space import (
    CELL_AXES,
    Cells,
    Doubles,
    Floats,
    Ints,
    Space,
    base_side,
    center_side,
    query_side,
    squared_distances,
    widened,
)
from palpate.leakage.search.threads import one_blas_thread

QUERIES, ROWS = (
    192,
    1024,
)  # a block of pairs: 0.75 megabyte of float32, small enough to stay in a processor's cache
LEAST = 32  # queries of one group that make a block of their own
GUESS_ROWS = 512
PENDING = 1 << 15  # survivors measured at once
AXES = (13, 21, 29, 45, 61, 93, 125)  # with the three extra columns multiples of 8
# Costs in nanoseconds, measured on one core with AVX-512; only their ratios matter, and only for speed, never for the result.
PAIR, PAIR_AXIS, SURVIVOR, SURVIVOR_AXIS = 0.25, 0.011, 60.0, 0.8


@dataclass
class Best:
    """The k nearest so far of each query: squared distances (n, k), rows (n, k), nearest first; infinity and -1 where none."""

    squared: Doubles
    row: Ints

    @staticmethod
    def none(n: int, k: int) -> Best:
        """Nothing found yet."""
        return Best(np.full((n, k), np.inf), np.full((n, k), -1, dtype=np.int64))

    def merge(self, queries: Ints, squared: Doubles, row: Ints) -> None:
        """Adds found pairs; a pair may come twice. Ties go to the lowest row."""
        k = self.row.shape[1]
        closer = squared <= self.squared[queries, -1]
        queries, squared, row = queries[closer], squared[closer], row[closer]
        touched = np.unique(queries)
        q = np.concatenate([np.repeat(touched, k), queries])
        s = np.concatenate([self.squared[touched].ravel(), squared])
        r = np.concatenate([self.row[touched].ravel(), row])
        order = np.lexsort(
            (r.view(np.uint64), s, q)
        )  # so that -1 (nothing yet) comes after every row
        q, s, r = q[order], s[order], r[order]
        fresh = np.ones(len(q), dtype=bool)
        fresh[1:] = (q[1:] != q[:-1]) | (r[1:] != r[:-1]) | (r[1:] < 0)
        q, s, r = q[fresh], s[fresh], r[fresh]
        heads = np.r_[0, np.flatnonzero(q[1:] != q[:-1]) + 1] if len(q) else np.empty(0, np.int64)
        rank = np.arange(len(q)) - np.repeat(heads, np.diff(np.r_[heads, len(q)]))
        keep = rank < k
        self.squared[q[keep], rank[keep]] = s[keep]
        self.row[q[keep], rank[keep]] = r[keep]


@dataclass
class Sieve:
    """Pairs of blocks that pass bound (1), with the buffers they need."""

    bound: Floats = field(default_factory=lambda: np.empty((QUERIES, ROWS), dtype=np.float32))
    passed: NDArray[np.bool_] = field(default_factory=lambda: np.empty((QUERIES, ROWS), dtype=bool))

    def __call__(self, left: Floats, right: Floats) -> Iterator[tuple[Ints, Ints, Floats]]:
        """Yields (rows of left, rows of right, products) that pass, a slab of right at a time; left has at most :data:`QUERIES` rows.

        ``left`` may be changed (thresholds lowered) between two slabs.
        """
        for start in range(0, len(right), ROWS):
            slab = right[start : start + ROWS]
            size = len(left) * len(slab)
            bound, passed = self.bound.reshape(-1)[:size], self.passed.reshape(-1)[:size]
            with np.errstate(
                invalid="ignore"
            ):  # BLAS kernels raise the flag on lanes that they do not use
                np.matmul(
                    slab, left.T, out=bound.reshape(len(slab), len(left))
                )  # base rows first: faster by a fifth than the other way round
            np.less_equal(bound, 0, out=passed)
            hit = np.flatnonzero(passed)
            if len(hit):
                j, i = np.divmod(hit, len(left))
                yield i, j + start, bound[hit]


class Index:
    """A base ready to be searched: its rows rotated and sorted by cell.

    Attributes:
        rows: (m, d) as given.
        space: principal axes.
        cells: cells of the rotated rows; ``cells.order`` turns a position of the sorted base into a row.
        z: (m, d) rotated rows, sorted.
    """

    def __init__(self, rows: Floats, space: Space) -> None:
        self.rows, self.space = rows, space
        z = space.rotate(rows)
        self.cells = Cells.of(z)
        self.z = z[self.cells.order]
        self._near = base_side(self.z, CELL_AXES)
        centers = self.cells.centers.astype(np.float64)
        squares = (centers**2).sum(axis=1)
        self._gaps = squares[:, None] + squares - 2 * (centers @ centers.T)

    @np.errstate(invalid="ignore")
    def from_center(self, cell: int) -> Floats:
        """(m,) squared distances of the sorted base rows from a center, in units of the space, rounded down by the slack."""
        return self._near @ center_side(self.cells.centers[cell], self.rows.shape[1])

    def outwards(self, cell: int) -> Iterator[Ints]:
        """Positions of the sorted base, from the given cell outwards, in slabs that grow from :data:`GUESS_ROWS`."""
        held: list[Ints] = []
        size, wanted = 0, GUESS_ROWS
        for other in np.argsort(self._gaps[cell], kind="stable"):
            for start in range(
                int(self.cells.starts[other]), int(self.cells.starts[other + 1]), ROWS
            ):
                held.append(np.arange(start, min(start + ROWS, int(self.cells.starts[other + 1]))))
                size += len(held[-1])
                if size >= wanted:
                    yield np.concatenate(held)
                    held, size, wanted = [], 0, min(2 * wanted, ROWS)
        if held:
            yield np.concatenate(held)


def within(limit: Doubles) -> np.float32:
    """A float32 bound for :meth:`Index.from_center` that keeps every row within the largest of some distances (in units of the space)."""
    furthest = float(limit.max())
    return (
        np.float32(np.inf)
        if furthest > 1e3
        else np.nextafter(np.float32(furthest**2 * (1 + 4e-6) + 1e-36), np.float32(np.inf))
    )


def choose_axes(index: Index, samples: list[tuple[Floats, Doubles, Ints]]) -> int:
    """The number of leading axes that makes a sweep cheapest, by counting on samples (rotated queries, squared thresholds, positions)."""
    d = index.rows.shape[1]
    cost: dict[int, float] = {}
    for p in [p for p in AXES if p < d] + [d]:
        pairs = survivors = 0
        for z, squared, at in samples:
            passed = query_side(z, p, squared) @ base_side(index.z[at], p).T <= 0
            pairs, survivors = pairs + passed.size, survivors + int(passed.sum())
        cost[p] = pairs * (PAIR + PAIR_AXIS * p) + survivors * (SURVIVOR + SURVIVOR_AXIS * d)
    return min(cost, key=cost.__getitem__)


class Nearest:
    """The k nearest rows of a base for each query, with rows of the query's own group left out.

    Args:
        queries: (n, d).
        base: (m, d).
        k: how many.
        query_groups: (n,) or None.
        base_groups: (m,) or None; a row whose group equals the query's and is not negative is no candidate.
        radius: rows further than this are left out.
    """

    def __init__(
        self,
        queries: Floats,
        base: Floats,
        k: int,
        query_groups: Ints | None,
        base_groups: Ints | None,
        radius: float | None,
    ) -> None:
        same = queries is base
        space = Space.of(base) if same else Space.of(base, queries)
        self.index = Index(base, space)
        order = self.index.cells.order
        if same:
            self.z = np.empty_like(self.index.z)
            self.z[order] = self.index.z
        else:
            self.z = space.rotate(queries)
        self.queries, self.unit = queries, space.norm**2
        self.cell, self.away = self.index.cells.assign(self.z)
        self.best = Best.none(len(queries), k)
        if radius is not None:
            self.best.squared[:] = radius**2
        self.query_groups = query_groups
        self.base_groups = (
            base_groups[order] if base_groups is not None and query_groups is not None else None
        )
        self.mutual = same and (
            query_groups is None or base_groups is None or np.array_equal(query_groups, base_groups)
        )
        self.place = np.empty(len(queries) if self.mutual else 0, dtype=np.int64)
        self.place[order[: len(self.place)]] = np.arange(len(self.place))
        self.open = np.ones(len(base), dtype=bool)  # positions that are still candidates
        self._merging = Lock()  # workers find neighbors of each other's queries; a threshold only ever falls, so an old one is safe to read

    def solve(self, progress: Progress) -> Best:
        """Guesses, chooses p, sweeps."""
        with one_blas_thread() as workers, ThreadPoolExecutor(workers) as pool:
            guesses = list(self._blocks(np.zeros(len(self.z))))
            for done, _ in enumerate(pool.map(self._guess, *zip(*guesses, strict=True)), 1):
                progress("guessing neighbors", done, len(guesses))
            blocks = list(self._blocks(self._reach()))
            p = choose_axes(
                self.index, [self._sample(*block) for block in blocks[:: max(1, len(blocks) // 12)]]
            )
            right = base_side(self.index.z, p)
            tasks = [[*same] for _, same in groupby(blocks, key=itemgetter(0))]
            for done, _ in enumerate(
                pool.map(lambda task: self._sweep_cell(task, right, p), tasks), 1
            ):
                progress("searching neighbors", done, len(tasks))
        self.best.squared[self.best.row < 0] = np.inf
        return self.best

    def _sweep_cell(self, blocks: list[tuple[int, Ints]], right: Floats, p: int) -> None:
        centered, theirs, sieve = self.index.from_center(blocks[0][0]), self._theirs(), Sieve()
        for _, queries in blocks:
            self._sweep(queries, self._candidates(centered, queries, theirs), right, p, sieve)
            if self.mutual:
                self.open[self.place[queries]] = False

    def _reach(self, queries: Ints | slice = slice(None)) -> Doubles:
        """How far from its cell's center a query's candidates may lie, in units of the space."""
        return self.away[queries] + np.sqrt(self.best.squared[queries, -1] / self.unit)

    def _blocks(self, key: Doubles) -> Iterator[tuple[int, Ints]]:
        """(cell, at most :data:`QUERIES` queries), sorted by group and ``key``; blocks of one group where groups are large."""
        groups = (
            np.zeros(len(key), dtype=np.int64) if self.query_groups is None else self.query_groups
        )
        order = np.lexsort((key, groups, self.cell))
        cells, labels = self.cell[order], groups[order]
        fresh = np.r_[True, cells[1:] != cells[:-1]]
        ends = np.r_[np.flatnonzero(fresh | np.r_[True, labels[1:] != labels[:-1]])[1:], len(order)]
        start = 0
        for end in map(int, ends):
            while end - start > QUERIES:
                yield int(cells[start]), order[start : start + QUERIES]
                start += QUERIES
            if end - start >= LEAST or end == len(order) or fresh[end]:
                yield int(cells[start]), order[start:end]
                start = end

    def _own(self, queries: Ints) -> int:
        """The group of all the queries, which none of them may find; -1 where they differ or it is unknown."""
        labels = None if self.query_groups is None else self.query_groups[queries]
        return int(labels[0]) if labels is not None and (labels == labels[0]).all() else -1

    def _theirs(self) -> Doubles | None:
        """Thresholds of the base rows as queries, by position, in units of the space; None where they are not queries."""
        return (
            np.sqrt(self.best.squared[self.index.cells.order, -1] / self.unit)
            if self.mutual
            else None
        )

    def _candidates(self, centered: Floats, queries: Ints, theirs: Doubles | None) -> Ints | None:
        """Positions that may matter to some of the queries, or they to them; None for all."""
        keep = centered <= within(self._reach(queries))
        if theirs is not None:
            keep |= centered <= ((self.away[queries].max() + theirs) ** 2 * (1 + 4e-6) + 1e-36)
            keep &= self.open
        own = self._own(queries)
        if own >= 0 and self.base_groups is not None:
            keep &= self.base_groups != own
        count = int(np.count_nonzero(keep))
        return (
            None
            if count > 0.8 * len(keep) and not self.mutual and own < 0
            else np.flatnonzero(keep)
        )

    def _sample(self, cell: int, queries: Ints) -> tuple[Floats, Doubles, Ints]:
        at = self._candidates(self.index.from_center(cell), queries, self._theirs())
        at = np.arange(len(self.index.z)) if at is None else at
        return (
            self.z[queries],
            self.best.squared[queries, -1] / self.unit,
            at[:: max(1, len(at) // 1024)],
        )

    def _allowed(self, queries: Ints, at: Ints) -> NDArray[np.bool_] | None:
        """Which pairs (query, position) are of different or unknown groups; None where all are."""
        if self.query_groups is None or self.base_groups is None:
            return None
        theirs = self.base_groups[at]
        return (self.query_groups[queries] != theirs) | (theirs < 0)

    def _found(self, queries: Ints, at: Ints) -> None:
        rows = self.index.cells.order[at]
        squared = squared_distances(self.queries, queries, self.index.rows, rows)
        if self.mutual:
            queries, rows, squared = (
                np.r_[queries, rows],
                np.r_[rows, queries],
                np.r_[squared, squared],
            )
        with self._merging:
            self.best.merge(queries, squared, rows)

    def _guess(self, cell: int, queries: Ints) -> None:
        """Measures the k apparently nearest allowed rows of each query among the nearest slabs, until each query has k."""
        k, d = self.best.row.shape[1], self.z.shape[1]
        met = np.zeros(len(queries), dtype=np.int64)
        own = self._own(queries)
        for slab in self.index.outwards(cell):
            at = (
                slab if own < 0 or self.base_groups is None else slab[self.base_groups[slab] != own]
            )
            if not len(at):
                continue
            bound = (
                query_side(self.z[queries], d, np.zeros(len(queries)))
                @ base_side(self.index.z[at], d).T
            )
            allowed = self._allowed(queries[:, None], at[None])
            if allowed is not None:
                bound[~allowed] = np.inf
            met += len(at) if allowed is None else allowed.sum(axis=1)
            few = (
                np.argpartition(bound, k - 1, axis=1)[:, :k]
                if k < len(at)
                else np.broadcast_to(np.arange(len(at)), bound.shape)
            )
            i, j = np.nonzero(np.isfinite(np.take_along_axis(bound, few, axis=1)))
            self._found(queries[i], at[few[i, j]])
            lacking = met < max(k, GUESS_ROWS // 2)
            queries, met = queries[lacking], met[lacking]
            if not len(queries):
                return

    def _sweep(self, queries: Ints, at: Ints | None, right: Floats, p: int, sieve: Sieve) -> None:
        right = right if at is None else right[at]
        left = query_side(self.z[queries], p, self.best.squared[queries, -1] / self.unit)
        either = Either(self, queries, at, right) if self.mutual and at is not None else None
        held: list[tuple[Ints, Ints]] = []
        size = 0
        for i, j, product in sieve(left, right):
            if either is not None:
                passed = either(i, j, product)
                i, j = i[passed], j[passed]
            q, b = queries[i], j if at is None else at[j]
            allowed = self._allowed(q, b)
            if allowed is not None:
                q, b = q[allowed], b[allowed]
            held.append((q, b))
            size += len(q)
            if size > PENDING:
                self._found(*(np.concatenate(part) for part in zip(*held, strict=True)))
                held, size = [], 0
                if either is None:
                    left[:] = query_side(
                        self.z[queries], p, self.best.squared[queries, -1] / self.unit
                    )
        if held:
            self._found(*(np.concatenate(part) for part in zip(*held, strict=True)))


class Either:
    """Widens a block's test to max(t_x, t_y)^2.

    It lowers the right factor by max(0, t_y^2 - t^2), and tells afterwards which pairs passed for the sum alone.
    """

    def __init__(self, search: Nearest, queries: Ints, at: Ints, right: Floats) -> None:
        columns = right.shape[1]
        mine = search.best.squared[queries, -1] / search.unit
        theirs = search.best.squared[search.index.cells.order[at], -1] / search.unit
        self.mine, self.theirs = widened(mine, columns), widened(theirs, columns)
        self.added = np.maximum(0, self.theirs - self.mine.min())
        right[:, -1] -= self.added

    def __call__(self, i: Ints, j: Ints, product: Floats) -> NDArray[np.bool_]:
        """Which of the pairs have a bound of at most the larger of the two thresholds."""
        mine, theirs, added = self.mine[i], self.theirs[j], self.added[j]
        return product + mine + added <= np.maximum(mine, theirs) + 4e-6 * (mine + added)
