"""Features that the impact of a leak is measured on, and their reduction by a PCA of train.

Pixels: the center square as 32 x 32 RGB, row by row. Given features are used as they are if
their rows have length 1 (Euclidean order is then the order by cosine); otherwise their columns are
standardized by the train part.

Reduction: with m the mean of at most ``FIT_ROWS`` train rows X and V the leading right singular
vectors of X - m, a row x becomes (x - m) V. V comes from a subspace iteration with a seeded start
(Halko, Martinsson, Tropp 2011, algorithm 4.4), exact where all columns are kept. Nothing is
whitened.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, Progress, quiet, require, rng_for
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest

#: Side of the squares of pixels.
SIZE = 32
#: Train rows that the PCA is fitted to; more change 128 components by less than the choice of the
#: split.
FIT_ROWS = 10_000
#: Rows in memory at a time as floats.
BLOCK = 4096
#: Power iterations and extra directions of the subspace iteration.
POWERS, EXTRA = 4, 16
#: How far from 1 the lengths of normalized rows may be (float16 embeddings are off by 1e-3).
UNIT = 5e-3

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Source:
    """One kind of features of n samples.

    Attributes:
        name: e.g. ``tactile pixels``.
        width: columns.
        read: rows by number -> (rows, width) float32.
        standardize: divide columns by their spread in the train part.
        digest: SHA-256 of the values of all rows, or of the encoder that made them.
    """

    name: str
    width: int
    read: Callable[[Rows], NDArray[np.float32]]
    standardize: bool
    digest: str


@dataclass(frozen=True)
class Reduction:
    """``((x - mean) / spread) @ axes``."""

    mean: NDArray[np.float32]
    spread: NDArray[np.float32]
    axes: NDArray[np.float32]

    def apply(self, source: Source, rows: Rows) -> NDArray[np.float32]:
        """The reduced features of some rows, (rows, components)."""
        blocks = [rows[start : start + BLOCK] for start in range(0, len(rows), BLOCK)]
        reduced = [((source.read(b) - self.mean) / self.spread) @ self.axes for b in blocks]
        return np.vstack(reduced).astype(np.float32, copy=False)


def pixel_sources(
    manifest: Manifest, *, cache: Path | None = None, progress: Progress = quiet
) -> list[Source]:
    """The kinds of pixels that a manifest has.

    Raises:
        PalpateError: if there are neither vision nor tactile images, or only some samples have one.
        ProblemsError: naming every missing or unreadable file.
    """
    nulls = {
        name: manifest.table[name].null_count() for name in ("tactile", "vision", "background")
    }
    present = [name for name in ("tactile", "vision") if nulls[name] < len(manifest)]
    fix = "Import the data set with its images (palpate import), and take the import"
    must = "Pixels as features need vision or tactile images"
    require(len(present) > 0, None, must, "names alone", fix=fix)
    sources: list[Source] = []
    for name in present:
        images = cached_images(manifest, name, SIZE, cache, progress)
        sources.append(_pixels(f"{name} pixels", images))
        if name == "tactile" and not nulls["background"]:
            background = cached_images(manifest, "background", SIZE, cache, progress)
            sources.append(_pixels("tactile minus background", images, background))
    return sources


def given_sources(features: Mapping[str, FeatureSet], ids: Sequence[str]) -> list[Source]:
    """The features of the samples ``ids``, by name.

    Raises:
        PalpateError: if some have none.
    """
    return [_given(name, rows.take(ids)) for name, rows in features.items()]


def _given(name: str, rows: FeatureSet) -> Source:
    x = rows.features.astype(np.float32, copy=False)
    unit = bool((np.abs(np.linalg.norm(x, axis=1) - 1) < UNIT).all())
    return Source(name, x.shape[1], lambda at: x[at], not unit, rows.encoder or _digest(x))


def _pixels(name: str, images: NDArray[np.uint8], *less: NDArray[np.uint8]) -> Source:
    """Images as rows, minus other images where given; all (n, size, size, 3)."""

    def read(at: Rows) -> NDArray[np.float32]:
        x = images[at].astype(np.float32)
        for other in less:
            x -= other[at]
        return x.reshape(len(at), -1)

    return Source(name, int(np.prod(images.shape[1:])), read, False, _digest(images, *less))


def _digest(*arrays: NDArray[Any]) -> str:
    state = hashlib.sha256()
    for array in arrays:
        state.update(repr((array.dtype.str, array.shape)).encode())
        for start in range(0, len(array), BLOCK):
            state.update(np.ascontiguousarray(array[start : start + BLOCK]).data)
    return state.hexdigest()


def fit_reduction(source: Source, train: Rows, components: int, seed: int) -> Reduction:
    """The PCA at the head of this file, of the rows ``train``, whose order says nothing.

    Features of no more columns than ``components`` are only centered (and standardized).
    """
    used = train if len(train) <= FIT_ROWS else train[np.arange(FIT_ROWS) * len(train) // FIT_ROWS]
    x = source.read(used)
    mean = x.mean(axis=0, dtype=np.float64).astype(np.float32)
    x = x - mean
    spread = x.std(axis=0) if source.standardize else np.ones(source.width, np.float32)
    # Columns that do not vary in train have no scale, and add the same to all distances.
    flat = np.ptp(x, axis=0) <= 1e-6 * np.maximum(np.abs(mean), 1e-30)
    spread = np.where(flat, 1, spread).astype(np.float32)
    x /= spread
    if source.width <= components:
        return Reduction(mean, spread, np.eye(source.width, dtype=np.float32)[:, ~flat])
    width = min(components + EXTRA, *x.shape)
    start = rng_for(seed, "impact pca", source.name).standard_normal((source.width, width))
    basis = start.astype(np.float32)
    for _ in range(POWERS):
        basis = np.linalg.qr(x.T @ (x @ basis))[0]
    values, turn = np.linalg.eigh(((y := x @ basis).T @ y).astype(np.float64))
    values, turn = values[::-1][:components], turn[:, ::-1][:, :components]
    kept = values > 1e-7 * max(values[0], 1e-30)
    return Reduction(mean, spread, basis @ turn[:, kept].astype(np.float32))
