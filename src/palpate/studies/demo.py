"""The demo: photos in, a page of results out, as a graph of stages.

::

    world -> data -> split -> encoders -> generator -> generated -> scores

Each stage is kept in the run folder under the digest of what it read
(:mod:`palpate.studies.stages`): a killed run resumes from its last finished stage, and a
changed option rebuilds only what depends on it. ``world`` is skipped where data is given. Training
goes on from the models that ship.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from palpate.core import Note, Progress, Score, Split, require_choice, write_json
from palpate.data.images import cached_images
from palpate.data.importing import import_dataset
from palpate.data.manifest import Manifest
from palpate.diffusion.generated import Generated
from palpate.diffusion.presets import MINI, DiffusionPreset
from palpate.encoders.contrastive import train_tactile
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.presets import PRESETS as ENCODERS
from palpate.encoders.presets import EncoderPreset, preset_of
from palpate.evaluation.scoring import score
from palpate.leakage.auditing import audit
from palpate.leakage.splitting import split as leak_free_split
from palpate.report.labels import percent, with_interval
from palpate.report.results import Results
from palpate.report.tables import BACKGROUND, families
from palpate.sim.options import WorldOptions
from palpate.sim.presets import PRESETS as WORLDS
from palpate.studies.controls import nearest_rows
from palpate.studies.files import (
    cleared,
    data_of,
    gallery,
    read_audits,
    read_scores,
    write_images,
    write_scores,
)
from palpate.studies.graph import Node, Nodes, Stamped, Work
from palpate.studies.making import Training, make_generator, make_images, make_world, read_data
from palpate.studies.names import NEAREST, SHIPPED
from palpate.studies.stages import Facts, Stage, record_of
from palpate.studies.stamps import data_stamp, model_stamp
from palpate.studies.study import WORLD
from palpate.studies.study_tables import FAMILY, NAMED, Scores
from palpate.training.run import TrainingRun

#: Name of the split file, without its ending.
SPLIT = "split"


@dataclass(frozen=True)
class DemoPreset:
    """A complete run.

    Attributes:
        name: of the preset.
        world: the embedded data set, used where no data is given.
        encoder: how the tactile encoder is trained, from random weights.
        diffusion: how the training of the shipped generator goes on.
        train: share of the train part.
        tactile_epochs: passes of the tactile encoder over the train part.
    """

    name: str
    world: WorldOptions
    encoder: EncoderPreset
    diffusion: DiffusionPreset
    train: float
    tactile_epochs: float


PRESETS = {
    preset.name: preset
    for preset in (
        DemoPreset(
            "tiny",  # for tests
            replace(WORLDS["tiny"], objects_per_material=4),
            ENCODERS["mini"],
            replace(
                MINI,
                loop=replace(MINI.loop, steps=4, batch=8),
                sampler=replace(MINI.sampler, steps=2),
            ),
            train=0.75,
            tactile_epochs=0.5,
        ),
        DemoPreset(
            "mini",
            replace(WORLD, frames_per_contact=2),
            ENCODERS["mini"],
            MINI,
            train=0.85,
            tactile_epochs=12,
        ),
    )
}


@dataclass(frozen=True)
class Demo:
    """What to run.

    Attributes:
        preset: see :data:`PRESETS`.
        data: a data set on disk, or None for the embedded world.
        seed: of the split, the weights, the order of training and the noise.
        device: ``auto``, ``cpu``, ``cuda`` ...
    """

    name: ClassVar[str] = "demo"

    preset: str = "mini"
    data: Path | None = None
    seed: int = 0
    device: str = "auto"

    @classmethod
    def again(cls, settings: Mapping[str, Any]) -> Demo:
        """The demo that a record says."""
        options = settings["options"]
        data = options["data"] and Path(options["data"])
        return cls(settings["preset"], data, settings["seeds"][0], options["device"])

    def nodes(self) -> list[Node]:
        """The stages; data that is given has no world.

        Raises:
            PalpateError: on bad options.
        """
        data, seed, nodes = self.data, self.seed, Nodes()
        require_choice("preset", self.preset, PRESETS)
        preset, size, root = PRESETS[self.preset], None, None
        clip, autoencoder, start = (
            Stamped(SHIPPED, model_stamp(part, SHIPPED))
            for part in ("clip", "autoencoder", "generator")
        )
        if data is None:
            nodes.add("world", make_world, options=preset.world)
        else:
            root = Stamped(data, [str(data.resolve()), data_stamp(data)])
            size = 4 * preset.diffusion.size
        nodes.add(
            "data",
            read_data,
            *(node.name for node in nodes),
            read=Stamped(partial(import_sized, size=size), size),
            root=root,
            name="world" if data is None else data.name,
            unseen=True,
        )
        nodes.add("split", make_demo_splits, "data", seed=seed, train=preset.train, measures=True)
        nodes.add(
            "encoders",
            train_on,
            "data",
            "split",
            seed=seed,
            preset=preset.encoder,
            epochs=preset.tactile_epochs,
            clip=clip,
        )
        nodes.add(
            "generator",
            make_generator,
            "data",
            "split",
            split=SPLIT,
            seed=seed,
            training=Training(preset.diffusion),
            clip=clip,
            autoencoder=autoencoder,
            start=start,
        )
        nodes.add(
            "generated",
            make_images,
            "data",
            "split",
            "generator",
            split=SPLIT,
            seed=seed,
            generator="generator",
        )
        nodes.add(
            "scores",
            score_images,
            "data",
            "split",
            "generated",
            "encoders",
            seed=seed,
            size=preset.diffusion.size,
            measures=True,
        )
        return nodes

    def results(self, stages: Mapping[str, Stage], jobs: int = 1) -> Results:
        """What the page says of finished stages."""
        return Page(self, stages).results(jobs)


def import_sized(source: Path, folder: Path, progress: Progress, *, size: int | None) -> None:
    """Import a data set, its images no larger than ``size`` pixels."""
    import_dataset(source, folder, size=size, overwrite=True, progress=progress)


def make_demo_splits(work: Work, *, seed: int, train: float) -> Facts:
    """The leak-free split, and the audits of it and of the data set's own splits."""
    data = work.after["data"]
    manifest = Manifest.load(data)
    clean = leak_free_split(manifest, train=train, by="auto", seed=seed)
    clean.save(work.folder / f"{SPLIT}.json")
    measured = partial(audit, manifest, cache=work.cache, progress=work.progress)
    audits = [
        measured(split=path, name=path.stem, by="video")
        for path in sorted((data / "splits").glob("*.json"))
        if Split.load(path).ids("test")
    ]
    group = str(clean.rule["group"])
    name = str(clean.rule["name"])
    name = f"{name} by {group}" if name == "NoLeak" and group != "video" else name
    audits.append(measured(split=clean, by=group, name=name))
    if group != "video" and not manifest.table["video"].null_count():
        name = f"{name}, seen by video"
        audits.append(audit(manifest, split=clean, by="video", name=name, images=False))
    write_json(work.folder / "audits.json", [a.to_json() for a in audits])
    return {"digest": clean.digest, "counts": clean.counts(), "rule": dict(clean.rule)}


def train_on(work: Work, *, seed: int, preset: EncoderPreset, epochs: float, clip: str) -> Facts:
    """The frozen CLIP with a tactile encoder that learns from it."""
    run = TrainingRun(
        work.folder / "training",
        seed=seed,
        cache=work.cache,
        device=work.device,
        progress=work.progress,
    )
    preset = preset_of(preset, epochs)
    encoders = train_tactile(*data_of(work, SPLIT), load_clip(clip), preset, run)
    encoders.save(cleared(work.folder / "encoders"))
    source = encoders.card.get("text_source")
    return {"digest": encoders.digest("tactile"), "text_source": source}


def score_images(work: Work, *, seed: int, size: int) -> Facts:
    """The scores of the generated images and of the controls."""
    manifest, split = data_of(work, SPLIT)
    encoders = EncoderSet.load(work.after["encoders"] / "encoders")
    train, test = manifest.part(split, "train"), manifest.part(split, "test")
    rows = nearest_rows(train, test, encoders, work)
    images = cached_images(train, "tactile", size, work.cache)[rows]
    told = not train.table["background"].null_count()
    gels = cached_images(train, "background", size, work.cache)[rows] if told else None
    write_images(work.folder / "nearest", test.ids, images, gels)
    results = score(
        [work.after["generated"] / "images", work.folder / "nearest"],
        manifest,
        encoder=encoders,
        split=split,
        names=["generated", NEAREST],
        presets=("grouped", "paper"),
        companions=("ssim", "psnr"),
        seed=seed,
        cache=work.cache,
        progress=work.progress,
        allow_seen=True,  # an image may be in two videos; the scores say so
    )
    write_scores(work.folder, results.scores)
    return {"scores": len(results)}


class Page:
    """From a finished run to the results of its page: facts, gallery, notes, commands."""

    def __init__(self, demo: Demo, stages: Mapping[str, Stage]) -> None:
        self.demo, self.stages = demo, stages
        self.work = Work(Path(), {name: stage.folder for name, stage in stages.items()})
        self.manifest, self.split = data_of(self.work, SPLIT)
        self.generated = Generated.load(self.work.after["generated"] / "images")
        self.scores = read_scores(self.work.after["scores"])
        self.named = Scores.of(self.scores)
        self.audits = read_audits(self.work)

    def results(self, jobs: int) -> Results:
        """Everything of the page."""
        demo, facts = self.demo, {name: stage.facts for name, stage in self.stages.items()}
        digests = {name: fact["digest"] for name, fact in facts.items() if "digest" in fact}
        settings = {
            "study": demo.name,
            "dataset": facts["data"]["dataset"],
            "models": SHIPPED,
            "preset": demo.preset,
            "seeds": [demo.seed],
            "options": {"data": demo.data and str(demo.data), "device": demo.device, "jobs": jobs},
            "digests": {"manifest": self.manifest.digest, "split": self.split.digest} | digests,
            "split rule": dict(self.split.rule),
            "facts": facts,
            **record_of(self.stages),
        }
        return Results(
            title="From photo to tactile image",
            facts=[self._leak(), self._distance(), self._material()],
            audits=self.audits,
            scores=self.scores,
            gallery=gallery(self.manifest, self.generated, demo.seed),
            settings=settings,
            notes=self._notes(),
            commands=self._next_steps(),
        )

    def _leak(self) -> str:
        audits = {(a.split == self.split.digest, a.group): a for a in self.audits}
        noleak = audits[True, str(self.split.rule["group"])]
        by_video = audits.get((True, "video"), noleak)
        original = next((a for (ours, _), a in audits.items() if not ours), None)
        fact = f"{noleak.name} (whole {noleak.group}s kept together) leaks "
        fact += percent(noleak.leaked_fraction)
        if original is not None:
            gap = ""
            if original.gap_median is not None:
                gap = f", a median of {original.gap_median:g} frames from the nearest train frame"
            share = f"{percent(original.leaked_fraction)} of the test samples of the data set's own"
            return f"Leak: {share} split share a video with train{gap}; {fact}."
        if by_video is not noleak:
            share = f"{percent(by_video.leaked_fraction)} of its test samples share a video with"
            return f"Leak: {fact} by {noleak.group}, but {share} train: there are too few videos."
        return f"Leak: {fact}."

    def _with_interval(self, score: Score | None) -> str:
        """The score and its interval, rounded as in the tables."""
        if score is None or score.value is None:
            return "undefined"
        columns = (column for family in families(self.scores) for column in family.columns)
        digits = next(c.digits for c in columns if any(s is score for s in c.scores))
        return with_interval(score, digits)

    def _distance(self) -> str:
        with_gels = self.stages["generator"].facts["background"]
        source = "photos and no-contact images" if with_gels else "photos alone"
        background, ours = (self.named.get(FAMILY[0], n) for n in (BACKGROUND, "generated"))
        versus = f", the no-contact image {self._with_interval(background)}" if background else ""
        start = f"Distance: {len(self.generated.ids)} tactile images generated from {source}"
        value = self._with_interval(ours)
        return f"{start} have TMMD (grouped) {value} to the real ones{versus} (lower is better)."

    def _material(self) -> str:
        generated, real, nearest, background = (
            self.named.get(NAMED, name) for name in ("generated", "real", NEAREST, BACKGROUND)
        )
        if generated is None or real is None:
            materials = self.manifest.table["material"].drop_nulls().n_unique()
            return f"Material: {materials} materials, too few for a probe."
        more = f", {percent(float(nearest))} of those of the nearest photo" if nearest else ""
        more += f", {percent(float(background))} of the no-contact image" if background else ""
        more += f"; chance is {percent(generated.details['chance'])}"
        start = "Material: a probe fitted to real train images is right on"
        shares = f"{percent(float(real))} of the real test images"
        shares += f", {percent(float(generated))} of the generated ones"
        return f"{start} {shares}{more}."

    def _notes(self) -> list[Note]:
        notes = [Note("synthetic-data")] if self.manifest.facts.get("synthetic") else []
        notes.append(Note("models-shipped", {"name": SHIPPED}))
        notes += self.split.notes
        if self.manifest.table["text"].null_count():
            notes.append(Note("template-texts"))
        background = self.named.get(NAMED, BACKGROUND)
        if background is not None and float(background) > 2 * background.details["chance"]:
            notes.append(Note("background-predicts-material", {"share": background.value}))
        return notes

    def _next_steps(self) -> list[str]:
        folder = Path(self.stages["data"].folder).parent
        data, split = folder / "data", folder / "split" / f"{SPLIT}.json"
        model, encoders = folder / "generator" / "model", folder / "encoders" / "encoders"
        return [
            f"palpate audit {data} --split {split}",
            f"palpate generate YOUR_PHOTOS/ --model {model} -o YOUR_IMAGES/",
            f"palpate score --generated YOUR_IMAGES/ --reference {data} --split {split} "
            f"--encoder {encoders} -o scores.json",
        ]
