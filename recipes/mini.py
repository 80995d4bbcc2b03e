"""Train the models that ship with palpate (``palpate/mini``), score them on unseen worlds, and
write their cards.

    python recipes/mini.py --work runs/mini                     # everything
    python recipes/mini.py --work runs/mini --only autoencoder  # one part and what it needs
    python recipes/mini.py --work runs/mini --tactile --ship    # the tactile encoder alone, anew
    python recipes/mini.py --work runs/mini --tactile --seed 1  # another training of it, scored
    python recipes/mini.py --work runs/mini --tactile --wide    # one of other gels, scored
    python recipes/mini.py --work runs/mini --contacts --ship   # the last round of the generator
    python recipes/mini.py --work runs/mini --ship              # and write src/palpate/mini
    python recipes/mini.py --work runs/mini --range             # write anew what training saw
    python recipes/mini.py --work runs/mini --verify            # score what ships again

Stopped half-way, the same command goes on. Only worlds of the seeds
``palpate.sim.presets.MINI_SEEDS`` are read, which nothing else may use:

=============  ========  =========================================================================
world          seed      read by
=============  ========  =========================================================================
gelsight       900000    every part
digit          900001    the autoencoder alone: the other look of the sensor
photos         900002    the vision encoder alone: 16,000 more objects, one photo of each
contacts       900003    the last round of the generator: touches that can be asked for; and what is
                         unlike the training
gel 0 .. 13    900010 .. the tactile encoder: pads of 9 to 22 mm, 0 to 12 rows of markers, DIGIT
wide 0 .. 12   900030 .. with ``--wide`` in place of DIGIT: pads of 26 mm, 10 rows of markers
new gelsight   900050    scores: new objects, videos and gel units
new digit      900051    scores of the autoencoder
new gel        900052    scores of the tactile encoder: a pad of 14 mm, 8 rows of markers
new pad        900053    scores of the tactile encoder: a pad of 26 mm, 10 rows of markers
new look       900054    scores of the tactile encoder: DIGIT
=============  ========  =========================================================================

Weights are rounded to 16 bits before anything is scored, so the scores are those of the shipped
files.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mini_cards import ship, write_page
from mini_scores import prefixed, score_all, score_encoders, score_generator
from numpy.typing import NDArray

from palpate.core import PalpateError, Split, digest_json, read_json, rng_for, write_json
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import AnyAutoencoder, load_autoencoder
from palpate.diffusion.autoencoder_training import fit_autoencoder
from palpate.diffusion.gels import gels_of
from palpate.diffusion.options import BackgroundOptions, SamplerOptions
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import MINI as DIFFUSION
from palpate.diffusion.presets import DiffusionPreset
from palpate.diffusion.training import Parts, train_pipeline
from palpate.diffusion.training_range import TrainingRange
from palpate.encoders.contrastive import train_clip
from palpate.encoders.embed import texts_of
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.gel_training import train_ruler
from palpate.encoders.models import SHIPPED, shipped_root
from palpate.encoders.presets import EncoderPreset, preset_of
from palpate.metrics.conditions import contact_conditions
from palpate.sim import PRESETS, VERSION, WorldOptions, write_world
from palpate.studies.files import cleared
from palpate.studies.stages import Stage, run_stage, stored_stage
from palpate.training.options import Compute
from palpate.training.run import TrainingRun

NAME = "palpate/mini"
#: Its table of scores is written from the cards.
PAGE = Path(__file__).parents[1] / "docs" / "concepts" / "mini.md"
SEED = 0
#: Phases as when these models were trained: the first and last moments, the lightest of a contact.
_BASE = replace(PRESETS["pretrain"], contacts_per_video=3, frames_per_contact=2, phases="spaced")
WORLDS: dict[str, WorldOptions] = {
    "gelsight": replace(_BASE, seed=900_000, objects_per_material=150, sensors=8),
    "digit": replace(_BASE, seed=900_001, objects_per_material=30, sensors=4, look="digit"),
    "photos": replace(
        _BASE, seed=900_002, objects_per_material=800, contacts_per_video=1, frames_per_contact=1
    ),
    "contacts": replace(_BASE, seed=900_003, objects_per_material=36, sensors=8),
    "new gelsight": replace(_BASE, seed=900_050, objects_per_material=10),
    "new digit": replace(_BASE, seed=900_051, objects_per_material=4, look="digit"),
}
_GEL = replace(
    _BASE,
    size=128,
    tile=384,
    mixed=0.0,
    sensors=24,
    load_mm=(0.03, 0.5),
    sensor_noise=(0.001, 0.006),
)
_NEW = replace(_GEL, objects_per_material=20)
WORLDS["new gel"] = replace(_NEW, seed=900_052, pad_mm=14.0, markers=8)
WORLDS["new pad"] = replace(_NEW, seed=900_053, pad_mm=26.0, markers=10)
WORLDS["new look"] = replace(_NEW, seed=900_054, look="digit")


def gel(number: int) -> WorldOptions:
    """One of the worlds that the tactile encoder learns from beside ``gelsight``: another gel,
    load, noise and codec each.
    """
    rng = rng_for(SEED, "gel world", number)
    return replace(
        _GEL,
        seed=900_010 + number,
        objects_per_material=6,
        look="digit" if number % 3 == 0 else "gelsight",
        pad_mm=round(math.exp(rng.uniform(math.log(9), math.log(22))), 1),
        markers=int(rng.choice([0, 0, 6, 8, 12])),
        quality=int(rng.choice([95, 95, 90, 80, 70, 60, 50])),
    )


GELS = [f"gel {number}" for number in range(14)]
WORLDS |= {name: gel(number) for number, name in enumerate(GELS)}
#: In place of which world with ``--wide``: what the encoder has not learned from is learned there.
WIDE = {f"gel {n}": f"wide {n}" for n in range(14) if gel(n).look == "digit"}
WORLDS |= {
    wide: replace(WORLDS[name], seed=900_030 + k, look="gelsight", pad_mm=26.0, markers=10)
    for k, (name, wide) in enumerate(WIDE.items())
}
ENCODER = preset_of("mini")
TACTILE = preset_of("gel")
#: Fields of a preset that decide nothing.
TEXTS = {"cost": "", "score": ""}
#: Of the vision encoder when it goes on: more rows to tell apart.
VISION = replace(ENCODER, clip_course=replace(ENCODER.clip_course, batch=256, lr=2e-3))
#: Passes over the data. One core sees about 400 images a second in training.
CLIP_EPOCHS, VISION_EPOCHS = 14.0, 20.0
AUTOENCODER = BackgroundOptions(steps=6_000)
GENERATOR = replace(DIFFUSION, loop=replace(DIFFUSION.loop, batch=32, warmup=100))
#: Of a round of the generator's training, and how many rounds: each goes on from the last.
GENERATOR_STEPS, GENERATOR_ROUNDS = 8_000, 2
#: The last round: contacts that can be asked for.
CONTACTS = replace(
    DIFFUSION,
    condition=replace(DIFFUSION.condition, contact=True),
    loop=replace(DIFFUSION.loop, ema=0.995),
)
CONTACTS_STEPS = 3_600
#: Touches that say how well it follows what is asked.
CALIBRATED = 480
#: Half the time, on CPUs that have it; the weights then depend on the kind of CPU.
COMPUTE = Compute(precision="bf16")
PARTS = ("worlds", "clip", "encoders", "autoencoder", "generator", "scores")


def main() -> int:
    """Run the requested parts; exit with 1 if ``--verify`` gives other scores than the cards."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=Path("runs/mini"))
    parser.add_argument("--only", choices=PARTS, default="scores", help="the last part to make")
    parser.add_argument("--tactile", action="store_true", help="keep all else as it ships")
    parser.add_argument("--contacts", action="store_true", help="go on with the generator alone")
    parser.add_argument("--seed", type=int, default=SEED, help="of the tactile encoder")
    parser.add_argument("--wide", action="store_true", help="wide pads instead of DIGIT")
    parser.add_argument("--ship", action="store_true", help="write src/palpate/mini")
    parser.add_argument("--range", action="store_true", help="what the generator's training saw")
    parser.add_argument("--verify", action="store_true", help="score the shipped models again")
    options = parser.parse_args()
    recipe = Recipe(options.work, options.tactile, options.seed, options.wide, options.contacts)
    if recipe.compared and (options.ship or not options.tactile):
        parser.error("--seed and --wide are for comparison: with --tactile, without --ship")
    try:
        if options.verify:
            return recipe.verify()
        if options.range:
            return recipe.write_range()
        recipe.make(options.only)
        if options.ship:
            recipe.ship()
    except PalpateError as error:
        sys.stderr.write(f"{error}\n")
        return 2
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
    start: TactilePipeline | None,
    preset: DiffusionPreset,
    run: TrainingRun,
) -> TactilePipeline:
    """The generator after a round of training, from random weights or from those of ``start``."""
    last = preset.condition.contact  # on fewer images: what photos recall stays
    parts = Parts(preset, autoencoder, encoders, start=start, remember=last)
    made = train_pipeline(train, everything(train), parts, replace(run, compute=COMPUTE))
    # Nothing is left out of the training: the ceiling is that of the autoencoder's own card.
    return replace(made, training={**made.training, "ceiling": autoencoder.card.get("scores")})


def calibrated(pipeline: TactilePipeline, train: Manifest, cache: Path) -> TactilePipeline:
    """The generator with the gains by which touches follow what is asked with a slope of 1, on
    photos of its training: asked for are touches of other samples of the same material.
    """
    some = train.take(train.ids[:: max(1, len(train) // CALIBRATED)])
    size, contact = pipeline.size, pipeline.contact
    assert contact is not None
    images, gels = cached_images(some, "tactile", size, cache), gels_of(some, size, cache)
    sensors, materials = some.column("sensor"), np.array(some.column("material"))
    other = np.arange(len(some))
    for material in np.unique(materials):
        rows = np.flatnonzero(materials == material)
        other[rows] = np.roll(rows, len(rows) // 2)
    asked = contact.requested(contact_conditions(images, gels), sensors).astype(float)[other]
    photos = pipeline.embed(cached_images(some, "vision", pipeline.vision_size, cache))
    made = pipeline.sample(photos, some.ids, seed=0, background=np.asarray(gels), touches=asked)
    shown = contact.requested(contact_conditions(made, gels), sensors)
    known = np.isfinite(asked).all(axis=1) & np.isfinite(shown).all(axis=1)
    slopes = [np.polyfit(x, y, 1)[0] for x, y in zip(asked[known].T, shown[known].T, strict=True)]
    gain = [round(1 / float(slope), 3) for slope in slopes]
    return replace(pipeline, contact=replace(contact, gain=gain))


def _seeing(preset: EncoderPreset, epochs: float) -> EncoderPreset:
    """A preset with so many epochs of vision and text."""
    assert preset.clip_course is not None
    return replace(preset, clip_course=replace(preset.clip_course, epochs=epochs))


class Recipe:
    """The parts, each a stage of a run folder; a finished stage is read, not made again."""

    def __init__(
        self,
        work: Path,
        tactile: bool = False,
        seed: int = SEED,
        wide: bool = False,
        contacts: bool = False,
    ) -> None:
        """Work in a folder; with ``tactile`` all but the tactile encoder is what ships, with
        ``contacts`` all but the last round of the generator, which goes on from what ships.
        """
        self.work, self.cache, self.seed = work, work / "cache", seed
        self.kept, self.contacts = tactile or contacts, contacts
        #: Name of a tactile encoder that is compared with the one that ships, or ''.
        self.compared = " wide" * wide + f" {seed}" * (seed != SEED)
        gels = [WIDE.get(name, name) if wide else name for name in GELS]
        self.learned = ["gelsight", *gels]
        new = [name for name in WORLDS if name.startswith("new")]
        self.worlds = [*self.learned, *new, *([] if tactile else ["digit", "photos", "contacts"])]
        if contacts:
            self.worlds = ["gelsight", "contacts", "new gelsight"]
        self.common: dict[str, Any] = {"cache": self.cache, "progress": self.progress}

    def stage(
        self, name: str, inputs: Mapping[str, Any], build: Callable[[Path], Mapping[str, Any]]
    ) -> Stage:
        """A stage, made if it is not there."""
        return run_stage(self.work / name, inputs, build, print_line=print_line)

    @staticmethod
    def progress(what: str, done: int, total: int, remark: str = "") -> None:
        """A line every twentieth of the way."""
        if done % max(1, total // 20) == 0:
            print_line(f"  {what}: {done} of {total} {remark}")

    def make(self, last: str) -> None:
        """Make the part ``last`` and what it needs."""
        for name in self.worlds:
            self.world(name)
        if last != "worlds":
            getattr(self, last)()

    def world(self, name: str) -> Manifest:
        """The samples of a world."""

        def build(folder: Path) -> Mapping[str, Any]:
            workers = len(os.sched_getaffinity(0))
            tree, options = folder / "tree", WORLDS[name]
            record = write_world(tree, options, workers=workers, progress=self.progress)
            facts = {"frames": record.counts["contact_frames"], "videos": record.counts["videos"]}
            return {"digest": record.digest, **facts}

        stage = self.stage(f"world {name}", {"options": WORLDS[name].digest}, build)
        return Manifest.load(stage.folder / "tree")

    def clip(self) -> Stage:
        """Vision and text, by contrast of photos and captions; in ``clip``."""
        train = self.world("gelsight")

        def build(folder: Path) -> Mapping[str, Any]:
            preset = _seeing(ENCODER, CLIP_EPOCHS)
            clip = train_clip(train, everything(train), preset, self._run(folder))
            clip.save(cleared(folder / "clip"))
            return {"vision": clip.digest("vision"), "text": clip.digest("text")}

        inputs = {"preset": ENCODER, "epochs": CLIP_EPOCHS, "seed": SEED, "train": train.digest}
        return self.stage("clip", inputs, build)

    def _run(self, folder: Path) -> TrainingRun:
        return TrainingRun(folder / "training", seed=SEED, cache=self.cache, progress=self.progress)

    def pair(self) -> EncoderSet:
        """Vision and text; vision goes on with one photo each of many more objects."""
        if self.kept:
            return load_clip(NAME)
        clip = self.clip()
        parts = [prefixed(self.world(name), f"{name}/") for name in ("gelsight", "photos")]
        train = Manifest.join(*parts)

        def build(folder: Path) -> Mapping[str, Any]:
            run = replace(self._run(folder), compute=COMPUTE)
            preset, start = _seeing(VISION, VISION_EPOCHS), load_clip(clip.folder / "clip")
            pair = train_clip(train, everything(train), preset, run, start=start)
            pair.save(cleared(folder / "pair"))
            return {"vision": pair.digest("vision")}

        inputs = {"preset": VISION, "epochs": VISION_EPOCHS, "seed": SEED, "train": train.digest}
        inputs |= {"clip": clip.digest}
        return EncoderSet.load(self.stage("pair", inputs, build).folder / "pair")

    def encoders(self) -> EncoderSet:
        """The three encoders: the tactile one learns from many gels, against vision and text."""
        if self.contacts:
            return EncoderSet.load(NAME)
        pair = self.pair()
        pair.halve()
        parts = [prefixed(self.world(name), f"{name}/") for name in self.learned]
        train = Manifest.join(*parts)

        def build(folder: Path) -> Mapping[str, Any]:
            run = replace(self._run(folder), seed=self.seed)
            encoders = train_ruler(train, everything(train), pair, TACTILE, run)
            encoders.save(cleared(folder / "encoders"))
            return {"tactile": encoders.digest("tactile")}

        preset = replace(TACTILE, **TEXTS)
        inputs = {"preset": preset, "seed": self.seed, "train": train.digest}
        inputs |= {m: pair.digest(m) for m in pair.modalities}
        stage = self.stage(f"tactile{self.compared}", inputs, build)
        return EncoderSet.load(stage.folder / "encoders")

    def autoencoder(self) -> AnyAutoencoder:
        """The background autoencoder, of tactile images of both looks."""
        if self.kept:
            return load_autoencoder(NAME)
        parts = [self.world(name) for name in ("gelsight", "digit")]
        digests = [part.digest for part in parts]

        def images(column: str) -> NDArray[np.uint8]:
            how = DIFFUSION.size, self.cache, self.progress
            return np.concatenate([cached_images(part, column, *how) for part in parts])

        def build(folder: Path) -> Mapping[str, Any]:
            run = TrainingRun(folder / "training", SEED, compute=COMPUTE, progress=self.progress)
            data = images("tactile"), images("background"), AUTOENCODER, run
            model = fit_autoencoder(*data, key=digest_json(digests))
            model.save(cleared(folder / "autoencoder"))
            return {"digest": model.digest}

        inputs = {"options": AUTOENCODER, "seed": SEED, "train": digests}
        stage = self.stage("autoencoder", inputs, build)
        return load_autoencoder(stage.folder / "autoencoder")

    def generator(self) -> TactilePipeline:
        """From a photo to a tactile image, in the space of the rounded encoders and autoencoder."""
        pipeline = TactilePipeline.from_pretrained(NAME) if self.kept else None
        if pipeline is not None and not self.contacts:
            return pipeline
        parts = self.pair(), self.autoencoder()
        parts[0].halve()
        parts[1].halve()
        for number in range(0 if self.kept else GENERATOR_ROUNDS):
            pipeline = self._round(number, pipeline, *parts, self.world("gelsight"))
        world = self.world("contacts")
        pipeline = self._round(GENERATOR_ROUNDS, pipeline, *parts, world)
        pipeline.denoiser.halve()
        pipeline = replace(pipeline, sampler=GENERATOR.sampler)

        def build(folder: Path) -> Mapping[str, Any]:
            made = calibrated(pipeline, world, self.cache)
            assert made.contact is not None
            return {"gain": made.contact.gain}

        inputs = {"start": pipeline.digest, "touches": CALIBRATED}
        gain = self.stage("calibration", inputs, build).facts["gain"]
        return replace(pipeline, contact=replace(pipeline.contact, gain=gain))

    def _round(
        self,
        number: int,
        start: TactilePipeline | None,
        encoders: EncoderSet,
        autoencoder: AnyAutoencoder,
        train: Manifest,
    ) -> TactilePipeline:
        """A round of the generator's training; it goes on from the rounded weights of the last."""
        seed, last = SEED + number, number == GENERATOR_ROUNDS
        preset = (
            CONTACTS.with_steps(CONTACTS_STEPS) if last else GENERATOR.with_steps(GENERATOR_STEPS)
        )
        inputs = {
            "preset": replace(preset, sampler=SamplerOptions()),  # no part of the training
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
            parts = train, encoders, autoencoder
            run = TrainingRun(folder / "training", seed, **self.common)
            pipeline = train_round(*parts, start, preset, run)
            pipeline.save(cleared(folder / "model"))
            return {"digest": pipeline.digest, "train": len(train)}

        name = f"generator {number + 1}" if number else "generator"
        folder = self.stage(name, inputs, build).folder
        return TactilePipeline.from_pretrained(folder / "model")

    def scores(self) -> dict[str, Any]:
        """Scores of the rounded models on the new worlds, as rows for the cards."""
        if self.compared:
            return self._encoder_scores()
        models = self.encoders(), self.autoencoder(), self.generator()
        self._halve(*models)
        digests = [models[0].digest("tactile"), models[0].digest("vision"), models[1].digest]

        def build(folder: Path) -> Mapping[str, Any]:
            worlds, how = self._samples(), (self.cache, self.progress)
            if self.contacts:
                sides = worlds["gelsight"], worlds["new gelsight"]
                rows = {"generator": score_generator(models[2], models[0], *sides, *how)}
            else:
                rows = score_all(*models, worlds, *how)
            write_json(folder / "scores.json", rows)
            return {}

        inputs = {
            "models": [*digests, models[2].digest],
            "sampler": GENERATOR.sampler,
            "worlds": [part.digest for part in self._samples().values()],
        }
        stage = self.stage("scores", inputs, build)
        return read_json(stage.folder / "scores.json", "scores")

    def _encoder_scores(self) -> dict[str, Any]:
        """Those of a tactile encoder that does not ship, printed."""
        encoders = self.encoders()
        encoders.halve()
        rows = score_encoders(encoders, self._samples(), self.cache, self.progress)
        for row in rows:
            print_line(f"{row['score']}: {row['value']:.4g}")
        write_json(self.work / f"scores{self.compared}.json", rows)
        return {"encoders": rows}

    def _samples(self) -> dict[str, Manifest]:
        return {n: self.world(n) for n in self.worlds if n == "gelsight" or n.startswith("new")}

    @staticmethod
    def _halve(
        encoders: EncoderSet, autoencoder: AnyAutoencoder, pipeline: TactilePipeline
    ) -> None:
        """Round all weights to 16 bits, in place."""
        encoders.halve()
        autoencoder.halve()
        pipeline.denoiser.halve()
        vars(pipeline).pop("digest", None)  # cached before the weights changed

    def ship(self) -> None:
        """Write ``src/palpate/mini``: weights in 16 bits, and cards."""
        scores = self.scores()
        models = self.encoders(), self.autoencoder(), self.generator()
        self._halve(*models)
        target = shipped_root() / SHIPPED[NAME]
        flags = "--contacts" if self.contacts else "--tactile" if self.kept else ""
        ship(target, *models, scores, self._worlds(), flags)
        if PAGE.is_file():
            write_page(PAGE, target)
        print_line(f"Shipped in {target}")

    def write_range(self) -> int:
        """Write what training saw (``range.json``) to the generator that ships."""
        train, pipeline = self.world("contacts"), TactilePipeline.from_pretrained(NAME)
        seen = TrainingRange.of(pipeline, train, texts_of(train)[0], self._run(self.work))
        seen.save(shipped_root() / SHIPPED[NAME] / "generator")
        new = cached_images(self.world("new gelsight"), "vision", pipeline.vision_size, self.cache)
        rates = np.array(seen.photo_rates(new))
        for level in (0.5, 0.9, 0.95, 0.99):
            share = (rates >= level).mean()
            print_line(
                f"{share:.1%} of {len(rates):,} new photos are unlike {level:.0%} of training"
            )
        return 0

    def _worlds(self) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        kept = load_clip(NAME).clip_card["data"] if self.kept else []
        kept += load_autoencoder(NAME).card["data"] if self.kept else []
        shipped = {row["world"]: row for row in kept}
        for name, o in WORLDS.items():
            if name not in self.worlds:
                rows += [shipped[name]] if name in shipped else []
                continue
            facts = stored_stage(self.work / f"world {name}").facts
            row = {"world": name, "seed": o.seed, "look": o.look, "version": VERSION}
            rows.append(row | {key: facts[key] for key in ("frames", "videos", "digest")})
        return rows

    def verify(self) -> int:
        """Score the shipped models again: as the cards say, within 0.002 of the scale."""
        encoders, autoencoder = EncoderSet.load(NAME), load_autoencoder(NAME)
        pipeline = TactilePipeline.from_pretrained(NAME)
        models = encoders, autoencoder, pipeline
        rows = score_all(*models, self._samples(), self.cache, self.progress)
        cards = {"encoders": encoders.card, "autoencoder": autoencoder.card}
        cards["generator"] = dict(pipeline.training)
        bad = 0
        for part, scored in rows.items():
            said = {row["score"]: row["value"] for row in cards[part]["scores"]}
            now = {row["score"]: row["value"] for row in scored}
            for name in said | now:
                both = said.get(name, math.nan), now.get(name, math.nan)
                same = abs(both[1] - both[0]) <= 0.002 * max(1.0, abs(both[0]))
                bad += not same
                mark = "" if same else "  DIFFERS"
                print_line(f"{part}: {name}: {both[1]:.4g}, the card says {both[0]:.4g}{mark}")
        return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
