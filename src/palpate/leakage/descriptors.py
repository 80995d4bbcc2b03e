"""Descriptors of images whose cosines are high for one contact, and for edited copies of an image.

All start from x = log(rgb + 2) of a thumbnail, minus that of its background where one is used, each
channel's mean removed (brightness). Whitening is fitted on train and test together, without labels:
with mean m, eigenvectors V and eigenvalues l of x,

    z = (x - m) V (l + r mean l)^(-1/2),

all directions kept. The mean and the damped leading directions are a model of the passive gel, and
of what all photos share. The ridge r grows as 1 / n below 8,000 images, else images of one contact
would be taken for background where they are few.

0. *Slopes*. z V^T is a whitened image; its slopes in 8 directions, negative ones cut off, are
   summed over 4 x 4 overlapping cells, the square root is taken, and the result whitened again.
   Where exactly a print lies within a cell does not matter: presses that slip stay similar.
1. *Cells*. x averaged to 8 x 8 and to 16 x 16 cells of the middle 94 %, whitened. Of 16
   candidates the best is chosen with the query moved by 3 % over its background, in 9 ways.
2. *Edited cells*. Queries in 8 turns and mirrors, each with red and blue swapped; train also as if
   cropped and slightly turned, each with a mean of its own. Candidates are found by keys that no
   turn, mirror or swap changes, the mean over all of them of max(0, u A) with random A. An edit
   is tried only where the whitened length of the query, over the least of all edits, is
   plausible: the light shows which edit was made.

Measured in docs/studies/near_duplicates.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.core import rng_for
from palpate.leakage.neighbors import Apart, Floats, Ints, nearest
from palpate.leakage.thumbnails import SIDE

OFFSET, MARGIN = 2.0, 0.03
#: Cells a side, and the ridge of their whitening for many images.
GRIDS = {8: 0.01, 16: 0.03}
#: Ridges of the whitened image and of its slopes, cells a side and directions of the slopes.
IMAGE_RIDGE, SLOPE_RIDGE, SLOPE_CELLS, DIRECTIONS = 0.4, 0.05, 4, 8
#: Images from which ridges stay as they are, and the most that they grow below.
MANY, MOST = 8000, 10
#: Share of the side that a copy may show, and degrees that it may be turned.
GEOMETRIES = ((1.0, 0.0), (0.9, 0.0), (1.0, 3.0), (1.0, -3.0))
#: Shares of the side by which a copy may be moved.
MOVES = [(y, x) for y in (0.0, -0.03, 0.03) for x in (0.0, -0.03, 0.03)]
#: Whitened length, over the least of all edits, up to which an edit is plausible.
PLAUSIBLE = 1.3
#: Shares of the rate of false positives: slopes, cells, edits, which are rarer than contacts.
SHARES = (0.4, 0.4, 0.2)
#: Length of a key, and how many candidates it finds.
KEY, CANDIDATES = 128, 16
#: Train images up to which all columns of vectors are searched; above, so many columns.
FEW, COLUMNS = 4000, 96
#: Images that are fitted on, and images at a time.
FITTED, BLOCK = 10_000, 512
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_LOG = np.log(np.arange(256, dtype=np.float32) + OFFSET)


class Index(Protocol):
    """Train images that are searched in one way."""

    def closest(
        self, rows: Ints, count: int = 1, apart: Apart | None = None
    ) -> tuple[Ints, Floats]:
        """(n, count) the most similar train images and cosines, best first; -1, NaN for none."""
        ...


class Descriptors(Protocol):
    """Ways in which a pool of images is compared, by row.

    Attributes:
        shares: of the rate of false positives, for each question.
        ways: the question that each answers, and what makes an index of train images.
    """

    shares: Sequence[float]
    ways: Sequence[tuple[int, Callable[[Ints], Index]]]


class VectorIndex:
    """Vectors that are compared as they are.

    Args:
        describe: from rows to (n, d) unit vectors.
        rows: the train images.
    """

    def __init__(self, describe: Callable[[Ints], NDArray[Any]], rows: Ints) -> None:
        self._describe, self._vectors = describe, describe(rows)
        columns = np.arange(self._vectors.shape[1])
        if len(rows) > FEW:
            spread = self._vectors[:FEW].astype(np.float32).var(axis=0)
            columns = np.argsort(-spread)[:COLUMNS]
        self._columns = columns
        self._keys = np.ascontiguousarray(self._vectors[:, columns], np.float32)

    def closest(
        self, rows: Ints, count: int = 1, apart: Apart | None = None
    ) -> tuple[Ints, Floats]:
        """See :class:`Index`."""
        vectors = self._describe(rows).astype(np.float32)
        keys = np.ascontiguousarray(vectors[:, self._columns])
        more = 0 if len(self._keys) <= FEW else CANDIDATES
        near = nearest(keys, self._keys, count + more, apart=apart)
        values = np.empty(near.shape, np.float32)
        for k in range(0, len(rows), BLOCK):
            part = slice(k, k + BLOCK)
            among = self._vectors[near[part]].astype(np.float32)
            values[part] = np.einsum("qd,qkd->qk", vectors[part], among)
        return _best(near, values, count)


class Embeddings:
    """Given vectors, compared as they are."""

    shares = (1.0,)

    def __init__(self, vectors: Floats) -> None:
        vectors = unit(vectors)
        self.ways = [(0, lambda rows: VectorIndex(vectors.__getitem__, rows))]


class Whitener:
    """PCA whitening of (n, d) signals that come in blocks."""

    def __init__(self, blocks: Iterator[Floats], ridge: float) -> None:
        total, squares, count = 0.0, 0.0, 0
        for x in blocks:
            total, squares, count = (
                total + x.sum(0, dtype=np.float64),
                squares + x.T @ x,
                count + len(x),
            )
        self.mean = np.asarray(total / count, np.float32)
        values, directions = np.linalg.eigh(squares / count - np.outer(self.mean, self.mean))
        values = np.maximum(values, 0)
        damped = values + ridge * min(max(1, MANY / count), MOST) * values.mean()
        self.directions = directions.astype(np.float32)
        self.matrix = self.directions * np.maximum(damped, 1e-12).astype(np.float32) ** -0.5

    def __call__(self, x: Floats) -> Floats:
        """(n, d) whitened."""
        return (x - self.mean) @ self.matrix


class Whitened:
    """Thumbnails of a pool.

    Args:
        pixels: (u, side, side, 3) thumbnails.
        images: (n,) rows in ``pixels``.
        backgrounds: (n,) rows of their backgrounds, or None to use none.
        gray: compare luma alone, as copies without color need.
        fit: (f,) the images to fit on, those that show something.
    """

    shares = SHARES

    def __init__(
        self,
        pixels: NDArray[np.uint8],
        images: Ints,
        backgrounds: Ints | None,
        *,
        gray: bool,
        fit: Ints,
    ) -> None:
        self._pixels, self._images, self._backgrounds, self._gray = (
            pixels,
            images,
            backgrounds,
            gray,
        )
        fit = fit[np.linspace(0, len(fit) - 1, min(len(fit), FITTED)).astype(np.int64)]
        self._samplers = [[_sampler(s, *g) for s in GRIDS] for g in GEOMETRIES]
        blocks = lambda: map(self._logs, _blocks(fit))  # noqa: E731
        self._images_whitened: list[Whitener] = []
        for c in range(1 if gray else 3):
            whiten = Whitener((x[:, c] for x in blocks()), IMAGE_RIDGE)
            whiten.matrix = whiten.matrix @ whiten.directions.T
            self._images_whitened.append(whiten)
        self._slopes_whitened = Whitener(map(self._raw_slopes, blocks()), SLOPE_RIDGE)
        self._cells = [
            Whitener((_cells(x, self._samplers[0][g]) for x in blocks()), ridge)
            for g, ridge in enumerate(GRIDS.values())
        ]
        self._means = [
            [
                sum(_cells(x, s).sum(axis=0) for x in blocks()) / np.float32(len(fit)) @ w.matrix
                for s, w in zip(samplers, self._cells, strict=True)
            ]
            for samplers in self._samplers
        ]
        self._moved = [[_sampler(s, *GEOMETRIES[0], move) for s in GRIDS] for move in MOVES]
        self._edits = _edits(8 if gray else 16, 1 if gray else 3)
        self.ways = [
            (0, lambda rows: VectorIndex(self.slopes, rows)),
            (1, lambda rows: CellIndex(self, 0, rows, edited=False)),
            *((2, lambda rows, g=g: CellIndex(self, g, rows)) for g in range(len(GEOMETRIES))),
        ]

    def slopes(self, rows: Ints) -> NDArray[np.float16]:
        """(n, d) unit vectors of slopes."""
        parts = [
            unit(self._slopes_whitened(self._raw_slopes(self._logs(block)))).astype(np.float16)
            for block in _blocks(rows)
        ]
        return np.concatenate(parts)

    def cells(self, rows: Ints, geometry: int) -> list[Floats]:
        """Cells of each grid, (n, cells^2 x channels), before whitening."""
        parts = [
            [_cells(logs, s) for s in self._samplers[geometry]]
            for logs in map(self._logs, _blocks(rows))
        ]
        return [np.concatenate(x) for x in zip(*parts, strict=True)]

    def moved(self, rows: Ints) -> list[list[Floats]]:
        """Cells of images that are moved over their backgrounds, as they are first."""
        logs = self._log(self._images[rows])
        moved = [[_cells(logs, s) for s in samplers] for samplers in self._moved]
        if self._backgrounds is not None:
            logs = self._log(self._backgrounds[rows])
            behind = [_cells(logs, s) for s in self._samplers[0]]
            moved = [[x - y for x, y in zip(c, behind, strict=True)] for c in moved]
        return moved

    def edited(self, cells: Sequence[Floats]) -> list[list[Floats]]:
        """Cells as if edited in every way, as they are first."""
        ways = zip(*self._edits, strict=True)
        return [[x[:, at] for x, at in zip(cells, columns, strict=False)] for columns in ways]

    def vectors(self, cells: Sequence[Floats], geometry: int) -> Floats:
        """(n, d) unit vectors of cells, in which both grids weigh the same; coarse ones first."""
        parts = [self.white(x, geometry, grid) for grid, x in enumerate(cells)]
        return np.hstack(parts) / np.float32(np.sqrt(len(parts)))

    def white(self, cells: Floats, geometry: int, grid: int = 0) -> Floats:
        """(n, d) unit vectors of one grid."""
        return unit(cells @ self._cells[grid].matrix - self._means[geometry][grid])

    def plausible(self, variants: Sequence[Sequence[Floats]], geometry: int) -> NDArray[np.bool_]:
        """(n, variants) whether an image may have been edited so, by its whitened length."""
        lengths = np.stack(
            [
                [
                    np.linalg.norm(x - means[0], axis=1)
                    for x in (cells[0] @ self._cells[0].matrix for cells in variants)
                ]
                for means in self._means
            ]
        )  # (geometries, variants, n)
        return (lengths[geometry] <= PLAUSIBLE * lengths.min(axis=(0, 1))).T

    def _logs(self, rows: Ints) -> Floats:
        """(n, channels, side^2): log thumbnails, over the background where it is used."""
        logs = self._log(self._images[rows])
        if self._backgrounds is not None:
            logs -= self._log(self._backgrounds[rows])
        return logs - logs.mean(axis=2, keepdims=True)

    def _log(self, rows: Ints) -> Floats:
        pixels = self._pixels[rows].reshape(len(rows), SIDE * SIDE, 3).transpose(0, 2, 1)
        if self._gray:
            return np.log(np.tensordot(pixels, LUMA, (1, 0)) + np.float32(OFFSET))[:, None]
        return _LOG[pixels]

    def _raw_slopes(self, logs: Floats) -> Floats:
        """(n, channels x directions x cells^2)."""
        white = [w(logs[:, c]) for c, w in enumerate(self._images_whitened)]
        image = np.stack(white, axis=1).reshape(len(logs), -1, SIDE, SIDE)
        down, right = np.gradient(image, axis=(2, 3))
        pooled: list[Floats] = []
        for angle in 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
            slope = np.float32(np.cos(angle)) * right + np.float32(np.sin(angle)) * down
            pooled.append(_POOL @ np.maximum(slope, 0) @ _POOL.T)
        return np.sqrt(unit(np.stack(pooled, axis=1).reshape(len(logs), -1)))


class CellIndex:
    """Cells of train images; queries are edited, or moved, in the way that fits best.

    Args:
        pool: all images.
        geometry: crop and turn of the train images.
        rows: the train images.
        edited: turn, mirror and swap queries; else move them.
    """

    def __init__(self, pool: Whitened, geometry: int, rows: Ints, *, edited: bool = True) -> None:
        self._pool, self._geometry, self._edited = pool, geometry, edited
        self._vectors = np.concatenate(
            [
                pool.vectors(pool.cells(block, geometry), geometry).astype(np.float16)
                for block in _blocks(rows)
            ]
        )
        self._coarse = pool.cells(rows[:1], geometry)[0].shape[1]
        self._random = rng_for(0, "near-duplicates", "key").standard_normal(
            (self._coarse, KEY), dtype=np.float32
        )
        keys = self._keys(rows, geometry)
        self._center = keys.mean(axis=0)
        self._base = unit(keys - self._center)

    def closest(
        self, rows: Ints, count: int = 1, apart: Apart | None = None
    ) -> tuple[Ints, Floats]:
        """See :class:`Index`."""
        keys = unit(self._keys(rows, 0) - self._center)
        near = nearest(keys, self._base, count + CANDIDATES, apart=apart)
        values = np.empty(near.shape, np.float32)
        for start in range(0, len(rows), BLOCK):
            part = slice(start, start + BLOCK)
            variants = self._variants(rows[part])
            among = self._vectors[near[part]].astype(np.float32)
            coarse = np.stack([self._pool.white(c[0], self._geometry) for c in variants], axis=1)
            alike = coarse @ among[:, :, : self._coarse].transpose(0, 2, 1)
            if self._edited:
                alike[~self._pool.plausible(variants, self._geometry)] = -np.inf
                if self._geometry == 0:
                    alike[:, 0] = -np.inf  # as it is: another question
            best, every = alike.max(axis=2).argmax(axis=1), np.arange(len(alike))
            chosen = [np.stack(grid)[best, every] for grid in zip(*variants, strict=True)]
            vectors = self._pool.vectors(chosen, self._geometry)
            values[part] = np.einsum("qd,qkd->qk", vectors, among)
            near[part][alike[every, best].max(axis=1) == -np.inf] = -1
        return _best(near, values, count)

    def _variants(self, rows: Ints) -> list[list[Floats]]:
        if self._edited:
            return self._pool.edited(self._pool.cells(rows, 0))
        return self._pool.moved(rows)

    def _keys(self, rows: Ints, geometry: int) -> Floats:
        """(n, d) to search by: coarse vectors, or what is the same for every edit of an image."""
        parts: list[Floats] = []
        for block in _blocks(rows):
            cells = self._pool.cells(block, geometry)[:1]
            if self._edited:
                edits = [self._pool.white(c[0], self._geometry) for c in self._pool.edited(cells)]
                total = sum(np.maximum(x @ self._random, 0) for x in edits)
                parts.append(total / np.float32(len(edits)))
            else:
                parts.append(self._pool.white(cells[0], geometry))
        return np.concatenate(parts)


def unit(x: Floats) -> Floats:
    """Rows of length 1 (or 0)."""
    return (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)).astype(np.float32)


def _best(near: Ints, values: Floats, count: int) -> tuple[Ints, Floats]:
    """The best of some candidates."""
    values = np.where(near >= 0, values, -np.inf)
    order = np.argsort(-values, axis=1, kind="stable")[:, :count]
    near, values = (np.take_along_axis(x, order, axis=1) for x in (near, values))
    return near, np.where(near >= 0, values, np.nan)


def _blocks(rows: Ints) -> Iterator[Ints]:
    for start in range(0, len(rows), BLOCK):
        yield rows[start : start + BLOCK]


def _cells(logs: Floats, sampler: Any) -> Floats:
    """(n, cells x channels), each channel's mean removed."""
    count, channels, pixels = logs.shape
    x = (sampler @ logs.reshape(-1, pixels).T).reshape(-1, count, channels)
    return (x - x.mean(axis=0)).transpose(1, 0, 2).reshape(count, -1)


def _edits(count: int, channels: int) -> list[list[Ints]]:
    """For each grid the columns of every edit: quarters (k % 4), mirrored (& 4), BGR (& 8)."""
    out: list[list[Ints]] = []
    for side in GRIDS:
        columns = np.arange(side * side * channels).reshape(side, side, channels)
        turned = [np.rot90(columns, k % 4) for k in range(count)]
        turned = [x[:, ::-1] if k & 4 else x for k, x in enumerate(turned)]
        out.append([(x[..., ::-1] if k & 8 else x).ravel() for k, x in enumerate(turned)])
    return out


def _sampler(
    cells: int, share: float, degrees: float, move: tuple[float, float] = (0.0, 0.0)
) -> Any:
    """(cells^2, side^2) sparse: the middle of a thumbnail, cropped to a share, turned and moved."""
    finer = SIDE // cells
    at = ((np.arange(cells * finer) + 0.5) / (cells * finer) - 0.5) * (1 - 2 * MARGIN) * share
    y, x = np.meshgrid(at, at, indexing="ij")
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    right, down = (
        np.clip((p + 0.5 + by) * SIDE - 0.5, 0, SIDE - 1)
        for p, by in ((cos * x - sin * y, move[1]), (sin * x + cos * y, move[0]))
    )
    j, i = np.minimum(right.astype(int), SIDE - 2), np.minimum(down.astype(int), SIDE - 2)
    fx, fy = right - j, down - i
    cell = np.arange(cells * finer) // finer
    cell = (cell[:, None] * cells + cell).ravel()
    corners = [
        (dy, dx, (fy if dy else 1 - fy) * (fx if dx else 1 - fx)) for dy in (0, 1) for dx in (0, 1)
    ]
    columns = np.concatenate([((i + dy) * SIDE + j + dx).ravel() for dy, dx, _ in corners])
    weights = np.concatenate([w.ravel() for _, _, w in corners]) / finer**2
    shape = (cells * cells, SIDE * SIDE)
    return sparse.csr_matrix((weights.astype(np.float32), (np.tile(cell, 4), columns)), shape=shape)


def _pool() -> Floats:
    """(cells, side): triangles that overlap by half."""
    place = (np.arange(SIDE) + 0.5) * SLOPE_CELLS / SIDE - 0.5
    away = np.abs(place - np.arange(SLOPE_CELLS)[:, None])
    return np.maximum(0, 1 - away).astype(np.float32)


_POOL = _pool()
