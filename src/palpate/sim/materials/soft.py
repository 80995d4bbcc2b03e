"""Soft goods: leather and fabrics."""

from __future__ import annotations

import math

import numpy as np

from palpate.sim.arrays import Array, blend, hsv, smoothstep, tint
from palpate.sim.materials.surface import Surface, of_top
from palpate.sim.tile import Tile


def leather(tile: Tile) -> Surface:
    """Draw pebbled, fine-grained, or stitched leather."""
    kind, draw = tile.pick("pebbled", "pebbled", "fine", "fine", "stitched"), tile.draw
    size = draw(0.8, 1.5) if kind == "fine" else draw(1.5, 2.6)
    cells = tile.cells(size)
    gap = tile.warp(cells.far - cells.near, 0.15)
    pebble = smoothstep(gap * (1.0 / size), 0.0, draw(0.2, 0.4))
    folds = np.maximum(tile.ridged(2.0, 14.0, 2.2, 3.0, tile.angle()) - 1.0, 0.0)
    height = pebble * draw(0.05, 0.14) + tile.noise(4.0, 20.0, 2.5) * 0.06 - 0.08 * folds
    if tile.flip(0.7):
        color = hsv(draw(0.02, 0.1), draw(0.3, 0.75), draw(0.12, 0.6))
    else:
        color = hsv(draw(), draw(0.0, 0.7), draw(0.08, 0.7))
    albedo = tint(color, (0.72 + 0.28 * pebble) * (1.0 + 0.06 * tile.noise(2.0, 20.0)))
    if kind == "stitched":
        seam = smoothstep(tile.lines(16.0, 0.0), 0.8, 0.3)
        stitch = seam * smoothstep(np.sin(tile.wave(2.6, math.pi / 2.0)), -0.3, 0.2)
        height, albedo = height + stitch * 0.3, blend(albedo, hsv(0.12, 0.2, 0.85), stitch)
    return Surface(height, albedo, kind, gloss=draw(0.15, 0.45), softness=0.35)


def _weave(tile: Tile, kind: str, step: float, wobble: float) -> Array:
    """Draw a woven or knitted relief in about [0, 1] with threads ``step`` mm apart."""
    angle = tile.pick(0.0, math.pi / 4.0)
    u, v = tile.waves(step, angle, wobble * tile.draw(0.05, 0.35))
    if kind == "plain":
        over = smoothstep(np.sin(u) * np.sin(v), -0.35, 0.35)
        return over * np.abs(np.sin(u)) ** 0.7 + (1.0 - over) * np.abs(np.sin(v)) ** 0.7
    if kind == "twill":
        rib = 0.5 + 0.5 * np.sin(u + v)
        return 0.6 * rib**0.8 + 0.4 * (0.5 + 0.5 * np.sin(2.0 * u)) * rib
    if kind == "knit":
        fold = np.abs((u * (1.0 / math.pi)) % 2.0 - 1.0) * math.pi
        return 0.6 * (0.5 + 0.5 * np.sin(2.0 * v + 2.2 * fold)) + 0.5 * np.abs(np.sin(u))
    if kind == "rib":
        return np.abs(np.sin(u)) ** 0.8 + 0.15 * (0.5 + 0.5 * np.sin(3.0 * v))
    return smoothstep(np.cos(u) + np.cos(v), 0.9, -0.3)  # mesh


_SYNTHETIC = ("twill", "knit", "mesh", "rib", "plain")


def synthetic_fabric(tile: Tile) -> Surface:
    """Draw a fabric of fine even threads; a third of them striped, which cannot be felt."""
    kind, draw = tile.pick(*_SYNTHETIC), tile.draw
    relief = _weave(tile, kind, draw(1.8, 3.6) if kind == "mesh" else draw(1.0, 2.2), 1.0)
    height = relief * draw(0.12, 0.28) + tile.noise(6.0, 30.0, 3.0) * 0.12
    tone = 0.55 + 0.45 * of_top(relief)
    albedo = tint(hsv(draw(), draw(0.1, 1.0), draw(0.15, 0.9)), tone)
    if tile.flip(0.35):
        stripe = smoothstep(np.sin(tile.wave(draw(8.0, 20.0), tile.angle())), -0.1, 0.1)
        albedo = blend(albedo, tint(hsv(draw(), 0.7, 0.7), tone), stripe)
    return Surface(height, albedo, kind, gloss=draw(0.1, 0.35), softness=0.6)


def natural_fabric(tile: Tile) -> Surface:
    """Draw coarse plain weave, knit, or corded fabric of uneven fuzzy threads."""
    kind, draw = tile.pick("plain", "plain", "knit", "rib"), tile.draw
    relief = _weave(tile, kind, draw(1.8, 4.2), 2.5)
    fuzz = tile.strokes(260, 5.0, 0.3, spread=3.0, height=0.16)
    height = relief * draw(0.2, 0.45) + fuzz * draw(0.3, 1.0) + tile.noise(5.0, 30.0, 3.0) * 0.15
    if tile.flip(0.6):
        color = hsv(draw(0.06, 0.14), draw(0.05, 0.4), draw(0.45, 0.95))
    else:
        color = hsv(draw(), draw(0.2, 0.7), draw(0.2, 0.8))
    tone = 0.5 + 0.5 * of_top(relief)
    albedo = tint(color, tone * (1.0 + 0.1 * tile.noise(0.4, 6.0, 1.0)))
    return Surface(height, albedo, kind, gloss=0.02, softness=0.75)
