"""Candidates by nearest neighbors and the similarity of a pair, for images and for embeddings.

:class:`ImageSimilarity` compares images (:mod:`palpate.leakage.correlation`),
:class:`CosineSimilarity` the embeddings of a trained encoder. Both answer in [-1, 1] for row
numbers of one pool that holds every distinct image of train and test once.

The search vector of a band-passed image x joins two parts of equal length:

* the magnitudes of the windowed spectrum up to 4 cycles a side, |F(w x)|^(1/2): a shift changes
only
  phases;
* G_2 x at every fourth pixel: where things are, blurred by more than a shift moves them.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from palpate.core import Progress, quiet
from palpate.leakage.correlation import BLOCK, blur_matrix, similarities, similarity_grid
from palpate.leakage.neighbors import Floats, Ints, nearest, other_nearest
from palpate.leakage.thumbnails import SIDE

#: Up to so many pairs are all compared, without a search for candidates.
EXHAUSTIVE = 200_000
#: Candidates of each query; a planted copy was among the first 3 of 192 in every trial.
CANDIDATES = 8
_HIGHEST = 4
_HANN = np.hanning(SIDE + 2)[1:-1]
_WINDOW = np.outer(_HANN, _HANN).astype(np.float32)
_BLUR = blur_matrix(2.0)[2::4]


class Similarity(Protocol):
    """Features of a pool of images.

    Attributes:
        same: the similarity from which two rows are the same image, whatever the others are.
    """

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


class ImageSimilarity:
    """Band-passed images (n, 3, 32, 32) of any scale, by aligned cross-correlation."""

    def __init__(self, images: NDArray[np.int8]) -> None:
        self.same = 0.9995
        self._images = images
        self._vectors: Floats | None = None

    def vectors(self) -> Floats:
        """(n, 327) search vectors, made once."""
        if self._vectors is None:
            self._vectors = search_vectors(self._images)
        return self._vectors

    def pairs(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """See :func:`palpate.leakage.correlation.similarities`."""
        return similarities(self._images, i, j, progress=progress)

    def grid(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """See :func:`palpate.leakage.correlation.similarity_grid`."""
        return similarity_grid(self._images, i, j, progress=progress)


class CosineSimilarity:
    """Embeddings (n, d) by their cosine; a row of zeros is similar to nothing."""

    def __init__(self, vectors: Floats) -> None:
        self.same = 1 - 1e-6  # a weak encoder puts different images very near
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        self._vectors = (vectors / np.maximum(length, np.float32(1e-12))).astype(np.float32)

    def vectors(self) -> Floats:
        """The unit vectors."""
        return self._vectors

    def pairs(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """Cosines."""
        cosine = np.empty(len(i), np.float32)
        for start in range(0, len(i), BLOCK):
            progress("comparing embeddings", start, len(i))
            part = slice(start, start + BLOCK)
            cosine[part] = (self._vectors[i[part]] * self._vectors[j[part]]).sum(axis=1)
        return cosine

    def grid(self, i: Ints, j: Ints, progress: Progress = quiet) -> Floats:
        """Cosines."""
        progress("comparing embeddings", 0, len(i))
        return self._vectors[i] @ self._vectors[j].T


def search_vectors(images: NDArray[np.int8]) -> Floats:
    """(n, 327) for band-passed images (n, 3, 32, 32); zeros where an image is flat."""
    keep = _HIGHEST + 1
    vectors = np.zeros(
        (len(images), 3 * (2 * _HIGHEST + 1) * keep + 3 * len(_BLUR) ** 2), np.float32
    )
    for start in range(0, len(images), BLOCK):
        x = images[start : start + BLOCK].astype(np.float32)
        spectrum = np.asarray(fft.rfft2(x * _WINDOW))
        low = np.concatenate(
            [spectrum[:, :, :keep, :keep], spectrum[:, :, -_HIGHEST:, :keep]], axis=2
        )
        parts = [_unit(np.sqrt(np.abs(low))), _unit(_BLUR @ x @ _BLUR.T)]
        vectors[start : start + BLOCK] = np.hstack(parts)
    return vectors


def _unit(x: NDArray[np.floating]) -> NDArray[np.floating]:
    """Each image's numbers as a row of length 1 (or 0)."""
    flat = x.reshape(len(x), -1)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)


def best_matches(
    similarity: Similarity,
    queries: Ints,
    base: Ints,
    groups: tuple[Ints, Ints] | None = None,
    progress: Progress = quiet,
) -> tuple[Ints, Floats]:
    """For each query the most similar of the base, without the base's rows of the query's group.

    Args:
        similarity: the features.
        queries: (q,) rows of the pool.
        base: (m,) rows of the pool.
        groups: (q,) and (m,) labels; negative: unknown, which excludes nothing.
        progress: callback.

    Returns:
        (place, similarity): (q,) places in ``base``, -1 where there is none, and similarities, NaN
        there.
    """
    place, value = np.full(len(queries), -1, np.int64), np.full(len(queries), np.nan, np.float32)
    if not len(queries) or not len(base):
        return place, value
    if len(queries) * len(base) <= EXHAUSTIVE:
        candidates = np.broadcast_to(np.arange(len(base)), (len(queries), len(base)))
        values = similarity.grid(queries, base, progress)
        if groups is not None:
            same = (groups[0][:, None] == groups[1]) & (groups[0][:, None] >= 0)
            values = np.where(same, -np.inf, values)
    else:
        vectors = similarity.vectors()
        candidates = nearest(
            vectors[queries], vectors[base], CANDIDATES, groups=groups, progress=progress
        )
        values = np.full(candidates.shape, -np.inf, np.float32)
        known = candidates >= 0
        i, j = queries[np.nonzero(known)[0]], base[candidates[known]]
        values[known] = similarity.pairs(i, j, progress)
    rows, best = np.arange(len(queries)), values.argmax(axis=1)
    has = np.isfinite(values[rows, best])
    place[has], value[has] = candidates[rows, best][has], values[rows, best][has]
    return place, value


def close_pairs(
    similarity: Similarity, items: Ints, count: int, progress: Progress = quiet
) -> tuple[Ints, Ints, Floats]:
    """Pairs worth comparing: all if they are few, else each with its ``count`` nearest.

    Returns:
        (i, j, similarity): places in ``items``, which are all different; a pair may come in both
        orders.
    """
    n = len(items)
    if n * n <= EXHAUSTIVE:
        i, j = np.nonzero(~np.eye(n, dtype=bool))
        grid = similarity.grid(items, items, progress) if n else np.zeros((0, 0), np.float32)
        return i, j, grid[i, j]
    near = other_nearest(similarity.vectors()[items], count, progress)
    i, k = np.nonzero(near >= 0)
    j = near[i, k]
    return i, j, similarity.pairs(items[i], items[j], progress)
