"""Sheets for the eye: real and generated tactile images by material, the contact amplified.

    python benchmarks/generator_sheet.py --write docs/images/generated.jpg
    python benchmarks/generator_sheet.py --blind runs/blind       # to be sorted by somebody
    python benchmarks/generator_sheet.py --blind runs/blind \\
        --answers docs/studies/generator_blind.json

New objects, videos and gel units of a world that no shipped model has seen. ``--blind`` writes
``examples-*.png``, a strip of real images for each material by name, of other objects, and
``sort-*.png``, five generated images of each material, numbered in random order; whoever sorts
them writes ``{"1": "Wood", ...}`` and sees nothing else. With the answers, ``{"who": {"1": ...}}``,
the number of materials above chance is printed: at least two of five right, which guessing reaches
for one material in forty. With ``--real`` the images to be sorted are the real ones of the same
samples: what an eye can tell.
"""

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from palpate.core import rng_for
from palpate.data.images import load_images
from palpate.data.manifest import Manifest
from palpate.diffusion.generation import generate
from palpate.diffusion.pipeline import TactilePipeline
from palpate.sim import PRESETS, write_world

WORLD = replace(
    PRESETS["pretrain"],
    seed=63,
    objects_per_material=10,
    contacts_per_video=2,
    frames_per_contact=1,
    sensors=1,
)
EACH = 5  # images of a material, of as many videos
SIDE = 96
LARGE = 144  # side of an image that is to be sorted
PER_PAGE = 50  # images of one page
AMPLIFIED = 3.0


def amplified(images, gels):
    """The difference to the gel, `AMPLIFIED` times, on gray: bytes (n, h, w, 3)."""
    change = np.asarray(images, float) - np.asarray(gels, float)
    return (128 + AMPLIFIED * change).clip(0, 255).astype(np.uint8)


def picked(world):
    """Material -> ids of its first videos, one each, and of the other videos, for the examples."""
    first = world.table.group_by("material", "video", maintain_order=True).agg("id")
    table = {}
    for material, _, ids in first.iter_rows():
        table.setdefault(material, []).append(ids[0])
    names = sorted(table)
    return {m: table[m][:EACH] for m in names}, {m: table[m][EACH:] for m in names}


def sheet(rows, names, side=SIDE):
    """Rows of images of one size, each with its name at the left."""
    font = ImageFont.load_default(14)
    width = max(len(images) for images in rows)
    page = Image.new("RGB", (150 + side * width, side * len(rows)), "white")
    draw = ImageDraw.Draw(page)
    for k, (name, images) in enumerate(zip(names, rows, strict=True)):
        draw.text((6, side * k + side // 2 - 8), str(name), "black", font=font)
        for j, image in enumerate(images):
            page.paste(Image.fromarray(image).resize((side, side)), (150 + side * j, side * k))
    return page


def numbered(images, first, columns=10):
    """All images with their numbers, from ``first`` on."""
    font = ImageFont.load_default(14)
    lines = -(-len(images) // columns)
    page = Image.new("RGB", (columns * (LARGE + 8), lines * (LARGE + 24)), "white")
    draw = ImageDraw.Draw(page)
    for k, image in enumerate(images):
        left, top = (k % columns) * (LARGE + 8), (k // columns) * (LARGE + 24)
        draw.text((left + 4, top + 2), str(first + k), "black", font=font)
        page.paste(Image.fromarray(image).resize((LARGE, LARGE)), (left, top + 20))
    return page


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="palpate/mini")
    parser.add_argument("--write", type=Path, help="image of real and generated rows")
    parser.add_argument("--blind", type=Path, help="folder for the sheets to be sorted")
    parser.add_argument("--real", action="store_true", help="sort real images, as a control")
    parser.add_argument("--answers", type=Path, help="JSON: sorting -> number -> material")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        size = TactilePipeline.from_pretrained(chosen.model).size
        write_world(Path(folder) / "tree", replace(WORLD, size=size, tile=4 * size), workers=2)
        world = Manifest.load(Path(folder) / "tree")
        ids, others = picked(world)
        flat = [i for row in ids.values() for i in row]
        pixels = lambda names, column: load_images(world.take(names).paths(column), size)
        made = np.stack(
            [np.asarray(i) for i in generate(world.take(flat), model=chosen.model).images]
        )
        made = amplified(made, pixels(flat, "background"))
        real = amplified(pixels(flat, "tactile"), pixels(flat, "background"))
        shown = {
            m: amplified(*(pixels(o, c) for c in ("tactile", "background")))
            for m, o in others.items()
        }
    labels = [m for m, row in ids.items() for _ in row]
    if chosen.write:
        by = {m: [k for k, name in enumerate(labels) if name == m] for m in ids}
        rows = [np.concatenate([real[k], made[k]]) for k in by.values()]
        sheet(rows, by).save(chosen.write)
    if chosen.blind:
        order = rng_for(0, "blind").permutation(len(made))
        key = {str(k + 1): labels[i] for k, i in enumerate(order)}
        chosen.blind.mkdir(parents=True, exist_ok=True)
        sorted_ones, names, half = (real if chosen.real else made)[order], list(ids), len(ids) // 2
        for page, part in enumerate((names[:half], names[half:]), 1):
            strips = sheet([shown[m][:8] for m in part], part, LARGE)
            strips.save(chosen.blind / f"examples-{page}.png")
        for page, at in enumerate(range(0, len(made), PER_PAGE), 1):
            numbers = numbered(sorted_ones[at : at + PER_PAGE], at + 1)
            numbers.save(chosen.blind / f"sort-{page}.png")
        sortings = json.loads(chosen.answers.read_text()) if chosen.answers else {}
        for name, answers in sortings.items():
            right = {m: sum(answers.get(k) == m == v for k, v in key.items()) for m in ids}
            above = sum(n >= 2 for n in right.values())
            total = f"{sum(right.values())} of {len(key)} right"
            print(f"{name}: {total}; {above} materials above chance; {right}")


if __name__ == "__main__":
    main()
