"""One video of the world: any of its frames can be rendered alone."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from palpate.core import PalpateError
from palpate.sim.arrays import Array, f32, grid, sample_periodic, to_bytes
from palpate.sim.camera import Scene, light_object, make_camera, photo
from palpate.sim.gel import gap_of, make_sensor, marker_shift, press, shade
from palpate.sim.motion import State, make_touches, state_at
from palpate.sim.objects import Thing, make_object
from palpate.sim.options import BACKGROUND_OFFSET, WorldOptions
from palpate.sim.plan import VideoPlan, first_contact, plan_world
from palpate.sim.text import caption


class Video:
    """Renders the frames of one video.

    Args:
        options: the world's.
        plan: which video (:func:`~palpate.sim.plan.plan_world`), or its index.

    Raises:
        PalpateError: if there is no such video.
    """

    def __init__(self, options: WorldOptions, plan: VideoPlan | int) -> None:
        if isinstance(plan, int):
            plans = plan_world(options)
            if not 0 <= plan < len(plans):
                raise PalpateError(
                    f"A video of this world must be 0 to {len(plans) - 1}",
                    str(plan),
                    "Choose another video",
                )
            plan = plans[plan]
        self.options, self.plan = options, plan
        self.sensor = make_sensor(options, plan.sensor)
        self.touches = make_touches(options, plan)
        self.camera = make_camera(options, plan.index)
        rng = options.rng("gain", plan.index)
        spread = 2.0 * options.hard
        self.gain: Array = f32(
            np.exp(0.03 * spread * rng.standard_normal(3) + 0.05 * spread * rng.standard_normal())
        )
        self._scenes: dict[int, Scene] = {}
        self._states: dict[int, State] = {}

    def state(self, frame: int) -> State:
        """Where the sensor is at ``frame``.

        Raises:
            PalpateError: if the video has no such frame.
        """
        if not 0 <= frame < self.options.video_length:
            last = self.options.video_length - 1
            raise PalpateError(
                f"A frame of video {self.plan.name} must be 0 to {last}",
                str(frame),
                "Choose another frame",
            )
        if frame not in self._states:
            self._states = {
                frame: state_at(self.options, self.plan, self.touches, frame)
            }  # photo and touch ask for the same one
        return self._states[frame]

    def thing(self, touch: int) -> Thing:
        """The object of a touch."""
        return make_object(self.options, self.plan.object_of(touch))

    def text(self, touch: int) -> str:
        """The caption of a touch."""
        return caption(self.options, self.plan.index, touch, self.thing(touch).surface)

    def vision(self, frame: int) -> np.ndarray:
        """The photo: uint8, shape (n, n, 3)."""
        state = self.state(frame)
        number = self.plan.touched[state.touch]
        if number not in self._scenes:
            self._scenes[number] = light_object(
                self.options, self.camera, self.thing(state.touch), self.plan.index, number
            )
        return to_bytes(
            photo(self.options, self.camera, self._scenes[number], state, self.plan.index, frame)
        )

    def tactile(self, frame: int) -> np.ndarray:
        """The sensor's image: uint8, shape (n, n, 3)."""
        state, sensor = self.state(frame), self.sensor
        if state.contact:
            membrane = self.membrane(state)[0]
            shift = marker_shift(sensor, membrane, state.shear) if sensor.ink is not None else None
            image = shade(sensor, membrane, self.gain, shift)
        else:
            image = self._passive
        rng = self.options.rng("noise", self.plan.index, frame)
        return to_bytes(
            image + rng.standard_normal(image.shape, dtype=np.float32) * np.float32(sensor.noise)
        )

    def membrane(self, state: State) -> tuple[Array, Array]:
        """Displacement of the gel in mm and contact mask, both (n, n), of a state in contact."""
        thing = self.thing(state.touch)
        gap = gap_of(thing, self.sensor, self.relief(state), state.load, state.tilt)
        return press(self.sensor, gap, state.load * (1.0 - 0.3 * thing.surface.softness))

    def relief(self, state: State) -> Array:
        """The object's relief under the pad in mm, (n, n)."""
        thing = self.thing(state.touch)
        y, x = grid(self.options.size)
        half = self.options.pad_mm / 2.0 / thing.px
        c, s = float(np.cos(state.rotation)) * half, float(np.sin(state.rotation)) * half
        return sample_periodic(
            thing.surface.height,
            s * x + c * y + state.place[1] / thing.px,
            c * x - s * y + state.place[0] / thing.px,
        )

    def background(self) -> np.ndarray:
        """The sensor's image when it touches nothing, without noise: uint8, shape (n, n, 3)."""
        return to_bytes(self._passive)

    def background_of(self, touch: int) -> np.ndarray:
        """The background image that the layout gives a touch: one noiseless picture a video in HCT, else the frame 4 before the touch."""
        if self.options.layout == "hct":
            return self.background()
        return self.tactile(first_contact(self.options, touch) - BACKGROUND_OFFSET)

    @cached_property
    def _passive(self) -> Array:
        return shade(
            self.sensor, np.zeros((self.options.size, self.options.size), np.float32), self.gain
        )
