"""Objects: a drawn piece of a material, with the curvature of the body that it covers."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

from palpate.core import rng_for
from palpate.sim.materials import MATERIALS, Material, Surface, draw_surface
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import ObjectRef

#: Share of the objects that are curved, and the range of their radius in mm, log-uniform (of dents
#: 3.3 times as much).
CURVED, RADIUS_MM = 0.4, (25.0, 90.0)


def make_object(options: WorldOptions, ref: ObjectRef) -> Surface:
    """Make the object of that name; it depends on the seed, the name and the tile size alone."""
    return _make(options.seed, ref, MATERIALS[ref.material], options.tile)


@lru_cache(maxsize=6)
def _make(seed: int, ref: ObjectRef, material: Material, tile: int) -> Surface:
    rng = rng_for(seed, "world", VERSION, "object", ref.material, ref.number)
    surface = draw_surface(ref.material, material, tile, rng)
    curved = rng.random() < CURVED
    bulge = 1.0 if rng.random() < 0.5 else -0.3
    smallest, largest = map(math.log, RADIUS_MM)
    radius = math.exp(rng.uniform(smallest, largest))
    return replace(surface, curvature=bulge / radius if curved else 0.0)
