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
2. *Edited cells*, where no background is used. Queries in 8 turns and mirrors, each with red and
   blue swapped; train also as if cropped and slightly turned, each with a mean of its own.
   Candidates are found by keys that no turn, mirror or swap changes, the mean over all of them
   of max(0, u A) with random A. Each crop and turn has a whitening of its own, and the cosine of
   an edit loses 2 (l / l' - 1), where l is the length of the query in it and l' the least of all
   edits: the light and the markers show which edit was made.

Measured in docs/studies/near_duplicates.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.core import rng_for
from palpate.leakage.neighbors import Apart, Floats, Ints, nearest
from palpate.leakage.thumbnails import SIDE

OFFSET, MARGIN = 2.0, 0.03
#: Cells a side, and the ridge of their whitening for many images.
GRIDS = {8: 0.01, 16: 0.03}
#: Ridges of the whitened image and of its slopes, cells a side and directions of the slopes.
IMAGE_RIDGE, SLOPE_RIDGE, SLOPE_CELLS, DIRECTIONS = 0.4, 0.05, 4, 8
#: Images from which ridges stay as they are, and the most that they grow below.
MANY, MOST = 8000, 40
#: Share of the side that a copy may show, and degrees that it may be turned.
GEOMETRIES = ((1.0, 0.0), (0.9, 0.0), (1.0, 3.0), (1.0, -3.0))
#: Shares of the side by which a copy may be moved.
MOVES = [(y, x) for y in (0.0, -0.03, 0.03) for x in (0.0, -0.03, 0.03)]
#: What an edit loses in cosine for each 100 % of whitened length above the least of all edits.
IMPLAUSIBLE = 2.0
#: Shares of the rate of false positives: slopes, cells, edits, which are rarer than contacts.
SHARES = (0.4, 0.4, 0.2)
#: Length of a key, and how many candidates it finds.
KEY, CANDIDATES = 128, 16
#: Train images up to which all columns of vectors are searched; above, so many columns.
FEW, COLUMNS = 4000, 96
#: Images that are fitted on, and images at a time.
FITTED, BLOCK = 6_000, 512
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_LOG = np.log(np.arange(256, dtype=np.float32) + OFFSET)


class Index(Protocol):
    """Train images that are searched in one way."""

    def closest(
        self, rows: Ints, count: int = 1, apart: Apart | None = None
    ) -> tuple[Ints, Floats]:
        """(n, count) the most similar train images and cosines, best first; -1, NaN for none."""
        ...


class VectorIndex:
    """Vectors that are compared as they are.

    Args:
        describe: from rows to (n, d) unit vectors.
        rows: the train images.
    """

    def __init__(self, describe: Callable[[Ints], NDArray[Any]], rows: Ints) -> None:
        self._describe, self._vectors = describe, describe(rows)
        self._columns = _leading(self._vectors)
        self._keys = np.ascontiguousarray(self._vectors[:, self._columns], np.float32)

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


class Whitener:
    """PCA whitening of (n, d) signals that are added in blocks."""

    def __init__(self) -> None:
        self._total: Any = 0.0
        self._squares: Any = 0.0
        self._count = 0

    def add(self, x: Floats) -> None:
        """Fit on some more."""
        self._total += x.sum(0, dtype=np.float64)
        self._squares += x.T @ x
        self._count += len(x)

    def fit(self, ridge: float) -> Whitener:
        """Finish, with the ridge of many images."""
        self.mean = np.asarray(self._total / self._count, np.float32)
        covariance = self._squares / self._count - np.outer(self.mean, self.mean)
        values, directions = np.linalg.eigh(covariance)
        values = np.maximum(values, 0)
        damped = values + ridge * min(max(1, MANY / self._count), MOST) * values.mean()
        self.directions = directions.astype(np.float32)
        self.matrix = self.directions * np.maximum(damped, 1e-12).astype(np.float32) ** -0.5
        return self

    def __call__(self, x: Floats) -> Floats:
        """(n, d) whitened."""
        return (x - self.mean) @ self.matrix


class Whitened:
    """Thumbnails of a pool, and the ways in which they are compared, by row.

    Args:
        pixels: (u, side, side, 3) thumbnails.
        images: (n,) rows in ``pixels``.
        backgrounds: (n,) rows of their backgrounds, or None to use none.
        gray: compare luma alone, as copies without color need.
        fit: (f,) the images to fit on, those that show something.

    Attributes:
        ways: the question that each answers, and what makes an index of train images.
        shares: of the rate of false positives, for each question.
    """

    def __init__(
        self,
        pixels: NDArray[np.uint8],
        images: Ints,
        backgrounds: Ints | None,
        *,
        gray: bool,
        fit: Ints,
    ) -> None:
        self._pixels = pixels
        self._images = images
        self._backgrounds = backgrounds
        self._gray = gray
        fit = fit[np.linspace(0, len(fit) - 1, min(len(fit), FITTED)).astype(np.int64)]
        # Over backgrounds the light no longer shows which edit was made: edits are not tried.
        shapes = GEOMETRIES if backgrounds is None else GEOMETRIES[:1]
        self._samplers = [[_sampler(s, *g) for s in GRIDS] for g in shapes]
        self._white = [Whitener() for _ in range(1 if gray else 3)]
        coarse, fine, keys = [Whitener() for _ in shapes], Whitener(), Whitener()
        total = np.zeros((1, len(self._white), SIDE * SIDE))
        for logs in map(self.logs, _blocks(fit)):
            centered = _centered(logs)
            for c, whiten in enumerate(self._white):
                whiten.add(centered[:, c])
            for g, whiten in enumerate(coarse):
                whiten.add(self.cells(logs, g, grids=1)[0])
            signals = self.cells(logs)
            keys.add(self._swapped(signals[0]))
            fine.add(signals[1])
            total += logs.sum(axis=0, dtype=np.float64)
        for whiten in self._white:
            whiten.fit(IMAGE_RIDGE)
            whiten.matrix = whiten.matrix @ whiten.directions.T
        self._slopes = Whitener()
        for logs in map(self.logs, _blocks(fit)):
            self._slopes.add(self._raw_slopes(logs))
        self._slopes.fit(SLOPE_RIDGE)
        #: Whitening of coarse cells for each geometry, by whose lengths an edit is plausible.
        self.edited = [whiten.fit(GRIDS[min(GRIDS)]) for whiten in coarse]
        self.matrices = [self.edited[0].matrix, fine.fit(GRIDS[max(GRIDS)]).matrix]
        mean = np.asarray(total / len(fit), np.float32)
        finely = [self.cells(mean, g)[1] for g in range(len(shapes))]
        #: For each grid (geometries, d) whitened means.
        self.means = [
            np.stack([w.mean for w in self.edited]) @ self.matrices[0],
            np.concatenate(finely) @ self.matrices[1],
        ]
        random = rng_for(0, "near-duplicates", "key")
        self._key = keys.fit(GRIDS[min(GRIDS)]).matrix
        self._key_means = [self._swapped(w.mean[None]) @ self._key for w in self.edited]
        self._random = random.standard_normal((len(self._key), KEY), dtype=np.float32)
        self._moved = [[_sampler(s, *GEOMETRIES[0], move) for s in GRIDS] for move in MOVES]
        self.edits = _edits(8 if gray else 16, 1 if gray else 3)
        self._turns = _edits(8, 1 if gray else 2)[0]
        self.ways: list[tuple[int, Callable[[Ints], Index]]] = [
            (0, lambda rows: VectorIndex(self.slopes, rows)),
            (1, lambda rows: MoveIndex(self, rows)),
            (2, lambda rows: EditIndex(self, rows)),
        ]
        if backgrounds is not None:
            self.ways = self.ways[:2]
        self.shares = SHARES[: len(self.ways)]

    def slopes(self, rows: Ints) -> NDArray[np.float16]:
        """(n, d) unit vectors of slopes."""
        parts = [
            unit(self._slopes(self._raw_slopes(self.logs(block)))).astype(np.float16)
            for block in _blocks(rows)
        ]
        return np.concatenate(parts)

    def cells(self, logs: Floats, geometry: int = 0, grids: int = len(GRIDS)) -> list[Floats]:
        """Cells of the first ``grids`` grids, (n, cells^2 x channels), before whitening."""
        return [_cells(logs, s) for s in self._samplers[geometry][:grids]]

    def moved(self, rows: Ints, moves: Sequence[int], grids: int) -> Iterator[list[Floats]]:
        """For each move the first ``grids`` cells of images that are moved over backgrounds."""
        logs = self._log(self._images[rows])
        behind = [np.float32(0)] * grids
        if self._backgrounds is not None:
            under = self._log(self._backgrounds[rows])
            behind = [_cells(under, s) for s in self._samplers[0][:grids]]
        for move in moves:
            samplers = self._moved[move][:grids]
            yield [_cells(logs, s) - x for s, x in zip(samplers, behind, strict=True)]

    def vectors(self, cells: Sequence[Floats], geometry: int | Ints) -> Floats:
        """(n, d) unit vectors of cells, in which both grids weigh the same; coarse ones first."""
        fitted = zip(cells, self.matrices, self.means, strict=False)  # one grid, or both
        parts = [unit(x @ matrix - means[geometry]) for x, matrix, means in fitted]
        return np.hstack(parts) / np.float32(np.sqrt(len(parts)))

    def keys(self, coarse: Floats, geometries: Sequence[int]) -> list[Floats]:
        """For each geometry (n, KEY) what is the same for every edit of an image."""
        cells = self._swapped(coarse)
        turned = [cells[:, columns] @ self._key for columns in self._turns]
        return [
            np.sum([np.maximum(unit(x - self._key_means[g]) @ self._random, 0) for x in turned], 0)
            for g in geometries
        ]

    def _swapped(self, coarse: Floats) -> Floats:
        """Coarse cells of what stays where red and blue are swapped: green, and red with blue."""
        if self._gray:
            return coarse
        x = coarse.reshape(len(coarse), -1, 3)
        return np.stack([x[..., 1], (x[..., 0] + x[..., 2]) * np.float32(0.5)], axis=-1).reshape(
            len(x), -1
        )

    def logs(self, rows: Ints) -> Floats:
        """(n, channels, side^2): log thumbnails, over the background where it is used."""
        logs = self._log(self._images[rows])
        if self._backgrounds is not None:
            logs -= self._log(self._backgrounds[rows])
        return logs

    def _log(self, rows: Ints) -> Floats:
        pixels = self._pixels[rows].reshape(len(rows), SIDE * SIDE, 3).transpose(0, 2, 1)
        if self._gray:
            return np.log(np.tensordot(pixels, LUMA, (1, 0)) + np.float32(OFFSET))[:, None]
        return _LOG[pixels]

    def _raw_slopes(self, logs: Floats) -> Floats:
        """(n, channels x directions x cells^2)."""
        centered = _centered(logs)
        white = [w(centered[:, c]) for c, w in enumerate(self._white)]
        image = np.stack(white, axis=1).reshape(len(logs), -1, SIDE, SIDE)
        down, right = (x.reshape(-1, SIDE * SIDE) for x in np.gradient(image, axis=(2, 3)))
        total = down @ _POOL, right @ _POOL
        forward: list[Floats] = []
        backward: list[Floats] = []
        for angle in 2 * np.pi * np.arange(DIRECTIONS // 2) / DIRECTIONS:
            y, x = np.float32(np.sin(angle)), np.float32(np.cos(angle))
            forward.append(np.maximum(y * down + x * right, 0) @ _POOL)
            # What is left of the sum is the opposite direction.
            backward.append(np.maximum(forward[-1] - y * total[0] - x * total[1], 0))
        pooled = np.stack(forward + backward, axis=1).reshape(len(logs), -1)
        return np.sqrt(unit(pooled))


class MoveIndex:
    """Cells of train images; queries are moved in the way that fits best."""

    def __init__(self, pool: Whitened, rows: Ints) -> None:
        self._pool = pool
        parts = [
            pool.vectors(pool.cells(pool.logs(block)), 0).astype(np.float16)
            for block in _blocks(rows)
        ]
        self._vectors, coarse = np.concatenate(parts), len(pool.matrices[0])
        self._coarse = unit(self._vectors[:, :coarse].astype(np.float32))
        self._columns = _leading(self._coarse)
        self._keys = np.ascontiguousarray(self._coarse[:, self._columns])

    def closest(
        self, rows: Ints, count: int = 1, apart: Apart | None = None
    ) -> tuple[Ints, Floats]:
        """See :class:`Index`."""
        pool = self._pool
        still = [pool.vectors(pool.cells(pool.logs(block), grids=1), 0) for block in _blocks(rows)]
        keys = np.ascontiguousarray(np.concatenate(still)[:, self._columns])
        near = nearest(keys, self._keys, count + CANDIDATES, apart=apart)
        blocks = _blocks(np.arange(len(rows)))
        return _joined(self._compared(rows[b], near[b], count) for b in blocks)

    def _compared(self, rows: Ints, near: Ints, count: int) -> tuple[Ints, Floats]:
        """Choose moves by the coarse grid, and compare the best candidates in full."""
        pool, every = self._pool, np.arange(len(rows))
        moved = [pool.vectors(c, 0) for c in pool.moved(rows, range(len(MOVES)), 1)]
        cosine = np.stack(moved, axis=1) @ self._coarse[near].transpose(0, 2, 1)
        cosine.transpose(0, 2, 1)[near < 0] = -np.inf
        move, cosine = cosine.argmax(axis=1), cosine.max(axis=1)  # (n, candidates)
        best = np.argsort(-cosine, axis=1, kind="stable")[:, : count + 1]
        row, values = np.take_along_axis(near, best, axis=1), np.zeros(best.shape, np.float32)
        for t, at in enumerate(best.T):
            for m in np.unique(move[every, at]).tolist():
                part = np.flatnonzero(move[every, at] == m)
                (cells,) = pool.moved(rows[part], [m], len(GRIDS))
                among = self._vectors[row[part, t]].astype(np.float32)
                values[part, t] = np.einsum("nd,nd->n", pool.vectors(cells, 0), among)
        return _best(row, values, count)


class EditIndex:
    """Cells of train images, as if cropped or turned; queries are edited in the best way."""

    def __init__(self, pool: Whitened, rows: Ints) -> None:
        self._pool, self._rows = pool, rows
        every = range(len(GEOMETRIES))
        parts: list[list[NDArray[np.float16]]] = [[] for _ in every]
        keys: list[list[Floats]] = [[] for _ in every]
        for block in _blocks(rows):
            logs = pool.logs(block)
            for g in every:
                cells = pool.cells(logs, g, grids=1)
                parts[g].append(pool.vectors(cells, g).astype(np.float16))
                keys[g] += pool.keys(cells[0], [g])
        self._vectors = np.stack([np.concatenate(x) for x in parts])
        self._centers = [np.concatenate(x).mean(axis=0) for x in keys]
        self._keys = [unit(np.concatenate(x) - c) for x, c in zip(keys, self._centers, strict=True)]

    def closest(
        self, rows: Ints, count: int = 1, apart: Apart | None = None
    ) -> tuple[Ints, Floats]:
        """See :class:`Index`."""
        pool, every = self._pool, range(len(GEOMETRIES))
        cells = [pool.cells(pool.logs(block)) for block in _blocks(rows)]
        keys = zip(*(pool.keys(c[0], every) for c in cells), strict=True)
        near = np.stack(
            [
                nearest(unit(np.concatenate(key) - center), base, count + CANDIDATES, apart=apart)
                for key, center, base in zip(keys, self._centers, self._keys, strict=True)
            ],
            axis=1,
        )  # (n, geometries, candidates)
        blocks = zip(_blocks(np.arange(len(rows))), cells, strict=True)
        return _joined(self._compared(signals, near[b], count) for b, signals in blocks)

    def _compared(self, cells: Sequence[Floats], near: Ints, count: int) -> tuple[Ints, Floats]:
        """Choose edits by the coarse grid, and compare the best candidates in full."""
        pool, every = self._pool, np.arange(len(near))
        edited = np.stack([cells[0][:, at] for at in pool.edits[0]], axis=1)
        lengths = np.stack([np.linalg.norm(w(edited), axis=2) for w in pool.edited], axis=1)
        least = np.maximum(lengths.min(axis=(1, 2), keepdims=True), 1e-9)
        penalty = IMPLAUSIBLE * np.maximum(lengths / least - 1, 0)
        penalty[:, 0, 0] = np.inf  # as it is: another question
        # (n, geometries, edits, d)
        centered = (edited @ pool.matrices[0])[:, None] - pool.means[0][:, None]
        centered /= np.maximum(np.linalg.norm(centered, axis=3, keepdims=True), 1e-9)
        among = self._vectors[np.arange(len(GEOMETRIES))[:, None], near].astype(np.float32)
        cosine = centered @ among.transpose(0, 1, 3, 2) - penalty[..., None]
        cosine.transpose(0, 1, 3, 2)[near < 0] = -np.inf
        edit, cosine = cosine.argmax(axis=2), cosine.max(axis=2)  # (n, geometries, candidates)
        best = np.argsort(-cosine.reshape(len(near), -1), axis=1, kind="stable")[:, : count + 2]
        row, values = np.full(best.shape, -1), np.zeros(best.shape, np.float32)
        for t, at in enumerate(best.T):
            g, k = np.divmod(at, near.shape[2])
            row[:, t] = near[every, g, k]
            chosen = [
                np.take_along_axis(x, np.stack(columns)[edit[every, g, k]], axis=1)
                for x, columns in zip(cells, pool.edits, strict=True)
            ]
            queries = pool.vectors(chosen, g)
            for geometry in np.unique(g).tolist():
                part = np.flatnonzero(g == geometry)
                logs = pool.logs(self._rows[row[part, t]])
                among = pool.vectors(pool.cells(logs, geometry), geometry)
                values[part, t] = np.einsum("nd,nd->n", queries[part], among)
            values[:, t] -= penalty[every, g, edit[every, g, k]]
        return _best(row, np.maximum(values, -1), count)


def _leading(vectors: NDArray[Any]) -> Ints:
    """The columns that are searched: all for few images, else those of the largest variance."""
    if len(vectors) <= FEW:
        return np.arange(vectors.shape[1])
    return np.argsort(-vectors[:FEW].astype(np.float32).var(axis=0))[:COLUMNS]


def unit(x: Floats) -> Floats:
    """Rows of length 1 (or 0)."""
    return (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)).astype(np.float32)


def _joined(parts: Iterable[tuple[Ints, Floats]]) -> tuple[Ints, Floats]:
    rows, values = zip(*parts, strict=True)
    return np.concatenate(rows), np.concatenate(values)


def _best(near: Ints, values: Floats, count: int) -> tuple[Ints, Floats]:
    """The best of some candidates."""
    values = np.where(near >= 0, values, -np.inf)
    order = np.argsort(-values, axis=1, kind="stable")[:, :count]
    near = np.take_along_axis(near, order, axis=1)
    values = np.take_along_axis(values, order, axis=1)
    return near, np.where(near >= 0, values, np.nan)


def _blocks(rows: Ints) -> Iterator[Ints]:
    for start in range(0, len(rows), BLOCK):
        yield rows[start : start + BLOCK]


def _centered(logs: Floats) -> Floats:
    """Logs (n, channels, side^2) without each channel's mean."""
    return logs - logs.mean(axis=2, keepdims=True)


def _cells(logs: Floats, sampler: Floats) -> Floats:
    """(n, cells x channels), each channel's mean removed."""
    count, channels, pixels = logs.shape
    x = (logs.reshape(-1, pixels) @ sampler).reshape(count, channels, -1)
    return (x - x.mean(axis=2, keepdims=True)).transpose(0, 2, 1).reshape(count, -1)


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
) -> Floats:
    """(side^2, cells^2): the middle of a thumbnail, cropped to a share, turned and moved."""
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
    out = np.zeros((SIDE * SIDE, cells * cells), np.float32)
    np.add.at(out, (columns, np.tile(cell, 4)), weights.astype(np.float32))
    return out


def _pool() -> Floats:
    """(side^2, cells^2): triangles that overlap by half."""
    center = (np.arange(SIDE) + 0.5) * SLOPE_CELLS / SIDE - 0.5
    side = np.maximum(0, 1 - np.abs(center[:, None] - np.arange(SLOPE_CELLS)))
    return np.kron(side, side).astype(np.float32)


_POOL = _pool()
