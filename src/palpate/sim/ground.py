"""Grounds: 512 mm of a material at the scale of photos, which show 150 to 400 mm of it.

The relief under a pad is h = a f + b w + g: the material's own fine relief f (a tile of 64 mm),
waves w of 16 to 40 mm and unit deviation, and the height g of the ground in mm: its waves of 12 to
250 mm, joints of true size, or the height of a scan. Factor a, deviation b and the load belong to
the material (:data:`TOUCHES`).

The picture of a procedural ground is its tile, looked up at two places that are mixed by a mask of
waves of 8 to 80 mm, which hides the repeat; joints, and another tone for each brick, plank and
stone, lie over it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from palpate.sim.arrays import Array, f32, resample, smoothstep
from palpate.sim.materials import Surface
from palpate.sim.tile import TILE_MM, Tile

if TYPE_CHECKING:
    from palpate.sim.scans import Scan

#: Tiles along a side, and the side in mm.
TILES = 8
GROUND_MM = TILES * TILE_MM
#: Deviation of the blur of a ground's height when it is looked up, in its pixels.
BLUR = 1.15


class Touch(NamedTuple):
    """How a material is felt on a ground."""

    relief: float  # factor on the fine relief
    waves: float  # deviation of waves of 16 to 40 mm, in mm
    load: float  # factor on the load of contacts
    fitted: bool = (
        False  # by a real clip (benchmarks/surfaces.py), not in all bands, else a guess by kind
    )


_STONE, _GRASS = Touch(0.4, 0.3, 0.8, True), Touch(0.75, 1.1, 1.4, True)
_FABRIC, _WOOD = Touch(1.75, 1.3, 1.4, True), Touch(1.8, 0.2, 2.0, True)
_MINERAL, _PLANT, _SOFT, _HARD = (
    t._replace(fitted=False) for t in (_STONE, _GRASS, _FABRIC, _WOOD)
)
TOUCHES: dict[str, Touch] = {
    "Rock": _STONE,
    "Grass": _GRASS,
    "Brick": Touch(0.1, 0.15, 2.9, True),
    "Natural Fabric": _FABRIC,
    "Wood": _WOOD,
    **dict.fromkeys(("Concrete", "Gravel", "Sand", "Soil"), _MINERAL),
    **dict.fromkeys(("Tree", "Plants"), _PLANT),
    **dict.fromkeys(("Leather", "Synthetic Fabric", "Rubber", "Others"), _SOFT),
    **dict.fromkeys(("Plastic", "Glass", "Metal", "Tile", "Paper"), _HARD._replace(relief=1.0)),
}
#: Of a material that is not listed.
ANY = Touch(0.5, 0.5, 1.2)
#: Deviation in mm of the waves of 12 to 250 mm of natural grounds, and of all others.
WAVES: dict[str, float] = {
    **dict.fromkeys(("Rock", "Soil", "Gravel", "Sand", "Plants"), 4.0),
    **{"Grass": 5.0, "Tree": 3.0, "Natural Fabric": 3.0, "Others": 1.0},
}
FLAT = 0.5


class _Layout(NamedTuple):
    """What divides a ground into pieces; lengths in mm."""

    high: float
    long: float
    joint: float  # width of the joints
    depth: float
    shift: float  # of each course, in lengths of a piece


def touch_of(material: str) -> Touch:
    """Return how that material is felt on a ground."""
    return TOUCHES.get(material, ANY)


def draw_ground(
    material: str, piece: Surface, rng: np.random.Generator, scan: Scan | None = None
) -> Surface:
    """Lay a piece of a material on a ground.

    Args:
        material: its name.
        piece: drawn ``whole``.
        rng: of what the ground draws.
        scan: is the ground; by default it is drawn.

    Returns:
        The piece, whose height is a f + b w, with ``ground``: a surface of 512 mm, or of the size
        of ``scan``. What the ground's pixels can hold of f is in its height.

    Raises:
        PalpateError: if the scan cannot be read.
    """
    ground = _of_scan(scan, piece) if scan else _procedural(material, piece, rng)
    touch = touch_of(material)
    px = max(ground.px, scan.px if scan else 0.0)
    fine = piece.height - scipy.ndimage.gaussian_filter(
        piece.height, BLUR * px / piece.px, mode="wrap"
    )
    waves = Tile(len(piece.height), rng).noise(16.0, 40.0, 0.5)
    return replace(piece, height=touch.relief * fine + touch.waves * waves, ground=ground)


def _of_scan(scan: Scan, piece: Surface) -> Surface:
    """Return a scan as a ground with gloss and softness of a piece of its material."""
    color, height, side = scan.read(2 * len(piece.height))
    return replace(piece, height=height, albedo=color, subtype=scan.name, side_mm=side)


def _procedural(material: str, piece: Surface, rng: np.random.Generator) -> Surface:
    """Draw 512 mm of a material from a tile of it."""
    n = len(piece.height) // 4
    plan = Tile(TILES * n, rng)  # lengths are divided by TILES: it stands for 512 mm
    small = resample(np.dstack([piece.albedo, piece.height]), n)
    places = rng.integers(n, size=(2, 2))
    first, second = (np.tile(np.roll(small, p, (0, 1)), (TILES, TILES, 1)) for p in places)
    mask = smoothstep(plan.noise(8 / TILES, 80 / TILES), -0.3, 0.3)[..., None]
    laid = first * mask + second * (1 - mask)
    color, height = laid[..., :3], laid[..., 3] * touch_of(material).relief
    height += plan.noise(12 / TILES, 250 / TILES) * (
        WAVES.get(material, FLAT) * plan.draw(0.5, 1.5)
    )
    if (layout := _layout(material, plan)) is not None:
        color, height = _divided(layout, material, plan, color, height)
    color = (
        color * (1 + plan.draw(0.02, 0.12) * plan.noise(10 / TILES, 300 / TILES, 1.6))[..., None]
    )
    return replace(
        piece, height=f32(height), albedo=f32(np.clip(color, 0.01, 1)), side_mm=GROUND_MM
    )


def _layout(material: str, plan: Tile) -> _Layout | None:
    """Draw the layout of a ground of that material; None of one that nothing divides."""
    draw, side = plan.draw, plan.draw(40, 300)
    share, layout = {
        "Brick": (1.0, _Layout(draw(62, 78), draw(190, 230), draw(8, 13), draw(2, 8), 0.5)),
        "Tile": (1.0, _Layout(side, side, draw(2, 6), draw(0.5, 2), 0.0)),
        "Wood": (0.75, _Layout(draw(60, 180), draw(300, 600), draw(1, 3), draw(0.5, 2.5), 0.37)),
        "Rock": (0.55, _Layout(draw(60, 180), draw(150, 400), draw(5, 15), draw(3, 10), 0.37)),
    }.get(material, (0.0, None))
    return layout if plan.flip(share) else None


def _divided(
    layout: _Layout, material: str, plan: Tile, color: Array, height: Array
) -> tuple[Array, Array]:
    """Divide a ground into pieces of different tones and heights, with joints between."""
    rng, (y, x) = plan.rng, (plan.y * TILES, plan.x * TILES)
    high, long = (GROUND_MM / max(1, round(GROUND_MM / side)) for side in layout[:2])
    row = np.floor(y / high)
    across = (x + row * (layout.shift * long)) % GROUND_MM
    number = (row * 64 + np.floor(across / long)).astype(np.intp) % 4096
    v, u = y % high, across % long
    edge = np.minimum(np.minimum(v, high - v), np.minimum(u, long - u))
    edge = edge + 0.4 * plan.noise(3 / TILES, 30 / TILES)
    body = smoothstep(edge, layout.joint * 0.3, layout.joint * 0.8)
    tone = 1 + rng.normal(0, 0.03 if material == "Tile" else 0.13, (4096, 1))
    tone = f32(tone + rng.normal(0, 0.03, (4096, 3)))
    gray = f32([0.66, 0.63, 0.58]) * plan.draw(0.5, 1.1)
    mortar = f32([0.12, 0.08, 0.05]) if material == "Wood" else gray
    color = mortar + (color * tone[number] - mortar) * body[..., None]
    tops = layout.depth * (1 + f32(rng.normal(0, 0.1, 4096))[number])
    return color, height * (0.3 + 0.7 * body) + body * tops
