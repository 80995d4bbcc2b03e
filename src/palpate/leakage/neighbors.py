"""Nearest neighbors of unit vectors: all pairs of small sets, faiss' flat index for large ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress, quiet

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

#: Queries between two calls of the progress callback.
BLOCK = 2048
#: Up to so many pairs all are compared; above, so many candidates by the leading columns.
EXHAUSTIVE, COARSE, CANDIDATES = 4_000_000, 192, 8


@dataclass(frozen=True)
class Apart:
    """Which rows of the base are no neighbors of a query, as they may be related to it.

    Attributes:
        queries: (q,) a number of each query.
        base: (m,) a number of each base row.
        window: None excludes equal numbers; else numbers, all different, that are at most so far
            apart.
    """

    queries: Ints
    base: Ints
    window: int | None = None

    def only(self, rows: Ints) -> Apart:
        """For some of the queries."""
        return Apart(self.queries[rows], self.base, self.window)

    def related(self, rows: Any, base: Any) -> NDArray[np.bool_]:
        """Whether queries and base rows, broadcast, are related."""
        return np.abs(self.queries[rows] - self.base[base]) <= (self.window or 0)


class Base:
    """Vectors to search among.

    Args:
        vectors: (m, d) unit vectors, of any float type; candidates are chosen by the leading
            ``COARSE`` columns.
    """

    def __init__(self, vectors: NDArray[Any]) -> None:
        self._vectors = vectors

    def closest(
        self,
        queries: Floats,
        count: int = 1,
        apart: Apart | None = None,
        progress: Progress = quiet,
    ) -> tuple[Ints, Floats]:
        """The most similar rows of each query.

        Returns:
            (rows, cosines): (q, count), best first; -1 and NaN where there is none.
        """
        rows = np.full((len(queries), count), -1, np.int64)
        cosines = np.full((len(queries), count), np.nan, np.float32)
        every = len(queries) * len(self._vectors) <= EXHAUSTIVE
        candidates = np.arange(len(self._vectors))[None].repeat(len(queries) if every else 0, 0)
        if not every:
            coarse, among = (
                np.ascontiguousarray(x[:, :COARSE], np.float32) for x in (queries, self._vectors)
            )
            candidates = nearest(coarse, among, count + CANDIDATES, apart=apart, progress=progress)
        vectors = self._vectors.astype(np.float32) if every else None
        for start in range(0, len(queries), BLOCK):
            part = slice(start, start + BLOCK)
            near = candidates[part]
            if vectors is not None:
                values = queries[part] @ vectors.T
                if apart is not None:
                    at = np.arange(start, start + len(near))[:, None]
                    values[apart.related(at, near)] = -np.inf
            else:
                values = _cosines(queries[part], self._vectors, near)
            best = min(count, near.shape[1])
            order = values.argmax(axis=1)[:, None]
            if count > 1:
                order = np.argsort(-values, axis=1, kind="stable")[:, :best]
            value = np.take_along_axis(values, order, axis=1)
            place = np.take_along_axis(near, order, axis=1)
            known = np.isfinite(value)
            rows[part, :best] = np.where(known, place, -1)
            cosines[part, :best] = np.where(known, value, np.nan)
        return rows, cosines


def _cosines(queries: Floats, base: NDArray[Any], candidates: Ints) -> Floats:
    """(q, k) of each query with its candidates; -inf where there is none."""
    values = np.full(candidates.shape, -np.inf, np.float32)
    for k, rows in enumerate(candidates.T):
        value = np.einsum("qd,qd->q", queries, base[rows].astype(np.float32))
        values[:, k] = np.where(rows >= 0, value, -np.inf)
    return values


def nearest(
    queries: Floats,
    base: Floats,
    k: int = 1,
    *,
    apart: Apart | None = None,
    progress: Progress = quiet,
) -> Ints:
    """The k nearest base rows of each query, by Euclidean distance.

    Args:
        queries: (n, d).
        base: (m, d).
        k: how many, at least 1.
        apart: which base rows are no neighbors.
        progress: called with the number of queries done.

    Returns:
        (n, k) rows of the base, nearest first; -1 where there is none.
    """
    if apart is None:
        return _search(queries, base, k, progress)[0]
    if apart.window is not None:
        index = _search(queries, base, k + 2 * apart.window + 1, progress)[0]
        index[apart.related(np.arange(len(index))[:, None], index) & (index >= 0)] = -1
        order = np.argsort(index < 0, axis=1, kind="stable")[:, :k]
        return np.take_along_axis(index, order, axis=1)
    # Sorted by group, all rows of other groups are two slices, which need no selector.
    order = np.argsort(apart.base, kind="stable")
    rows, labels = base[order], apart.base[order]
    index = np.full((len(queries), k), -1, np.int64)
    done = 0
    for group in np.unique(apart.queries).tolist():
        at = np.flatnonzero(apart.queries == group)
        low, high = np.searchsorted(labels, [group, group + 1])
        before, near = _search(queries[at], rows[:low], k)
        after, far = _search(queries[at], rows[high:], k)
        both = np.concatenate([before, np.where(after < 0, -1, after + high)], axis=1)
        best = np.argsort(np.concatenate([near, far], axis=1), axis=1, kind="stable")[:, :k]
        picked = np.take_along_axis(both, best, axis=1)
        index[at] = np.where(picked < 0, -1, order[picked])
        done += len(at)
        progress("searching", done, len(queries))
    return index


def _search(queries: Floats, base: Floats, k: int, progress: Progress = quiet) -> tuple[Ints, Any]:
    """Rows and squared distances; -1 and infinity where there are fewer than k."""
    index = np.full((len(queries), k), -1, np.int64)
    distance = np.full((len(queries), k), np.inf, np.float32)
    if len(base):
        for start in range(0, len(queries), BLOCK):
            progress("searching", start, len(queries))
            part = slice(start, start + BLOCK)
            least, rows = faiss.knn(queries[part], base, k)
            index[part], distance[part] = rows, np.where(rows < 0, np.inf, least)
    progress("searching", len(queries), len(queries))
    return index, distance
