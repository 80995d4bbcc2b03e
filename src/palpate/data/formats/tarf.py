"""TaRF, Tactile-Augmented Radiance Fields (Dou, Yang, Liu, Loquercio, Owens; CVPR 2024).

DIGIT touches located in 13 scanned scenes::

    root/
      vision/<scene>_<scale>/<idx>.jpg      a view of the touched place, rendered at some scales
      touch/<scene>_40_30/<idx>.jpg         640x480
      touch_bg/<scene>_40_30/bg.jpg         the untouched gel, one a scene; the public code
                                            names the folder <scene>_colmap_40_50
      depth/<scene>_<scale>/<idx>.npy       meters; not imported
      split_interval.json                   {"train|val|test": [["<scene>_40_30", "<idx>"], ..]};
                                            not in the public code

A scene is one recording, and the group: with 13 of them, leave scenes out. Of several scales the
views of that of the touch are read. An index is a frame number, so ``7`` and ``0007`` are the same.
"""

from __future__ import annotations

import re
from pathlib import Path

from palpate.core import Progress, quiet, require
from palpate.data.formats.layout import (
    is_split,
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

FACTS = Facts(
    name="TaRF",
    citation="Y. Dou, F. Yang, Y. Liu, A. Loquercio, A. Owens: Tactile-Augmented Radiance Fields. "
    "CVPR, 2024",
    license="no license found",
    url="https://github.com/Dou-Yiming/TaRF",
    sensor="DIGIT",
    image_size=(640, 480),
    samples="not published; 13 scenes (named in the public code)",
    group="video (= scene); there are few, so leave whole scenes out in turn",
)
LOOKS_FOR = "vision/ and touch/ with folders named <scene>_40_30"
#: Names of scenes in the ``touch_bg`` folders of the public code; that of office_2 is uncertain.
BACKGROUND_NAMES = {
    "bench": "bench_outdoor_1",
    "bus_stop": "bus_stop_1",
    "lounge": "lounge_indoor_1",
    "stairs": "stairs_indoor_1",
    "table_indoor": "table_indoor_2",
    "workroom": "workroom_1",
}
SCALED = r"(.+)_([0-9]+_[0-9]+)"
TACTILE_SCALE = "40_30"
LIST = "split_interval.json"


def detect(source: Path) -> bool:
    """Whether both sides have folders that end in a scale."""
    return all(_scenes(source / side) for side in ("vision", "touch"))


def scan(source: Path, *, progress: Progress = quiet) -> Scan:
    """Pair every tactile image with the view of its number."""
    root = require_folder(source, FACTS.name)
    tactile, vision = _scenes(root / "touch"), _scenes(root / "vision")
    require_layout(root, LOOKS_FOR, FACTS, complete=tactile and vision)
    result = Scan(root, {"layout": "vision/, touch/, touch_bg/", "text_source": "none"})
    ids: dict[tuple[str, int], str] = {}
    used: set[str] = set()
    for done, scene in enumerate(sorted({*tactile, *vision}, key=natural)):
        progress("reading scenes", done, len(tactile))
        scales = vision.get(scene, [])
        scale = scales[0] if len(scales) == 1 else TACTILE_SCALE
        must, got = f"The views of {scene!r} must have the scale {scale}", ", ".join(scales)
        fix = "Keep one scale, or fetch that one"
        require(not scales or scale in scales, None, must, got, fix=fix)
        used |= {scale} if scene in tactile and scales else set()
        _scene(result, scene, scale, ids)
    names = [name for side in ("touch", "vision") for name in subfolders(root / side)]
    odd = [name for name in names if not re.fullmatch(SCALED, name)]
    result.suspect(root, "unknown-folder", "skipped, as not named <scene>_<scale>", odd)
    result.facts["vision_scale"] = ", ".join(sorted(used))
    path = root / LIST
    data = read_json_file(result, path) if path.is_file() else None
    if is_split(data):
        result.splits["Orig"] = read_split(result, path, data, ids, _key)
    elif data is not None:
        result.problem(path, "bad-json", 'not {"train|val|test": [[scene, index], ..]}')
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan)


def _scenes(side: Path) -> dict[str, list[str]]:
    """Scene -> its scales, of the folders in ``touch/`` or ``vision/``."""
    scenes: dict[str, list[str]] = {}
    for name in subfolders(side):
        if match := re.fullmatch(SCALED, name):
            scenes.setdefault(match[1], []).append(match[2])
    return scenes


def _scene(result: Scan, scene: str, view_scale: str, ids: dict[tuple[str, int], str]) -> None:
    """Add the pairs of one scene; the list may also name tactile images without a view."""
    tactile = numbered(result, f"touch/{scene}_{TACTILE_SCALE}")
    vision = numbered(result, f"vision/{scene}_{view_scale}")
    ids |= {(scene, k): f"{scene}/{Path(name).stem}" for k, name in tactile.files.items()}
    plain = scene.removesuffix("_colmap")
    names = [f"{scene}_{TACTILE_SCALE}", f"{plain}_colmap_40_50"]
    names.append(f"{BACKGROUND_NAMES.get(plain, plain)}_colmap_40_50")
    paths = [f"touch_bg/{name}/bg.jpg" for name in names]
    background = next((path for path in paths if (result.base / path).exists()), None)
    if background is None and tactile.files:
        result.suspect(tactile.folder, "no-background", "no touch_bg/ image of this scene")
    for k in paired(result, tactile, vision):
        row = {
            "id": ids[scene, k],
            "video": scene,
            "frame": k,
            "vision": vision.path(k),
            "tactile": tactile.path(k),
            "background": background,
            "sensor": FACTS.sensor,
        }
        result.rows.append((tactile.path(k), row))


def _key(scene: str, index: str) -> tuple[str, int] | None:
    """Scene and number of an entry of the list."""
    return (re.sub(r"_[0-9]+_[0-9]+$", "", scene), int(index)) if index.isdecimal() else None
