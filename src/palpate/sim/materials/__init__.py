"""The table of materials: Touch and Go's twenty, with their label ids.

A custom material is one function ``(tile) -> Surface`` in one file, and one line that adds
it::

    from palpate.sim import MATERIALS, Material, Surface
    MATERIALS["Cork"] = Material(20, cork)

Its name then works in ``WorldOptions(materials=...)``. With more than one worker the function must
be importable (not defined in ``__main__``). A world does not record the function: after an edit
write another one.
"""

from __future__ import annotations

from palpate.core import few, require
from palpate.sim.materials.made import glass, metal, other, paper, plastic, rubber
from palpate.sim.materials.mineral import brick, ceramic_tile, concrete, gravel, rock, sand, soil
from palpate.sim.materials.plant import grass, plants, tree, wood
from palpate.sim.materials.soft import leather, natural_fabric, synthetic_fabric
from palpate.sim.materials.surface import Material, Surface, draw_surface

#: Name in ``category_reference.txt`` -> label, function.
MATERIALS: dict[str, Material] = {
    "Concrete": Material(0, concrete),
    "Plastic": Material(1, plastic),
    "Glass": Material(2, glass),
    "Wood": Material(3, wood),
    "Metal": Material(4, metal),
    "Brick": Material(5, brick),
    "Tile": Material(6, ceramic_tile),
    "Leather": Material(7, leather),
    "Synthetic Fabric": Material(8, synthetic_fabric),
    "Natural Fabric": Material(9, natural_fabric),
    "Rubber": Material(10, rubber),
    "Paper": Material(11, paper),
    "Tree": Material(12, tree),
    "Grass": Material(13, grass),
    "Soil": Material(14, soil),
    "Rock": Material(15, rock),
    "Gravel": Material(16, gravel),
    "Sand": Material(17, sand),
    "Plants": Material(18, plants),
    "Others": Material(19, other),
}


def object_prefix(name: str) -> str:
    """Return the beginning of the ids of a material's objects, e.g. ``natural_fabric``."""
    return name.lower().replace(" ", "_")


def check_material(name: str) -> None:
    """Check that no other material has the label of this one.

    Raises:
        PalpateError: if one has.
    """
    label = MATERIALS[name].label
    names = [n for n, material in MATERIALS.items() if material.label == label]
    got, fix = f"label {label} of {few(names)}", "Give the new one 20 or more"
    require(len(names) == 1, None, "Materials must differ in label", got, fix=fix)


__all__ = ["MATERIALS", "Material", "Surface", "check_material", "draw_surface", "object_prefix"]
