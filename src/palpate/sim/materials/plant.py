"""Materials that grew: wood, tree bark, grass, plants."""

from __future__ import annotations

import math

import numpy as np

from palpate.sim.arrays import Array, blend, f32, hsv, smoothstep, tint
from palpate.sim.materials.surface import Surface, flip, pick
from palpate.sim.tile import Tile


def _rising(height: Array) -> Array:
    """Heights scaled to [0, 1]."""
    low, high = float(height.min()), float(height.max())
    return (height - low) * (1.0 / (high - low + 1e-9))


def wood(tile: Tile, rng: np.random.Generator) -> Surface:
    """Polished, planed, sawn, or boards with grooves."""
    kind = pick(rng, "polished", "planed", "sawn", "boards")
    angle = rng.uniform(-0.15, 0.15) + math.pi / 2.0 * int(rng.integers(2))
    light = hsv(rng.uniform(0.05, 0.10), rng.uniform(0.35, 0.65), rng.uniform(0.3, 0.8))
    dark = light * rng.uniform(0.45, 0.75)
    ring = np.sin(tile.noise(2.5, 24.0, 2.2, 12.0, angle) * rng.uniform(4.0, 9.0))
    fine = tile.noise(0.25, 2.5, 1.2, 30.0, angle)
    pores = np.maximum(tile.noise(0.25, 1.5, 0.6, 22.0, angle) - 1.1, 0.0)
    rough, first = {
        "polished": (0.25, "polished"),
        "planed": (0.6, "smooth"),
        "sawn": (1.3, "coarse"),
        "boards": (0.6, "grooved"),
    }[kind]
    height = (ring * 0.018 + fine * 0.028 - pores * 0.07) * (rough * rng.uniform(0.9, 1.5))
    if kind == "boards":
        groove = smoothstep(tile.lines(rng.uniform(12.0, 24.0), angle + math.pi / 2.0)[0], 0.7, 0.3)
        height, dark = height - 0.35 * groove, dark * 0.9
    albedo = tint(
        blend(light, dark, 0.5 + 0.45 * ring + 0.22 * fine), 1.0 - 0.35 * np.clip(pores, 0.0, 1.0)
    )
    gloss = 0.3 if kind == "polished" else 0.05
    return Surface(
        height, albedo, kind, (first, "straight-grained", "firm"), gloss=gloss, softness=0.05
    )


def tree(tile: Tile, rng: np.random.Generator) -> Surface:
    """Bark: furrowed, plated, or flaky with bands; some with moss, which shows but is hardly
    felt.
    """
    kind = pick(rng, "furrowed", "plated", "flaky")
    angle = math.pi / 2.0 + rng.normal(0.0, 0.1)
    color = hsv(rng.uniform(0.05, 0.11), rng.uniform(0.15, 0.5), rng.uniform(0.25, 0.6))
    if kind == "furrowed":
        height = np.minimum(np.abs(tile.noise(1.2, 14.0, 2.2, 9.0, angle)), 1.2) * 1.3
        first = "deeply furrowed"
    elif kind == "plated":
        cells = tile.cells(rng.uniform(6.0, 10.0))
        plate = smoothstep(tile.warp(cells.far - cells.near, 1.2), 0.0, 2.2)
        height = plate * 1.3 + cells.each(rng, 0.15, 0.1) * plate
        first = "cracked"
    else:
        height = (
            np.maximum(tile.ridged(0.8, 6.0, 1.6, 0.12, angle), -0.5) * 0.25
            + tile.noise(4.0, 20.0, 2.0) * 0.2
        )
        first = "flaky"
    height = height + tile.noise(0.3, 3.0, 1.2, 3.0, angle) * 0.12
    albedo = tint(
        blend(color * 0.35, color * 1.15, _rising(height)), 1.0 + 0.12 * tile.noise(0.4, 6.0, 1.2)
    )
    if flip(rng, 0.35):
        albedo = blend(
            albedo, hsv(0.22, 0.5, 0.45), smoothstep(tile.noise(1.0, 15.0, 2.0), 0.8, 1.6)
        )
    return Surface(height, albedo, kind, (first, "rugged", "rough"), gloss=0.02, softness=0.08)


def grass(tile: Tile, rng: np.random.Generator) -> Surface:
    """Broad blades, thin blades, or tangled blades."""
    kind = pick(rng, "broad", "thin", "tangled")
    width = rng.uniform(0.9, 1.5) if kind == "thin" else rng.uniform(1.6, 2.6)
    spread = 2.0 if kind == "tangled" else (0.25, 0.7)[int(rng.integers(2))]
    angle = rng.uniform(0.0, math.pi)
    blades = tile.strokes(
        int(rng.integers(170, 420)),
        rng.uniform(20.0, 42.0),
        width,
        angle=angle,
        spread=spread,
        height=rng.uniform(0.9, 1.6),
        bend=0.5,
    )
    rise = np.clip(blades * (1.0 / float(blades.max())), 0.0, 1.0)
    color = hsv(rng.uniform(0.17, 0.33), rng.uniform(0.45, 0.8), rng.uniform(0.35, 0.75))
    tone = (0.5 + 0.6 * rise) * (1.0 + 0.2 * tile.noise(1.0, 8.0, 1.5, 10.0, angle))
    albedo = tint(blend(f32([0.16, 0.11, 0.06]), color, smoothstep(rise, 0.05, 0.5)), tone)
    words = {
        "broad": ("bladed", "layered", "soft"),
        "thin": ("thin-bladed", "fine", "soft"),
        "tangled": ("bladed", "tangled", "soft"),
    }[kind]
    return Surface(blades, albedo, kind, words, gloss=0.08, softness=0.5)


def plants(tile: Tile, rng: np.random.Generator) -> Surface:
    """A leaf from below (raised veins) or above (sunken veins), or moss."""
    kind = pick(rng, "raised veins", "sunken veins", "moss")
    color = hsv(rng.uniform(0.2, 0.38), rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.7))
    if kind == "moss":
        height = tile.strokes(520, 5.0, 0.8, angle=0.0, spread=3.0, height=1.1, bend=0.8)
        albedo = blend(color * 0.25, color, _rising(height))
        words, noun = ("tufted", "cushioned", "pliable"), "moss"
    else:
        angle, step = rng.uniform(0.0, math.pi), rng.uniform(4.0, 8.0)
        middle, _ = tile.lines(32.0, angle)
        rib = smoothstep(tile.warp(middle, 0.6), 0.9, 0.2)
        side = smoothstep(
            np.sin(tile.wave(step, angle + math.pi / 2.0) + middle * (0.7 * math.pi / step)),
            0.8,
            1.0,
        )
        cell = tile.cells(rng.uniform(1.2, 2.5)).walls(0.5)
        vein = np.maximum(rib, 0.6 * side)
        sign = 1.0 if kind == "raised veins" else -1.0
        height = (
            vein * (sign * rng.uniform(0.3, 0.6)) + cell * 0.09 + tile.noise(6.0, 30.0, 3.0) * 0.12
        )
        albedo = blend(tint(color, 0.8 + 0.2 * cell), hsv(0.22, 0.4, 0.8), vein * 0.7)
        words, noun = ("veined" if sign > 0 else "furrowed", "waxy", "pliable"), "a leaf"
    albedo = tint(albedo, 1.0 + 0.08 * tile.noise(1.0, 12.0))
    return Surface(height, albedo, kind, words, rng.uniform(0.1, 0.35), 0.6, noun)
