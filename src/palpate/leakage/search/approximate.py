"""Approximate nearest neighbors by faiss, for bases beyond the exact limit.

An inverted file of flat vectors (IVF): k-means with ``4 sqrt(m)`` lists (fixed seed, at most 64 training rows a list), and the
:data:`PROBES` lists nearest to a query are searched in full. Rows of the query's own group are left out inside faiss, by an ID selector
over the base sorted by group, one call a group, so that a video of ten thousand frames cannot fill the k places. What faiss returns is
measured again in float64 and sorted by (distance, row).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from palpate.core import MissingExtraError, Progress
from palpate.leakage.search.exact import Best
from palpate.leakage.search.space import Floats, Ints, squared_distances

PROBES, TRAINING_ROWS, SEED, QUERIES = 32, 64, 20240607, 4096


def approximate(
    queries: Floats,
    base: Floats,
    k: int,
    query_groups: Ints | None,
    base_groups: Ints | None,
    radius: float | None,
    progress: Progress,
) -> tuple[Best, str]:
    """As :class:`~palpate.leakage.search.exact.Nearest`, approximately; the second value names backend and settings.

    Raises:
        MissingExtraError: if faiss is not installed.
    """
    try:
        import faiss
    except ImportError:
        raise MissingExtraError(
            "faiss-cpu", "faiss", "Searching more than 100,000 images for near-duplicates"
        ) from None
    order = np.arange(len(base)) if base_groups is None else np.argsort(base_groups, kind="stable")
    lists = int(np.clip(4 * np.sqrt(len(base)), 1, max(1, len(base) // 39)))
    probes = min(PROBES, lists)
    index = _trained(faiss, base if base_groups is None else base[order], lists)
    best = Best.none(len(queries), k)
    if radius is not None:
        best.squared[:] = radius**2
    settings: Any = (
        faiss.SearchParametersIVF
    )  # takes its fields as keywords, which its stub does not know
    done = 0
    for at, span in _calls(
        query_groups, None if base_groups is None else base_groups[order], len(queries)
    ):
        size = len(at)
        own = (
            None if span is None else faiss.IDSelectorRange(*span)
        )  # must outlive the selector that refers to it
        others = {} if own is None else {"sel": faiss.IDSelectorNot(own)}
        for effort in (
            probes,
            lists,
        ):  # where the probed lists hold too few allowed rows, all lists are searched
            _, found = index.search(queries[at], k, params=settings(nprobe=effort, **others))
            i, j = np.nonzero(found >= 0)
            rows = order[found[i, j]]
            best.merge(at[i], squared_distances(queries, at[i], base, rows), rows)
            lacking = (found < 0).any(axis=1)
            if not lacking.any():
                break
            at = at[lacking]
        done += size
        progress("searching neighbors", done, len(queries))
    best.squared[best.row < 0] = np.inf
    return (
        best,
        f"faiss {faiss.__version__} IVF{lists},Flat nprobe={probes} (approximate; distances exact)",
    )


def _trained(faiss: Any, base: Floats, lists: int) -> Any:
    index = faiss.IndexIVFFlat(faiss.IndexFlatL2(base.shape[1]), base.shape[1], lists)
    (
        index.cp.seed,
        index.cp.max_points_per_centroid,
        index.cp.niter,
        index.cp.min_points_per_centroid,
    ) = SEED, TRAINING_ROWS, 10, 1
    index.train(base[:: max(1, len(base) // (TRAINING_ROWS * lists))])
    for start in range(0, len(base), 1 << 16):
        index.add(base[start : start + (1 << 16)])
    return index


def _calls(
    query_groups: Ints | None, base_groups: Ints | None, n: int
) -> Iterator[tuple[Ints, tuple[int, int] | None]]:
    """Queries that can be asked together, and the span of base positions that they must not find."""
    order = np.arange(n) if query_groups is None else np.argsort(query_groups, kind="stable")
    ends = np.r_[0, n]
    if query_groups is not None:
        labels = query_groups[order]
        ends = np.r_[0, np.flatnonzero(labels[1:] != labels[:-1]) + 1, n]
    for a, b in pairwise(ends):
        span = None
        if query_groups is not None and base_groups is not None and query_groups[order[a]] >= 0:
            label = query_groups[order[a]]
            span = (
                int(np.searchsorted(base_groups, label, "left")),
                int(np.searchsorted(base_groups, label, "right")),
            )
        for start in range(a, b, QUERIES):
            yield order[start : min(start + QUERIES, b)], span
