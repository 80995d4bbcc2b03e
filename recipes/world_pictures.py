"""Draws the pictures of ``docs/concepts/world.md``.

    python recipes/world_pictures.py -o docs/images

Everything is rendered from fixed seeds; nothing is painted. A picture is a :class:`Board`: panels of pixels with labels between them. Colored panels are rounded
to multiples of :data:`STEP` (at most STEP / 2 = 2 of 255 off), which halves the size of the files, since the noise of a sensor does not compress.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from palpate.core import atomic_path, rng_for
from palpate.sim import MATERIALS, Tile, Video, WorldOptions
from palpate.sim.arrays import f32, resample, smoothstep, to_bytes
from palpate.sim.gel import gap_of, shade, solve_approach
from palpate.sim.motion import State
from palpate.sim.objects import make_object
from palpate.sim.plan import ObjectRef, VideoPlan, first_contact

Look: TypeAlias = Literal["gelsight", "digit"]
#: Gray levels that the stored colored panels are multiples of.
STEP = 4
#: Pixels of a line of text, and between a label and its panel.
LINE, ROOM = 16, 2
GAP = 6


class Board:
    """A white picture with panels and labels.

    Attributes:
        panels: (left, top, pixels): uint8 arrays (h, w, 3), not rounded.
        labels: (left, top, text).
    """

    def __init__(self) -> None:
        self.panels: list[tuple[int, int, np.ndarray]] = []
        self.labels: list[tuple[int, int, str]] = []

    def panel(self, left: int, top: int, pixels: np.ndarray, label: str = "") -> None:
        """Adds a panel, with its label on the lines above it."""
        self.panels.append((left, top, pixels))
        for k, line in enumerate(reversed(label.split("\n") if label else [])):
            self.labels.append((left, top - LINE * (k + 1) - ROOM, line))

    def row(
        self, left: int, top: int, panels: Sequence[np.ndarray], labels: Sequence[str] = ()
    ) -> None:
        """Panels of one size from left to right."""
        for k, pixels in enumerate(panels):
            self.panel(left + k * (pixels.shape[1] + GAP), top, pixels, labels[k] if labels else "")

    def image(self) -> Image.Image:
        """The whole picture; its colored panels are rounded to multiples of :data:`STEP`."""
        font = ImageFont.load_default(12.5)
        right = max(left + p.shape[1] for left, _, p in self.panels)
        right = max(
            [right, *(int(left + font.getlength(text)) + 1 for left, _, text in self.labels)]
        )
        bottom = max(
            [
                *(top + p.shape[0] for _, top, p in self.panels),
                *(top + LINE for _, top, _ in self.labels),
            ]
        )
        picture = Image.new("RGB", (right + GAP, bottom + GAP), "white")
        draw = ImageDraw.Draw(picture)
        for left, top, text in self.labels:
            draw.text((left, top), text, fill="black", font=font)
        for left, top, pixels in self.panels:
            colored = bool((pixels != pixels[..., :1]).any())
            rounded = np.minimum((pixels.astype(np.int32) + STEP // 2) // STEP * STEP, 255).astype(
                np.uint8
            )
            picture.paste(Image.fromarray(rounded if colored else pixels), (left, top))
        return picture


def gray(field: np.ndarray, low: float | None = None, high: float | None = None) -> np.ndarray:
    """A field (n, n) as gray levels from black (``low``, default the smallest) to white (``high``)."""
    low, high = (
        float(field.min()) if low is None else low,
        float(field.max()) if high is None else high,
    )
    return to_bytes(np.repeat(((f32(field) - low) / (high - low or 1.0))[..., None], 3, -1))


def signed(contact: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Contact minus background around middle gray."""
    return np.clip(contact.astype(np.int32) - background + 128, 0, 255).astype(np.uint8)


def small(image: np.ndarray, size: int) -> np.ndarray:
    """A square image (n, n, 3) as (size, size, 3)."""
    return to_bytes(resample(f32(image) / 255.0, size))


def video_of(options: WorldOptions, ref: ObjectRef, index: int, sensor: int = 0) -> Video:
    """A video of the pictures' own of one object of the world."""
    return Video(
        options, VideoPlan(index, "picture", sensor, (ref,), (0,) * options.contacts_per_video)
    )


@cache
def first_of(options: WorldOptions, material: str, subtype: str) -> ObjectRef:
    """The first object of the material that is of the sub-type."""
    number = 0
    while make_object(options, ObjectRef(material, number)).surface.subtype != subtype:
        number += 1
    return ObjectRef(material, number)


def sheet(look: Look, names: Sequence[str]) -> Board:
    """Photo and touch in the middle of a contact; object 0 of each material, not chosen. Rendered at 128 px, shown at 96."""
    options, board, shown = WorldOptions(size=128, tile=512, look=look), Board(), 96
    frame = first_contact(options, 0) + options.frames_per_contact // 2
    for k, name in enumerate(names):
        video = video_of(options, ObjectRef(name, 0), 10**6 + k, k % options.sensors)
        left, top = (
            GAP + k % 5 * (2 * shown + 3 * GAP),
            GAP + LINE + k // 5 * (shown + LINE + 2 * GAP),
        )
        pair = np.concatenate(
            [small(video.vision(frame), shown), small(video.tactile(frame), shown)], 1
        )
        board.panel(left, top, pair, f"{name} ({video.object_of(0).surface.subtype})")
    return board


def toolbox() -> Board:
    """Fields of the tile toolbox, a quarter of the tile (32 x 32 mm) each."""
    rng = rng_for(0, "picture of the toolbox")
    tile = Tile(256, rng)
    cells, (stones, _), blades = (
        tile.cells(6.0),
        tile.grains(5.0),
        tile.strokes(250, 25.0, 2.0, angle=0.8, spread=0.5, height=1.0),
    )
    noise = tile.noise(0.6, 20.0)
    u, v = tile.wave(5.0, 0.0), tile.wave(5.0, np.pi / 2)
    over = smoothstep(np.sin(u) * np.sin(v), -0.35, 0.35)
    fields = {
        "noise, 0.6 .. 20 mm": noise,
        "noise, stretched 12 x": tile.noise(0.5, 20.0, 2.0, 12.0, 0.5),
        "ridged noise": tile.ridged(0.8, 20.0),
        "cells: F1": cells.near,
        "cells: F2 - F1": cells.far - cells.near,
        "the same, warped": tile.warp(cells.far - cells.near, 1.2),
        "packed grains": stones,
        "strokes": blades,
        "wave, wobbling": np.sin(tile.wave(5.0, 0.5, 0.4)),
        "plain weave": over * np.abs(np.sin(u)) ** 0.7 + (1.0 - over) * np.abs(np.sin(v)) ** 0.7,
    }
    board = Board()
    for k, (name, field) in enumerate(fields.items()):
        board.panel(
            GAP + k % 5 * (128 + 2 * GAP),
            GAP + LINE + k // 5 * (128 + LINE + GAP),
            gray(field[:128, :128]),
            name,
        )
    return board


def _outlined(photo: np.ndarray, video: Video, state: State) -> np.ndarray:
    """The photo with the pad at this state, its upper edge red; perspective and sway are left out, so the outline is nearly right."""
    size, image = photo.shape[0], Image.fromarray(photo)
    reach = video.options.pad_mm / video.camera.view * size / 2.0
    angle = state.rotation - video.camera.turn
    c, s = np.cos(angle) * reach, np.sin(angle) * reach
    corners = [
        (size / 2 + c * x - s * y, size / 2 + s * x + c * y)
        for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    draw = ImageDraw.Draw(image)
    draw.polygon(corners, outline="white")
    draw.line(corners[:2], fill=(255, 40, 40), width=2)
    return np.asarray(image)


def steps(look: Look = "gelsight") -> Board:
    """One touch of a tread plate, from the photo to the image of the gel."""
    options = WorldOptions(
        size=160, tile=512, look=look, hand=0.0, edge=0.0, shadow=0.0, stains=0.0
    )
    video = video_of(options, first_of(options, "Metal", "tread plate"), 2)
    frame = first_contact(options, 0) + 1
    state, sensor, thing = video.state(frame), video.sensor, video.object_of(0)
    relief = video.relief(state)
    load = state.load * (1.0 - 0.3 * thing.surface.softness)
    gap = gap_of(thing, sensor, relief, state.load, state.tilt)
    held = np.maximum(gap + solve_approach(gap, load), 0.0)
    membrane, contact = video.membrane(state)
    plain = dataclasses.replace(sensor, ink=None)
    white = f32([1.0, 1.0, 1.0])
    lights = []
    for k in range(3):
        one = f32(np.eye(3)[k])[:, None] * plain.color
        lights.append(
            to_bytes(
                shade(
                    dataclasses.replace(plain, color=one, ambient=f32([0.0] * 3)), membrane, white
                )
            )
        )
    final, background = video.tactile(frame), video.background()
    deepest = float(held.max())
    board = Board()
    board.row(
        GAP,
        GAP + 2 * LINE,
        [
            _outlined(video.vision(frame), video, state),
            gray(relief),
            gray(gap),
            gray(held, 0.0, deepest),
            gray(contact, 0.0, 1.0),
            gray(membrane, 0.0, deepest),
        ],
        [
            f"1 photo, {video.camera.view:.0f} mm wide,\npad {options.pad_mm:g} mm, red: its top",
            f"2 relief under the pad,\n{float(np.ptp(relief)):.2f} mm from low to high",
            "3 gap g: relief less dome,\ntilt and curvature",
            f"4 penetration p, mm:\nmean {load:.2f}, most {deepest:.2f}",
            f"5 contact p > 0,\n{100 * float(contact.mean()):.0f} % of the pad",
            "6 membrane m,\nthe scale of 4",
        ],
    )
    board.row(
        GAP,
        GAP + 160 + GAP + 4 * LINE,
        [*lights, final, background, signed(final, background)],
        [
            "7 green light alone,\nno markers",
            "8 blue light alone",
            "9 red light alone",
            "10 the sum, with markers\nand noise",
            "11 background: the same\nformula with m = 0",
            "12 contact minus\nbackground (gray: equal)",
        ],
    )
    return board


def motion() -> Board:
    """One touch in time: the way down, then press, hold, slide, lift, above the load of each frame."""
    options = WorldOptions(
        size=128,
        tile=512,
        frames_per_contact=7,
        contacts_per_video=1,
        slide_mm=(5.0,),
        load_mm=(0.3, 0.3),
        hand=0.95,
    )
    video = video_of(options, first_of(options, "Gravel", "rounded"), 4)
    first, shown = first_contact(options, 0), 96
    frames = [
        first - options.free_frames,
        first - 2,
        first - 1,
        *range(first, options.video_length),
    ]
    board = Board()
    board.row(
        GAP,
        GAP + LINE,
        [small(video.vision(f), shown) for f in frames],
        [f"frame {f}" for f in frames],
    )
    board.row(GAP, GAP + LINE + shown + GAP, [small(video.tactile(f), shown) for f in frames])
    top, bars, highest = GAP + LINE + 2 * (shown + GAP) + LINE, 60, 0.35
    for k, f in enumerate(frames):
        load, bar = video.state(f).load, np.full((bars, shown, 3), 255, np.uint8)
        bar[bars - 1 - round(load / highest * (bars - 1)) :, 28:68] = (90, 110, 160)
        bar[-1] = 0
        board.panel(GAP + k * (shown + GAP), top, bar, f"load {load:.2f} mm" if load else "free")
    return board


def units() -> Board:
    """One contact on three units of both families: backgrounds, touches, and their differences."""
    board = Board()
    looks: tuple[Look, ...] = ("gelsight", "digit")
    for row, look in enumerate(looks):
        options = WorldOptions(size=128, tile=512, look=look, load_mm=(0.25, 0.25), tilt=0.02)
        frame = first_contact(options, 0) + 1
        videos = [
            video_of(options, first_of(options, "Tree", "plated"), 7, unit) for unit in range(3)
        ]
        for column, video in enumerate(videos):
            images = [
                video.background(),
                video.tactile(frame),
                signed(video.tactile(frame), video.background()),
            ]
            labels = [f"{look} {column}: empty", "touch", "difference"]
            board.row(
                GAP + column * (3 * 104 + 4 * GAP),
                GAP + LINE + row * (104 + LINE + 2 * GAP),
                [small(i, 104) for i in images],
                labels,
            )
    return board


def subtypes(material: str = "Metal") -> Board:
    """A photo and a touch of each sub-type of a material."""
    options = WorldOptions(size=128, tile=512, load_mm=(0.25, 0.25), hand=0.0, edge=0.0, curved=0.0)
    frame, board = first_contact(options, 0) + 1, Board()
    for k, kind in enumerate(MATERIALS[material].subtypes):
        video = video_of(options, first_of(options, material, kind), 20 + k)
        images = [video.vision(frame), video.tactile(frame)]
        left = GAP + k * (128 + 4 * GAP)
        board.panel(left, GAP + 2 * LINE, images[0], kind)
        board.panel(left, GAP + 2 * LINE + 128 + GAP, images[1])
    return board


def hard() -> Board:
    """The same six videos at hard 0, 0.5 and 1."""
    board, things = Board(), ("Brick", "Synthetic Fabric", "Wood", "Grass", "Tile", "Leather")
    for row, value in enumerate((0.0, 0.5, 1.0)):
        options = WorldOptions(size=128, tile=512, hard=value)
        frame = first_contact(options, 1) + 1
        images = [
            small(video_of(options, ObjectRef(name, 1), 60 + k).vision(frame), 104)
            for k, name in enumerate(things)
        ]
        board.row(70, GAP + LINE + row * (104 + GAP), images, things if row == 0 else ())
        board.labels.append((GAP, GAP + LINE + row * (104 + GAP) + 44, f"hard {value:g}"))
    return board


#: File name -> how it is drawn.
PICTURES: dict[str, Callable[[], Board]] = {
    "world_gelsight_1.png": partial(sheet, "gelsight", tuple(MATERIALS)[:10]),
    "world_gelsight_2.png": partial(sheet, "gelsight", tuple(MATERIALS)[10:]),
    "world_digit_1.png": partial(sheet, "digit", tuple(MATERIALS)[:10]),
    "world_digit_2.png": partial(sheet, "digit", tuple(MATERIALS)[10:]),
    "world_toolbox.png": toolbox,
    "world_steps.png": steps,
    "world_motion.png": motion,
    "world_units.png": units,
    "world_subtypes.png": subtypes,
    "world_hard.png": hard,
}


def main() -> int:
    """Draws all pictures, or those named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument(
        "--only", nargs="*", choices=list(PICTURES), default=list(PICTURES), metavar="NAME"
    )
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        image = PICTURES[name]().image()
        with atomic_path(options.output / name) as part:
            image.save(part, "PNG", optimize=True)
        sys.stdout.write(
            f"{name}: {image.width} x {image.height}, {(options.output / name).stat().st_size / 1000:.0f} kB\n"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
