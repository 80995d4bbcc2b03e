"""All pairs within a radius, and the clusters that they make, without ever holding them all.

*Pairs*: rows are sorted by cell; each block of rows is swept (bound (1) of ``search.space``, threshold = radius) against the rows behind
it in that order, and what passes is measured in float64. Each unordered pair is met once.

*Clusters* are the connected components of "at most ``radius`` apart". Their pairs may be far too many (two million nearly identical
frames make 2e12), so a pair is looked at only while its rows are not joined yet:
1. identical rows count as one;
2. the rows of a ball of the radius round a row are all joined to that row, by one pass over the rows: first balls that hold a good part
   of all rows, then cell by cell;
3. the sweep drops candidates that are in the same cluster as all the rows of a cell, and pairs whose rows are joined by now.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from palpate.core import Progress
from palpate.leakage.search.exact import PENDING, QUERIES, Index, Sieve, choose_axes, within
from palpate.leakage.search.space import (
    Doubles,
    Floats,
    Ints,
    Space,
    base_side,
    query_side,
    squared_distances,
)

BALL_SHARE, BALLS = (
    0.05,
    32,
)  # a ball must hold this share of the rows that are left, else no more balls are drawn


class Close:
    """Rows sorted by cell, with what a sweep at one radius needs.

    Attributes:
        index: the rows as a searchable base.
        radius: the threshold.
    """

    def __init__(self, rows: Floats, radius: float) -> None:
        space = Space.of(rows)
        self.index, self.radius = Index(rows, space), radius
        self.limit = radius / space.norm
        starts = self.index.cells.starts
        _, self.away = self.index.cells.assign(
            self.index.z
        )  # of each sorted row from its cell's center
        self.spans = [
            (cell, int(a), int(b)) for cell, (a, b) in enumerate(pairwise(starts)) if b > a
        ]
        self.axes = choose_axes(
            self.index,
            [self._sample(*span) for span in self.spans[:: max(1, len(self.spans) // 12)]],
        )
        self.right = base_side(self.index.z, self.axes)
        self.sieve = Sieve()

    def _threshold(self, count: int) -> Doubles:
        return np.full(count, self.limit**2)

    def _sample(self, cell: int, start: int, end: int) -> tuple[Floats, Doubles, Ints]:
        end = min(end, start + QUERIES)
        at = np.flatnonzero(
            self.index.from_center(cell) <= within(self.away[start:end] + self.limit)
        )
        return self.index.z[start:end], self._threshold(end - start), at[:: max(1, len(at) // 1024)]

    def candidates(self, cell: int, start: int, end: int) -> Ints:
        """Positions from ``start`` on that may lie within the radius of a row in [start, end) of the cell."""
        near = self.index.from_center(cell)[start:] <= within(self.away[start:end] + self.limit)
        return start + np.flatnonzero(near)

    def passing(self, at: Ints, candidates: Ints) -> Iterator[tuple[Ints, Ints]]:
        """Pairs (position in at, candidate) that pass the bound."""
        right = self.right[candidates]
        for start in range(0, len(at), QUERIES):
            block = at[start : start + QUERIES]
            for i, j, _ in self.sieve(
                query_side(self.index.z[block], self.axes, self._threshold(len(block))), right
            ):
                yield block[i], candidates[j]

    def measured(self, i: Ints, j: Ints) -> tuple[Ints, Ints, Doubles]:
        """Rows i < j and squared distances of those pairs of positions that are truly within the radius."""
        a, b = self.index.cells.order[i], self.index.cells.order[j]
        squared = squared_distances(self.index.rows, a, self.index.rows, b)
        kept = squared <= self.radius**2
        a, b = a[kept], b[kept]
        return np.minimum(a, b), np.maximum(a, b), squared[kept]


def close_pairs(
    rows: Floats, radius: float, limit: int, progress: Progress
) -> Iterator[tuple[Ints, Ints, NDArray[np.float32]]]:
    """Streams each unordered pair within the radius once, at most ``limit`` pairs at a time."""
    close = Close(rows, radius)
    for cell, start, end in close.spans:
        candidates = close.candidates(cell, start, end)
        for i, j in close.passing(np.arange(start, end), candidates):
            behind = j > i
            i, j = i[behind], j[behind]
            for at in range(0, len(i), limit):
                a, b, squared = close.measured(i[at : at + limit], j[at : at + limit])
                if len(a):
                    yield a, b, np.sqrt(squared).astype(np.float32)
        progress("comparing", end, len(rows))


class Joined:
    """Clusters so far: ``root[i]`` is the lowest row of row i's cluster."""

    def __init__(self, rows: int) -> None:
        self.root = np.arange(rows)

    def join(self, a: Ints, b: Ints) -> None:
        """Joins rows pairwise."""
        a, b = self.root[a], self.root[b]
        names, local = np.unique(np.concatenate([a, b]), return_inverse=True)
        edges = coo_array(
            (np.ones(len(a), dtype=np.int8), (local[: len(a)], local[len(a) :])),
            shape=(len(names), len(names)),
        )
        _, part = connected_components(edges, directed=False)
        lowest = np.full(part.max() + 1, len(self.root))
        np.minimum.at(lowest, part, names)
        renamed = np.arange(len(self.root))
        renamed[names] = lowest[part]
        self.root = renamed[self.root]

    def ball(self, members: Ints) -> None:
        """Joins all members, and what is joined to them."""
        self.join(members[:-1], members[1:])


def clusters(rows: Floats, radius: float, progress: Progress) -> Ints:
    """The lowest row of each row's cluster; the rows should differ (identical ones cost time)."""
    joined = Joined(len(rows))
    _draw_balls(joined, rows, np.arange(len(rows)), radius)
    close = Close(rows, radius)
    order = close.index.cells.order
    for _, start, end in close.spans:
        _draw_balls(joined, rows, order[start:end], radius)
    for cell, start, end in close.spans:
        _sweep(joined, close, cell, start, end)
        progress("joining", end, len(rows))
    return joined.root


def _draw_balls(joined: Joined, rows: Floats, left: Ints, radius: float) -> None:
    """Joins the rows of large balls, each round the first row that is in no ball yet."""
    for _ in range(BALLS):
        if len(left) < 2:
            return
        inside = (
            squared_distances(rows, left, rows, np.broadcast_to(left[:1], left.shape)) <= radius**2
        )
        if inside.sum() > 1:
            joined.ball(left[inside])
        if inside.sum() < max(2, BALL_SHARE * len(left)):
            return
        left = left[~inside]


def _sweep(joined: Joined, close: Close, cell: int, start: int, end: int) -> None:
    order = close.index.cells.order
    own = joined.root[order[start:end]]
    candidates = close.candidates(cell, start, end)
    if (own == own[0]).all():
        candidates = candidates[joined.root[order[candidates]] != own[0]]
    if not len(candidates):
        return
    held: list[tuple[Ints, Ints]] = []
    size = 0
    for i, j in close.passing(np.arange(start, end), candidates):
        apart = joined.root[order[i]] != joined.root[order[j]]
        held.append((i[apart], j[apart]))
        size += int(apart.sum())
        if size > PENDING:
            _join_close(joined, close, held)
            held, size = [], 0
    if size:
        _join_close(joined, close, held)


def _join_close(joined: Joined, close: Close, held: list[tuple[Ints, Ints]]) -> None:
    """Measures pairs a few at a time and joins the close ones, skipping those that are joined by then."""
    order = close.index.cells.order
    i, j = (np.concatenate(part) for part in zip(*held, strict=True))
    step = 256
    while len(i):
        a, b, _ = close.measured(i[:step], j[:step])
        if len(a):
            joined.join(a, b)
        i, j, step = i[step:], j[step:], 4 * step
        apart = joined.root[order[i]] != joined.root[order[j]]
        i, j = i[apart], j[apart]
