"""YCB-Slide (Suresh, Si, Anderson, Kaess, Mukadam; CoRL 2022): a DIGIT slides over 10 YCB objects, held by hand and simulated.

::

    root/
      real/<object>/dataset_{0..4}/frames/frame_0000000.jpg           60 s of touch at 30 Hz
      real/<object>/dataset_{0..4}/webcam_frames/frame_0000000.jpg    the scene at the same time
      real/<object>/dataset_{0..4}/{digit_data,synced_data}.npy       pickles of poses: never opened; frames.mp4: the same frames
      sim/<object>/{00..04}/tactile_images/<i>.jpg                    TACTO; gt_heightmaps, gt_contactmasks, *.pkl are left aside

A log is a video. The logs of an object slide over the same surface, so the group is the object. The webcam shows the whole scene and
not the place of contact (inferred). No picture of the untouched gel is part of the set (Sparsh ships some of its own), so
``background`` is null.

The set has no split. ``sparsh`` is that of facebookresearch/sparsh, which trains on logs 0 to 3 and validates on log 4 of every
object (here the part ``test``, as an audit asks for one): no log is shared, every object is.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, get_args

from palpate.core import PalpateError, Problem, Progress, quiet
from palpate.data.formats.base import Facts, Scan
from palpate.data.formats.numbered import few, numbered, require_folder, subfolders, tell

Part = Literal["real", "sim"]
FACTS = Facts(
    "YCB-Slide",
    "S. Suresh, Z. Si, S. Anderson, M. Kaess, M. Mukadam: MidasTouch: Monte-Carlo inference over distributions across sliding touch. "
    "CoRL, 2022",
    "CC BY-SA 4.0 (the code: MIT)",
    "https://github.com/rpl-cmu/YCB-Slide",
    "DIGIT",
    None,
    "10 objects x 5 logs x 60 s at 30 Hz, real; 5 simulated trajectories an object (stated by the authors)",
    "object; at least the log (= video)",
    group_column="object",
)
OBJECTS = (
    "004_sugar_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "021_bleach_cleanser",
    "025_mug",
    "035_power_drill",
    "037_scissors",
    "042_adjustable_wrench",
    "048_hammer",
    "055_baseball",
)
LOGS = range(5)
#: Part -> (name of a log's folder, folder of touch in it, name of a frame, folder of vision in it).
LAYOUT: dict[str, tuple[str, str, str, str | None]] = {
    "real": (r"dataset_([0-9]+)", "frames", r"frame_([0-9]+)", "webcam_frames"),
    "sim": (r"([0-9]+)", "tactile_images", r"([0-9]+)", None),
}
SPARSH = {
    "method": "logs 0 to 3 of every object train, log 4 (there: validation) tests",
    "source": "facebookresearch/sparsh",
}
LOOKED_FOR = "real/<object>/dataset_0/ or sim/<object>/00/tactile_images/"


def detect(source: Path) -> bool:
    """Whether the real or the simulated part is there."""
    return source.is_dir() and any(_logs(source / part, part) for part in LAYOUT)


def scan(source: Path, *, part: Part | None = None, progress: Progress = quiet) -> Scan:
    """Lists the frames of all logs, with the webcam's of the same number.

    Args:
        source: the folder with ``real/`` or ``sim/``.
        part: which of the two; default: ``real`` if it is there.
        progress: told how many logs are read.

    Raises:
        PalpateError: if the part is unknown or not there.
    """
    root = Path(source)
    require_folder(root, FACTS.name)
    if part is not None and part not in LAYOUT:
        raise PalpateError(
            f"part must be {' or '.join(get_args(Part))}", repr(part), "Choose one of these"
        )
    chosen = part or next((p for p in LAYOUT if _logs(root / p, p)), "real")
    logs = _logs(root / chosen, chosen)
    if not logs:
        raise PalpateError(
            f"{root} must hold {LOOKED_FOR}",
            few(subfolders(root)),
            f"Fetch the data from {FACTS.url}",
        )
    out = Scan([], root, facts={"layout": chosen, "text_source": "none"})
    if chosen == "sim":
        out.facts |= {"simulated": "yes", "vision": "none in this part"}
    parts: dict[str, str] = {}
    for done, (name, log, folder) in enumerate(logs):
        progress("reading logs", done, len(logs))
        before = len(out.rows)
        _log(out, chosen, name, f"{chosen}/{name}/{folder}")
        parts |= {
            str(row["id"]): "train" if log < max(LOGS) else "test"
            for _, row in out.rows[before:]
            if log in LOGS
        }
    _odd(
        out, chosen, {name: [log for other, log, _ in logs if other == name] for name, _, _ in logs}
    )
    if chosen == "real":
        out.parts["sparsh"], out.rules["sparsh"] = parts, SPARSH
    return out


def _logs(place: Path, part: str) -> list[tuple[str, int, str]]:
    """(object, number of the log, its folder), in order."""
    pattern = LAYOUT[part][0]
    found = [
        (name, log, re.fullmatch(pattern, log))
        for name in subfolders(place)
        for log in subfolders(place / name)
    ]
    logs = [(name, int(match[1]), log) for name, log, match in found if match]
    return sorted(
        log
        for log in logs
        if part == "real" or (place / log[0] / log[2] / LAYOUT[part][1]).is_dir()
    )


def _log(out: Scan, part: str, name: str, place: str) -> None:
    """Adds the frames of one log; what has no partner is told in one line a log and side."""
    _, touch, pattern, webcam = LAYOUT[part]
    frames = numbered(out.base / place / touch, pattern)
    tell(frames, f"{place}/{touch}", out.problems, out.suspicious, steady=True)
    if not frames.files:
        out.problems.append(_no_frames(out.base, place, touch))
        return
    views: dict[int, str] | None = None
    if webcam:
        found = numbered(out.base / place / webcam, pattern)
        tell(found, f"{place}/{webcam}", out.problems, out.suspicious)
        views = found.files or None
        if views is None:
            text = f"no frames in {webcam}/: the log's {len(frames.files)} touches have no vision"
            out.suspicious.append(Problem(place, "no-vision", text))
    if views is not None:
        for lost, what in (
            (frames.files.keys() - views, "touch frames without a webcam frame"),
            (views - frames.files.keys(), "webcam frames without a touch frame"),
        ):
            if lost:
                out.problems.append(Problem(place, "unpaired", f"{what}, {few(sorted(lost))}"))
    video = place.partition("/")[2]
    for k, file in frames.files.items():
        if views is None or k in views:
            tactile = f"{place}/{touch}/{file}"
            row = {
                "id": f"{video}/{k}",
                "video": video,
                "frame": k,
                "object": name,
                "tactile": tactile,
                "vision": f"{place}/{webcam}/{views[k]}" if views is not None else None,
                "sensor": FACTS.sensor,
                "domain": part,
            }
            out.rows.append((tactile, row))


def _no_frames(root: Path, place: str, touch: str) -> Problem:
    """What is missing where a log has no pictures of touch, and how to make them from its video."""
    if (root / place / f"{touch}.mp4").is_file():
        command = f"mkdir -p {touch} && ffmpeg -i {touch}.mp4 -start_number 0 -qscale:v 2 {touch}/frame_%07d.jpg"
        return Problem(
            place,
            "missing-frames",
            f"only {touch}.mp4 is there; extract it in this folder: {command}",
        )
    return Problem(place, "missing-frames", f"no pictures in {touch}/")


def _odd(out: Scan, part: str, logs: dict[str, list[int]]) -> None:
    """Tells objects and logs that differ from the published ones."""
    if unknown := [name for name in logs if name not in OBJECTS]:
        out.suspicious.append(
            Problem(
                part, "unknown-object", f"objects that are not in the publication: {few(unknown)}"
            )
        )
    if absent := [name for name in OBJECTS if name not in logs]:
        out.suspicious.append(
            Problem(
                part,
                "missing-object",
                f"of the {len(OBJECTS)} objects there are not: {few(absent)}",
            )
        )
    for name, found in logs.items():
        if found != list(LOGS):
            got = ", ".join(map(str, found))
            out.suspicious.append(
                Problem(
                    f"{part}/{name}",
                    "missing-log",
                    f"the logs {got} are there; 0 to {max(LOGS)} were published",
                )
            )
