"""A contact sheet of a world, for people: a row a material, three objects, photo beside touch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from palpate.core import atomic_path
from palpate.sim.materials import MATERIALS
from palpate.sim.options import WorldOptions
from palpate.sim.plan import ObjectRef, VideoPlan, first_contact
from palpate.sim.video import Video

SHOWN = 3
_LABEL = 104


def render_contact_sheet(options: WorldOptions, path: Path) -> None:
    """Writes a PNG, two materials side by side, for each three objects with photo and touch in the middle of a contact.

    The objects are the world's own (the first three of each material); their videos are drawn for the sheet.
    """
    size, names = options.size, options.names
    rows = (len(names) + 1) // 2
    width = _LABEL + 2 * SHOWN * size
    sheet = Image.new("RGB", (width * min(2, len(names)), rows * size), "white")
    draw = ImageDraw.Draw(sheet)
    frame = first_contact(options, 0) + options.frames_per_touch // 2
    for k, name in enumerate(names):
        left, top = k // rows * width, k % rows * size
        draw.text((left + 4, top + size // 2 - 6), f"{MATERIALS[name].label} {name}", fill="black")
        for number in range(SHOWN):
            plan = VideoPlan(
                10**6 + SHOWN * k + number,
                "contact sheet",
                number % options.sensors,
                (ObjectRef(name, number),),
                (0,) * options.touches_per_video,
            )
            video = Video(options, plan)
            pair = np.concatenate([video.vision(frame), video.tactile(frame)], 1)
            sheet.paste(Image.fromarray(pair), (left + _LABEL + 2 * number * size, top))
    with atomic_path(Path(path)) as part:
        sheet.save(part, "PNG")
