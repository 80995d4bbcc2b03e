"""The touch sensor: a gel pad of 14 mm, pressed with a given force, lit by three coloured lights.

- Press: a Winkler foundation. The gap between relief and gel dome is g; the approach d is solved exactly from
  mean(max(g + d, 0)) = load (sort g, then the k largest values touch for the k at which d_k = (N load - sum of k) / k is consistent).
  The free membrane is relaxed by three blurs with the contact re-imposed after each.
- Light: I = (ambient + sum_k colour_k F_k(x, y) max(0, n . l_k)) vignette dirt (1 - ink), raised to a gamma; F_k quadratic along the
  light's direction (near field). The background image is the same formula with no contact.
- Everything of a unit is drawn on 256 x 256 points and averaged down, so that a unit looks the same at every image size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from palpate.core import rng_for
from palpate.sim.arrays import Array, f32, grid, resample, smooth, smoothstep
from palpate.sim.objects import Thing
from palpate.sim.options import VERSION, WorldOptions

#: Side of the gel pad in mm.
PATCH_MM = 14.0
#: Thickness of gel that can be indented, in mm.
GEL_MM = 1.6
#: Points a side that a unit is drawn on.
DRAWN = 256
#: Blurs in mm that relax the free membrane, and the optical blur after them.
RELAX_MM, OPTICAL_MM = (1.6, 0.7, 0.3), 0.085


@dataclass(frozen=True)
class Sensor:
    """One gel unit at one image size n.

    Attributes:
        look, unit, size: which it is; px: pixel size in mm.
        field: near-field factor of each light, shape (3, n, n); colour: their RGB, (3, 3); light: unit vectors towards them, (3, 3).
        ambient: RGB, (3,); veil: vignette times dirt, (n, n); texture, dome: gel relief in mm, (n, n).
        ink: opacity of the markers in [0, 1], (n, n), or None without markers.
        gamma, noise: tone exponent, and deviation of the image noise.
    """

    look: str
    unit: int
    size: int
    px: float
    field: Array
    colour: Array
    light: Array
    ambient: Array
    veil: Array
    texture: Array
    dome: Array
    ink: Array | None
    gamma: float
    noise: float


def make_sensor(options: WorldOptions, unit: int) -> Sensor:
    """A unit of the family ``options.look``; the family is the same product in every world, the unit depends on the seed."""
    return _make(options.look, options.seed, unit, options.size)


@lru_cache(maxsize=64)
def _make(look: str, seed: int, unit: int, size: int) -> Sensor:
    family: np.random.Generator = rng_for(0, "sensor family", VERSION, look)
    rng: np.random.Generator = rng_for(seed, "world", VERSION, "sensor", look, unit)
    around = lambda value, spread: value * math.exp(rng.normal(0.0, spread))  # noqa: E731
    turn = -2.25 + family.normal(0.0, 0.2)
    azimuth = [turn + k * 2.0 * math.pi / 3.0 + family.normal(0.0, 0.08) + rng.normal(0.0, 0.05) for k in range(3)]
    if look == "gelsight":  # grey-pink middle, coloured corners
        mixed, gain, fall, ambient = around(0.12, 0.12), around(0.45, 0.05), around(0.46, 0.10), around(0.14, 0.08)
        elevation = np.deg2rad(family.uniform(24.0, 36.0, 3))
    else:  # darker, with stronger colour lobes
        mixed, gain, fall, ambient = around(0.13, 0.15), around(0.43, 0.06), around(0.60, 0.10), around(0.07, 0.10)
        elevation = np.deg2rad(family.uniform(26.0, 42.0, 3))
    pure = np.eye(3)[[1, 2, 0]]  # the lights are green, blue, red
    colour = (pure * (1.0 - mixed) + mixed) * np.exp(rng.normal(0.0, 0.05, (3, 1))) * gain
    light = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1)
    y, x = grid(DRAWN)
    along = [math.cos(a) * x + math.sin(a) * y for a in azimuth]
    field = np.stack([np.clip(1.0 + fall * q + 0.35 * fall * fall * q * q, 0.08, None) for q in along])
    square = x * x + y * y
    veil = (1.0 - rng.uniform(0.03, 0.16) * square) * _dirt(rng)
    texture = ndimage.gaussian_filter(rng.standard_normal((DRAWN, DRAWN), dtype=np.float32), 0.12 / (PATCH_MM / DRAWN))
    texture *= 0.0024 / float(texture.std())
    dome = square * ((PATCH_MM / 2.0) ** 2 / (2.0 * rng.uniform(26.0, 60.0)))
    ink = _markers(rng) if look == "gelsight" else None
    down = lambda a: resample(f32(a), size)  # noqa: E731
    return Sensor(
        look, unit, size, PATCH_MM / size, np.stack([down(f) for f in field]), f32(colour), f32(light),
        f32(ambient * rng.uniform(0.9, 1.1, 3)), down(veil), down(texture), down(dome), None if ink is None else down(ink),
        rng.uniform(0.9, 1.1), rng.uniform(0.004, 0.010),
    )  # fmt: skip


def _dirt(rng: np.random.Generator) -> Array:
    """Uneven coating, specks and scratches as a factor around 1, on the drawn grid."""
    y, x = grid(DRAWN)
    low = ndimage.gaussian_filter(rng.standard_normal((DRAWN, DRAWN), dtype=np.float32), DRAWN / 7, mode="reflect")
    fine = ndimage.gaussian_filter(rng.standard_normal((DRAWN, DRAWN), dtype=np.float32), 1.6)
    dirt = 1.0 + low * (0.018 / float(low.std())) + fine * (0.008 / float(fine.std()))
    for _ in range(int(rng.integers(2, 9))):
        cx, cy, width = rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), rng.uniform(0.008, 0.03)
        dirt -= rng.uniform(0.03, 0.18) * np.exp(((x - cx) ** 2 + (y - cy) ** 2) * (-0.5 / width**2))
    for _ in range(int(rng.integers(0, 4))):
        angle, offset, middle = rng.uniform(0.0, math.pi), rng.uniform(-1.0, 1.0), rng.uniform(-0.5, 0.5)
        across = (x * math.cos(angle) + y * math.sin(angle) - offset) * (1.0 / 0.012)
        along = y * math.cos(angle) - x * math.sin(angle) - middle
        dirt += rng.uniform(0.01, 0.05) * np.exp(-across * across) * (np.abs(along) < 0.35)
    return dirt


def _markers(rng: np.random.Generator) -> Array:
    """Ink dots on a jittered grid of 7 x 7 over the pad (one more row on each side), on the drawn grid."""
    ink = np.zeros((DRAWN, DRAWN), np.float32)
    y, x = grid(DRAWN)
    step = 2.0 / 7.0
    for i in range(-1, 8):
        for j in range(-1, 8):
            cy, cx = -1.0 + (i + 0.5) * step + rng.normal(0.0, 0.023), -1.0 + (j + 0.5) * step + rng.normal(0.0, 0.023)
            radius, aspect, dark = rng.uniform(0.13, 0.25) * 0.164, rng.uniform(0.85, 1.2), rng.uniform(0.75, 0.95)
            low_y, low_x = (int(np.searchsorted(g.ravel(), c - 0.1)) for g, c in ((y, cy), (x, cx)))
            part = np.s_[low_y : low_y + 26, low_x : low_x + 26]
            if ink[part].size:
                distance = np.hypot((x[:, part[1]] - cx) * (1.0 / aspect), y[part[0]] - cy)
                ink[part] = np.maximum(ink[part], smoothstep(distance, radius + 0.012, radius - 0.008) * dark)
    return ink


def solve_approach(gap: Array, load: float) -> float:
    """The d for which mean(max(gap + d, 0)) equals ``load`` (> 0), in mm.

    With the gaps sorted downwards and their running sums S_k, the k largest touch if d_k = (N load - S_k) / k lifts gap k but not gap k + 1.
    """
    ordered = np.sort(gap, axis=None)[::-1].astype(np.float64)
    d = (load * ordered.size - np.cumsum(ordered)) / np.arange(1, ordered.size + 1)
    consistent = np.append(ordered[1:] + d[:-1] <= 0.0, True)
    return float(d[int(np.argmax(consistent))])


def gap_of(thing: Thing, sensor: Sensor, relief: Array, load: float, tilt: tuple[float, float]) -> Array:
    """Relief of the object minus the gel's dome, tilted and curved, in mm, shape (n, n); soft objects flatten under the load."""
    y, x = grid(sensor.size)
    half = PATCH_MM / 2.0
    if thing.surface.softness:
        relief = relief * (1.0 - 0.5 * thing.surface.softness * min(1.0, load / 0.3))
    return relief - sensor.dome - (x * (half * tilt[0]) + y * (half * tilt[1])) - x * x * (thing.curvature / 2.0 * half * half)


def press(sensor: Sensor, gap: Array, load: float) -> tuple[Array, Array]:
    """Presses the gel until the mean penetration equals ``load`` mm.

    Returns:
        Membrane displacement in mm and the contact mask, both of shape (n, n).
    """
    penetration = gap + solve_approach(gap, load)
    contact = penetration > 0.0
    held = np.tanh(np.maximum(penetration, 0.0) * (1.0 / GEL_MM)) * GEL_MM
    membrane = held
    for blur in RELAX_MM:
        membrane = np.where(contact, held, smooth(membrane, blur / sensor.px))
    return smooth(membrane, OPTICAL_MM / sensor.px), contact


def marker_shift(sensor: Sensor, membrane: Array, shear: tuple[float, float]) -> tuple[Array, Array]:
    """Displacement (dy, dx) of the markers in pixels: dragged by ``shear`` (mm per mm of depth), pushed apart where the gel is deep."""
    depth = smooth(np.minimum(membrane, 1.0), sensor.size / 10)
    slope_y, slope_x = np.gradient(depth, sensor.px)
    unit = 1.0 / sensor.px
    return f32(depth * (shear[1] * unit) - slope_y * (0.107 * unit)), f32(depth * (shear[0] * unit) - slope_x * (0.107 * unit))


def shade(sensor: Sensor, membrane: Array, gain: Array, shift: tuple[Array, Array] | None = None) -> Array:
    """The image of the gel, shape (n, n, 3), in [0, 1.2]^gamma, without noise.

    Args:
        sensor: the gel unit.
        membrane: displacement in mm, (n, n); zeros give the background image.
        gain: white balance of the recording, RGB, (3,).
        shift: displacement of the markers in pixels, or None.
    """
    slope_y, slope_x = np.gradient(membrane + sensor.texture, sensor.px)
    slope_y, slope_x = f32(slope_y), f32(slope_x)
    upright = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    light = [
        np.maximum((slope_x * float(lx) + slope_y * float(ly) + float(lz)) * upright, 0.0) * field
        for (lx, ly, lz), field in zip(sensor.light, sensor.field, strict=True)
    ]
    veil = sensor.veil
    if sensor.ink is not None:
        ink = sensor.ink
        if shift is not None:
            row, column = np.mgrid[: sensor.size, : sensor.size].astype(np.float32)
            ink = ndimage.map_coordinates(ink, [row - shift[0], column - shift[1]], order=1, mode="nearest")
        veil = veil * (1.0 - 0.88 * ink)
    image = np.empty((sensor.size, sensor.size, 3), np.float32)
    for c in range(3):
        total = sum(light[k] * float(sensor.colour[k, c]) for k in range(3)) + float(sensor.ambient[c])
        image[..., c] = total * veil * float(gain[c])
    return np.clip(image, 0.0, 1.2) ** sensor.gamma
