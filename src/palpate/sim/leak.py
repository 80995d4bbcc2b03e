"""The train/test cut of a world, and exactly what it leaks.

``leak.csv`` is what an audit must find: a row for each test sample in the order of the manifest,
with 1 or 0 for a shared video, contact and object, the gap in frames, and the nearest train sample
of the same video.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from palpate.core import require
from palpate.data.tables import csv_text
from palpate.sim.layouts import Parts, sample_id
from palpate.sim.options import WorldOptions
from palpate.sim.plan import Row, VideoPlan, spread

LEAK_COLUMNS = ("id", "video_in_train", "contact_in_train", "object_in_train", "gap", "nearest")
_UNITS = {"frame": "contact frames", "contact": "contacts", "none": "videos"}


def _unit(options: WorldOptions, row: Row) -> tuple[int, ...]:
    """Return what goes to train or test as a whole: a frame, a contact or a video."""
    key = {"frame": (row.frame,), "contact": (row.contact,), "none": ()}
    return (row.video.index, *key[options.leak])


def cut(options: WorldOptions, plans: Sequence[VideoPlan], rows: Sequence[Row]) -> Parts:
    """Cut rows into train and test, both shuffled; it leaks as ``options.leak`` says."""
    rng = options.rng("cut", "touch" if options.leak == "contact" else options.leak)
    units = list(dict.fromkeys(_unit(options, row) for row in rows))
    must = f"must have at least two {_UNITS[options.leak]} to cut: choose a larger world"
    require(len(units) >= 2, "leak", must, len(units))
    order = [units[k] for k in rng.permutation(len(units))]
    if options.leak == "none":  # material by material
        materials = [options.names.index(plan.objects[0].material) for plan in plans]
        order.sort(key=lambda unit: materials[unit[0]])
    # A share too small or too large for a whole unit still gives each list at least one.
    chosen = {order[k] for k in spread(len(order), options.test)} or {order[0]}
    if len(chosen) == len(order):
        chosen.discard(order[-1])
    shuffled = [rows[k] for k in rng.permutation(len(rows))]
    train = [row for row in shuffled if _unit(options, row) not in chosen]
    return {"train": train, "test": [row for row in shuffled if _unit(options, row) in chosen]}


@dataclass(frozen=True)
class Leak:
    """What a test row shares with train."""

    row: Row
    contact: bool  # whether train has frames of the same contact
    object: bool  # whether train has frames of the same object
    nearest: int | None  # nearest train frame of the same video (of two, the earlier)

    @property
    def gap(self) -> int | None:
        """Frames to the nearest train frame."""
        return None if self.nearest is None else abs(self.nearest - self.row.frame)


def leaks(parts: Parts) -> list[Leak]:
    """Return the exact leak of every test row, by video and frame."""
    frames: dict[int, list[int]] = {}
    for row in parts["train"]:
        frames.setdefault(row.video.index, []).append(row.frame)
    contacts = {(row.video.index, row.contact) for row in parts["train"]}
    objects = {row.object for row in parts["train"]}
    result: list[Leak] = []
    for row in sorted(parts["test"], key=lambda row: (row.video.index, row.frame)):
        video, at = row.video.index, row.frame
        nearest = min(frames.get(video, ()), key=lambda f: (abs(f - at), f), default=None)
        result.append(Leak(row, (video, row.contact) in contacts, row.object in objects, nearest))
    return result


def leak_counts(parts: Parts) -> dict[str, int | float | None]:
    """Count the test frames that share a video, contact or object with train, and the gaps."""
    rows = leaks(parts)
    gaps = [leak.gap for leak in rows if leak.gap is not None]
    in_contacts = [(leak.row.video.index, leak.row.contact) for leak in rows if leak.contact]
    in_objects = [leak.row.object for leak in rows if leak.object]
    return {
        "test_frames": len(parts["test"]),
        "test_frames_in_shared_videos": len(gaps),
        "test_frames_in_shared_contacts": len(in_contacts),
        "test_frames_of_shared_objects": len(in_objects),
        "videos_shared": len({leak.row.video.index for leak in rows if leak.nearest is not None}),
        "contacts_shared": len(set(in_contacts)),
        "objects_shared": len(set(in_objects)),
        "gap_min": min(gaps, default=None),
        "gap_median": statistics.median(gaps) if gaps else None,
        "gap_max": max(gaps, default=None),
    }


def leak_file(parts: Parts) -> str:
    """Return the text of ``leak.csv``."""
    rows: list[tuple[object, ...]] = []
    for leak in leaks(parts):
        video, at = leak.row.video, leak.nearest
        gap, nearest = ("", "") if at is None else (leak.gap, sample_id(video, at))
        flags = (int(at is not None), int(leak.contact), int(leak.object))
        rows.append((sample_id(video, leak.row.frame), *flags, gap, nearest))
    return csv_text(LEAK_COLUMNS, rows)
