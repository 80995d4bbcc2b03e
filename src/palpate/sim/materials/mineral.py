"""Materials of stone and earth: concrete, brick, tile, rock, gravel, sand, soil."""

from __future__ import annotations

import math

import numpy as np

from palpate.sim.arrays import blend, f32, hsv, smoothstep, tint
from palpate.sim.materials.surface import Surface
from palpate.sim.tile import TILE_MM, Tile


def concrete(tile: Tile) -> Surface:
    """Draw exposed aggregate, concrete cast with air holes, or broomed concrete."""
    kind, draw = tile.pick("aggregate", "cast", "broomed"), tile.draw
    gray = draw(0.35, 0.72)
    base = f32([gray, gray * draw(0.95, 1.0), gray * draw(0.86, 0.99)])
    height = tile.noise(0.3, draw(2.0, 6.0), 1.6) * draw(0.06, 0.20)
    if kind == "aggregate":
        stones, cells = tile.grains(draw(2.2, 4.5), 0.4, draw(0.4, 0.8))
        height = height * 0.6 + stones * draw(0.25, 0.5)
        factor = 1.0 + cells.each(0.0, 0.12) * (stones > 0.2)
    elif kind == "cast":
        cells = tile.cells(draw(3.0, 6.0))
        hole = smoothstep(cells.near, draw(0.4, 0.9), 0.1) * cells.keep(0.5)
        height, factor = height * 0.8 - hole * 0.5, 1.0 - 0.35 * hole
    else:
        lines = tile.noise(0.5, 3.5, 1.2, 14.0, tile.angle())
        height, factor = height * 0.5 + lines * draw(0.1, 0.2), 1.0 + 0.05 * lines
    albedo = tint(base, factor * (1.0 + 0.07 * tile.noise(0.3, 20.0, 1.6)))
    return Surface(height, albedo, kind, gloss=0.03)


def brick(tile: Tile) -> Surface:
    """Draw laid bricks with mortar joints, the face of a single brick, or a wire-cut face."""
    kind = tile.pick(*("laid", "laid", "face", "wire-cut")[2 * tile.whole :])
    draw = tile.draw
    clay = hsv(draw(0.0, 0.06), draw(0.35, 0.7), draw(0.4, 0.75))
    mortar = f32([0.72, 0.7, 0.66]) * draw(0.7, 1.1)
    grit = tile.noise(0.3, 4.0, 1.3)
    pits = smoothstep(tile.noise(0.5, 2.0, 0.8), 1.2, 2.0)
    relief = grit * draw(0.05, 0.12) - pits * 0.3
    solid = tile.ones()
    if kind == "laid":
        course, length = TILE_MM / 4.0, TILE_MM / 2.0
        y = tile.y % course
        x = (tile.x + np.floor(tile.y / course) % 2.0 * (length / 2.0)) % length
        edge = np.minimum(np.minimum(y, course - y), np.minimum(x, length - x))
        solid = smoothstep(edge + tile.noise(2.0, 10.0) * 0.2, 0.9, 2.4)
    elif kind == "wire-cut":
        cuts = tile.noise(0.5, 5.0, 1.0, 20.0, tile.pick(0.0, math.pi / 2.0))
        relief += cuts * draw(0.08, 0.16)
    height = solid * (draw(0.8, 1.6) + relief)
    height += (1.0 - solid) * tile.noise(0.3, 1.5, 0.8) * 0.12
    tone = (1.0 + 0.16 * tile.noise(1.0, 20.0)) * (1.0 + 0.10 * grit) * (1.0 - 0.25 * pits)
    joint = tint(mortar, 1.0 + 0.06 * tile.noise(0.3, 2.0))
    return Surface(height, blend(joint, tint(clay, tone), solid), kind, gloss=0.02)


def ceramic_tile(tile: Tile) -> Surface:
    """Draw glazed tiles, textured (anti-slip) tiles, or small mosaic."""
    kind = tile.pick(*("glazed", "glazed", "textured", "mosaic")[: 4 - tile.whole])
    draw = tile.draw
    color = hsv(draw(), tile.pick(0.05, 0.12, 0.5), draw(0.5, 0.95))
    side = TILE_MM / (5 if kind == "mosaic" else int(tile.rng.integers(2, 4)))
    gap = draw(0.6, 1.4)
    side = 2 * TILE_MM if tile.whole else side
    body = tile.ones() if tile.whole else smoothstep(tile.squares(side), gap * 0.6, gap * 1.6)
    cell = (np.floor(tile.y / side) * 7.0 + np.floor(tile.x / side)).astype(np.intp) % 64
    shade = 1.0 + f32(0.08 * tile.rng.standard_normal(64))[cell]
    relief = tile.noise(5.0, 30.0, 3.0) * 0.02
    if kind == "textured":
        relief += smoothstep(tile.noise(0.8, 4.0, 1.2), -0.2, 0.6) * draw(0.04, 0.08)
    marble = tile.ridged(1.0, 25.0, 2.4) * tile.pick(0.0, 0.06, 0.12)
    height = body * (draw(0.4, 0.9) + relief) + (1.0 - body) * tile.noise(0.3, 1.2, 0.6) * 0.05
    grout = f32([0.6, 0.59, 0.57]) * draw(0.5, 1.3)
    gloss = draw(0.1, 0.3) if kind == "textured" else draw(0.4, 0.9)
    albedo = blend(grout, tint(color, shade + marble), body)
    return Surface(height, albedo, kind, gloss=gloss)


def rock(tile: Tile) -> Surface:
    """Draw craggy, layered, or weathered rock."""
    kind, draw = tile.pick("craggy", "layered", "weathered"), tile.draw
    color = hsv(draw(0.05, 0.6), draw(0.0, 0.18), draw(0.3, 0.7))
    angle = tile.angle()
    if kind == "craggy":
        form = tile.ridged(0.8, 25.0, 2.2)
        height = form * 0.45
    elif kind == "layered":
        form = tile.noise(0.7, 25.0, 2.4, 7.0, angle)
        height = np.round(form * 3.0 + 0.3 * tile.noise(0.5, 3.0)) * 0.15 + form * 0.1
    else:
        form = tile.noise(1.0, 25.0, 2.6)
        height = form * 0.55
    grit = tile.noise(0.3, 1.5, 0.6)
    specks = smoothstep(tile.noise(0.4, 1.6, 0.3), 1.0, 1.6) * (-0.5 if tile.flip(0.5) else 0.5)
    albedo = tint(color, (1.0 + 0.16 * form + 0.08 * grit) * (1.0 + specks))
    return Surface(height + grit * draw(0.02, 0.08), albedo, kind, gloss=0.04)


def gravel(tile: Tile) -> Surface:
    """Draw rounded pebbles or crushed stone."""
    kind, draw = tile.pick("rounded", "crushed"), tile.draw
    size = draw(5.0, 11.0)
    stones, cells = tile.grains(size, 0.35, edge=0.75 if kind == "rounded" else 0.35)
    base = hsv(draw(0.03, 0.62), draw(0.02, 0.2), draw(0.4, 0.7))
    colors = f32(base * draw(0.55, 1.4, (cells.count, 1)) * draw(0.9, 1.1, (cells.count, 3)))
    height = stones * (size * 0.28)
    if kind == "crushed":
        height += tile.ridged(0.8, 8.0, 1.8) * 0.12
    else:
        height += tile.noise(0.4, 3.0, 1.2) * 0.04
    tone = (1.0 + 0.1 * tile.noise(0.3, 3.0)) * smoothstep(stones, -0.05, 0.5)
    return Surface(height, tint(colors[cells.index], tone), kind, gloss=0.05, softness=0.1)


def sand(tile: Tile) -> Surface:
    """Draw dry, rippled, or packed sand."""
    kind, draw = tile.pick("dry", "rippled", "packed"), tile.draw
    size = draw(0.6, 1.1)
    fine, cells = tile.grains(size, 0.5)
    coarse = tile.grains(size * 1.8, 0.6, 0.25)[0]
    height = fine * (size * 0.45) + coarse * (size * 0.5)
    height += tile.noise(3.0, 25.0, 2.4) * draw(0.05, 0.2)
    softness = 0.4
    if kind == "rippled":
        ripples = np.sin(tile.wave(draw(10.0, 20.0), tile.angle(), 0.5))
        height = height * 0.8 + ripples * draw(0.5, 0.8)
    elif kind == "packed":
        height, softness = height * 0.5, 0.15
    color = hsv(draw(0.07, 0.13), draw(0.15, 0.45), draw(0.55, 0.9))
    speckle = np.clip(cells.each(1.0, 0.25), 0.4, 1.6)
    albedo = tint(color, speckle * (1.0 + 0.05 * tile.noise(3.0, 30.0)))
    return Surface(height, albedo, kind, gloss=0.03, softness=softness)


def soil(tile: Tile) -> Surface:
    """Draw crumbs, clods, or soil with plant litter."""
    kind, draw = tile.pick("crumbs", "clods", "litter"), tile.draw
    color = hsv(draw(0.04, 0.1), draw(0.3, 0.6), draw(0.15, 0.45))
    size = draw(4.0, 7.0) if kind == "clods" else draw(2.2, 3.5)
    clods = tile.grains(size, 0.6, 0.6)[0]
    crumbs = tile.grains(draw(0.8, 1.6), 0.5)[0]
    height = tile.noise(0.5, 9.0, 2.0) * draw(0.2, 0.4) + clods * draw(0.3, 0.7) + crumbs * 0.2
    tone = (1.0 + 0.22 * tile.noise(0.3, 6.0, 1.2)) * (0.75 + 0.25 * np.clip(clods, 0.0, 1.0))
    albedo = tint(color, tone)
    if kind == "litter":
        stalks = tile.strokes(25, 12.0, 0.6, spread=3.0, height=0.6)
        height = np.maximum(height, float(height.mean()) + stalks)
        albedo = blend(albedo, hsv(0.11, 0.35, 0.6), smoothstep(stalks, 0.05, 0.2))
    return Surface(height, albedo, kind, gloss=0.01, softness=0.55)
