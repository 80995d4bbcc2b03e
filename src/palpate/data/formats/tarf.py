"""TaRF, Tactile-Augmented Radiance Fields (Dou, Yang, Liu, Loquercio, Owens; CVPR 2024): DIGIT touches located in 13 scanned scenes.

::

    root/
      vision/<scene>_<scale>/<idx>.jpg      a view of the touched place, rendered at one or several scales
      touch/<scene>_40_30/<idx>.jpg         640x480
      touch_bg/<scene>_40_30/bg.jpg         the gel untouched, one a scene; the public code names it <scene>_colmap_40_50
      depth/<scene>_<scale>/<idx>.npy       meters; not imported
      split_interval.json                   {"train|val|test": [["<scene>_40_30", "<idx>"], ..]}; not in the public code

A scene is one recording, and the group: with 13 of them, leave scenes out. Of several scales of the views that of the touch is taken,
unless ``scale`` names another. An index is a frame number, so ``7`` and ``0007`` are the same.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from palpate.core import PARTS, PalpateError, Problem, Progress, Split, quiet, write_json
from palpate.data.formats.base import Facts, Scan
from palpate.data.formats.numbered import (
    Entry,
    assign,
    few,
    natural,
    numbered,
    read_pairs,
    require_folder,
    subfolders,
    tell,
)
from palpate.data.manifest import Manifest

SCENES = (
    "conference_room",
    "clothes",
    "office_1",
    "office_2",
    "stairs",
    "table_outdoor",
    "workroom",
    "bench",
    "snow",
    "bus_stop",
    "chair_outdoor",
    "table_indoor",
    "lounge",
)
#: Names that the public code's ``touch_bg`` folders give to scenes; for office_2 it has none that is surely the same.
BACKGROUND_NAMES = {
    "bench": "bench_outdoor_1",
    "bus_stop": "bus_stop_1",
    "lounge": "lounge_indoor_1",
    "stairs": "stairs_indoor_1",
    "table_indoor": "table_indoor_2",
    "workroom": "workroom_1",
}
SCALED = r"(?P<scene>.+)_(?P<scale>[0-9]+_[0-9]+)"
TOUCH_SCALE = "40_30"
LIST = "split_interval.json"
FACTS = Facts(
    "TaRF",
    "Y. Dou, F. Yang, Y. Liu, A. Loquercio, A. Owens: Tactile-Augmented Radiance Fields. CVPR, 2024",
    "no license found",
    "https://github.com/Dou-Yiming/TaRF",
    "DIGIT",
    (640, 480),
    "not published; 13 scenes (named in the public code)",
    "video (= scene); there are few, so leave whole scenes out in turn",
)
LOOKED_FOR = "vision/ and touch/ with folders named <scene>_40_30"


def detect(source: Path) -> bool:
    """Whether both sides have folders that end in a scale."""
    return source.is_dir() and all(_scaled(source / side) for side in ("vision", "touch"))


def scan(source: Path, *, scale: str | None = None, progress: Progress = quiet) -> Scan:
    """Pairs every touch with the view of its number.

    Args:
        source: the folder with ``vision/`` and ``touch/``.
        scale: of the views, ``"40_30"``; default: that of the touch, else the only one there is.
        progress: told how many scenes are read.

    Raises:
        PalpateError: if a side is missing, or the scale of the views is in doubt or absent.
    """
    root = Path(source)
    require_folder(root, FACTS.name)
    touch, vision = _scaled(root / "touch"), _scaled(root / "vision")
    for side, found in (("touch", touch), ("vision", vision)):
        if not found:
            raise PalpateError(
                f"{root / side} must hold folders named <scene>_40_30",
                few(subfolders(root / side)),
                f"Fetch the data from {FACTS.url}",
            )
    out = Scan([], root, facts={"layout": "vision/, touch/, touch_bg/", "text_source": "none"})
    ids: dict[tuple[str, int], str] = {}
    for done, scene in enumerate(sorted(touch, key=natural)):
        progress("reading scenes", done, len(touch))
        scales = touch[scene]
        own = TOUCH_SCALE if TOUCH_SCALE in scales else scales[0]
        if others := [s for s in scales if s != own]:
            out.suspicious.append(
                Problem(
                    f"touch/{scene}",
                    "other-scale",
                    f"touches at {', '.join(others)} are left out: {own} is read",
                )
            )
        _scene(out, scene, own, _view_scale(scene, vision.get(scene, []), own, scale), ids)
    bare = sorted(set(vision) - set(touch))
    out.problems += [
        Problem(f"vision/{scene}", "missing-folder", f"no touch folder of the scene {scene!r}")
        for scene in bare
    ]
    known = {*SCENES, *BACKGROUND_NAMES.values()}
    if unknown := sorted(s for s in touch if s.removesuffix("_colmap") not in known):
        out.suspicious.append(
            Problem(
                "touch",
                "unknown-scene",
                f"scenes that the publication does not name: {few(unknown)}",
            )
        )
    if depth := subfolders(root / "depth"):
        out.facts["depth"] = f"{len(depth)} folders of .npy files, not imported"
    if odd := [
        n
        for side in ("touch", "vision")
        for n in subfolders(root / side)
        if re.fullmatch(SCALED, n) is None
    ]:
        out.suspicious.append(
            Problem(
                str(root),
                "unknown-folder",
                f"folders not named <scene>_<scale> are left out: {few(odd)}",
            )
        )
    out.facts["vision_scale"] = ", ".join(
        sorted(
            {
                str(row["vision"]).split("/")[1].rpartition(f"{row['video']}_")[2]
                for _, row in out.rows
            }
        )
    )
    _split(out, ids)
    return out


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Writes ``split_interval.json``, with all three parts, as the public loader asks for each by name.

    Raises:
        PalpateError: if a touch does not lie in ``touch/<scene>_<scale>/``.
    """
    lists: dict[str, list[list[str]]] = {part: [] for part in PARTS}
    for part in split.counts():
        for name in manifest.part(split, part).column("tactile"):
            path = Path(str(name))
            if re.fullmatch(SCALED, path.parent.name) is None:
                raise PalpateError(
                    "A list of TaRF needs touches in touch/<scene>_40_30/",
                    str(name),
                    "Write the split file alone",
                )
            lists[part].append([path.parent.name, path.stem])
    write_json(Path(folder) / LIST, lists)
    return [Path(folder) / LIST]


def _scaled(side: Path) -> dict[str, list[str]]:
    """Scene -> its scales, of the folders in ``touch/`` or ``vision/``."""
    found: dict[str, list[str]] = {}
    for name in subfolders(side):
        if match := re.fullmatch(SCALED, name):
            found.setdefault(match["scene"], []).append(match["scale"])
    return found


def _view_scale(scene: str, there: list[str], own: str, wanted: str | None) -> str | None:
    """Which scale of a scene's views is read; None if it has none.

    Raises:
        PalpateError: if several are there and none is that of the touch, or the one asked for is absent.
    """
    if not there:
        return None
    if wanted is not None and wanted not in there:
        raise PalpateError(
            f"The views of {scene!r} must have the scale {wanted}",
            ", ".join(there),
            "Choose one of these as scale",
        )
    if wanted is None and own not in there and len(there) > 1:
        raise PalpateError(
            f"Of several scales of the views of {scene!r} one must be named",
            ", ".join(there),
            f"Pass scale={there[0]!r}",
        )
    return wanted or (own if own in there else there[0])


def _scene(
    out: Scan, scene: str, own: str, view: str | None, ids: dict[tuple[str, int], str]
) -> None:
    """Adds the pairs of one scene; ids of touches without a view are kept for the list."""
    at = f"touch/{scene}_{own}"
    touches, views = numbered(out.base / at), numbered(out.base / "vision" / f"{scene}_{view}")
    tell(touches, at, out.problems, out.suspicious)
    tell(views, f"vision/{scene}_{view}", out.problems, out.suspicious)
    background = _background(out.base, scene, own)
    if background is None:
        out.suspicious.append(
            Problem(
                at,
                "no-background",
                f"no touch_bg/{scene}_{own}/bg.jpg and no other background of this scene",
            )
        )
    if not touches.files:
        out.problems.append(Problem(at, "missing-frames", "the folder has no touch"))
    elif view is None:
        out.problems.append(
            Problem(
                at,
                "missing-folder",
                f"no vision folder of this scene: {len(touches.files)} touches without a view",
            )
        )
    for k, name in touches.files.items():
        ids[scene, k] = f"{scene}/{Path(name).stem}"
        row: dict[str, Any] = {
            "id": ids[scene, k],
            "video": scene,
            "frame": k,
            "vision": f"vision/{scene}_{view}/{views.files.get(k)}",
            "tactile": f"{at}/{name}",
            "background": background,
            "sensor": FACTS.sensor,
        }
        if k in views.files:
            out.rows.append((row["tactile"], row))
        elif view is not None:
            out.problems.append(
                Problem(
                    row["tactile"],
                    "unpaired",
                    f"no view of the number {k} in vision/{scene}_{view}",
                )
            )
    out.problems += [
        Problem(f"vision/{scene}_{view}/{name}", "unpaired", f"no touch of the number {k} in {at}")
        for k, name in views.files.items()
        if k not in touches.files
    ]


def _background(root: Path, scene: str, own: str) -> str | None:
    plain = scene.removesuffix("_colmap")
    names = [
        f"{scene}_{own}",
        *(f"{name}_colmap_40_50" for name in (plain, BACKGROUND_NAMES.get(plain, plain))),
    ]
    return next(
        (f"touch_bg/{n}/bg.jpg" for n in names if (root / "touch_bg" / n / "bg.jpg").exists()), None
    )


def _split(out: Scan, ids: dict[tuple[str, int], str]) -> None:
    """``Orig`` of the JSON list, if it is there."""
    path = out.base / LIST
    if not path.is_file():
        return
    before = len(out.problems)
    entries = read_pairs(path, out.problems)
    if entries is None:
        if len(out.problems) == before:
            out.problems.append(
                Problem(str(path), "bad-list", 'not {"train|val|test": [[scene, index], ..]}')
            )
        return
    known: list[tuple[Entry, tuple[str, int]]] = []
    for entry in entries:
        if re.fullmatch("[0-9]+", entry.second) is None:
            out.problems.append(
                Problem(entry.where, "bad-frame", f"the index {entry.second!r} is no integer")
            )
        else:
            known.append((entry, (re.sub(r"_[0-9]+_[0-9]+$", "", entry.first), int(entry.second))))
    out.parts["Orig"] = assign(path, known, ids, out.problems)
    out.rules["Orig"] = {"method": "official", "files": [LIST]}
    if rest := len(ids) - len({key for _, key in known} & set(ids)):
        out.suspicious.append(
            Problem(str(path), "unlisted", f"{rest} of {len(ids)} touches are in no part")
        )
