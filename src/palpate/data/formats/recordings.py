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
from operator import itemgetter
from pathlib import Path
from threading import Event
from typing import Any, Literal

from palpate.core import PalpateError, Problem, Progress, read_json, require, sealed, write_json
from palpate.data.contacts import Pixels
from palpate.data.frames import (
    FolderFrames,
    Frames,
    TimedFrames,
    VideoFrames,
    nearest_in_time,
    streams_of,
)
from palpate.data.images import Check, check_image, in_threads
from palpate.data.manifest import IMAGE_COLUMNS, SIDES
from palpate.data.scanning import Into, Scan, raise_if, require_some
from palpate.data.streams import FEWEST, SHORTER, Finding, findings
from palpate.data.suspicions import Look

#: The background is this many frames before the contact.
BACKGROUND_BEFORE = 4

Pairing = Literal["time", "number"]
#: One recording: modality -> a folder of frames, a video file, or None.
VideoFiles = Mapping[str, Path | None]


@dataclass(frozen=True)
class Row:
    """A labeled frame."""

    where: str  # ``list:line``
    id: str
    video: str
    frame: int
    contact: str
    more: Mapping[str, Any] = field(default_factory=dict)  # further cells of the manifest


#: The needed frames of one modality of a recording.
_Job = tuple[str, str, set[int]]


def thin(rows: list[Row], max_per_contact: int | None) -> list[Row]:
    """So many rows per contact at most: the middle one of each of that many equal stretches."""
    most = max_per_contact
    require(most is None or most >= 1, "max_per_contact", "must be at least 1", most)
    if most is None:
        return rows
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.contact, []).append(row)
    few = lambda group: [group[int((i + 0.5) * len(group) / most)] for i in range(most)]
    return [row for g in groups.values() for row in (g if len(g) <= most else few(g))]


@dataclass
class Recordings:
    """The recordings of one data set while it is read."""

    scan: Scan  # of the data set: gets the rows, what is wrong, and what looks wrong
    into: Into | None  # where extracted frames go; None where nothing is written
    videos: Mapping[str, VideoFiles]  # recordings on disk, by name
    in_contact: Mapping[str, set[int]]  # frames of each recording in which the sensor is in contact
    size: int | None  # of extracted frames, the shorter side
    #: Recording -> modality -> frames, for those that could be opened.
    frames: dict[str, dict[str, Frames]] = field(default_factory=dict)
    backgrounds: dict[str, Path] = field(default_factory=dict)  # contact -> background image
    #: Contact -> the frame before it that is its background, if there is one.
    background_frames: dict[str, int] = field(default_factory=dict)
    extracted: bool = False  # whether frames of videos are files by now
    modalities: tuple[str, ...] = SIDES  # those that every recording has
    #: How frames of both sides belong together; None where a data set says that it is by number.
    pairing: Pairing | None = None

    def __post_init__(self) -> None:
        self.home = self.scan.base  # before extracted frames move the root
        self.scan.met = True
        require(self.size is None or self.size >= 1, "size", "must be at least 1 pixel", self.size)

    @property
    def out(self) -> Path:
        """Where extracted frames go, or would go."""
        return self.scan.base if self.into is None else self.into.out

    def open(self, rows: Sequence[Row], progress: Progress) -> list[Row]:
        """Open both modalities of every recording in use; keep the rows of those that opened."""
        first = {row.video: row for row in reversed(rows)}
        count = Counter(row.video for row in rows)
        results = in_threads(self._open_one, sorted(first), "reading recordings", progress)
        for name, opened in sorted(results, key=itemgetter(0)):
            if isinstance(opened, tuple):
                kind, text = opened
                lost = f"{text} ({count[name]} row{'s' * (count[name] != 1)} of this recording)"
                self.scan.problem(first[name].where, kind, lost)
                continue
            self.frames[name] = opened
            for frames in opened.values():
                for duplicate, read in frames.duplicates:
                    text = f"{read} has the same number, and is read"
                    self.scan.suspect(frames.source / duplicate, "duplicate-frame", text)
        return [row for row in rows if row.video in self.frames]

    def _open_one(self, name: str) -> dict[str, Frames] | tuple[str, str]:
        """Both modalities of a recording, or (kind, text) of what is wrong."""
        if name not in self.videos:
            return "missing-video", f"the recording {name!r} is not in the data set"
        opened: dict[str, Frames] = {}
        for modality in self.modalities:
            source = self.videos[name][modality]
            if source is None:
                return "missing-video", f"the recording {name!r} has no {modality} frames"
            if source.is_dir():
                opened[modality] = FolderFrames(source)
                continue
            cache = self.out / "images" / name / modality
            try:
                opened[modality] = VideoFrames(source, cache, self.size)
            except PalpateError as error:
                return "bad-video", f"{source}: {error.got}"
        return opened if self.pairing is None else self._in_time(name, opened)

    def _in_time(self, name: str, opened: dict[str, Frames]) -> dict[str, Frames] | tuple[str, str]:
        """The frames by the numbers of the tactile ones, where equal numbers are other instants."""
        tactile, vision = opened.get("tactile"), opened.get("vision")
        if not isinstance(tactile, VideoFrames) or not isinstance(vision, VideoFrames):
            return opened
        counts = f"{len(vision)} frames of vision and {len(tactile)} of tactile"
        if tactile.seconds is None or vision.seconds is None:
            differ = abs(len(vision) - len(tactile)) >= max(
                FEWEST, SHORTER * max(len(vision), len(tactile))
            )
            if differ and self.pairing == "time":
                text = f"{counts} without time stamps, so frame k may not be one instant in both; "
                return "unequal-streams", f"{text}the option pairing, if number, takes them so"
            return opened
        if self.pairing == "number":
            return opened
        if (found := nearest_in_time(tactile.seconds, vision.seconds)) is None:
            return opened
        nearest, near = found
        alone = int((nearest < 0).sum())
        text = f"{counts}, of other rates or with gaps: each tactile frame has the photo that is "
        text += f"nearest in time, within {near:.3f} s; {alone} without one are left out"
        self.scan.suspect(name, "paired-by-time", text)
        self.scan.facts["pairing"] = "nearest in time"
        return {**opened, "vision": TimedFrames(vision, nearest)}

    def has(self, row: Row) -> bool:
        """Whether both modalities have the frame; if not, it is a problem."""
        opened = self.frames[row.video]
        length = min(map(len, opened.values()))
        if row.frame >= length:
            text = f"frame {row.frame} of {row.video!r}, which has {length} frames, counted from 0"
            self.scan.problem(row.where, "beyond-end", text)
            return False
        missing = [frames for frames in opened.values() if not frames.has(row.frame)]
        for frames in missing:
            text = f"no image of frame {row.frame} in {frames.source}"
            self.scan.problem(row.where, "missing-file", text)
        return not missing

    def add(
        self,
        rows: list[Row],
        starts: Mapping[str, tuple[str, int]],
        *,
        check: Check,
        progress: Progress,
    ) -> None:
        """Add the rows whose images are whole to the scan, with a background for each contact.

        Frames of videos are extracted, or only decoded; if nothing is written, rows have paths only
        if they are still to be checked and are files. ``starts`` has the video and the first frame
        of each contact; recordings without one are reported.
        """
        self.choose_backgrounds(rows, starts)
        rows = self._whole(rows, check, progress)
        for video in sorted(set(self.videos) - {video for video, _ in starts.values()}):
            text = f"no usable contact of the recording {video!r} is listed"
            self.scan.suspect(self.scan.base, "unlisted-video", text)
        for contact in sorted({row.contact for row in rows} - self.background_frames.keys()):
            text = "no frame before it shows the untouched gel"
            self.scan.suspect(contact, "no-background", text)
        hidden: dict[str, Any] = {}
        if self.into is not None:
            rows = self.extract(rows, progress)
            self.scan.facts |= self._facts(rows)
            self.scan.base = self._base(rows)
        else:
            if check == "decode":
                rows = self._decode(rows, progress)
                self._check_streams(progress)
            hidden = {} if check == "none" else dict.fromkeys(IMAGE_COLUMNS)
        cells = self.cells(rows, self.scan.base.resolve())
        self.scan.rows = [(r.where, cell | hidden) for r, cell in zip(rows, cells, strict=True)]

    def choose_backgrounds(
        self, rows: Sequence[Row], starts: Mapping[str, tuple[str, int]]
    ) -> None:
        """Choose the background of every contact.

        It is the frame 4 before the contact, else the nearest earlier one without contact.
        """
        for contact in dict.fromkeys(row.contact for row in rows):
            video, first = starts[contact]
            frames = self.frames[video]["tactile"]
            numbers, in_contact = frames.numbers, self.in_contact.get(video, set())
            before = bisect_right(numbers, first - BACKGROUND_BEFORE)
            earlier = (numbers[i] for i in range(before - 1, -1, -1))
            k = next((k for k in earlier if k not in in_contact), None)
            if k is not None:
                self.background_frames[contact] = k
                self.backgrounds[contact] = frames.path(k)

    def _whole(self, rows: list[Row], check: Check, progress: Progress) -> list[Row]:
        """Check every image of folders in use once; keep the rows whose images are whole."""
        if check == "none":
            return rows
        first = {path: row for row in reversed(rows) for path in self._folder_images(row)}
        bad: set[Path] = set()
        checks = in_threads(lambda p: check_image(p, check), first, "checking images", progress)
        for path, checked in checks:
            self.scan.taken.update(checked.taken)
            if checked.problem:
                bad.add(path)
                self.scan.problem(first[path].where, "bad-image", f"{path}: {checked.problem}")
        # A bad background costs no row.
        self.backgrounds = {c: path for c, path in self.backgrounds.items() if path not in bad}
        return [row for row in rows if bad.isdisjoint(self._folder_images(row))]

    def _folder_images(self, row: Row) -> list[Path]:
        """The images of a row and its background that are files already."""
        frames = self.frames[row.video]
        folders = [m for m in self.modalities if not self._is_video(row.video, m)]
        images = [frames[m].path(row.frame) for m in folders]
        with_background = "tactile" in folders and row.contact in self.backgrounds
        return images + ([self.backgrounds[row.contact]] if with_background else [])

    def _decode(self, rows: list[Row], progress: Progress) -> list[Row]:
        """Decode what ``extract`` would; keep the rows whose images are whole."""
        decoded: set[tuple[str, str, int]] = set()

        def work(job: _Job, stop: Event) -> None:
            video, modality, needed = job
            for k, _ in self.frames[video][modality].read(sorted(needed)):
                if stop.is_set():
                    return
                decoded.add((video, modality, k))

        self._run("decoding frames", self._jobs(rows), work, rows, progress)
        return [
            r for r in rows if all((r.video, m, r.frame) in decoded for m in self._videos_of(r))
        ]

    def watched(self, video: str) -> tuple[dict[str, Pixels], list[Finding]]:
        """Thumbnails of a recording by modality, and what looks wrong with it: lag ..."""
        images, seconds = streams_of(self.frames[video])
        self.scan.looks[video] = Look.of_video(images)
        counted = "tactile" in images and self.frames[video]["tactile"].numbers[0] == 0
        return images, findings(images, seconds, self.in_contact.get(video, ()) if counted else ())

    def _check_streams(self, progress: Progress) -> None:
        """Report what looks wrong with whole recordings."""

        def check(video: str) -> list[Finding]:
            try:
                return self.watched(video)[1]
            except PalpateError:
                return []  # reported where its frames are read

        results = in_threads(check, sorted(self.frames), "checking streams", progress)
        for video, problems in sorted(results):
            for problem in problems:
                self.scan.suspect(video, *problem)

    def extract(self, rows: list[Row], progress: Progress) -> list[Row]:
        """Extract the needed frames of videos; keep the rows whose images are there.

        Raises:
            ProblemsError: before, if something is bad that is not to be skipped, or no row is left.
        """
        into = self.into
        assert into is not None
        self.scan.problems.sort(key=Problem.sort_key)
        raise_if(self.scan.problems, into.skip_bad)
        require_some(len(rows), self.scan.base, self.scan.problems)

        def work(job: _Job, stop: Event) -> None:
            frames = self.frames[job[0]][job[1]]
            assert isinstance(frames, VideoFrames)
            frames.extract(job[2], into.created, stop)

        jobs = self._jobs(rows)
        self._require_same_settings(jobs, into)
        self._run("extracting frames", jobs, work, rows, progress)
        self.extracted = True
        self.backgrounds = {c: path for c, path in self.backgrounds.items() if path.is_file()}
        there = lambda r, m: self.frames[r.video][m].path(r.frame).is_file()
        return [row for row in rows if all(there(row, m) for m in self._videos_of(row))]

    def _layout(self, rows: Iterable[Row]) -> str:
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
        """The frames of videos that rows and backgrounds need."""
        needed: dict[tuple[str, str], set[int]] = {}
        for row in rows:
            for modality in self._videos_of(row):
                frames = needed.setdefault((row.video, modality), set())
                frames.add(row.frame)
                if modality == "tactile" and row.contact in self.background_frames:
                    frames.add(self.background_frames[row.contact])
        return [(video, modality, frames) for (video, modality), frames in needed.items()]

    def _run(
        self,
        task: str,
        jobs: Sequence[_Job],
        work: Callable[[_Job, Event], None],
        rows: Sequence[Row],
        progress: Progress,
    ) -> None:
        """Run jobs in threads; a video that breaks off becomes a problem."""
        first = {row.video: row for row in reversed(rows)}
        stop = Event()

        def attempt(job: _Job) -> str | None:
            try:
                work(job, stop)
            except PalpateError as error:
                return f"{self.frames[job[0]][job[1]].source}: {error.got}"
            return None

        for (video, side, _), text in in_threads(attempt, jobs, task, progress, stop=stop):
            if text:
                self.scan.problem(first[video].where, "bad-video", text)
            if getattr(self.frames[video][side], "turned", False):
                self.scan.taken["videos turned upright by their tag"] += 1

    def _require_same_settings(self, jobs: Sequence[_Job], into: Into) -> None:
        """Record the settings of extracted frames; reject a folder with others."""
        videos = [job[:2] for job in jobs]
        if not videos:
            return
        path = into.out / "images" / "settings.json"
        settings = {"size": self.size}
        source = lambda video, m: self.frames[video][m].source
        sizes = {f"{v}/{m}": source(v, m).stat().st_size for v, m in sorted(videos)}
        if path.is_file():
            earlier = read_json(path, "record of the extracted frames")
            sizes_before: dict[str, int] = earlier.pop("videos")
            changed = [name for name, size in sizes.items() if sizes_before.get(name, size) != size]
            must = f"Frames in {path.parent} must be of the same videos and the same settings"
            got = f"other videos: {', '.join(changed)}"
            got = got if changed else f"{earlier} there, {settings} here"
            fix = "Choose another folder, or remove that one"
            require(earlier == settings and not changed, None, must, got, fix=fix)
            sizes = sizes_before | sizes
        else:
            into.created.append(path)
        write_json(path, sealed({**settings, "videos": sizes}))

    def cells(self, rows: Sequence[Row], root: Path) -> list[dict[str, Any]]:
        """Manifest cells of the rows, with paths relative to ``root``.

        Frames inside videos have no path before ``extract``.
        """

        @cache
        def folder(path: Path) -> str:
            """Relative to the root, by the names of links below the data set."""
            top = next((t for t in (self.home, self.out) if path.is_relative_to(t)), path)
            real = Path(os.path.realpath(top)) / path.relative_to(top)
            return Path(os.path.relpath(real, root)).as_posix()

        def relative(frames: Frames, path: Path | None) -> str | None:
            if path is None or (isinstance(frames, VideoFrames) and not self.extracted):
                return None
            return f"{folder(path.parent)}/{path.name}".removeprefix("./")

        cells: list[dict[str, Any]] = []
        for row in rows:
            opened = self.frames[row.video]
            values = {name: getattr(row, name) for name in ("id", "video", "frame", "contact")}
            values |= {m: relative(f, f.path(row.frame)) for m, f in opened.items()}
            background = self.backgrounds.get(row.contact)
            if background is not None:
                values["background"] = relative(opened["tactile"], background)
            cells.append({**values, **row.more})
        return cells

    def _facts(self, rows: Sequence[Row]) -> dict[str, str]:
        """How the frames are stored, and how many contacts have which background."""
        contacts = {row.contact for row in rows}
        kinds = Counter("frame" if c in self.backgrounds else "none" for c in contacts)
        backgrounds = ", ".join(f"{kind} {count}" for kind, count in sorted(kinds.items()))
        return {"layout": self._layout(rows), "backgrounds": backgrounds}

    def _base(self, rows: Sequence[Row]) -> Path:
        """The folder that holds all images: the data set, ``out``, or the one around both."""
        root, out = self.scan.base.resolve(), self.out.resolve()
        both = Path(os.path.commonpath([root, out]))
        return {"extracted": root, "raw": out}.get(self._layout(rows), both)
