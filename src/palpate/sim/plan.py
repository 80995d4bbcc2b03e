"""Which videos a world has, their objects and frame numbers; known before rendering.

A video of T contacts, F free frames and C frames of a contact has frames 0 .. T (F + C) - 1.
Contact k begins with its free frames at k (F + C); its frames in contact are k (F + C) + F up to
(k + 1)(F + C) - 1.

Objects per material: ``balance="uniform"`` gives each the same number. ``balance="touch-and-go"``
makes classes as unequal as the frames of Touch and Go (Yang et al., 2022), whose official lists
hold 121,861 frames: 23 % of them are synthetic fabric, 0.2 % sand. A material has max(2, total *
its share) objects, and what the minimum of two adds is taken from the others in proportion.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from dataclasses import dataclass

from palpate.core import seed_for
from palpate.sim.materials import object_prefix
from palpate.sim.options import BACKGROUND_OFFSET, VERSION, WorldOptions

#: Frames of each class in both official lists together. Natural fabric has none there.
TOUCH_AND_GO_FRAMES = {
    **{"Concrete": 18_047, "Plastic": 6_001, "Glass": 1_458, "Wood": 21_846, "Metal": 10_633},
    **{"Brick": 7_337, "Tile": 3_068, "Leather": 2_730, "Synthetic Fabric": 28_010},
    **{"Natural Fabric": 0, "Rubber": 330, "Paper": 2_389, "Tree": 1_782, "Grass": 5_837},
    **{"Soil": 1_628, "Rock": 7_787, "Gravel": 775, "Sand": 223, "Plants": 1_441, "Others": 539},
}
#: Objects that a material has at least, so that train and test can both have one.
LEAST = 2


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
    """One video.

    Attributes:
        index: position in the world; its random draws depend on it.
        name: 15 characters ``YYYYMMDD_HHMMSS``, unique in the world.
        sensor: the gel unit, 0 .. sensors - 1.
        objects: its objects in order; mostly a single one.
        object_index: position in ``objects`` for each contact; never decreasing.
    """

    index: int
    name: str
    sensor: int
    objects: tuple[ObjectRef, ...]
    object_index: tuple[int, ...]

    def object_of(self, contact: int) -> ObjectRef:
        """Return the object of a contact."""
        return self.objects[self.object_index[contact]]


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


def first_contact(options: WorldOptions, contact: int) -> int:
    """Return the number of the first frame of a contact."""
    return contact * (options.free_frames + options.frames_per_contact) + options.free_frames


def contact_frames(options: WorldOptions, contact: int) -> range:
    """Return the frame numbers of a contact."""
    first = first_contact(options, contact)
    return range(first, first + options.frames_per_contact)


def contact_row(options: WorldOptions, plans: list[VideoPlan], k: int) -> Row:
    """Return contact frame ``k`` of the world, by video and frame."""
    video, within = divmod(k, options.contacts_per_video * options.frames_per_contact)
    contact, step = divmod(within, options.frames_per_contact)
    return Row(plans[video], contact, first_contact(options, contact) + step)


def contact_rows(options: WorldOptions, plans: list[VideoPlan]) -> Iterator[Row]:
    """Yield every contact frame, by video and frame: the order of the manifest."""
    for plan in plans:
        for contact in range(options.contacts_per_video):
            for frame in contact_frames(options, contact):
                yield Row(plan, contact, frame)


def written_frames(options: WorldOptions) -> list[int]:
    """Return the frame numbers that are written, the same in every video."""
    if options.free_written == "all":
        return list(range(options.video_length))
    contacts = [contact_frames(options, k) for k in range(options.contacts_per_video)]
    return [frame for c in contacts for frame in (c.start - BACKGROUND_OFFSET, *c)]


def objects_of(options: WorldOptions) -> dict[str, int]:
    """Return material -> number of objects that have videos, in the order of ``options.names``.

    A material that Touch and Go does not know has the mean share.
    """
    names = options.names
    known = [TOUCH_AND_GO_FRAMES[name] for name in names if name in TOUCH_AND_GO_FRAMES]
    if options.balance == "uniform" or not sum(known):
        return dict.fromkeys(names, options.objects_per_material)
    mean = sum(known) / len(known)
    frames = {name: float(TOUCH_AND_GO_FRAMES.get(name, mean)) for name in names}
    return _in_proportion(frames, options.objects_per_material * len(names))


def _in_proportion(weights: dict[str, float], total: int) -> dict[str, int]:
    """Return whole numbers >= ``LEAST`` in proportion to ``weights`` that sum to ``total``."""
    small: set[str] = set()
    while True:
        large = {name: w for name, w in weights.items() if name not in small}
        scale = (total - LEAST * len(small)) / (sum(large.values()) or 1.0)  # 1.0: all are small
        more = {name for name, w in large.items() if w * scale < LEAST}
        if not more:
            break
        small |= more
    exact = {name: float(LEAST) if name in small else w * scale for name, w in weights.items()}
    counts = {name: int(value) for name, value in exact.items()}
    # The largest remainder first, ties in the given order.
    by_remainder = sorted(exact, key=lambda name: counts[name] - exact[name])
    for name in by_remainder[: total - sum(counts.values())]:
        counts[name] += 1
    return counts


def spread(count: int, share: float) -> list[int]:
    """Return positions in 0 .. count - 1 of a share by error diffusion, evenly spread."""
    return [k for k in range(count) if int((k + 1) * share + 0.5) > int(k * share + 0.5)]


def _with_two_videos(options: WorldOptions, objects: list[ObjectRef]) -> set[ObjectRef]:
    """Return a share ``two_videos`` of the objects, about the same share of every material."""
    order = [objects[k] for k in options.rng("two videos").permutation(len(objects))]
    order.sort(key=lambda ref: options.names.index(ref.material))
    return {order[k] for k in spread(len(order), options.two_videos)}


def plan_world(options: WorldOptions) -> list[VideoPlan]:
    """Plan all videos of a world in the order of their names: object by object, shuffled."""
    counts = objects_of(options)
    objects = [ObjectRef(m, k) for m, count in counts.items() for k in range(count)]
    twice = _with_two_videos(options, objects)
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
    most = min(options.objects_per_video, options.contacts_per_video, len(options.names))
    if rng.random() < options.mixed and most > 1:
        others = [m for m in options.names if m != main.material]
        for k in rng.permutation(len(others))[: int(rng.integers(1, most))]:
            objects.append(ObjectRef(others[k], guests[others[k]]))
            guests[others[k]] += 1
    changes = rng.permutation(options.contacts_per_video - 1)[: len(objects) - 1]
    cuts = sorted(int(c) + 1 for c in changes)
    which = tuple(sum(c >= cut for cut in cuts) for c in range(options.contacts_per_video))
    return VideoPlan(index, name, int(rng.integers(options.sensors)), tuple(objects), which)
