"""Touch and Go (Yang, Ma, Zhang, Zhu, Yuan, Owens; NeurIPS 2022): a scene and a GelSight.

::

    root/
      label.txt                  video/0000000033.jpg,15     every labeled in-contact frame
      category_reference.txt     Rock: 15
      train.txt  test.txt        the official split, lines as in label.txt (optional)
      captions.csv  objects.csv  frame,text and frame,object, by the user (optional)
      dataset/<video>/video.mp4        gelsight.mp4          raw, 640x480, in step; or
      dataset/<video>/video_frame/     gelsight_frame/       extracted, 0000000000.jpg ...

The videos may also be under ``final_dataset/`` or in the root itself. The number of a frame is its
position in both videos, so it is valid up to the shorter one. The background of a contact is the
gel 4 frames before it begins; if the sensor is in contact there, the nearest earlier frame where it
is not; if there is none, of up to 15 frames outside all contacts the one nearest to their median;
else null.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Problem, Progress, Split, quiet, require_choice, write_text
from palpate.data.formats.base import WORLD, Cells, Facts, Format, Into, Scan, world_facts
from palpate.data.formats.layout import require_folder, subfolders
from palpate.data.frames import IMAGE_FORMATS, ImageFormat
from palpate.data.images import Check
from palpate.data.imported import raise_if, require_some
from palpate.data.listing import (
    INCONCLUSIVE,
    FrameList,
    FrameTable,
    read_categories,
    read_frame_table,
    read_lists,
    write_list,
)
from palpate.data.manifest import Manifest
from palpate.data.recordings import Recordings, VideoFiles, first_frames, rows_of, thin
from palpate.data.recordings import Row as FrameRow

FACTS = Facts(
    name="Touch and Go",
    citation="F. Yang, C. Ma, J. Zhang, J. Zhu, W. Yuan, A. Owens: Touch and Go: Learning from "
    "Human-Collected Vision and Touch. NeurIPS Datasets and Benchmarks, 2022",
    license="CC BY 4.0",
    url="https://touch-and-go.github.io",
    sensor="GelSight'17",
    image_size=(640, 480),
    samples="121,861 frames of 126 videos in the official lists; label.txt has about twice as many",
    group="video",
    normalization={
        "touch, 50 images (T3)": ((0.51808, 0.50300, 0.51457), (0.13893, 0.11343, 0.13497))
    },
)
LOOKS_FOR = (
    "label.txt (or train.txt, test.txt), and videos under dataset/, final_dataset/ or the folder "
    "itself"
)
_NAMES = (
    "Concrete, Plastic, Glass, Wood, Metal, Brick, Tile, Leather, Synthetic Fabric, Natural Fabric,"
    " Rubber, Paper, Tree, Grass, Soil, Rock, Gravel, Sand, Plants, Others"
)
CATEGORIES: dict[int, str] = dict(enumerate(_NAMES.split(", ")))
#: Part of the official split -> its list.
OFFICIAL = {"train": "train.txt", "test": "test.txt"}
PLACES = ("dataset", "final_dataset", ".")
MODALITIES = {"vision": ("video_frame", "video.mp4"), "tactile": ("gelsight_frame", "gelsight.mp4")}


def detect(source: Path) -> bool:
    """Whether a folder has a list and a recording."""
    lists = ("label.txt", *OFFICIAL.values())
    return any((source / name).is_file() for name in lists) and bool(find_videos(source))


def find_videos(root: Path) -> dict[str, VideoFiles]:
    """Recordings by name; extracted frames go before the raw video."""
    videos: dict[str, VideoFiles] = {}
    for place in PLACES:
        for name in subfolders(root / place):
            paths: dict[str, Path | None] = {}
            for modality, (frames, video) in MODALITIES.items():
                folder, file = (root / place / name / part for part in (frames, video))
                paths[modality] = folder if folder.is_dir() else file if file.is_file() else None
            if any(paths.values()):
                videos.setdefault(name, VideoFiles(name, **paths))
    return videos


def scan(
    root: Path,
    *,
    labels: Sequence[Path] | Path | None = None,
    image_format: ImageFormat = "jpg",
    size: int | None = None,
    max_per_contact: int | None = None,
    seed: int = 0,
    check: Check = "decode",
    into: Into | None = None,
    progress: Progress = quiet,
) -> Scan:
    """Read lists, recordings, frames and images.

    Without ``into`` nothing is written: with ``check="decode"`` the frames in use are decoded as an
    import would, those of raw videos too; rows carry paths of extracted frames only if ``check`` is
    ``none``.

    Args:
        root: the data set.
        labels: frame lists; default ``label.txt``, else ``train.txt`` and ``test.txt``.
        image_format: of the cached frames.
        size: shorter side of the cached frames in pixels, if they are larger; None keeps them.
        max_per_contact: import that many evenly spaced frames of a contact.
        seed: with ``max_per_contact``: 0 takes the middle of each of the equal stretches, any other
            a random place in them.
        check: how extracted images are checked.
        into: where frames of raw videos go, to ``images/<video>/{vision,tactile}/``. After an
            interruption the same call continues.
        progress: progress callback.

    Raises:
        PalpateError: if the root, the list or the recordings are missing, or ``into`` holds frames
            of other settings.
        ProblemsError: with ``into``, before frames are written, unless bad rows are skipped.
    """
    root = require_folder(root, FACTS.name)
    require_frame_options(image_format, size)
    if max_per_contact is not None and max_per_contact < 1:
        got = str(max_per_contact)
        raise PalpateError("must be at least 1", got, "", argument="max_per_contact")
    videos, lists = require_videos(root), _read_lists(root, labels)
    out, created = (into.out, into.created) if into else (root, list[Path]())
    work = Recordings(root, out, videos, lists.in_contact, image_format, size, created)
    work.problems += lists.problems
    work.suspicious += lists.unused
    every = rows_of(lists.listed)
    rows = work.open(thin(every, max_per_contact, seed) if into else every, progress)
    listed = set(lists.listed.contact["video"])
    rows = usable(work, rows, first_frames(every), listed, check=check, progress=progress)
    result = Scan(root, lists.facts, inconclusive=lists.listed.inconclusive)
    more: dict[str, Any] = {"sensor": lists.sensor, "words": lists.words}
    add_frames(result, work, rows, check=check, into=into, progress=progress, **more)
    if lists.official is not None:
        part_of = {name: part for part, name in OFFICIAL.items()}
        cells = lists.official.rows.select("video", "frame", "source").iter_rows()
        parts = {(video, frame): part_of[Path(source).name] for video, frame, source in cells}
        for _, row in result.rows:
            row["split"] = parts.get((row["video"], row["frame"]))
        result.split_name = "Orig"
        result.split_rule = {"method": "official", "files": list(OFFICIAL.values())}
    return result


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Write ``<part>.txt`` with a ``video/0000000033.jpg,3`` line a sample, as the official lists.

    The classes are those of the manifest's fact ``classes``, which an import with another table
    than the published one writes, else the published ones. A material that is none of them keeps
    its number if it is one (bare lists without a category table), else it gets the next one, and
    ``category_reference.txt`` says which.

    Raises:
        PalpateError: if a sample has no video or frame.
    """
    classes: dict[str, str] = json.loads(manifest.facts.get("classes", "{}"))
    ids: dict[str | None, int] = {name: int(k) for k, name in (classes or CATEGORIES).items()}
    names = set(manifest.column("material")) - {None, *ids}
    more = sorted(name for name in names if not name.isdecimal())
    ids |= {name: k for k, name in enumerate(more, max(ids.values()) + 1)}
    table = "".join(f"{name}: {k}\n" for name, k in ids.items())
    ids[None] = INCONCLUSIVE
    columns = ("id", "video", "frame", "material")
    files: list[Path] = []
    for part in split.counts():
        rows: list[tuple[str, int]] = []
        for i, video, frame, name in manifest.part(split, part).table.select(columns).iter_rows():
            label = ids[name] if name in ids else int(name)
            if video is None or frame is None:
                must = "A frame list needs the video and frame of every sample"
                got = f"{i!r} with video {video!r} and frame {frame!r}"
                raise PalpateError(must, got, "Write the split file alone")
            rows.append((f"{video}/{frame:010d}.jpg", label))
        files.append(Path(folder) / f"{part}.txt")
        write_list(files[-1], rows)
    if more:
        files.append(Path(folder) / "category_reference.txt")
        write_text(files[-1], table)
    return files


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan, write_lists)


# --- Steps that interval lists share


def require_videos(root: Path) -> dict[str, VideoFiles]:
    """The recordings.

    Raises:
        PalpateError: if there is none.
    """
    videos = find_videos(root)
    if not videos:
        must = f"{root} must hold recordings: folders with video.mp4 and gelsight.mp4, or "
        must += "video_frame/ and gelsight_frame/"
        got = "none there, nor in dataset/ or final_dataset/"
        raise PalpateError(must, got, f"Check the folder, or fetch videos from {FACTS.url}")
    return videos


def require_frame_options(image_format: str, size: int | None) -> None:
    """Check the options of extracted frames.

    Raises:
        PalpateError: if one is out of range.
    """
    if size is not None and size < 1:
        raise PalpateError("must be at least 1 pixel", str(size), "", argument="size")
    require_choice("image_format", image_format, IMAGE_FORMATS)


def extracted(
    work: Recordings, rows: list[FrameRow], source: Path, *, skip_bad: bool, progress: Progress
) -> list[FrameRow]:
    """The rows whose frames are there after extracting those of raw videos.

    Raises:
        ProblemsError: if something is bad and not ``skip_bad``, or no row is left.
    """
    raise_if(work.problems, skip_bad)
    require_some(len(rows), source, work.problems)
    rows = work.extract(rows, progress)
    raise_if(work.problems, skip_bad)
    require_some(len(rows), source, work.problems)
    return rows


def usable(
    work: Recordings,
    rows: list[FrameRow],
    starts: Mapping[str, int],
    listed: set[str],
    *,
    check: Check,
    progress: Progress,
) -> list[FrameRow]:
    """The rows whose images are whole, with a background chosen for each contact.

    Args:
        work: takes what is wrong.
        rows: of opened recordings.
        starts: contact -> its first frame.
        listed: the recordings in use; others are reported.
        check: how images are checked.
        progress: progress callback.
    """
    work.choose_backgrounds(rows, starts)
    rows = work.check(rows, check, progress)
    for video in sorted(set(work.videos) - listed):
        text = f"no usable contact of the recording {video!r} is listed"
        work.suspicious.append(Problem(str(work.root), "unlisted-video", text))
    with_background = {*work.background_frames, *work.typical_of}
    for contact in sorted({row.contact for row in rows} - with_background):
        text = "no frame of its recording shows the untouched gel"
        work.suspicious.append(Problem(contact, "no-background", text))
    return rows


def add_frames(
    result: Scan,
    work: Recordings,
    rows: list[FrameRow],
    *,
    check: Check,
    into: Into | None,
    progress: Progress,
    sensor: str | None = None,
    words: Mapping[str, FrameTable | None] | None = None,
) -> None:
    """Add usable rows to a scan, after extracting their frames, or only decoding them.

    Without ``into`` they have paths only if they are still to be checked and are files.
    """
    hidden: Cells = {}
    if into is not None:
        rows = extracted(work, rows, result.base, skip_bad=into.skip_bad, progress=progress)
        result.facts |= work.facts(rows)
        result.base = work.base(rows)
    else:
        rows = work.decode(rows, progress, videos=check == "decode")
        if check == "decode":
            work.check_streams(progress)
        hidden = {} if check == "none" else dict.fromkeys((*MODALITIES, "background"))
    cells = work.cells(rows, result.base.resolve(), sensor, words)
    result.rows = [(row.where, cell | hidden) for row, cell in zip(rows, cells, strict=True)]
    result.problems, result.suspicious = work.problems, work.suspicious


# --- Lists


@dataclass(frozen=True)
class _Lists:
    """What the lists at the root hold.

    Attributes:
        listed: the samples.
        official: the official lists, joined, if both are there.
        words: manifest column -> its words by frame.
        in_contact: recording -> the frames that any list calls a contact.
        facts: for the manifest.
        sensor: the tactile sensor.
        problems: all bad lines, each once.
        unused: tables with words of frames that no list has.
    """

    listed: FrameList
    official: FrameList | None
    words: Mapping[str, FrameTable | None]
    in_contact: Mapping[str, set[int]]
    facts: dict[str, str]
    sensor: str
    problems: list[Problem]
    unused: list[Problem]


def _read_lists(root: Path, labels: Sequence[Path] | Path | None) -> _Lists:
    """Read the lists given, else ``label.txt``, else the official two, and what is next to them."""
    every, official_paths = root / "label.txt", [root / name for name in OFFICIAL.values()]
    if labels is not None:
        paths = [Path(labels)] if isinstance(labels, (str, Path)) else [Path(p) for p in labels]
    else:
        paths = [every] if every.is_file() else [p for p in official_paths if p.is_file()]
    if not paths:
        must = f"{root} must hold label.txt, or train.txt and test.txt"
        raise PalpateError(must, "none of them", "Put a list there", example={"labels": "list.txt"})
    table = root / "category_reference.txt"
    categories = read_categories(table) if table.is_file() else CATEGORIES
    categories = {k: name for k, name in categories.items() if k >= 0}
    listed = read_lists(paths, root=root, skip_bad=True, categories=categories)
    official: FrameList | None = listed
    if paths != official_paths:
        both = all(path.is_file() for path in official_paths)
        official = read_lists(official_paths, root=root, skip_bad=True) if both else None
    contacts = [listed, *([official] if official else [])]
    if every.is_file() and every not in paths:
        contacts.append(read_lists([every], root=root, skip_bad=True))
    in_contact: dict[str, set[int]] = {}
    for frames in contacts:
        for (video,), group in frames.contact.group_by("video"):
            in_contact.setdefault(str(video), set()).update(group["frame"].to_list())
    places = {"text": root / "captions.csv", "object": root / "objects.csv"}
    words = {c: read_frame_table(path) if path.is_file() else None for c, path in places.items()}
    facts = {**FACTS.of_manifest(), **world_facts(root), "format": "touch-and-go"}
    facts["text_source"] = "captions.csv" if words["text"] else "none"
    if categories != CATEGORIES:
        facts["classes"] = json.dumps({str(k): name for k, name in categories.items()})
    sensor = WORLD.sensor if "synthetic" in facts else FACTS.sensor
    tables = [listed, *words.values(), official if official is not listed else None]
    problems = [problem for table in tables if table for problem in table.skipped]
    unused: list[Problem] = []
    for column, table in words.items():
        strays = (
            [key for key in table.values if key[1] not in in_contact.get(key[0], ())]
            if table
            else []
        )
        if strays:
            text = (
                f"{len(strays)} lines are of no listed frame, first {'{}/{}'.format(*strays[0])!r}"
            )
            unused.append(Problem(str(places[column]), "no-sample", text))
    return _Lists(listed, official, words, in_contact, facts, sensor, problems, unused)
