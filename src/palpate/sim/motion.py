"""How a hand moves the sensor: the touches of a video, and where the sensor is at each frame.

The touches of a video revisit one place of the object (``revisit_mm``; a share ``jump`` of them goes far away). A touch comes down during its free
frames, then presses, holds, slides and lifts: over the phase p in [0, 1] of the contact the load follows sin²(pi (0.12 + 0.76 p)) on a base.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from palpate.sim.options import WorldOptions
from palpate.sim.plan import VideoPlan
from palpate.sim.tile import TILE_MM

Pair = tuple[float, float]


@dataclass(frozen=True)
class Touch:
    """One contact: place (x, y) on the tile and slide in mm, rotation in radians, peak load in mm, tilt, shear."""

    place: Pair
    slide: Pair
    rotation: float
    load: float
    tilt: Pair
    shear: Pair


@dataclass(frozen=True)
class State:
    """The sensor at one frame.

    Attributes:
        touch: number of the touch in the video.
        contact: whether it touches.
        place: middle of the pad on the tile in mm; rotation: of the pad in radians.
        load: mean indentation in mm, 0 without contact.
        tilt: slope of the pad; shear: drag in mm per mm of depth.
        lift: 0 in contact to 1 far away.
    """

    touch: int
    contact: bool
    place: Pair
    rotation: float
    load: float
    tilt: Pair
    shear: Pair
    lift: float


def make_touches(options: WorldOptions, plan: VideoPlan) -> list[Touch]:
    """The touches of a video."""
    touches: list[Touch] = []
    rng = options.rng("motion", plan.index)
    home, turn, last = (0.0, 0.0), 0.0, -1
    lightest, heaviest = options.load_mm
    for thing in plan.touched:
        fresh = thing != last
        if fresh:
            home, turn, last = (
                (rng.uniform(0.0, TILE_MM), rng.uniform(0.0, TILE_MM)),
                rng.uniform(0.0, 2.0 * math.pi),
                thing,
            )
        far = bool(rng.random() < options.jump) and not fresh
        away = (rng.uniform(0.0, TILE_MM), rng.uniform(0.0, TILE_MM))
        near = (
            home[0] + options.revisit_mm * rng.normal(),
            home[1] + options.revisit_mm * rng.normal(),
        )
        reach = options.slide_mm[int(rng.integers(len(options.slide_mm)))]
        touches.append(
            Touch(
                place=away if far else near,
                slide=(reach * rng.normal(), reach * rng.normal()),
                rotation=turn + rng.normal(0.0, 0.5 if far else 0.1),
                load=math.exp(rng.uniform(math.log(lightest), math.log(heaviest))),
                tilt=(options.tilt * rng.normal(), options.tilt * rng.normal()),
                shear=(options.shear * rng.normal(), options.shear * rng.normal()),
            )
        )
    return touches


def state_at(options: WorldOptions, plan: VideoPlan, touches: list[Touch], frame: int) -> State:
    """Where the sensor is at ``frame``; depends on no other frame."""
    number, at = divmod(frame, options.free_frames + options.frames_per_touch)
    touch = touches[number]
    rng = options.rng("state", plan.index, frame)
    x, y = touch.place[0] + rng.normal(0.0, 0.02), touch.place[1] + rng.normal(0.0, 0.02)
    if at < options.free_frames:
        lift = 1.0 - 0.85 * at / (options.free_frames - 1)
        return State(number, False, (x, y), touch.rotation, 0.0, touch.tilt, (0.0, 0.0), lift)
    step, last = at - options.free_frames, options.frames_per_touch - 1
    phase = step / last if last else 0.5
    ramp = 0.45 + 0.55 * math.sin(math.pi * (0.12 + 0.76 * phase))
    load = touch.load * ramp * ramp * math.exp(0.03 * rng.normal())
    drag = 0.3 + phase
    return State(
        number,
        True,
        (x + touch.slide[0] * phase, y + touch.slide[1] * phase),
        touch.rotation + 0.04 * phase,
        load,
        touch.tilt,
        (touch.shear[0] * drag, touch.shear[1] * drag),
        0.0,
    )
