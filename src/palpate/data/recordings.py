"""From listed frames of recordings to manifest rows: open, choose backgrounds, check, extract.

Every step drops the rows that it cannot use and adds the reason to ``problems``, so that a user
sees everything that is wrong with a data set at once.
"""

from __future__ import annotations

import os
import shutil
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import polars as pl

from palpate.core import PalpateError, Problem, Progress, inside, read_json, rng_for, write_json
from palpate.data.frames import (
    FolderFrames,
    Frames,
    ImageFormat,
    VideoFrames,
    nearest_to_median,
    save_frame,
)
from palpate.data.images import Check, check_image, in_threads
from palpate.data.listing import FrameList, FrameTable
from palpate.data.manifest import Manifest

#: The background is this many frames before the contact.
BACKGROUND_BEFORE = 4
#: The typical frame of a recording is chosen from at most so many frames.
MEDIAN_OF = 15
MODALITIES = ("vision", "tactile")


@dataclass(frozen=True)
class VideoFiles:
    """One recording: each modality is a folder of frames, a video file, or None."""

    name: str
    vision: Path | None
    tactile: Path | None


@dataclass(frozen=True)
class Row:
    """A labeled frame; ``where`` is ``list:line``."""

    where: str
    id: str
    video: str
    frame: int
    contact: str
    material: str


@dataclass(frozen=True)
class _Job:
    """The needed frames of one modality of a recording; no ``frames``: its typical frame."""

    video: str
    modality: str
    frames: set[int]


def rows_of(listed: FrameList) -> list[Row]:
    """The rows of a list, sorted by video and frame."""
    cells = listed.manifest.table.select("contact", "material")
    table = pl.concat([listed.rows, cells], how="horizontal").sort("video", "frame")
    names = ("id", "video", "frame", "contact", "material")
    return [
        Row(f"{r['source']}:{r['line']}", *(r[name] for name in names))
        for r in table.iter_rows(named=True)
    ]


def first_frames(rows: Iterable[Row]) -> dict[str, int]:
    """Contact -> its first frame."""
    first: dict[str, int] = {}
    for row in rows:
        first[row.contact] = min(row.frame, first.get(row.contact, row.frame))
    return first


def thin(rows: Sequence[Row], most: int | None, seed: int) -> list[Row]:
    """At most ``most`` rows per contact, one from each of that many equal stretches.

    Of a contact of n rows, row ``floor((i + u) n / most)`` is taken for i = 0, 1, ...; u = 1/2 for
    seed 0, otherwise drawn in [0, 1) for each contact.
    """
    if most is None:
        return list(rows)
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.contact, []).append(row)
    taken: list[Row] = []
    for contact, group in groups.items():
        count = len(group)
        # The name of the stream is part of every thinned import so far.
        phase = 0.5 if seed == 0 else rng_for(seed, "frames of a touch", contact).random()
        places = (
            range(count)
            if count <= most
            else (int((i + phase) * count / most) for i in range(most))
        )
        taken += [group[k] for k in places]
    return taken


@dataclass
class Recordings:
    """The recordings of one data set while it is imported.

    Attributes:
        root: the data set.
        out: where extracted frames go.
        videos: recordings on disk, by name.
        in_contact: frames of each recording in which the sensor is in contact.
        image_format, size: of extracted frames.
        created: every new file is added here.
        problems: what is wrong so far.
        suspicious: what looks wrong, but can be used.
        frames: recording -> modality -> frames, for those that could be opened.
        backgrounds: contact -> background image.
        background_frames: contact -> the frame before it that is its background, where there is
            one.
        typical_of: contacts without such a frame -> their recording.
        extracted: whether frames of videos are files by now.
        moved: image -> its copy below ``out``, where some recordings are videos and others folders.
    """

    root: Path
    out: Path
    videos: Mapping[str, VideoFiles]
    in_contact: Mapping[str, set[int]]
    image_format: ImageFormat
    size: int | None
    created: list[Path]
    problems: list[Problem] = field(default_factory=list)
    suspicious: list[Problem] = field(default_factory=list)
    frames: dict[str, dict[str, Frames]] = field(default_factory=dict)
    backgrounds: dict[str, Path] = field(default_factory=dict)
    background_frames: dict[str, int] = field(default_factory=dict)
    typical_of: dict[str, str] = field(default_factory=dict)
    extracted: bool = False
    moved: dict[Path, Path] = field(default_factory=dict)

    def open(self, rows: Sequence[Row], progress: Progress) -> list[Row]:
        """Open both modalities of every recording in use; keep the rows that have both images."""
        first = {row.video: row for row in reversed(rows)}
        count = Counter(row.video for row in rows)
        names = sorted(first)
        for name, opened in in_threads(self._open_one, names, "reading recordings", progress):
            if isinstance(opened, str):
                kind, _, text = opened.partition(": ")
                lost = f"{text} ({count[name]} row{'s' * (count[name] != 1)} of this recording)"
                self.problems.append(Problem(first[name].where, kind, lost))
                continue
            self.frames[name] = opened
            self.suspicious += [
                Problem(
                    str(frames.source / duplicate),
                    "duplicate-frame",
                    f"{read} has the same number, and is read",
                )
                for frames in opened.values()
                if isinstance(frames, FolderFrames)
                for duplicate, read in frames.duplicates
            ]
        return [row for row in rows if row.video in self.frames and self._has(row)]

    def _open_one(self, name: str) -> dict[str, Frames] | str:
        """Both modalities of a recording, or ``kind: text`` of what is wrong."""
        files = self.videos.get(name)
        if files is None:
            return f"missing-video: the recording {name!r} is not in the data set"
        opened: dict[str, Frames] = {}
        for modality in MODALITIES:
            source: Path | None = getattr(files, modality)
            if source is None:
                return f"missing-video: the recording {name!r} has no {modality} frames"
            if not source.is_dir():
                cache = self.out / "images" / name / modality
                try:
                    opened[modality] = VideoFrames(source, cache, self.image_format, self.size)
                except PalpateError as error:
                    return f"bad-video: {source}: {error.got}"
            elif inside(self.root, os.path.relpath(source, self.root)) is None:
                return f"outside-root: {source} is a link that leaves the data set"
            else:
                opened[modality] = FolderFrames(source, self.root)
        return opened

    def _has(self, row: Row) -> bool:
        """Whether both modalities have the frame; if not, it is a problem."""
        opened = self.frames[row.video]
        length = min(map(len, opened.values()))
        if row.frame >= length:
            text = f"frame {row.frame} of {row.video!r}, which has {length} frames, counted from 0"
            self.problems.append(Problem(row.where, "beyond-end", text))
            return False
        missing = [frames for frames in opened.values() if not frames.has(row.frame)]
        for frames in missing:
            if isinstance(frames, FolderFrames) and row.frame in frames.leaving:
                text = f"{frames.path(row.frame)} is a link that leaves the data set"
                self.problems.append(Problem(row.where, "outside-root", text))
            else:
                text = f"no image of frame {row.frame} in {frames.source}"
                self.problems.append(Problem(row.where, "missing-file", text))
        return not missing

    def choose_backgrounds(self, rows: Sequence[Row], starts: Mapping[str, int]) -> None:
        """Choose the background of every contact.

        It is the frame 4 before the contact; else the nearest earlier one without contact; else (in
        ``extract``) a typical frame without contact; else none.
        """
        for contact, video in {row.contact: row.video for row in rows}.items():
            frames = self.frames[video]["tactile"]
            numbers, touched = frames.numbers, self.in_contact.get(video, set())
            before = bisect_right(numbers, starts[contact] - BACKGROUND_BEFORE)
            earlier = (numbers[i] for i in range(before - 1, -1, -1))
            k = next((k for k in earlier if k not in touched), None)
            if k is not None:
                self.background_frames[contact] = k
                self.backgrounds[contact] = frames.path(k)
            elif self._without_contact(video):
                self.typical_of[contact] = video

    def _without_contact(self, video: str) -> list[int]:
        """Up to 15 evenly spaced frames without contact, if possible 4 frames away from any."""
        numbers = np.asarray(self.frames[video]["tactile"].numbers, np.int64)
        contact = np.array(sorted(self.in_contact.get(video, set())), np.int64)
        for margin in (BACKGROUND_BEFORE, 0):
            # A frame is near a contact if a frame in contact lies within the margin.
            low = np.searchsorted(contact, numbers - margin, "left")
            free = numbers[low == np.searchsorted(contact, numbers + margin, "right")]
            if len(free):
                places = np.linspace(0, len(free) - 1, min(MEDIAN_OF, len(free))).round()
                return free[np.unique(places.astype(int))].tolist()
        return []

    def check(self, rows: list[Row], how: Check, progress: Progress) -> list[Row]:
        """Check every image of folders in use once; keep the rows whose images are whole."""
        first: dict[Path, Row] = {}
        for row in rows:
            for path in self._folder_images(row):
                first.setdefault(path, row)
        bad: set[Path] = set()
        paths = () if how == "none" else first
        for path, reason in in_threads(
            lambda p: check_image(p, how), paths, "checking images", progress
        ):
            if reason:
                bad.add(path)
                self.problems.append(Problem(first[path].where, "bad-image", f"{path}: {reason}"))
        self.backgrounds = {c: path for c, path in self.backgrounds.items() if path not in bad}
        self.problems.sort(key=place_of)
        # A bad background costs no row.
        return [row for row in rows if bad.isdisjoint(self._folder_images(row, backgrounds=False))]

    def _folder_images(self, row: Row, *, backgrounds: bool = True) -> list[Path]:
        """The images of a row that are not extracted from videos."""
        folders = {m: f for m, f in self.frames[row.video].items() if isinstance(f, FolderFrames)}
        paths = [frames.path(row.frame) for frames in folders.values()]
        if backgrounds and "tactile" in folders and row.contact in self.backgrounds:
            paths.append(self.backgrounds[row.contact])
        return paths

    def decode(self, rows: list[Row], progress: Progress, *, videos: bool = True) -> list[Row]:
        """Decode what ``extract`` would, and write nothing; keep the rows whose images are whole.

        With ``videos=False`` only the typical frames of folders are determined, and every row
        stays.
        """
        whole: set[tuple[str, str, int]] = set()

        def work(job: _Job, stop: Event) -> None:
            for k, _ in self.frames[job.video][job.modality].read(sorted(job.frames)):
                if stop.is_set():
                    return
                whole.add((job.video, job.modality, k))

        jobs = self._jobs(rows) if videos else []
        typical = self._typical(rows, videos=videos)
        self._run("decoding frames", [*jobs, *typical], work, rows, progress)
        if not videos:
            return rows
        return [
            row
            for row in rows
            if all((row.video, m, row.frame) in whole for m in self._of_videos(row))
        ]

    def extract(self, rows: list[Row], progress: Progress) -> list[Row]:
        """Extract the needed frames of videos; keep the rows whose images are there."""
        jobs = self._jobs(rows)
        self._require_same_settings(jobs)

        def work(job: _Job, stop: Event) -> None:
            frames = self.frames[job.video][job.modality]
            assert isinstance(frames, VideoFrames)
            frames.extract(job.frames, self.created, stop)

        typical = self._typical(rows, videos=True)
        self._run("extracting frames", [*jobs, *typical], work, rows, progress, save=True)
        self.extracted = True
        self.backgrounds = {c: path for c, path in self.backgrounds.items() if path.is_file()}
        rows = [
            row
            for row in rows
            if all(
                self.frames[row.video][m].path(row.frame).is_file() for m in self._of_videos(row)
            )
        ]
        if self.layout(rows) == "mixed":
            self._gather(rows)
        return rows

    def layout(self, rows: Iterable[Row]) -> str:
        """``raw`` if the frames are those of videos, ``extracted`` if of folders, or ``mixed``."""
        videos = {row.video for row in rows}
        raw = {isinstance(f, VideoFrames) for v in videos for f in self.frames[v].values()}
        return "mixed" if len(raw) > 1 else "raw" if True in raw else "extracted"

    def _of_videos(self, row: Row) -> list[str]:
        """The modalities of a row that are video files."""
        return [m for m, f in self.frames[row.video].items() if isinstance(f, VideoFrames)]

    def _jobs(self, rows: Iterable[Row]) -> list[_Job]:
        """The frames of videos that the rows and their backgrounds need."""
        needed: dict[tuple[str, str], set[int]] = {}
        for row in rows:
            for modality in self._of_videos(row):
                frames = needed.setdefault((row.video, modality), set())
                frames.add(row.frame)
                if modality == "tactile" and row.contact in self.background_frames:
                    frames.add(self.background_frames[row.contact])
        return [_Job(video, modality, k) for (video, modality), k in needed.items()]

    def _typical(self, rows: Iterable[Row], *, videos: bool) -> list[_Job]:
        """Recordings whose typical frame is needed; without ``videos`` only those in folders."""
        contacts = {row.contact for row in rows}
        names = sorted({video for contact, video in self.typical_of.items() if contact in contacts})
        folders = {v for v in names if isinstance(self.frames[v]["tactile"], FolderFrames)}
        return [_Job(video, "tactile", set()) for video in names if videos or video in folders]

    def _run(
        self,
        what: str,
        jobs: Sequence[_Job],
        work: Callable[[_Job, Event], None],
        rows: Sequence[Row],
        progress: Progress,
        *,
        save: bool = False,
    ) -> None:
        """Run jobs in threads; a video that breaks off becomes a problem.

        Jobs without frames choose a typical frame, and ``save`` it if it is not a file.
        """
        first = {row.video: row for row in reversed(rows)}
        typical: dict[str, Path] = {}
        stop = Event()

        def choose(video: str) -> None:
            frames = self.frames[video]["tactile"]
            k, image = nearest_to_median(frames, self._without_contact(video))
            path = typical[video] = frames.path(k)
            if save and not path.is_file():
                self.created.append(path)
                save_frame(path, image, self.size)

        def attempt(job: _Job) -> str | None:
            try:
                work(job, stop) if job.frames else choose(job.video)
            except PalpateError as error:
                return f"{self.frames[job.video][job.modality].source}: {error.got}"
            return None

        for job, text in in_threads(attempt, jobs, what, progress, stop=stop):
            if text:
                self.problems.append(Problem(first[job.video].where, "bad-video", text))
        for contact, video in self.typical_of.items():
            if video in typical:
                self.backgrounds[contact] = typical[video]
        self.problems.sort(key=place_of)

    def _gather(self, rows: Sequence[Row]) -> None:
        """Link (or copy) images of folders below ``out``, so that one root holds all."""
        for row in rows:
            for modality, frames in self.frames[row.video].items():
                if isinstance(frames, VideoFrames):
                    continue
                paths = [frames.path(row.frame)]
                if modality == "tactile" and row.contact in self.backgrounds:
                    paths.append(self.backgrounds[row.contact])
                for path in paths:
                    target = self.out / "images" / row.video / modality / path.name
                    if path not in self.moved and not target.is_file():
                        target.parent.mkdir(parents=True, exist_ok=True)
                        self.created.append(target)
                        try:
                            os.link(path, target)
                        except OSError:
                            shutil.copyfile(path, target)
                    self.moved[path] = target

    def _require_same_settings(self, jobs: Sequence[_Job]) -> None:
        """Record the settings of extracted frames; reject a folder with others."""
        if not jobs:
            return
        path = self.out / "images" / "settings.json"
        settings = {"format": self.image_format, "size": self.size}
        videos = {
            f"{job.video}/{job.modality}": self.frames[job.video][job.modality]
            .source.stat()
            .st_size
            for job in sorted(jobs, key=lambda job: (job.video, job.modality))
        }
        if path.is_file():
            earlier = read_json(path, "record of the extracted frames")
            known: dict[str, int] = earlier.pop("videos")
            changed = [name for name, size in videos.items() if known.get(name, size) != size]
            if earlier != settings or changed:
                got = (
                    f"other videos: {', '.join(changed)}"
                    if changed
                    else f"{earlier} there, {settings} here"
                )
                raise PalpateError(
                    f"Frames in {path.parent} must be of the same videos and the same settings",
                    got,
                    "Choose another folder, or remove that one",
                )
            videos = known | videos
        else:
            self.created.append(path)
        write_json(path, {**settings, "videos": videos})

    def cells(
        self,
        rows: Sequence[Row],
        root: Path,
        sensor: str | None = None,
        words: Mapping[str, FrameTable | None] | None = None,
    ) -> list[dict[str, Any]]:
        """Manifest cells of the rows; frames inside videos have no path before ``extract``.

        Args:
            rows: frames of opened recordings.
            root: folder that the paths shall be relative to.
            sensor: the tactile sensor.
            words: further columns by (video, frame).
        """
        folders: dict[Path, str] = {}

        def relative(frames: Frames, path: Path | None) -> str | None:
            if path is None or (isinstance(frames, VideoFrames) and not self.extracted):
                return None
            path = self.moved.get(path, path)
            if path.parent not in folders:
                folders[path.parent] = Path(os.path.relpath(path.parent.resolve(), root)).as_posix()
            prefix = folders[path.parent]
            return path.name if prefix == "." else f"{prefix}/{path.name}"

        tables = {name: table.values for name, table in (words or {}).items() if table is not None}
        cells: list[dict[str, Any]] = []
        for row in rows:
            opened = self.frames[row.video]
            names = ("id", "video", "frame", "contact", "material")
            row_cells = {name: getattr(row, name) for name in names} | {"sensor": sensor}
            row_cells |= {m: relative(f, f.path(row.frame)) for m, f in opened.items()}
            background = self.backgrounds.get(row.contact)
            row_cells["background"] = relative(opened["tactile"], background)
            row_cells |= {n: values.get((row.video, row.frame)) for n, values in tables.items()}
            cells.append(row_cells)
        return cells

    def manifest(
        self,
        rows: Sequence[Row],
        facts: Mapping[str, str],
        sensor: str,
        words: Mapping[str, FrameTable | None],
    ) -> Manifest:
        """The manifest of the rows.

        Its root is the data set if all recordings are folders of frames, else ``out``.
        """
        layout = self.layout(rows)
        root = (self.root if layout == "extracted" else self.out).resolve()
        table = self.cells(rows, root, sensor, words)
        kinds = Counter(
            "none"
            if c not in self.backgrounds
            else "frame"
            if c in self.background_frames
            else "typical"
            for c in {row.contact for row in rows}
        )
        backgrounds = ", ".join(f"{kind} {n}" for kind, n in sorted(kinds.items()))
        return Manifest.from_rows(
            table, root, {**facts, "layout": layout, "backgrounds": backgrounds}
        )


def place_of(problem: Problem) -> tuple[str, int]:
    """``file:line`` to sort problems by."""
    name, _, line = problem.where.rpartition(":")
    return (name, int(line)) if line.isdecimal() else (problem.where, 0)
