"""From listed frames of recordings to manifest rows: open, choose backgrounds, check, extract.

Every step drops the rows that it cannot use and adds the reason to ``problems``, so that a user
sees everything that is wrong with a data set at once.
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
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
    streams_of,
)
from palpate.data.images import Check, check_image, in_threads
from palpate.data.listing import FrameList, FrameTable
from palpate.data.streams import Finding, findings

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


#: The needed frames of one modality of a recording; no frames: its typical frame.
_Job = tuple[str, str, set[int]]


def rows_of(listed: FrameList) -> list[Row]:
    """The rows of a list, sorted by video and frame."""
    cells = listed.manifest.table.select("contact", "material")
    table = pl.concat([listed.rows, cells], how="horizontal").sort("video", "frame")
    where = pl.format("{}:{}", "source", "line")
    columns = (where, "id", "video", "frame", "contact", "material")
    return [Row(*row) for row in table.select(columns).iter_rows()]


def first_frames(rows: Iterable[Row]) -> dict[str, int]:
    """Contact -> its first frame."""
    return {row.contact: row.frame for row in sorted(rows, key=lambda row: -row.frame)}


def thin(rows: Sequence[Row], most: int | None, seed: int) -> list[Row]:
    """At most ``most`` rows per contact, one from each of that many equal stretches.

    Of a contact of n rows, row ``floor((i + u) n / most)`` is taken for i = 0, 1, ...; u = 1/2 for
    seed 0, otherwise drawn in [0, 1) for each contact.
    """
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.contact, []).append(row)
    taken: list[Row] = []
    for contact, group in groups.items():
        if most is None or len(group) <= most:
            taken += group
            continue
        # The name of the stream is part of every thinned import so far.
        phase = 0.5 if seed == 0 else rng_for(seed, "frames of a touch", contact).random()
        taken += [group[int((i + phase) * len(group) / most)] for i in range(most)]
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
        background_frames: contact -> the frame before it that is its background, if there is one.
        typical_of: contacts without such a frame -> their recording.
        extracted: whether frames of videos are files by now.
        modalities: those that every recording has.
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
    modalities: tuple[str, ...] = MODALITIES

    def open(self, rows: Sequence[Row], progress: Progress) -> list[Row]:
        """Open both modalities of every recording in use; keep the rows that have both images."""
        first = {row.video: row for row in reversed(rows)}
        count = Counter(row.video for row in rows)
        results = in_threads(self._open_one, sorted(first), "reading recordings", progress)
        for name, opened in results:
            if isinstance(opened, tuple):
                kind, text = opened
                lost = f"{text} ({count[name]} row{'s' * (count[name] != 1)} of this recording)"
                self.problems.append(Problem(first[name].where, kind, lost))
                continue
            self.frames[name] = opened
            for frames in opened.values():
                for duplicate, read in frames.duplicates:
                    text = f"{read} has the same number, and is read"
                    place = str(frames.source / duplicate)
                    self.suspicious.append(Problem(place, "duplicate-frame", text))
        return [row for row in rows if row.video in self.frames and self._has(row)]

    def _open_one(self, name: str) -> dict[str, Frames] | tuple[str, str]:
        """Both modalities of a recording, or (kind, text) of what is wrong."""
        if name not in self.videos:
            return "missing-video", f"the recording {name!r} is not in the data set"
        opened: dict[str, Frames] = {}
        for modality in self.modalities:
            source: Path | None = getattr(self.videos[name], modality)
            if source is None:
                return "missing-video", f"the recording {name!r} has no {modality} frames"
            if source.is_dir():
                if inside(self.root, os.path.relpath(source, self.root)) is None:
                    return "outside-root", f"{source} is a link that leaves the data set"
                opened[modality] = FolderFrames(source, self.root)
                continue
            cache = self.out / "images" / name / modality
            try:
                opened[modality] = VideoFrames(source, cache, self.image_format, self.size)
            except PalpateError as error:
                return "bad-video", f"{source}: {error.got}"
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
            kind, text = "missing-file", f"no image of frame {row.frame} in {frames.source}"
            if row.frame in frames.leaving:
                kind = "outside-root"
                text = f"{frames.path(row.frame)} is a link that leaves the data set"
            self.problems.append(Problem(row.where, kind, text))
        return not missing

    def choose_backgrounds(self, rows: Sequence[Row], starts: Mapping[str, int]) -> None:
        """Choose the background of every contact.

        It is the frame 4 before the contact; else the nearest earlier one without contact; else (in
        ``extract``) a typical frame without contact; else none.
        """
        for contact, video in {row.contact: row.video for row in rows}.items():
            frames = self.frames[video]["tactile"]
            numbers, in_contact = frames.numbers, self.in_contact.get(video, set())
            before = bisect_right(numbers, starts[contact] - BACKGROUND_BEFORE)
            earlier = (numbers[i] for i in range(before - 1, -1, -1))
            k = next((k for k in earlier if k not in in_contact), None)
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
                return free[places.astype(int)].tolist()
        return []

    def check(self, rows: list[Row], how: Check, progress: Progress) -> list[Row]:
        """Check every image of folders in use once; keep the rows whose images are whole."""
        first: dict[Path, Row] = {}
        for row in rows:
            for _, path in self._folder_images(row):
                first.setdefault(path, row)
        bad: set[Path] = set()
        paths = () if how == "none" else first
        checked = in_threads(lambda p: check_image(p, how), paths, "checking images", progress)
        for path, reason in checked:
            if reason:
                bad.add(path)
                self.problems.append(Problem(first[path].where, "bad-image", f"{path}: {reason}"))
        # A bad background costs no row.
        self.backgrounds = {c: path for c, path in self.backgrounds.items() if path not in bad}
        self.problems.sort(key=place_of)
        return [row for row in rows if bad.isdisjoint(path for _, path in self._folder_images(row))]

    def _folder_images(self, row: Row) -> list[tuple[str, Path]]:
        """(modality, image) of a row and its background, without those of videos."""
        frames = self.frames[row.video]
        folders = [m for m in self.modalities if isinstance(frames[m], FolderFrames)]
        images = [(m, frames[m].path(row.frame)) for m in folders]
        if "tactile" in folders and row.contact in self.backgrounds:
            images.append(("tactile", self.backgrounds[row.contact]))
        return images

    def decode(self, rows: list[Row], progress: Progress, *, videos: bool = True) -> list[Row]:
        """Decode what ``extract`` would, and write nothing; keep the rows whose images are whole.

        With ``videos=False`` only the typical frames of folders are determined, and every row
        stays.
        """
        whole: set[tuple[str, str, int]] = set()

        def work(job: _Job, stop: Event) -> None:
            video, modality, needed = job
            for k, _ in self.frames[video][modality].read(sorted(needed)):
                if stop.is_set():
                    return
                whole.add((video, modality, k))

        jobs = [job for job in self._jobs(rows) if videos or not self._is_video(*job[:2])]
        self._run("decoding frames", jobs, work, rows, progress)
        if not videos:
            return rows
        return [r for r in rows if all((r.video, m, r.frame) in whole for m in self._videos_of(r))]

    def check_streams(self, progress: Progress) -> None:
        """Report what looks wrong with whole recordings: lag, frozen streams, another gel ..."""

        def check(video: str) -> list[Finding]:
            try:
                return findings(*streams_of(self.frames[video]))
            except PalpateError:
                return []  # reported where its frames are read

        results = in_threads(check, sorted(self.frames), "checking streams", progress)
        self.suspicious += [
            Problem(video, *problem) for video, problems in sorted(results) for problem in problems
        ]

    def extract(self, rows: list[Row], progress: Progress) -> list[Row]:
        """Extract the needed frames of videos; keep the rows whose images are there."""

        def work(job: _Job, stop: Event) -> None:
            frames = self.frames[job[0]][job[1]]
            assert isinstance(frames, VideoFrames)
            frames.extract(job[2], self.created, stop)

        jobs = self._jobs(rows)
        self._require_same_settings(jobs)
        self._run("extracting frames", jobs, work, rows, progress, save=True)
        self.extracted = True
        self.backgrounds = {c: path for c, path in self.backgrounds.items() if path.is_file()}
        there = lambda r, m: self.frames[r.video][m].path(r.frame).is_file()
        return [row for row in rows if all(there(row, m) for m in self._videos_of(row))]

    def layout(self, rows: Iterable[Row]) -> str:
        """``raw`` if the frames are those of videos, ``extracted`` if of folders, or ``mixed``."""
        videos = {row.video for row in rows}
        raw = {self._is_video(video, m) for video in videos for m in self.modalities}
        return "mixed" if len(raw) > 1 else "raw" if True in raw else "extracted"

    def _is_video(self, video: str, modality: str) -> bool:
        return isinstance(self.frames[video][modality], VideoFrames)

    def _videos_of(self, row: Row) -> list[str]:
        """The modalities of a row that are video files."""
        return [m for m in self.modalities if self._is_video(row.video, m)]

    def _jobs(self, rows: Sequence[Row]) -> list[_Job]:
        """The frames of videos that rows and backgrounds need, then the typical frames needed."""
        needed: dict[tuple[str, str], set[int]] = {}
        for row in rows:
            for modality in self._videos_of(row):
                frames = needed.setdefault((row.video, modality), set())
                frames.add(row.frame)
                if modality == "tactile" and row.contact in self.background_frames:
                    frames.add(self.background_frames[row.contact])
        typical = {self.typical_of[r.contact] for r in rows if r.contact in self.typical_of}
        jobs = [(video, modality, frames) for (video, modality), frames in needed.items()]
        return [*jobs, *((video, "tactile", set[int]()) for video in sorted(typical))]

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
            numbers, images = zip(*frames.read(self._without_contact(video)), strict=True)
            best = nearest_to_median(images, frames.source)
            path = typical[video] = frames.path(numbers[best])
            if save and not path.is_file():
                self.created.append(path)
                save_frame(path, images[best], self.size)

        def attempt(job: _Job) -> str | None:
            try:
                work(job, stop) if job[2] else choose(job[0])
            except PalpateError as error:
                return f"{self.frames[job[0]][job[1]].source}: {error.got}"
            return None

        for (video, _, _), text in in_threads(attempt, jobs, what, progress, stop=stop):
            if text:
                self.problems.append(Problem(first[video].where, "bad-video", text))
        chosen = {c: typical[video] for c, video in self.typical_of.items() if video in typical}
        self.backgrounds |= chosen
        self.problems.sort(key=place_of)

    def _require_same_settings(self, jobs: Sequence[_Job]) -> None:
        """Record the settings of extracted frames; reject a folder with others."""
        videos = [job[:2] for job in jobs if self._is_video(*job[:2])]
        if not videos:
            return
        path = self.out / "images" / "settings.json"
        settings = {"format": self.image_format, "size": self.size}
        source = lambda video, m: self.frames[video][m].source
        sizes = {f"{v}/{m}": source(v, m).stat().st_size for v, m in sorted(videos)}
        if path.is_file():
            earlier = read_json(path, "record of the extracted frames")
            known: dict[str, int] = earlier.pop("videos")
            changed = [name for name, size in sizes.items() if known.get(name, size) != size]
            if earlier != settings or changed:
                must = f"Frames in {path.parent} must be of the same videos and the same settings"
                got = f"other videos: {', '.join(changed)}"
                got = got if changed else f"{earlier} there, {settings} here"
                raise PalpateError(must, got, "Choose another folder, or remove that one")
            sizes = known | sizes
        else:
            self.created.append(path)
        write_json(path, {**settings, "videos": sizes})

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

        @cache
        def folder(path: Path) -> str:
            return Path(os.path.relpath(os.path.realpath(path), root)).as_posix()

        def relative(frames: Frames, path: Path | None) -> str | None:
            if path is None or (isinstance(frames, VideoFrames) and not self.extracted):
                return None
            return f"{folder(path.parent)}/{path.name}".removeprefix("./")

        tables = {name: table.values for name, table in (words or {}).items() if table is not None}
        cells: list[dict[str, Any]] = []
        for row in rows:
            opened = self.frames[row.video]
            values = {**vars(row), "sensor": sensor}
            del values["where"]
            values |= {m: relative(f, f.path(row.frame)) for m, f in opened.items()}
            background = self.backgrounds.get(row.contact)
            if background is not None:
                values["background"] = relative(opened["tactile"], background)
            values |= {name: table.get((row.video, row.frame)) for name, table in tables.items()}
            cells.append(values)
        return cells

    def facts(self, rows: Sequence[Row]) -> dict[str, str]:
        """How the frames are stored, and how many contacts have which background."""
        kinds: Counter[str] = Counter()
        for contact in {row.contact for row in rows}:
            kind = "frame" if contact in self.background_frames else "typical"
            kinds[kind if contact in self.backgrounds else "none"] += 1
        backgrounds = ", ".join(f"{kind} {count}" for kind, count in sorted(kinds.items()))
        return {"layout": self.layout(rows), "backgrounds": backgrounds}

    def base(self, rows: Sequence[Row]) -> Path:
        """The folder that holds all images: the data set, ``out``, or the one around both."""
        roots = {"extracted": [self.root], "raw": [self.out]}
        return Path(
            os.path.commonpath(
                [p.resolve() for p in roots.get(self.layout(rows), [self.root, self.out])]
            )
        )


def place_of(problem: Problem) -> tuple[str, int]:
    """``file:line`` to sort problems by."""
    name, _, line = problem.where.rpartition(":")
    return (name, int(line)) if line.isdecimal() else (problem.where, 0)
