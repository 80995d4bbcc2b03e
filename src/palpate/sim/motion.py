"""How a hand moves the sensor: the contacts of a video, and the state of the sensor at each frame.

The contacts of a video revisit a place of the object; a quarter of them goes far away. The sensor
comes down during the free frames, then presses, holds, slides and lifts: over the phase p in [0, 1]
of a contact the load follows (0.45 + 0.55 sin(pi (0.12 + 0.76 p)))^2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from palpate.sim.options import WorldOptions
from palpate.sim.plan import VideoPlan
from palpate.sim.tile import TILE_MM

#: Range of the peak load as mean indentation in mm, log-uniform.
LOAD_MM = (0.09, 0.42)
#: Deviation of a video's contacts around its first, in mm, and share that goes far away instead.
REVISIT_MM, JUMP = 3.5, 0.25
#: Deviations in mm, one drawn a contact, of the sensor's slide.
SLIDE_MM = (0.0, 1.5, 5.0)
#: Deviations of the pad's slope, and of the drag in mm per mm of depth.
TILT, SHEAR = 0.045, 0.7
Pair = tuple[float, float]


@dataclass(frozen=True)
class Contact:
    """A contact: place (x, y) on the tile, slide and peak load in mm, rotation in radians."""

    place: Pair
    slide: Pair
    rotation: float
    load: float
    tilt: Pair
    shear: Pair


@dataclass(frozen=True)
class State:
    """The sensor at a frame."""

    contact: int  # number of the contact in the video
    in_contact: bool
    place: Pair  # middle of the pad on the tile in mm
    rotation: float  # of the pad in radians
    load: float  # mean indentation in mm, 0 without contact
    tilt: Pair  # slope of the pad
    shear: Pair  # drag in mm per mm of depth
    lift: float  # 0 in contact to 1 far away


def make_contacts(options: WorldOptions, plan: VideoPlan) -> list[Contact]:
    """Draw the contacts of a video."""
    contacts: list[Contact] = []
    rng = options.rng("motion", plan.index)
    normal, draw = rng.normal, rng.uniform
    home, turn, last = (0.0, 0.0), 0.0, -1
    lightest, heaviest = map(math.log, LOAD_MM)
    for number in plan.object_index:
        first = number != last  # on this object
        if first:
            home, last = (draw(0.0, TILE_MM), draw(0.0, TILE_MM)), number
            turn = draw(0.0, 2.0 * math.pi)
        far = bool(rng.random() < JUMP) and not first
        away = (draw(0.0, TILE_MM), draw(0.0, TILE_MM))
        near = (home[0] + REVISIT_MM * normal(), home[1] + REVISIT_MM * normal())
        reach = SLIDE_MM[int(rng.integers(len(SLIDE_MM)))]
        contact = Contact(
            place=away if far else near,
            slide=(reach * normal(), reach * normal()),
            rotation=turn + normal(0.0, 0.5 if far else 0.1),
            load=math.exp(draw(lightest, heaviest)),
            tilt=(TILT * normal(), TILT * normal()),
            shear=(SHEAR * normal(), SHEAR * normal()),
        )
        contacts.append(contact)
    return contacts


def state_at(options: WorldOptions, plan: VideoPlan, contacts: list[Contact], frame: int) -> State:
    """Return the state of the sensor at ``frame``; it depends on no other frame."""
    number, step = divmod(frame, options.free_frames + options.frames_per_contact)
    contact = contacts[number]
    rng = options.rng("state", plan.index, frame)
    x, y = contact.place[0] + rng.normal(0.0, 0.02), contact.place[1] + rng.normal(0.0, 0.02)
    if step < options.free_frames:
        lift = 1.0 - 0.85 * step / (options.free_frames - 1)
        return State(number, False, (x, y), contact.rotation, 0.0, contact.tilt, (0.0, 0.0), lift)
    step, last = step - options.free_frames, options.frames_per_contact - 1
    phase = step / last if last else 0.5
    ramp = 0.45 + 0.55 * math.sin(math.pi * (0.12 + 0.76 * phase))
    load = contact.load * ramp * ramp * math.exp(0.03 * rng.normal())
    place = (x + contact.slide[0] * phase, y + contact.slide[1] * phase)
    rotation, drag = contact.rotation + 0.04 * phase, 0.3 + phase
    shear = (contact.shear[0] * drag, contact.shear[1] * drag)
    return State(number, True, place, rotation, load, contact.tilt, shear, 0.0)
