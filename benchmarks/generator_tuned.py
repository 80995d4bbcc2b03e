"""The shipped generator, fine-tuned on the materials at hand: how near it comes to real touches.

    python benchmarks/generator_tuned.py --materials 10 --seeds 0 1 2

What a user does with ``palpate train generator --start palpate/mini``: the U-Net goes on, and the
memory holds the captions and photos of the new data alone. Trained on one world, judged on new
objects, videos and gel units of another, by a CNN that saw real images of a third (those of
``generator_goals.py``, whose work folder is used). A seed is of one training and of its noise.
Captions are of what is felt, as the world writes them, or coded from the material, as palpate does
for data without texts. A training that was stopped goes on, and a measurement that is on record is
not made again.
"""

import argparse
import platform
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

from generator_ablation import BFLOAT, MANY, Line, Study
from generator_goals import DRIVES, NAME, Goals

from palpate.core import digest_json, short
from palpate.core.digest import facts
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import MINI
from palpate.diffusion.training import train_generator

ROWS = "by photo", "by photo, on gels of its training", "by photo and caption"
PRESET = replace(MINI, loop=replace(MINI.loop, batch=32, warmup=100))


CAPTIONS = {"felt": "Captions of what is felt", "label": "Captions coded from the material"}


def without_texts(manifest):
    """The same samples; their captions are then made from the material."""
    return replace(manifest, table=manifest.table.with_columns(text=None))


def tuned(study, world, start, seed, steps):
    """The generator of one training, from its folder if it is there."""
    made_by = [start.digest, world.digest, facts(PRESET), seed, steps]
    folder = study.work / f"tuned-{short(digest_json(made_by))}"
    if not (folder / "model_index.json").is_file():
        how = {"preset": PRESET, "start": start, "steps": steps, "seed": seed, "output": folder}
        train_generator(world, study.everything_of(world), **how, compute=BFLOAT, progress=Line())
    return TactilePipeline.from_pretrained(folder)


def page(parts, day, chosen, start):
    materials, seeds = (" ".join(map(str, rows)) for rows in (chosen.materials, chosen.seeds))
    command = f"generator_tuned.py --materials {materials} --seeds {seeds} --steps {chosen.steps}"
    command += f" --captions {' '.join(chosen.captions)}"
    return f"""# The shipped generator, fine-tuned

Made by a committed command; do not edit by hand. Synthetic: the tables show a mechanism.

    python benchmarks/{command}

`{NAME}` (digest {short(start)}) goes on for {chosen.steps:,} steps of {PRESET.loop.batch}
on a world of the named materials alone (seed 64), as
`palpate train generator --start {NAME} --steps {chosen.steps} --batch-size {PRESET.loop.batch}
--warmup {PRESET.loop.warmup} --precision bf16` does; a seed is of one training
and of its noise. Judged on new objects, videos and gel units of another world (seed 65), one image
of each video, by a small CNN that saw real images of a third (seed 61), and by the linear probe of
`{NAME}`, fitted on that third. Nothing was chosen on these numbers: preset, steps and seeds were
set before. Intervals: 95 % over videos, of the seeds' mean image by image: how trainings differ is
not in them. What one is ahead of another is paired by image, in points of the CNN. TMMD (grouped)
is to the real images of the same samples, with the mean of the seeds' limits. Captions, of training
and test, are those that the world writes of what is felt, or coded from the material.
{platform.machine()}, CPU, bf16; {day}.

{chr(10).join(parts)}"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--materials", type=int, nargs="+", default=[10])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--captions", nargs="+", choices=[*CAPTIONS], default=[*CAPTIONS])
    parser.add_argument("--steps", type=int, default=500, help="of 32 images")
    parser.add_argument("--work", type=Path, default=Path("runs/generator_ablation"))
    parser.add_argument(
        "--page",
        type=Path,
        default=Path(__file__).parents[1] / "docs/studies/generator_tuned.md",
        help="Markdown file to write",
    )
    chosen, parts, days = parser.parse_args(), [], []
    start = TactilePipeline.from_pretrained(NAME)
    for materials, captions in product(sorted(chosen.materials), chosen.captions):
        study = Study(chosen.work / str(materials), materials, "many", MANY)
        world = study.world("tuned")
        if captions == "label":
            study.test, world = without_texts(study.test), without_texts(world)
        made_by = start.digest, facts(start.sampler), world.digest, facts(PRESET), chosen.steps
        goals = Goals(study, (world, study.work / "tuned cache"), *made_by)
        goals.measure("real", 0, lambda s=study: s.real)
        goals.measure("real, of the nearest photo of its training", 0, goals.nearest)
        for seed in chosen.seeds:
            goals.take(tuned(study, world, start, seed, chosen.steps))
            for name in ROWS:
                goals.measure(name, seed, partial(goals.generated, seed, **DRIVES[name]))
        days.append(goals.day())
        title = f"## {CAPTIONS[captions]}, "
        parts.append(goals.section(chosen.seeds).replace("## ", title, 1))
    chosen.page.write_text(page(parts, max(days), chosen, start.digest))
    print(chosen.page.read_text())


if __name__ == "__main__":
    main()
