"""VisGel (Li, Zhu, Tedrake, Torralba; CVPR 2019): a robot with a GelSight pokes objects.

**With lists**, ``data_lst/{train,eval}_{vision2touch,touch2vision}.txt``, a line is one sample, 8
paths separated by spaces::

    ref_src ref_des src des src_pre_0 src_pre_1 src_nxt_0 src_nxt_1

The source is vision in the lists of vision2touch and touch in those of touch2vision; the other is
the destination. ``ref_*`` show no contact; the four neighbors of the source in time are not
imported. The paths start at ``root``.

**Without lists**, recordings are the folders that hold ``frameNNNN.jpg``::

    root/
      data_seen/touch/<n>/<recording>/frame0000.jpg     frame0000 is the no-contact reference:
      data_seen/vision/<n>/<recording>/frame0000.jpg    the background, and no sample

In the tree that T3 reads (``<root>/<n>/<recording>/``) all is touch and ``vision`` is null.

A recording is a video, the group. Its name is its path without the side, ``data_seen/12/rec``;
``seen`` or ``unseen`` in it is the domain.

Most frames touch nothing: T3 keeps 726,740 of 3,170,795.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import islice
from pathlib import Path

from palpate.core import Progress, Split, few, quiet, require
from palpate.data.formats.layout import (
    Images,
    natural,
    numbered,
    paired,
    report_missing_folders,
    require_folder,
)
from palpate.data.scanning import Cells, Facts, Format, Row, Scan

FACTS = Facts(
    name="VisGel",
    citation="Y. Li, J.-Y. Zhu, R. Tedrake, A. Torralba: Connecting Touch and Vision via "
    "Cross-Modal Prediction. CVPR, 2019",
    license="no license found",
    url="https://github.com/YunzhuLi/VisGel",
    sensor="GelSight",
    samples="3,170,795 touch frames, 726,740 of them in contact (counted by T3)",
    group="video (= recording); the column domain says whether its objects are seen or unseen",
)
LOOKS_FOR = (
    "data_lst/{train,eval}_{vision2touch,touch2vision}.txt, or recordings "
    "<n>/<recording>/frame0000.jpg"
)
LISTS = "data_lst"
DIRECTIONS = ("vision2touch", "touch2vision")
#: Part -> the word in the names of the lists.
WORDS = {"train": "train", "test": "eval"}
FIELDS = 8
FRAME = r"frame([0-9]{1,18})"
SIDES = ("touch", "vision")
#: How deep recordings may be below the source, and how many folders ``detect`` opens.
DEPTH, PEEKS = 6, 60


def detect(source: Path) -> bool:
    """Whether there are lists of these names, or within the first folders a reference frame."""
    if _lists(source):
        return True
    folders = islice(_walk(source), PEEKS)
    return any(folder != "." and "frame0000.jpg" in names for folder, names in folders)


def scan(source: Path, *, root: Path | None = None, progress: Progress = quiet) -> Scan:
    """Read the lists, or find the recordings where there are none.

    Options:
        root: where the paths of the lists start; default: the source.
    """
    source = require_folder(source, FACTS.name)
    lists = _lists(source)
    result = Scan(Path(root) if root and lists else source, {"text_source": "none"})
    result.facts["layout"] = "lists" if lists else "recordings"
    if lists:
        _read_lists(result, lists, progress)
    else:
        _read_recordings(result, progress)
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan)


def _lists(source: Path) -> dict[tuple[str, str], Path]:
    """(part, direction) -> list, from ``data_lst/`` or the folder itself."""
    for folder in (source / LISTS, source):
        keys = [(part, way) for part in WORDS for way in DIRECTIONS]
        paths = {(part, way): folder / f"{WORDS[part]}_{way}.txt" for part, way in keys}
        if lists := {key: path for key, path in paths.items() if path.is_file()}:
            return lists
    return {}


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines that are not blank, one by one: a list has hundreds of megabytes."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if text := line.strip():
                yield number, text


def _row(fields: Sequence[str], way: str) -> Cells | None:
    """The cells of a line, or None if its tactile image is no numbered frame."""
    names = [name.removeprefix("./") for name in fields[:4]]
    if way == "vision2touch":
        _, background, vision, tactile = names
    else:
        background, _, tactile, vision = names
    folder, _, name = tactile.rpartition("/")
    match = re.fullmatch(FRAME, name.rpartition(".")[0])
    return _cells(_recording(folder), int(match[1]), vision, tactile, background) if match else None


def _cells(
    video: str, frame: int, vision: str | None, tactile: str, background: str | None
) -> Cells:
    lower = video.lower()
    return {
        "id": f"{video}/{frame}",
        "video": video,
        "frame": frame,
        "vision": vision,
        "tactile": tactile,
        "background": background,
        "sensor": FACTS.sensor,
        "domain": "unseen" if "unseen" in lower else "seen" if "seen" in lower else None,
    }


@lru_cache(maxsize=4096)
def _recording(folder: str) -> str:
    """The name of a recording: its folders without the side."""
    return "/".join(part for part in folder.split("/") if part.lower() not in SIDES) or "."


def _read_lists(result: Scan, lists: dict[tuple[str, str], Path], progress: Progress) -> None:
    """Rows of all lists, each sample once; the parts by direction, as one split if they agree."""
    rows: dict[str, Row] = {}
    parts: dict[str, dict[str, str]] = {}
    for done, ((part, way), path) in enumerate(lists.items()):
        progress("reading lists", done, len(lists))
        here: dict[str, str] = {}
        in_way = parts.setdefault(way, {})
        for number, text in _lines(path):
            where, fields = f"{path}:{number}", text.split()
            row = _row(fields, way) if len(fields) == FIELDS else None
            if "\ufffd" in text:
                result.problem(where, "bad-encoding", f"the line {text[:80]!r} is not UTF-8")
            elif len(fields) != FIELDS:
                result.problem(where, "bad-line", f"{len(fields)} paths instead of {FIELDS}")
            elif row is None:
                result.problem(where, "bad-frame", "its tactile image is no frameNNNN")
            elif (i := row["id"]) in here:
                text = f"{i} is listed at {here[i]} already"
                result.problem(where, "duplicate-row", text)
            else:
                here[i] = where
                rows.setdefault(i, (where, row))
                if in_way.setdefault(i, part) != part:
                    in_way[i] = ""
                    text = f"{i} is in both lists of its direction, so in no part"
                    result.problem(where, "two-parts", text)
    result.rows = list(rows.values())
    report_missing_folders(result)
    joined = {i: part for in_way in parts.values() for i, part in in_way.items()}
    agree = all(joined[i] == part for in_way in parts.values() for i, part in in_way.items())
    splits = {"Orig": joined} if agree else {f"Orig-{way}": parts[way] for way in parts}
    for name, split in splits.items():
        files = [path.name for path in lists.values() if agree or name[5:] in path.name]
        rule = {"method": "official", "files": files}
        result.splits[name] = Split({i: part for i, part in split.items() if part}, rule)


def _read_recordings(result: Scan, progress: Progress) -> None:
    """Rows of the folders that hold frames."""
    places: dict[str, dict[str, str]] = {"touch": {}, "vision": {}}
    for folder, names in _walk(result.base):
        if any(re.fullmatch(FRAME, name.rpartition(".")[0]) for name in names):
            side = next((p.lower() for p in folder.split("/") if p.lower() in SIDES), "touch")
            places[side][_recording(folder)] = folder
    got = few(sorted(places["vision"])) + " of vision"
    fix = f"See {FACTS.url}"
    require(bool(places["touch"]), None, f"{result.base} must hold {LOOKS_FOR}", got, fix=fix)
    if not places["vision"]:
        result.facts["vision"] = "none in this layout"
    videos = sorted(places["touch"], key=lambda video: [natural(p) for p in video.split("/")])
    bare: list[str] = []
    for done, video in enumerate(videos):
        progress("reading recordings", done, len(videos))
        tactile = numbered(result, places["touch"][video], FRAME)
        reference = tactile.files.pop(0, None)
        background = f"{tactile.folder}/{reference}" if reference else None
        bare += [] if reference else [video]
        vision: Images[int] | None = None
        if places["vision"]:
            source = places["vision"].get(video, f"vision of {video}")
            vision = numbered(result, source, FRAME)
            vision.files.pop(0, None)
        for k in tactile.files if vision is None else paired(result, tactile, vision):
            view = vision.path(k) if vision else None
            row = _cells(video, k, view, tactile.path(k), background)
            result.rows.append((tactile.path(k), row))
    lone = sorted(places["vision"].keys() - places["touch"].keys())
    for video in lone:
        result.problem(places["vision"][video], "unpaired", "a recording of vision without touch")
    result.suspect(result.base, "no-background", "recordings without the reference frame0000", bare)


def _walk(root: Path) -> Iterator[tuple[str, list[str]]]:
    """(folder relative to the root, its files), in order, to a limited depth."""
    for folder, below, names in os.walk(root):
        relative = Path(folder).relative_to(root)
        deeper = len(relative.parts) < DEPTH
        below[:] = sorted((n for n in below if deeper and not n.startswith(".")), key=natural)
        yield relative.as_posix(), names
