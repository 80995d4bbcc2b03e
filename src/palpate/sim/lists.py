"""The lists of a world in the layout of Touch and Go, its train/test cut, and what that cut leaks.

- ``label.txt``, ``train.txt``, ``test.txt``: ``20260101_000000/0000000012.jpg,3``; the latter two shuffled and, like the official lists,
  without a newline at the end.
- ``category_reference.txt``: ``Name: id``.
- ``objects.csv`` (``frame,object``) and ``captions.csv`` (``frame,text``): one row a contact frame, in the order of ``label.txt``.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from palpate.core import PalpateError
from palpate.sim.materials import MATERIALS
from palpate.sim.options import WorldOptions
from palpate.sim.plan import VideoPlan, contact_frames


@dataclass(frozen=True)
class Row:
    """A contact frame: its video, the touch within it, its number, label and object."""

    video: VideoPlan
    touch: int
    frame: int

    @property
    def path(self) -> str:
        """As in the lists: ``video/0000000012.jpg``."""
        return f"{self.video.name}/{self.frame:010d}.jpg"

    @property
    def line(self) -> str:
        """``path,label``."""
        return f"{self.path},{MATERIALS[self.video.object_of(self.touch).material].label}"


def contact_rows(options: WorldOptions, plans: Sequence[VideoPlan]) -> list[Row]:
    """Every contact frame, by video and frame."""
    touches = range(options.touches_per_video)
    return [Row(plan, touch, frame) for plan in plans for touch in touches for frame in contact_frames(options, touch)]


def cut(options: WorldOptions, plans: Sequence[VideoPlan], rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """Train and test rows, both shuffled: the world's own split, which leaks as ``options.leak`` tells.

    Raises:
        PalpateError: if there are fewer than two units (frames, touches, videos) to cut.
    """
    rng = options.rng("cut", options.leak)
    unit_of = {
        "frame": lambda row: (row.video.index, row.frame),
        "touch": lambda row: (row.video.index, row.touch),
        "none": lambda row: (row.video.index,),
    }[options.leak]
    units = list(dict.fromkeys(unit_of(row) for row in rows))
    if len(units) < 2:
        what = {"frame": "contact frames", "touch": "touches", "none": "videos"}[options.leak]
        raise PalpateError(f"leak={options.leak!r} needs at least two {what}", f"{len(units)}", "Ask for a larger world")
    order = [units[k] for k in rng.permutation(len(units))]
    if options.leak == "none":  # by video, material by material
        main = {(plan.index,): options.names.index(plan.objects[0].material) for plan in plans}
        order.sort(key=lambda unit: main[unit])
    # Error diffusion: unit k goes to test where the running share passes a whole number, so that every stretch has its share.
    chosen = {u for k, u in enumerate(order) if int((k + 1) * options.test + 0.5) > int(k * options.test + 0.5)}
    if not chosen or len(chosen) == len(order):
        chosen = {order[0]}
    shuffled = [rows[k] for k in rng.permutation(len(rows))]
    return [r for r in shuffled if unit_of(r) not in chosen], [r for r in shuffled if unit_of(r) in chosen]


def leak_of(train: Sequence[Row], test: Sequence[Row]) -> dict[str, int | float]:
    """What the cut leaks, counted: videos, touches and objects on both sides, and the test frames whose video is in train."""
    sides = [
        ({r.video.name for r in rows}, {(r.video.name, r.touch) for r in rows}, {r.video.object_of(r.touch) for r in rows})
        for rows in (train, test)
    ]
    shared = sides[0][0] & sides[1][0]
    leaked = sum(row.video.name in shared for row in test)
    return {
        "test_frames": len(test),
        "test_frames_in_shared_videos": leaked,
        "leaked_fraction": leaked / len(test),
        "videos_shared": len(shared),
        "touches_shared": len(sides[0][1] & sides[1][1]),
        "objects_shared": len(sides[0][2] & sides[1][2]),
    }


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """CSV text; lines end with a line feed alone."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def list_files(
    options: WorldOptions, plans: Sequence[VideoPlan], captions: dict[str, list[str]]
) -> tuple[dict[str, str], dict[str, int | float]]:
    """All list files by name, and the leak of the cut.

    Args:
        options: the world's.
        plans: all videos.
        captions: video name -> one caption a touch.
    """
    rows = contact_rows(options, plans)
    train, test = cut(options, plans, rows)
    files = {
        "label.txt": "".join(f"{row.line}\n" for row in rows),
        "category_reference.txt": "".join(f"{name}: {material.label}\n" for name, material in MATERIALS.items()),
        "train.txt": "\n".join(row.line for row in train),
        "test.txt": "\n".join(row.line for row in test),
        "objects.csv": table(("frame", "object"), ((row.path, row.video.object_of(row.touch).name) for row in rows)),
        "captions.csv": table(("frame", "text"), ((row.path, captions[row.video.name][row.touch]) for row in rows)),
    }
    return files, leak_of(train, test)
