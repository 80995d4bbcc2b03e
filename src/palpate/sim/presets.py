"""Worlds with a name, and what they cost."""

from __future__ import annotations

from palpate.sim.options import WorldOptions

_FEW = ("Wood", "Brick", "Leather", "Grass")

#: Frames in contact, frames written, and the CPU seconds of one worker at 64 px (Intel Xeon, seed of the row, 2026-11-21; on a busy
#: machine the clock shows two to four times that).
# fmt: off
PRESETS: dict[str, WorldOptions] = {
    # name    options                                                                                                                   # contact written CPU s   MB
    "tiny":     WorldOptions(materials=_FEW, objects_per_material=2, touches_per_video=2, frames_per_touch=2),                          #      32     112   0.5    1
    "demo":     WorldOptions(objects_per_material=5, videos_per_object=1, touches_per_video=4, frames_per_touch=3),                     #    1200    3200     8   23
    "pretrain": WorldOptions(seed=1000, objects_per_material=20, touches_per_video=5, frames_per_touch=2, free_written="background"),   #    4000    6000    25   47
    "small":    WorldOptions(objects_per_material=20, touches_per_video=5, frames_per_touch=4, free_written="background"),              #    8000   10000    32   76
}
# fmt: on
