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
is not; else null.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from palpate.core import PalpateError, Progress, Split, quiet, write_text
from palpate.data.formats.layout import has_listed_videos, require_folder, require_videos
from palpate.data.formats.recordings import Recordings, Row, thin
from palpate.data.images import Check
from palpate.data.listing import FrameList, categories_in, read_frame_table, read_lists, write_list
from palpate.data.manifest import Manifest
from palpate.data.scanning import WORLD, Facts, Format, Into, Scan, world_facts
from palpate.data.tables import INCONCLUSIVE

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
#: Manifest column -> (video, frame) -> its words.
Words = Mapping[str, Mapping[tuple[str, int], str]]
#: Part of the official split -> its list.
OFFICIAL = {"train": "train.txt", "test": "test.txt"}


def scan(
    root: Path,
    *,
    labels: Sequence[Path] | Path | None = None,
    size: int | None = None,
    max_per_contact: int | None = None,
    check: Check = "decode",
    into: Into | None = None,
    progress: Progress = quiet,
) -> Scan:
    """Read lists, recordings, frames and images.

    Without ``into`` nothing is written: with ``check="decode"`` the frames in use are decoded as an
    import would, those of raw videos too; rows carry paths of extracted frames only if ``check`` is
    ``none``.

    Options:
        labels: frame lists; default ``label.txt``, else ``train.txt`` and ``test.txt``.
        size: shorter side of the cached frames in pixels, if they are larger; None keeps them.
        max_per_contact: import that many evenly spaced frames of a contact.
    """
    root = require_folder(root, FACTS.name)
    result, videos = Scan(root, world_facts(root)), require_videos(root)
    sensor = WORLD.sensor if "synthetic" in result.facts else FACTS.sensor
    listed, official, words, in_contact = _read_lists(result, labels)
    work = Recordings(result, into, videos, in_contact, size)
    every = _rows(listed, words, sensor)
    rows = work.open(thin(every, max_per_contact) if into else every, progress)
    rows = [row for row in rows if work.has(row)]
    starts = {row.contact: (row.video, row.frame) for row in reversed(every)}
    work.add(rows, starts, check=check, progress=progress)
    if official is not None:
        part_of = {name: part for part, name in OFFICIAL.items()}
        cells = official.rows.select("video", "frame", "source").iter_rows()
        parts = {(video, frame): part_of[Path(source).name] for video, frame, source in cells}
        for _, row in result.rows:
            row["split"] = parts.get((row["video"], row["frame"]))
        result.split_rule = {"files": list(OFFICIAL.values())}
    return result


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Write ``<part>.txt`` with a ``video/0000000033.jpg,3`` line a sample, as the official lists.

    The classes are those of the manifest's fact ``classes``, which an import with another table
    than the published one writes, else the published ones. A material that is none of them keeps
    its number if it is one (bare lists without a category table), else it gets the next one, and
    ``category_reference.txt`` says which.
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
        files.append(folder / f"{part}.txt")
        write_list(files[-1], rows)
    if more:
        files.append(folder / "category_reference.txt")
        write_text(files[-1], table)
    return files


FORMAT = Format(FACTS, has_listed_videos, LOOKS_FOR, scan, write_lists)


def _rows(listed: FrameList, words: Words, sensor: str) -> list[Row]:
    """The rows of a list, sorted by video and frame."""
    columns = ("contact", "material")
    table = pl.concat([listed.rows, listed.manifest.table.select(columns)], how="horizontal")
    where = pl.format("{}:{}", "source", "line")
    table = table.sort("video", "frame").select(where, "id", "video", "frame", *columns)
    rows: list[Row] = []
    for line, name, video, frame, contact, material in table.iter_rows():
        more = {column: of.get((video, frame)) for column, of in words.items()}
        more |= {"material": material, "sensor": sensor}
        rows.append(Row(line, name, video, frame, contact, more))
    return rows


def _read_lists(
    result: Scan, labels: Sequence[Path] | Path | None
) -> tuple[FrameList, FrameList | None, Words, dict[str, set[int]]]:
    """Read the lists given, else ``label.txt``, else the official two, and what is next to them.

    Returns:
        The samples; the official lists joined, if both are there; manifest column -> its words by
        frame; recording -> the frames that any list calls a contact.
    """
    root = result.base
    every, official_paths = root / "label.txt", [root / name for name in OFFICIAL.values()]
    if labels is not None:
        paths = [Path(labels)] if isinstance(labels, (str, Path)) else [Path(p) for p in labels]
    else:
        paths = [every] if every.is_file() else [p for p in official_paths if p.is_file()]
    if not paths:
        must = f"{root} must hold label.txt, or train.txt and test.txt"
        raise PalpateError(must, "none of them", "Put a list there", example={"labels": "list.txt"})
    categories = {k: name for k, name in (categories_in(root) or CATEGORIES).items() if k >= 0}
    read = lambda paths, **more: read_lists(paths, root=root, skip_bad=True, **more)
    listed = read(paths, categories=categories)
    official: FrameList | None = listed
    if paths != official_paths:
        official = read(official_paths) if all(path.is_file() for path in official_paths) else None
    more = [read([every])] if every.is_file() and every not in paths else []
    in_contact: dict[str, set[int]] = {}
    for frames in (listed, *([official] if official else []), *more):
        for (video,), group in frames.contact.group_by("video"):
            in_contact.setdefault(str(video), set()).update(group["frame"].to_list())
    places = {"text": root / "captions.csv", "object": root / "objects.csv"}
    result.problems = [*listed.skipped]
    words = {
        c: read_frame_table(path, result.problems) for c, path in places.items() if path.is_file()
    }
    if official and official is not listed:
        result.problems += official.skipped
    for column, keys in words.items():
        if strays := [(v, k) for v, k in keys if k not in in_contact.get(v, ())]:
            first = "/".join(map(str, strays[0]))
            text = f"{len(strays)} lines are of no listed frame, first {first!r}"
            result.suspect(places[column], "no-sample", text)
    result.inconclusive = listed.inconclusive
    result.facts |= {"text_source": "captions.csv" if "text" in words else "none"}
    if categories != CATEGORIES:
        result.facts["classes"] = json.dumps({str(k): name for k, name in categories.items()})
    return listed, official, words, in_contact
