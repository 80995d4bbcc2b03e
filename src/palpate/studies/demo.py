"""The demo: photos in, a page of results out, as a graph of stages.

::

    world -> data -> split -> (pretraining world -> clip -> autoencoder) -> encoders -> generator
          -> generated -> scores

Each stage is kept in the run folder under the digest of what it read
(:class:`palpate.studies.stages.Run`): a killed run resumes from its last finished stage, and a
changed option rebuilds only what depends on it. ``world`` is skipped where data is given. The
stages in brackets train small stand-ins for pretrained models; they are skipped where such models
are given, or ship with the package and the preset takes them. What each model saw is in its card,
which the next model's card contains.
"""

from __future__ import annotations

import dataclasses
import os
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from palpate import __version__
from palpate.core import (
    PalpateError,
    Progress,
    Score,
    Split,
    digest_file,
    digest_folder,
    digest_lines,
    locked,
    quiet,
    read_json,
    require_choice,
    write_json,
)
from palpate.data.images import cached_images
from palpate.data.importing import import_dataset
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import BackgroundAutoencoder
from palpate.diffusion.autoencoder_training import measure_reconstruction
from palpate.diffusion.autoencoders import autoencoder_of, gels_of, load_autoencoder
from palpate.diffusion.generation import Generated, generate
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import preset_named as diffusion_preset
from palpate.diffusion.training import train_pipeline
from palpate.encoders.contrastive import train_clip, train_tactile
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import Part, is_shipped, shipped_folder
from palpate.encoders.presets import preset as encoder_preset
from palpate.evaluation.scoring import score
from palpate.leakage.auditing import audit
from palpate.leakage.splitting import split as leak_free_split
from palpate.report.results import Audit
from palpate.sim import WorldOptions, write_world
from palpate.sim.presets import MINI_SEEDS
from palpate.studies.controls import NEAREST, nearest_rows
from palpate.studies.making import fresh, write_images
from palpate.studies.presets import PRESETS
from palpate.studies.stages import Run, Stage


@dataclass(frozen=True)
class DemoOptions:
    """What to run.

    Attributes:
        preset: see :data:`palpate.studies.presets.PRESETS`.
        data: a data set on disk, or None for the embedded world.
        clip: shipped name, hub id or folder of a pretrained CLIP; None: the preset's choice.
        autoencoder: the same for a pretrained autoencoder, or its ``.ckpt``.
        from_scratch: train small models where none are given, and take nothing that ships.
        by: what the split keeps whole; ``auto`` falls back to contacts where videos are too few.
        seed: of the split, the weights, the order of training and the noise.
        skip_bad: skip bad rows and images of ``data`` and list them.
        background: train the variant that sees the no-contact image.
        device: ``auto``, ``cpu``, ``cuda`` ...
        workers: processes that render the world.
    """

    preset: str = "mini"
    data: Path | None = None
    clip: str | None = None
    autoencoder: str | None = None
    from_scratch: bool = False
    by: str = "auto"
    seed: int = 0
    skip_bad: bool = False
    background: bool = False
    device: str = "auto"
    workers: int = 2


@dataclass(frozen=True)
class DemoRun:
    """A finished run; see the stages' folders for the files.

    Attributes:
        manifest, split: the data, and the leak-free split that was trained and scored on.
        audits: of the data set's own splits, if it has any, and of the leak-free one.
        generated: the images generated for the test part.
        scores: see :func:`palpate.evaluation.score`.
        stages: by name, with digests, facts and times.
        options: what was requested.
        models: the pretrained models used, by role (``clip``, ``autoencoder``); None: trained here.
    """

    manifest: Manifest
    split: Split
    audits: list[Audit]
    generated: Generated
    scores: list[Score]
    stages: Mapping[str, Stage]
    options: DemoOptions
    models: Mapping[str, str | None]

    def settings(self) -> dict[str, Any]:
        """Options, digests, versions and times, for the page."""
        packages = ("numpy", "torch", "diffusers", "transformers", "polars", "pillow")
        options = dataclasses.asdict(self.options)
        digests = {n: s.facts["digest"] for n, s in self.stages.items() if "digest" in s.facts}
        return {
            "dataset": self.stages["data"].facts["dataset"],
            "models": dict(self.models),
            "options": {k: str(v) if isinstance(v, Path) else v for k, v in options.items()},
            "digests": {"manifest": self.manifest.digest, "split": self.split.digest} | digests,
            "split rule": dict(self.split.rule),
            "stages": {
                name: {k: v for k, v in stage.facts.items() if k != "digest"}
                for name, stage in self.stages.items()
            },
            "seconds": {name: round(stage.seconds, 1) for name, stage in self.stages.items()},
            "versions": {"palpate": __version__, "python": platform.python_version()}
            | {p: metadata.version(p) for p in packages},
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        }


def run_demo(
    options: DemoOptions,
    folder: Path,
    *,
    print_line: Callable[[str], None] = lambda line: None,
    progress: Progress = quiet,
) -> DemoRun:
    """Run all stages, or those that are not there yet for the same inputs.

    Args:
        options: what to run.
        folder: run folder; running again with the same folder resumes.
        print_line: called with one line per stage.
        progress: called with what is done within a stage.

    Raises:
        PalpateError: on bad data or options; finished stages stay.
    """
    demo = _Demo(options, Run(Path(folder), print_line), progress)
    with locked(Path(folder)):
        return _run(demo)


def run_again(options: DemoOptions, run: Run, progress: Progress = quiet) -> DemoRun:
    """The demo on a run that makes its stages in its own way."""
    return _run(_Demo(options, run, progress))


def _run(demo: _Demo) -> DemoRun:
    manifest = demo.data()
    split, audits = demo.split(manifest)
    pretraining = None
    if not (demo.models["clip"] and demo.models["autoencoder"]):
        pretraining = demo.pretraining(manifest, split)
    clip = demo.models["clip"] or demo.clip(pretraining)
    autoencoder = demo.models["autoencoder"] or demo.autoencoder(pretraining, manifest, split)
    encoders = demo.encoders(manifest, split, clip, pretraining)
    model = demo.generator(manifest, split, encoders, autoencoder)
    generated = demo.generated(manifest, split, model)
    scores = demo.scores(manifest, split, generated, encoders)
    stages = demo.run.stages
    return DemoRun(manifest, split, audits, generated, scores, stages, demo.options, demo.models)


class _Demo:
    """The stages; each method returns what later ones read."""

    def __init__(self, options: DemoOptions, run: Run, progress: Progress) -> None:
        if options.data is not None and not options.data.exists():
            must, got = "must exist", f"nothing at {options.data}"
            raise PalpateError(must, got, "Check the path", argument="data")
        self.options, self.run, self.progress = options, run, progress
        require_choice("preset", options.preset, PRESETS)
        self.preset = PRESETS[options.preset]
        self.encoder = encoder_preset(self.preset.encoder)
        self.diffusion = diffusion_preset(self.preset.diffusion)
        self.cache = run.folder / "cache"
        self.shipped = None if options.from_scratch else self.preset.models
        self.models = {
            "clip": options.clip or self.shipped,
            "autoencoder": options.autoencoder or self.shipped,
        }
        parts: tuple[Part, ...] = ("clip", "encoders", "autoencoder", "generator")
        for part in parts:  # an unknown or absent model is reported before any work
            for name in filter(None, self.models.values()):
                shipped_folder(name, part)

    def stage(
        self,
        name: str,
        inputs: Mapping[str, Any],
        after: tuple[str, ...],
        build: Callable[[Path], Mapping[str, Any]],
    ) -> Stage:
        """The stage, built unless it is there for the same inputs and the same earlier stages."""
        earlier = {n: self.run.stages[n].digest for n in after if n in self.run.stages}
        return self.run.stage(name, {**inputs, "seed": self.options.seed, **earlier}, build)

    @property
    def training(self) -> dict[str, Any]:
        """Options of every training."""
        options = self.options
        common = {"seed": options.seed, "cache": self.cache, "device": options.device}
        return {**common, "progress": self.progress}

    def pixels(self, manifest: Manifest) -> Any:
        """The tactile images at the generator's size."""
        size = self.diffusion.size
        return cached_images(manifest, "tactile", size, self.cache, self.progress)

    def world(self, name: str, options: WorldOptions) -> Path:
        """A rendered world; it does not depend on the run's seed."""

        def build(folder: Path) -> dict[str, Any]:
            workers, progress = self.options.workers, self.progress
            record = write_world(folder / "tree", options, workers=workers, progress=progress)
            return {"digest": record.digest, "preset": self.options.preset}

        stage = self.run.stage(name, {"options": options, "digest": options.digest}, build)
        return stage.folder / "tree"

    def data(self) -> Manifest:
        """The manifest of the given data, or of the embedded world."""
        source = self.options.data or self.world("world", self.preset.world)
        judged = any(map(is_shipped, filter(None, self.models.values())))
        if judged:
            require_unseen(source)
        size = None if self.options.data is None else 4 * self.diffusion.size

        def build(folder: Path) -> dict[str, Any]:
            options: dict[str, Any] = {"size": size, "overwrite": True, "progress": self.progress}
            options["skip_bad"] = self.options.skip_bad
            imported = import_dataset(source, folder, **options)
            return {
                "digest": imported.manifest.digest,
                "dataset": imported.facts.get("dataset", source.name),
                "samples": len(imported.manifest),
                "skipped": [str(p) for p in imported.skipped],
                "inconclusive": imported.inconclusive,
                "facts": dict(imported.facts),
            }

        inputs = {"source": str(source.resolve()), "stamp": stamp(source), "size": size}
        inputs |= {"skip_bad": self.options.skip_bad}
        world = self.run.stages["world"].digest if "world" in self.run.stages else None
        stage = self.run.stage("data", {**inputs, "world": world}, build)
        manifest = Manifest.load(stage.folder)
        if judged:  # images may lie elsewhere than the source
            require_unseen(manifest.root, manifest.facts)
        return manifest

    def split(self, manifest: Manifest) -> tuple[Split, list[Audit]]:
        """The leak-free split, and the audits of it and of the data set's own splits."""
        splits = sorted((self.run.stages["data"].folder / "splits").glob("*.json"))
        options, preset = self.options, self.preset

        def build(folder: Path) -> dict[str, Any]:
            clean = leak_free_split(manifest, train=preset.train, by=options.by, seed=options.seed)
            clean.save(folder / "noleak.json")
            how: dict[str, Any] = {"cache": self.cache, "progress": self.progress}
            audits = [
                audit(manifest, split=path, name=path.stem, by="video", **how)
                for path in splits
                if Split.load(path).ids("test")
            ]
            group = str(clean.rule["group"])
            name = "NoLeak" if group == "video" else f"NoLeak by {group}"
            audits.append(audit(manifest, split=clean, by=group, name=name, **how))
            if group != "video" and not manifest.table["video"].null_count():
                name = f"{name}, seen by video"
                audits.append(audit(manifest, split=clean, by="video", name=name, images=False))
            write_json(folder / "audits.json", [a.to_json() for a in audits])
            return {"digest": clean.digest, "counts": clean.counts(), "rule": dict(clean.rule)}

        inputs = {"manifest": manifest.digest, "root": str(manifest.root), "train": preset.train}
        inputs |= {"by": options.by, "own": [digest_file(p) for p in splits]}
        folder = self.stage("split", inputs, (), build).folder
        audits = [Audit.from_json(a) for a in read_json(folder / "audits.json", "audits")]
        return Split.load(folder / "noleak.json"), audits

    def pretraining(self, manifest: Manifest, split: Split) -> Manifest:
        """Another world's samples and the train part: what the frozen models may see."""
        tree = self.world("pretraining", self.preset.pretraining)

        def build(folder: Path) -> dict[str, Any]:
            imported = import_dataset(tree, folder, overwrite=True, progress=self.progress)
            return {"digest": imported.manifest.digest, "samples": len(imported.manifest)}

        world = {"pretraining": self.run.stages["pretraining"].digest}
        stage = self.run.stage("pretraining-data", world, build)
        other = Manifest.load(stage.folder)
        # Prefixed, so that a user's copy of this world does not collide with it.
        return Manifest.join(other.prefixed("pretraining/"), manifest.part(split, "train"))

    def clip(self, pretraining: Manifest | None) -> str:
        """A small CLIP trained on photos and texts; returns its folder."""
        assert pretraining is not None

        def build(folder: Path) -> dict[str, Any]:
            everything, place = _all_train(pretraining), folder / "training"
            clip = train_clip(pretraining, everything, self.encoder, place, **self.training)
            clip.save(fresh(folder / "clip"))
            digests = {"digest": clip.digest("vision"), "text": clip.digest("text")}
            return {**digests, "samples": len(pretraining)}

        inputs = {"preset": self.encoder, "train": pretraining.digest}
        stage = self.stage("clip", inputs, ("pretraining-data", "split", "data"), build)
        return str(stage.folder / "clip")

    def autoencoder(self, pretraining: Manifest | None, manifest: Manifest, split: Split) -> str:
        """A small autoencoder of tactile images; returns its folder."""
        assert pretraining is not None
        options = self.diffusion.autoencoder
        if options is None:
            must = f"must be given for the preset {self.diffusion.name}"
            raise PalpateError(must, "none", "Pass a hub id or a folder", argument="autoencoder")
        test = manifest.part(split, "test")
        both = Manifest.join(pretraining, test)  # the first holds the train part
        parts = Split.from_ids(
            train=pretraining.ids, test=test.ids, rule={"name": "pretraining"}, manifest=both.digest
        )

        def build(folder: Path) -> dict[str, Any]:
            model = autoencoder_of(
                both,
                parts,
                options,
                self.diffusion.size,
                folder / "training",
                cache=self.cache,
                seed=self.options.seed,
                device=self.options.device,
                progress=self.progress,
            )
            model.save(fresh(folder / "autoencoder"))
            ceiling = model.card["held_out"]
            return {"digest": model.digest, "images": len(pretraining), "ceiling on test": ceiling}

        inputs = {"options": options, "size": self.diffusion.size, "train": pretraining.digest}
        after = ("pretraining-data", "split", "data")
        return str(self.stage("autoencoder", inputs, after, build).folder / "autoencoder")

    def encoders(
        self, manifest: Manifest, split: Split, clip: str, pretraining: Manifest | None
    ) -> EncoderSet:
        """The frozen CLIP with a tactile encoder trained on the train part.

        The training starts from the shipped tactile encoder of a shipped CLIP, from one trained on
        the pretraining samples first, or from random weights.
        """
        ready = clip if is_shipped(clip) else None

        def build(folder: Path) -> dict[str, Any]:
            frozen = load_clip(clip, device=self.options.device)
            before, after = self.preset.tactile_epochs
            common = (frozen, self.encoder)
            how: dict[str, Any] = dict(self.training)
            if ready is not None:
                how |= {"start": EncoderSet.load(ready), "epochs": after}
            elif pretraining is not None:
                everything, place = _all_train(pretraining), folder / "pretraining"
                first = train_tactile(pretraining, everything, *common, place, epochs=before, **how)
                how |= {"start": first, "epochs": after}
            encoders = train_tactile(manifest, split, *common, folder / "training", **how)
            encoders.save(fresh(folder / "encoders"))
            source = encoders.card.get("text_source")
            return {"digest": encoders.digest("tactile"), "text_source": source}

        inputs = {
            "preset": self.encoder,
            "clip": self._model_stamp("clip", clip),
            "start": ready and self._model_stamp("encoders", ready),
            "epochs": self.preset.tactile_epochs,
        }
        names = ("split", "data") + (("pretraining-data",) if pretraining is not None else ())
        return EncoderSet.load(self.stage("encoders", inputs, names, build).folder / "encoders")

    def generator(
        self, manifest: Manifest, split: Split, encoders: EncoderSet, autoencoder: str
    ) -> TactilePipeline:
        """The trained pipeline."""
        all_shipped = self.shipped is not None and {*self.models.values()} == {self.shipped}
        fits = all_shipped and self.preset.start and not self.options.background
        start = self.shipped if fits else None

        def build(folder: Path) -> dict[str, Any]:
            pipeline = train_pipeline(
                manifest,
                split,
                encoders,
                load_autoencoder(autoencoder),
                self.diffusion,
                folder / "training",
                background=self.options.background,
                start=TactilePipeline.from_pretrained(start) if start else None,
                **self.training,
            )
            pipeline.save(fresh(folder / "model"))
            loop, test = pipeline.training["loop"], manifest.part(split, "test")
            images, gels = self.pixels(test), gels_of(test, self.diffusion.size, self.cache)
            given = gels if isinstance(pipeline.autoencoder, BackgroundAutoencoder) else None
            ceiling = measure_reconstruction(pipeline.autoencoder, images, given)
            return {
                "ceiling on test": dataclasses.asdict(ceiling),
                "digest": pipeline.digest,
                "parameters": pipeline.training["parameters"],
                "steps": loop["steps"],
                "batch": loop["batch"],
                "learning_rate": loop["lr"],
                "source": pipeline.training["source"],
                "background": pipeline.background,
                "sampler": dataclasses.asdict(pipeline.sampler),
            }

        inputs = {
            "preset": self.diffusion,
            "autoencoder": self._model_stamp("autoencoder", autoencoder),
            "background": self.options.background,
            "start": start and self._model_stamp("generator", start),
        }
        stage = self.stage("generator", inputs, ("split", "data", "encoders"), build)
        return TactilePipeline.from_pretrained(stage.folder / "model")

    def generated(self, manifest: Manifest, split: Split, pipeline: TactilePipeline) -> Generated:
        """A tactile image for each photo of the test part."""

        def build(folder: Path) -> dict[str, Any]:
            how: dict[str, Any] = {"seed": self.options.seed, "progress": self.progress}
            output = folder / "generated"
            generated = generate(manifest, split=split, model=pipeline, output=output, **how)
            return {"images": len(generated.ids)}

        inputs = {"pipeline": pipeline.digest, "sampler": pipeline.sampler}
        stage = self.stage("generated", inputs, ("split", "data"), build)
        return Generated.load(stage.folder / "generated")

    def scores(
        self, manifest: Manifest, split: Split, generated: Generated, encoders: EncoderSet
    ) -> list[Score]:
        """The scores of the generated images and of the controls."""

        def build(folder: Path) -> dict[str, Any]:
            nearest = self.nearest(manifest, split, encoders, folder / "nearest")
            results = score(
                [generated.folder, nearest],
                manifest,
                encoder=encoders,
                split=split,
                names=["generated", NEAREST],
                presets=("grouped", "paper"),
                companions=("ssim", "psnr"),
                seed=self.options.seed,
                cache=self.cache,
                progress=self.progress,
                allow_seen=True,  # data may be a copy of the pretraining world; the scores say so
            )
            write_json(folder / "scores.json", [s.to_json() for s in results])
            return {"scores": len(results)}

        inputs = {"encoder": encoders.digest("tactile"), "controls": [NEAREST]}
        stage = self.stage("scores", inputs, ("split", "data", "generated", "encoders"), build)
        return [Score.from_json(s) for s in read_json(stage.folder / "scores.json", "scores")]

    def nearest(self, manifest: Manifest, split: Split, encoders: EncoderSet, folder: Path) -> Path:
        """For each test photo the tactile image of the nearest train photo, as generators' are."""
        train, test = manifest.part(split, "train"), manifest.part(split, "test")
        rows = nearest_rows(train, test, encoders, cache=self.cache, progress=self.progress)
        write_images(folder, test.ids, self.pixels(train)[rows])
        return folder

    def _model_stamp(self, part: Part, source: str) -> str:
        """What names a model: its stage's digest, that of its folder or file, or its hub id."""
        if (shipped := shipped_folder(source, part)) is not None:
            return digest_folder(shipped, "**/*.json")  # they hold the digests of the weights
        if part in self.run.stages:
            return self.run.stages[part].digest
        if Path(source).is_file():
            return digest_file(Path(source))
        return digest_folder(Path(source)) if Path(source).is_dir() else source


def require_unseen(source: Path, facts: Mapping[str, str] | None = None) -> None:
    """Raise for data that the shipped models were trained on: it cannot judge them.

    Args:
        source: a world, or any file or folder of one; the nearest ``world.json`` there or above
            decides.
        facts: of the manifest made of it; they hold the world's seed where ``world.json`` is out of
            sight.
    """
    place = Path(source).resolve()
    marks = (folder / "world.json" for folder in (place, *place.parents))
    mark = next((m for m in marks if m.is_file()), None)
    record = read_json(mark, "world record") if mark is not None else {}
    seen = isinstance(record, dict) and bool(record.get("seen_by_shipped_models"))
    seed = (facts or {}).get("world_seed", "")
    if seen or (seed.isdecimal() and int(seed) in MINI_SEEDS):
        must = "The shipped models must not have been trained on the data that they are judged on"
        fix = "Write a world of another seed, or train from scratch"
        example = {"from_scratch": True}
        raise PalpateError(must, f"{source}", fix, example=example)


def _all_train(manifest: Manifest) -> Split:
    """A split whose train part is everything."""
    rule = {"name": "pretraining"}
    return Split.from_ids(train=manifest.ids, rule=rule, manifest=manifest.digest)


def stamp(source: Path) -> str:
    """Names, sizes and modification times of the files of a data set: changes when it does."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    return digest_lines(
        f"{p.relative_to(source)} {(s := p.stat()).st_size} {s.st_mtime_ns}" for p in files
    )
