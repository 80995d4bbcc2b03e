"""Touch and Go (Yang, Ma, Zhang, Zhu, Yuan, Owens; NeurIPS 2022): 640x480 video of a scene and of a GelSight in step.

::

    root/
      label.txt                  video/0000000033.jpg,15     every labeled in-contact frame
      category_reference.txt     Rock: 15
      train.txt  test.txt        the official split, lines as in label.txt (optional)
      captions.csv  objects.csv  frame,text and frame,object, by the user (optional)
      dataset/<video>/video.mp4        gelsight.mp4          raw, or
      dataset/<video>/video_frame/     gelsight_frame/       extracted, 0000000000.jpg ...

The videos may also lie under ``final_dataset/`` or in the root itself. A frame's number is its position in both videos,
so it is valid up to the shorter one. The background of a touch is the gel 4 frames before the touch begins; if the
sensor is in contact there, the nearest earlier frame where it is not; if there is none, of up to 15 frames
outside all touches the one nearest to their median; else null.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from palpate.core import PalpateError, Problem, Progress, Split, quiet
from palpate.data.formats.base import WORLD, Facts, Scan, world_facts
from palpate.data.frames import IMAGE_FORMATS, ImageFormat
from palpate.data.images import Check
from palpate.data.imported import Imported, raise_if, removing_on_error, require_some
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
from palpate.data.recordings import Recordings, Row, VideoFiles, first_frames, rows_of, thin

FACTS = Facts(
    "Touch and Go",
    "F. Yang, C. Ma, J. Zhang, J. Zhu, W. Yuan, A. Owens: Touch and Go: Learning from Human-Collected Vision and Touch. "
    "NeurIPS Datasets and Benchmarks, 2022",
    "CC BY 4.0",
    "https://touch-and-go.github.io",
    "GelSight'17",
    (640, 480),
    "121,861 frames of 126 videos in the official lists; label.txt names about twice as many",
    "video",
    {"touch, 50 images (T3)": ((0.51808, 0.50300, 0.51457), (0.13893, 0.11343, 0.13497))},
)
CATEGORIES: dict[int, str] = dict(
    enumerate(
        (
            "Concrete",
            "Plastic",
            "Glass",
            "Wood",
            "Metal",
            "Brick",
            "Tile",
            "Leather",
            "Synthetic Fabric",
            "Natural Fabric",
            "Rubber",
            "Paper",
            "Tree",
            "Grass",
            "Soil",
            "Rock",
            "Gravel",
            "Sand",
            "Plants",
            "Others",
        )
    )
)
#: Part of the official split -> its list.
OFFICIAL = {"train": "train.txt", "test": "test.txt"}
PLACES = ("dataset", "final_dataset", ".")
SIDES = {"vision": ("video_frame", "video.mp4"), "tactile": ("gelsight_frame", "gelsight.mp4")}
LOOKED_FOR = "label.txt (or train.txt, test.txt), and videos under dataset/, final_dataset/ or the folder itself"


def detect(source: Path) -> bool:
    """Whether a folder looks like Touch and Go: a list and a recording."""
    return (
        source.is_dir()
        and any((source / n).is_file() for n in ("label.txt", "train.txt", "test.txt"))
        and bool(find_videos(source))
    )


def find_videos(root: Path) -> dict[str, VideoFiles]:
    """Recordings by name, under ``dataset/``, ``final_dataset/`` or the root; extracted frames go before the raw video."""
    found: dict[str, VideoFiles] = {}
    for place in PLACES:
        base = Path(root) / place
        for folder in sorted(base.iterdir()) if base.is_dir() else []:
            if folder.name in found or not folder.is_dir():
                continue
            sides = {
                side: folder / frames
                if (folder / frames).is_dir()
                else folder / video
                if (folder / video).is_file()
                else None
                for side, (frames, video) in SIDES.items()
            }
            if any(sides.values()):
                found[folder.name] = VideoFiles(folder.name, sides["vision"], sides["tactile"])
    return found


def import_touch_and_go(
    root: Path,
    out: Path,
    *,
    labels: Sequence[Path] | Path | None = None,
    skip_bad: bool = False,
    image_format: ImageFormat = "jpg",
    size: int | None = None,
    check: Check = "decode",
    max_per_contact: int | None = None,
    seed: int = 0,
    progress: Progress = quiet,
) -> Imported:
    """Reads Touch and Go and writes ``out/manifest.parquet``, ``out/splits/Orig.json`` and the frames of raw videos.

    Args:
        root: the data set.
        out: folder to write to. Frames of raw videos go to ``out/images/<video>/{vision,tactile}/``; extracted frames
            stay where they are. If an import is interrupted, the same call goes on where it stopped.
        labels: frame lists; default ``label.txt``, else ``train.txt`` and ``test.txt``, at the root.
        skip_bad: leave bad rows out and list them, instead of raising.
        image_format: of the cached frames.
        size: shorter side of the cached frames in pixels, if they are larger; None keeps them.
        check: how extracted images are checked.
        max_per_contact: take that many evenly spaced frames of a contact.
        seed: with ``max_per_contact``: 0 takes the middle of each of the equal stretches, any other a random place in them.
        progress: told what is being done.

    Returns:
        The manifest, sorted by video and frame. Its root is the data set's if all recordings are extracted; if some are raw it is
        ``out``, and used frames of the others are linked (or copied) there.

    Raises:
        PalpateError: if the root, the list or the recordings are missing, or ``out`` holds frames of other settings.
        ProblemsError: with everything bad in the whole data set; nothing is left behind.
    """
    root, out = Path(root), Path(out)
    if max_per_contact is not None and max_per_contact < 1:
        raise PalpateError(
            "max_per_contact must be at least 1",
            str(max_per_contact),
            "Leave it out to take every frame",
        )
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
    videos = _require_videos(root)
    table = root / "category_reference.txt"
    categories = {
        k: v
        for k, v in (read_categories(table) if table.is_file() else CATEGORIES).items()
        if k >= 0
    }
    lists = _require_lists(root, labels)
    listed = read_lists(lists, root=root, skip_bad=True, categories=categories)
    official = listed if lists == [root / name for name in OFFICIAL.values()] else _official(root)
    texts, objects = _optional(root / "captions.csv"), _optional(root / "objects.csv")
    rows = rows_of(listed)
    with removing_on_error(out) as created:
        work = Recordings(
            root, out, videos, _contacts(root, listed, official), image_format, size, created
        )
        work.problems += [
            p
            for part in (listed, None if official is listed else official, texts, objects)
            if part
            for p in part.skipped
        ]
        starts = first_frames(rows)
        rows = work.open(thin(rows, max_per_contact, seed), progress)
        work.choose_backgrounds(rows, starts)
        rows = work.check(rows, check, progress)
        _look(work, rows, listed)
        raise_if(work.problems, skip_bad)
        require_some(len(rows), root, work.problems)
        rows = work.extract(rows, progress)
        raise_if(work.problems, skip_bad)
        require_some(len(rows), root, work.problems)
        facts = _facts(root, categories) | {"text_source": "captions.csv" if texts else "none"}
        manifest = work.manifest(
            rows,
            facts,
            WORLD.sensor if "synthetic" in facts else FACTS.sensor,
            {"text": texts, "object": objects},
        )
        found = Imported(
            manifest,
            work.problems,
            _splits(manifest, official),
            listed.inconclusive,
            work.suspicious,
        )
        return found.save(out, created)


def scan(
    root: Path,
    *,
    labels: Sequence[Path] | Path | None = None,
    check: Check = "decode",
    progress: Progress = quiet,
) -> Scan:
    """Looks a data set over without writing anything: lists, recordings, frames and pictures.

    With ``check="decode"`` the frames in use are decoded as an import would, those of raw videos too. Rows carry no paths, as frames of raw videos have none yet.

    Raises:
        PalpateError: if the root, the list or the recordings are missing.
    """
    root = Path(root)
    videos = _require_videos(root)
    lists = _require_lists(root, labels)
    table = root / "category_reference.txt"
    categories = {
        k: v
        for k, v in (read_categories(table) if table.is_file() else CATEGORIES).items()
        if k >= 0
    }
    listed = read_lists(lists, root=root, skip_bad=True, categories=categories)
    official = listed if lists == [root / name for name in OFFICIAL.values()] else _official(root)
    rows = rows_of(listed)
    work = Recordings(root, root, videos, _contacts(root, listed, official), "jpg", None, [])
    work.problems += listed.skipped + (
        official.skipped if official and official is not listed else []
    )
    starts = first_frames(rows)
    rows = work.open(rows, progress)
    work.choose_backgrounds(rows, starts)
    rows = work.check(rows, check, progress)
    _look(work, rows, listed)
    rows = work.decode(rows, progress) if check == "decode" else rows
    found = [
        (
            r.where,
            {
                "id": r.id,
                "video": r.video,
                "frame": r.frame,
                "contact": r.contact,
                "material": r.material,
            },
        )
        for r in rows
    ]
    return Scan(
        found,
        root,
        work.problems,
        work.suspicious,
        _facts(root, categories),
        inconclusive=listed.inconclusive,
    )


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Writes ``<part>.txt`` with a ``video/0000000033.jpg,3`` line a sample, as the official lists are.

    The classes are those of the manifest's fact ``classes``, which an import with another table than the published one writes, else
    the published ones. A material that is none of them keeps its number if it is one (bare lists without a category table).

    Raises:
        PalpateError: if a sample has no video or frame, or a material that is no class.
    """
    classes: dict[str, str] = (
        json.loads(manifest.facts["classes"]) if "classes" in manifest.facts else {}
    )
    ids = {name: int(k) for k, name in (classes or CATEGORIES).items()}
    files: list[Path] = []
    for part in split.counts():
        rows: list[tuple[str, int]] = []
        for row in (
            manifest.part(split, part)
            .table.select("id", "video", "frame", "material")
            .iter_rows(named=True)
        ):
            name = row["material"]
            label = (
                INCONCLUSIVE
                if name is None
                else ids.get(name, int(name) if str(name).isdecimal() else None)
            )
            if row["video"] is None or row["frame"] is None or label is None:
                got = f"{row['id']!r} with video {row['video']!r}, frame {row['frame']!r} and material {name!r}"
                raise PalpateError(
                    "A frame list needs the video, frame and class of every sample",
                    got,
                    "Write the split file alone",
                )
            rows.append((f"{row['video']}/{row['frame']:010d}.jpg", label))
        files.append(Path(folder) / f"{part}.txt")
        write_list(files[-1], rows)
    return files


def _look(work: Recordings, rows: Sequence[Row], listed: FrameList) -> None:
    """Tells recordings in no list, and touches without a picture of the gel."""
    unlisted = sorted(set(work.videos) - set(listed.contact["video"]))
    work.suspicious += [
        Problem(str(work.root), "unlisted-video", f"the recording {name!r} is in no list")
        for name in unlisted
    ]
    bare = sorted({r.contact for r in rows} - set(work.background_frames) - set(work.typical_of))
    work.suspicious += [
        Problem(touch, "no-background", "no frame of its recording shows the gel untouched")
        for touch in bare
    ]


def _facts(root: Path, categories: Mapping[int, str]) -> dict[str, str]:
    """Name and license of the data, and its classes if they are not the published ones.

    Palpate's own world comes in this layout, and must never pass for the real set.
    """
    classes = (
        {}
        if categories == CATEGORIES
        else {"classes": json.dumps({str(k): name for k, name in categories.items()})}
    )
    return {**FACTS.of_manifest(), **world_facts(root), "format": "touch-and-go", **classes}


def _require_videos(root: Path) -> dict[str, VideoFiles]:
    if not root.is_dir():
        raise PalpateError(
            "The data set's folder must exist", f"no folder {root}", "Check the path"
        )
    videos = find_videos(root)
    if not videos:
        raise PalpateError(
            f"{root} must hold recordings: folders with video.mp4 and gelsight.mp4, or video_frame/ and gelsight_frame/",
            "none under " + ", ".join("the folder itself" if p == "." else f"{p}/" for p in PLACES),
            f"Download the videos from {FACTS.url}",
        )
    return videos


def _require_lists(root: Path, labels: Sequence[Path] | Path | None) -> list[Path]:
    """The lists to read: those given, else ``label.txt``, else the official two."""
    if labels is not None:
        return [Path(labels)] if isinstance(labels, (str, Path)) else [Path(p) for p in labels]
    if (root / "label.txt").is_file():
        return [root / "label.txt"]
    lists = [root / name for name in OFFICIAL.values() if (root / name).is_file()]
    if not lists:
        raise PalpateError(
            f"{root} must hold label.txt, or train.txt and test.txt",
            "none of them",
            "Put a list there, or name it: --labels FILE",
        )
    return lists


def _official(root: Path) -> FrameList | None:
    """The official lists, joined, if both lie at the root; labels do not matter here."""
    paths = [root / name for name in OFFICIAL.values()]
    return read_lists(paths, root=root, skip_bad=True) if all(p.is_file() for p in paths) else None


def _optional(path: Path) -> FrameTable | None:
    return read_frame_table(path) if path.is_file() else None


def _contacts(root: Path, listed: FrameList, official: FrameList | None) -> dict[str, set[int]]:
    """By recording, the frames that any list at hand calls a touch."""
    lists = [listed, *([official] if official else [])]
    known = set(listed.rows["source"].unique())
    if (every := root / "label.txt").is_file() and str(every) not in known:
        lists.append(read_lists([every], root=root, skip_bad=True))
    found: dict[str, set[int]] = {}
    for part in lists:
        for (video,), group in part.contact.group_by("video"):
            found.setdefault(str(video), set()).update(group["frame"].to_list())
    return found


def _splits(manifest: Manifest, official: FrameList | None) -> dict[str, Split]:
    """``Orig``: the official parts of the samples at hand, matched by recording and frame number."""
    if official is None:
        return {}
    part_of = {name: part for part, name in OFFICIAL.items()}
    parts = {
        (r["video"], r["frame"]): part_of[Path(r["source"]).name]
        for r in official.rows.iter_rows(named=True)
    }
    table = manifest.table.select("id", "video", "frame").iter_rows()
    found = {i: parts[video, frame] for i, video, frame in table if (video, frame) in parts}
    rule = {"method": "official", "files": list(OFFICIAL.values())}
    return {"Orig": Split(found, rule, manifest.digest)} if found else {}
