"""Worlds with a name, what they cost, and the seeds that are reserved for the shipped models."""

from __future__ import annotations

from typing import Any

from palpate.sim.options import WorldOptions

#: Seeds of the worlds that the shipped mini models were trained on. No preset, test or benchmark of
#: a score
#: uses one: a model has seen what it would be judged on.
MINI_SEEDS = range(900_000, 900_100)
#: What a world of such a seed says of itself.
SEEN = (
    "The shipped mini models may have been trained on this world: "
    "scores of theirs on it mean nothing."
)

_SPARSE: dict[str, Any] = {"free_written": "background"}
_FEW = ("Wood", "Brick", "Leather", "Grass")

#: Cost of ``palpate world --preset NAME --workers 1`` on one shared Intel Xeon core,
#: 2026-11-21: tiny 32 contact frames, 1 s, 1 MB; demo 1,200, 9 s, 24 MB; pretrain 4,000, 23 s, 49
#: MB; small 8,000, 34 s, 80 MB; full 36,000, 430 s, 870 MB (ten times a tenth of it).
PRESETS: dict[str, WorldOptions] = {
    "tiny": WorldOptions(
        materials=_FEW, objects_per_material=2, contacts_per_video=2, frames_per_contact=2
    ),
    "demo": WorldOptions(objects_per_material=5),
    "pretrain": WorldOptions(
        seed=1000, objects_per_material=20, contacts_per_video=5, frames_per_contact=2, **_SPARSE
    ),
    "small": WorldOptions(
        objects_per_material=20, two_videos=0.25, frames_per_contact=4, **_SPARSE
    ),
    "full": WorldOptions(
        size=128,
        tile=512,
        objects_per_material=60,
        two_videos=0.25,
        contacts_per_video=6,
        frames_per_contact=4,
        **_SPARSE,
    ),
}
#: The preset of ``palpate world`` without options.
DEFAULT = "small"


def seen_by_mini(options: WorldOptions) -> bool:
    """Whether the shipped mini models may have been trained on this world."""
    return options.seed in MINI_SEEDS
