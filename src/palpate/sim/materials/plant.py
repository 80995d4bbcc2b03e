"""Materials that grew: wood, tree bark, grass, plants."""

from __future__ import annotations

import math

import numpy as np

from palpate.sim.arrays import blend, f32, hsv, smoothstep, tint
from palpate.sim.materials.surface import Surface, of_top, rising
from palpate.sim.tile import Tile

#: Roughness of each kind.
_WOOD = {"polished": 0.25, "planed": 0.6, "sawn": 1.3, "boards": 0.6}


def wood(tile: Tile) -> Surface:
    """Draw polished, planed or sawn wood, or boards with grooves."""
    kind, draw = tile.pick(*tuple(_WOOD)[: 4 - tile.whole]), tile.draw
    angle = draw(-0.15, 0.15) + tile.pick(0.0, math.pi / 2.0)
    light = hsv(draw(0.05, 0.10), draw(0.35, 0.65), draw(0.3, 0.8))
    dark = light * draw(0.45, 0.75)
    ring = np.sin(tile.noise(2.5, 24.0, 2.2, 12.0, angle) * draw(4.0, 9.0))
    fine = tile.noise(0.25, 2.5, 1.2, 30.0, angle)
    pores = np.maximum(tile.noise(0.25, 1.5, 0.6, 22.0, angle) - 1.1, 0.0)
    height = (ring * 0.018 + fine * 0.028 - pores * 0.07) * (_WOOD[kind] * draw(0.9, 1.5))
    if kind == "boards":
        groove = smoothstep(tile.lines(draw(12.0, 24.0), angle + math.pi / 2.0), 0.7, 0.3)
        height, dark = height - 0.35 * groove, dark * 0.9
    grain = blend(light, dark, 0.5 + 0.45 * ring + 0.22 * fine)
    albedo = tint(grain, 1.0 - 0.35 * np.clip(pores, 0.0, 1.0))
    gloss = 0.3 if kind == "polished" else 0.05
    return Surface(height, albedo, kind, gloss=gloss, softness=0.05)


def tree(tile: Tile) -> Surface:
    """Draw furrowed, plated or flaky bark; some with moss, which shows but is hardly felt."""
    kind, draw = tile.pick("furrowed", "plated", "flaky"), tile.draw
    angle = math.pi / 2.0 + tile.rng.normal(0.0, 0.1)
    color = hsv(draw(0.05, 0.11), draw(0.15, 0.5), draw(0.25, 0.6))
    if kind == "furrowed":
        height = np.minimum(np.abs(tile.noise(1.2, 14.0, 2.2, 9.0, angle)), 1.2) * 1.3
    elif kind == "plated":
        cells = tile.cells(draw(6.0, 10.0))
        plate = smoothstep(tile.warp(cells.far - cells.near, 1.2), 0.0, 2.2)
        height = plate * 1.3 + cells.each(0.15, 0.1) * plate
    else:
        flakes = np.maximum(tile.ridged(0.8, 6.0, 1.6, 0.12, angle), -0.5)
        height = flakes * 0.25 + tile.noise(4.0, 20.0, 2.0) * 0.2
    height += tile.noise(0.3, 3.0, 1.2, 3.0, angle) * 0.12
    tone = 1.0 + 0.12 * tile.noise(0.4, 6.0, 1.2)
    albedo = tint(blend(color * 0.35, color * 1.15, rising(height)), tone)
    if tile.flip(0.35):
        moss = smoothstep(tile.noise(1.0, 15.0, 2.0), 0.8, 1.6)
        albedo = blend(albedo, hsv(0.22, 0.5, 0.45), moss)
    return Surface(height, albedo, kind, gloss=0.02, softness=0.08)


def grass(tile: Tile) -> Surface:
    """Draw broad, thin, or tangled blades."""
    kind, draw = tile.pick("broad", "thin", "tangled"), tile.draw
    width = draw(0.9, 1.5) if kind == "thin" else draw(1.6, 2.6)
    spread = 2.0 if kind == "tangled" else tile.pick(0.25, 0.7)
    angle = tile.angle()
    count, length, height = int(tile.rng.integers(170, 420)), draw(20.0, 42.0), draw(0.9, 1.6)
    blades = tile.strokes(count, length, width, angle=angle, spread=spread, height=height, bend=0.5)
    rise = of_top(blades)
    color = hsv(draw(0.17, 0.33), draw(0.45, 0.8), draw(0.35, 0.75))
    tone = (0.5 + 0.6 * rise) * (1.0 + 0.2 * tile.noise(1.0, 8.0, 1.5, 10.0, angle))
    albedo = tint(blend(f32([0.16, 0.11, 0.06]), color, smoothstep(rise, 0.05, 0.5)), tone)
    return Surface(blades, albedo, kind, gloss=0.08, softness=0.5)


def plants(tile: Tile) -> Surface:
    """Draw a leaf from below (raised veins) or above (sunken veins), or moss."""
    kind, draw = tile.pick("raised veins", "sunken veins", "moss"), tile.draw
    color = hsv(draw(0.2, 0.38), draw(0.4, 0.8), draw(0.3, 0.7))
    if kind == "moss":
        height = tile.strokes(520, 5.0, 0.8, spread=3.0, height=1.1, bend=0.8)
        albedo = blend(color * 0.25, color, rising(height))
    else:
        angle, step = tile.angle(), draw(4.0, 8.0)
        middle = tile.lines(32.0, angle)
        rib = smoothstep(tile.warp(middle, 0.6), 0.9, 0.2)
        phase = tile.wave(step, angle + math.pi / 2.0) + middle * (0.7 * math.pi / step)
        vein = np.maximum(rib, 0.6 * smoothstep(np.sin(phase), 0.8, 1.0))
        cell = tile.cells(draw(1.2, 2.5)).walls(0.5)
        sign = 1.0 if kind == "raised veins" else -1.0
        height = vein * (sign * draw(0.3, 0.6)) + cell * 0.09 + tile.noise(6.0, 30.0, 3.0) * 0.12
        albedo = blend(tint(color, 0.8 + 0.2 * cell), hsv(0.22, 0.4, 0.8), vein * 0.7)
    albedo = tint(albedo, 1.0 + 0.08 * tile.noise(1.0, 12.0))
    return Surface(height, albedo, kind, gloss=draw(0.1, 0.35), softness=0.6)
