"""The main job as a graph of stages: photos in, a page's worth of results out.

::

    world -> data -> split -> (pretraining world -> clip -> autoencoder) -> encoders -> generator -> generated -> scores

Each stage reads the ones before it and is kept in the run folder under the digest of what it read
(:class:`palpate.core.Run`), so a run that was killed goes on from its last finished stage, and a changed option
redoes only what depends on it. ``world`` is skipped where data is given. The stages in brackets train small stand-ins for
pretrained models; they are skipped where such models are given or taken from those that ship with the package, which is the
preset's choice (:attr:`PipelinePreset.models`). What each model saw stands in its card, which the next model's card contains.
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

import numpy as np

from palpate import __version__
from palpate.core import (
    PalpateError,
    Progress,
    Run,
    Score,
    Split,
    Stage,
    digest_file,
    digest_folder,
    digest_lines,
    quiet,
    read_json,
    write_json,
)
from palpate.data.images import cached_images
from palpate.data.importing import import_dataset
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import Autoencoder
from palpate.diffusion.autoencoder_training import train_autoencoder
from palpate.diffusion.generation import Generated, generate
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import preset_named as diffusion_preset
from palpate.diffusion.training import train_pipeline
from palpate.encoders.contrastive import train_clip, train_tactile
from palpate.encoders.embed import texts_of
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import Part, is_shipped, pick_device, shipped_folder
from palpate.encoders.presets import preset as encoder_preset
from palpate.evaluation.scoring import score
from palpate.leakage.auditing import audit as audit_split
from palpate.leakage.splitting import split as leak_free_split
from palpate.report.results import Audit
from palpate.sim import WorldOptions, write_world
from palpate.studies.inputs import fresh, reconstruction, repeats, require_unseen, stamp_of
from palpate.studies.presets import preset as pipeline_preset


@dataclass(frozen=True)
class PipelineOptions:
    """What to run.

    Attributes:
        preset: see :data:`palpate.studies.presets.PRESETS`.
        data: a data set on disk, or None for the embedded world.
        clip: shipped name, hub id or folder of a pretrained CLIP; None: the preset's choice.
        autoencoder: shipped name, hub id or folder of a pretrained VQ model; None: the preset's choice.
        from_scratch: where ``clip`` or ``autoencoder`` is None, train a small one first, and take nothing that ships.
        group: what the split keeps whole; ``auto`` falls back to touches where videos are too few.
        seed: of the split, the weights, the order of training and the noise.
        skip_bad: leave bad rows and images of ``data`` out and list them.
        background: train the variant that sees the no-contact image.
        device: ``auto``, ``cpu``, ``cuda`` ...
        workers: processes that render the world.
    """

    preset: str = "mini"
    data: Path | None = None
    clip: str | None = None
    autoencoder: str | None = None
    from_scratch: bool = False
    group: str = "auto"
    seed: int = 0
    skip_bad: bool = False
    background: bool = False
    device: str = "auto"
    workers: int = 2


@dataclass(frozen=True)
class PipelineOutcome:
    """Everything that a finished run holds; see the stages' folders for the files.

    Attributes:
        manifest, split: the data and the leak-free split that was trained and scored on.
        audits: of the data set's own splits, if it has any, and of ours.
        generated: the touches made for the test part.
        scores: see :func:`palpate.evaluation.score`.
        stages: by name, with digests, facts and times.
        options: what was asked for.
        models: the pretrained models that were taken, by role (``clip``, ``autoencoder``); None: trained in the run.
    """

    manifest: Manifest
    split: Split
    audits: list[Audit]
    generated: Generated
    scores: list[Score]
    stages: Mapping[str, Stage]
    options: PipelineOptions
    models: Mapping[str, str | None]

    def settings(self) -> dict[str, Any]:
        """Options, digests, versions and times, for the page."""
        packages = ("numpy", "torch", "diffusers", "transformers", "polars", "pillow")
        return {
            "models": dict(self.models),
            "options": {
                k: str(v) if isinstance(v, Path) else v
                for k, v in dataclasses.asdict(self.options).items()
            },
            "digests": {"manifest": self.manifest.digest, "split": self.split.digest}
            | {
                name: stage.facts["digest"]
                for name, stage in self.stages.items()
                if "digest" in stage.facts
            },
            "split rule": dict(self.split.rule),
            "stages": {
                name: {k: v for k, v in stage.facts.items() if k not in ("digest", "audits")}
                for name, stage in self.stages.items()
            },
            "seconds": {name: round(stage.seconds, 1) for name, stage in self.stages.items()},
            "versions": {"palpate": __version__, "python": platform.python_version()}
            | {p: metadata.version(p) for p in packages},
            "machine": f"{platform.machine()}, {_cores()} cores",
        }


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_pipeline(
    options: PipelineOptions,
    out: Path,
    *,
    say: Callable[[str], None] = lambda line: None,
    progress: Progress = quiet,
) -> PipelineOutcome:
    """Runs all stages, or those that are not there yet for the same inputs.

    Args:
        options: what to run.
        out: run folder; stopping and running again with the same folder goes on.
        say: called with one line a stage.
        progress: told what is being done within a stage.

    Raises:
        PalpateError: on bad data or options; finished stages stay.
    """
    work = _Pipeline(options, Run(Path(out), say), progress)
    manifest = work.data()
    split, audits = work.split(manifest)
    pretraining = (
        None
        if work.ready["clip"] and work.ready["autoencoder"]
        else work.pretraining(manifest, split)
    )
    clip = work.ready["clip"] or work.clip(pretraining)
    autoencoder = work.ready["autoencoder"] or work.autoencoder(pretraining, manifest, split)
    encoders = work.encoders(manifest, split, clip, pretraining)
    model = work.generator(manifest, split, encoders, autoencoder)
    generated = work.generated(manifest, split, model)
    scores = work.scores(manifest, split, generated, encoders)
    return PipelineOutcome(
        manifest, split, audits, generated, scores, work.run.stages, options, work.ready
    )


class _Pipeline:
    """The stages; each method returns what later ones read."""

    def __init__(self, options: PipelineOptions, run: Run, progress: Progress) -> None:
        if options.data is not None and not options.data.exists():
            raise PalpateError("The data must exist", f"nothing at {options.data}", "Check --data")
        self.options, self.run, self.progress = options, run, progress
        self.preset = pipeline_preset(options.preset)
        self.encoder = encoder_preset(self.preset.encoder)
        self.diffusion = diffusion_preset(self.preset.diffusion)
        self.cache = run.folder / "cache"
        self.shipped = None if options.from_scratch else self.preset.models
        #: Pretrained models by role; None: trained in this run.
        self.ready = {
            "clip": options.clip or self.shipped,
            "autoencoder": options.autoencoder or self.shipped,
        }
        for part in (
            "clip",
            "encoders",
            "autoencoder",
            "generator",
        ):  # an unknown or absent model is told now, not minutes later
            for name in filter(None, self.ready.values()):
                shipped_folder(name, part)

    def _digest(self, *names: str) -> dict[str, str]:
        return {name: self.run.stages[name].digest for name in names if name in self.run.stages}

    def _world(self, name: str, options: WorldOptions) -> Path:
        def build(folder: Path) -> dict[str, Any]:
            record = write_world(
                folder / "tree", options, workers=self.options.workers, progress=self.progress
            )
            return {"digest": record.digest, "preset": self.options.preset}

        return (
            self.run.stage(name, {"options": options, "digest": options.digest}, build).folder
            / "tree"
        )

    def data(self) -> Manifest:
        """The manifest of the given data, or of the embedded world."""
        source = (
            self.options.data
            if self.options.data is not None
            else self._world("world", self.preset.world)
        )
        if judged := any(map(is_shipped, filter(None, self.ready.values()))):
            require_unseen(source)
        size = None if self.options.data is None else 4 * self.diffusion.size

        def build(folder: Path) -> dict[str, Any]:
            done = import_dataset(
                source, folder, skip_bad=self.options.skip_bad, size=size, progress=self.progress
            )
            texts_of(
                done.manifest
            )  # a sample with neither text nor a known material is refused now, not minutes later
            return {
                "digest": done.manifest.digest,
                "dataset": done.facts.get("dataset", source.name),
                "samples": len(done.manifest),
                "skipped": [str(p) for p in done.skipped],
                "inconclusive": done.inconclusive,
                "facts": dict(done.facts),
            }

        inputs = {
            "source": str(source.resolve()),
            "stamp": stamp_of(source),
            "skip_bad": self.options.skip_bad,
            "size": size,
        }
        stage = self.run.stage("data", inputs | self._digest("world"), build)
        manifest = Manifest.load(stage.folder)
        if judged:
            require_unseen(
                manifest.root, manifest.facts
            )  # images may lie elsewhere than what was named
        return manifest

    def split(self, manifest: Manifest) -> tuple[Split, list[Audit]]:
        """The leak-free split, and the audits of it and of the data set's own."""
        own = sorted((self.run.stages["data"].folder / "splits").glob("*.json"))

        def build(folder: Path) -> dict[str, Any]:
            made = leak_free_split(
                manifest, train=self.preset.train, by=self.options.group, seed=self.options.seed
            )
            made.save(folder / "noleak.json")
            options: dict[str, Any] = {"cache": self.cache, "progress": self.progress}
            audits = [
                audit_split(manifest, split=path, name=path.stem, by="video", **options)
                for path in own
                if Split.load(path).ids("test")
            ]
            group = str(made.rule["group"])
            name = "NoLeak" if group == "video" else f"NoLeak by {group}"
            audits.append(audit_split(manifest, split=made, by=group, name=name, **options))
            if group != "video" and not manifest.table["video"].null_count():
                name = f"{name}, seen by video"
                audits.append(
                    audit_split(manifest, split=made, by="video", name=name, images=False)
                )
            write_json(folder / "audits.json", [a.to_json() for a in audits])
            return {"digest": made.digest, "counts": made.counts(), "rule": dict(made.rule)}

        inputs = {
            "manifest": manifest.digest,
            "root": str(manifest.root),
            "train": self.preset.train,
            "group": self.options.group,
        }
        stage = self.run.stage(
            "split",
            inputs | {"seed": self.options.seed, "own": [digest_file(p) for p in own]},
            build,
        )
        return Split.load(stage.folder / "noleak.json"), [
            Audit.from_json(a) for a in read_json(stage.folder / "audits.json", "audits")
        ]

    def pretraining(self, manifest: Manifest, split: Split) -> Manifest:
        """Another world's samples, joined with the train part: what the frozen models may see."""
        tree = self._world("pretraining", self.preset.pretraining)

        def build(folder: Path) -> dict[str, Any]:
            done = import_dataset(tree, folder, progress=self.progress)
            return {"digest": done.manifest.digest, "samples": len(done.manifest)}

        stage = self.run.stage("pretraining-data", self._digest("pretraining"), build)
        # Prefixed, so that a user's own copy of this world does not collide with it.
        return Manifest.join(
            Manifest.load(stage.folder).prefixed("pretraining/"), manifest.part(split, "train")
        )

    def clip(self, pretraining: Manifest | None) -> str:
        """A small CLIP trained on photos and texts; returns its folder."""
        assert pretraining is not None

        def build(folder: Path) -> dict[str, Any]:
            everything = Split.from_ids(
                train=pretraining.ids, rule={"name": "pretraining"}, manifest=pretraining.digest
            )
            clip = train_clip(
                pretraining,
                everything,
                self.encoder,
                folder / "training",
                seed=self.options.seed,
                cache=self.cache,
                device=self.options.device,
                progress=self.progress,
            )
            clip.save(fresh(folder / "clip"))
            return {
                "digest": clip.digest("vision"),
                "text": clip.digest("text"),
                "samples": len(pretraining),
            }

        inputs = {"preset": self.encoder, "train": pretraining.digest, "seed": self.options.seed}
        return str(
            self.run.stage(
                "clip", inputs | self._digest("pretraining-data", "split", "data"), build
            ).folder
            / "clip"
        )

    def autoencoder(self, pretraining: Manifest | None, manifest: Manifest, split: Split) -> str:
        """A small VQ autoencoder of touches; returns its folder. Its reconstruction bounds every score of pictures."""
        assert pretraining is not None
        options = self.diffusion.autoencoder
        if options is None:
            raise PalpateError(
                f"The preset {self.diffusion.name} needs a trained autoencoder",
                "none",
                "Pass --autoencoder HUB_ID_OR_FOLDER",
            )
        own = manifest.part(split, "train")

        def build(folder: Path) -> dict[str, Any]:
            images = cached_images(
                pretraining, "tactile", self.diffusion.size, self.cache, self.progress
            )
            mine = cached_images(own, "tactile", self.diffusion.size, self.cache, self.progress)
            images = np.concatenate(
                [images, *[mine] * repeats(len(images), len(mine), self.preset.repeat)]
            )
            key = digest_lines([pretraining.digest, own.digest])
            held_out = cached_images(
                manifest.part(split, "test"),
                "tactile",
                self.diffusion.size,
                self.cache,
                self.progress,
            )
            model = train_autoencoder(
                images,
                options,
                folder / "training",
                held_out=held_out,
                seed=self.options.seed,
                key=key,
                device=pick_device(self.options.device),
                progress=self.progress,
            )
            model.save(fresh(folder / "autoencoder"))
            return {
                "digest": model.digest,
                "images": len(images),
                "on test touches": model.card["held_out"],
            }

        inputs = {
            "options": options,
            "size": self.diffusion.size,
            "train": pretraining.digest,
            "own": own.digest,
        }
        stage = self.run.stage(
            "autoencoder",
            inputs
            | {"seed": self.options.seed, "repeat": self.preset.repeat}
            | self._digest("pretraining-data", "split", "data"),
            build,
        )
        return str(stage.folder / "autoencoder")

    def encoders(
        self, manifest: Manifest, split: Split, clip: str, pretraining: Manifest | None
    ) -> EncoderSet:
        """The frozen pair with a tactile encoder, trained on the train part, from where there is something to go on from.

        That is the shipped tactile encoder beside the shipped CLIP, or one trained on the pretraining samples first; else random weights.
        """
        ready = clip if is_shipped(clip) else None

        def build(folder: Path) -> dict[str, Any]:
            frozen = load_clip(clip, device=self.options.device)
            common: dict[str, Any] = {
                "seed": self.options.seed,
                "cache": self.cache,
                "device": self.options.device,
                "progress": self.progress,
            }
            before, after = self.preset.touch_epochs
            if ready is not None:
                start = EncoderSet.load(ready)
                encoders = train_tactile(
                    manifest,
                    split,
                    frozen,
                    self.encoder,
                    folder / "training",
                    epochs=after,
                    start=start,
                    **common,
                )
            elif pretraining is None:
                encoders = train_tactile(
                    manifest, split, frozen, self.encoder, folder / "training", **common
                )
            else:
                everything = Split.from_ids(
                    train=pretraining.ids, rule={"name": "pretraining"}, manifest=pretraining.digest
                )
                start = train_tactile(
                    pretraining,
                    everything,
                    frozen,
                    self.encoder,
                    folder / "pretraining",
                    epochs=before,
                    **common,
                )
                encoders = train_tactile(
                    manifest,
                    split,
                    frozen,
                    self.encoder,
                    folder / "training",
                    epochs=after,
                    start=start,
                    **common,
                )
            encoders.save(fresh(folder / "encoders"))
            return {
                "digest": encoders.digest("tactile"),
                "text_source": encoders.card.get("text_source"),
            }

        inputs = {
            "preset": self.encoder,
            "clip": self._model_stamp("clip", clip),
            "start": ready and self._model_stamp("encoders", ready),
            "seed": self.options.seed,
            "epochs": self.preset.touch_epochs,
        }
        names = ("split", "data") + (("pretraining-data",) if pretraining is not None else ())
        stage = self.run.stage("encoders", inputs | self._digest(*names), build)
        return EncoderSet.load(stage.folder / "encoders")

    def generator(
        self, manifest: Manifest, split: Split, encoders: EncoderSet, autoencoder: str
    ) -> TactilePipeline:
        """The trained pipeline."""
        fits = (
            self.shipped is not None
            and set(self.ready.values()) == {self.shipped}
            and not self.options.background
        )
        start = self.shipped if self.preset.start and fits else None

        def build(folder: Path) -> dict[str, Any]:
            pipeline = train_pipeline(
                manifest,
                split,
                encoders,
                Autoencoder.load(autoencoder),
                self.diffusion,
                folder / "training",
                seed=self.options.seed,
                background=self.options.background,
                start=TactilePipeline.from_pretrained(start) if start else None,
                cache=self.cache,
                device=self.options.device,
                progress=self.progress,
            )
            pipeline.save(fresh(folder / "model"))
            loop, model = pipeline.training["loop"], pipeline.autoencoder
            return {
                "autoencoder on test touches": reconstruction(
                    manifest, split, model, pipeline.size, self.cache, self.progress
                ),
                "digest": pipeline.digest,
                "parameters": pipeline.training["parameters"],
                "steps": loop["steps"],
                "batch": loop["batch"],
                "learning_rate": loop["lr"],
                "source": pipeline.training["source"],
                "sampler": dataclasses.asdict(pipeline.sampler),
            }

        inputs = {
            "preset": self.diffusion,
            "autoencoder": self._model_stamp("autoencoder", autoencoder),
            "background": self.options.background,
            "start": start and self._model_stamp("generator", start),
        }
        stage = self.run.stage(
            "generator",
            inputs | {"seed": self.options.seed} | self._digest("split", "data", "encoders"),
            build,
        )
        return TactilePipeline.from_pretrained(stage.folder / "model")

    def generated(self, manifest: Manifest, split: Split, pipeline: TactilePipeline) -> Generated:
        """A touch for each photo of the test part."""

        def build(folder: Path) -> dict[str, Any]:
            made = generate(
                manifest.part(split, "test"),
                model=pipeline,
                output=folder / "touches",
                seed=self.options.seed,
                progress=self.progress,
            )
            return {"images": len(made.ids)}

        inputs = {
            "pipeline": pipeline.digest,
            "sampler": pipeline.sampler,
            "seed": self.options.seed,
        }
        return Generated.load(
            self.run.stage("generated", inputs | self._digest("split", "data"), build).folder
            / "touches"
        )

    def scores(
        self, manifest: Manifest, split: Split, generated: Generated, encoders: EncoderSet
    ) -> list[Score]:
        """The scores of the generated touches and of the controls."""

        def build(folder: Path) -> dict[str, Any]:
            results = score(
                generated.folder,
                manifest,
                encoder=encoders,
                split=split,
                names=["generated"],
                presets=("grouped", "paper"),
                companions=("ssim", "psnr"),
                seed=self.options.seed,
                cache=self.cache,
                progress=self.progress,
            )
            write_json(folder / "scores.json", [s.to_json() for s in results])
            return {"scores": len(results)}

        inputs = {"encoder": encoders.digest("tactile"), "seed": self.options.seed}
        stage = self.run.stage(
            "scores", inputs | self._digest("split", "data", "generated", "encoders"), build
        )
        return [Score.from_json(s) for s in read_json(stage.folder / "scores.json", "scores")]

    def _model_stamp(self, part: Part, source: str) -> str:
        """What names a ready model: its stage's digest, the digest of its folder, or its hub id."""
        if (shipped := shipped_folder(source, part)) is not None:
            return digest_folder(shipped, "**/*.json")  # they hold the digests of the weights
        if part in self.run.stages:
            return self.run.stages[part].digest
        return digest_folder(Path(source)) if Path(source).is_dir() else source
