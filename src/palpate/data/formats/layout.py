"""What formats share: the names in folders, recordings of frames and videos, folders that lack."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import islice
from pathlib import Path, PurePosixPath

from palpate.core import PalpateError, inside, require
from palpate.core.images import SUFFIXES
from palpate.data.scanning import Row, Scan

NUMBER = r"([0-9]+)"
#: Frame lists of Touch and Go: all labeled frames, and its split.
LISTS = ("label.txt", "train.txt", "test.txt")
#: Where its recordings are, below the root.
PLACES = ("dataset", "final_dataset", ".")
#: Modality -> its folder of frames and its video in the folder of a recording.
RECORDED = {"vision": ("video_frame", "video.mp4"), "tactile": ("gelsight_frame", "gelsight.mp4")}


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


def first_files(root: Path) -> list[str]:
    """Names of the files in up to 500 folders, the first one included."""
    folders = islice(os.walk(root, followlinks=True), 500)
    return [name for _, _, names in folders for name in names]


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
