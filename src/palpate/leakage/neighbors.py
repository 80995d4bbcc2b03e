"""Nearest neighbors, by faiss, without those that may be related to a query."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

#: Queries at a time, which bounds memory.
BLOCK = 2048
#: Neighbors up to which a search is quick; more related rows than that are left out before.
MOST = 100


@dataclass(frozen=True)
class Apart:
    """Which rows of the base are no neighbors of a query, as they may be related to it."""

    queries: Ints  # (q,) a number of each query
    base: Ints  # (m,) a number of each base row
    #: None excludes equal numbers; else numbers, all different, that are at most so far apart.
    window: int | None = None

    def related(self, rows: Any, base: Any) -> NDArray[np.bool_]:
        """Whether queries and base rows, broadcast, are related."""
        return np.abs(self.queries[rows] - self.base[base]) <= (self.window or 0)


def nearest(queries: Floats, base: Floats, k: int = 1, *, apart: Apart | None = None) -> Ints:
    """The k nearest base rows of each query, by Euclidean distance; ``apart`` excludes some.

    Returns:
        (n, k) rows of the base (m, d) for queries (n, d), nearest first; -1 where there is none.
    """
    if apart is None:
        return _search(queries, base, k)[0]
    widest = 2 * apart.window + 1 if apart.window is not None else _largest(apart)
    if apart.window is not None or k + widest <= MOST:
        index = _search(queries, base, k + widest)[0]
        index[apart.related(np.arange(len(index))[:, None], index) & (index >= 0)] = -1
        order = np.argsort(index < 0, axis=1, kind="stable")[:, :k]
        return np.take_along_axis(index, order, axis=1)
    # Sorted by group, all rows of other groups are two slices, which need no selector.
    order = np.argsort(apart.base, kind="stable")
    rows, labels = base[order], apart.base[order]
    index = np.full((len(queries), k), -1, np.int64)
    for group in np.unique(apart.queries).tolist():
        at = np.flatnonzero(apart.queries == group)
        low, high = np.searchsorted(labels, [group, group + 1])
        before, near = _search(queries[at], rows[:low], k)
        after, far = _search(queries[at], rows[high:], k)
        both = np.concatenate([before, np.where(after < 0, -1, after + high)], axis=1)
        best = np.argsort(np.concatenate([near, far], axis=1), axis=1, kind="stable")[:, :k]
        picked = np.take_along_axis(both, best, axis=1)
        index[at] = np.where(picked < 0, -1, order[picked])
    return index


def _largest(apart: Apart) -> int:
    """The most base rows that are related to one query."""
    related = apart.base[np.isin(apart.base, apart.queries)]
    return int(np.unique(related, return_counts=True)[1].max(initial=0))


def _search(queries: Floats, base: Floats, k: int) -> tuple[Ints, Any]:
    """Rows and squared distances; -1 and infinity where there are fewer than k."""
    import faiss  # lists and most scores do without

    index = np.full((len(queries), k), -1, np.int64)
    distance = np.full((len(queries), k), np.inf, np.float32)
    if len(base):
        for start in range(0, len(queries), BLOCK):
            part = slice(start, start + BLOCK)
            least, rows = faiss.knn(queries[part], base, k)
            index[part], distance[part] = rows, np.where(rows < 0, np.inf, least)
    return index, distance
