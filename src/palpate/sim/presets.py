"""Worlds with a name, what they cost, and the seeds that are kept for the shipped models."""

from __future__ import annotations

from typing import Any

from palpate.sim.options import WorldOptions

#: Seeds of the worlds that the shipped mini models are trained on. No preset, test of a score or benchmark may use one: a model has seen
#: what it would be judged on. A world of such a seed says so in its ``world.json``.
MINI_SEEDS = range(900_000, 900_100)

_SPARSE: dict[str, Any] = {"free_written": "background"}
_FEW = ("Wood", "Brick", "Leather", "Grass")

#: Frames in contact, frames written, and the CPU seconds and megabytes of ``palpate world --preset NAME --workers 1`` (one Intel Xeon core shared with
#: other work, 2026-11-21; by ``time`` and ``du -m``; on a busy machine the clock shows two to four times that). ``full`` is ten times what
#: ``--objects-per-material 6`` took. With ``--layout raw`` ``small`` takes 28 s and 282 MB.

PRESETS: dict[str, WorldOptions] = {
    # name                                                                                                                   contact written CPU s    MB
    "tiny": WorldOptions(
        materials=_FEW, objects_per_material=2, touches_per_video=2, frames_per_touch=2
    ),  #      32     112     1     1
    "demo": WorldOptions(
        objects_per_material=5, videos_per_object=1, touches_per_video=4, frames_per_touch=3
    ),  #    1200    3200     9    24
    "pretrain": WorldOptions(
        seed=1000, objects_per_material=20, touches_per_video=5, frames_per_touch=2, **_SPARSE
    ),  #    4000    6000    23    49
    "small": WorldOptions(
        objects_per_material=20, two_videos=0.25, touches_per_video=4, frames_per_touch=4, **_SPARSE
    ),  #  8000   10000    34    80
    "full": WorldOptions(
        size=128,
        tile=512,
        objects_per_material=60,
        two_videos=0.25,
        touches_per_video=6,
        frames_per_touch=4,
        **_SPARSE,
    ),
    #                                                                                                                          36000   45000   430   870
}

#: What a world of such a seed says of itself.
SEEN = "The shipped mini models may have been trained on this world: scores of theirs on it mean nothing."
#: What ``palpate world`` writes unless told otherwise.
DEFAULT = "small"


def seen_by_mini(options: WorldOptions) -> bool:
    """Whether the shipped mini models may have been trained on this world."""
    return options.seed in MINI_SEEDS
