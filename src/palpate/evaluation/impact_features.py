"""Raw features of samples, in blocks, and their reduction by a PCA that only the train side has seen.

Three kinds of pixels: ``touch pixels``, ``touch minus background`` (the gel's own look removed) and ``vision pixels``, each the center square
as ``size x size`` RGB, row by row. Features that are handed in instead (a encoder's embeddings, or any array) are taken as they are if their
rows have length 1, so that Euclidean order is the order by cosine; otherwise their columns are standardized by the train side.

Reduction: with m the mean of at most ``FIT_ROWS`` train rows X and V the leading right singular vectors of X - m, a row x becomes
(x - m) V. V is found by subspace iteration from a seeded start (Halko, Martinsson, Tropp 2011, algorithm 4.4), exact where all columns
are kept. Nothing is whitened: distances stay those of the features.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError, Progress, quiet, rng_for
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest

#: Train rows that the PCA is fitted to; more change 128 components by less than the choice of the split does.
FIT_ROWS = 10_000
#: Rows in memory at a time as floats.
BLOCK = 4096
#: Power iterations and spare directions of the subspace iteration.
POWERS, SPARE = 4, 16
#: How far from 1 the lengths of rows may be that count as normalized (float16 embeddings are off by 1e-3).
UNIT = 5e-3

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Source:
    """One kind of features of n samples.

    Attributes:
        name: e.g. ``touch pixels``.
        width: columns.
        read: rows by number -> (rows, width) float32.
        standardize: divide columns by their spread on the train side.
        digest: SHA-256 of the values of all rows in order, or of the encoder that made them.
    """

    name: str
    width: int
    read: Callable[[Rows], NDArray[np.float32]]
    standardize: bool
    digest: str


@dataclass(frozen=True)
class Reduction:
    """An affine map fitted to the train side: ``((x - mean) / spread) @ axes``; ``explained`` is the share of variance kept."""

    mean: NDArray[np.float32]
    spread: NDArray[np.float32]
    axes: NDArray[np.float32]
    explained: float

    def apply(self, source: Source, rows: Rows) -> NDArray[np.float32]:
        """The reduced features of some rows, (rows, components)."""
        out = np.empty((len(rows), self.axes.shape[1]), np.float32)
        for start in range(0, len(rows), BLOCK):
            out[start : start + BLOCK] = (
                (source.read(rows[start : start + BLOCK]) - self.mean) / self.spread
            ) @ self.axes
        return out


def pixel_sources(
    manifest: Manifest, *, size: int = 32, cache: Path | None = None, progress: Progress = quiet
) -> tuple[list[Source], list[str]]:
    """The kinds of pixels that the manifest has, and a sentence for each that it lacks.

    Args:
        manifest: the samples, in the order of the rows.
        size: side of the squares in pixels.
        cache: see :func:`palpate.data.images.cached_images`.
        progress: told how many files are decoded.

    Raises:
        PalpateError: if there are neither vision nor tactile images, or only some samples have one.
        ProblemsError: naming every missing or unreadable file.
    """
    if size < 4:
        raise PalpateError("Pixels must be at least 4 x 4", f"size {size}", "Pass e.g. size=32")
    nulls = {
        name: manifest.table[name].null_count() for name in ("tactile", "vision", "background")
    }
    sources: list[Source] = []
    notes: list[str] = []
    if nulls["tactile"] < len(manifest):
        touch = cached_images(manifest, "tactile", size, cache, progress)
        sources.append(_pixels("touch pixels", touch))
        if not nulls["background"]:
            sources.append(
                _pixels(
                    "touch minus background",
                    touch,
                    cached_images(manifest, "background", size, cache, progress),
                )
            )
        else:
            notes.append(
                f"{nulls['background']} of {len(manifest)} samples have no background: touch is looked at as it is only."
            )
    if nulls["vision"] < len(manifest):
        sources.append(
            _pixels("vision pixels", cached_images(manifest, "vision", size, cache, progress))
        )
    notes += [
        f"No sample has a {name} image: no features of it."
        for name in ("tactile", "vision")
        if nulls[name] == len(manifest)
    ]
    if not sources:
        raise PalpateError(
            "Pixels as features need vision or tactile images",
            "a manifest without either",
            "Fill the columns vision and tactile, or pass features={name: array}",
        )
    return sources, notes


def array_sources(
    features: Mapping[str, FeatureSet | NDArray[np.floating]],
    manifest: Manifest,
    ids: Sequence[str],
    rows: Rows,
) -> list[Source]:
    """Features that were handed in.

    Args:
        features: name -> features of at least the samples used, or an (n, d) array in the order of the manifest.
        manifest: all samples.
        ids: those that are used; they become rows 0, 1, ... of the sources.
        rows: their numbers in the manifest.

    Raises:
        PalpateError: for no features at all, a wrong number of rows, missing ids, or values that are not finite numbers.
    """
    if not features:
        raise PalpateError(
            "There must be features to classify by",
            "an empty mapping",
            "Pass features='pixels' or features={name: array}",
        )
    return [_given(name, value, len(manifest), rows, ids) for name, value in features.items()]


def _given(
    name: str, value: FeatureSet | NDArray[np.floating], total: int, rows: Rows, ids: Sequence[str]
) -> Source:
    encoder = None
    if isinstance(value, FeatureSet):
        x, encoder = value.take(ids).features, value.encoder
    else:
        x = np.asarray(value)
        if x.ndim != 2 or len(x) != total:
            raise PalpateError(
                f"The features {name!r} must have shape ({total}, d), one row a sample of the manifest",
                f"shape {x.shape}",
                "Pass them in the order of manifest.ids, or as a FeatureSet with ids",
            )
        x = x[rows]
    if x.dtype.kind not in "fiub" or not x.shape[1]:
        raise PalpateError(
            f"The features {name!r} must be numbers in at least one column",
            f"{x.dtype}, shape {x.shape}",
            "Pass floats",
        )
    x = FeatureSet(ids, x.astype(np.float32, copy=False)).features  # refuses what is not finite
    unit = bool((np.abs(np.linalg.norm(x, axis=1) - 1) < UNIT).all())
    return Source(name, x.shape[1], lambda at: x[at], not unit, encoder or _digest(x))


def _pixels(name: str, images: NDArray[np.uint8], less: NDArray[np.uint8] | None = None) -> Source:
    """Images as rows, less other images where given; both (n, size, size, 3)."""

    def read(at: Rows) -> NDArray[np.float32]:
        x = images[at].astype(np.float32)
        return (x if less is None else x - less[at]).reshape(len(at), -1)

    return Source(
        name,
        int(np.prod(images.shape[1:])),
        read,
        False,
        _digest(images, *([] if less is None else [less])),
    )


def _digest(*arrays: np.ndarray) -> str:
    state = hashlib.sha256()
    for array in arrays:
        state.update(repr((array.dtype.str, array.shape)).encode())
        for start in range(0, len(array), BLOCK):
            state.update(np.ascontiguousarray(array[start : start + BLOCK]).data)
    return state.hexdigest()


def fit_reduction(source: Source, train: Rows, components: int, seed: int) -> Reduction:
    """The PCA at the head of this file, fitted to train rows alone.

    Args:
        source: the features.
        train: rows of the train side, in any order that does not follow the content; of many, evenly spaced ones are used.
        components: columns to keep; with no more columns than that, they are only centered (and standardized).
        seed: of the start.
    """
    used = train if len(train) <= FIT_ROWS else train[np.arange(FIT_ROWS) * len(train) // FIT_ROWS]
    x = source.read(used)
    mean = x.mean(axis=0, dtype=np.float64).astype(np.float32)
    x = x - mean
    spread = x.std(axis=0) if source.standardize else np.ones(source.width, np.float32)
    # Directions without spread in train add the same to all distances and have no scale: they are left out, which changes no neighbor.
    flat = np.ptp(x, axis=0) <= 1e-6 * np.maximum(np.abs(mean), 1e-30)
    spread = np.where(flat, 1, spread).astype(np.float32)
    x /= spread
    if source.width <= components:
        return Reduction(mean, spread, np.eye(source.width, dtype=np.float32)[:, ~flat], 1.0)
    width = min(components + SPARE, *x.shape)
    basis = (
        rng_for(seed, "impact pca", source.name)
        .standard_normal((source.width, width))
        .astype(np.float32)
    )
    for _ in range(POWERS):
        basis = np.linalg.qr(x.T @ (x @ basis))[0]
    values, turn = np.linalg.eigh(((y := x @ basis).T @ y).astype(np.float64))
    values, turn = values[::-1][:components], turn[:, ::-1][:, :components]
    kept = values > 1e-7 * max(values[0], 1e-30)
    total = float(np.einsum("ij,ij->", x, x, dtype=np.float64))
    return Reduction(
        mean,
        spread,
        basis @ turn[:, kept].astype(np.float32),
        float(values[kept].sum()) / total if total else 1.0,
    )
