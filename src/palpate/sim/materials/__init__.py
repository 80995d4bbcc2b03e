"""The table of materials: Touch and Go's twenty, with their label ids.

A material of your own is one function ``(tile, rng) -> Surface`` in one file, and one line that enters it::

    from palpate.sim import MATERIALS, Material, Surface
    MATERIALS["Cork"] = Material(20, "cork", cork, ("pressed", "natural"))

Its name then works in ``WorldOptions(materials=...)``. With more than one worker the function must be importable (not defined in ``__main__``).
A world of added materials records what their functions are, and is not gone on with after they were edited.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from palpate.sim.materials.made import glass, metal, other, paper, plastic, rubber
from palpate.sim.materials.mineral import brick, ceramic_tile, concrete, gravel, rock, sand, soil
from palpate.sim.materials.plant import grass, plants, tree, wood
from palpate.sim.materials.soft import leather, natural_fabric, synthetic_fabric
from palpate.sim.materials.surface import Material, Surface, draw_surface

#: Name in ``category_reference.txt`` -> label, noun, function, subtypes.
MATERIALS: dict[str, Material] = {
    "Concrete": Material(0, "concrete", concrete, ("aggregate", "cast", "broomed")),
    "Plastic": Material(1, "plastic", plastic, ("smooth", "textured", "ribbed", "dotted")),
    "Glass": Material(2, "glass", glass, ("clear", "frosted", "fluted")),
    "Wood": Material(3, "wood", wood, ("polished", "planed", "sawn", "boards")),
    "Metal": Material(
        4, "metal", metal, ("brushed", "tread plate", "perforated", "rusted", "scratched")
    ),
    "Brick": Material(5, "brick", brick, ("laid", "face", "wire-cut")),
    "Tile": Material(6, "tile", ceramic_tile, ("glazed", "textured", "mosaic")),
    "Leather": Material(7, "leather", leather, ("pebbled", "fine", "stitched")),
    "Synthetic Fabric": Material(
        8, "synthetic fabric", synthetic_fabric, ("twill", "knit", "mesh", "rib", "plain")
    ),
    "Natural Fabric": Material(9, "natural fabric", natural_fabric, ("plain", "knit", "rib")),
    "Rubber": Material(10, "rubber", rubber, ("studded", "treaded", "ribbed", "granular")),
    "Paper": Material(11, "paper", paper, ("sheet", "corrugated", "crumpled")),
    "Tree": Material(12, "tree bark", tree, ("furrowed", "plated", "flaky")),
    "Grass": Material(13, "grass", grass, ("broad", "thin", "tangled")),
    "Soil": Material(14, "soil", soil, ("crumbs", "clods", "litter")),
    "Rock": Material(15, "rock", rock, ("craggy", "layered", "weathered")),
    "Gravel": Material(16, "gravel", gravel, ("rounded", "crushed")),
    "Sand": Material(17, "sand", sand, ("dry", "rippled", "packed")),
    "Plants": Material(18, "a plant", plants, ("raised veins", "sunken veins", "moss")),
    "Others": Material(19, "material", other, ("sponge", "carpet", "stud mat", "rope")),
}

#: The table as it comes with palpate: these are known by their name and VERSION, others by their function too.
BUILT_IN: Mapping[str, Material] = MappingProxyType(dict(MATERIALS))

__all__ = ["BUILT_IN", "MATERIALS", "Material", "Surface", "draw_surface"]
