"""Man-made hard goods: plastic, glass, metal, rubber, paper, and others. Their color is free: it
must not predict the touch.
"""

from __future__ import annotations

import math

import numpy as np

from palpate.sim.arrays import Array, blend, f32, hsv, smoothstep, tint
from palpate.sim.materials.surface import Surface, flip, pick, plain
from palpate.sim.tile import TILE_MM, Tile


def _rising(height: Array) -> Array:
    """Heights scaled to [0, 1]."""
    low, high = float(height.min()), float(height.max())
    return (height - low) * (1.0 / (high - low + 1e-9))


def plastic(tile: Tile, rng: np.random.Generator) -> Surface:
    """Smooth, finely textured, ribbed, or dotted."""
    kind = pick(rng, "smooth", "textured", "ribbed", "dotted")
    color = hsv(rng.random(), rng.uniform(0.0, 0.9), rng.uniform(0.25, 0.95))
    angle = rng.uniform(0.0, math.pi)
    height = tile.noise(4.0, 40.0, 3.0) * 0.03
    words: tuple[str, ...] = ("smooth", "even", "hard")
    if kind == "textured":
        height = height + tile.cells(rng.uniform(0.9, 1.8)).walls(0.5) * rng.uniform(0.03, 0.07)
        words = ("finely textured", "even", "hard")
    elif kind == "ribbed":
        height = height + smoothstep(
            np.sin(tile.wave(rng.uniform(2.5, 7.0), angle)), -0.3, 0.3
        ) * rng.uniform(0.12, 0.3)
        words = ("ribbed", "smooth", "hard")
    elif kind == "dotted":
        step = rng.uniform(3.5, 7.0)
        bumps = np.cos(tile.wave(step, angle)) + np.cos(tile.wave(step, angle + math.pi / 2.0))
        height = height + smoothstep(bumps, 0.6, 1.2) * rng.uniform(0.15, 0.35)
        words = ("dotted", "smooth", "hard")
    height = height + tile.noise(0.3, 3.0, 1.0) * 0.002
    albedo = tint(plain(tile, color), 1.0 + 0.02 * tile.noise(1.0, 30.0))
    return Surface(height, albedo, kind, words, gloss=rng.uniform(0.35, 0.8), softness=0.05)


def glass(tile: Tile, rng: np.random.Generator) -> Surface:
    """Clear, frosted, or fluted; the albedo holds soft mirrored windows, which nobody can feel."""
    kind = pick(rng, "clear", "clear", "clear", "frosted", "fluted")
    color = hsv(rng.uniform(0.3, 0.62), rng.uniform(0.03, 0.25), rng.uniform(0.35, 0.8))
    height = tile.noise(8.0, 60.0, 3.0) * 0.01
    words: tuple[str, ...] = ("perfectly smooth", "slick", "hard")
    if kind == "frosted":
        height = height + tile.noise(0.35, 1.6, 0.8) * rng.uniform(0.012, 0.03)
        words = ("frosted", "faintly rough", "hard")
    elif kind == "fluted":
        height = height + np.cos(
            tile.wave(rng.uniform(4.0, 9.0), rng.uniform(0.0, math.pi))
        ) * rng.uniform(0.1, 0.25)
        words = ("fluted", "slick", "hard")
    albedo = tint(color, 0.75 + 0.16 * tile.noise(18.0, 64.0, 3.0))
    for _ in range(int(rng.integers(1, 4))):
        angle, half = rng.uniform(0.0, math.pi), TILE_MM / 2.0
        dy = (tile.y - rng.uniform(0.0, TILE_MM) + half) % TILE_MM - half
        dx = (tile.x - rng.uniform(0.0, TILE_MM) + half) % TILE_MM - half
        c, s = math.cos(angle), math.sin(angle)
        reach = np.maximum(
            np.abs(c * dx + s * dy) * (1 / rng.uniform(3.0, 12.0)),
            np.abs(c * dy - s * dx) * (1 / rng.uniform(5.0, 16.0)),
        )
        albedo = blend(
            albedo, f32([0.93, 0.96, 1.0]), smoothstep(reach, 1.08, 0.95) * rng.uniform(0.25, 0.7)
        )
    dust = f32(tile.noise(0.2, 0.8, 0.0) > 3.0)
    return Surface(height, blend(albedo, f32([0.9, 0.9, 0.9]), dust), kind, words, gloss=1.0)


def _tread(tile: Tile, rng: np.random.Generator) -> Array:
    """Tread plate: lozenges of two directions at right angles, interleaved; in [0, 1]."""
    step, angle = rng.uniform(10.0, 14.0), rng.uniform(0.0, math.pi)
    u, v = tile.wave(step, angle), tile.wave(step, angle + math.pi / 2.0)
    long, short = rng.uniform(1.7, 2.2), rng.uniform(0.55, 0.75)
    turn = lambda a: (a + math.pi) % (2.0 * math.pi) - math.pi  # noqa: E731
    first = np.hypot(turn(u) * (1.0 / long), turn(v) * (1.0 / short))
    second = np.hypot(turn(u + math.pi) * (1.0 / short), turn(v + math.pi) * (1.0 / long))
    return smoothstep(np.minimum(first, second), 1.0, 0.6)


def metal(tile: Tile, rng: np.random.Generator) -> Surface:
    """Brushed, tread plate, perforated, rusted, or scratched."""
    kind = pick(rng, "brushed", "tread plate", "perforated", "rusted", "scratched")
    value = rng.uniform(0.45, 0.85)
    color = f32([value, value * rng.uniform(0.93, 1.0), value * rng.uniform(0.85, 1.05)])
    if flip(rng, 0.25):
        color = hsv(rng.uniform(0.06, 0.13), 0.5, value)
    angle = rng.uniform(0.0, math.pi)
    height = tile.noise(6.0, 50.0, 3.0) * 0.015
    albedo = plain(tile, color)
    if kind == "brushed":
        lines = tile.noise(0.2, 1.6, 0.7, 60.0, angle)
        height, albedo = (
            height + lines * rng.uniform(0.006, 0.016),
            tint(albedo, 1.0 + 0.10 * lines),
        )
        words = ("brushed", "fine-lined", "cold", "hard")
    elif kind == "tread plate":
        height, words = (
            height + _tread(tile, rng) * rng.uniform(0.35, 0.5),
            ("studded", "diamond-plated", "cold", "hard"),
        )
    elif kind == "perforated":
        step = rng.uniform(4.5, 7.0)
        hole = smoothstep(
            np.cos(tile.wave(step, angle)) + np.cos(tile.wave(step, angle + math.pi / 2.0)),
            0.7,
            1.0,
        )
        height, albedo = height - hole * 0.9, tint(albedo, 1.0 - 0.8 * hole)
        words = ("perforated", "smooth", "cold", "hard")
    elif kind == "rusted":
        rust = smoothstep(tile.noise(0.4, 8.0, 1.8), -0.3, 0.9) * rng.uniform(0.6, 1.0)
        height = height + rust * (0.10 + tile.noise(0.4, 2.5, 1.0) * 0.10)
        albedo = blend(albedo, f32([0.42, 0.22, 0.10]), rust)
        words = ("flaking", "uneven", "cold", "hard")
    else:
        scratch = tile.strokes(30, 25.0, 0.6, angle=angle, spread=0.8, height=0.09, bend=0.1)
        height, albedo = height - scratch, tint(albedo, 1.0 - 2.5 * scratch)
        words = ("scratched", "smooth", "cold", "hard")
    return Surface(
        height,
        albedo,
        kind,
        words,
        gloss=rng.uniform(0.5, 0.95) * (0.4 if kind == "rusted" else 1.0),
    )


def rubber(tile: Tile, rng: np.random.Generator) -> Surface:
    """Studded, treaded, ribbed, or granular."""
    kind = pick(rng, "studded", "treaded", "ribbed", "granular")
    value = rng.uniform(0.06, 0.3) if flip(rng, 0.7) else 0.6
    color = hsv(rng.random(), (0.0, 0.1, 0.6)[int(rng.integers(3))], value)
    angle = (0.0, math.pi / 4.0, math.pi / 3.0)[int(rng.integers(3))]
    step = rng.uniform(4.0, 9.0)
    u, v = tile.wave(step, angle), tile.wave(step, angle + math.pi / 2.0)
    if kind == "studded":
        height, first = smoothstep(np.cos(u) + np.cos(v), 0.1, 0.7) * 0.5, "studded"
    elif kind == "treaded":
        zigzag = np.abs((v * (1.0 / math.pi)) % 2.0 - 1.0) * math.pi
        height, first = smoothstep(np.sin(u + 0.9 * zigzag), -0.15, 0.3) * 0.7, "zigzag-grooved"
    elif kind == "ribbed":
        height, first = (0.5 + 0.5 * np.cos(u)) * 0.6, "ribbed"
    else:
        height, first = tile.grains(rng.uniform(1.5, 3.0))[0] * 0.2, "granular"
    height = height + tile.noise(0.3, 2.0, 1.0) * 0.008
    albedo = tint(color, 0.75 + 0.25 * _rising(height))
    return Surface(
        height,
        albedo,
        kind,
        (first, "grippy", "elastic"),
        gloss=rng.uniform(0.05, 0.25),
        softness=0.45,
    )


def paper(tile: Tile, rng: np.random.Generator) -> Surface:
    """A flat sheet, corrugated board, or crumpled; half of them printed, which nobody can feel."""
    kind = pick(rng, "sheet", "corrugated", "crumpled")
    color = hsv(rng.uniform(0.08, 0.15), rng.uniform(0.0, 0.15), rng.uniform(0.8, 0.97))
    fibre = tile.noise(0.25, 2.0, 0.9)
    height = fibre * 0.010 + tile.noise(8.0, 50.0, 3.0) * 0.06
    words: tuple[str, ...] = ("thin", "flat", "dry")
    if kind == "corrugated":
        color = hsv(0.09, rng.uniform(0.3, 0.5), rng.uniform(0.5, 0.75))
        flutes = np.cos(tile.wave(rng.uniform(5.0, 8.0), math.pi / 2.0 * int(rng.integers(2))))
        height, words = height + flutes * rng.uniform(0.10, 0.20), ("corrugated", "dry", "firm")
    elif kind == "crumpled":
        cells = tile.cells(rng.uniform(9.0, 16.0))
        height = height + (cells.far - cells.near) * 0.16 + tile.ridged(3.0, 24.0, 2.6) * 0.07
        words = ("crumpled", "creased", "thin")
    albedo = tint(color, 1.0 + 0.03 * fibre)
    if flip(rng, 0.5):
        line = smoothstep(np.sin(tile.wave(rng.uniform(3.0, 6.0), math.pi / 2.0)), 0.2, 0.4)
        albedo = blend(
            albedo, f32([0.1, 0.1, 0.15]), line * (tile.noise(0.6, 3.0, 0.5, 3.0) > 0) * 0.85
        )
    return Surface(height, albedo, kind, words, gloss=0.05, softness=0.3)


def other(tile: Tile, rng: np.random.Generator) -> Surface:
    """Things that fit nowhere: sponge, carpet, studded mat, rope."""
    kind = pick(rng, "sponge", "carpet", "stud mat", "rope")
    color = hsv(rng.random(), rng.uniform(0.1, 0.9), rng.uniform(0.3, 0.95))
    if kind == "sponge":
        cells = tile.cells(rng.uniform(1.5, 3.5))
        height = cells.walls(0.7) * -0.7 * cells.keep(rng, 0.8)
        words, noun = ("porous", "spongy", "unusual"), "a sponge"
    elif kind == "carpet":
        height = tile.strokes(900, 3.5, 0.7, angle=0.0, spread=3.0, height=1.0, bend=0.8)
        words, noun = ("tufted", "springy", "unusual"), "carpet"
    elif kind == "stud mat":
        across = lambda at: at % 8.0 - 4.0  # noqa: E731
        height = smoothstep(np.hypot(across(tile.x), across(tile.y)), 2.6, 2.3) * 1.2
        words, noun = ("studded", "regular", "unusual"), "a mat"
    else:
        angle = rng.uniform(0.0, math.pi)
        strand = np.abs(np.sin(tile.wave(rng.uniform(10.0, 16.0), angle)))
        height = strand * 0.8 + 0.25 * np.sin(tile.wave(rng.uniform(2.0, 3.0), angle + 0.9))
        words, noun = ("corded", "twisted", "unusual"), "a rope"
    albedo = tint(color, 0.55 + 0.45 * _rising(height))
    return Surface(
        height + tile.noise(0.5, 4.0) * 0.02, albedo, kind, words, rng.uniform(0.05, 0.4), 0.4, noun
    )
