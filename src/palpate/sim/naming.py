"""What samples and files are called in each layout, so that ids are those that ``palpate import`` gives.

=============  ===========================================  ============================================================
layout         id                                           photo, touch (background: the touch 4 frames before, or ``background.png``)
=============  ===========================================  ============================================================
``frames``     ``20260101_000000/0000000012``               ``dataset/<video>/video_frame/0000000012.jpg``, ``gelsight_frame/``
``videos``     as above                                     none: frames lie in ``video.mp4`` and ``gelsight.mp4``
``raw``        as above                                     none: row k of the arrays is row k of the manifest
``hct``        ``data2/4-1702596295.70/12``                 ``data2/4-1702596295.70/vision/12-0.0207.jpg``, ``tactile/``
=============  ===========================================  ============================================================

HCT names a recording by a number that is used again and its start in Unix seconds, and a frame by its number and a latency in seconds. Its rigs
``data1, data2 ...`` are our gel units.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from palpate.sim.options import BACKGROUND_OFFSET, WorldOptions
from palpate.sim.plan import VideoPlan, first_contact

#: HCT's numbers of recordings run from 1 to this and begin again.
_NUMBERS = 7


def rig_of(plan: VideoPlan) -> str:
    """``data1`` for the first gel unit: HCT's rig, the manifest's domain."""
    return f"data{plan.sensor + 1}"


def video_id(options: WorldOptions, plan: VideoPlan) -> str:
    """The video as the manifest names it."""
    if options.layout != "hct":
        return plan.name
    start = datetime.datetime.strptime(plan.name, "%Y%m%d_%H%M%S").replace(tzinfo=datetime.UTC)
    return f"{rig_of(plan)}/{plan.index % _NUMBERS + 1}-{int(start.timestamp())}.{plan.index % 100:02d}"


def sample_id(options: WorldOptions, plan: VideoPlan, frame: int) -> str:
    """The id of a contact frame."""
    number = str(frame) if options.layout == "hct" else f"{frame:010d}"
    return f"{video_id(options, plan)}/{number}"


def touch_id(options: WorldOptions, plan: VideoPlan, touch: int) -> str:
    """The touch as the manifest names it; unique across videos, counted from 1."""
    return f"{video_id(options, plan)}#{touch + 1:04d}"


def manifest_root(options: WorldOptions, folder: Path) -> Path:
    """The folder that image paths start at."""
    return folder / "hct" if options.layout == "hct" else folder


def video_folder(options: WorldOptions, plan: VideoPlan) -> str:
    """Where the files of a video lie, relative to the manifest's root; not for ``raw``."""
    return video_id(options, plan) if options.layout == "hct" else f"dataset/{plan.name}"


def frame_name(options: WorldOptions, plan: VideoPlan, frame: int) -> str:
    """The file name of a frame, the same for photo and touch."""
    if options.layout == "hct":
        return f"{frame}-{options.rng('latency', plan.index, frame).uniform(0.005, 0.06):.4f}.jpg"
    return f"{frame:010d}.jpg"


def sides(options: WorldOptions) -> tuple[str, str]:
    """The folders of photos and touches within a video."""
    return ("vision", "tactile") if options.layout == "hct" else ("video_frame", "gelsight_frame")


def image_paths(
    options: WorldOptions, plan: VideoPlan, touch: int, frame: int
) -> dict[str, str | None]:
    """``vision``, ``tactile``, ``background`` of a contact frame relative to the manifest's root; None where there are no image files."""
    if options.layout not in ("frames", "hct"):
        return {"vision": None, "tactile": None, "background": None}
    folder, (vision, tactile), name = (
        video_folder(options, plan),
        sides(options),
        frame_name(options, plan, frame),
    )
    if options.layout == "hct":
        background = f"{folder}/background.png"
    else:
        background = f"{folder}/{tactile}/{frame_name(options, plan, first_contact(options, touch) - BACKGROUND_OFFSET)}"
    return {
        "vision": f"{folder}/{vision}/{name}",
        "tactile": f"{folder}/{tactile}/{name}",
        "background": background,
    }


@dataclass(frozen=True)
class Row:
    """A contact frame: its video, the touch within it, and its number."""

    video: VideoPlan
    touch: int
    frame: int

    @property
    def object(self) -> str:
        """The name of what is touched."""
        return self.video.object_of(self.touch).name


def contact_row(options: WorldOptions, plans: list[VideoPlan], k: int) -> Row:
    """Contact frame number ``k`` of the world, by video and frame."""
    video, within = divmod(k, options.touches_per_video * options.frames_per_touch)
    touch, step = divmod(within, options.frames_per_touch)
    return Row(plans[video], touch, first_contact(options, touch) + step)


def contact_rows(options: WorldOptions, plans: list[VideoPlan]) -> Iterator[Row]:
    """Every contact frame, by video and frame: the order of manifest and arrays."""
    return (
        contact_row(options, plans, k)
        for k in range(len(plans) * options.touches_per_video * options.frames_per_touch)
    )
