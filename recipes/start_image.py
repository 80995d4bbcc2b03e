"""Draw the image of the start page: photos, the sensor's images, the generator's images.

    python recipes/start_image.py -o docs/images/start.png     # 20 CPU seconds

The samples are of a world that the shipped models were not trained on; the first object of each
material, not chosen.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

import palpate as pp
from palpate.core import atomic_path
from palpate.sim import WorldOptions

MATERIALS = ("Brick", "Grass", "Leather", "Metal", "Gravel", "Natural Fabric", "Tree", "Wood")
#: Side of a shown image, and the space between images, in pixels.
SIDE, SPACE = 96, 6


def draw(seed: int = 3) -> Image.Image:
    """Three rows (photo, sensor, generator), a column a material."""
    options = WorldOptions(seed=seed, materials=MATERIALS, objects_per_material=1, mixed=0.0)
    world = pp.World(options)
    first = {sample["material"]: k for k, sample in reversed(list(enumerate(world)))}
    samples = [world[first[name] + 1] for name in MATERIALS]  # the middle of the contact
    pipeline = pp.TactilePipeline.from_pretrained("palpate/mini")
    made = pipeline([sample["vision"] for sample in samples], seed=0).images
    rows = [[s["vision"] for s in samples], [s["tactile"] for s in samples], made]
    size = (len(MATERIALS) * (SIDE + SPACE) - SPACE, len(rows) * (SIDE + SPACE) - SPACE)
    board = Image.new("RGB", size, "white")
    for y, row in enumerate(rows):
        for x, image in enumerate(row):
            tile = image if isinstance(image, Image.Image) else Image.fromarray(np.asarray(image))
            tile = tile.resize((SIDE, SIDE), Image.Resampling.BICUBIC)
            board.paste(tile, (x * (SIDE + SPACE), y * (SIDE + SPACE)))
    return board


def run() -> None:
    """Draw into the file that was named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    with atomic_path(options.output) as part:
        draw().save(part, "PNG", optimize=True)


if __name__ == "__main__":
    run()
