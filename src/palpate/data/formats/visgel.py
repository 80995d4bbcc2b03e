"""VisGel (Li, Zhu, Tedrake, Torralba; CVPR 2019): a robot pokes objects; a camera and a GelSight record frame by frame.

**With lists**, ``data_lst/{train,eval}_{vision2touch,touch2vision}.txt``, one sample a line, 8 paths parted by spaces::

    ref_src ref_des src des src_pre_0 src_pre_1 src_nxt_0 src_nxt_1

The source is vision in the lists of vision2touch and touch in those of touch2vision; the other is the destination.
``ref_*`` show no contact; the four neighbors of the source in time are not imported. The paths start at ``root``.

**Without lists**, recordings are the folders that hold ``frameNNNN.jpg``. ``frame0000`` is the no-contact reference, hence
the background and no sample. A folder ``touch`` on the way marks the touch side, ``vision`` that of the camera; without either, as in
the tree that T3 reads (``<root>/<n>/<recording>/``), all is touch and ``vision`` is null.

A recording is a video, the group. Its name is its path without the side, ``data_seen/12/rec``; ``seen`` or ``unseen`` in it is the domain.

Most frames touch nothing. The contact of a frame is the variance of the Laplacian of (frame - reference) in gray levels;
T3 keeps contact > 18, which leaves 726,740 of 3,170,795 frames. ``min_contact`` does so (on luma, while T3 weighs red and blue the other
way round); by default all frames stay, and a look at a few tells whether most are flat.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from palpate.core import PalpateError, Problem, Progress, Split, inside, quiet, write_text
from palpate.data.formats.base import Facts, Found, Scan
from palpate.data.formats.numbered import few, natural, numbered, require_folder, tell
from palpate.data.images import Check, in_threads, read_image
from palpate.data.listing import write_table
from palpate.data.manifest import CLIMBS, Manifest

FACTS = Facts(
    "VisGel",
    "Y. Li, J.-Y. Zhu, R. Tedrake, A. Torralba: Connecting Touch and Vision via Cross-Modal Prediction. CVPR, 2019",
    "no license found",
    "https://github.com/YunzhuLi/VisGel",
    "GelSight",
    None,
    "3,170,795 touch frames, 726,740 of them in contact (counted by T3)",
    "video (= recording); seen and unseen objects stand in the column domain",
    {
        "touch in contact, 50 images (T3)": (
            (0.36917, 0.51738, 0.51782),
            (0.13530, 0.11039, 0.10001),
        )
    },
)
LISTS = "data_lst"
DIRECTIONS = ("vision2touch", "touch2vision")
#: Part of ours -> the word in the lists' names.
WORDS = {"train": "train", "val": "val", "test": "eval"}
FIELDS = 8
FRAME = r"frame_?([0-9]{1,18})"
SIDES = {
    "touch": "tactile",
    "tactile": "tactile",
    "gelsight": "tactile",
    "vision": "vision",
    "rgb": "vision",
}
LOOKED_FOR = f"{LISTS}/{{train,eval}}_{{vision2touch,touch2vision}}.txt, or recordings <n>/<recording>/frame0000.jpg"
#: How deep recordings may lie below the source, and how many folders ``detect`` opens.
DEPTH, PEEKS = 6, 60
#: T3's threshold for contact, and how many frames are looked at where nobody asked for one.
FLAT, LOOKS = 18.0, 64


def detect(source: Path) -> bool:
    """Whether there are lists of the names, or within a few folders a reference frame."""
    return source.is_dir() and (bool(_lists(source)) or _peek(source))


def scan(
    source: Path,
    *,
    root: Path | None = None,
    prefix: str = "",
    min_contact: float | None = None,
    check: Check = "decode",
    progress: Progress = quiet,
) -> Scan:
    """Reads the lists, or finds the recordings where there are none.

    Args:
        source: the folder with ``data_lst/``, or one with recordings.
        root: where the paths of the lists start; default: the source.
        prefix: beginning of the listed paths to take away, where they were written for another disk.
        min_contact: leave frames of this contact or less out; T3 takes 18. Reads every frame.
        check: ``decode`` looks at 64 frames to tell whether most are flat.
        progress: told how many recordings or lines are read.

    Raises:
        PalpateError: if the source is no folder, or has neither lists nor recordings.
    """
    source = Path(source)
    require_folder(source, FACTS.name)
    lists = _lists(source)
    if lists:
        out = Scan(
            [],
            Path(root) if root is not None else source,
            facts={"layout": "lists", "prefix": prefix},
        )
        out.facts["lists"] = os.path.relpath(
            next(iter(lists.values())).parent.resolve(), out.base.resolve()
        )
        _read_lists(out, lists, prefix, progress)
    else:
        out = Scan([], source, facts={"layout": "recordings"})
        _read_recordings(out, progress)
    out.facts["text_source"] = "none"
    if min_contact is not None:
        _leave_flat(out, min_contact, progress)
    elif check == "decode" and out.rows:
        step = -(-len(out.rows) // LOOKS)
        looks = [c for c in _contacts(out.base, out.rows[::step], quiet).values() if c is not None]
        if (flat := sum(c <= FLAT for c in looks)) * 2 > len(looks):
            text = f"{flat} of {len(looks)} frames looked at touch nothing (contact of {FLAT:g} or less); min_contact={FLAT:g} leaves such out"
            out.suspicious.append(Problem(str(out.base), "flat-frames", text))
    return out


def contact(frame: np.ndarray, reference: np.ndarray) -> float:
    """Variance of the Laplacian (4 neighbors, mirrored at the edge) of (frame - reference); both (h, w), gray, 0 to 255."""
    from scipy.ndimage import (
        laplace,
    )  # every command imports all formats, and this takes an eighth of a second

    return float(
        laplace(frame.astype(np.float64) - reference.astype(np.float64), mode="mirror").var()
    )


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Writes ``{train,val,eval}_{vision2touch,touch2vision}.txt`` of the data set's own lines, as they name frames that a manifest lacks.

    Of recordings without lists, a CSV of the manifest's rows a part.

    Raises:
        PalpateError: if the lists are gone, or lack a sample.
    """
    if "lists" not in manifest.facts:
        return [
            write_table(Path(folder) / f"{part}.csv", manifest.part(split, part))
            for part in split.counts()
        ]
    place = manifest.root / manifest.facts["lists"]
    lists = _lists(place.parent if place.name == LISTS else place)
    if not lists:
        raise PalpateError(
            "The lists that the manifest came from must still be there",
            f"none in {place}",
            "Put them back",
        )
    manifest.take(list(split.parts))
    files: list[Path] = []
    found: set[str] = set()
    for way in DIRECTIONS:
        lines: dict[str, list[str]] = {part: [] for part in split.counts()}
        done: set[str] = set()
        for path in (path for (_, other), path in lists.items() if other == way):
            for _, text in _lines(path):
                row = _row(text.split(), way, manifest.facts.get("prefix", ""))
                part = split.parts.get(row["id"]) if row else None
                if row and part and row["id"] not in done:
                    done.add(row["id"])
                    lines[part].append(text + "\n")
        found |= done
        for part in (p for p in lines if lines[p]):
            files.append(Path(folder) / f"{WORDS[part]}_{way}.txt")
            write_text(files[-1], "".join(lines[part]))
    if lost := set(split.parts) - found:
        raise PalpateError(
            "Every sample must stand in one of the lists",
            few(sorted(lost)),
            "Import the data set again",
        )
    return files


def _lists(source: Path) -> dict[tuple[str, str], Path]:
    """(part, direction) -> list, from ``data_lst/`` or the folder itself."""
    names = {
        (part, way): f"{WORDS[part]}_{way}.txt" for part in ("train", "test") for way in DIRECTIONS
    }
    places = (source / LISTS, source)
    found = (
        {key: place / name for key, name in names.items() if (place / name).is_file()}
        for place in places
    )
    return next((lists for lists in found if lists), {})


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines that are not empty, stripped, without holding them all: a list has hundreds of megabytes."""
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if text := line.decode(
                "utf-8-sig" if number == 1 else "utf-8", errors="replace"
            ).strip():
                yield number, text


def _row(fields: list[str], way: str, prefix: str) -> dict[str, Any] | None:
    """The manifest row of a line, or None if its touch is no numbered frame."""
    source, other = (fields[0], fields[2]), (fields[1], fields[3])
    (background, tactile), (_, vision) = (
        (source, other) if way == "touch2vision" else (other, source)
    )
    background, tactile, vision = (
        name.removeprefix(prefix).removeprefix("./") for name in (background, tactile, vision)
    )
    folder, _, name = tactile.rpartition("/")
    match = re.fullmatch(FRAME, name.rpartition(".")[0])
    if match is None:
        return None
    video = _recording(folder)
    return {
        "id": f"{video}/{int(match[1])}",
        "video": video,
        "frame": int(match[1]),
        "vision": vision,
        "tactile": tactile,
        "background": background,
        "sensor": FACTS.sensor,
        "domain": _domain(video),
    }


@lru_cache(maxsize=4096)
def _recording(folder: str) -> str:
    """A recording's name: its folders without the side."""
    return "/".join(part for part in folder.split("/") if part.lower() not in SIDES) or "."


def _climbing(fields: list[str], prefix: str) -> str | None:
    """The first path that leaves the root, or None. Lists are long: a line without a suspect sign is not looked at closely."""
    names = [name.removeprefix(prefix) for name in fields]
    if not re.search(r"\.\.|[\\:]|\n/", "\n" + "\n".join(names)):
        return None
    return next(
        (given for given, name in zip(fields, names, strict=True) if re.search(CLIMBS, name)), None
    )


def _domain(video: str) -> str | None:
    return "unseen" if "unseen" in video.lower() else "seen" if "seen" in video.lower() else None


def _read_lists(
    out: Scan, lists: dict[tuple[str, str], Path], prefix: str, progress: Progress
) -> None:
    """Rows of all lists, a sample once; the parts by direction, one split if they agree."""
    rows: dict[str, Found] = {}
    parts: dict[str, dict[str, str]] = {}
    for done, ((part, way), path) in enumerate(lists.items()):
        progress("reading lists", done, len(lists))
        here: dict[str, str] = {}
        for number, text in _lines(path):
            where, fields = f"{path}:{number}", text.split()
            row = _row(fields, way, prefix) if len(fields) == FIELDS else None
            if "\ufffd" in text:
                out.problems.append(
                    Problem(where, "bad-encoding", f"the line {text[:80]!r} is not UTF-8")
                )
            elif len(fields) != FIELDS:
                out.problems.append(
                    Problem(where, "bad-line", f"{len(fields)} paths instead of {FIELDS}")
                )
            elif climbing := _climbing(fields, prefix):
                out.problems.append(
                    Problem(
                        where, "outside-root", f"the path {climbing!r} leaves the root {out.base}"
                    )
                )
            elif row is None:
                out.problems.append(
                    Problem(
                        where,
                        "bad-frame",
                        f"the touch {fields[2 if way == 'touch2vision' else 3]!r} is no frameNNNN",
                    )
                )
            elif (before := here.setdefault(row["id"], where)) != where:
                out.problems.append(
                    Problem(where, "duplicate-row", f"{row['id']} is listed at {before} already")
                )
            else:
                _join(out, rows, where, row)
                _sort_in(out, parts.setdefault(way, {}), where, row["id"], part)
    out.rows = list(rows.values())
    used = [path.name for path in lists.values()]
    _strangers(out)
    found = list(parts.items())
    agree = all(
        found[0][1].get(i, part) == part for _, other in found[1:] for i, part in other.items()
    )
    for name, those in (
        [("Orig", {i: part for _, each in found for i, part in each.items()})]
        if agree
        else [(f"Orig-{w}", p) for w, p in found]
    ):
        out.parts[name] = {i: part for i, part in those.items() if part}
        out.rules[name] = {
            "method": "official",
            "files": [n for n in used if agree or n.endswith(f"{name[5:]}.txt")],
        }


def _join(out: Scan, rows: dict[str, Found], where: str, row: dict[str, Any]) -> None:
    """Enters a row, or compares it with that of the other direction."""
    before = rows.setdefault(row["id"], (where, row))
    if before[1] != row:
        column = next(name for name in row if before[1][name] != row[name])
        text = f"the {column} of {row['id']} is {row[column]!r} here, {before[1][column]!r} at {before[0]}"
        out.problems.append(Problem(where, "two-rows", text))


def _sort_in(out: Scan, parts: dict[str, str], where: str, i: str, part: str) -> None:
    """Notes the part of a sample; one in both is in neither (an empty word)."""
    if parts.setdefault(i, part) != part:
        parts[i] = ""
        out.problems.append(
            Problem(where, "two-parts", f"{i} is in both lists of its direction, so in no part")
        )


def _strangers(out: Scan) -> None:
    """Takes out rows of recordings of which nothing is there, telling each once: users have seen objects, unseen ones, or a few folders."""
    folders: dict[str, bool] = {}
    lost: Counter[str] = Counter()
    rows: list[Found] = []
    for where, row in out.rows:
        gone = ""
        for name in ("tactile", "vision"):
            folder = row[name].rpartition("/")[0] or "."
            if folder not in folders:
                path = inside(out.base, folder)
                folders[folder] = (
                    path is None or path.is_dir()
                )  # what leaves the root is told as such later
            gone = gone or ("" if folders[folder] else folder)
        lost.update([gone] if gone else [])
        rows += [] if gone else [(where, row)]
    out.rows = rows
    out.problems += [
        Problem(folder, "missing-folder", f"no such folder, which {n} listed samples need")
        for folder, n in lost.items()
    ]


def _read_recordings(out: Scan, progress: Progress) -> None:
    """Rows of the folders that hold frames.

    Raises:
        PalpateError: if there are none.
    """
    sides: dict[str, dict[str, str]] = {"tactile": {}, "vision": {}}
    for folder, names in _walk(out.base):
        if any(re.fullmatch(FRAME, Path(n).stem) for n in names):
            side = next((SIDES[p.lower()] for p in folder.parts if p.lower() in SIDES), "tactile")
            video = _recording(folder.as_posix())
            if (before := sides[side].setdefault(video, folder.as_posix())) != folder.as_posix():
                out.problems.append(
                    Problem(
                        folder.as_posix(),
                        "duplicate-id",
                        f"{before} is a recording of the same name",
                    )
                )
    if not sides["tactile"]:
        raise PalpateError(
            f"{out.base} must hold {LOOKED_FOR}",
            few(sorted(sides["vision"])) + " of vision",
            f"See {FACTS.url}",
        )
    bare: list[str] = []
    for done, video in enumerate(
        sorted(sides["tactile"], key=lambda v: [natural(p) for p in v.split("/")])
    ):
        progress("reading recordings", done, len(sides["tactile"]))
        bare += (
            []
            if _recording_rows(
                out,
                video,
                sides["tactile"][video],
                sides["vision"].get(video),
                bool(sides["vision"]),
            )
            else [video]
        )
    if lone := sorted(set(sides["vision"]) - set(sides["tactile"])):
        out.problems.append(
            Problem(str(out.base), "unpaired", f"recordings of vision without touch: {few(lone)}")
        )
    if bare:
        out.suspicious.append(
            Problem(
                str(out.base),
                "no-background",
                f"recordings without the reference frame0000: {few(bare)}",
            )
        )
    if not sides["vision"]:
        out.facts["vision"] = "none in this layout"


def _recording_rows(out: Scan, video: str, folder: str, view: str | None, paired: bool) -> bool:
    """Adds the rows of a recording; whether it has a reference."""
    frames = numbered(out.base / folder, FRAME)
    views = numbered(out.base / view, FRAME) if view else None
    tell(frames, folder, out.problems, out.suspicious, steady=True)
    if views and view:
        tell(views, view, out.problems, out.suspicious)
    reference = frames.files.pop(0, None)
    if paired and views is None:
        out.problems.append(
            Problem(
                folder,
                "unpaired",
                f"no recording of vision of this name, for {len(frames.files)} frames",
            )
        )
        return reference is not None
    if views and (lost := [k for k in frames.files if k not in views.files]):
        out.problems.append(
            Problem(folder, "unpaired", f"frames without a view in {view}: {few(lost)}")
        )
    for k, name in frames.files.items():
        if views is None or k in views.files:
            row: dict[str, Any] = {
                "id": f"{video}/{k}",
                "video": video,
                "frame": k,
                "vision": f"{view}/{views.files[k]}" if views else None,
                "tactile": f"{folder}/{name}",
                "background": f"{folder}/{reference}" if reference else None,
                "sensor": FACTS.sensor,
                "domain": _domain(video),
            }
            out.rows.append((row["tactile"], row))
    return reference is not None


def _walk(root: Path) -> Iterator[tuple[PurePosixPath, list[str]]]:
    """Folders below the root with their files, in order, to a limited depth; links to folders are not followed."""
    for folder, below, names in os.walk(root):
        here = PurePosixPath(Path(folder).relative_to(root).as_posix())
        below[:] = (
            sorted((n for n in below if not n.startswith(".")), key=natural)
            if len(here.parts) < DEPTH
            else []
        )
        yield here, names


def _peek(source: Path) -> bool:
    """Whether one of the first folders below has a reference frame."""
    try:
        for looked, (here, names) in enumerate(_walk(source)):
            if len(here.parts) >= 1 and "frame0000.jpg" in names:
                return True
            if looked >= PEEKS:
                return False
    except OSError:
        return False
    return False


def _contacts(base: Path, rows: list[Found], progress: Progress) -> dict[str, float | None]:
    """Touch -> contact; None without a reference, or where a picture cannot be read or has another size, which is told elsewhere."""

    def one(row: dict[str, Any]) -> float | None:
        paths = [inside(base, row[name]) for name in ("tactile", "background") if row[name]]
        if len(paths) != 2 or None in paths:
            return None
        try:
            frame, reference = (np.asarray(read_image(path).convert("L")) for path in paths if path)
        except PalpateError:
            return None
        return contact(frame, reference) if frame.shape == reference.shape else None

    out: dict[str, float | None] = {}
    for done, (row, value) in enumerate(in_threads(one, [row for _, row in rows]), 1):
        out[row["tactile"]] = value
        progress("measuring contact", done, len(rows))
    return out


def _leave_flat(out: Scan, least: float, progress: Progress) -> None:
    """Takes the frames of little contact out; those that cannot be measured stay."""
    found = _contacts(out.base, out.rows, progress)
    rows = [
        (where, row) for where, row in out.rows if (c := found[row["tactile"]]) is None or c > least
    ]
    out.facts["min_contact"] = (
        f"{least:g}; {len(out.rows) - len(rows)} of {len(out.rows)} frames left out"
    )
    if unknown := sum(c is None for c in found.values()):
        out.suspicious.append(
            Problem(
                str(out.base),
                "contact-unknown",
                f"{unknown} frames could not be compared with a reference",
            )
        )
    out.rows = rows
