"""Worlds with a name, their cost, and the seeds that are reserved for the shipped models."""

from __future__ import annotations

from dataclasses import replace

from palpate.sim.options import WorldOptions

#: Seeds of the worlds that the shipped mini models were trained on. No preset, test or benchmark of
#: a score uses one: a model would be scored on its training data.
MINI_SEEDS = range(900_000, 900_100)
#: The warning on a world of such a seed.
SEEN_WARNING = (
    "Shipped mini models may have been trained on this world: their scores on it mean nothing."
)

_SMALL = WorldOptions(
    objects_per_material=20, two_videos=0.25, frames_per_contact=4, free_written="background"
)
PRESETS: dict[str, WorldOptions] = {
    "tiny": WorldOptions(
        objects_per_material=2,
        materials=("Wood", "Brick", "Leather", "Grass"),
        contacts_per_video=2,
        frames_per_contact=2,
    ),
    "demo": WorldOptions(),
    "pretrain": WorldOptions(
        seed=1000,
        objects_per_material=20,
        contacts_per_video=5,
        frames_per_contact=2,
        free_written="background",
    ),
    "small": _SMALL,
    "full": replace(_SMALL, size=128, tile=512, objects_per_material=60, contacts_per_video=6),
}
#: Size, and cost on one shared Intel Xeon core, 2026-11-21 (of full ten times a tenth).
COSTS = {
    "tiny": "32 contact frames: 1 s, 1 MB",
    "demo": "1,200 contact frames: 9 s, 24 MB",
    "pretrain": "4,000 contact frames: 23 s, 49 MB",
    "small": "8,000 contact frames: 34 s, 80 MB",
    "full": "36,000 contact frames: 430 s, 870 MB",
}
#: The preset of ``palpate world`` without options.
DEFAULT = "small"
