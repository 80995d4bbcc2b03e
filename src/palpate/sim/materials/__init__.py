"""The table of materials: Touch and Go's twenty, with their label ids.

A custom material is one function ``(tile, rng) -> Surface`` in one file, and one line that adds
it::

    from palpate.sim import MATERIALS, Material, Surface
    MATERIALS["Cork"] = Material(20, cork, ("pressed", "natural"))

Its name then works in ``WorldOptions(materials=...)``. With more than one worker the function must
be importable (not defined in ``__main__``). A world does not record the function: after an edit
write another one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from palpate.core import PalpateError
from palpate.sim.materials.made import glass, metal, other, paper, plastic, rubber
from palpate.sim.materials.mineral import brick, ceramic_tile, concrete, gravel, rock, sand, soil
from palpate.sim.materials.plant import grass, plants, tree, wood
from palpate.sim.materials.soft import leather, natural_fabric, synthetic_fabric
from palpate.sim.materials.surface import Material, Surface, draw_surface

_METALS = ("brushed", "tread plate", "perforated", "rusted", "scratched")
_SYNTHETICS = ("twill", "knit", "mesh", "rib", "plain")
#: Name in ``category_reference.txt`` -> label, function, subtypes.
MATERIALS: dict[str, Material] = {
    "Concrete": Material(0, concrete, ("aggregate", "cast", "broomed")),
    "Plastic": Material(1, plastic, ("smooth", "textured", "ribbed", "dotted")),
    "Glass": Material(2, glass, ("clear", "frosted", "fluted")),
    "Wood": Material(3, wood, ("polished", "planed", "sawn", "boards")),
    "Metal": Material(4, metal, _METALS),
    "Brick": Material(5, brick, ("laid", "face", "wire-cut")),
    "Tile": Material(6, ceramic_tile, ("glazed", "textured", "mosaic")),
    "Leather": Material(7, leather, ("pebbled", "fine", "stitched")),
    "Synthetic Fabric": Material(8, synthetic_fabric, _SYNTHETICS),
    "Natural Fabric": Material(9, natural_fabric, ("plain", "knit", "rib")),
    "Rubber": Material(10, rubber, ("studded", "treaded", "ribbed", "granular")),
    "Paper": Material(11, paper, ("sheet", "corrugated", "crumpled")),
    "Tree": Material(12, tree, ("furrowed", "plated", "flaky")),
    "Grass": Material(13, grass, ("broad", "thin", "tangled")),
    "Soil": Material(14, soil, ("crumbs", "clods", "litter")),
    "Rock": Material(15, rock, ("craggy", "layered", "weathered")),
    "Gravel": Material(16, gravel, ("rounded", "crushed")),
    "Sand": Material(17, sand, ("dry", "rippled", "packed")),
    "Plants": Material(18, plants, ("raised veins", "sunken veins", "moss")),
    "Others": Material(19, other, ("sponge", "carpet", "stud mat", "rope")),
}
#: What a material may be called: names are parts of lists and ids.
_NAME = re.compile(r"[A-Za-z0-9_()-]+(?: [A-Za-z0-9_()-]+)*")


def object_prefix(name: str) -> str:
    """Return the beginning of the ids of a material's objects, e.g. ``natural_fabric``."""
    return name.lower().replace(" ", "_")


def check_material(name: str) -> Iterator[PalpateError]:
    """Yield what is wrong with the entry of a material, by itself and next to the others."""
    entry, fix = MATERIALS[name], f"Correct MATERIALS[{name!r}]"
    if not _NAME.fullmatch(name):
        must = "The name of a material must consist of letters, digits, _ ( ) - and single spaces"
        yield PalpateError(must, ascii(name), "Add it under another name")
    if not 0 <= entry.label < 2**31:
        must = f"The label of {name!r} must be a whole number from 0 to 2147483647"
        yield PalpateError(must, repr(entry.label), fix)
    for second, material in MATERIALS.items():
        if second == name:
            continue
        if material.label == entry.label:
            got = f"label {entry.label} of {name!r} and {second!r}"
            yield PalpateError("Materials must differ in label", got, "Give the new one 20 or more")
        if object_prefix(second) == object_prefix(name):
            must = "Objects of two materials must differ in name"
            yield PalpateError(must, f"{name!r} and {second!r}", "Give the new one another name")


__all__ = ["MATERIALS", "Material", "Surface", "check_material", "draw_surface", "object_prefix"]
