"""A video of the world: any of its frames can be rendered alone.

An object is a drawn piece of a material, with the curvature of the body that it covers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from palpate.core import require, rng_for
from palpate.sim.arrays import Array, f32, grid, smooth, to_bytes, window
from palpate.sim.camera import Camera
from palpate.sim.felt import caption, measure
from palpate.sim.gel import make_sensor
from palpate.sim.ground import draw_ground
from palpate.sim.materials import MATERIALS, Material, Surface, draw_surface
from palpate.sim.motion import State, make_contacts, state_at
from palpate.sim.options import BACKGROUND_OFFSET, VERSION, WorldOptions
from palpate.sim.plan import ObjectRef, VideoPlan, first_contact, plan_world

if TYPE_CHECKING:
    from palpate.sim.scans import Scan

#: Share of the objects that are curved, and the range of their radius in mm, log-uniform (of dents
#: 3.3 times as much).
CURVED, RADIUS_MM = 0.4, (25.0, 90.0)


def make_object(options: WorldOptions, ref: ObjectRef) -> Surface:
    """Make the object of that name; it depends on the seed, the name and the tile size alone.

    In scale real every other object is a scan, each scan one object, as long as there are any.
    """
    material = MATERIALS[ref.material]
    if options.scale == "real":
        return _make_ground(options.seed, ref, material, options.tile, _scan_of(options, ref))
    return _make(options.seed, ref, material, options.tile)


def _scan_of(options: WorldOptions, ref: ObjectRef) -> Scan | None:
    scans = [scan for scan in options.scans if scan.material == ref.material]
    if ref.number % 2 == 0 or ref.number // 2 >= len(scans):
        return None
    return scans[options.rng("scans", ref.material).permutation(len(scans))[ref.number // 2]]


@lru_cache(maxsize=6)
def _make_ground(
    seed: int, ref: ObjectRef, material: Material, tile: int, scan: Scan | None
) -> Surface:
    rng = rng_for(seed, "world", VERSION, "object", ref.material, ref.number)
    return draw_ground(
        ref.material, draw_surface(ref.material, material, tile, rng, whole=True), rng, scan
    )


@lru_cache(maxsize=6)
def _make(seed: int, ref: ObjectRef, material: Material, tile: int) -> Surface:
    rng = rng_for(seed, "world", VERSION, "object", ref.material, ref.number)
    surface = draw_surface(ref.material, material, tile, rng)
    curved = rng.random() < CURVED
    bulge = 1.0 if rng.random() < 0.5 else -0.3
    smallest, largest = map(math.log, RADIUS_MM)
    radius = math.exp(rng.uniform(smallest, largest))
    return replace(surface, curvature=bulge / radius if curved else 0.0)


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
            _require_number(plan, len(plans), "A video of this world")
            plan = plans[plan]
        self.options, self.plan = options, plan
        self.sensor = make_sensor(options, plan.sensor)
        self.contacts = make_contacts(options, plan)
        self.camera, self._lit = (
            Camera(options, plan.index),
            dict[int, tuple[Array, float, float]](),
        )
        rng, spread = options.rng("gain", plan.index), 2.0 * options.hard
        balance, exposure = rng.standard_normal(3), rng.standard_normal()
        self.gain: Array = f32(np.exp(0.03 * spread * balance + 0.05 * spread * exposure))

    def state(self, frame: int) -> State:
        """Return the state of the sensor at ``frame``."""
        _require_number(frame, self.options.video_length, f"A frame of {self.plan.name}")
        return state_at(self.options, self.plan, self.contacts, frame)

    def surface(self, contact: int) -> Surface:
        """Return the object of a contact."""
        return make_object(self.options, self.plan.object_of(contact))

    def text(self, contact: int) -> str:
        """Return the caption of a contact."""
        surface = self.surface(contact)
        relief = self.relief(self.state(first_contact(self.options, contact)))
        felt = measure(relief, self.sensor.px, surface.softness, surface.gloss)
        return caption(self.options, self.plan.index, contact, felt)

    def vision(self, frame: int) -> np.ndarray:
        """Render the photo: uint8, shape (n, n, 3)."""
        state = self.state(frame)
        number = self.plan.object_index[state.contact]
        if number not in self._lit:
            self._lit[number] = self.camera.light_object(self.surface(state.contact), number)
        return to_bytes(self.camera.photo(*self._lit[number], state, frame))

    def tactile(self, frame: int) -> np.ndarray:
        """Render the tactile image: uint8, shape (n, n, 3)."""
        state, sensor, image = self.state(frame), self.sensor, self._passive
        if state.in_contact:
            membrane = self.membrane(state)[0]
            shift = sensor.shift(membrane, state.shear) if sensor.ink is not None else None
            image = sensor.shade(membrane, self.gain, shift)
        rng = self.options.rng("noise", self.plan.index, frame)
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        return to_bytes(image + noise * np.float32(sensor.noise))

    def membrane(self, state: State) -> tuple[Array, Array]:
        """Press: displacement of the gel in mm and contact mask, both (n, n)."""
        surface = self.surface(state.contact)
        gap = self.sensor.gap(surface, self.relief(state), state)
        return self.sensor.press(gap, state.load * (1.0 - 0.3 * surface.softness))

    def relief(self, state: State) -> Array:
        """Return the object's relief under the pad in mm, (n, n)."""
        surface = self.surface(state.contact)
        center = state.position[0] / surface.px, state.position[1] / surface.px
        reach = self.sensor.half / surface.px
        pixels = grid(self.options.size)
        relief = window(surface.height, pixels, state.rotation, reach, center)
        if (ground := surface.ground) is None:
            return relief
        center = state.position[0] / ground.px, state.position[1] / ground.px
        coarse = window(ground.height, pixels, state.rotation, self.sensor.half / ground.px, center)
        relief += smooth(coarse, ground.px / self.sensor.px)
        for axis in pixels:  # a hand lays the pad flat
            relief = relief - axis * (float((relief * axis).mean()) / float((axis * axis).mean()))
        return relief

    def background(self) -> np.ndarray:
        """Render the sensor without contact and without noise: uint8, shape (n, n, 3)."""
        return to_bytes(self._passive)

    def background_of(self, contact: int) -> np.ndarray:
        """Render the background of a contact: the frame 4 before it."""
        return self.tactile(first_contact(self.options, contact) - BACKGROUND_OFFSET)

    @cached_property
    def _passive(self) -> Array:
        flat = np.zeros((self.options.size, self.options.size), np.float32)
        return self.sensor.shade(flat, self.gain)


def _require_number(number: int, count: int, name: str) -> None:
    must, fix = f"{name} must be 0 to {count - 1}", "Choose another"
    require(0 <= number < count, None, must, number, fix=fix)
