"""A video of the world: any of its frames can be rendered alone."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from palpate.core import PalpateError
from palpate.sim.arrays import Array, f32, grid, sample_periodic, to_bytes
from palpate.sim.camera import Scene, light_object, make_camera, photo
from palpate.sim.felt import caption, measure
from palpate.sim.gel import PAD_MM, gap_of, make_sensor, marker_shift, press, shade
from palpate.sim.motion import State, make_contacts, state_at
from palpate.sim.objects import WorldObject, make_object
from palpate.sim.options import BACKGROUND_OFFSET, WorldOptions
from palpate.sim.plan import VideoPlan, first_contact, plan_world


class Video:
    """Renders the frames of a video.

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
                must = f"A video of this world must be 0 to {len(plans) - 1}"
                raise PalpateError(must, str(plan), "Choose another video")
            plan = plans[plan]
        self.options, self.plan = options, plan
        self.sensor = make_sensor(options, plan.sensor)
        self.contacts = make_contacts(options, plan)
        self.camera = make_camera(options, plan.index)
        rng, spread = options.rng("gain", plan.index), 2.0 * options.hard
        balance, exposure = rng.standard_normal(3), rng.standard_normal()
        self.gain: Array = f32(np.exp(0.03 * spread * balance + 0.05 * spread * exposure))
        self._scenes: dict[int, Scene] = {}

    def state(self, frame: int) -> State:
        """Return the state of the sensor at ``frame``."""
        if not 0 <= frame < self.options.video_length:
            must = f"A frame of {self.plan.name} must be 0 to {self.options.video_length - 1}"
            raise PalpateError(must, str(frame), "Choose another frame")
        return state_at(self.options, self.plan, self.contacts, frame)

    def object_of(self, contact: int) -> WorldObject:
        """Return the object of a contact."""
        return make_object(self.options, self.plan.object_of(contact))

    def text(self, contact: int) -> str:
        """Return the caption of a contact."""
        index, surface = self.plan.index, self.object_of(contact).surface
        relief = self.relief(self.state(first_contact(self.options, contact)))
        felt = measure(relief, self.sensor.px, surface.softness, surface.gloss)
        return caption(self.options, index, contact, felt)

    def vision(self, frame: int) -> np.ndarray:
        """Render the photo: uint8, shape (n, n, 3)."""
        state, index = self.state(frame), self.plan.index
        number = self.plan.object_index[state.contact]
        if number not in self._scenes:
            body = self.object_of(state.contact)
            self._scenes[number] = light_object(self.options, self.camera, body, index, number)
        image = photo(self.options, self.camera, self._scenes[number], state, (index, frame))
        return to_bytes(image)

    def tactile(self, frame: int) -> np.ndarray:
        """Render the tactile image: uint8, shape (n, n, 3)."""
        state, sensor, image = self.state(frame), self.sensor, self._passive
        if state.in_contact:
            membrane = self.membrane(state)[0]
            shift = marker_shift(sensor, membrane, state.shear) if sensor.ink is not None else None
            image = shade(sensor, membrane, self.gain, shift)
        rng = self.options.rng("noise", self.plan.index, frame)
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        return to_bytes(image + noise * np.float32(sensor.noise))

    def membrane(self, state: State) -> tuple[Array, Array]:
        """Press: displacement of the gel in mm and contact mask, both (n, n)."""
        body = self.object_of(state.contact)
        gap = gap_of(body, self.sensor, self.relief(state), state.load, state.tilt)
        return press(self.sensor, gap, state.load * (1.0 - 0.3 * body.surface.softness))

    def relief(self, state: State) -> Array:
        """Return the object's relief under the pad in mm, (n, n)."""
        body = self.object_of(state.contact)
        y, x = grid(self.options.size)
        half = PAD_MM / 2.0 / body.px
        c, s = float(np.cos(state.rotation)) * half, float(np.sin(state.rotation)) * half
        rows = s * x + c * y + state.place[1] / body.px
        columns = c * x - s * y + state.place[0] / body.px
        return sample_periodic(body.surface.height, rows, columns)

    def background(self) -> np.ndarray:
        """Render the sensor without contact and without noise: uint8, shape (n, n, 3)."""
        return to_bytes(self._passive)

    def background_of(self, contact: int) -> np.ndarray:
        """Render the background of a contact: the frame 4 before it."""
        return self.tactile(first_contact(self.options, contact) - BACKGROUND_OFFSET)

    @cached_property
    def _passive(self) -> Array:
        flat = np.zeros((self.options.size, self.options.size), np.float32)
        return shade(self.sensor, flat, self.gain)
