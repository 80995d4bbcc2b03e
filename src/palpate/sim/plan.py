"""Which videos a world has, what each touches, and how frames are numbered; known before anything is rendered.

A video of T touches, F free frames and C contact frames a touch has frames 0 .. T (F + C) - 1. Touch k begins with its free frames at
k (F + C); its contact frames are k (F + C) + F up to (k + 1)(F + C) - 1.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass

from palpate.core import seed_for
from palpate.sim.balance import objects_of
from palpate.sim.materials.entries import object_prefix
from palpate.sim.options import BACKGROUND_OFFSET, VERSION, WorldOptions


@dataclass(frozen=True)
class ObjectRef:
    """An object by name: the material and its number among the objects of that material."""

    material: str
    number: int

    @property
    def name(self) -> str:
        """As in ``objects.csv``, e.g. ``natural_fabric_003``."""
        return f"{object_prefix(self.material)}_{self.number:03d}"


@dataclass(frozen=True)
class VideoPlan:
    """One video.

    Attributes:
        index: position in the world, the id that its random draws hang on.
        name: 15 characters ``YYYYMMDD_HHMMSS``, unique in the world.
        sensor: the gel unit, 0 .. sensors - 1.
        objects: the objects touched, in order; mostly one.
        touched: for each touch, the position of its object in ``objects``; never decreasing.
    """

    index: int
    name: str
    sensor: int
    objects: tuple[ObjectRef, ...]
    touched: tuple[int, ...]

    def object_of(self, touch: int) -> ObjectRef:
        """What touch number ``touch`` touches."""
        return self.objects[self.touched[touch]]


def first_contact(options: WorldOptions, touch: int) -> int:
    """Frame number of the first contact frame of a touch."""
    return touch * (options.free_frames + options.frames_per_touch) + options.free_frames


def contact_frames(options: WorldOptions, touch: int) -> range:
    """Frame numbers of a touch in contact."""
    return range(
        first_contact(options, touch), first_contact(options, touch) + options.frames_per_touch
    )


def written_frames(options: WorldOptions) -> list[int]:
    """Frame numbers that are written, the same in every video."""
    if options.free_written == "all":
        return list(range(options.video_length))
    frames: list[int] = []
    for touch in range(options.touches_per_video):
        frames += [
            first_contact(options, touch) - BACKGROUND_OFFSET,
            *contact_frames(options, touch),
        ]
    return frames


def chosen_twice(options: WorldOptions, listed: list[ObjectRef]) -> set[ObjectRef]:
    """The share ``two_videos`` of the objects, drawn so that every material has its share, nearly."""
    rng = options.rng("two videos")
    order = sorted(
        (listed[k] for k in rng.permutation(len(listed))),
        key=lambda ref: options.names.index(ref.material),
    )
    return {
        ref
        for k, ref in enumerate(order)
        if int((k + 1) * options.two_videos + 0.5) > int(k * options.two_videos + 0.5)
    }


def plan_world(options: WorldOptions) -> list[VideoPlan]:
    """All videos of a world, in the order of their names; objects stand in random order, the videos of one object in a row."""
    objects = objects_of(options)
    listed = [ObjectRef(m, k) for m, count in objects.items() for k in range(count)]
    twice = chosen_twice(options, listed)
    own = [listed[k] for k in options.rng("order").permutation(len(listed))]
    guests = dict(objects)
    day = datetime.datetime(2026, 1, 1) + datetime.timedelta(
        days=seed_for(options.seed, "world", VERSION, "date") % 3650
    )
    plans: list[VideoPlan] = []
    for ref in own:
        for _ in range(options.videos_per_object + (ref in twice)):
            index = len(plans)
            rng = options.rng("plan", index)
            touched_objects = [ref]
            most = min(options.objects_per_video, options.touches_per_video, len(options.names))
            if rng.random() < options.mixed and most > 1:
                others = [m for m in options.names if m != ref.material]
                for k in rng.permutation(len(others))[: int(rng.integers(1, most))]:
                    touched_objects.append(ObjectRef(others[k], guests[others[k]]))
                    guests[others[k]] += 1
            cuts = sorted(
                int(c) + 1
                for c in rng.permutation(options.touches_per_video - 1)[: len(touched_objects) - 1]
            )
            touched = tuple(
                sum(touch >= cut for cut in cuts) for touch in range(options.touches_per_video)
            )
            name = (day + datetime.timedelta(seconds=index * 97)).strftime("%Y%m%d_%H%M%S")
            plans.append(
                VideoPlan(
                    index, name, int(rng.integers(options.sensors)), tuple(touched_objects), touched
                )
            )
    return plans
