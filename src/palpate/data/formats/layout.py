"""What formats share: folders of images by name, pairs of equal names, and JSON lists of pairs.

The number of an image is an integer, so ``frame10.jpg`` comes after ``frame9.jpg``, and ``7.jpg``
and ``0007.jpg`` are one frame. Nothing is skipped silently: duplicate numbers, images of another
name and images without a partner are reported.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path, PurePosixPath

from palpate.core import PalpateError, inside, require
from palpate.data.images import SUFFIXES
from palpate.data.scanning import Row, Scan

NUMBER = r"([0-9]+)"
#: Frame lists of Touch and Go: all labeled frames, and its split.
LISTS = ("label.txt", "train.txt", "test.txt")
#: Where its recordings are, below the root.
PLACES = ("dataset", "final_dataset", ".")
#: Modality -> its folder of frames and its video in the folder of a recording.
RECORDED = {"vision": ("video_frame", "video.mp4"), "tactile": ("gelsight_frame", "gelsight.mp4")}


@dataclass(frozen=True)
class Images:
    """The images of one folder."""

    folder: str  # the folder, relative to the root
    files: dict[str, str] = field(default_factory=dict)  # key -> file name, in order

    def path(self, key: str) -> str:
        """Path of an image, relative to the root."""
        return f"{self.folder}/{self.files[key]}"


def paired(scan: Scan, tactile: Images, vision: Images) -> list[str]:
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
