"""Man-made materials: plastic, glass, metal, rubber, paper, and others.

Every function draws a variant (``kind``) and its dimensions at random; no number is measured from a
real material. Lengths are in mm: heights of the relief, and the wavelengths, periods and sizes that
go to the methods of :class:`~palpate.sim.tile.Tile`. ``draw(low, high)`` is uniform, ``draw()`` is
in [0, 1); ``hsv`` takes hue, saturation and value in [0, 1]. But for cardboard and rust, the base
color is drawn independently of the relief, so that color alone does not predict it.
"""

from __future__ import annotations

import math

import numpy as np

from palpate.sim.arrays import Array, blend, f32, hsv, smoothstep, tint, turned
from palpate.sim.materials.surface import Surface, rising
from palpate.sim.tile import TILE_MM, Tile, wrapped_offset


def plastic(tile: Tile) -> Surface:
    """Draw smooth, finely textured, ribbed, or dotted plastic."""
    kind, draw = tile.pick("smooth", "textured", "ribbed", "dotted"), tile.draw
    color = hsv(draw(), draw(0.0, 0.9), draw(0.25, 0.95))
    angle = tile.angle()
    height = tile.noise(4.0, 40.0, 3.0) * 0.03
    if kind == "textured":
        height += tile.cells(draw(0.9, 1.8)).walls(0.5) * draw(0.03, 0.07)
    elif kind == "ribbed":
        rib = np.sin(tile.wave(draw(2.5, 7.0), angle))
        height += smoothstep(rib, -0.3, 0.3) * draw(0.12, 0.3)
    elif kind == "dotted":
        u, v = tile.waves(draw(3.5, 7.0), angle)
        height += smoothstep(np.cos(u) + np.cos(v), 0.6, 1.2) * draw(0.15, 0.35)
    height += tile.noise(0.3, 3.0, 1.0) * 0.002
    albedo = tint(color, 1.0 + 0.02 * tile.noise(1.0, 30.0))
    return Surface(height, albedo, kind, gloss=draw(0.35, 0.8), softness=0.05)


def glass(tile: Tile) -> Surface:
    """Draw clear, frosted, or fluted glass.

    Reflections of windows and specks of dust are in its color alone: they cannot be felt.
    """
    kind = tile.pick("clear", "clear", "clear", "frosted", "fluted")  # three of five are clear
    draw = tile.draw
    color = hsv(draw(0.3, 0.62), draw(0.03, 0.25), draw(0.35, 0.8))
    height = tile.noise(8.0, 60.0, 3.0) * 0.01
    if kind == "frosted":
        height += tile.noise(0.35, 1.6, 0.8) * draw(0.012, 0.03)
    elif kind == "fluted":
        flutes = np.cos(tile.wave(draw(4.0, 9.0), tile.angle()))
        height += flutes * draw(0.1, 0.25)
    albedo = tint(color, 0.75 + 0.16 * tile.noise(18.0, 64.0, 3.0))
    for _ in range(0 if tile.whole else int(tile.rng.integers(1, 4))):
        angle = tile.angle()
        dy, dx = (wrapped_offset(at, draw(0.0, TILE_MM)) for at in (tile.y, tile.x))
        u, v = turned(dy, dx, angle)
        # 1 on the edge of a rectangle with these half sides.
        edge = np.maximum(np.abs(u) * (1 / draw(3.0, 12.0)), np.abs(v) * (1 / draw(5.0, 16.0)))
        window = smoothstep(edge, 1.08, 0.95) * draw(0.25, 0.7)
        albedo = blend(albedo, f32([0.93, 0.96, 1.0]), window)
    dust = f32(tile.noise(0.2, 0.8, 0.0) > 3.0)
    return Surface(height, blend(albedo, f32([0.9, 0.9, 0.9]), dust), kind, gloss=1.0)


def _tread(tile: Tile) -> Array:
    """Draw the raised ellipses of tread plate, one each way in every period; in [0, 1].

    Half axes are in radians of the phases ``u`` and ``v``; the second ellipse is half a period off.
    """
    u, v = tile.waves(tile.draw(10.0, 14.0), tile.angle())
    long, short = 1.0 / tile.draw(1.7, 2.2), 1.0 / tile.draw(0.55, 0.75)
    wrapped = lambda phase: (phase + math.pi) % (2.0 * math.pi) - math.pi
    first = np.hypot(wrapped(u) * long, wrapped(v) * short)
    second = np.hypot(wrapped(u + math.pi) * short, wrapped(v + math.pi) * long)
    return smoothstep(np.minimum(first, second), 1.0, 0.6)


def metal(tile: Tile) -> Surface:
    """Draw brushed metal, tread plate, perforated, rusted, or scratched metal."""
    kind = tile.pick("brushed", "tread plate", "perforated", "rusted", "scratched")
    draw = tile.draw
    value = draw(0.45, 0.85)
    color = f32([value, value * draw(0.93, 1.0), value * draw(0.85, 1.05)])
    if tile.flip(0.25):  # brass or copper instead of gray
        color = hsv(draw(0.06, 0.13), 0.5, value)
    angle = tile.angle()
    height = tile.noise(6.0, 50.0, 3.0) * 0.015
    albedo = tint(color, tile.ones())
    if kind == "brushed":
        lines = tile.noise(0.2, 1.6, 0.7, 60.0, angle)
        height, albedo = height + lines * draw(0.006, 0.016), tint(albedo, 1.0 + 0.10 * lines)
    elif kind == "tread plate":
        height += _tread(tile) * draw(0.35, 0.5)
    elif kind == "perforated":
        u, v = tile.waves(draw(4.5, 7.0), angle)
        hole = smoothstep(np.cos(u) + np.cos(v), 0.7, 1.0)
        height, albedo = height - hole * 0.9, tint(albedo, 1.0 - 0.8 * hole)
    elif kind == "rusted":
        rust = smoothstep(tile.noise(0.4, 8.0, 1.8), -0.3, 0.9) * draw(0.6, 1.0)
        height += rust * (0.10 + tile.noise(0.4, 2.5, 1.0) * 0.10)
        albedo = blend(albedo, f32([0.42, 0.22, 0.10]), rust)
    else:
        scratch = tile.strokes(30, 25.0, 0.6, angle=angle, spread=0.8, height=0.09, bend=0.1)
        height, albedo = height - scratch, tint(albedo, 1.0 - 2.5 * scratch)
    gloss = draw(0.5, 0.95) * (0.4 if kind == "rusted" else 1.0)
    return Surface(height, albedo, kind, gloss=gloss)


def rubber(tile: Tile) -> Surface:
    """Draw studded, treaded, ribbed, or granular rubber."""
    kind, draw = tile.pick("studded", "treaded", "ribbed", "granular"), tile.draw
    value = draw(0.06, 0.3) if tile.flip(0.7) else 0.6
    color = hsv(draw(), tile.pick(0.0, 0.1, 0.6), value)
    angle = tile.pick(0.0, math.pi / 4.0, math.pi / 3.0)
    u, v = tile.waves(draw(4.0, 9.0), angle)
    if kind == "studded":
        height = smoothstep(np.cos(u) + np.cos(v), 0.1, 0.7) * 0.5
    elif kind == "treaded":
        zigzag = np.abs((v * (1.0 / math.pi)) % 2.0 - 1.0) * math.pi  # a triangle wave in [0, pi]
        height = smoothstep(np.sin(u + 0.9 * zigzag), -0.15, 0.3) * 0.7
    elif kind == "ribbed":
        height = (0.5 + 0.5 * np.cos(u)) * 0.6
    else:
        height = tile.grains(draw(1.5, 3.0))[0] * 0.2
    height += tile.noise(0.3, 2.0, 1.0) * 0.008
    albedo = tint(color, 0.75 + 0.25 * rising(height))
    return Surface(height, albedo, kind, gloss=draw(0.05, 0.25), softness=0.45)


def paper(tile: Tile) -> Surface:
    """Draw a sheet, corrugated board, or crumpled paper; half of them printed.

    Print is in the color alone: it cannot be felt.
    """
    kind, draw = tile.pick("sheet", "corrugated", "crumpled"), tile.draw
    color = hsv(draw(0.08, 0.15), draw(0.0, 0.15), draw(0.8, 0.97))
    fiber = tile.noise(0.25, 2.0, 0.9)
    height = fiber * 0.010 + tile.noise(8.0, 50.0, 3.0) * 0.06
    if kind == "corrugated":
        color = hsv(0.09, draw(0.3, 0.5), draw(0.5, 0.75))
        flutes = np.cos(tile.wave(draw(5.0, 8.0), tile.pick(0.0, math.pi / 2.0)))
        height += flutes * draw(0.10, 0.20)
    elif kind == "crumpled":
        cells = tile.cells(draw(9.0, 16.0))
        height += (cells.far - cells.near) * 0.16
        height += tile.ridged(3.0, 24.0, 2.6) * 0.07
    albedo = tint(color, 1.0 + 0.03 * fiber)
    if tile.flip(0.5):
        line = smoothstep(np.sin(tile.wave(draw(3.0, 6.0), math.pi / 2.0)), 0.2, 0.4)
        ink = line * (tile.noise(0.6, 3.0, 0.5, 3.0) > 0) * 0.85  # lines broken into words
        albedo = blend(albedo, f32([0.1, 0.1, 0.15]), ink)
    return Surface(height, albedo, kind, gloss=0.05, softness=0.3)


def other(tile: Tile) -> Surface:
    """Draw what fits no other class: sponge, carpet, studded mat, rope."""
    kind, draw = tile.pick("sponge", "carpet", "stud mat", "rope"), tile.draw
    color = hsv(draw(), draw(0.1, 0.9), draw(0.3, 0.95))
    if kind == "sponge":
        cells = tile.cells(draw(1.5, 3.5))
        height = cells.walls(0.7) * -0.7 * cells.keep(0.8)
    elif kind == "carpet":
        height = tile.strokes(900, 3.5, 0.7, spread=3.0, height=1.0, bend=0.8)
    elif kind == "stud mat":
        height = smoothstep(np.hypot(tile.x % 8.0 - 4.0, tile.y % 8.0 - 4.0), 2.6, 2.3) * 1.2
    else:
        angle = tile.angle()
        strand = np.abs(np.sin(tile.wave(draw(10.0, 16.0), angle)))
        height = strand * 0.8 + 0.25 * np.sin(tile.wave(draw(2.0, 3.0), angle + 0.9))
    albedo = tint(color, 0.55 + 0.45 * rising(height))
    height += tile.noise(0.5, 4.0) * 0.02
    return Surface(height, albedo, kind, gloss=draw(0.05, 0.4), softness=0.4)
