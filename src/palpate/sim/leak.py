"""The train/test cut of a world, and exactly what it leaks.

``leak.csv`` is what an audit must find: a row for each test sample in the order of the manifest,
with 1 or 0 for a shared video, contact and object, the gap in frames, and the nearest train sample
of the same video.
"""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from palpate.core import require
from palpate.sim.layouts import Parts
from palpate.sim.options import WorldOptions
from palpate.sim.plan import Row, spread

#: Columns of ``leak.csv``, with the id first.
LEAK_COLUMNS = ("video_in_train", "contact_in_train", "object_in_train", "gap", "nearest")
_UNITS = {"frame": "contact frames", "contact": "contacts", "none": "videos"}


def _unit(options: WorldOptions, row: Row) -> tuple[int, ...]:
    """Return what goes to train or test as a whole: a frame, a contact or a video."""
    key = {"frame": (row.frame,), "contact": (row.contact,), "none": ()}
    return (row.video.index, *key[options.leak])


def cut(options: WorldOptions, rows: Sequence[Row]) -> Parts:
    """Cut rows into train and test, both shuffled; it leaks as ``options.leak`` says."""
    rng = options.rng("cut", "touch" if options.leak == "contact" else options.leak)
    material = {_unit(options, row): row.video.objects[0].material for row in rows}
    must = f"must have at least two {_UNITS[options.leak]} to cut: choose a larger world"
    require(len(material) >= 2, "leak", must, len(material))
    units = list(material)
    order = [units[k] for k in rng.permutation(len(units))]
    if options.leak == "none":  # material by material
        order.sort(key=lambda unit: options.names.index(material[unit]))
    # A share too small or too large for a whole unit still gives each list at least one.
    chosen = {order[k] for k in spread(len(order), options.test)} or {order[0]}
    if len(chosen) == len(order):
        chosen.discard(order[-1])
    parts: dict[str, list[Row]] = {"train": [], "test": []}
    for k in rng.permutation(len(rows)):
        parts["test" if _unit(options, rows[k]) in chosen else "train"].append(rows[k])
    return parts


def leak_table(parts: Parts) -> pl.DataFrame:
    """Return the exact leak of every test row, by video and frame.

    Returns:
        ``id``, ``LEAK_COLUMNS``, and the ``video``, ``contact`` and ``object`` of each row.
    """
    frames: dict[str, list[int]] = {}
    for row in parts["train"]:
        frames.setdefault(row.video.name, []).append(row.frame)
    contacts = {row.contact_id for row in parts["train"]}
    objects = {row.object for row in parts["train"]}
    cells: list[dict[str, object]] = []
    for row in sorted(parts["test"], key=lambda row: row.id):
        video, at = row.video, row.frame
        # Of two frames as near, the earlier.
        near = min(frames.get(video.name, ()), key=lambda f: (abs(f - at), f), default=None)
        cells.append(
            {
                "id": row.id,
                "video_in_train": int(near is not None),
                "contact_in_train": int(row.contact_id in contacts),
                "object_in_train": int(row.object in objects),
                "gap": None if near is None else abs(near - at),
                "nearest": None if near is None else video.sample_id(near),
                "video": video.name,
                "contact": row.contact_id,
                "object": row.object.name,
            }
        )
    return pl.DataFrame(cells, schema_overrides={"gap": pl.Int64, "nearest": pl.String})


def leak_counts(table: pl.DataFrame) -> dict[str, int | float | None]:
    """Count the test frames that share a video, contact or object with train, and the gaps."""
    level = ("video", "contact", "object")
    shared = {name: table.filter(pl.col(f"{name}_in_train") == 1)[name] for name in level}
    gap = table["gap"]
    return {
        "test_frames": len(table),
        "test_frames_in_shared_videos": len(shared["video"]),
        "test_frames_in_shared_contacts": len(shared["contact"]),
        "test_frames_of_shared_objects": len(shared["object"]),
        **{f"{name}s_shared": rows.n_unique() for name, rows in shared.items()},
        "gap_min": gap.min(),
        "gap_median": gap.median(),
        "gap_max": gap.max(),
    }  # pyright: ignore[reportReturnType]
