"""From listed frames of two-sided recordings to manifest rows: open, choose backgrounds, check, extract.

Every step drops the rows that it cannot use and says why in ``problems``; nothing is raised in between, so that a user
sees everything that is wrong with a data set at once. Rows of one recording share their fate where the recording is bad.
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

import numpy as np

from palpate.core import (
    PalpateError,
    Problem,
    Progress,
    atomic_path,
    inside,
    read_json,
    rng_for,
    write_json,
)
from palpate.data.frames import (
    FolderFrames,
    Frames,
    ImageFormat,
    VideoFrames,
    nearest_to_median,
    save_picture,
)
from palpate.data.images import Check, check_image, in_threads
from palpate.data.listing import FrameList, FrameTable
from palpate.data.manifest import Manifest

#: The background is this many frames before the touch.
BACKGROUND_BEFORE = 4
#: From at most so many frames is a recording's typical frame chosen.
MEDIAN_OF = 15
SIDES = ("vision", "tactile")


@dataclass(frozen=True)
class VideoFiles:
    """One recording: each side is a folder of frames, a video file, or None where it is missing."""

    name: str
    vision: Path | None
    tactile: Path | None


@dataclass(frozen=True)
class Row:
    """A labeled frame on its way into the manifest; ``where`` is ``list:line``."""

    where: str
    id: str
    video: str
    frame: int
    touch: str
    material: str


@dataclass(frozen=True)
class _Job:
    """The wanted frames of one side of a recording, or (``resting``) its typical frame in no touch."""

    video: str
    side: str
    resting: bool


def rows_of(listed: FrameList) -> list[Row]:
    """The rows of a list, sorted by video and frame."""
    table = listed.rows.with_columns(
        listed.manifest.table["contact"], listed.manifest.table["material"]
    ).sort("video", "frame")
    return [
        Row(
            f"{r['source']}:{r['line']}",
            r["id"],
            r["video"],
            r["frame"],
            r["contact"],
            r["material"],
        )
        for r in table.iter_rows(named=True)
    ]


def first_frames(rows: Iterable[Row]) -> dict[str, int]:
    """Touch -> its first frame."""
    found: dict[str, int] = {}
    for row in rows:
        found[row.touch] = min(row.frame, found.get(row.touch, row.frame))
    return found


def thin(rows: Sequence[Row], most: int | None, seed: int) -> list[Row]:
    """At most ``most`` rows a touch, one from each of that many equal stretches.

    Of a touch of n rows, row ``floor((i + u) n / most)`` is taken for i = 0, 1, ...; u = 1/2 for seed 0, otherwise drawn in
    [0, 1) for each touch.
    """
    if most is None:
        return list(rows)
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.touch, []).append(row)
    taken: list[Row] = []
    for touch, group in groups.items():
        count = len(group)
        if count <= most:
            taken += group
            continue
        phase = 0.5 if seed == 0 else rng_for(seed, "frames of a touch", touch).random()
        taken += [group[int((i + phase) * count / most)] for i in range(most)]
    return taken


@dataclass
class Recordings:
    """The recordings of one data set while it is imported.

    Attributes:
        root: the data set.
        out: where cached frames go.
        videos: recordings on disk, by name.
        contact: frames of each recording in which the sensor touches something.
        image_format, size: of cached frames.
        created: every new file is entered here.
        problems: what is wrong so far.
        suspicious: what looks wrong, but can be used.
        sides: recording -> side -> frames, for those that could be opened.
        background: touch -> background picture.
        background_frames: touch -> the frame before it that is its background, where there is one.
        resting: touches without such a frame -> their recording.
        moved: extracted picture -> its place below ``out``, where some recordings are raw and others are not.
    """

    root: Path
    out: Path
    videos: Mapping[str, VideoFiles]
    contact: Mapping[str, set[int]]
    image_format: ImageFormat
    size: int | None
    created: list[Path]
    problems: list[Problem] = field(default_factory=list)
    suspicious: list[Problem] = field(default_factory=list)
    sides: dict[str, dict[str, Frames]] = field(default_factory=dict)
    background: dict[str, Path] = field(default_factory=dict)
    background_frames: dict[str, int] = field(default_factory=dict)
    resting: dict[str, str] = field(default_factory=dict)
    moved: dict[Path, Path] = field(default_factory=dict)

    def open(self, rows: Sequence[Row], progress: Progress) -> list[Row]:
        """Opens both sides of every recording in use; keeps the rows whose frame is there on both."""
        first: dict[str, Row] = {}
        count: Counter[str] = Counter()
        for row in rows:
            first.setdefault(row.video, row)
            count[row.video] += 1
        progress("reading recordings", 0, len(first))
        for done, (name, found) in enumerate(in_threads(self._open_one, sorted(first)), 1):
            if isinstance(found, dict):
                self.sides[name] = found
                for frames in (
                    frames for frames in found.values() if isinstance(frames, FolderFrames)
                ):
                    self.suspicious += [
                        Problem(
                            str(frames.source / other),
                            "duplicate-frame",
                            f"{read} has the same number, and is read",
                        )
                        for other, read in frames.doubled
                    ]
            else:
                kind, text = found
                self.problems.append(
                    Problem(
                        first[name].where, kind, f"{text} ({_rows(count[name])} of this recording)"
                    )
                )
            progress("reading recordings", done, len(first))
        return [row for row in rows if row.video in self.sides and self._has(row)]

    def _open_one(self, name: str) -> dict[str, Frames] | tuple[str, str]:
        """Both sides of a recording, or what is wrong as (kind, text)."""
        files = self.videos.get(name)
        if files is None:
            return "missing-video", f"the recording {name!r} is not in the data set"
        sides: dict[str, Frames] = {}
        for side in SIDES:
            source: Path | None = getattr(files, side)
            if source is None:
                return "missing-video", f"the recording {name!r} has no {side} side"
            if source.is_dir():
                if inside(self.root, os.path.relpath(source, self.root)) is None:
                    return (
                        "outside-root",
                        f"{source} is a link that leaves the data set; import from the folder that really holds it",
                    )
                sides[side] = FolderFrames(source, self.root)
                continue
            try:
                sides[side] = VideoFrames(
                    source, self.out / "images" / name / side, self.image_format, self.size
                )
            except PalpateError as error:
                return "bad-video", f"{source}: {error.got}"
        return sides

    def _has(self, row: Row) -> bool:
        """Whether the frame is there on both sides; says so if not."""
        sides = self.sides[row.video]
        length = min(len(frames) for frames in sides.values())
        if row.frame >= length:
            text = f"frame {row.frame} lies behind the end of {row.video!r}, whose sides have {length} frames in common, counted from 0"
            self.problems.append(Problem(row.where, "beyond-end", text))
            return False
        missing = [side for side, frames in sides.items() if not frames.has(row.frame)]
        for side in missing:
            source = sides[side]
            if isinstance(source, FolderFrames) and row.frame in source.leaving:
                self.problems.append(
                    Problem(
                        row.where,
                        "outside-root",
                        f"{source.path(row.frame)} is a link that leaves the data set",
                    )
                )
            else:
                self.problems.append(
                    Problem(
                        row.where,
                        "missing-file",
                        f"no picture of frame {row.frame} in {source.source}",
                    )
                )
        return not missing

    def choose_backgrounds(self, rows: Sequence[Row], starts: Mapping[str, int]) -> None:
        """The background of every touch: 4 frames before it, else further back, else (in ``extract``) a typical frame in no touch, else none."""
        for touch, row in {row.touch: row for row in reversed(rows)}.items():
            frames, contact = self.sides[row.video]["tactile"], self.contact.get(row.video, set())
            there = frames.numbers
            before = bisect_right(there, starts[touch] - BACKGROUND_BEFORE)
            k = next((there[i] for i in range(before - 1, -1, -1) if there[i] not in contact), None)
            if k is not None:
                self.background_frames[touch] = k
                self.background[touch] = frames.path(k)
            elif self._untouched(row.video):
                self.resting[touch] = row.video

    def _untouched(self, video: str) -> list[int]:
        """Up to 15 evenly spaced frames in no touch; a margin of 4 frames around touches is kept where that leaves any."""
        there = np.asarray(self.sides[video]["tactile"].numbers, np.int64)
        contact = np.array(sorted(self.contact.get(video, set())), np.int64)
        for margin in (BACKGROUND_BEFORE, 0):
            # A frame is near a touch if some frame of contact lies between it less and it plus the margin.
            near = np.searchsorted(contact, there - margin, "left") < np.searchsorted(
                contact, there + margin, "right"
            )
            free = there[~near].tolist()
            if free:
                return [
                    free[i]
                    for i in sorted(
                        {
                            int(p)
                            for p in np.linspace(
                                0, len(free) - 1, min(MEDIAN_OF, len(free))
                            ).round()
                        }
                    )
                ]
        return []

    def check(self, rows: list[Row], how: Check, progress: Progress) -> list[Row]:
        """Checks every extracted picture in use once; keeps the rows whose pictures are whole."""
        first: dict[Path, Row] = {}
        for row in rows:
            for side, frames in self.sides[row.video].items():
                if not frames.raw:
                    first.setdefault(frames.path(row.frame), row)
                    if side == "tactile" and row.touch in self.background_frames:
                        first.setdefault(self.background[row.touch], row)
        bad: set[Path] = set()
        if how != "none":
            progress("checking images", 0, len(first))
            for done, (path, reason) in enumerate(
                in_threads(lambda p: check_image(p, how), first), 1
            ):
                if reason:
                    bad.add(path)
                    self.problems.append(
                        Problem(first[path].where, "bad-image", f"{path}: {reason}")
                    )
                progress("checking images", done, len(first))
        self.background = {
            touch: path for touch, path in self.background.items() if path not in bad
        }
        self.problems.sort(key=lambda p: _place(p.where))
        return [
            row
            for row in rows
            if not any(frames.path(row.frame) in bad for frames in self.sides[row.video].values())
        ]

    def decode(self, rows: list[Row], progress: Progress) -> list[Row]:
        """Decodes what ``extract`` would cache, and writes nothing; keeps the rows whose pictures are whole."""
        wanted = self._wanted(rows)
        whole: dict[tuple[str, str], set[int]] = {key: set() for key in wanted}

        def work(job: _Job, stop: Event) -> None:
            frames = self.sides[job.video][job.side]
            if job.resting:
                nearest_to_median(frames, self._untouched(job.video))
            elif isinstance(frames, VideoFrames):
                frames.decode(wanted[job.video, job.side], whole[job.video, job.side], stop)

        self._do("decoding frames", rows, wanted, work, progress)
        return [
            row
            for row in rows
            if all(
                not f.raw or row.frame in whole[row.video, s]
                for s, f in self.sides[row.video].items()
            )
        ]

    def extract(self, rows: list[Row], progress: Progress) -> list[Row]:
        """Caches the needed frames of raw videos and the medians; keeps the rows whose pictures are there."""
        wanted = self._wanted(rows)
        if wanted:
            self._require_same_settings(wanted)
        typical: dict[str, Path] = {}

        def work(job: _Job, stop: Event) -> None:
            frames = self.sides[job.video][job.side]
            if job.resting:
                k, picture = nearest_to_median(frames, self._untouched(job.video))
                typical[job.video] = frames.path(k)
                if frames.raw and not typical[job.video].is_file():
                    self.created.append(typical[job.video])
                    save_picture(typical[job.video], picture, self.size)
            elif isinstance(frames, VideoFrames):
                frames.extract(wanted[job.video, job.side], self.created, stop)

        self._do("extracting frames", rows, wanted, work, progress)
        self.background |= {
            touch: typical[video] for touch, video in self.resting.items() if video in typical
        }
        self.background = {touch: path for touch, path in self.background.items() if path.is_file()}
        rows = [
            row
            for row in rows
            if all(not f.raw or f.path(row.frame).is_file() for f in self.sides[row.video].values())
        ]
        if len({f.raw for row in rows for f in self.sides[row.video].values()}) > 1:
            self._gather(rows)
        return rows

    def _wanted(self, rows: Iterable[Row]) -> dict[tuple[str, str], set[int]]:
        """(recording, side) -> the frames of a raw video that the rows and their backgrounds need."""
        wanted: dict[tuple[str, str], set[int]] = {}
        for row in rows:
            for side, frames in self.sides[row.video].items():
                if frames.raw:
                    wanted.setdefault((row.video, side), set()).add(row.frame)
                    if side == "tactile" and row.touch in self.background_frames:
                        wanted[row.video, side].add(self.background_frames[row.touch])
        return wanted

    def _do(
        self,
        what: str,
        rows: Sequence[Row],
        wanted: Iterable[tuple[str, str]],
        work: Callable[[_Job, Event], None],
        progress: Progress,
    ) -> None:
        """Does the work for every wanted side and for the typical frame of every resting recording; what breaks off is a problem."""
        first = {row.video: row for row in reversed(rows)}
        touches = {row.touch for row in rows}
        resting = sorted({video for touch, video in self.resting.items() if touch in touches})
        jobs = [
            *(_Job(video, side, False) for video, side in wanted),
            *(_Job(video, "tactile", True) for video in resting),
        ]
        stop = Event()

        def told(job: _Job) -> str | None:
            try:
                work(job, stop)
            except PalpateError as error:
                return f"{self.sides[job.video][job.side].source}: {error.got}"
            return None

        progress(what, 0, len(jobs))
        for done, (job, text) in enumerate(in_threads(told, jobs, stop=stop), 1):
            if text:
                self.problems.append(Problem(first[job.video].where, "bad-video", text))
            progress(what, done, len(jobs), job.video)
        self.problems.sort(key=lambda p: _place(p.where))

    def _gather(self, rows: Sequence[Row]) -> None:
        """Puts extracted pictures beside the cached ones, as hard links where the disk allows, so that one root holds all."""
        for row in rows:
            for side, frames in self.sides[row.video].items():
                if frames.raw:
                    continue
                used = [frames.path(row.frame)]
                if side == "tactile" and row.touch in self.background:
                    used.append(self.background[row.touch])
                for path in used:
                    target = self.out / "images" / row.video / side / path.name
                    if path not in self.moved and not target.is_file():
                        self.created.append(target)
                        with atomic_path(target) as part:
                            part.unlink()
                            try:
                                os.link(path, part)
                            except OSError:
                                shutil.copyfile(path, part)
                    self.moved[path] = target

    def _require_same_settings(self, wanted: Iterable[tuple[str, str]]) -> None:
        """Refuses to mix cached frames of other settings or other videos with new ones."""
        path = self.out / "images" / "settings.json"
        now = {"format": self.image_format, "size": self.size}
        videos = {
            f"{video}/{side}": self.sides[video][side].source.stat().st_size
            for video, side in sorted(wanted)
        }
        if path.is_file():
            then = read_json(path, "record of the cached frames")
            before: dict[str, int] = then.pop("videos")
            changed = [name for name, size in videos.items() if before.get(name, size) != size]
            if then != now or changed:
                raise PalpateError(
                    f"The frames cached in {path.parent} must have been made from the same videos with the same settings",
                    f"other videos: {', '.join(changed)}"
                    if changed
                    else f"{then} there, {now} here",
                    "Choose another folder, or remove that one",
                )
            videos = before | videos
        else:
            self.created.append(path)
        write_json(path, {**now, "videos": videos})

    def manifest(
        self,
        rows: Sequence[Row],
        facts: Mapping[str, str],
        sensor: str,
        words: Mapping[str, FrameTable | None],
    ) -> Manifest:
        """The manifest of the rows; ``words`` fills columns by (video, frame).

        Its root is the data set if all recordings are extracted, else ``out``.
        """
        raws = {f.raw for row in rows for f in self.sides[row.video].values()}
        root = (self.out if True in raws else self.root).resolve()
        prefix: dict[Path, str] = {}

        def name(path: Path) -> str:
            path = self.moved.get(path, path)
            folder = path.parent
            if folder not in prefix:
                prefix[folder] = Path(os.path.relpath(folder.resolve(), root)).as_posix()
            return path.name if prefix[folder] == "." else f"{prefix[folder]}/{path.name}"

        table = [
            {
                "id": row.id,
                "video": row.video,
                "frame": row.frame,
                "contact": row.touch,
                "material": row.material,
                "sensor": sensor,
                "vision": name(self.sides[row.video]["vision"].path(row.frame)),
                "tactile": name(self.sides[row.video]["tactile"].path(row.frame)),
                "background": name(self.background[row.touch])
                if row.touch in self.background
                else None,
                **{
                    column: t.values.get((row.video, row.frame))
                    for column, t in words.items()
                    if t is not None
                },
            }
            for row in rows
        ]
        layout = "mixed" if len(raws) > 1 else "raw" if True in raws else "extracted"
        used = {row.touch: row.video for row in rows}
        kinds = Counter(
            "none"
            if t not in self.background
            else "frame"
            if t in self.background_frames
            else "typical"
            for t in used
        )
        background = ", ".join(f"{kind} {n}" for kind, n in sorted(kinds.items()))
        return Manifest.from_rows(
            table, root, {**facts, "layout": layout, "backgrounds": background}
        )


def _rows(count: int) -> str:
    return f"{count} row{'s' * (count != 1)}"


def _place(where: str) -> tuple[str, int]:
    """``file:line`` to sort by."""
    name, _, line = where.rpartition(":")
    return (name, int(line)) if line.isdecimal() else (where, 0)
