"""The table of materials: Touch and Go's twenty, with their label ids.

A custom material is one function ``(tile, rng) -> Surface`` in one file, and one line that adds
it::

    from palpate.sim import MATERIALS, Material, Surface
    MATERIALS["Cork"] = Material(20, "cork", cork, ("pressed", "natural"))

Its name then works in ``WorldOptions(materials=...)``. With more than one worker the function must
be importable (not defined in ``__main__``). A world records the source of added materials, and is
not continued with edited ones.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

from palpate.core import PalpateError, digest_lines
from palpate.sim.materials.made import glass, metal, other, paper, plastic, rubber
from palpate.sim.materials.mineral import brick, ceramic_tile, concrete, gravel, rock, sand, soil
from palpate.sim.materials.plant import grass, plants, tree, wood
from palpate.sim.materials.soft import leather, natural_fabric, synthetic_fabric
from palpate.sim.materials.surface import Material, Surface, draw_surface

_METALS = ("brushed", "tread plate", "perforated", "rusted", "scratched")
_SYNTHETICS = ("twill", "knit", "mesh", "rib", "plain")
#: Name in ``category_reference.txt`` -> label, noun, function, subtypes.
MATERIALS: dict[str, Material] = {
    "Concrete": Material(0, "concrete", concrete, ("aggregate", "cast", "broomed")),
    "Plastic": Material(1, "plastic", plastic, ("smooth", "textured", "ribbed", "dotted")),
    "Glass": Material(2, "glass", glass, ("clear", "frosted", "fluted")),
    "Wood": Material(3, "wood", wood, ("polished", "planed", "sawn", "boards")),
    "Metal": Material(4, "metal", metal, _METALS),
    "Brick": Material(5, "brick", brick, ("laid", "face", "wire-cut")),
    "Tile": Material(6, "tile", ceramic_tile, ("glazed", "textured", "mosaic")),
    "Leather": Material(7, "leather", leather, ("pebbled", "fine", "stitched")),
    "Synthetic Fabric": Material(8, "synthetic fabric", synthetic_fabric, _SYNTHETICS),
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
_BUILT_IN = dict(MATERIALS)
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


def added_materials(names: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return name -> label, noun, subtypes and source digest of materials that are not built in."""
    added: dict[str, dict[str, Any]] = {}
    for name in names:
        material = MATERIALS[name]
        if _BUILT_IN.get(name) != material:
            facts = {"label": material.label, "noun": material.noun}
            source = digest_lines(_source(material.draw).splitlines())
            added[name] = {**facts, "subtypes": list(material.subtypes), "function": source}
    return added


def _source(function: Any) -> str:
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):  # typed at a prompt, or not a plain function
        return getattr(function, "__qualname__", type(function).__name__)


__all__ = [
    "MATERIALS",
    "Material",
    "Surface",
    "added_materials",
    "check_material",
    "draw_surface",
    "object_prefix",
]
