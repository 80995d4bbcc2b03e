"""Nearest neighbors and near-duplicates among feature vectors: the search engine of the leak audit.

Distances are Euclidean, measured as |x - y| in float64 on the rows as given (never as |x|^2 + |y|^2 - 2 xy, which cancels for
near-duplicates), ties go to the lowest row, and no N x N matrix is ever held. The mathematics of the exact search is in ``search.space``
(a bound that never loses a pair) and ``search.exact`` (guess, sweep, measure); beyond :data:`EXACT_LIMIT` different base rows,
:func:`nearest` asks faiss, which is approximate. Identical rows are searched once, so two million frames of the same untouched gel cost
little more than one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError, Progress, quiet
from palpate.leakage.search.exact import Best, Nearest
from palpate.leakage.search.pairs import close_pairs, clusters
from palpate.leakage.search.space import Floats, Ints, checked_labels, checked_rows, identical_rows
from palpate.leakage.search.threads import limited, one_blas_thread

EXACT_LIMIT = 100_000
BACKENDS = ("auto", "exact", "faiss")


@dataclass(frozen=True)
class Neighbors:
    """The nearest base rows of each query.

    Attributes:
        index: (n, k) rows of the base, nearest first; -1 where there is none.
        distance: (n, k) Euclidean distances; infinity where there is none.
        backend: ``"exact"``, or ``"faiss ..."`` with its settings (approximate: a nearer row may have been missed; the distances given are
            true).
    """

    index: NDArray[np.int64]
    distance: NDArray[np.float32]
    backend: str


def nearest(
    queries: object,
    base: object,
    k: int = 1,
    *,
    query_groups: object = None,
    base_groups: object = None,
    self_join: bool = False,
    radius: float | None = None,
    backend: str = "auto",
    progress: Progress = quiet,
) -> Neighbors:
    """The k nearest base rows of each query.

    Args:
        queries: (n, d) finite float32 numbers.
        base: (m, d); may be the same array.
        k: how many, at least one.
        query_groups: (n,) integer labels; a base row of the query's own group is no candidate. A negative label is an unknown group, which
            excludes nothing.
        base_groups: (m,) labels; needed with ``query_groups``.
        self_join: row i of ``queries`` is row i of ``base`` and must not find itself. An identical other row is found, at distance 0.
        radius: rows further than this are left out, which makes the search faster.
        backend: ``"exact"``, ``"faiss"`` (approximate), or ``"auto"``: exact up to :data:`EXACT_LIMIT` base rows (identical rows counted k
            + 1 times at most).
        progress: told about blocks of queries.

    Returns:
        Rows, distances and what found them. The exact result is that of brute force in float64, ties by lowest row.

    Raises:
        PalpateError: on shapes or labels that do not fit, numbers that are not finite (naming the first row), or an option out of range.
        MissingExtraError: if faiss is needed and not installed.
    """
    same = queries is base
    x = checked_rows("queries", queries)
    y = x if same else checked_rows("base", base)
    if x.shape[1] != y.shape[1]:
        raise PalpateError(
            "queries and base must have as many dimensions",
            f"{x.shape[1]} and {y.shape[1]}",
            "Make both with the same descriptor or encoder",
        )
    if self_join and len(x) != len(y):
        raise PalpateError(
            "A self join must search the rows among themselves",
            f"{len(x)} queries and {len(y)} base rows",
            "Pass the same rows twice",
        )
    if k < 1:
        raise PalpateError("k must be at least 1", str(k), "Ask for one neighbor or more")
    if backend not in BACKENDS:
        raise PalpateError(
            f"backend must be one of {', '.join(BACKENDS)}", str(backend), "Choose one of them"
        )
    _check_radius(radius, needed=False)
    if (query_groups is None) != (base_groups is None):
        raise PalpateError(
            "Groups must be given for queries and base, or for neither",
            "groups for one of them",
            "Pass both",
        )
    qg, bg = (
        checked_labels("query_groups", query_groups, len(x)),
        checked_labels("base_groups", base_groups, len(y)),
    )
    if not len(x) or not len(y):
        return Neighbors(
            np.full((len(x), k), -1), np.full((len(x), k), np.inf, np.float32), "exact"
        )
    found, name = _distinct(x, y, k + self_join, qg, bg, radius, backend, progress)
    index, squared = _without_self(found) if self_join else (found.row, found.squared)
    return Neighbors(index, np.sqrt(squared).astype(np.float32), name)


def _check_radius(radius: float | None, needed: bool = True) -> None:
    if (radius is None and needed) or (
        radius is not None and not (np.isfinite(radius) and radius >= 0)
    ):
        raise PalpateError(
            "radius must be a finite distance, zero or more", str(radius), "Pass e.g. radius=0.1"
        )


def _distinct(
    x: Floats,
    y: Floats,
    k: int,
    qg: Ints | None,
    bg: Ints | None,
    radius: float | None,
    backend: str,
    progress: Progress,
) -> tuple[Best, str]:
    """Searches each different query once, among the k lowest copies of each different base row: no other can be among the k nearest."""
    first, rank = identical_rows(y, bg)
    kept = np.flatnonzero(rank < k)
    if x is y and (qg is None or bg is None or np.array_equal(qg, bg)):
        asked, back = np.flatnonzero(rank == 0), first
    else:
        back, rank = identical_rows(x, qg)
        asked = np.flatnonzero(rank == 0)
    whole = len(asked) == len(x) and len(kept) == len(y)
    rows = y if len(kept) == len(y) else y[kept]
    wanted = rows if x is y and whole else x if len(asked) == len(x) else x[asked]
    groups = (None if qg is None else qg[asked], None if bg is None else bg[kept])
    if backend == "faiss" or (backend == "auto" and len(rows) > EXACT_LIMIT):
        from palpate.leakage.search.approximate import (
            approximate,
        )  # so that nothing of it is imported where nobody asks for it

        best, name = approximate(wanted, rows, k, *groups, radius, progress)
    else:
        best, name = Nearest(wanted, rows, k, *groups, radius).solve(progress), "exact"
    place = np.empty(len(x), dtype=np.int64)
    place[asked] = np.arange(len(asked))
    at = place[back]
    row = np.where(best.row < 0, -1, kept[best.row])
    return Best(best.squared[at], row[at]), name


def _without_self(found: Best) -> tuple[Ints, NDArray[np.float64]]:
    """Drops each row from its own neighbors, or else the last of them."""
    own = found.row == np.arange(len(found.row))[:, None]
    own[:, -1] |= ~own.any(axis=1)
    shape = (len(own), own.shape[1] - 1)
    return found.row[~own].reshape(shape), found.squared[~own].reshape(shape)


def pairs_within(
    vectors: object,
    radius: float,
    *,
    progress: Progress = quiet,
    max_pairs_per_block: int = 1 << 16,
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]]:
    """Every pair of rows at most ``radius`` apart, exactly, in blocks; use :func:`clusters_within` where rows may be near by the million.

    Args:
        vectors: (n, d) finite float32 numbers.
        radius: Euclidean, zero or more.
        progress: told about rows.
        max_pairs_per_block: how many pairs a block may hold.

    Returns:
        An iterator of (i, j, distance) with i < j, each pair once, in an order that depends on the rows alone.

    Raises:
        PalpateError: on rows that are no matrix of finite numbers, or an option out of range. Raised at the call, not while iterating.
    """
    rows = checked_rows("vectors", vectors)
    _check_radius(radius)
    if max_pairs_per_block < 1:
        raise PalpateError(
            "max_pairs_per_block must be at least 1", str(max_pairs_per_block), "Leave it out"
        )
    return (
        limited(close_pairs(rows, radius, max_pairs_per_block, progress))
        if len(rows) > 1
        else iter(())
    )


def clusters_within(
    vectors: object, radius: float, *, progress: Progress = quiet
) -> NDArray[np.int64]:
    """Connected components of "at most ``radius`` apart", exactly, without listing the pairs.

    Args:
        vectors: (n, d) finite float32 numbers.
        radius: Euclidean, zero or more.
        progress: told about rows.

    Returns:
        (n,) the lowest row of each row's component.

    Raises:
        PalpateError: as :func:`pairs_within`.
    """
    rows = checked_rows("vectors", vectors)
    _check_radius(radius)
    first, rank = identical_rows(rows)
    different = np.flatnonzero(rank == 0)
    if len(different) < 2:
        return first
    with one_blas_thread():
        root = clusters(rows if len(different) == len(rows) else rows[different], radius, progress)
    lowest = np.arange(len(rows))
    lowest[different] = different[
        root
    ]  # the different rows ascend, so the lowest of them is the lowest of all
    return lowest[first]
