"""The train/test cut of a world, what it leaks, and the lists in the layout of Touch and Go.

- ``label.txt``, ``train.txt``, ``test.txt``: ``20260101_000000/0000000012.jpg,3``; the latter two shuffled and, like the official lists,
  without a newline at the end.
- ``category_reference.txt``: ``Name: id``.
- ``objects.csv`` (``frame,object``) and ``captions.csv`` (``frame,text``): one row a contact frame, in the order of ``label.txt``.
- ``leak.csv``, in every layout: what an audit must find, one row a test sample in the order of the manifest.
"""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from palpate.core import PalpateError
from palpate.sim.materials import MATERIALS
from palpate.sim.naming import Row, sample_id
from palpate.sim.options import WorldOptions
from palpate.sim.plan import VideoPlan

LEAK_COLUMNS = ("id", "video_in_train", "touch_in_train", "object_in_train", "gap", "nearest")


def cut(
    options: WorldOptions, plans: Sequence[VideoPlan], rows: Sequence[Row]
) -> tuple[list[Row], list[Row]]:
    """Train and test rows, both shuffled: the world's own split, which leaks as ``options.leak`` tells.

    Raises:
        PalpateError: if there are fewer than two units (frames, touches, videos) to cut.
    """
    rng = options.rng("cut", options.leak)
    unit_of = {
        "frame": lambda row: (row.video.index, row.frame),
        "contact": lambda row: (row.video.index, row.touch),
        "none": lambda row: (row.video.index,),
    }[options.leak]
    units = list(dict.fromkeys(unit_of(row) for row in rows))
    if len(units) < 2:
        what = {"frame": "contact frames", "contact": "touches", "none": "videos"}[options.leak]
        raise PalpateError(
            f"leak={options.leak!r} needs at least two {what}",
            f"{len(units)}",
            "Ask for a larger world",
        )
    order = [units[k] for k in rng.permutation(len(units))]
    if options.leak == "none":  # by video, material by material
        main = {(plan.index,): options.names.index(plan.objects[0].material) for plan in plans}
        order.sort(key=lambda unit: main[unit])
    # Error diffusion: unit k goes to test where the running share passes a whole number, so that every stretch has its share.
    chosen = {
        u
        for k, u in enumerate(order)
        if int((k + 1) * options.test + 0.5) > int(k * options.test + 0.5)
    }
    if not chosen:  # the share is too small for one unit, or too large to leave one: both lists have one at least
        chosen = {order[0]}
    elif len(chosen) == len(order):
        chosen.discard(order[-1])
    shuffled = [rows[k] for k in rng.permutation(len(rows))]
    return [r for r in shuffled if unit_of(r) not in chosen], [
        r for r in shuffled if unit_of(r) in chosen
    ]


@dataclass(frozen=True)
class Leaked:
    """What a test row shares with train.

    Attributes:
        row: the test row.
        video, touch, object: whether train has frames of the same.
        gap: frames to the nearest train frame of the same video, None if train has none.
        nearest: that frame (of two equally near, the earlier), or None.
    """

    row: Row
    video: bool
    touch: bool
    object: bool
    gap: int | None
    nearest: int | None


def leaks(train: Sequence[Row], test: Sequence[Row]) -> list[Leaked]:
    """The exact leak of every test row, in the order of video and frame."""
    frames: dict[int, list[int]] = {}
    for row in train:
        frames.setdefault(row.video.index, []).append(row.frame)
    touches = {(row.video.index, row.touch) for row in train}
    objects = {row.object for row in train}
    found: list[Leaked] = []
    for row in sorted(test, key=lambda row: (row.video.index, row.frame)):
        near = min(
            frames.get(row.video.index, ()),
            key=lambda frame: (abs(frame - row.frame), frame),
            default=None,
        )
        gap = None if near is None else abs(near - row.frame)
        found.append(
            Leaked(
                row,
                near is not None,
                (row.video.index, row.touch) in touches,
                row.object in objects,
                gap,
                near,
            )
        )
    return found


def leak_counts(train: Sequence[Row], test: Sequence[Row]) -> dict[str, int | float | None]:
    """What the cut leaks, counted: test frames that share a video, touch or object with train, how many of those are shared, and the gaps."""
    every = leaks(train, test)
    gaps = [leak.gap for leak in every if leak.gap is not None]
    return {
        "test_frames": len(test),
        "test_frames_in_shared_videos": len(gaps),
        "test_frames_in_shared_touches": sum(leak.touch for leak in every),
        "test_frames_of_shared_objects": sum(leak.object for leak in every),
        "leaked_fraction": len(gaps) / len(test),
        "videos_shared": len({leak.row.video.index for leak in every if leak.video}),
        "touches_shared": len(
            {(leak.row.video.index, leak.row.touch) for leak in every if leak.touch}
        ),
        "objects_shared": len({leak.row.object for leak in every if leak.object}),
        "gap_min": min(gaps, default=None),
        "gap_median": statistics.median(gaps) if gaps else None,
        "gap_max": max(gaps, default=None),
    }


def leak_file(options: WorldOptions, train: Sequence[Row], test: Sequence[Row]) -> str:
    """``leak.csv``: for each test sample 1 or 0 for shared video, touch and object, the gap in frames and the nearest train sample."""
    rows: list[tuple[str, ...]] = []
    for leak in leaks(train, test):
        near = "" if leak.nearest is None else sample_id(options, leak.row.video, leak.nearest)
        flags = (str(int(flag)) for flag in (leak.video, leak.touch, leak.object))
        rows.append(
            (
                sample_id(options, leak.row.video, leak.row.frame),
                *flags,
                "" if leak.gap is None else str(leak.gap),
                near,
            )
        )
    return table(LEAK_COLUMNS, rows)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """CSV text; lines end with a line feed alone."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def list_files(
    rows: Sequence[Row],
    train: Sequence[Row],
    test: Sequence[Row],
    captions: Mapping[str, Sequence[str]],
) -> dict[str, str]:
    """Touch and Go's lists by file name.

    Args:
        rows: all contact frames.
        train: those for training, in the order of the list.
        test: the others.
        captions: video name -> one caption a touch.
    """
    path = lambda row: f"{row.video.name}/{row.frame:010d}.jpg"  # noqa: E731
    line = lambda row: f"{path(row)},{MATERIALS[row.video.object_of(row.touch).material].label}"  # noqa: E731
    return {
        "label.txt": "".join(f"{line(row)}\n" for row in rows),
        "category_reference.txt": "".join(
            f"{name}: {material.label}\n" for name, material in MATERIALS.items()
        ),
        "train.txt": "\n".join(map(line, train)),
        "test.txt": "\n".join(map(line, test)),
        "objects.csv": table(("frame", "object"), ((path(row), row.object) for row in rows)),
        "captions.csv": table(
            ("frame", "text"), ((path(row), captions[row.video.name][row.touch]) for row in rows)
        ),
    }
