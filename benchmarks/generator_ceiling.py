"""What survives the autoencoder that ships, on both looks: the ceiling of its generators.

    python benchmarks/generator_ceiling.py

Worlds and judges are those of ``generator_ablation.py``, whose work folder is used, and a DIGIT's
of the same seeds. A small CNN and the linear probe of ``palpate/mini`` saw real images of one world
alone; the refitted probe saw reconstructions of the same images. They judge one image of each video
of another world, on gel units that nothing was trained on: through the autoencoder, with noise on
the latents (shares of their spread), and decoded on the gel of another sample. Writes the page.
"""

import argparse
import platform
from datetime import date
from pathlib import Path

import numpy as np
import torch
from generator_ablation import BASE, MANY, Study, by_video, cells, line, percents

from palpate.core import FeatureSet, rng_for, short
from palpate.diffusion.no_contact import gels_of
from palpate.encoders.embed import embed_images
from palpate.metrics.images import per_image
from palpate.metrics.probe import material_accuracy

NOISES = 0.0, 0.2, 0.5


class Look(Study):
    """The worlds and judges of one look."""

    def __init__(self, work, materials, look):
        self.look = look
        super().__init__(work, materials, "many", MANY)

    def rows(self):
        """Markdown rows of the table."""
        code = self.autoencoder()
        known_gels = gels_of(self.train, BASE.size, self.cache)
        known, real = code.encode(self.images, known_gels), code.encode(self.real, self.gels)
        spread = known.std((0, 2, 3), keepdim=True)
        hit = self.judge.names(np.asarray(self.real)) == self.answers
        whole = self.judged(np.asarray(self.real))
        yield line("real", *cells(whole)[:2], "", "", cells(whole)[-1], "")

        def noisy(latents, noise):
            draw = torch.from_numpy(rng_for(0, "noise").standard_normal(latents.shape))
            return latents + noise * spread * draw.float()

        order = rng_for(0, "gels").permutation(len(self.gels))
        for noise in (*NOISES, None):
            gels = self.gels[order] if noise is None else self.gels
            made = code.decode(noisy(real, noise or 0), gels)
            judged = self.judged(made)
            lost = hit.astype(float) - (self.judge.names(made) == self.answers)
            refitted = psnr = ""
            if noise is not None:
                labels, digest = self.train.column("material"), self.encoders.digest("tactile")
                sets = [
                    FeatureSet(part.ids, embed_images(images, self.encoders), names, groups, digest)
                    for part, images, names, groups in (
                        (self.train, code.decode(noisy(known, noise), known_gels), labels, None),
                        (self.test, made, self.test.column("material"), self.videos),
                    )
                ]
                score = material_accuracy(*sets)
                refitted = f"{100 * score.value:.1f}"
                psnr = f"{per_image('PSNR', made, np.asarray(self.real)).values.mean():.1f}"
            name = "on the gel of another sample (control)"
            name = name if noise is None else f"latent noise {noise:g}" if noise else "through it"
            cnn, probe, *_, far = cells(judged)
            yield line(name, cnn, probe, percents(by_video(lost, self.videos)), refitted, far, psnr)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--materials", type=int, default=20)
    parser.add_argument("--looks", nargs="+", default=["gelsight", "digit"])
    parser.add_argument("--work", type=Path, default=Path("runs/generator_ablation"))
    page = Path(__file__).parents[1] / "docs/studies/generator_ceiling.md"
    parser.add_argument("--page", type=Path, default=page, help="Markdown file to write")
    chosen, parts = parser.parse_args(), []
    for look in chosen.looks:
        name = str(chosen.materials) if look == "gelsight" else f"{chosen.materials} {look}"
        study = Look(chosen.work / name, chosen.materials, look)
        head = ["images", "CNN, %", "probe, %", "CNN loses", "probe refitted, %", "TMMD", "PSNR"]
        rows = "\n".join([line(*head), line(*["---"] * len(head)), *study.rows()])
        parts.append(f"## {look}\n\n{len(study.test)} samples of as many videos.\n\n{rows}\n")
        digest = study.autoencoder().digest
    text = f"""# What survives the autoencoder

Made by a committed command; do not edit by hand. Synthetic: the tables show a mechanism.

    python benchmarks/generator_ceiling.py --materials {chosen.materials}

`palpate/mini`'s autoencoder (digest {short(digest)}) on new objects, videos and gel units of the
world of seed 65. A small CNN and the linear probe of `palpate/mini` saw real images of the world of
seed 61 alone; the refitted probe saw reconstructions of these, with the row's noise. Noise is in
shares of the latents' spread, of noise seed 0. Intervals: 95 % over videos; what the CNN loses is
paired by image, in points. TMMD (grouped) is to the real images of the same samples.
{platform.machine()}, CPU; {date.today()}.

{chr(10).join(parts)}"""
    chosen.page.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
