"""An overview image of a world: a row for each material, three objects of each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, PngImagePlugin

from palpate.core import atomic_path
from palpate.sim.materials import MATERIALS
from palpate.sim.options import WorldOptions
from palpate.sim.plan import ObjectRef, VideoPlan, first_contact
from palpate.sim.video import Video

SHOWN = 3
_LABEL = 104


def render_sheet(options: WorldOptions, path: str | Path) -> None:
    """Write a PNG, two materials side by side: three objects of each in the middle of a contact.

    The objects are the world's (the first three of each material); their videos are drawn for the
    sheet.

    Raises:
        PalpateError: if the path cannot be written.
    """
    size, names = options.size, options.names
    rows = (len(names) + 1) // 2
    width = _LABEL + 2 * SHOWN * size
    sheet = Image.new("RGB", (width * min(2, len(names)), rows * size), "white")
    draw = ImageDraw.Draw(sheet)
    frame = first_contact(options, 0) + options.frames_per_contact // 2
    for k, name in enumerate(names):
        left, top = k // rows * width, k % rows * size
        draw.text((left + 4, top + size // 2 - 6), f"{MATERIALS[name].label} {name}", fill="black")
        for number in range(SHOWN):
            index, unit = 10**6 + SHOWN * k + number, number % options.sensors
            which = (0,) * options.contacts_per_video
            plan = VideoPlan(index, "sheet", unit, (ObjectRef(name, number),), which)
            video = Video(options, plan)
            pair = np.concatenate([video.vision(frame), video.tactile(frame)], 1)
            sheet.paste(Image.fromarray(pair), (left + _LABEL + 2 * number * size, top))
    about = PngImagePlugin.PngInfo()
    about.add_text("Software", "palpate")
    with atomic_path(Path(path)) as part:
        sheet.save(part, "PNG", pnginfo=about)
