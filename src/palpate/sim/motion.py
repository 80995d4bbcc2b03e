"""How a hand moves the sensor: the contacts of a video, and the state of the sensor at each frame.

The contacts of a video revisit a place of the object; a quarter of them goes far away. The sensor
comes down during the free frames, then presses, holds, slides and lifts: over the phase p in [0, 1]
of a contact the load follows (0.45 + 0.55 sin(pi (0.12 + 0.76 p)))^2.

Of C frames in contact, frame k has the phase p = (k + u) / C with one u, uniform in [0, 1), a
contact, as of a camera that does not know of it: the phases of a world's frames are then uniform
for every C. Spaced phases are k / (C - 1), and 1/2 of a single frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from palpate.sim.ground import GROUND_MM, touch_of
from palpate.sim.options import RANGES, WorldOptions
from palpate.sim.plan import VideoPlan
from palpate.sim.tile import TILE_MM

#: Deviation of a video's contacts around its first, in mm, and share that goes far away instead.
REVISIT_MM, JUMP = 3.5, 0.25
#: Deviations in mm, one drawn a contact, of the sensor's slide.
SLIDE_MM = (0.0, 1.5, 5.0)
#: Deviations of the pad's slope (in scale real against the plane of what is under it), and of the
#: drag in mm per mm of depth.
TILT, TILT_REAL, SHEAR = 0.045, 0.1, 0.7
Pair = tuple[float, float]


@dataclass(frozen=True)
class State:
    """The sensor at a frame; of a contact as a whole, as it begins and with its peak load."""

    contact: int  # number of the contact in the video
    position: Pair  # middle of the pad on the tile in mm
    slide: Pair  # way of the whole contact in mm
    rotation: float  # of the pad in radians
    load: float  # mean indentation in mm, 0 without contact
    tilt: Pair  # slope of the pad
    shear: Pair  # drag in mm per mm of depth
    lift: float = 0.0  # 0 in contact to 1 far away

    @property
    def in_contact(self) -> bool:
        """Whether the sensor touches the object."""
        return self.lift == 0.0


def make_contacts(options: WorldOptions, plan: VideoPlan) -> list[State]:
    """Draw the contacts of a video."""
    rng, contacts = options.rng("motion", plan.index), list[State]()
    draw = rng.uniform
    normal = lambda spread: (spread * rng.normal(), spread * rng.normal())
    real = options.scale == "real"
    side, tilt = (GROUND_MM, TILT_REAL) if real else (TILE_MM, TILT)
    anywhere = lambda: (draw(0.0, side), draw(0.0, side))
    home, turn, last = (0.0, 0.0), 0.0, -1
    lightest, heaviest = map(math.log, options.load_mm)
    for contact, number in enumerate(plan.object_index):
        first = number != last  # on this object
        if first:
            home, last = anywhere(), number
            turn = draw(0.0, 2.0 * math.pi)
        far = rng.random() < JUMP and not first
        away, near = anywhere(), normal(REVISIT_MM)
        load = touch_of(plan.objects[number].material).load if real else 1.0
        state = State(
            contact,
            position=away if far else (home[0] + near[0], home[1] + near[1]),
            slide=normal(SLIDE_MM[int(rng.integers(len(SLIDE_MM)))]),
            rotation=turn + rng.normal(0.0, 0.5 if far else 0.1),
            load=min(load * math.exp(draw(lightest, heaviest)), RANGES["load_mm"][1]),
            tilt=normal(tilt),
            shear=normal(SHEAR),
        )
        contacts.append(state)
    return contacts


def state_at(options: WorldOptions, plan: VideoPlan, contacts: list[State], frame: int) -> State:
    """Return the state of the sensor at ``frame``; it depends on no other frame."""
    number, step = divmod(frame, options.free_frames + options.frames_per_contact)
    contact, rng = contacts[number], options.rng("state", plan.index, frame)
    x, y = (at + rng.normal(0.0, 0.02) for at in contact.position)
    if step < options.free_frames:
        lift = 1.0 - 0.85 * step / (options.free_frames - 1)
        return replace(contact, position=(x, y), load=0.0, shear=(0.0, 0.0), lift=lift)
    phase = _phase(options, plan, number, step - options.free_frames)
    ramp, drag = 0.45 + 0.55 * math.sin(math.pi * (0.12 + 0.76 * phase)), 0.3 + phase
    return replace(
        contact,
        position=(x + contact.slide[0] * phase, y + contact.slide[1] * phase),
        rotation=contact.rotation + 0.04 * phase,
        load=contact.load * ramp * ramp * math.exp(0.03 * rng.normal()),
        shear=(contact.shear[0] * drag, contact.shear[1] * drag),
    )


def _phase(options: WorldOptions, plan: VideoPlan, contact: int, step: int) -> float:
    """Return the phase of a frame of a contact in [0, 1]."""
    frames = options.frames_per_contact
    if options.phases == "drawn":
        return (step + options.rng("phase", plan.index, contact).random()) / frames
    return step / (frames - 1) if frames > 1 else 0.5
