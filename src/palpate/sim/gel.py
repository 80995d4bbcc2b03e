"""The tactile sensor: a gel pad, pressed with a given force and lit by three colored lights.

- Press: a Winkler foundation. The gap between relief and gel dome is g; the approach d is solved
  exactly from mean(max(g + d, 0)) = load.
- Membrane: penetration p = max(g + d, 0), limited to h = G tanh(p / G) for a gel of depth G, grip
  w = p / (p + :data:`GRIP_MM`). From m = h, each blur S of ``RELAX_MM`` gives m <- S m + w (h - S
  m): the gel follows what presses hard, and bridges the hollows and the rim, so that a contact ends
  softly. ``OPTICAL_MM`` follows.
- Light: with n the normal of m + texture,
  I = ((ambient + sum_k color_k F_k(x, y) max(0, n . l_k)) V (1 - q m) (1 - 0.96 ink) gain)^gamma.
  Near field F_k = 1 + a + 0.35 a² - hump_k r², a = fall_k (x, y) . azimuth_k, in units of half the
  pad; V = vignette times dirt; q, of either sign, dims or brightens what is indented. The
  background is the same formula with m = 0.
- Markers: a jittered grid of small squarish dots of ink, large round ones where they are worn, and
  dust; they move with the gel.
- A unit is drawn on 256 x 256 points and averaged down, so that it looks the same at every size.

The look ``gelsight`` is fitted to the real clips.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from palpate.core import rng_for
from palpate.sim.arrays import (
    Array,
    f32,
    grid,
    resample,
    sample_clipped,
    smooth,
    smoothstep,
    turned,
)
from palpate.sim.materials import Surface
from palpate.sim.motion import State
from palpate.sim.options import VERSION, WorldOptions

#: Points a side that a unit is drawn on.
DRAWN = 256
#: Penetration in mm at which the gel follows the object half the way; below, it bridges hollows.
GRIP_MM = 0.04
#: Depth of the gel in mm.
GEL_MM = 1.6
#: Blurs in mm of the gel where nothing touches it, one by one, and of the sensor's optics.
RELAX_MM, OPTICAL_MM = (2.4, 0.9, 0.35), 0.14
#: Range of the radius in mm of the domed gel of a unit.
DOME_MM = (30.0, 80.0)
#: Range of the darkening at half the pad's side of a unit.
VIGNETTE = (0.03, 0.16)
#: The lights are green, blue and red.
_PURE = np.eye(3)[[1, 2, 0]]
_Triple = tuple[float, float, float]


@dataclass(frozen=True)
class _Look:
    """The optics of a family of units; a triple has a value for each light: green, blue, red."""

    azimuth: _Triple  # radians, x to the right and y down
    elevation: tuple[float, float]  # range in degrees
    mixed: float  # share of white in each light
    gain: _Triple  # brightness
    fall: _Triple  # near-field slope
    hump: _Triple  # loss of the light away from the middle
    ambient: _Triple  # light without direction, RGB
    # Deviation between units of the logarithms of mixed, gain, fall and ambient.
    spread: tuple[float, float, float, float]


_LOOKS = {
    # Gray-pink and bright, faint lobes: teal top left, violet lower left, red on the right.
    "gelsight": _Look(
        azimuth=(-2.2, 2.4, 0.25),
        elevation=(26.0, 33.0),
        mixed=0.12,
        gain=(0.39, 0.50, 0.68),
        fall=(0.33, 0.25, 0.08),
        hump=(0.0, 0.0, 0.28),
        ambient=(0.295, 0.325, 0.31),
        spread=(0.12, 0.03, 0.15, 0.02),
    ),
    # Darker, three strong lobes.
    "digit": _Look(
        azimuth=(-2.25, 1.94, -0.16),
        elevation=(30.0, 40.0),
        mixed=0.13,
        gain=(0.48, 0.52, 0.54),
        fall=(0.60, 0.60, 0.60),
        hump=(0.0, 0.0, 0.0),
        ambient=(0.10, 0.10, 0.11),
        spread=(0.15, 0.06, 0.10, 0.10),
    ),
}


class Sensor:
    """One gel unit at one image size n. The family is the same in every world, the unit is not.

    Attributes:
        size, px, half: n, the pixel size and half the pad's side in mm.
        field: near-field factor of each light, (3, n, n).
        color: RGB of each light, (3, 3).
        light: unit vectors towards the lights, (3, 3).
        ambient: RGB, (3,).
        veil: vignette times dirt, (n, n).
        texture, dome: fine relief of the gel, and its doming, in mm, (n, n).
        ink: opacity of the markers in [0, 1], (n, n), or None.
        dim: loss of light for each mm of indentation.
        gamma, noise: of the image; the noise as a deviation.
    """

    def __init__(self, options: WorldOptions, unit: int) -> None:
        name, size, pad = options.look, options.size, options.pad_mm
        self.size, self.px, self.half, look = size, pad / size, pad / 2.0, _LOOKS[name]
        family: np.random.Generator = rng_for(0, "sensor family", VERSION, name)
        rng = options.rng("sensor", name, unit)
        down = lambda a: resample(f32(a), size)
        spread = [math.exp(s * rng.normal()) for s in look.spread]
        azimuth = [a + rng.normal(0.0, 0.05) for a in look.azimuth]
        elevation = np.deg2rad(family.uniform(*look.elevation, 3))
        mixed = look.mixed * spread[0]
        gain = np.exp(rng.normal(0.0, 0.05, (3, 1))) * np.asarray(look.gain)[:, None] * spread[1]
        flat = np.cos(elevation)
        light = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], 1)
        self.color, self.light = f32((_PURE * (1.0 - mixed) + mixed) * gain), f32(light)
        y, x = grid(DRAWN)
        square = x * x + y * y
        field: list[Array] = []
        for angle, fall, hump in zip(azimuth, look.fall, look.hump, strict=True):
            a = turned(y, x, angle)[0] * (fall * spread[2])
            field.append(down(np.clip(1.0 + a + 0.35 * a * a - hump * square, 0.08, None)))
        self.field = np.stack(field)
        self.veil = down((1.0 - rng.uniform(*VIGNETTE) * square) * (1.0 + _dirt(rng)))
        texture = scipy.ndimage.gaussian_filter(_white(rng), 0.3 / (pad / DRAWN))
        self.texture = down(texture * (0.0022 / float(texture.std())))
        self.dome = down(square * (self.half**2 / (2.0 * rng.uniform(*DOME_MM))))
        inked = name == "gelsight" and options.markers > 0
        self.ink = down(_markers(options.markers, pad, rng)) if inked else None
        self.ambient = f32(np.asarray(look.ambient) * spread[3] * rng.uniform(0.97, 1.03, 3))
        self.dim, self.gamma = rng.normal(0.03, 0.06), rng.uniform(0.9, 1.1)
        self.noise = rng.uniform(*options.sensor_noise)

    def gap(self, surface: Surface, relief: Array, state: State) -> Array:
        """Return the relief minus the gel's dome, tilted and curved, in mm, shape (n, n).

        Soft objects flatten under the load.
        """
        y, x = grid(self.size)
        half, (along, across) = self.half, state.tilt
        if surface.softness:
            relief = relief * (1.0 - 0.5 * surface.softness * min(1.0, state.load / 0.3))
        slope = x * (half * along) + y * (half * across)
        return relief - self.dome - slope - x * x * (surface.curvature / 2.0 * half * half)

    def press(self, gap: Array, load: float) -> tuple[Array, Array]:
        """Press the gel until the mean penetration equals ``load`` mm.

        Returns:
            Membrane displacement in mm and the contact mask, both of shape (n, n).
        """
        penetration = gap + solve_approach(gap, load)
        indented = np.maximum(penetration, 0.0)
        grip = indented / (indented + GRIP_MM)
        membrane = indented = np.tanh(indented * (1.0 / GEL_MM)) * GEL_MM
        for blur in RELAX_MM:
            membrane = smooth(membrane, blur / self.px)
            membrane += grip * (indented - membrane)
        return smooth(membrane, OPTICAL_MM / self.px), penetration > 0.0

    def shift(self, membrane: Array, shear: tuple[float, float]) -> tuple[Array, Array]:
        """Displace the markers: (dy, dx) in pixels.

        They are dragged by ``shear`` (mm per mm of depth) and pushed apart where the gel is deep.
        """
        depth = smooth(np.minimum(membrane, 1.0), self.size / 10)
        slope_y, slope_x = np.gradient(depth, self.px)
        unit = 1.0 / self.px
        dy = f32(depth * (shear[1] * unit) - slope_y * (0.107 * unit))
        return dy, f32(depth * (shear[0] * unit) - slope_x * (0.107 * unit))

    def shade(
        self, membrane: Array, gain: Array, shift: tuple[Array, Array] | None = None
    ) -> Array:
        """Render the gel, shape (n, n, 3), in [0, 1.2]^gamma, without noise.

        Args:
            membrane: displacement in mm, (n, n); zeros give the background image.
            gain: white balance of the recording, RGB, (3,).
            shift: displacement of the markers in pixels, or None.
        """
        slope_y, slope_x = np.gradient(membrane + self.texture, self.px)
        upright = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        light = [
            np.maximum((slope_x * float(lx) + slope_y * float(ly) + float(lz)) * upright, 0.0)
            * field
            for (lx, ly, lz), field in zip(self.light, self.field, strict=True)
        ]
        veil = self.veil * (1.0 - self.dim * membrane)
        if self.ink is not None:
            ink = self.ink
            if shift is not None:
                at = f32(np.arange(self.size))
                ink = sample_clipped(ink, at[:, None] - shift[0], at - shift[1])
            veil = veil * (1.0 - 0.96 * ink)
        image = np.empty((self.size, self.size, 3), np.float32)
        for c in range(3):
            total = sum(light[k] * float(self.color[k, c]) for k in range(3))
            image[..., c] = (total + float(self.ambient[c])) * veil * float(gain[c])
        return np.clip(image, 0.0, 1.2) ** self.gamma


#: A unit is made once for all videos of a world.
make_sensor = lru_cache(maxsize=64)(Sensor)


def _white(rng: np.random.Generator) -> Array:
    return rng.standard_normal((DRAWN, DRAWN), dtype=np.float32)


def _dirt(rng: np.random.Generator) -> Array:
    """Draw uneven coating, specks and scratches: a change of brightness around 0."""
    draw, (y, x) = rng.uniform, grid(DRAWN)
    low = scipy.ndimage.gaussian_filter(_white(rng), DRAWN / 7, mode="reflect")
    fine = scipy.ndimage.gaussian_filter(_white(rng), 1.6)
    dirt = low * (0.018 / float(low.std())) + fine * (0.004 / float(fine.std()))
    for _ in range(int(rng.integers(2, 9))):
        cx, cy, width = draw(-1.0, 1.0), draw(-1.0, 1.0), draw(0.008, 0.03)
        square = (x - cx) ** 2 + (y - cy) ** 2
        dirt -= draw(0.03, 0.18) * np.exp(square * (-0.5 / width**2))
    for _ in range(int(rng.integers(0, 4))):
        angle, offset = draw(0.0, math.pi), draw(-1.0, 1.0)
        middle = draw(-0.5, 0.5)
        across, length = turned(y, x, angle)
        across, length = (across - offset) * (1.0 / 0.012), length - middle
        dirt += draw(0.01, 0.05) * np.exp(-across * across) * (np.abs(length) < 0.35)
    return dirt


def _markers(rows: int, pad: float, rng: np.random.Generator) -> Array:
    """Draw the opacity of the ink: a jittered grid of small dots, worn ones among them, and dust.

    The grid has a pitch of 0.96 pad / rows and begins anywhere, so that a unit shows ``rows`` or
    one more a side. A small dot has a radius of 0.2 mm at the pitch of 8 rows on 14 mm and shrinks
    with a finer pitch. Worn dots are large and round.
    """
    draw, ink = rng.uniform, np.zeros((DRAWN, DRAWN), np.float32)
    step, mm = 2.0 * 0.96 / rows, 2.0 / pad
    scale = min(1.0, step * pad / (0.24 * 14.0)) * mm
    first = -1.0 - step * draw(0.0, 1.0, 2)
    wear_x, wear_y, wear = draw(-1.0, 1.0), draw(-1.0, 1.0), draw(0.15, 0.5)
    for i, j in np.ndindex(rows + 3, rows + 3):
        cy = first[0] + (i * step + rng.normal(0.0, 0.012))
        cx = first[1] + (j * step + rng.normal(0.0, 0.012))
        square = (cx - wear_x) ** 2 + (cy - wear_y) ** 2
        worn = rng.random() < 0.07 + 0.75 * math.exp(-square / (2.0 * wear * wear))
        radius = (draw(0.26, 0.40) if worn else draw(0.16, 0.215)) * scale
        shape = (draw(0.85, 1.2), draw(0.93, 1.0), 2.0 if worn else 4.0)
        _dot(ink, (cy, cx), radius, shape)
    for _ in range(int(rng.integers(0, 14))):
        center = (draw(-1.0, 1.0), draw(-1.0, 1.0))
        radius = draw(0.03, 0.09) * mm
        _dot(ink, center, radius, (draw(0.6, 1.6), draw(0.4, 0.9), 2.0))
    return ink


def _dot(ink: Array, center: tuple[float, float], radius: float, shape: _Triple) -> None:
    """Draw |x / aspect|^power + |y|^power < radius^power at ``center`` (y, x) in [-1, 1].

    ``shape`` is the aspect, the opacity and the power.
    """
    aspect, dark, power = shape
    y, x = grid(DRAWN)
    reach = 1.3 * radius + 0.02
    rows, columns = (slice(*np.searchsorted(y[:, 0], (c - reach, c + reach))) for c in center)
    part = ink[rows, columns]
    dx, dy = np.abs((x[:, columns] - center[1]) / aspect), np.abs(y[rows] - center[0])
    distance = (dx**power + dy**power) ** (1.0 / power)
    np.maximum(part, smoothstep(distance, radius + 0.006, radius - 0.006) * dark, out=part)


def solve_approach(gap: Array, load: float) -> float:
    """Solve mean(max(gap + d, 0)) = ``load`` (> 0) for d, in mm.

    With the gaps sorted downwards and their running sums S_k, the k largest are in contact if
    d_k = (N load - S_k) / k lifts gap k but not gap k + 1.
    """
    ordered = np.sort(gap, axis=None)[::-1].astype(np.float64)
    d = (load * ordered.size - np.cumsum(ordered)) / np.arange(1, ordered.size + 1)
    consistent = np.append(ordered[1:] + d[:-1] <= 0.0, True)
    return float(d[int(np.argmax(consistent))])
