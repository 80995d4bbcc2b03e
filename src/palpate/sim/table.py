"""A world's own manifest and split: everything the world knows of its contact frames, in palpate's vocabulary.

It has the ids, videos, touches and image paths that ``palpate import`` finds in the tree, and more: the object, the gel unit, and in every layout the
material and the text.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from palpate.core import Split
from palpate.data.formats.hct import sessions_of
from palpate.data.formats.touch_and_go import CATEGORIES
from palpate.data.manifest import Manifest
from palpate.sim.materials import MATERIALS
from palpate.sim.naming import (
    Row,
    contact_rows,
    image_paths,
    manifest_root,
    rig_of,
    sample_id,
    touch_id,
    video_id,
)
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import VideoPlan

#: Seconds between the starts of two recordings of one session in the layout of HCT, as an import takes it.
_SESSION_GAP = 60.0


def world_manifest(
    options: WorldOptions,
    plans: list[VideoPlan],
    captions: Mapping[str, Sequence[str]],
    folder: Path | None,
) -> Manifest:
    """The manifest of all contact frames, by video and frame.

    Args:
        options: the world's.
        plans: all videos.
        captions: video name -> one caption a touch.
        folder: the world's folder; the manifest is rooted there, in the layout of HCT at its ``hct``. None: there are no files.
    """
    sessions = (
        sessions_of([_folder(options, plan) for plan in plans], _SESSION_GAP)
        if options.layout == "hct"
        else {}
    )
    rows: list[dict[str, object]] = []
    for row in contact_rows(options, plans):
        plan = row.video
        rows.append(
            {
                "id": sample_id(options, plan, row.frame),
                "video": video_id(options, plan),
                "frame": row.frame,
                "contact": touch_id(options, plan, row.touch),
                "object": row.object,
                "session": sessions[_folder(options, plan)] if sessions else None,
                "material": plan.object_of(row.touch).material,
                "text": captions[plan.name][row.touch],
                **(image_paths(options, plan, row.touch, row.frame) if folder is not None else {}),
                "sensor": f"{options.look}-{plan.sensor}",
                "domain": rig_of(plan) if options.layout == "hct" else None,
            }
        )
    return Manifest.from_rows(rows, manifest_root(options, folder or Path()), _facts(options))


def _folder(options: WorldOptions, plan: VideoPlan) -> tuple[str, str]:
    rig, folder = video_id(options, plan).split("/", 1)
    return rig, folder


def _facts(options: WorldOptions) -> dict[str, str]:
    """What the data set is; it must never pass for a real one."""
    facts = {
        "dataset": "palpate's procedural world",
        "synthetic": "yes",
        "world_version": str(VERSION),
        "world_options": options.digest,
    }
    facts |= {"text_source": "the drawn sub-type", "layout": options.layout}
    if options.layout == "hct":
        return facts | {"format": "hct"}
    classes = {material.label: name for name, material in MATERIALS.items()}
    own = (
        {}
        if classes == CATEGORIES
        else {"classes": json.dumps({str(k): name for k, name in classes.items()})}
    )
    return facts | {"format": "touch-and-go", **own}


def world_split(
    options: WorldOptions, train: Sequence[Row], test: Sequence[Row], manifest: str | None
) -> Split:
    """``Orig``: the world's own cut, over the ids of its manifest (of that digest), in the order of the lists."""
    ids = {
        part: [sample_id(options, row.video, row.frame) for row in rows]
        for part, rows in (("train", train), ("test", test))
    }
    rule = {
        "method": "world",
        "leak": options.leak,
        "test": options.test,
        "seed": options.seed,
        "world_version": VERSION,
    }
    return Split.from_ids(rule=rule, manifest=manifest, **ids)
