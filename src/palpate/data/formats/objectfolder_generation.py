"""The cross-generation benchmark of ObjectFolder-Real (Gao et al., CVPR 2023), of 50 objects.

::

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

from palpate.core import Progress, quiet
from palpate.data.formats.base import Facts, Format, Scan
from palpate.data.formats.layout import (
    is_split,
    named,
    natural,
    paired,
    read_json_file,
    read_split,
    require_folder,
    require_layout,
    subfolders,
)
from palpate.data.formats.objectfolder import CITATION, LICENSE, SENSOR
from palpate.data.formats.objectfolder import FACTS as OBJECTFOLDER

FACTS = Facts(
    name="ObjectFolder-Real, visuo-tactile cross-generation",
    citation=CITATION,
    license=LICENSE,
    url="https://github.com/objectfolder/visuo-tactile-cross-generation",
    sensor=OBJECTFOLDER.sensor,
    samples="50,000 pairs: 1,000 of each of 50 objects (stated by the benchmark)",
    group="object; cross-contact shares every object, cross-object none",
    group_column="object",
)
LOOKS_FOR = "touch/, vision/ and touch_ref/ or vision_ref/"
BACKGROUND = "touch_ref/touch_ref.png"


def detect(source: Path) -> bool:
    """Whether both sides and a folder of references are there."""
    folders = set(subfolders(source))
    return {"touch", "vision"} <= folders and not folders.isdisjoint({"touch_ref", "vision_ref"})


def scan(source: Path, *, progress: Progress = quiet) -> Scan:
    """Pair the images of ``touch/`` and ``vision/``."""
    root = require_folder(source, FACTS.name)
    sides = [subfolders(root / side) for side in ("touch", "vision")]
    require_layout(root, LOOKS_FOR, FACTS, complete=all(sides))
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


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan)
