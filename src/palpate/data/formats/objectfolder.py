"""ObjectFolder-Real (Gao et al., CVPR 2023): trials of 100 objects, as T3 and Sparsh read them.

::

    root/
      <object 1..100>/tactile_data/<trial>/0/gelsight/<k>.png     images of one press, by number
      objectfolder_real_metadata.csv                              Index,Name,Material (optional;
                                                                  from alanzjl/t3)

A trial is a recording. Its first image is taken to show the gel before contact (inferred; nothing
says so): it is the background of the others and no sample. There is no vision in this layout.
Several objects share a name, so an object is its number. JPEGs next to the PNGs are T3's copies
and are skipped.
"""

from __future__ import annotations

from pathlib import Path

from palpate.core import PalpateError, Progress, quiet
from palpate.data.formats.base import Facts, Format, Scan
from palpate.data.formats.layout import numbered, require_folder, require_layout, subfolders
from palpate.data.tables import open_table

CITATION = (
    "R. Gao et al.: The ObjectFolder Benchmark: Multisensory Learning with Neural and Real "
    "Objects. CVPR, 2023"
)
LICENSE = "unknown for ObjectFolder-Real (CC BY 4.0 is stated for ObjectFolder 2.0)"
SENSOR = "GelSight"
FACTS = Facts(
    name="ObjectFolder-Real",
    citation=CITATION,
    license=LICENSE,
    url="https://github.com/objectfolder",
    sensor="GelSight (T3 says black, Sparsh says Mini, AnyTouch files it with GelSlim)",
    samples="1,417,600 touch frames of 100 objects (counted by T3)",
    group="object",
    group_column="object",
)
LOOKS_FOR = "<object>/tactile_data/<trial>/0/gelsight/"
METADATA = "objectfolder_real_metadata.csv"


def detect(source: Path) -> bool:
    """Whether a numbered folder holds ``tactile_data/``."""
    return any((source / name / "tactile_data").is_dir() for name in _numbers(source))


def scan(source: Path, *, progress: Progress = quiet) -> Scan:
    """List the images of all trials."""
    root = require_folder(source, FACTS.name)
    require_layout(root, LOOKS_FOR, FACTS, complete=detect(root))
    facts = {"background": "first image of the trial (inferred), which is no sample"}
    facts |= {"layout": "raw trials", "text_source": "none", "vision": "none in this layout"}
    result = Scan(root, facts)
    materials = _materials(result)
    objects = _numbers(root)
    for done, name in enumerate(objects):
        progress("reading objects", done, len(objects))
        _object(result, name, materials.get(int(name)))
    _suspect_unnumbered(result, ".")
    bare = [name for name in objects if materials and int(name) not in materials]
    result.suspect(METADATA, "no-material", "objects that the table lacks", bare)
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan)


def _numbers(folder: Path) -> list[str]:
    return [name for name in subfolders(folder) if name.isdecimal()]


def _suspect_unnumbered(result: Scan, place: str) -> None:
    odd = [name for name in subfolders(result.base / place) if not name.isdecimal()]
    result.suspect(place, "unknown-folder", "skipped, as not a number", odd)


def _object(result: Scan, name: str, material: str | None) -> None:
    """Add the images of one object's trials."""
    place = f"{name}/tactile_data"
    trials = _numbers(result.base / place)
    _suspect_unnumbered(result, place)
    if not trials:
        result.problem(place, "missing-folder", "the object has no trial")
    single: list[str] = []
    for trial in trials:
        folder = f"{place}/{trial}/0/gelsight"
        images = numbered(result, folder, suffixes=(".png",))
        if not images.files:
            kind = "frames" if (result.base / folder).is_dir() else "folder"
            result.problem(folder, f"missing-{kind}", "the trial has no PNG images")
            continue
        first, *others = images.files
        if not others:  # an image cannot be its own background
            single.append(trial)
        for k in others or [first]:
            row = {
                "id": f"{name}/{trial}/{k}",
                "video": f"{name}/{trial}",
                "frame": k,
                "object": name,
                "material": material,
                "tactile": images.path(k),
                "background": images.path(first) if others else None,
                "sensor": SENSOR,
            }
            result.rows.append((images.path(k), row))
    result.suspect(place, "no-background", "trials of one image, which is a sample", single)


def _materials(result: Scan) -> dict[int, str]:
    """Object -> material from the table; empty without one."""
    path = result.base / METADATA
    if not path.is_file():
        return {}
    table = open_table(path)
    if not {"Index", "Material"} <= set(table.names):
        must = f"{path} must have the columns Index, Name, Material"
        raise PalpateError(must, ", ".join(table.names) or "none", "Fetch it again")
    materials: dict[int, str] = {}
    for line, index, material in table.read(["Index", "Material"]).iter_rows():
        where = f"{path}:{line}"
        if not material or not str(index).isdecimal():
            text = f"{index!r}, {material!r} is not an object and its material"
            result.problem(where, "bad-line", text)
        elif (before := materials.setdefault(int(index), material)) != material:
            result.problem(where, "two-labels", f"object {index} is {before} on an earlier line")
    result.problems += table.problems
    return materials
