"""Materials of stone and earth: concrete, brick, tile, rock, gravel, sand, soil."""

from __future__ import annotations

import math

import numpy as np

from palpate.sim.arrays import blend, f32, hsv, smoothstep, tint
from palpate.sim.materials.surface import Surface, flip, pick
from palpate.sim.tile import TILE_MM, Tile


def concrete(tile: Tile, rng: np.random.Generator) -> Surface:
    """Exposed aggregate, cast with air holes, or broomed."""
    kind = pick(rng, "aggregate", "cast", "broomed")
    grey = rng.uniform(0.35, 0.72)
    base = f32([grey, grey * rng.uniform(0.95, 1.0), grey * rng.uniform(0.86, 0.99)])
    height = tile.noise(0.3, rng.uniform(2.0, 6.0), 1.6) * rng.uniform(0.06, 0.20)
    if kind == "aggregate":
        stones, cells = tile.grains(rng.uniform(2.2, 4.5), 0.4, rng.uniform(0.4, 0.8))
        height = height * 0.6 + stones * rng.uniform(0.25, 0.5)
        factor = 1.0 + cells.each(rng, 0.0, 0.12) * (stones > 0.2)
        words = ("pebbly", "coarse", "hard")
    elif kind == "cast":
        cells = tile.cells(rng.uniform(3.0, 6.0))
        hole = smoothstep(cells.near, rng.uniform(0.4, 0.9), 0.1) * cells.keep(rng, 0.5)
        height = height * 0.8 - hole * 0.5
        factor = 1.0 - 0.35 * hole
        words = ("pitted", "gritty", "hard")
    else:
        lines = tile.noise(0.5, 3.5, 1.2, 14.0, rng.uniform(0.0, math.pi))
        height = height * 0.5 + lines * rng.uniform(0.1, 0.2)
        factor = 1.0 + 0.05 * lines
        words = ("scored", "rough", "hard")
    return Surface(
        height,
        tint(base, factor * (1.0 + 0.07 * tile.noise(0.3, 20.0, 1.6))),
        kind,
        words,
        gloss=0.03,
    )


def brick(tile: Tile, rng: np.random.Generator) -> Surface:
    """Laid bricks with mortar joints, the face of one brick, or a wire-cut face."""
    kind = pick(rng, "laid", "laid", "face", "wire-cut")
    clay = hsv(rng.uniform(0.0, 0.06), rng.uniform(0.35, 0.7), rng.uniform(0.4, 0.75))
    mortar = f32([0.72, 0.7, 0.66]) * rng.uniform(0.7, 1.1)
    grit = tile.noise(0.3, 4.0, 1.3)
    pits = smoothstep(tile.noise(0.5, 2.0, 0.8), 1.2, 2.0)
    relief = grit * rng.uniform(0.05, 0.12) - pits * 0.3
    solid, words = tile.zeros() + 1.0, ("gritty", "grainy", "hard")
    if kind == "laid":
        course, length = TILE_MM / 4.0, TILE_MM / 2.0
        y = tile.y % course
        x = (tile.x + np.floor(tile.y / course) % 2.0 * (length / 2.0)) % length
        edge = (
            np.minimum(np.minimum(y, course - y), np.minimum(x, length - x))
            + tile.noise(2.0, 10.0) * 0.2
        )
        solid = smoothstep(edge, 0.9, 2.4)
        words = ("jointed", "gritty", "hard")
    elif kind == "wire-cut":
        cuts = tile.noise(0.5, 5.0, 1.0, 20.0, pick_angle(rng))
        relief = relief + cuts * rng.uniform(0.08, 0.16)
        words = ("scraped", "gritty", "hard")
    height = (
        solid * (rng.uniform(0.8, 1.6) + relief) + (1.0 - solid) * tile.noise(0.3, 1.5, 0.8) * 0.12
    )
    tone = (1.0 + 0.16 * tile.noise(1.0, 20.0)) * (1.0 + 0.10 * grit) * (1.0 - 0.25 * pits)
    joint = tint(mortar, 1.0 + 0.06 * tile.noise(0.3, 2.0))
    return Surface(height, blend(joint, tint(clay, tone), solid), kind, words, gloss=0.02)


def pick_angle(rng: np.random.Generator) -> float:
    """Along x or along y, in radians."""
    return math.pi / 2.0 * int(rng.integers(2))


def ceramic_tile(tile: Tile, rng: np.random.Generator) -> Surface:
    """Glazed, textured (anti-slip), or small mosaic."""
    kind = pick(rng, "glazed", "glazed", "textured", "mosaic")
    color = hsv(rng.random(), (0.05, 0.12, 0.5)[int(rng.integers(3))], rng.uniform(0.5, 0.95))
    side = TILE_MM / (5 if kind == "mosaic" else int(rng.integers(2, 4)))
    gap = rng.uniform(0.6, 1.4)
    body = smoothstep(tile.squares(side), gap * 0.6, gap * 1.6)
    cell = (np.floor(tile.y / side) * 7.0 + np.floor(tile.x / side)).astype(np.intp) % 64
    shade = 1.0 + f32(0.08 * rng.standard_normal(64))[cell]
    relief = tile.noise(5.0, 30.0, 3.0) * 0.02
    words: tuple[str, ...] = ("slick", "smooth", "grid-lined")
    if kind == "textured":
        relief = relief + smoothstep(tile.noise(0.8, 4.0, 1.2), -0.2, 0.6) * rng.uniform(0.04, 0.08)
        words = ("grippy", "nubbly", "grid-lined")
    elif kind == "mosaic":
        words = ("slick", "smooth", "densely jointed")
    marble = tile.ridged(1.0, 25.0, 2.4) * (0.0, 0.06, 0.12)[int(rng.integers(3))]
    height = (
        body * (rng.uniform(0.4, 0.9) + relief) + (1.0 - body) * tile.noise(0.3, 1.2, 0.6) * 0.05
    )
    grout = f32([0.6, 0.59, 0.57]) * rng.uniform(0.5, 1.3)
    gloss = rng.uniform(0.1, 0.3) if kind == "textured" else rng.uniform(0.4, 0.9)
    return Surface(
        height, blend(grout, tint(color, shade + marble), body), kind, words, gloss=gloss
    )


def rock(tile: Tile, rng: np.random.Generator) -> Surface:
    """Craggy, layered, or weathered."""
    kind = pick(rng, "craggy", "layered", "weathered")
    color = hsv(rng.uniform(0.05, 0.6), rng.uniform(0.0, 0.18), rng.uniform(0.3, 0.7))
    angle = rng.uniform(0.0, math.pi)
    if kind == "craggy":
        form = tile.ridged(0.8, 25.0, 2.2)
        height, words = form * 0.45, ("craggy", "sharp-edged", "hard")
    elif kind == "layered":
        form = tile.noise(0.7, 25.0, 2.4, 7.0, angle)
        height = np.round(form * 3.0 + 0.3 * tile.noise(0.5, 3.0)) * 0.15 + form * 0.1
        words = ("layered", "stepped", "hard")
    else:
        form = tile.noise(1.0, 25.0, 2.6)
        height, words = form * 0.55, ("weathered", "uneven", "hard")
    grit = tile.noise(0.3, 1.5, 0.6)
    specks = smoothstep(tile.noise(0.4, 1.6, 0.3), 1.0, 1.6) * (-0.5 if flip(rng, 0.5) else 0.5)
    albedo = tint(color, (1.0 + 0.16 * form + 0.08 * grit) * (1.0 + specks))
    return Surface(height + grit * rng.uniform(0.02, 0.08), albedo, kind, words, gloss=0.04)


def gravel(tile: Tile, rng: np.random.Generator) -> Surface:
    """Rounded pebbles or crushed stone."""
    kind = pick(rng, "rounded", "crushed")
    size = rng.uniform(5.0, 11.0)
    stones, cells = tile.grains(size, 0.35, edge=0.75 if kind == "rounded" else 0.35)
    base = hsv(rng.uniform(0.03, 0.62), rng.uniform(0.02, 0.2), rng.uniform(0.4, 0.7))
    colors = f32(
        base * rng.uniform(0.55, 1.4, (cells.count, 1)) * rng.uniform(0.9, 1.1, (cells.count, 3))
    )
    height = stones * (size * 0.28)
    if kind == "crushed":
        height = height + tile.ridged(0.8, 8.0, 1.8) * 0.12
        words = ("pebbly", "angular", "hard")
    else:
        height = height + tile.noise(0.4, 3.0, 1.2) * 0.04
        words = ("pebbly", "lumpy", "hard")
    albedo = tint(
        colors[cells.index], (1.0 + 0.1 * tile.noise(0.3, 3.0)) * smoothstep(stones, -0.05, 0.5)
    )
    return Surface(height, albedo, kind, words, gloss=0.05, softness=0.1)


def sand(tile: Tile, rng: np.random.Generator) -> Surface:
    """Dry, rippled, or packed sand."""
    kind = pick(rng, "dry", "rippled", "packed")
    size = rng.uniform(0.6, 1.1)
    fine, cells = tile.grains(size, 0.5)
    coarse, _ = tile.grains(size * 1.8, 0.6, 0.25)
    height = (
        fine * (size * 0.45)
        + coarse * (size * 0.5)
        + tile.noise(3.0, 25.0, 2.4) * rng.uniform(0.05, 0.2)
    )
    softness, words = 0.4, ("granular", "fine-grained", "loose")
    if kind == "rippled":
        height = height * 0.8 + np.sin(
            tile.wave(rng.uniform(10.0, 20.0), rng.uniform(0.0, math.pi), 0.5)
        ) * rng.uniform(0.5, 0.8)
        words = ("granular", "rippled", "loose")
    elif kind == "packed":
        height, softness, words = height * 0.5, 0.15, ("granular", "fine-grained", "firm")
    color = hsv(rng.uniform(0.07, 0.13), rng.uniform(0.15, 0.45), rng.uniform(0.55, 0.9))
    speckle = np.clip(cells.each(rng, 1.0, 0.25), 0.4, 1.6)
    return Surface(
        height,
        tint(color, speckle * (1.0 + 0.05 * tile.noise(3.0, 30.0))),
        kind,
        words,
        gloss=0.03,
        softness=softness,
    )


def soil(tile: Tile, rng: np.random.Generator) -> Surface:
    """Crumbs, clods, or soil with plant litter."""
    kind = pick(rng, "crumbs", "clods", "litter")
    color = hsv(rng.uniform(0.04, 0.1), rng.uniform(0.3, 0.6), rng.uniform(0.15, 0.45))
    clods, _ = tile.grains(
        rng.uniform(4.0, 7.0) if kind == "clods" else rng.uniform(2.2, 3.5), 0.6, 0.6
    )
    crumbs, _ = tile.grains(rng.uniform(0.8, 1.6), 0.5)
    height = (
        tile.noise(0.5, 9.0, 2.0) * rng.uniform(0.2, 0.4)
        + clods * rng.uniform(0.3, 0.7)
        + crumbs * 0.2
    )
    tone = (1.0 + 0.22 * tile.noise(0.3, 6.0, 1.2)) * (0.75 + 0.25 * np.clip(clods, 0.0, 1.0))
    albedo = tint(color, tone)
    words = {
        "crumbs": ("crumbly", "loose", "yielding"),
        "clods": ("clumpy", "crumbly", "uneven"),
        "litter": ("crumbly", "fibrous", "loose"),
    }[kind]
    if kind == "litter":
        stalks = tile.strokes(25, 12.0, 0.6, angle=0.0, spread=3.0, height=0.6)
        height = np.maximum(height, float(height.mean()) + stalks)
        albedo = blend(albedo, hsv(0.11, 0.35, 0.6), smoothstep(stalks, 0.05, 0.2))
    return Surface(height, albedo, kind, words, gloss=0.01, softness=0.55)
