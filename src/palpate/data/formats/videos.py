"""Anyone's videos or stacks of frames: path templates say which file is what.

::

    root/
      {object}_{video}.mov                        tactile videos alone, or
      {object}/{video}/camera.mp4  gel.mp4        both sides, in step; or
      {object}/rgb.npy  gel.npy                   stacks (n, h, w, 3), read from the disk piece by
                                                  piece; or
      {object}.jpg  {object}_{video}.mov          one photo for many tactile videos

A template (:mod:`palpate.data.templates`) for each side is given, or found from the names of the
files. Fields become columns, and equal fields join the sides. A video is named by its field
``video`` (and the object around it), else by all fields. An image may serve a whole video: a photo
as ``vision``, the untouched gel as ``background``.

A frame is its position in the tactile file. The photo is that of the same number, or, where the
time stamps of two videos show other rates or gaps, the one that is nearest in time. The samples are
the frames in contact (:mod:`palpate.data.contacts`), or every n-th frame of the whole video, in
contact or not. A contact is ``video#000k``; its background is the gel before it.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from filecmp import cmp
from pathlib import Path

import numpy as np

from palpate.core import PalpateError, ProblemsError, Progress, atomic_path, few, quiet, require
from palpate.core.images import SUFFIXES
from palpate.data.contacts import Contacts, find_contacts, thumbnail
from palpate.data.detection import (
    ORDER,
    SIDES,
    Side,
    joined,
    name_apart,
    parsed,
    templates_of,
    walked,
)
from palpate.data.formats.layout import first_files, has_listed_videos, require_folder
from palpate.data.formats.recordings import Pairing, Recordings, Row, thin
from palpate.data.frames import MOVING
from palpate.data.images import Check, in_threads, read_image
from palpate.data.manifest import PART_NAMES, is_image
from palpate.data.scanning import Cells, Facts, Format, Into, Scan
from palpate.data.streams import Finding
from palpate.data.suspicions import startup_frames
from palpate.data.templates import FIX, Fields, Template, assign, walk

FACTS = Facts(
    name="your own videos", samples="the frames in contact, or every n-th", group="the column video"
)
LOOKS_FOR = f"a folder of videos or stacks ({', '.join(MOVING)})"


@dataclass(frozen=True)
class _Video:
    """A recording: side -> its video or stack, side -> an image for all frames, its fields."""

    name: str
    moving: dict[str, str]
    still: dict[str, str]
    fields: Fields

    @property
    def where(self) -> str:
        """The file that names it."""
        return next(iter(self.moving.values()))


def detect(source: Path) -> bool:
    """Whether this is a folder with videos or stacks below it, and without images."""
    if not source.is_dir() or has_listed_videos(source):
        return False
    files = first_files(source)
    images = any(map(is_image, files))
    return not images and any(name.lower().endswith(MOVING) for name in files)


def is_templated(source: Path, templates: Mapping[str, str]) -> bool:
    """Whether a template is of a video or stack, or matches one below a folder."""
    if any(text.lower().endswith(MOVING) for text in templates.values()):
        return True
    parsed = {side: Template.parse(text, side) for side, text in templates.items()}
    files, _ = walk(source, MOVING) if source.is_dir() else ([], [])
    return any(assign(files, parsed).values())


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a folder of videos is read by.

    Attributes:
        vision: template of the videos (or photos) of the scene; without any template the names are
            searched.
        tactile: template of the tactile videos.
        background: template of images of the untouched gel.
        side: what the videos show, if all show one thing.
        every: take every n-th frame of whole videos, in contact or not.
        max_per_contact: keep that many evenly spaced frames of a contact.
        sensor: the tactile sensor.
        size: their shorter side is reduced to so many pixels.
        pairing: whether frames of both sides belong together by their time stamps, where these
            show other rates or gaps, or by number.
    """

    vision: str | None = None
    tactile: str | None = None
    background: str | None = None
    side: Side | None = None
    every: int | None = None
    max_per_contact: int | None = None
    sensor: str | None = None
    size: int | None = None
    pairing: Pairing = "time"


def scan(
    source: Path,
    options: Options,
    *,
    check: Check = "decode",
    into: Into | None = None,
    progress: Progress = quiet,
) -> Scan:
    """Read a folder of videos; without ``into`` nothing is written."""
    every = options.every
    videos, result = _videos(require_folder(source, FACTS.name), options)
    decoded = check == "decode" or into is not None
    _require_amounts(videos, every if decoded else 1, options.max_per_contact)
    work = _opened(result, into, videos, progress, options)
    contacts = _contacts(work, videos, progress) if decoded else {}
    rows = _rows(work, videos, contacts, every if decoded else 1, options.sensor)
    rows = thin(rows, options.max_per_contact)
    hidden: Cells = dict.fromkeys(ORDER)
    if into is not None:
        _require_contact(result, rows)
        rows = work.extract(rows, progress)
        _copy_images(result.base, into, rows, videos)
        result.base, hidden = work.out, {}
        result.facts["frames"] = "in contact" if every is None else f"every {every} of whole videos"
    cells = work.cells(rows, work.out.resolve())
    result.rows = [(row.where, cell | hidden) for row, cell in zip(rows, cells, strict=True)]
    if any("split" in cell for cell in cells):
        result.split_rule = {"column": "split"}
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan, record=Options)


def _videos(root: Path, options: Options) -> tuple[dict[str, _Video], Scan]:
    """The recordings by name, and a scan without rows that holds what was wrong or odd."""
    result = Scan(root, {"layout": "videos", "dataset": root.resolve().stem, "text_source": "none"})
    texts = {column: text for column in ORDER if (text := getattr(options, column)) is not None}
    files = walked(result, (*MOVING, *SUFFIXES))
    moving = [path for path in files if path.lower().endswith(MOVING)]
    templates = parsed(texts or templates_of(moving, root, options.side, "videos", _naming_videos))
    matches = assign(files, templates)
    for column, template in templates.items():
        kinds = {path.lower().endswith(MOVING) for path, _ in matches[column]}
        images = column == "background" or (column == "vision" and "tactile" in templates)
        got = f"{template.text}, which matches none of {few(files)}"
        got = got if not kinds else f"{template.text}, which matches images, too"
        must = "must match images or videos" if images else "must match videos"
        require(kinds == {True} or (kinds == {False} and images), column, must, got, fix=FIX)
        got, fix = f"{template.text} with the field frame", "Name it video"
        must = "must say which video, not frame"
        require("frame" not in template.fields, column, must, got, fix=fix)
    rows, fields = joined(result, moving, templates, matches, "videos")
    name_apart(rows, fields)
    return _named(rows, fields, result), result


def _naming_videos(texts: Mapping[str, str]) -> dict[str, str]:
    """Templates whose number or name is that of a video, and not of a frame."""
    field = "{take}" if any("{video" in text for text in texts.values()) else "{video}"
    names = [n for n in ("{frame:d}", "{name}", "{sample}") if any(n in t for t in texts.values())]
    return {c: text.replace(names[0], field) if names else text for c, text in texts.items()}


def _named(rows: list[Fields], fields: tuple[str, ...], result: Scan) -> dict[str, _Video]:
    """The recordings by name: the field ``video``, if it differs between them, else all fields."""
    names = [row.get("video", "") for row in rows]
    if "" in names or len(set(names)) < len(names):
        names = ["/".join(row[name] for name in fields if name in row) for row in rows]
    videos: dict[str, _Video] = {}
    for name, row in zip(names, rows, strict=True):
        paths = {column: row[column] for column in ORDER if column in row}
        moving = {c: path for c, path in paths.items() if path.lower().endswith(MOVING)}
        still = {c: path for c, path in paths.items() if c not in moving}
        values = {field: row[field] for field in fields if field in row}
        name = name or Path(next(iter(moving.values()))).stem
        video = _Video(name, moving, still, values)
        if len(set(paths.values())) < len(paths):
            text = f"its {' and its '.join(paths)} are one file"
            result.problem(video.where, "same-image", text)
        elif (before := videos.setdefault(name, video)) is not video:
            text = f"the video {name!r} is {before.where} already"
            result.problem(video.where, "duplicate-id", text)
        elif values.get("split", "train").lower() not in PART_NAMES:
            result.problem(video.where, "unknown-part", f"the split {values['split']!r} is unknown")
    return videos


def _require_amounts(
    videos: Mapping[str, _Video], every: int | None, max_per_contact: int | None
) -> None:
    require(every is None or every >= 1, "every", "must be at least 1", every)
    must, alone = "must come without every", every is None or max_per_contact is None
    require(alone, "max_per_contact", must, str(max_per_contact), fix="Choose one")
    if every is None and videos and not any("tactile" in v.moving for v in videos.values()):
        must, got = "must be given", "videos without touch, in which no contact is found"
        raise PalpateError(must, got, "", argument="every", example={"every": 10})


def _opened(
    result: Scan,
    into: Into | None,
    videos: Mapping[str, _Video],
    progress: Progress,
    options: Options,
) -> Recordings:
    """The recordings with their files open."""
    files = {
        name: {c: result.base / v.moving[c] if c in v.moving else None for c in SIDES}
        for name, v in videos.items()
    }
    sides = tuple(c for c in SIDES if any(c in v.moving for v in videos.values()))
    work = Recordings(
        result, into, files, {}, options.size, modalities=sides, pairing=options.pairing
    )
    work.open([Row(v.where, name, name, 0, name) for name, v in videos.items()], progress)
    return work


def _contacts(
    work: Recordings, videos: Mapping[str, _Video], progress: Progress
) -> dict[str, Contacts | None]:
    """Recording -> its contacts, None without touch; what looks wrong is reported."""

    def find(video: str) -> tuple[Contacts | None, list[Finding]] | str:
        try:
            declared = videos[video].still.get("background")
            gel = None if declared is None else thumbnail(read_image(work.scan.base / declared))
            images, problems = work.watched(video)
        except PalpateError as error:
            return error.got
        if (touch := images.get("tactile")) is None:
            return None, problems
        if count := startup_frames(touch):  # they are no contact
            touch = np.concatenate([touch[count : count + 1].repeat(count, axis=0), touch[count:]])
        return find_contacts(touch, gel=gel), problems

    contacts: dict[str, Contacts | None] = {}
    for video, outcome in in_threads(find, sorted(work.frames), "finding contacts", progress):
        if isinstance(outcome, str):
            work.scan.problem(video, "bad-video", outcome)
            continue
        contacts[video], problems = outcome
        for problem in problems:
            work.scan.suspect(video, *problem)
        if outcome[0] is not None and not outcome[0].runs:
            work.scan.suspect(video, "no-contact", outcome[0].why_none())
    return contacts


def _require_contact(result: Scan, rows: list[Row]) -> None:
    """Raise if no video has a contact, and nothing else is wrong."""
    none = [problem for problem in result.suspicious if problem.kind == "no-contact"]
    if none and not rows and not result.problems:
        fix = "Give an image of the untouched gel, or take frames in contact or not"
        raise ProblemsError(none, fix, example={"every": 10})


def _rows(
    work: Recordings,
    videos: Mapping[str, _Video],
    contacts: Mapping[str, Contacts | None],
    every: int | None,
    sensor: str | None,
) -> list[Row]:
    """A row for each frame to take; those in no contact have their video's name for one."""
    rows: list[Row] = []
    for name, video in videos.items():
        if name not in work.frames or (contacts and name not in contacts):
            continue
        analysis = contacts.get(name)
        opened = work.frames[name].values()
        numbers = range(min(map(len, opened)))
        contact_of = {k: name for k in numbers if all(frames.has(k) for frames in opened)}
        chosen = {} if analysis is None else {name: analysis.reference}
        for k, (first, last) in enumerate(analysis.runs if analysis else (), 1):
            contact = video.fields.get("contact", f"{name}#{k:04d}")
            chosen.setdefault(contact, analysis.backgrounds[k - 1] if analysis else 0)
            inside = (frame for frame in range(first, last + 1) if frame in contact_of)
            contact_of |= dict.fromkeys(inside, contact)
        if "background" not in video.still:
            work.background_frames |= chosen
            work.backgrounds |= {c: work.frames[name]["tactile"].path(k) for c, k in chosen.items()}
        frames = (
            sorted(contact_of)[::every]
            if every
            else [k for k, c in contact_of.items() if c != name]
        )
        own = ("id", "video", "frame", "contact")
        more = {field: value for field, value in video.fields.items() if field not in own}
        if "split" in more:
            more["split"] = PART_NAMES.get(more["split"].lower(), "")
        more |= {column: _place(name, column, path) for column, path in video.still.items()}
        more |= {} if sensor is None else {"sensor": sensor}
        for k in frames:
            further = {**more, "contact": None} if contact_of[k] == name else more
            rows.append(Row(video.where, f"{name}/{k:010d}", name, k, contact_of[k], further))
    return rows


def _copy_images(root: Path, into: Into, rows: list[Row], videos: Mapping[str, _Video]) -> None:
    """Copy the images that serve whole videos next to the frames, so that one root holds all."""
    for name in dict.fromkeys(row.video for row in rows):
        for column, path in videos[name].still.items():
            target = into.out / _place(name, column, path)
            if not (target.is_file() and cmp(target, root / path, shallow=False)):
                into.created.append(target)
                with atomic_path(target) as part:
                    shutil.copyfile(root / path, part)


def _place(video: str, column: str, path: str) -> str:
    return f"images/{video}/{column}/{Path(path).name}"
