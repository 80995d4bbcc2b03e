"""Draw the pictures of ``docs/concepts/world.md`` from fixed seeds.

    python recipes/world_pictures.py -o docs/images

Colored panels are rounded to multiples of :data:`STEP` (at most 2 of 255 off), which halves the
size of the files, since the noise of a sensor does not compress.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from palpate.core import atomic_path
from palpate.sim import MATERIALS, Video, WorldOptions
from palpate.sim.arrays import f32, resample, to_bytes
from palpate.sim.gel import solve_approach
from palpate.sim.plan import ObjectRef, VideoPlan, first_contact
from palpate.sim.video import make_object

#: Gray levels that the stored colored panels are multiples of.
STEP = 4
#: Pixels of a line of text, and between panels.
LINE, GAP = 16, 6


class Board:
    """A white picture: panels (left, top, uint8 pixels) and labels (left, top, text)."""

    def __init__(self) -> None:
        self.panels: list[tuple[int, int, np.ndarray]] = []
        self.labels: list[tuple[int, int, str]] = []

    def row(
        self, left: int, top: int, panels: Sequence[np.ndarray], labels: Sequence[str] = ()
    ) -> None:
        """Add panels of one size from left to right, each with its label above."""
        width = panels[0].shape[1] + GAP
        self.panels += [(left + k * width, top, pixels) for k, pixels in enumerate(panels)]
        for k, label in enumerate(labels):
            lines = label.count("\n") + 1
            self.labels.append((left + k * width, top - LINE * lines - 2, label))

    def image(self) -> Image.Image:
        """The whole picture."""
        font = ImageFont.load_default(12.5)
        right = max(left + pixels.shape[1] for left, _, pixels in self.panels)
        bottom = max(top + pixels.shape[0] for _, top, pixels in self.panels)
        picture = Image.new("RGB", (right + GAP, bottom + GAP), "white")
        draw = ImageDraw.Draw(picture)
        for left, top, text in self.labels:
            draw.text((left, top), text, fill="black", font=font)
        for left, top, pixels in self.panels:
            rounded = np.minimum((pixels.astype(int) + STEP // 2) // STEP * STEP, 255)
            colored = (pixels != pixels[..., :1]).any()
            picture.paste(Image.fromarray(np.uint8(rounded if colored else pixels)), (left, top))
        return picture


def gray(field: np.ndarray, low: float, high: float) -> np.ndarray:
    """A field (n, n) as gray levels from black (``low``) to white (``high``)."""
    return to_bytes(np.repeat(((f32(field) - low) / (high - low))[..., None], 3, -1))


def small(image: np.ndarray, size: int) -> np.ndarray:
    """A square image (n, n, 3) as (size, size, 3)."""
    return to_bytes(resample(f32(image) / 255.0, size))


def video_of(options: WorldOptions, ref: ObjectRef, index: int, sensor: int = 0) -> Video:
    """A video of one object of the world."""
    contacts = (0,) * options.contacts_per_video
    return Video(options, VideoPlan(index, "picture", sensor, (ref,), contacts))


def sheet(look: Literal["gelsight", "digit"], names: Sequence[str]) -> Board:
    """Photo and tactile image in the middle of a contact; object 0 of each material."""
    options, board = WorldOptions(size=128, tile=512, look=look, phases="spaced"), Board()
    frame = first_contact(options, 0) + 1
    for k, name in enumerate(names):
        video = video_of(options, ObjectRef(name, 0), 10**6 + k, k % 3)
        pair = [small(image, 96) for image in (video.vision(frame), video.tactile(frame))]
        place = GAP + k % 5 * (2 * 96 + 3 * GAP), GAP + LINE + k // 5 * (96 + LINE + 2 * GAP)
        label = f"{name} ({video.surface(0).subtype})"
        board.row(*place, [np.concatenate(pair, 1)], [label])
    return board


def real() -> Board:
    """Photo and tactile image in scale real; objects 0 and 1 of the five fitted materials."""
    options, board = WorldOptions(size=128, tile=512, scale="real"), Board()
    for k, name in enumerate(("Brick", "Rock", "Wood", "Grass", "Natural Fabric")):
        for j in range(2):
            video = video_of(options, ObjectRef(name, j), 10**6 + 10 * k + j, k % 3)
            frame = first_contact(options, 0) + 1
            pair = [small(image, 96) for image in (video.vision(frame), video.tactile(frame))]
            place = GAP + k * (2 * 96 + 3 * GAP), GAP + LINE + j * (96 + LINE + 2 * GAP)
            label = f"{name}, {video.camera.view:.0f} mm"
            board.row(*place, [np.concatenate(pair, 1)], [label])
    return board


def steps() -> Board:
    """One contact with a tread plate, from the photo to the image of the gel."""
    options, board = WorldOptions(size=128, tile=512, phases="spaced"), Board()
    refs = (ObjectRef("Metal", number) for number in count())
    of_kind = (r for r in refs if make_object(options, r).subtype == "tread plate")
    video, frame = video_of(options, next(of_kind), 2), first_contact(options, 0) + 1
    video.camera.hand = video.camera.edge = video.camera.shadow = None
    state, relief = video.state(frame), video.relief(video.state(frame))
    gap = video.sensor.gap(video.surface(0), relief, state)
    pressed = np.maximum(gap + solve_approach(gap, state.load), 0.0)
    fields = [gray(f, float(f.min()), float(f.max())) for f in (relief, gap)]
    fields += [gray(f, 0.0, float(pressed.max())) for f in (pressed, video.membrane(state)[0])]
    tactile, background = video.tactile(frame), video.background()
    signed = np.clip(tactile.astype(int) - background + 128, 0, 255).astype(np.uint8)
    labels = [
        f"photo, {video.camera.view:.0f} mm;\nthe pad: {video.options.pad_mm:g} mm",
        "relief h\nunder the pad",
    ]
    labels += ["gap g: less dome,\ntilt, curvature", "penetration p", "membrane m,\nas bright as p"]
    labels += ["tactile image", "background:\nm = 0", "difference"]
    panels = [video.vision(frame), *fields, tactile, background, signed]
    board.row(GAP, GAP + 2 * LINE, panels, labels)
    return board


def hard() -> Board:
    """The same six videos at hard 0, 0.5 and 1."""
    board, names = Board(), ("Brick", "Synthetic Fabric", "Wood", "Grass", "Tile", "Leather")
    for row, value in enumerate((0.0, 0.5, 1.0)):
        options, top = (
            WorldOptions(size=128, tile=512, hard=value, phases="spaced"),
            GAP + LINE + row * (104 + GAP),
        )
        videos = [video_of(options, ObjectRef(name, 1), 60 + k) for k, name in enumerate(names)]
        images = [small(v.vision(first_contact(options, 1) + 1), 104) for v in videos]
        board.row(70, top, images, () if row else names)
        board.labels.append((GAP, top + 44, f"hard {value:g}"))
    return board


#: File name -> how it is drawn.
PICTURES: dict[str, Callable[[], Board]] = {
    "world_gelsight_1.png": partial(sheet, "gelsight", tuple(MATERIALS)[:10]),
    "world_gelsight_2.png": partial(sheet, "gelsight", tuple(MATERIALS)[10:]),
    "world_digit_1.png": partial(sheet, "digit", tuple(MATERIALS)[:10]),
    "world_digit_2.png": partial(sheet, "digit", tuple(MATERIALS)[10:]),
    "world_real.png": real,
    "world_steps.png": steps,
    "world_hard.png": hard,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    output = parser.parse_args().output
    for file, picture in PICTURES.items():
        with atomic_path(output / file) as part:
            picture().image().save(part, "PNG", optimize=True)
