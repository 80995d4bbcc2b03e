"""Worlds with a name, their cost, and the seeds that are reserved for the shipped models."""

from __future__ import annotations

from typing import Any

from palpate.sim.options import WorldOptions

#: Seeds of the worlds that the shipped mini models were trained on. No preset, test or benchmark of
#: a score uses one: a model would be scored on its training data.
MINI_SEEDS = range(900_000, 900_100)
#: The warning on a world of such a seed.
SEEN_WARNING = (
    "Shipped mini models may have been trained on this world: their scores on it mean nothing."
)

_BACKGROUND_FRAMES_ONLY: dict[str, Any] = {"free_written": "background"}
_FOUR_MATERIALS = ("Wood", "Brick", "Leather", "Grass")
_TINY: dict[str, Any] = {
    "materials": _FOUR_MATERIALS,
    "contacts_per_video": 2,
    "frames_per_contact": 2,
}
_PRETRAIN: dict[str, Any] = {
    "contacts_per_video": 5,
    "frames_per_contact": 2,
    **_BACKGROUND_FRAMES_ONLY,
}
_SMALL: dict[str, Any] = {"two_videos": 0.25, "frames_per_contact": 4, **_BACKGROUND_FRAMES_ONLY}

#: Cost of ``palpate world --preset NAME --workers 1`` on one shared Intel Xeon core,
#: 2026-11-21: tiny 32 contact frames, 1 s, 1 MB; demo 1,200, 9 s, 24 MB; pretrain 4,000, 23 s, 49
#: MB; small 8,000, 34 s, 80 MB; full 36,000, 430 s, 870 MB (ten times a tenth of it).
PRESETS: dict[str, WorldOptions] = {
    "tiny": WorldOptions(objects_per_material=2, **_TINY),
    "demo": WorldOptions(),
    "pretrain": WorldOptions(seed=1000, objects_per_material=20, **_PRETRAIN),
    "small": WorldOptions(objects_per_material=20, **_SMALL),
    "full": WorldOptions(
        size=128, tile=512, objects_per_material=60, contacts_per_video=6, **_SMALL
    ),
}
#: The preset of ``palpate world`` without options.
DEFAULT = "small"


def seen_by_mini(options: WorldOptions) -> bool:
    """Return whether the shipped mini models may have been trained on this world."""
    return options.seed in MINI_SEEDS
