"""Periodic fields on a square tile of 64 mm, the toolbox that materials are made from.

Every field repeats without a seam: noise is shaped in the Fourier domain, cells live on a jittered
    grid with wrapped neighbors, waves
have whole numbers of periods along both sides, strokes are drawn modulo the tile.

- Band-limited fractal noise: white noise with amplitude f^-(beta + 1)/2 between two wavelengths, f
  stretched along an angle.
- Worley noise: distances F1 <= F2 to the nearest two seeds, and the cell a point belongs to.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from palpate.sim.arrays import Array, f32, sample_periodic, smoothstep

#: Side of the tile in mm.
TILE_MM = 64.0


class Cells:
    """Worley cells of a tile.

    Attributes:
        near, far: distances F1 and F2 to the nearest and second nearest seed in mm, shape (n, n).
        index: the cell of each pixel, shape (n, n), in 0 .. count - 1.
        seeds: (y, x) of the seeds in mm, shape (count, 2).
        count: number of cells.
    """

    def __init__(self, near: Array, far: Array, index: np.ndarray, seeds: Array) -> None:
        self.near, self.far, self.index, self.seeds, self.count = (
            near,
            far,
            index,
            seeds,
            len(seeds),
        )

    def keep(self, rng: np.random.Generator, share: float) -> Array:
        """1 in a random ``share`` of the cells, 0 in the others; shape (n, n)."""
        return f32(rng.random(self.count) < share)[self.index]

    def each(self, rng: np.random.Generator, mean: float, spread: float) -> Array:
        """One normal number a cell, shape (n, n)."""
        return f32(rng.normal(mean, spread, self.count))[self.index]

    def walls(self, width: float) -> Array:
        """0 on the walls between cells, rising to 1 over ``width`` mm; shape (n, n)."""
        return smoothstep(self.far - self.near, 0.0, width)


class Tile:
    """A periodic grid of n x n pixels and the random generator that its fields draw from.

    Args:
        n: pixels a side.
        rng: generator; the order of calls matters, so a material draws in a fixed order.

    Attributes:
        px: pixel size in mm.
        y, x: pixel positions in mm, shapes (n, 1) and (1, n).
    """

    def __init__(self, n: int, rng: np.random.Generator) -> None:
        self.n, self.rng, self.px = n, rng, TILE_MM / n
        at = f32(np.arange(n) * self.px)
        self.y, self.x = at[:, None], at[None]
        self._fy = f32(np.fft.fftfreq(n, self.px))[:, None]
        self._fx = f32(np.fft.rfftfreq(n, self.px))[None]

    def zeros(self) -> Array:
        """A flat field."""
        return np.zeros((self.n, self.n), np.float32)

    def noise(
        self, low: float, high: float, beta: float = 2.0, stretch: float = 1.0, angle: float = 0.0
    ) -> Array:
        """Fractal noise of zero mean and unit deviation.

        Args:
            low: shortest wavelength in mm.
            high: longest wavelength in mm.
            beta: power falls as f^-(beta + 1) in two dimensions; 0 is nearly white, 3 very soft.
            stretch: how much longer the features are along ``angle`` than across.
            angle: direction in radians, 0 along x.
        """
        c, s, root = math.cos(angle), math.sin(angle), math.sqrt(stretch)
        along, across = (
            (c * self._fx + s * self._fy) * root,
            (c * self._fy - s * self._fx) * (1.0 / root),
        )
        f = np.sqrt(along * along + across * across) + 1e-9
        weight = f ** (-beta / 2.0 - 0.5) * np.exp(f * f * (-low * low / 2.0)) * (f > 1.0 / high)
        white = self.rng.standard_normal((self.n, self.n), dtype=np.float32)
        z = np.fft.irfft2(np.fft.rfft2(white) * weight, s=(self.n, self.n))
        return f32(z * (1.0 / (float(z.std()) + 1e-12)))

    def ridged(
        self, low: float, high: float, beta: float = 2.0, stretch: float = 1.0, angle: float = 0.0
    ) -> Array:
        """Noise folded at zero, so that it has sharp crests; zero mean, unit deviation."""
        z = -np.abs(self.noise(low, high, beta, stretch, angle))
        return (z - float(z.mean())) * (1.0 / float(z.std()))

    def warp(self, field: Array, amount: float, low: float = 4.0, high: float = 20.0) -> Array:
        """``field`` looked up at places displaced by smooth noise of deviation ``amount`` mm."""
        dy, dx = (
            self.noise(low, high) * (amount / self.px),
            self.noise(low, high) * (amount / self.px),
        )
        return sample_periodic(field, self.y * (1.0 / self.px) + dy, self.x * (1.0 / self.px) + dx)

    def cells(self, size: float, jitter: float = 0.9) -> Cells:
        """Worley cells of mean diameter ``size`` mm; ``jitter`` 0 is a square grid."""
        k = max(3, round(TILE_MM / size))
        side = TILE_MM / k
        offsets = 0.5 + jitter * (self.rng.random((k, k, 2), dtype=np.float32) - 0.5)
        q = f32((np.arange(self.n) + 0.5) * (self.px / side))
        cell = np.floor(q).astype(np.intp)
        part = q - np.floor(q)
        near = np.full((self.n, self.n), 9.0, np.float32)
        far, index = near.copy(), np.zeros((self.n, self.n), np.int32)
        for dy in (-1, 0, 1):
            row = (cell + dy) % k
            for dx in (-1, 0, 1):
                column = (cell + dx) % k
                seed = offsets[row[:, None], column[None]]
                distance = (seed[..., 0] + (dy - part)[:, None]) ** 2 + (
                    seed[..., 1] + (dx - part)[None]
                ) ** 2
                closer = distance < near
                far = np.where(closer, near, np.minimum(far, distance))
                near = np.where(closer, distance, near)
                index = np.where(closer, row[:, None] * k + column[None], index)
        corner = np.stack(np.meshgrid(np.arange(k), np.arange(k), indexing="ij"), -1)
        seeds = f32((corner + offsets).reshape(-1, 2) * side)
        return Cells(np.sqrt(near) * side, np.sqrt(far) * side, index, seeds)

    def grains(
        self, size: float, spread: float = 0.35, cover: float = 1.0, edge: float = 0.6
    ) -> tuple[Array, Cells]:
        """Packed stones.

        Args:
            size: diameter in mm.
            spread: deviation of their heights around 1.
            cover: share of the cells that hold a stone.
            edge: roundness; small is a flat top with steep sides.

        Returns:
            Height in units of a stone's radius, and the cells.
        """
        cells = self.cells(size)
        dome = np.clip(1.0 - (cells.near / (cells.near + cells.far) * 2.0) ** 2, 0.0, 1.0) ** edge
        z = dome * np.clip(cells.each(self.rng, 1.0, spread), 0.25, 2.0)
        lean = f32(self.rng.normal(0.0, 0.25, (cells.count, 2)))[cells.index]
        seed = cells.seeds[cells.index]
        half = TILE_MM / 2.0
        dy = (self.y - seed[..., 0] + half) % TILE_MM - half
        dx = (self.x - seed[..., 1] + half) % TILE_MM - half
        return (z + (lean[..., 0] * dy + lean[..., 1] * dx) * (2.0 / size) * dome) * cells.keep(
            self.rng, cover
        ), cells

    def wave(self, period: float, angle: float = 0.0, wobble: float = 0.0) -> Array:
        """The phase of a plane wave in radians, shape (n, n), for ``sin`` and the like.

        The wave vector is rounded to whole periods a side, so ``period`` mm and ``angle`` are met
        nearly; two waves at right angles stay so. ``wobble`` adds noise of that deviation (radians)
        to the phase.
        """
        k = TILE_MM / period
        kx, ky = round(k * math.cos(angle)), round(k * math.sin(angle))
        if kx == ky == 0:
            kx = 1
        phase = self.rng.uniform(0.0, 2.0 * math.pi)
        a = (kx * self.x + ky * self.y) * (2.0 * math.pi / TILE_MM) + phase
        return a + wobble * self.noise(3.0, 16.0) if wobble else a

    def lines(self, period: float, angle: float) -> tuple[Array, float]:
        """Distance in mm to the nearest of parallel lines ``period`` apart (rounded as in
        :meth:`wave`), and the period met.
        """
        k = TILE_MM / period
        kx, ky = round(k * math.cos(angle)), round(k * math.sin(angle))
        if kx == ky == 0:
            kx = 1
        met = TILE_MM / math.hypot(kx, ky)
        turns = (kx * self.x + ky * self.y) * (1.0 / TILE_MM) + self.rng.uniform(0.0, 1.0)
        return np.abs(turns - np.round(turns)) * met, met

    def squares(self, side: float) -> Array:
        """Distance in mm to the nearest joint of a square grid whose side divides the tile."""
        across = lambda at: np.minimum(at % side, side - at % side)  # noqa: E731
        return np.minimum(across(self.y), across(self.x))

    def strokes(
        self,
        count: int,
        length: float,
        width: float,
        *,
        angle: float,
        spread: float,
        height: float,
        bend: float = 0.3,
    ) -> Array:
        """Curved ridges (blades, fibres, scratches), the highest winning where they cross; heights
        in mm.

        Args:
            count: how many.
            length: mean length in mm.
            width: mean width in mm.
            angle: mean direction in radians.
            spread: deviation of the direction in radians.
            height: height of the tallest in mm.
            bend: deviation of the total turn in radians.
        """
        n, rng = self.n, self.rng
        lengths, widths = (
            length * rng.uniform(0.6, 1.4, count),
            width * rng.uniform(0.6, 1.5, count),
        )
        start = angle + rng.normal(0.0, spread, count)
        steps = max(4, round(length * 1.7 / self.px))
        t = f32(np.linspace(0.0, 1.0, steps))[None]
        turn = f32(start)[:, None] + f32(bend * rng.standard_normal(count))[:, None] * (t - 0.3)
        sin, cos, step = np.sin(turn), np.cos(turn), f32(lengths / steps)[:, None]
        y = f32(rng.uniform(0.0, TILE_MM, (count, 1))) + np.cumsum(sin, 1) * step
        x = f32(rng.uniform(0.0, TILE_MM, (count, 1))) + np.cumsum(cos, 1) * step
        top = f32(height * rng.uniform(0.3, 1.0, count))
        reach = max(1, math.ceil(width * 0.75 / self.px))
        offset = f32(np.arange(-reach, reach + 1) * self.px)[None, None]
        half = f32(widths / 2.0)[:, None] * (1.0 - 0.85 * np.abs(2.0 * t - 1.0) ** 3) + 1e-3
        profile = (
            np.sqrt(np.clip(1.0 - (offset / half[..., None]) ** 2, 0.0, 1.0)) * top[:, None, None]
        )
        iy = (
            np.round((y[..., None] + cos[..., None] * offset) * (1.0 / self.px)).astype(np.intp) % n
        )
        ix = (
            np.round((x[..., None] - sin[..., None] * offset) * (1.0 / self.px)).astype(np.intp) % n
        )
        z = np.zeros(n * n, np.float32)
        np.maximum.at(z, (iy * n + ix).ravel(), profile.ravel())
        return ndimage.grey_closing(
            z.reshape(n, n), 2, mode="wrap"
        )  # fills pixels that the rounded steps left out
