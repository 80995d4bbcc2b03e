"""Train the models that ship with palpate (``palpate/mini``), score them on unseen worlds, and
write their cards.

    python recipes/mini.py --work runs/mini                     # everything
    python recipes/mini.py --work runs/mini --only autoencoder  # one part and what it needs
    python recipes/mini.py --work runs/mini --ship              # and write src/palpate/mini
    python recipes/mini.py --work runs/mini --verify            # score what ships again

Stopped half-way, the same command goes on. Only worlds of the seeds
``palpate.sim.presets.MINI_SEEDS`` are read, which nothing else may use:

=============  ========  =========================================================================
world          seed      read by
=============  ========  =========================================================================
gelsight       900000    every part
digit          900001    the autoencoder alone: the other look of the sensor
photos         900002    the vision encoder alone: 16,000 more objects, one photo of each
new gelsight   900050    scores: new objects, videos and gel units
new digit      900051    scores of the autoencoder
=============  ========  =========================================================================

Weights are rounded to 16 bits before anything is scored, so the scores are those of the shipped
files; what rounding costs is in the cards.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mini_cards import ship, write_page
from mini_scores import score_all

from palpate.core import PalpateError, Split, digest_json, read_json, write_json
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoders import AnyAutoencoder, load_autoencoder
from palpate.diffusion.background_training import train_background_autoencoder
from palpate.diffusion.options import BackgroundOptions, SamplerOptions
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import MINI as DIFFUSION
from palpate.diffusion.training import train_pipeline
from palpate.encoders.contrastive import train_clip, train_tactile
from palpate.encoders.encoder_set import ClipEncoders, EncoderSet, load_clip
from palpate.encoders.models import SHIPPED, shipped_root
from palpate.encoders.presets import EncoderPreset, preset
from palpate.sim import PRESETS, VERSION, WorldOptions, write_world
from palpate.studies.making import fresh
from palpate.studies.stages import Run
from palpate.training.options import Compute

NAME = "palpate/mini"
#: Its table of scores is written from the cards.
PAGE = Path(__file__).parents[1] / "docs" / "concepts" / "mini.md"
SEED = 0
_BASE = replace(PRESETS["pretrain"], contacts_per_video=3, frames_per_contact=2)
WORLDS: dict[str, WorldOptions] = {
    "gelsight": replace(_BASE, seed=900_000, objects_per_material=150, sensors=8),
    "digit": replace(_BASE, seed=900_001, objects_per_material=30, sensors=4, look="digit"),
    "photos": replace(
        _BASE, seed=900_002, objects_per_material=800, contacts_per_video=1, frames_per_contact=1
    ),
    "new gelsight": replace(_BASE, seed=900_050, objects_per_material=10),
    "new digit": replace(_BASE, seed=900_051, objects_per_material=4, look="digit"),
}
ENCODER = preset("mini")
#: Of the vision encoder when it goes on: more rows to tell apart.
VISION = replace(ENCODER, clip_course=replace(ENCODER.clip_course, batch=256, lr=2e-3))
#: Passes over the data. One core sees about 400 images a second in training.
CLIP_EPOCHS, TACTILE_EPOCHS, VISION_EPOCHS = 14.0, 8.0, 20.0
AUTOENCODER = BackgroundOptions(steps=6_000)
GENERATOR = replace(DIFFUSION, loop=replace(DIFFUSION.loop, batch=32, warmup=100))
#: Of a round of the generator's training, and how many rounds: each goes on from the last.
GENERATOR_STEPS, GENERATOR_ROUNDS = 8_000, 2
#: Half the time, on CPUs that have it; the weights then depend on the kind of CPU.
COMPUTE = Compute(precision="bf16")
PARTS = ("worlds", "clip", "encoders", "autoencoder", "generator", "scores")
LIMITS = (
    "Knows only the procedural world of palpate: 20 simulated materials and a simulated gel. "
    "Real photos and real tactile images are out of its range.",
    "Made to show mechanisms and to test code offline; never compare its numbers with those of "
    "real data sets.",
)


def main() -> int:
    """Run the requested parts; exit with 1 if ``--verify`` gives other scores than the cards."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--work",
        type=Path,
        default=Path("runs/mini"),
        help="folder for worlds, checkpoints and results",
    )
    parser.add_argument("--only", choices=PARTS, default="scores", help="the last part to make")
    parser.add_argument(
        "--ship", action="store_true", help="write src/palpate/mini of this checkout"
    )
    parser.add_argument(
        "--verify", action="store_true", help="score the shipped models again instead of training"
    )
    parser.add_argument(
        "--share",
        type=float,
        default=1.0,
        help="share of all training lengths, to try the recipe out (not for shipping)",
    )
    parser.add_argument(
        "--before",
        type=Path,
        help="folder of formerly shipped models whose text and tactile encoder and autoencoder "
        "stay, and whose vision encoder goes on, instead of training these",
    )
    options = parser.parse_args()
    recipe = Recipe(options.work, options.share, options.before)
    try:
        if options.verify:
            return recipe.verify()
        recipe.make(options.only)
        if options.ship:
            recipe.ship()
    except PalpateError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("Stopped; the same command goes on.\n")
        return 130
    return 0


def print_line(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def everything(manifest: Manifest) -> Split:
    """All samples, to train on."""
    rule = {"name": "everything, for the shipped models"}
    return Split.from_ids(train=manifest.ids, rule=rule, manifest=manifest.digest)


def train_round(
    train: Manifest,
    encoders: EncoderSet,
    autoencoder: AnyAutoencoder,
    folder: Path,
    seed: int,
    start: TactilePipeline | None,
    steps: int,
    **how: Any,
) -> TactilePipeline:
    """The generator after a round of training, from random weights or from those of ``start``."""
    parts = train, everything(train), encoders, autoencoder, GENERATOR, folder
    how |= {"seed": seed, "steps": steps, "start": start, "compute": COMPUTE}
    made = train_pipeline(*parts, **how)
    # Nothing is left out of the training: the ceiling is that of the autoencoder's own card.
    return replace(made, training={**made.training, "ceiling": autoencoder.card.get("scores")})


class Recipe:
    """The parts, each a stage of a run folder; a finished stage is read, not made again."""

    def __init__(self, work: Path, share: float, before: Path | None = None) -> None:
        self.run, self.share, self.before = Run(work, print_line), share, before
        self.cache = work / "cache"
        self.shown = 0.0

    def progress(self, what: str, done: int, total: int, remark: str = "") -> None:
        """A line every twentieth of the way."""
        at = done / total if total else 0.0
        if at >= self.shown + 0.05 or at in (0.0, 1.0) or at < self.shown:
            self.shown = at
            print_line(f"  {what}: {done} of {total} {remark}")

    def make(self, last: str) -> None:
        """Makes the parts up to ``last``, leaving out those that it does not need."""
        for name in WORLDS:
            self.world(name)
        wanted = {
            "worlds": (),
            "clip": (self.clip,),
            "encoders": (self.encoders,),
            "autoencoder": (self.autoencoder,),
            "generator": (self.generator,),
            "scores": (self.scores,),
        }[last]
        for part in wanted:
            part()

    def world(self, name: str) -> Manifest:
        """The samples of a world."""
        options = WORLDS[name]

        def build(folder: Path) -> Mapping[str, Any]:
            record = write_world(
                folder / "tree",
                options,
                workers=len(os.sched_getaffinity(0)),
                progress=self.progress,
            )
            return {
                "digest": record.digest,
                "frames": record.counts["contact_frames"],
                "videos": record.counts["videos"],
            }

        stage = self.run.stage(f"world {name}", {"options": options.digest}, build)
        return Manifest.load(stage.folder / "tree")

    def clip(self) -> Path:
        """Vision and text, by contrast of photos and captions."""
        train = self.world("gelsight")
        epochs = CLIP_EPOCHS * self.share

        def build(folder: Path) -> Mapping[str, Any]:
            clip = self._pair(train, ENCODER, folder, epochs)
            clip.save(fresh(folder / "clip"))
            return {"vision": clip.digest("vision"), "text": clip.digest("text")}

        stage = self.run.stage(
            "clip",
            {"preset": ENCODER, "epochs": epochs, "seed": SEED, "train": train.digest},
            build,
        )
        return stage.folder / "clip"

    def _pair(
        self, train: Manifest, preset: EncoderPreset, folder: Path, epochs: float, **how: Any
    ) -> ClipEncoders:
        how |= {"seed": SEED, "cache": self.cache, "progress": self.progress}
        part = everything(train)
        return train_clip(train, part, preset, folder / "training", epochs=epochs, **how)

    def tactile(self) -> EncoderSet:
        """The pair and a tactile encoder that learns from it."""
        if self.before:
            return EncoderSet.load(self.before / "encoders")
        clip, train = self.clip(), self.world("gelsight")
        epochs = TACTILE_EPOCHS * self.share

        def build(folder: Path) -> Mapping[str, Any]:
            encoders = train_tactile(
                train,
                everything(train),
                load_clip(clip),
                ENCODER,
                folder / "training",
                epochs=epochs,
                seed=SEED,
                cache=self.cache,
                progress=self.progress,
            )
            encoders.save(fresh(folder / "encoders"))
            return {"tactile": encoders.digest("tactile"), "text": encoders.digest("text")}

        stage = self.run.stage(
            "tactile",
            {
                "preset": ENCODER,
                "epochs": epochs,
                "seed": SEED,
                "clip": self.run.stages["clip"].digest,
            },
            build,
        )
        return EncoderSet.load(stage.folder / "encoders")

    def encoders(self) -> EncoderSet:
        """The three encoders; vision goes on with one photo of each of many more objects.

        Text and tactile encoder stay: so do all scores that are made with these.
        """
        encoders = self.tactile()
        parts = [self.world(name).prefixed(f"{name}/") for name in ("gelsight", "photos")]
        train, epochs = Manifest.join(*parts), VISION_EPOCHS * self.share

        def build(folder: Path) -> Mapping[str, Any]:
            how = {"start": encoders.clip, "compute": COMPUTE}
            clip = self._pair(train, VISION, folder, epochs, **how)
            replace(encoders, clip=clip).save(fresh(folder / "encoders"))
            return {"vision": clip.digest("vision")}

        inputs = {"preset": VISION, "epochs": epochs, "seed": SEED, "train": train.digest}
        inputs |= {m: encoders.digest(m) for m in encoders.modalities}
        stage = self.run.stage("encoders", inputs, build)
        return EncoderSet.load(stage.folder / "encoders")

    def autoencoder(self) -> AnyAutoencoder:
        """The background autoencoder, of tactile images of both looks."""
        if self.before:
            return load_autoencoder(self.before / "autoencoder")
        parts = [self.world(name) for name in ("gelsight", "digit")]
        options = replace(AUTOENCODER, steps=max(1, round(AUTOENCODER.steps * self.share)))

        def build(folder: Path) -> Mapping[str, Any]:
            images, gels = (
                np.concatenate(
                    [
                        cached_images(part, column, DIFFUSION.size, self.cache, self.progress)
                        for part in parts
                    ]
                )
                for column in ("tactile", "background")
            )
            model = train_background_autoencoder(
                images,
                gels,
                options,
                folder / "training",
                seed=SEED,
                key=digest_json([p.digest for p in parts]),
                compute=COMPUTE,
                progress=self.progress,
            )
            model.save(fresh(folder / "autoencoder"))
            return {"digest": model.digest}

        inputs = {"options": options, "seed": SEED, "train": [p.digest for p in parts]}
        stage = self.run.stage("autoencoder", inputs, build)
        return load_autoencoder(stage.folder / "autoencoder")

    def generator(self) -> TactilePipeline:
        """From a photo to a tactile image, in the space of the rounded encoders and autoencoder."""
        parts = self.encoders(), self.autoencoder(), self.world("gelsight")
        parts[0].halve()
        parts[1].halve()
        pipeline = None
        for number in range(GENERATOR_ROUNDS):
            pipeline = self._round(number, pipeline, *parts)
        return replace(pipeline, sampler=GENERATOR.sampler)

    def _round(
        self,
        number: int,
        start: TactilePipeline | None,
        encoders: EncoderSet,
        autoencoder: AnyAutoencoder,
        train: Manifest,
    ) -> TactilePipeline:
        """A round of the generator's training; it goes on from the rounded weights of the last."""
        steps, seed = max(1, math.ceil(GENERATOR_STEPS * self.share)), SEED + number
        inputs = {
            "preset": replace(GENERATOR, sampler=SamplerOptions()),  # no part of the training
            "steps": steps,
            "seed": seed,
            "vision": encoders.digest("vision"),
            "text": encoders.digest("text"),
            "autoencoder": autoencoder.digest,
            "train": train.digest,
        }
        if start is not None:
            self._halve(encoders, autoencoder, start)
            inputs["start"] = start.digest

        def build(folder: Path) -> Mapping[str, Any]:
            how = {"cache": self.cache, "progress": self.progress}
            parts = train, encoders, autoencoder
            pipeline = train_round(*parts, folder / "training", seed, start, steps, **how)
            pipeline.save(fresh(folder / "model"))
            return {"digest": pipeline.digest, "train": len(train)}

        name = f"generator {number + 1}" if number else "generator"
        folder = self.run.stage(name, inputs, build).folder
        return TactilePipeline.from_pretrained(folder / "model")

    def scores(self) -> dict[str, Any]:
        """Scores of the full and of the rounded models on the new worlds, as rows for the cards."""
        full = self.encoders(), self.autoencoder(), self.generator()
        digests = [
            full[0].digest("tactile"),
            full[0].digest("vision"),
            full[1].digest,
            full[2].digest,
        ]

        def build(folder: Path) -> Mapping[str, Any]:
            exact = score_all(*full, self._samples(), self.cache, None, self.progress)
            rounding = self._halve(*full)
            rounded = score_all(
                *full, self._samples(), self.cache, folder / "generated", self.progress
            )
            write_json(
                folder / "scores.json", {"rounded": rounded, "exact": exact, "rounding": rounding}
            )
            return {"rounding": rounding}

        inputs = {
            "models": digests,
            "sampler": GENERATOR.sampler,
            "worlds": [self.world(name).digest for name in WORLDS],
        }
        stage = self.run.stage("scores", inputs, build)
        return read_json(stage.folder / "scores.json", "scores")

    def _samples(self) -> dict[str, Manifest]:
        return {name: self.world(name) for name in WORLDS}

    @staticmethod
    def _halve(
        encoders: EncoderSet, autoencoder: AnyAutoencoder, pipeline: TactilePipeline
    ) -> dict[str, float]:
        """Rounds all weights to 16 bits, in place; the largest relative change of a tensor of each
        model.
        """
        changes = {
            "encoders": encoders.halve(),
            "autoencoder": autoencoder.halve(),
            "generator": pipeline.denoiser.halve(),
        }
        vars(pipeline).pop("digest", None)  # cached before the weights changed
        return changes

    def ship(self) -> None:
        """Writes ``src/palpate/mini``: weights in 16 bits, and cards."""
        if self.share != 1.0:
            raise PalpateError(
                "Shipped models must have been trained in full",
                f"--share {self.share:g}",
                "Leave out --share",
            )
        scores, encoders, autoencoder, pipeline = (
            self.scores(),
            self.encoders(),
            self.autoencoder(),
            self.generator(),
        )
        self._halve(encoders, autoencoder, pipeline)
        target = shipped_root() / SHIPPED[NAME]
        ship(target, encoders, autoencoder, pipeline, scores, self._worlds(), LIMITS)
        if PAGE.is_file():
            write_page(PAGE, target)
        print_line(f"Shipped in {target}")

    def _worlds(self) -> list[dict[str, Any]]:
        stages = {name: self.run.stages[f"world {name}"].facts for name in WORLDS}
        return [
            {
                "world": name,
                "seed": o.seed,
                "look": o.look,
                "version": VERSION,
                "frames": stages[name]["frames"],
                "videos": stages[name]["videos"],
                "digest": stages[name]["digest"],
            }
            for name, o in WORLDS.items()
        ]

    def verify(self) -> int:
        """Scores the shipped models again; every score must come out as its card says, within 0.002
        of its scale.
        """
        encoders, autoencoder, pipeline = (
            EncoderSet.load(NAME),
            load_autoencoder(NAME),
            TactilePipeline.from_pretrained(NAME),
        )
        rows = score_all(
            encoders, autoencoder, pipeline, self._samples(), self.cache, None, self.progress
        )
        cards = {
            "encoders": encoders.card,
            "autoencoder": autoencoder.card,
            "generator": dict(pipeline.training),
        }
        bad = 0
        for part, scored in rows.items():
            said = {row["score"]: row["value"] for row in cards[part]["scores"]}
            if missing := sorted(set(said) - {row["score"] for row in scored}):
                bad += len(missing)
                print_line(f"{part}: the card has former scores: {', '.join(missing)}  DIFFERS")
            for row in scored:
                value, card = row["value"], said.get(row["score"])
                same = card is not None and abs(value - card) <= 0.002 * max(1.0, abs(card))
                bad += not same
                known = "nothing" if card is None else f"{card:.4g}"
                print_line(
                    f"{part}: {row['score']}: {value:.4g}, the card says {known}"
                    f"{'' if same else '  DIFFERS'}"
                )
        return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
