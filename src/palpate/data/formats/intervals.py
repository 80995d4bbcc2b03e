"""Interval lists: the touches of recordings as ``video,start,end,label`` lines, beside folders of recordings.

The list is any table (:mod:`palpate.data.tables`). Its columns may have other names (``NAMES``), or map expressions
(:mod:`palpate.data.mapping`) name them; without a header the order is video, start, end, label. ``start`` and ``end`` are frame
numbers from 0 that **both belong to the touch**; with ``half_open`` the end is the first frame after it. ``object``, ``text``,
``session`` and ``background`` (the frame that shows the gel before the touch) are optional. A label of -1 marks contact of unclear
material: no samples, but no background is taken from there either.

The recordings are those of Touch and Go: ``<video>/`` with ``video_frame/`` and ``gelsight_frame/``, or ``video.mp4`` and
``gelsight.mp4``, in the list's folder (or ``root``), in its ``dataset/`` or ``final_dataset/``. Each interval is a touch
``video#000k`` in the order of frames; each of its frames is a sample (``every`` thins). Backgrounds follow the rule of Touch and Go
where the list names none. Intervals that overlap are left out, all of them: which is true is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import polars as pl

from palpate.core import PalpateError, Problem, Progress, quiet
from palpate.data.formats.base import Facts, Found, Scan
from palpate.data.formats.interval_lists import (
    NAMES,
    NEEDED,
    ORDER,
    Interval,
    apart,
    is_bare,
    numbered,
    read_intervals,
)
from palpate.data.formats.touch_and_go import find_videos
from palpate.data.frames import IMAGE_FORMATS, FolderFrames, ImageFormat
from palpate.data.images import Check
from palpate.data.imported import Imported, raise_if, removing_on_error, require_some
from palpate.data.listing import FrameTable
from palpate.data.manifest import Manifest
from palpate.data.recordings import Recordings, Row, VideoFiles
from palpate.data.rows import odd_groups
from palpate.data.tables import header_of

LOOKED_FOR = f"a table with the columns {', '.join(ORDER)}, beside folders of recordings"
FACTS = Facts(
    "recordings of one's own with an interval list",
    "unknown",
    "unknown",
    "unknown",
    "unknown",
    None,
    "as many as the intervals have frames",
    "the column video",
)


class _Whole(Recordings):
    """Recordings whose frames are looked at by interval, not one by one."""

    def _has(self, row: Row) -> bool:
        return True


def detect(source: Path) -> bool:
    """Whether this is a table with a video, a start and an end, and with no paths of images; or such lines without a header."""
    if not source.is_file():
        return False
    header = [name.lower() for name in header_of(source)]
    if {"vision", "tactile"} & set(header):
        return False
    return all(any(name in header for name in NAMES[target]) for target in NEEDED) or is_bare(
        header
    )


def scan(
    source: Path,
    *,
    root: Path | None = None,
    columns: Mapping[str, str] | None = None,
    classes: Path | None = None,
    half_open: bool = False,
    every: int = 1,
    check: Check = "decode",
    progress: Progress = quiet,
) -> Scan:
    """Looks a list and its recordings over without writing anything; rows carry no paths.

    Args:
        source: the list.
        root: folder of the recordings (default: that of the list).
        columns: ``video``, ``start``, ``end``, ``material`` ... -> map expression.
        classes: table of classes, whose numbers stand as labels.
        half_open: ``end`` is the first frame after the touch.
        every: take every so manieth frame of a touch, from its first.
        check: how extracted pictures are checked; ``decode`` decodes the frames of raw videos that are in use, too.
        progress: told what is being done.

    Raises:
        PalpateError: if the list or the recordings are missing, a column is lacking, or an option is out of range.
    """
    base = _root(source, root, every)
    work = _Whole(base, base, _videos(base), {}, "jpg", None, [])
    rows, touches, inconclusive = _prepared(
        work, Path(source), columns, classes, half_open, every, check, progress
    )
    rows = work.decode(rows, progress) if check == "decode" else rows
    found: list[Found] = [
        (
            r.where,
            {
                "id": r.id,
                "video": r.video,
                "frame": r.frame,
                "contact": r.contact,
                **touches[r.contact].words,
            },
        )
        for r in rows
    ]
    return Scan(
        found,
        base,
        work.problems,
        work.suspicious,
        {"dataset": source.stem},
        inconclusive=inconclusive,
    )


def run(
    source: Path,
    out: Path,
    *,
    root: Path | None = None,
    columns: Mapping[str, str] | None = None,
    classes: Path | None = None,
    half_open: bool = False,
    every: int = 1,
    sensor: str | None = None,
    skip_bad: bool = False,
    image_format: ImageFormat = "jpg",
    size: int | None = None,
    check: Check = "decode",
    progress: Progress = quiet,
) -> Imported:
    """Imports the touches of an interval list; frames of raw videos go to ``out/images/<video>/{vision,tactile}/``.

    Args:
        source: the list.
        out: folder to write to. If an import is interrupted, the same call goes on where it stopped.
        root: folder of the recordings (default: that of the list).
        columns: ``video``, ``start``, ``end``, ``material`` ... -> map expression.
        classes: table of classes, whose numbers stand as labels.
        half_open: ``end`` is the first frame after the touch.
        every: take every so manieth frame of a touch, from its first.
        sensor: name of the tactile sensor; null if not given.
        skip_bad: leave bad intervals and frames out and list them, instead of raising.
        image_format: of the cached frames.
        size: shorter side of the cached frames in pixels, if they are larger; None keeps them.
        check: how extracted pictures are checked.
        progress: told what is being done.

    Raises:
        PalpateError: if the list or the recordings are missing, a column is lacking, or an option is out of range.
        ProblemsError: with everything bad at once, unless ``skip_bad``; nothing is left behind.
    """
    base = _root(source, root, every)
    if size is not None and size < 1:
        raise PalpateError(
            "size must be at least 1 pixel",
            str(size),
            "Leave it out to keep the frames as they are",
        )
    if image_format not in IMAGE_FORMATS:
        raise PalpateError(
            f"image_format must be one of {', '.join(IMAGE_FORMATS)}",
            repr(image_format),
            "Choose one of these",
        )
    with removing_on_error(out) as created:
        work = _Whole(base, Path(out), _videos(base), {}, image_format, size, created)
        rows, touches, inconclusive = _prepared(
            work, Path(source), columns, classes, half_open, every, check, progress
        )
        raise_if(work.problems, skip_bad)
        require_some(len(rows), source, work.problems)
        rows = work.extract(rows, progress)
        raise_if(work.problems, skip_bad)
        require_some(len(rows), source, work.problems)
        words = {
            name: FrameTable(
                {
                    (r.video, r.frame): touches[r.contact].words[name]
                    for r in rows
                    if name in touches[r.contact].words
                },
                [],
            )
            for name in ("material", "object", "text", "session")
        }
        text = (columns or {}).get("text", "text")
        facts = {
            **FACTS.of_manifest(),
            "format": "intervals",
            "dataset": Path(source).stem,
            "text_source": f"column {text}" if words["text"].values else "none",
        }
        manifest = work.manifest(rows, facts, "", words)
        named = manifest.table.with_columns(sensor=pl.lit(sensor, dtype=pl.String))
        return Imported(
            Manifest(named, manifest.root, manifest.facts),
            work.problems,
            {},
            inconclusive,
            work.suspicious,
        ).save(out, created)


def _root(source: Path, root: Path | None, every: int) -> Path:
    if every < 1:
        raise PalpateError(
            "every must be at least 1", str(every), "Leave it out to take every frame"
        )
    base = Path(source).parent if root is None else Path(root)
    if not base.is_dir():
        raise PalpateError(
            "The folder of the recordings must exist", f"no folder {base}", "Check --root"
        )
    return base


def _videos(base: Path) -> Mapping[str, VideoFiles]:
    """The recordings.

    Raises:
        PalpateError: if there is none.
    """
    if not (videos := find_videos(base)):
        raise PalpateError(
            f"{base} must hold recordings: folders with video.mp4 and gelsight.mp4, or video_frame/ and gelsight_frame/",
            "none there, nor in dataset/ or final_dataset/",
            "Name their folder: --root",
        )
    return videos


def _prepared(
    work: _Whole,
    source: Path,
    columns: Mapping[str, str] | None,
    classes: Path | None,
    half_open: bool,
    every: int,
    check: Check,
    progress: Progress,
) -> tuple[list[Row], dict[str, Interval], int]:
    """Everything up to extraction: the rows, the touches by name, how many intervals are inconclusive."""
    problems = work.problems
    listed = read_intervals(source, dict(columns or {}), classes, half_open, problems)
    words = odd_groups(source, [(i.where, {"video": i.video, **i.words}) for i in listed])
    work.suspicious += [problem for problem in words if problem.kind == "word-for-null"]
    rows = [Row(i.where, i.video, i.video, i.first, i.where, "") for i in listed]
    opened = {row.where for row in work.open(rows, progress)}
    listed = _within(work, [i for i in listed if i.where in opened])
    contact: dict[str, set[int]] = {}
    for i in listed:
        contact.setdefault(i.video, set()).update(range(i.first, i.last + 1))
    work.in_contact = contact
    touches = {i.touch: i for i in numbered(apart(listed, problems))}
    rows = [row for i in touches.values() for row in _frames(work, i, every)]
    work.choose_backgrounds(rows, {i.touch: i.first for i in touches.values()})
    for name in {row.contact for row in rows}:
        _named_background(work, touches[name])
    rows = work.check(rows, check, progress)
    used = {touch.video for touch in touches.values()}
    work.suspicious += [
        Problem(str(work.root), "unlisted-video", f"the recording {name!r} has no usable interval")
        for name in sorted(set(work.videos) - used)
    ]
    bare = sorted({r.contact for r in rows} - set(work.background_frames) - set(work.typical_of))
    work.suspicious += [
        Problem(
            touches[t].where,
            "no-background",
            f"no frame of {touches[t].video!r} shows the gel untouched",
        )
        for t in bare
    ]
    return rows, touches, sum(i.inconclusive for i in listed)


def _within(work: Recordings, listed: list[Interval]) -> list[Interval]:
    """The intervals that lie within their recordings."""
    good: list[Interval] = []
    for i in listed:
        length = min(len(frames) for frames in work.frames[i.video].values())
        if max(i.last, i.background or 0) >= length:
            what = "the touch" if i.last >= length else "its background"
            text = f"{what} reaches frame {max(i.last, i.background or 0)} of {i.video!r}, whose sides have {length} frames in common, counted from 0"
            work.problems.append(Problem(i.where, "beyond-end", text))
        else:
            good.append(i)
    return good


def _frames(work: Recordings, touch: Interval, every: int) -> list[Row]:
    """A row for each frame of a touch that both sides have; one problem for those that a side lacks."""
    rows: list[Row] = []
    lacking: dict[str, list[int]] = {}
    for k in range(touch.first, touch.last + 1, every):
        without = [side for side, frames in work.frames[touch.video].items() if not frames.has(k)]
        for side in without:
            lacking.setdefault(side, []).append(k)
        if not without:
            rows.append(
                Row(touch.where, f"{touch.video}/{k:010d}", touch.video, k, touch.touch, "")
            )
    for side, missing in lacking.items():
        source = work.frames[touch.video][side]
        leaving = isinstance(source, FolderFrames) and any(k in source.leaving for k in missing)
        text = f"no {side} picture of {len(missing)} of the frames of {touch.touch}, the first of them {missing[0]}, in {source.source}"
        work.problems.append(
            Problem(
                touch.where,
                "outside-root" if leaving else "missing-file",
                text + ": a link that leaves it" * leaving,
            )
        )
    return rows


def _named_background(work: Recordings, touch: Interval) -> None:
    """Puts the background that the list names in place of the rule's."""
    if touch.background is None:
        return
    frames = work.frames[touch.video]["tactile"]
    if not frames.has(touch.background):
        work.problems.append(
            Problem(
                touch.where,
                "missing-file",
                f"no picture of the background, frame {touch.background}, in {frames.source}",
            )
        )
        return
    if touch.background in work.in_contact.get(touch.video, set()):
        text = (
            f"the listed background, frame {touch.background} of {touch.video!r}, lies in a touch"
        )
        work.suspicious.append(Problem(touch.where, "background-in-touch", text))
    work.background_frames[touch.touch] = touch.background
    work.backgrounds[touch.touch] = frames.path(touch.background)
    work.typical_of.pop(touch.touch, None)
