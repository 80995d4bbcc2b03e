"""Pictures of touches as they are asked for, with the generator that ships.

    python recipes/asked_pictures.py

``docs/images/asked.jpg``: a photo, and its touch at four strengths and shears.
``docs/images/asked_strips.jpg``: each condition alone, all else held.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.requested import Requested
from palpate.sim import World, WorldOptions

IMAGES = Path(__file__).parents[1] / "docs" / "images"
#: Photos and gels of a world that nothing was trained or judged on.
WORLD = WorldOptions(seed=4400, objects_per_material=1, contacts_per_video=1)
MATERIAL, STRIPS_OF = "Brick", "Leather"
SIDE, GAP, LINE = 160, 6, 20
HELD: dict[str, Any] = {"at": (0.5, 0.5), "area": 0.4, "strength": 0.6, "shear": (0.0, 0.0)}
#: Of the README: press, press harder, drag.
STEPS: list[dict[str, Any]] = [
    {"strength": 0.1, "shear": (0.0, 0.0), "area": 0.25},
    {"strength": 0.5, "shear": (0.0, 0.0), "area": 0.45},
    {"strength": 0.9, "shear": (0.0, 0.0), "area": 0.7},
    {"strength": 0.9, "shear": (2.0, 0.0), "area": 0.7},
]
STRIPS: dict[str, list[Any]] = {
    "at": [(0.25, 0.5), (0.5, 0.25), (0.5, 0.5), (0.5, 0.75), (0.75, 0.5)],
    "area": [0.15, 0.3, 0.45, 0.65, 0.85],
    "strength": [0.05, 0.25, 0.5, 0.75, 0.95],
    "shear": [(-2.0, 0.0), (0.0, -2.0), (0.0, 0.0), (0.0, 2.0), (2.0, 0.0)],
    "depth": [0.05, 0.08, 0.11, 0.15, 0.18],
}


def main() -> None:
    """Make both pictures."""
    pipeline, world = TactilePipeline.from_pretrained("palpate/mini"), World(WORLD)
    of = {row.object.material: k for k, row in enumerate(world.rows)}
    photo, touches = made(pipeline, world[of[MATERIAL]], [HELD | step for step in STEPS])
    titles = ["photo"]
    for step in STEPS:
        titles.append(f"strength {step['strength']:g}, shear {step['shear'][0]:g} %")
    sheet([[photo, *touches]], [titles]).save(IMAGES / "asked.jpg", quality=85, optimize=True)
    rows, names = [], []
    for name, values in STRIPS.items():
        held = {k: v for k, v in HELD.items() if (name, k) != ("depth", "strength")}
        photo, touches = made(pipeline, world[of[STRIPS_OF]], [held | {name: v} for v in values])
        rows.append([photo, *touches])
        names.append(["photo", *(f"{name} {_text(v)}" for v in values)])
    sheet(rows, names).save(IMAGES / "asked_strips.jpg", quality=85, optimize=True)


def made(
    pipeline: TactilePipeline, sample: dict[str, Any], asked: list[dict[str, Any]]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A photo, and its touches, which share the noise."""
    photo = pipeline.embed(sample["vision"][None])
    rows = np.stack([Requested(**one).row(pipeline.contact) for one in asked])
    gels = np.broadcast_to(sample["background"], (len(rows), *sample["background"].shape))
    same = photo.expand(len(rows), -1), ["touch"] * len(rows)
    return sample["vision"], pipeline.sample(*same, seed=0, background=gels, touches=rows)


def _text(value: Any) -> str:
    return " ".join(f"{v:g}" for v in value) if isinstance(value, tuple) else f"{value:g}"


def sheet(rows: list[list[NDArray[np.uint8]]], titles: list[list[str]]) -> Image.Image:
    """Images in rows, each under its title."""
    wide, high = SIDE + GAP, SIDE + GAP + LINE
    canvas = Image.new("RGB", (wide * len(rows[0]) - GAP, high * len(rows)), "white")
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(12)
    for r, (images, names) in enumerate(zip(rows, titles, strict=True)):
        for c, (image, name) in enumerate(zip(images, names, strict=True)):
            picture = Image.fromarray(image).resize((SIDE, SIDE), Image.Resampling.BICUBIC)
            draw.text((c * wide + 2, r * high + 2), name, fill="black", font=font)
            canvas.paste(picture, (c * wide, r * high + LINE))
    return canvas


if __name__ == "__main__":
    main()
