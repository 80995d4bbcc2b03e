"""Exact nearest neighbors among feature vectors, by faiss' flat index."""

from __future__ import annotations

from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress, quiet

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

#: Queries between two calls of the progress callback.
BLOCK = 4096


def nearest(
    queries: Floats,
    base: Floats,
    k: int = 1,
    *,
    groups: tuple[Ints, Ints] | None = None,
    progress: Progress = quiet,
) -> Ints:
    """The k nearest base rows of each query, by Euclidean distance.

    Args:
        queries: (n, d).
        base: (m, d).
        k: how many, at least 1.
        groups: (n,) labels of queries and (m,) of the base; a base row of the query's group is no
            neighbor. A negative label is an unknown group, which excludes nothing.
        progress: called with the number of queries done.

    Returns:
        (n, k) rows of the base, nearest first; -1 where there is none.
    """
    if groups is None:
        return _search(queries, base, k, progress)[0]
    query_groups, base_groups = groups
    # Sorted by group, all rows of other groups are two slices, which need no selector.
    order = np.argsort(base_groups, kind="stable")
    rows, labels = base[order], base_groups[order]
    index = np.full((len(queries), k), -1, np.int64)
    done = 0
    for group in np.unique(query_groups).tolist():
        at = np.flatnonzero(query_groups == group)
        low, high = np.searchsorted(labels, [group, group + 1]) if group >= 0 else (0, 0)
        before, near = _search(queries[at], rows[:low], k)
        after, far = _search(queries[at], rows[high:], k)
        both = np.concatenate([before, np.where(after < 0, -1, after + high)], axis=1)
        best = np.argsort(np.concatenate([near, far], axis=1), axis=1, kind="stable")[:, :k]
        picked = np.take_along_axis(both, best, axis=1)
        index[at] = np.where(picked < 0, -1, order[picked])
        done += len(at)
        progress("searching", done, len(queries))
    return index


def other_nearest(rows: Floats, k: int, progress: Progress = quiet) -> Ints:
    """(n, k) the k nearest other rows of each row; -1 where there is none."""
    index = _search(rows, rows, k + 1, progress)[0]
    itself = index == np.arange(len(rows))[:, None]
    itself[:, -1] |= ~itself.any(axis=1)  # among many equal rows it may not be listed
    return index[~itself].reshape(len(rows), k)


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
