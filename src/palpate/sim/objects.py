"""Objects: a drawn piece of a material, with the curvature of the body that it covers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from palpate.core import rng_for
from palpate.sim.materials import MATERIALS, Material, Surface, draw_surface
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import ObjectRef
from palpate.sim.tile import TILE_MM

#: Share of the objects that are curved, and the range of their radius in mm (of dents 3.3 times as
#: much).
CURVED, RADIUS_MM = 0.4, (25.0, 90.0)


@dataclass(frozen=True)
class WorldObject:
    """An object."""

    ref: ObjectRef
    surface: Surface
    px: float  # pixel size of the tile in mm
    curvature: float  # 1 / radius in 1/mm along x of the pad, positive for a bulge; 0 for flat


def make_object(options: WorldOptions, ref: ObjectRef) -> WorldObject:
    """Make the object of that name; it depends on the seed, the name and the tile size alone."""
    return _make(options.seed, ref, MATERIALS[ref.material], options.tile)


@lru_cache(maxsize=6)
def _make(seed: int, ref: ObjectRef, material: Material, tile: int) -> WorldObject:
    rng = rng_for(seed, "world", VERSION, "object", ref.material, ref.number)
    surface = draw_surface(ref.material, material, tile, rng)
    flat = rng.random() >= CURVED
    bulge = 1.0 if rng.random() < 0.5 else -0.3
    smallest, largest = map(math.log, RADIUS_MM)
    radius = math.exp(rng.uniform(smallest, largest))
    return WorldObject(ref, surface, TILE_MM / tile, 0.0 if flat else bulge / radius)
