"""A contact sheet of a world, for people: a row a material, three objects, photo beside touch."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from palpate.core import PalpateError, atomic_path
from palpate.sim.materials import MATERIALS
from palpate.sim.options import WorldOptions
from palpate.sim.plan import ObjectRef, VideoPlan, first_contact
from palpate.sim.video import Video

SHOWN = 3
_LABEL = 104


def require_sheet_path(path: Path, world: Path) -> None:
    """Refuses a path that no sheet could be written to, before a world is rendered.

    Args:
        path: of the sheet.
        world: the folder of the world.

    Raises:
        PalpateError: if it is a folder or will be one, or its place is a file or may not be written to.
    """
    path, fix = Path(path), "Name a file such as sheet.png"
    if path.is_dir() or path.absolute() == Path(world).absolute():
        raise PalpateError(f"The contact sheet {path} must be a file", "a folder", fix)
    place = next(p for p in path.absolute().parents if p.exists())
    if not place.is_dir():
        raise PalpateError(
            f"The contact sheet {path} must lie in a folder", f"the file {place}", fix
        )
    if not os.access(place, os.W_OK | os.X_OK):
        raise PalpateError(
            f"The folder of the contact sheet {path} must be writable",
            f"no right to write to {place}",
            "Choose another path",
        )


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
