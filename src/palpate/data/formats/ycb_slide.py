"""YCB-Slide (Suresh, Si, Anderson, Kaess, Mukadam; CoRL 2022): a DIGIT slides over 10 YCB objects.

::

    root/
      real/<object>/dataset_{0..4}/
        frames/frame_0000000.jpg           60 s of touch at 30 Hz
        webcam_frames/frame_0000000.jpg    the scene at the same time
        frames.mp4                         the same frames
        digit_data.npy synced_data.npy     pickles of poses: never opened
      sim/<object>/{00..04}/
        tactile_images/<i>.jpg             TACTO
        gt_heightmaps gt_contactmasks      skipped

A log is a video. The logs of an object slide over the same surface, so the group is the object. The
webcam shows the whole scene and not the place of contact (inferred). No image of the untouched gel
is part of the set (Sparsh ships some), so ``background`` is null.

The set has no split. ``sparsh`` is that of facebookresearch/sparsh, which trains on logs 0 to 3 and
validates on log 4 of every object (here ``test``): no log is shared, every object is.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from palpate.core import Progress, quiet, require
from palpate.data.formats.layout import (
    Images,
    numbered,
    paired,
    require_folder,
    require_layout,
    subfolders,
)
from palpate.data.scanning import Facts, Format, Scan

Part = Literal["real", "sim"]
FACTS = Facts(
    name="YCB-Slide",
    citation="S. Suresh, Z. Si, S. Anderson, M. Kaess, M. Mukadam: MidasTouch: Monte-Carlo "
    "inference over distributions across sliding touch. CoRL, 2022",
    license="CC BY-SA 4.0 (the code: MIT)",
    url="https://github.com/rpl-cmu/YCB-Slide",
    sensor="DIGIT",
    samples="10 objects x 5 logs x 60 s at 30 Hz, real; 5 simulated trajectories an object "
    "(stated by the authors)",
    group="object; at least the log (= video)",
    group_column="object",
)
LOOKS_FOR = "real/<object>/dataset_0/ or sim/<object>/00/tactile_images/"
LOGS = range(5)
#: Part -> (name of a log's folder, its tactile folder, name of a frame).
LAYOUT = {
    "real": (r"dataset_([0-9]+)", "frames", r"frame_([0-9]+)"),
    "sim": (r"([0-9]+)", "tactile_images", r"([0-9]+)"),
}
WEBCAM = "webcam_frames"
SPARSH = {
    "method": "logs 0 to 3 of every object train, log 4 (there: validation) tests",
    "source": "facebookresearch/sparsh",
}


def detect(source: Path) -> bool:
    """Whether the real or the simulated part is there."""
    return any(_logs(source / part, part) for part in LAYOUT)


def scan(source: Path, *, part: Part | None = None, progress: Progress = quiet) -> Scan:
    """List the frames of ``part`` (default: ``real`` if it is there), with those of the webcam."""
    root = require_folder(source, FACTS.name)
    require(part is None or part in LAYOUT, "part", "must be real or sim", repr(part))
    part = part or ("real" if _logs(root / "real", "real") else "sim")
    logs = _logs(root / part, part)
    require_layout(root, LOOKS_FOR, FACTS, complete=logs)
    result = Scan(root, {"layout": part, "text_source": "none"})
    if part == "sim":
        result.facts |= {"simulated": "yes", "vision": "none in this part"}
    else:
        result.split_name, result.split_rule = "sparsh", SPARSH
    for done, (name, log, folder) in enumerate(logs):
        progress("reading logs", done, len(logs))
        sparsh = None if part == "sim" or log not in LOGS else "test" if log == 4 else "train"
        _log(result, part, name, f"{part}/{name}/{folder}", sparsh)
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan)


def _logs(parent: Path, part: str) -> list[tuple[str, int, str]]:
    """(object, number of the log, its folder), in order."""
    pattern, tactile, _ = LAYOUT[part]
    logs: list[tuple[str, int, str]] = []
    for name in subfolders(parent):
        for folder in subfolders(parent / name):
            match = re.fullmatch(pattern, folder)
            if match and (part == "real" or (parent / name / folder / tactile).is_dir()):
                logs.append((name, int(match[1]), folder))
    return sorted(logs)


def _log(result: Scan, part: str, name: str, parent: str, sparsh: str | None) -> None:
    """Add the frames of one log."""
    _, folder, pattern = LAYOUT[part]
    tactile = numbered(result, f"{parent}/{folder}", pattern)
    if not tactile.files:
        result.problem(parent, "missing-frames", f"no images in {folder}/")
        return
    vision = numbered(result, f"{parent}/{WEBCAM}", pattern) if part == "real" else Images[int]("")
    if part == "real" and not vision.files:
        text = f"no frames in {WEBCAM}/: {len(tactile.files)} samples have no vision"
        result.suspect(parent, "no-vision", text)
    video = parent.partition("/")[2]
    for k in paired(result, tactile, vision) if vision.files else tactile.files:
        row = {
            "id": f"{video}/{k}",
            "video": video,
            "frame": k,
            "object": name,
            "tactile": tactile.path(k),
            "vision": vision.path(k) if vision.files else None,
            "sensor": FACTS.sensor,
            "domain": part,
            "split": sparsh,
        }
        result.rows.append((tactile.path(k), row))
