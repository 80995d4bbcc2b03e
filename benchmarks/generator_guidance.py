"""What guidance does to the generator that ships, and how far its photos tell the material.

    python benchmarks/generator_guidance.py --materials 10 20
    python benchmarks/generator_guidance.py --guidance guidance=3,high=.7

Worlds and judges are those of ``generator_ablation.py``, whose work folder is used; nothing of the
generator is trained. Prints Markdown: a row for each setting of the sampler (``high``, ``low``: the
times that are guided; ``rescale``: the share of the spread that is pulled back), and the share of
new photos whose material the nearest training photo, and the nearest training text, has.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from generator_ablation import Study, cells, line

from palpate.data.images import cached_images
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.embed import embed

SETTINGS = (
    "guidance=2.5,high=1,rescale=0",
    "guidance=1",
    "guidance=1.5,high=1,rescale=0",
    "guidance=2.5,high=.7,rescale=0",
    "guidance=2.5,high=1,rescale=.7",
    "guidance=4,high=.7,rescale=0",
    "guidance=4,low=.3,high=1,rescale=0",
    "guidance=4,high=1,rescale=.7",
    "guidance=4,high=.8,rescale=.7",
)


def sampler_of(pipeline, setting):
    """The pipeline's sampler with ``name=number`` pairs in place of its own."""
    pairs = (pair.split("=") for pair in setting.split(","))
    return replace(pipeline.sampler, **{name: float(value) for name, value in pairs})


def named_right(study, pipeline):
    """Shares of new photos whose material the nearest training photo, and text, has."""
    labels = np.array([study.names.index(m) for m in study.train.column("material")])

    def unit(samples, modality):
        features = embed(samples, study.encoders, modality, cache=study.cache).features
        return pipeline.denoiser._unit(torch.from_numpy(np.array(features)), modality)

    photos = unit(study.test, "vision")
    for modality in ("vision", "text"):
        nearest = (photos @ unit(study.train, modality).T).argmax(1).numpy()
        yield float((labels[nearest] == study.answers).mean())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--guidance", nargs="+", default=SETTINGS, metavar="NAME=NUMBER,...")
    parser.add_argument("--materials", type=int, nargs="+", default=[10])
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--work", type=Path, default=Path("runs/generator_ablation"))
    chosen = parser.parse_args()
    pipeline = TactilePipeline.from_pretrained("palpate/mini")
    samplers = {setting: sampler_of(pipeline, setting) for setting in chosen.guidance}
    for materials in chosen.materials:
        study = Study(chosen.work / str(materials), materials)
        photo, text = named_right(study, pipeline)
        print(f"\n{materials} materials; nearest photo right {photo:.3f}, text {text:.3f}\n")
        print(line("sampler", "CNN, %", "probe, %", "TMMD"), "\n|---|---|---|---|")
        print(line("real", *cells(study.judged(study.real))))
        size = pipeline.vision_size
        photos = pipeline.embed(cached_images(study.test, "vision", size, study.cache))
        how = {"seed": chosen.seed, "background": study.gels}
        for setting, sampler in samplers.items():
            made = pipeline.sample(photos, study.test.ids, sampler=sampler, **how)
            print(line(setting, *cells(study.judged(made))), flush=True)


if __name__ == "__main__":
    main()
