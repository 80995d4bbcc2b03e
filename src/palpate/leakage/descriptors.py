"""Descriptors of images whose cosines are high for one contact, and for edited copies of an image.

All start from x = log(rgb + 2) of a thumbnail, minus that of its background where one is used, each
channel's mean removed (brightness). Whitening is fitted on train and test together, without labels:
with mean m, eigenvectors V and eigenvalues l of x,

    z = (x - m) V (l + r mean l)^(-1/2),

all directions kept. The mean and the damped leading directions are a model of the passive gel, and
of what all photos share. The ridge r grows as 1 / n below 8,000 images, else images of one contact
would be taken for background where they are few.

*As it is*: slopes. z V^T is a whitened image; its slopes in 8 directions, negative ones cut off,
are summed over 4 x 4 overlapping cells, the square root is taken, and the result whitened again.
Where exactly a print lies within a cell does not matter, so presses that slip stay similar.

*Moved or edited*: cells. x averaged to 8 x 8 and to 16 x 16 cells of the middle 94 %, whitened.
Queries are compared in 8 turns and mirrors, each with red and blue swapped, and moved by 3 % over
their background; train also as if cropped and slightly turned, each with a mean of its own. An edit
is admitted only where the whitened length of the query is plausible: the light shows which edit was
made.

Measured in docs/studies/near_duplicates.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.leakage.neighbors import Floats, Ints
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
#: Whitened length, over the least of all edits, up to which an edit or a move is plausible.
PLAUSIBLE, MOVED = 1.3, 2.0
#: Images that are fitted on, and images at a time.
FITTED, BLOCK = 20_000, 512
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_LOG = np.log(np.arange(256, dtype=np.float32) + OFFSET)

#: Plausible edits of the queries under one base: (question they answer, queries, unit vectors).
Edits = Iterator[tuple[int, Ints, Floats]]


class Descriptors(Protocol):
    """Vectors of a pool of images, by row.

    Attributes:
        bases: ways in which train is described.
        questions: kinds of answers, each with a threshold of its own.
    """

    bases: int
    questions: int

    def train(self, rows: Ints, base: int) -> NDArray[Any]:
        """(n, d) unit vectors; leading columns of cells are coarser."""
        ...

    def test(self, rows: Ints) -> Callable[[int], Edits]:
        """From the number of a base to the edits of the queries that are plausible there."""
        ...


class Embeddings:
    """Given vectors, compared as they are."""

    bases = questions = 1

    def __init__(self, vectors: Floats) -> None:
        self._vectors = unit(vectors)

    def train(self, rows: Ints, base: int) -> NDArray[Any]:
        """The unit vectors."""
        return self._vectors[rows]

    def test(self, rows: Ints) -> Callable[[int], Edits]:
        """The unit vectors."""
        return lambda _: iter([(0, np.arange(len(rows)), self._vectors[rows])])


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
        self.directions = directions
        self.matrix = directions * np.maximum(damped, 1e-12) ** -0.5

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

    #: Slopes as they are, cells as they are or moved, cells as if edited.
    bases, questions = 1 + len(GEOMETRIES), 3

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
        channels = range(1 if gray else 3)
        blocks = lambda: map(self._logs, _blocks(fit))  # noqa: E731
        self._images_whitened = []
        for c in channels:
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

    def train(self, rows: Ints, base: int) -> NDArray[np.float16]:
        """See :class:`Descriptors`."""
        parts = [self._described(self._logs(block), base) for block in _blocks(rows)]
        return np.concatenate(parts)

    def test(self, rows: Ints) -> Callable[[int], Edits]:
        """See :class:`Descriptors`."""
        cells = [self._moved_cells(rows, move) for move in MOVES]
        variants = [(0, v) for v in range(8 if self._gray else 16)]
        variants += [(move, 0) for move in range(1, len(MOVES))]

        def projected(variant: tuple[int, int], at: Any) -> list[Floats]:
            return self._project(_edited([c[at] for c in cells[variant[0]]], variant[1]))

        lengths = np.stack(
            [
                [self._unit(z, k)[1] for k in range(len(GEOMETRIES))]
                for z in (projected(variant, slice(None)) for variant in variants)
            ],
            axis=1,
        )  # (geometries, variants, n)
        admitted = lengths <= PLAUSIBLE * lengths.min(axis=(0, 1))
        moves = [k for k, variant in enumerate(variants) if variant[1] == 0]
        admitted[0, moves] = lengths[0, moves] <= MOVED * lengths.min(axis=(0, 1))
        admitted[0, 0] = True

        def edits(base: int) -> Edits:
            if base == 0:
                slopes = [self._described(self._logs(block), 0) for block in _blocks(rows)]
                yield 0, np.arange(len(rows)), np.concatenate(slopes).astype(np.float32)
                return
            for v, variant in enumerate(variants):
                at = np.flatnonzero(admitted[base - 1, v])
                if len(at):
                    question = 1 if base == 1 and variant[1] == 0 else 2
                    yield question, at, self._unit(projected(variant, at), base - 1)[0]

        return edits

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

    def _moved_cells(self, rows: Ints, move: tuple[float, float]) -> list[Floats]:
        """Cells of images moved over their backgrounds."""
        out: list[list[Floats]] = []
        for block in _blocks(rows):
            cells = [
                _cells(self._log(self._images[block]), _sampler(s, *GEOMETRIES[0], move))
                for s in GRIDS
            ]
            if self._backgrounds is not None:
                behind = self._log(self._backgrounds[block])
                cells = [
                    x - _cells(behind, s) for x, s in zip(cells, self._samplers[0], strict=True)
                ]
            out.append(cells)
        return [np.concatenate(x) for x in zip(*out, strict=True)]

    def _described(self, logs: Floats, base: int) -> NDArray[np.float16]:
        if base == 0:
            return unit(self._slopes_whitened(self._raw_slopes(logs))).astype(np.float16)
        samplers = self._samplers[base - 1]
        cells = self._project([_cells(logs, s) for s in samplers])
        return self._unit(cells, base - 1)[0].astype(np.float16)

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

    def _project(self, cells: Sequence[Floats]) -> list[Floats]:
        return [x @ w.matrix for x, w in zip(cells, self._cells, strict=True)]

    def _unit(self, projected: Sequence[Floats], geometry: int) -> tuple[Floats, Floats]:
        """Unit vectors, in which all grids weigh the same, and the length on the finest."""
        z = [x - m for x, m in zip(projected, self._means[geometry], strict=True)]
        vectors = np.hstack([unit(x) for x in z]) / np.float32(np.sqrt(len(z)))
        return vectors, np.linalg.norm(z[-1], axis=1)


def unit(x: Floats) -> Floats:
    """Rows of length 1 (or 0)."""
    return (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)).astype(np.float32)


def _blocks(rows: Ints) -> Iterator[Ints]:
    for start in range(0, len(rows), BLOCK):
        yield rows[start : start + BLOCK]


def _cells(logs: Floats, sampler: Any) -> Floats:
    """(n, cells x channels), each channel's mean removed."""
    count, channels, pixels = logs.shape
    x = (sampler @ logs.reshape(-1, pixels).T).reshape(-1, count, channels)
    return (x - x.mean(axis=0)).transpose(1, 0, 2).reshape(count, -1)


def _edited(cells: Sequence[Floats], variant: int) -> list[Floats]:
    """Cells as if turned by quarters (variant % 4), mirrored (& 4), BGR for RGB (& 8)."""
    out: list[Floats] = []
    for side, x in zip(GRIDS, cells, strict=True):
        y = np.rot90(x.reshape(len(x), side, side, -1), variant % 4, (1, 2))
        y = y[:, :, ::-1] if variant & 4 else y
        out.append((y[..., ::-1] if variant & 8 else y).reshape(len(x), -1))
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
