"""The table of simulated materials: the twenty of Touch and Go, with their label ids.

A custom material is a function that draws a piece of it, and one line that adds it::

    from palpate.sim import MATERIALS, Material, Surface

    def cork(tile):  # heights in mm, colors as reflectance in [0, 1]
        return Surface(tile.noise(0.5, 4.0) * 0.1, tile.ones()[..., None] * [0.6, 0.4, 0.3], "cork")

    MATERIALS["Cork"] = Material(20, cork)

Its name then works in ``WorldOptions(materials=...)``. With more than one worker the function must
be importable (not defined in ``__main__``). A world records the material's name, not the function:
after an edit of the function, write the world into another folder.
"""

from __future__ import annotations

from palpate.core import few, require
from palpate.sim.materials.man_made import glass, metal, other, paper, plastic, rubber
from palpate.sim.materials.mineral import brick, ceramic_tile, concrete, gravel, rock, sand, soil
from palpate.sim.materials.plant import grass, plants, tree, wood
from palpate.sim.materials.soft import leather, natural_fabric, synthetic_fabric
from palpate.sim.materials.surface import Draw, Material, Surface, draw_surface

_DRAWS: dict[str, Draw] = {
    "Concrete": concrete,
    "Plastic": plastic,
    "Glass": glass,
    "Wood": wood,
    "Metal": metal,
    "Brick": brick,
    "Tile": ceramic_tile,
    "Leather": leather,
    "Synthetic Fabric": synthetic_fabric,
    "Natural Fabric": natural_fabric,
    "Rubber": rubber,
    "Paper": paper,
    "Tree": tree,
    "Grass": grass,
    "Soil": soil,
    "Rock": rock,
    "Gravel": gravel,
    "Sand": sand,
    "Plants": plants,
    "Others": other,
}
#: Name in ``category_reference.txt`` of Touch and Go -> label (its place above), function.
MATERIALS = {name: Material(label, draw) for label, (name, draw) in enumerate(_DRAWS.items())}


def object_prefix(name: str) -> str:
    """Return what the ids of a material's objects begin with: ``natural_fabric`` (``_003``)."""
    return name.lower().replace(" ", "_")


def check_material(name: str) -> None:
    """Check that no other material has the label of this one.

    Raises:
        PalpateError: naming those with the same label.
    """
    label = MATERIALS[name].label
    names = [n for n, material in MATERIALS.items() if material.label == label]
    got, fix = f"label {label} of {few(names)}", "Give the new one 20 or more"
    require(len(names) == 1, None, "Materials must differ in label", got, fix=fix)


__all__ = ["MATERIALS", "Material", "Surface", "check_material", "draw_surface", "object_prefix"]
