"""The same contacts under another appearance: what a photo shows and touch cannot feel.

``as recorded``; ``other light``: the sun from elsewhere, of other height and strength, another
shadow; ``other white balance``: red and blue of the whole photo gained by 1.35 and 1/1.35, or the
other way round; ``clutter``: four things beside the place of contact. All draws depend on the
world's seed and the video; tactile images, texts and everything else stay as they are.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, get_args

from palpate.core import require_choice
from palpate.sim.arrays import f32, hsv
from palpate.sim.camera import Camera, Thing
from palpate.sim.options import WorldOptions

Appearance = Literal["as recorded", "other light", "other white balance", "clutter"]
APPEARANCES: tuple[Appearance, ...] = get_args(Appearance)
#: Gain of red, and its inverse of blue.
BALANCE = 1.35
#: Half widths of the view that clutter keeps free around the contact: the corner of the pad.
FREE = 0.68


def with_appearance(
    options: WorldOptions, camera: Camera, video: int, appearance: Appearance
) -> Camera:
    """The camera of a video under another appearance.

    Raises:
        PalpateError: for an unknown appearance.
    """
    require_choice("appearance", appearance, APPEARANCES)
    rng = options.rng(appearance, video)
    draw = rng.uniform
    if appearance == "other light":
        elevation = math.radians(draw(*options.elevation_deg))
        turned = math.atan2(camera.sun_to[1], camera.sun_to[0]) + draw(0.5, 1.5) * math.pi
        flat = math.cos(elevation)
        return replace(
            camera,
            sun_to=(math.cos(turned) * flat, math.sin(turned) * flat, math.sin(elevation)),
            sun=draw(0.25, 1.0),
            ambient=draw(0.35, 0.8),
            shadow=(draw(0.0, math.pi), draw(-0.6, 0.6), draw(0.35, 0.75))
            if rng.random() < 0.5
            else None,
        )
    if appearance == "other white balance":
        gain = BALANCE if rng.random() < 0.5 else 1 / BALANCE
        return replace(camera, balance=f32([gain, 1.0, 1 / gain]))
    if appearance == "clutter":
        things: list[Thing] = []
        for _ in range(4):
            away, angle = draw(0.9, 1.2), draw(0.0, 2 * math.pi)
            color = hsv(rng.random(), draw(0.2, 0.9), draw(0.2, 0.9))
            size, box = draw(0.15, away - FREE), bool(rng.random() < 0.5)
            place = (away * math.sin(angle), away * math.cos(angle))
            # The corner of a box is farther from its center than its sides are.
            things.append(Thing(place, size / math.sqrt(2) if box else size, angle, color, box))
        return replace(camera, things=tuple(things))
    return camera
