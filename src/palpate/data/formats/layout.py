"""What formats share: folders of images by name, pairs of equal names, and JSON lists of pairs.

The number of an image is an integer, so ``frame10.jpg`` comes after ``frame9.jpg``, and ``7.jpg``
and ``0007.jpg`` are one frame. Nothing is skipped silently: duplicate numbers, images of another
name and images without a partner are reported.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, Generic, TypeGuard, TypeVar

from palpate.core import PARTS, PalpateError, Split, few, inside, require
from palpate.data.images import SUFFIXES
from palpate.data.manifest import CLIMBS, DIGITS
from palpate.data.scanning import Facts, Row, Scan

NUMBER = r"([0-9]+)"
#: Frame lists of Touch and Go: all labeled frames, and its split.
LISTS = ("label.txt", "train.txt", "test.txt")
#: Where its recordings are, below the root.
PLACES = ("dataset", "final_dataset", ".")
#: Modality -> its folder of frames and its video in the folder of a recording.
RECORDED = {"vision": ("video_frame", "video.mp4"), "tactile": ("gelsight_frame", "gelsight.mp4")}
K = TypeVar("K", int, str)
#: (folder, name or number): what a JSON list calls a sample.
Key = tuple[str, int] | tuple[str, str]


@dataclass(frozen=True)
class Images(Generic[K]):
    """The images of one folder."""

    folder: str  # the folder, relative to the root
    #: Key (frame number or stem) -> file name, in order.
    files: dict[K, str] = field(default_factory=dict)

    def path(self, key: K) -> str:
        """Path of an image, relative to the root."""
        return f"{self.folder}/{self.files[key]}"


def numbered(
    scan: Scan, folder: str, pattern: str = NUMBER, *, suffixes: Sequence[str] = SUFFIXES
) -> Images[int]:
    """The images of a folder by number; an absent folder has none.

    Args:
        scan: duplicate numbers become its problems, images without a number are suspicious.
        folder: relative to the root; its subfolders are not read.
        pattern: of the whole stem, with one group: the number.
        suffixes: of images, in lower case; other files are not images.
    """
    files: dict[int, str] = {}
    unnumbered: list[str] = []
    for name in file_names(scan.base / folder, suffixes):
        match = re.fullmatch(pattern, name.rpartition(".")[0])
        if match is None or len(match[1]) > DIGITS:
            unnumbered.append(name)
        elif (before := files.setdefault(int(match[1]), name)) != name:
            scan.problem(f"{folder}/{name}", "duplicate-frame", f"{before} has the same number")
    scan.suspect(folder, "unknown-name", "images that carry no frame number", unnumbered)
    return Images(folder, {k: files[k] for k in sorted(files)})


def named(scan: Scan, folder: str) -> Images[str]:
    """The images of a folder by stem, in natural order; a PNG goes before another form."""
    names = sorted(file_names(scan.base / folder), key=lambda n: n.lower().endswith(".png"))
    files = {name.rpartition(".")[0]: name for name in names}
    return Images(folder, {stem: files[stem] for stem in sorted(files, key=natural)})


def paired(scan: Scan, tactile: Images[K], vision: Images[K]) -> list[K]:
    """The keys that both folders have, in order; images without a partner are problems.

    A folder without any images is one problem, not one for each image of its partner.
    """
    for images, partner, side in ((tactile, vision, "vision"), (vision, tactile, "tactile")):
        if images.files and not partner.files:
            kind = "missing-frames" if (scan.base / partner.folder).is_dir() else "missing-folder"
            text = f"no {side} images here, for {len(images.files)} in {images.folder}"
            scan.problem(partner.folder, kind, text)
        elif partner.files:
            for key in images.files.keys() - partner.files.keys():
                text = f"no {side} image {key!r} in {partner.folder}"
                scan.problem(images.path(key), "unpaired", text)
    return [key for key in tactile.files if key in vision.files]


def report_missing_folders(scan: Scan) -> None:
    """Drop rows of folders that are not there or outside the root, with one problem a folder.

    A user may have fetched a part of a data set; the first missing folder on the way is named.
    """

    @cache
    def missing(folder: str) -> tuple[str, str] | None:
        """(kind of problem, its text)."""
        if inside(scan.base, folder) is None:
            return "outside-root", f"the folder {folder!r} leaves the root {scan.base}"
        parents = PurePosixPath(folder).parents
        for name in (*map(str, reversed(parents)), folder):
            if not (scan.base / name).is_dir():
                return "missing-folder", f"no folder {name!r} in {scan.base}"
        return None

    places: dict[tuple[str, str], list[str]] = {}
    rows: list[Row] = []
    for where, row in scan.rows:
        folders = (str(row[name]).rpartition("/")[0] for name in ("vision", "tactile"))
        if lost := next(filter(None, map(missing, folders)), None):
            places.setdefault(lost, []).append(where)
        else:
            rows.append((where, row))
    for (kind, text), wheres in places.items():
        scan.problem(wheres[0], kind, f"{count_rows(wheres)}: {text}")
    scan.rows = rows


def count_rows(places: Sequence[str]) -> str:
    """``"1 row"``, ``"3 rows"``."""
    return f"{len(places)} row{'s' * (len(places) != 1)}"


def file_names(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> list[str]:
    """Sorted names of the images in a folder, hidden ones aside; an unreadable folder has none."""
    return sorted(
        entry.name
        for entry in _entries(folder)
        if entry.name.lower().endswith(tuple(suffixes)) and not entry.is_dir()
    )


def subfolders(folder: Path) -> list[str]:
    """Names of the folders in a folder, in natural order; an unreadable folder has none."""
    return sorted((entry.name for entry in _entries(folder) if entry.is_dir()), key=natural)


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return [entry for entry in entries if not entry.name.startswith(".")]
    except OSError:
        return []


def natural(name: str) -> tuple[int, int, str]:
    """Sort key: integers by value, before other names."""
    return (0, int(name), name) if re.fullmatch(NUMBER, name) else (1, 0, name)


def require_folder(source: Path, name: str) -> Path:
    """The source of a data set, which must be a folder."""
    source = Path(source)
    got = f"the file {source}" if source.exists() else f"nothing at {source}"
    fix = "Check the path"
    require(source.is_dir(), None, f"The source of {name} must be a folder", got, fix=fix)
    return source


def require_layout(root: Path, looks_for: str, facts: Facts, *, complete: object) -> None:
    """Raise an error that lists the folders of a source, unless ``complete`` is true."""
    fix = f"Fetch the data from {facts.url}"
    require(bool(complete), None, f"{root} must hold {looks_for}", few(subfolders(root)), fix=fix)


def read_json_file(scan: Scan, path: Path) -> Any:
    """A JSON file of any content, or None with a problem."""
    try:
        return json.loads(path.read_bytes().decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        scan.problem(path, "bad-json", f"not JSON: {error}")
        return None


def is_split(data: Any) -> TypeGuard[dict[str, list[Any]]]:
    """Whether JSON data is ``{"train": [..], "val": .., "test": ..}``."""
    if not isinstance(data, dict) or set(PARTS).isdisjoint(data):
        return False
    return all(isinstance(rows, list) for rows in data.values())


def read_split(
    scan: Scan,
    path: Path,
    data: Mapping[str, list[Any]],
    ids: Mapping[Any, str],
    key: Callable[[str, str], Key | None],
) -> Split:
    """The split of ``{"train": [[folder, name], ..], ..}``; names may be integers.

    Args:
        scan: missing, duplicate and malformed entries are its problems. A sample in two parts is in
            neither.
        path: the list.
        data: its content.
        ids: (folder, name) -> id of every sample on disk, whether usable or not.
        key: the key in ``ids`` of an entry, or None if its name is no frame number.
    """
    folders = {folder for folder, _ in ids}
    lost: Counter[str] = Counter()
    seen: dict[str, str] = {}
    in_two: set[str] = set()
    for where, part, folder, name in _pairs(scan, path, data):
        sample = key(folder, name)
        i = ids.get(sample)
        if sample is None:
            scan.problem(where, "bad-frame", f"the index {name!r} is not an integer")
        elif sample[0] not in folders:
            lost[folder] += 1
        elif i is None:
            scan.problem(where, "missing-file", f"{folder}/{name} is listed but not there")
        elif i not in seen:
            seen[i] = part
        elif seen[i] == part:
            scan.problem(where, "duplicate-row", f"{folder}/{name} is listed twice")
        else:
            in_two.add(i)
            scan.problem(where, "two-parts", f"{folder}/{name} is in {seen[i]}, too")
    for name, count in lost.items():
        scan.problem(path, "missing-folder", f"no folder {name!r}, with {count} listed entries")
    if unlisted := len(ids) - len(seen):
        scan.suspect(path, "unlisted", f"{unlisted} of {len(ids)} samples are in no part")
    parts = {i: part for i, part in seen.items() if i not in in_two}
    return Split(parts, {"method": "official", "files": [path.name]})


def _pairs(
    scan: Scan, path: Path, data: Mapping[str, list[Any]]
) -> Iterator[tuple[str, str, str, str]]:
    """(place, part, folder, name) of the well-formed entries."""
    for part, rows in data.items():
        if part not in PARTS:
            text = f"the part {part!r} ({len(rows)} entries) is none of {', '.join(PARTS)}"
            scan.problem(path, "unknown-part", text)
            continue
        for k, row in enumerate(rows):
            where = f"{path} {part}[{k}]"
            names = [str(n).strip() for n in row] if isinstance(row, list) else []
            if len(names) != 2 or not all(isinstance(n, (str, int)) for n in row):
                scan.problem(where, "bad-line", f"{str(row)[:80]} is not a pair of names")
            elif any(re.search(rf"{CLIMBS}|[/\\]|^$", n) for n in names):
                scan.problem(where, "outside-root", f"{names!r} are not plain names")
            else:
                yield where, part, names[0], names[1]


def has_listed_videos(source: Path) -> bool:
    """Whether a folder has a frame list and a recording."""
    return any((source / name).is_file() for name in LISTS) and bool(find_videos(source))


def find_videos(root: Path) -> dict[str, Mapping[str, Path | None]]:
    """Recordings by name; extracted frames go before the raw video."""
    videos: dict[str, Mapping[str, Path | None]] = {}
    for parent in PLACES:
        for name in subfolders(root / parent):
            paths: dict[str, Path | None] = {}
            for modality, (frames, video) in RECORDED.items():
                folder, file = (root / parent / name / part for part in (frames, video))
                paths[modality] = folder if folder.is_dir() else file if file.is_file() else None
            if any(paths.values()):
                videos.setdefault(name, paths)
    return videos


def require_videos(root: Path) -> dict[str, Mapping[str, Path | None]]:
    """The recordings."""
    videos = find_videos(root)
    if not videos:
        must = f"{root} must hold recordings: folders with video.mp4 and gelsight.mp4, or "
        must += "video_frame/ and gelsight_frame/"
        got = "none there, nor in dataset/ or final_dataset/"
        raise PalpateError(must, got, "Check the folder")
    return videos


def suspect_rows(scan: Scan, places: Sequence[str], kind: str, text: str) -> None:
    """Report similar rows at the first of them, with their number; nothing for no rows."""
    if places:
        scan.suspect(places[0], kind, f"{count_rows(places)}: {text}")
