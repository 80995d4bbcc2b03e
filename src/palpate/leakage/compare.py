"""What near-duplicate detection needs of a kind of features: candidates by nearest neighbors, and the similarity of a pair.

:class:`Plates` compares pictures (``verify``), :class:`Embeddings` the vectors of a trained encoder by their cosine. Both answer in [-1, 1] for row numbers of one pool
that holds every distinct picture of train and test once.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress, quiet
from palpate.leakage.calibrate import HIGHEST
from palpate.leakage.descriptors import search_vectors
from palpate.leakage.search import nearest
from palpate.leakage.verify import BLOCK, Floats, Ints, against_all, similarities

#: Up to so many pairs are all compared, without a search for candidates.
EXHAUSTIVE = 200_000
#: Candidates of each query that are verified; a planted copy was among the first 3 of 192 in every trial.
CANDIDATES = 8


class Comparer(Protocol):
    """Features of a pool of pictures.

    Attributes:
        name: for people.
        same: the similarity from which two rows are the same picture, whatever others are like.
    """

    name: str
    same: float

    def vectors(self) -> Floats:
        """(n, d) rows whose nearest neighbors are candidates."""
        ...

    def pairs(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """(p,) similarity of each pair in [-1, 1]."""
        ...

    def grid(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """(len(i), len(j)) similarities of every query with every one of a few others."""
        ...


class Plates:
    """Band-passed pictures, compared by aligned cross-correlation.

    Args:
        plates: (n, 3, 32, 32) of any scale.
    """

    def __init__(self, plates: NDArray[np.int8]) -> None:
        self.name = "aligned cross-correlation of 32 x 32 YCbCr, band-passed"
        self.same = HIGHEST
        self._plates = plates
        self._vectors: Floats | None = None

    def vectors(self) -> Floats:
        """See :func:`palpate.leakage.descriptors.search_vectors`."""
        if self._vectors is None:
            self._vectors = search_vectors(self._plates)
        return self._vectors

    def pairs(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """See :func:`palpate.leakage.verify.similarities`."""
        return similarities(self._plates, i, j, progress=progress)

    def grid(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """See :func:`palpate.leakage.verify.against_all`."""
        out = np.empty((len(i), len(j)), np.float32)
        for part, values in against_all(self._plates, i, j, progress=progress):
            out[part] = values
        return out


class Embeddings:
    """Vectors compared by cosine.

    Args:
        vectors: (n, d) finite numbers; a row of zeros is like nothing.
        name: of what made them.
    """

    def __init__(self, vectors: Floats, name: str) -> None:
        self.name = name
        self.same = 1 - 1e-6  # a weak encoder puts different pictures very near
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        self._vectors = (vectors / np.maximum(length, np.float32(1e-12))).astype(np.float32)

    def vectors(self) -> Floats:
        """The unit vectors."""
        return self._vectors

    def pairs(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """Cosines."""
        out = np.empty(len(i), np.float32)
        for start in range(0, len(i), BLOCK):
            progress("comparing embeddings", start, len(i))
            part = slice(start, start + BLOCK)
            out[part] = np.einsum("pd,pd->p", self._vectors[i[part]], self._vectors[j[part]])
        return out

    def grid(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """Cosines."""
        progress("comparing embeddings", 0, len(i))
        return self._vectors[i] @ self._vectors[j].T


def best_matches(
    comparer: Comparer,
    queries: Ints,
    base: Ints,
    query_groups: Ints | None = None,
    base_groups: Ints | None = None,
    progress: Progress = quiet,
) -> tuple[Ints, Floats]:
    """For each query the most similar of the base, leaving out the base's rows of the query's own group.

    Args:
        comparer: the features.
        queries: (q,) rows of the pool.
        base: (m,) rows of the pool.
        query_groups: (q,) labels; negative = unknown, excludes nothing. None: nothing is left out.
        base_groups: (m,) labels.
        progress: told about both steps.

    Returns:
        (place, similarity): (q,) places in ``base``, -1 where none is left, and similarities, NaN there.
    """
    place, value = np.full(len(queries), -1, np.int64), np.full(len(queries), np.nan, np.float32)
    if not len(queries) or not len(base):
        return place, value
    if len(queries) * len(base) <= EXHAUSTIVE:
        found = comparer.grid(queries, base, progress)
        if query_groups is not None and base_groups is not None:
            found = np.where(
                (query_groups[:, None] == base_groups[None]) & (query_groups[:, None] >= 0),
                -np.inf,
                found,
            )
        best = found.argmax(axis=1)
        top = found[np.arange(len(best)), best]
        has = np.isfinite(top)
        place[has], value[has] = best[has], top[has]
        return place, value
    vectors = comparer.vectors()
    found = nearest(
        vectors[queries],
        vectors[base],
        min(CANDIDATES, len(base)),
        query_groups=query_groups,
        base_groups=base_groups,
        progress=progress,
    )
    rows, columns = np.nonzero(found.index >= 0)
    candidates = found.index[rows, columns]
    values = comparer.pairs(queries[rows], base[candidates], progress)
    order = np.lexsort(
        (candidates, -values, rows)
    )  # the best candidate of each query first; ties to the lowest row
    first = np.unique(rows[order], return_index=True)
    place[first[0]] = candidates[order][first[1]]
    value[first[0]] = values[order][first[1]]
    return place, value


def all_or_nearest(
    comparer: Comparer, items: Ints, count: int, progress: Progress = quiet
) -> tuple[Ints, Ints, Floats]:
    """Pairs of different pictures worth looking at: all if they are few, else each with its ``count`` nearest.

    Returns:
        (i, j, similarity): places in ``items``; a pair may stand in both orders.
    """
    if len(items) ** 2 <= EXHAUSTIVE:
        found = (
            comparer.grid(items, items, progress) if len(items) else np.zeros((0, 0), np.float32)
        )
        i, j = np.nonzero(items[:, None] != items[None])
        return i, j, found[i, j]
    vectors = comparer.vectors()[items]
    near = nearest(vectors, vectors, count, self_join=True, progress=progress).index
    i, k = np.nonzero(near >= 0)
    j = near[i, k]
    return i, j, comparer.pairs(items[i], items[j], progress)
