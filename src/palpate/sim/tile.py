"""Periodic fields on a square tile of 64 mm, the toolbox that materials are made from.

Every field repeats without a seam: noise is shaped in the Fourier domain, cells lie on a jittered
grid with wrapped neighbors, waves have whole numbers of periods along both sides, strokes are
drawn modulo the tile.

- Band-limited fractal noise: white noise with amplitude f^-(beta + 1)/2 between two wavelengths, f
  stretched along an angle.
- Worley noise: distances F1 <= F2 to the nearest two seeds, and the cell a point belongs to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import TypeVar

import numpy as np
import scipy

from palpate.sim.arrays import Array, f32, sample_periodic, smoothstep, turned

T = TypeVar("T")
#: Side of the tile in mm.
TILE_MM = 64.0


def wrapped_offset(at: Array, origin: Array | float) -> Array:
    """Return the shortest periodic offset from ``origin`` to ``at``, in mm."""
    half = TILE_MM / 2.0
    return (at - origin + half) % TILE_MM - half


@dataclass(frozen=True)
class Cells:
    """Worley cells of a tile."""

    near: Array  # distance F1 to the nearest seed in mm, (n, n)
    far: Array  # distance F2 to the second nearest seed in mm, (n, n)
    index: np.ndarray  # the cell of each pixel, in 0 .. count - 1, (n, n)
    seeds: Array  # (y, x) of the seeds in mm, (count, 2)
    rng: np.random.Generator  # the tile's

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.seeds)

    def keep(self, share: float) -> Array:
        """Return 1 in a random ``share`` of the cells, 0 in the others; shape (n, n)."""
        return f32(self.rng.random(self.count) < share)[self.index]

    def each(self, mean: float, spread: float) -> Array:
        """Draw one normal number a cell, shape (n, n)."""
        return f32(self.rng.normal(mean, spread, self.count))[self.index]

    def walls(self, width: float) -> Array:
        """Return 0 on the walls between cells, rising to 1 over ``width`` mm; shape (n, n)."""
        return smoothstep(self.far - self.near, 0.0, width)


class Tile:
    """A periodic grid of n x n pixels and the random generator that its fields draw from.

    Args:
        n: pixels a side.
        rng: generator; the order of calls matters, so a material draws in a fixed order.
        whole: whether what is drawn has no joints, and mirrors nothing: it becomes a ground.

    Attributes:
        px: pixel size in mm.
        draw: uniform numbers, as of ``rng.uniform``.
        y, x: pixel positions in mm, shapes (n, 1) and (1, n).
    """

    def __init__(self, n: int, rng: np.random.Generator, *, whole: bool = False) -> None:
        self.whole = whole
        self.n, self.rng, self.px, self.draw = n, rng, TILE_MM / n, rng.uniform
        at = f32(np.arange(n) * self.px)
        self.y, self.x = at[:, None], at[None]
        self._fy = f32(np.fft.fftfreq(n, self.px))[:, None]
        self._fx = f32(np.fft.rfftfreq(n, self.px))[None]

    def pick(self, *choices: T) -> T:
        """Draw one of ``choices`` with equal probability."""
        return choices[int(self.rng.integers(len(choices)))]

    def flip(self, share: float) -> bool:
        """Return True with probability ``share``."""
        return self.draw() < share

    def angle(self) -> float:
        """Draw a direction in [0, pi)."""
        return self.draw(0.0, math.pi)

    def ones(self) -> Array:
        """Return a field of ones."""
        return np.ones((self.n, self.n), np.float32)

    def noise(
        self, low: float, high: float, beta: float = 2.0, stretch: float = 1.0, angle: float = 0.0
    ) -> Array:
        """Draw fractal noise of zero mean and unit deviation.

        Args:
            low: shortest wavelength in mm.
            high: longest wavelength in mm.
            beta: power falls as f^-(beta + 1) in two dimensions; 0 is nearly white, 3 very soft.
            stretch: how much longer the features are along ``angle`` than across.
            angle: direction in radians, 0 along x.
        """
        root = math.sqrt(stretch)
        along, across = turned(self._fy, self._fx, angle)
        along, across = along * root, across * (1.0 / root)
        f = np.sqrt(along * along + across * across) + 1e-9
        weight = f ** (-beta / 2.0 - 0.5) * np.exp(f * f * (-low * low / 2.0)) * (f > 1.0 / high)
        white = self.rng.standard_normal((self.n, self.n), dtype=np.float32)
        z = np.fft.irfft2(np.fft.rfft2(white) * weight, s=(self.n, self.n))
        return f32(z * (1.0 / (float(z.std()) + 1e-12)))

    def ridged(self, *spectrum: float) -> Array:
        """Fold :meth:`noise` at zero, so that it has sharp crests; zero mean, unit deviation."""
        z = -np.abs(self.noise(*spectrum))
        return (z - float(z.mean())) * (1.0 / float(z.std()))

    def warp(self, field: Array, amount: float) -> Array:
        """Look ``field`` up at places displaced by smooth noise of deviation ``amount`` mm."""
        dy, dx = (self.noise(4.0, 20.0) * (amount / self.px) for _ in range(2))
        return sample_periodic(field, self.y * (1.0 / self.px) + dy, self.x * (1.0 / self.px) + dx)

    def cells(self, size: float, jitter: float = 0.9) -> Cells:
        """Draw Worley cells of mean diameter ``size`` mm; ``jitter`` 0 is a square grid."""
        k = max(3, round(TILE_MM / size))
        side = TILE_MM / k
        offsets = 0.5 + jitter * (self.rng.random((k, k, 2), dtype=np.float32) - 0.5)
        q = f32((np.arange(self.n) + 0.5) * (self.px / side))
        cell, part = np.floor(q).astype(np.intp), q - np.floor(q)
        near = np.full((self.n, self.n), 9.0, np.float32)
        far, index = near.copy(), np.zeros((self.n, self.n), np.int32)
        for dy, dx in product((-1, 0, 1), repeat=2):
            row, column = ((cell + dy) % k)[:, None], ((cell + dx) % k)[None]
            seed = offsets[row, column]
            down, right = seed[..., 0] + (dy - part)[:, None], seed[..., 1] + (dx - part)[None]
            distance = down**2 + right**2
            closer = distance < near
            far = np.where(closer, near, np.minimum(far, distance))
            near = np.where(closer, distance, near)
            index = np.where(closer, row * k + column, index)
        corner = np.moveaxis(np.indices((k, k)), 0, -1)
        seeds = f32((corner + offsets).reshape(-1, 2) * side)
        return Cells(np.sqrt(near) * side, np.sqrt(far) * side, index, seeds, self.rng)

    def grains(
        self, size: float, spread: float = 0.35, cover: float = 1.0, edge: float = 0.6
    ) -> tuple[Array, Cells]:
        """Pack stones.

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
        z = dome * np.clip(cells.each(1.0, spread), 0.25, 2.0)
        lean = f32(self.rng.normal(0.0, 0.25, (cells.count, 2)))[cells.index]
        seed = cells.seeds[cells.index]
        dy, dx = wrapped_offset(self.y, seed[..., 0]), wrapped_offset(self.x, seed[..., 1])
        z = z + (lean[..., 0] * dy + lean[..., 1] * dx) * (2.0 / size) * dome
        return z * cells.keep(cover), cells

    def _periods(self, period: float, angle: float) -> tuple[int, int]:
        """Return the whole periods along x and y of a wave, at least one."""
        k = TILE_MM / period
        kx, ky = round(k * math.cos(angle)), round(k * math.sin(angle))
        return (kx or int(ky == 0)), ky

    def wave(self, period: float, angle: float = 0.0, wobble: float = 0.0) -> Array:
        """Return the phase of a plane wave in radians, shape (n, n), for ``sin`` and the like.

        The wave vector is rounded to whole periods a side, so ``period`` mm and ``angle`` are met
        nearly; two waves at right angles stay so. ``wobble`` adds noise of that deviation (radians)
        to the phase.
        """
        kx, ky = self._periods(period, angle)
        phase = self.rng.uniform(0.0, 2.0 * math.pi)
        a = (kx * self.x + ky * self.y) * (2.0 * math.pi / TILE_MM) + phase
        return a + wobble * self.noise(3.0, 16.0) if wobble else a

    def waves(self, period: float, angle: float, wobble: float = 0.0) -> tuple[Array, Array]:
        """Return the phases of two waves at right angles, see :meth:`wave`."""
        first = self.wave(period, angle, wobble)
        return first, self.wave(period, angle + math.pi / 2.0, wobble)

    def lines(self, period: float, angle: float) -> Array:
        """Return the distance in mm to the nearest of parallel lines (see :meth:`wave`)."""
        kx, ky = self._periods(period, angle)
        turns = (kx * self.x + ky * self.y) * (1.0 / TILE_MM) + self.rng.uniform(0.0, 1.0)
        return np.abs(turns - np.round(turns)) * (TILE_MM / math.hypot(kx, ky))

    def squares(self, side: float) -> Array:
        """Return the distance in mm to the nearest joint of a square grid dividing the tile."""
        across = lambda at: np.minimum(at % side, side - at % side)
        return np.minimum(across(self.y), across(self.x))

    def strokes(
        self,
        count: int,
        length: float,
        width: float,
        *,
        angle: float = 0.0,
        spread: float,
        height: float,
        bend: float = 0.3,
    ) -> Array:
        """Draw curved ridges (blades, fibers, scratches); the highest wins where they cross.

        Args:
            count: how many.
            length: mean length in mm.
            width: mean width in mm.
            angle: mean direction in radians.
            spread: deviation of the direction in radians.
            height: height of the tallest in mm.
            bend: deviation of the total turn in radians.
        """
        n, rng, per_mm = self.n, self.rng, 1.0 / self.px
        lengths = length * rng.uniform(0.6, 1.4, count)
        widths = width * rng.uniform(0.6, 1.5, count)
        start = angle + rng.normal(0.0, spread, count)
        steps = max(4, round(length * 1.7 / self.px))
        t = f32(np.linspace(0.0, 1.0, steps))[None]
        turn = f32(start)[:, None] + f32(bend * rng.standard_normal(count))[:, None] * (t - 0.3)
        sin, cos, step = np.sin(turn), np.cos(turn), f32(lengths / steps)[:, None]
        y = f32(rng.uniform(0.0, TILE_MM, (count, 1))) + np.cumsum(sin, 1) * step
        x = f32(rng.uniform(0.0, TILE_MM, (count, 1))) + np.cumsum(cos, 1) * step
        top = f32(height * rng.uniform(0.3, 1.0, count))[:, None, None]
        reach = max(1, math.ceil(width * 0.75 / self.px))
        offset = f32(np.arange(-reach, reach + 1) * self.px)[None, None]
        half = f32(widths / 2.0)[:, None] * (1.0 - 0.85 * np.abs(2.0 * t - 1.0) ** 3) + 1e-3
        profile = np.sqrt(np.clip(1.0 - (offset / half[..., None]) ** 2, 0.0, 1.0)) * top
        iy = np.round((y[..., None] + cos[..., None] * offset) * per_mm).astype(np.intp) % n
        ix = np.round((x[..., None] - sin[..., None] * offset) * per_mm).astype(np.intp) % n
        z = np.zeros(n * n, np.float32)
        np.maximum.at(z, (iy * n + ix).ravel(), profile.ravel())
        # The rounded steps miss some pixels; closing fills them.
        return scipy.ndimage.grey_closing(z.reshape(n, n), 2, mode="wrap")
