"""Which videos a world has, their objects and frame numbers; known before rendering.

A video of T contacts, F free frames and C frames of a contact has frames 0 .. T (F + C) - 1.
Contact k begins with its free frames at k (F + C); its frames in contact are k (F + C) + F up to
(k + 1)(F + C) - 1.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from dataclasses import dataclass

from palpate.core import seed_for
from palpate.sim.materials import MATERIALS, Material, object_prefix
from palpate.sim.options import BACKGROUND_OFFSET, VERSION, WorldOptions

#: A mixed video has 2 to this many objects.
OBJECTS_PER_VIDEO = 3


@dataclass(frozen=True)
class ObjectRef:
    """An object by name: the material and its number among the objects of that material."""

    material: str
    number: int

    @property
    def name(self) -> str:
        """The name in ``objects.csv``, e.g. ``natural_fabric_003``."""
        return f"{object_prefix(self.material)}_{self.number:03d}"


@dataclass(frozen=True)
class VideoPlan:
    """One video."""

    index: int  # position in the world; its random draws depend on it
    name: str  # 15 characters ``YYYYMMDD_HHMMSS``, unique in the world
    sensor: int  # the gel unit, 0 .. sensors - 1.
    objects: tuple[ObjectRef, ...]  # its objects in order; mostly a single one
    object_index: tuple[int, ...]  # position in ``objects`` for each contact; never decreasing

    def object_of(self, contact: int) -> ObjectRef:
        """Return the object of a contact."""
        return self.objects[self.object_index[contact]]

    def sample_id(self, frame: int) -> str:
        """Return the id of a contact frame."""
        return f"{self.name}/{frame:010d}"


@dataclass(frozen=True)
class Row:
    """A frame in contact: its video, the contact within it, and its number."""

    video: VideoPlan
    contact: int
    frame: int

    @property
    def object(self) -> ObjectRef:
        """The object in contact."""
        return self.video.object_of(self.contact)

    @property
    def material(self) -> Material:
        """The entry of its material."""
        return MATERIALS[self.object.material]

    @property
    def id(self) -> str:
        """The sample's id."""
        return self.video.sample_id(self.frame)

    @property
    def contact_id(self) -> str:
        """The contact as the manifest names it; unique across videos, counted from 1."""
        return f"{self.video.name}#{self.contact + 1:04d}"


def first_contact(options: WorldOptions, contact: int) -> int:
    """Return the number of the first frame of a contact."""
    return contact * (options.free_frames + options.frames_per_contact) + options.free_frames


def contact_frames(options: WorldOptions, contact: int) -> range:
    """Return the frame numbers of a contact."""
    first = first_contact(options, contact)
    return range(first, first + options.frames_per_contact)


def contact_rows(options: WorldOptions, plans: list[VideoPlan]) -> Iterator[Row]:
    """Yield every contact frame, by video and frame: the order of the manifest."""
    for plan in plans:
        for contact in range(options.contacts_per_video):
            for frame in contact_frames(options, contact):
                yield Row(plan, contact, frame)


def written_frames(options: WorldOptions) -> list[int]:
    """Return the frame numbers that are written, the same in every video."""
    if options.free_written == "all" or options.layout == "videos":
        return list(range(options.video_length))
    contacts = [contact_frames(options, k) for k in range(options.contacts_per_video)]
    return [frame for c in contacts for frame in (c.start - BACKGROUND_OFFSET, *c)]


def spread(count: int, share: float) -> list[int]:
    """Return positions in 0 .. count - 1 of a share by error diffusion, evenly spread."""
    return [k for k in range(count) if int((k + 1) * share + 0.5) > int(k * share + 0.5)]


def plan_world(options: WorldOptions) -> list[VideoPlan]:
    """Plan all videos of a world in the order of their names: object by object, shuffled."""
    counts = dict.fromkeys(options.names, options.objects_per_material)
    objects = [ObjectRef(m, k) for m, count in counts.items() for k in range(count)]
    # About the same share of every material has two videos.
    order = [objects[k] for k in options.rng("two videos").permutation(len(objects))]
    order.sort(key=lambda ref: options.names.index(ref.material))
    twice = {order[k] for k in spread(len(order), options.two_videos)}
    guests = dict(counts)  # further objects of mixed videos, numbered behind the others
    days = seed_for(options.seed, "world", VERSION, "date") % 3650
    start = datetime.datetime(2026, 1, 1) + datetime.timedelta(days=days)
    plans: list[VideoPlan] = []
    for k in options.rng("order").permutation(len(objects)):
        for _ in range(options.videos_per_object + (objects[k] in twice)):
            index = len(plans)
            name = (start + datetime.timedelta(seconds=index * 97)).strftime("%Y%m%d_%H%M%S")
            plans.append(_plan_video(options, index, name, objects[k], guests))
    return plans


def _plan_video(
    options: WorldOptions, index: int, name: str, main: ObjectRef, guests: dict[str, int]
) -> VideoPlan:
    """Plan a video of ``main`` and, if it is mixed, of new objects counted in ``guests``."""
    rng = options.rng("plan", index)
    objects = [main]
    most = min(OBJECTS_PER_VIDEO, options.contacts_per_video, len(options.names))
    if rng.random() < options.mixed and most > 1:
        names = [m for m in options.names if m != main.material]
        for k in rng.permutation(len(names))[: int(rng.integers(1, most))]:
            objects.append(ObjectRef(names[k], guests[names[k]]))
            guests[names[k]] += 1
    changes = rng.permutation(options.contacts_per_video - 1)[: len(objects) - 1]
    cuts = sorted(int(c) + 1 for c in changes)
    which = tuple(sum(c >= cut for cut in cuts) for c in range(options.contacts_per_video))
    return VideoPlan(index, name, int(rng.integers(options.sensors)), tuple(objects), which)
