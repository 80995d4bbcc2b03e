"""ObjectFolder-Real (Gao et al., CVPR 2023): trials of 100 objects, and pairs of 50 of them.

**Trials**, as T3 and Sparsh read them::

    root/
      <object 1..100>/tactile_data/<trial>/0/gelsight/<k>.png     images of one press, by number
      objectfolder_real_metadata.csv                              Index,Name,Material (optional;
                                                                  from alanzjl/t3)

A trial is a recording. Its first image is taken to show the gel before contact (inferred; nothing
says so): it is the background of the others and no sample. There is no vision in this layout.
Several objects share a name, so an object is its number. JPEGs next to the PNGs are T3's copies
and are skipped.

**Pairs**, of the cross-generation benchmark::

    root/
      touch/<object>/<contact>.png   vision/<object>/<contact>.png
      touch_ref/touch_ref.png        the untouched gel, one for all
      vision_ref/<object>.png        not imported
      *.json                         {"train|val|test": [[object, contact], ..]}

The contacts of an object are in no order of time, so ``video`` and ``frame`` are null and the
object is the group. One list gives the split ``Orig``; several (cross-contact, cross-object) give
one split each, named as the file. Cross-contact shares every object between train and test.
"""

from __future__ import annotations

from pathlib import Path

from palpate.core import Progress, quiet, require
from palpate.data.formats.layout import (
    is_split,
    named,
    natural,
    numbered,
    paired,
    read_json_file,
    read_split,
    require_folder,
    require_layout,
    subfolders,
)
from palpate.data.scanning import Facts, Format, Scan
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


def _suspect_unnumbered(result: Scan, folder: str) -> None:
    odd = [name for name in subfolders(result.base / folder) if not name.isdecimal()]
    result.suspect(folder, "unknown-folder", "skipped, as not a number", odd)


def _object(result: Scan, name: str, material: str | None) -> None:
    """Add the images of one object's trials."""
    parent = f"{name}/tactile_data"
    trials = _numbers(result.base / parent)
    _suspect_unnumbered(result, parent)
    if not trials:
        result.problem(parent, "missing-folder", "the object has no trial")
    single: list[str] = []
    for trial in trials:
        folder = f"{parent}/{trial}/0/gelsight"
        images = numbered(result, folder, suffixes=(".png",))
        if not images.files:
            kind = "frames" if (result.base / folder).is_dir() else "folder"
            result.problem(folder, f"missing-{kind}", "the trial has no PNG images")
            continue
        first, *further = images.files
        if not further:  # an image cannot be its own background
            single.append(trial)
        for k in further or [first]:
            row = {
                "id": f"{name}/{trial}/{k}",
                "video": f"{name}/{trial}",
                "frame": k,
                "object": name,
                "material": material,
                "tactile": images.path(k),
                "background": images.path(first) if further else None,
                "sensor": SENSOR,
            }
            result.rows.append((images.path(k), row))
    result.suspect(parent, "no-background", "trials of one image, which is a sample", single)


def _materials(result: Scan) -> dict[int, str]:
    """Object -> material from the table; empty without one."""
    path = result.base / METADATA
    if not path.is_file():
        return {}
    table = open_table(path)
    must = f"{path} must have the columns Index, Name, Material"
    fix = "Fetch it again"
    got = ", ".join(table.names) or "none"
    require({"Index", "Material"} <= set(table.names), None, must, got, fix=fix)
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


PAIRED = Facts(
    name="ObjectFolder-Real, visuo-tactile cross-generation",
    citation=CITATION,
    license=LICENSE,
    url="https://github.com/objectfolder/visuo-tactile-cross-generation",
    sensor=FACTS.sensor,
    samples="50,000 pairs: 1,000 of each of 50 objects (stated by the benchmark)",
    group="object; cross-contact shares every object, cross-object none",
    group_column="object",
)
PAIRED_LOOKS_FOR = "touch/, vision/ and touch_ref/ or vision_ref/"
BACKGROUND = "touch_ref/touch_ref.png"


def detect_paired(source: Path) -> bool:
    """Whether both sides and a folder of references are there."""
    folders = set(subfolders(source))
    return {"touch", "vision"} <= folders and not folders.isdisjoint({"touch_ref", "vision_ref"})


def scan_paired(source: Path, *, progress: Progress = quiet) -> Scan:
    """Pair the images of ``touch/`` and ``vision/``."""
    root = require_folder(source, PAIRED.name)
    sides = [subfolders(root / side) for side in ("touch", "vision")]
    require_layout(root, PAIRED_LOOKS_FOR, PAIRED, complete=all(sides))
    result = Scan(root, {"layout": "cross-generation benchmark", "text_source": "none"})
    background = BACKGROUND if (root / BACKGROUND).exists() else None
    if background is None:
        result.suspect("touch_ref", "no-background", "no touch_ref.png, so no backgrounds")
    ids: dict[tuple[str, str], str] = {}
    objects = sorted(set().union(*sides), key=natural)
    for done, name in enumerate(objects):
        progress("reading objects", done, len(objects))
        tactile, vision = (named(result, f"{side}/{name}") for side in ("touch", "vision"))
        ids |= {(name, contact): f"{name}/{contact}" for contact in tactile.files}
        for contact in paired(result, tactile, vision):
            row = {
                "id": ids[name, contact],
                "object": name,
                "vision": vision.path(contact),
                "tactile": tactile.path(contact),
                "background": background,
                "sensor": SENSOR,
            }
            result.rows.append((tactile.path(contact), row))
    for path in sorted(root.glob("*.json")):
        data = read_json_file(result, path)
        if is_split(data):
            key = lambda folder, name: (folder, name)
            result.splits[path.stem] = read_split(result, path, data, ids, key)
        elif data is not None:
            text = 'skipped, as not {"train|val|test": [[object, contact], ..]}'
            result.suspect(path, "unknown-file", text)
    if len(result.splits) == 1:
        result.splits = {"Orig": result.splits.popitem()[1]}
    return result


GENERATION = Format(PAIRED, detect_paired, PAIRED_LOOKS_FOR, scan_paired)
