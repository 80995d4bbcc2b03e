"""The demo: photos in, a page of results out, as a graph of stages.

::

    world -> data -> split -> encoders -> generator -> generated -> scores

Each stage is kept in the run folder under the digest of what it read
(:mod:`palpate.studies.graph`): a killed run resumes from its last finished stage, and a
changed option rebuilds only what depends on it. ``world`` is skipped where data is given. Training
goes on from the models that ship.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core import (
    PalpateError,
    Progress,
    Score,
    Split,
    digest_file,
    digest_folder,
    digest_json,
    digest_lines,
    quiet,
    read_json,
    require_choice,
    write_json,
)
from palpate.data.images import cached_images
from palpate.data.importing import import_dataset
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoders import load_autoencoder
from palpate.diffusion.generation import Generated, generate
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.training import train_pipeline
from palpate.encoders.contrastive import train_tactile
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import Part, shipped_folder
from palpate.evaluation.scoring import score
from palpate.leakage.auditing import audit
from palpate.leakage.splitting import split as leak_free_split
from palpate.report.results import Audit
from palpate.sim.presets import MINI_SEEDS
from palpate.studies.controls import NEAREST, nearest_rows
from palpate.studies.graph import Node, run_graph
from palpate.studies.making import After, cache_of, fresh, make_world, write_images
from palpate.studies.methods import SHIPPED
from palpate.studies.presets import PRESETS
from palpate.studies.stages import Stage


@dataclass(frozen=True)
class DemoOptions:
    """What to run.

    Attributes:
        preset: see :data:`palpate.studies.presets.PRESETS`.
        data: a data set on disk, or None for the embedded world.
        seed: of the split, the weights, the order of training and the noise.
        device: ``auto``, ``cpu``, ``cuda`` ...
    """

    preset: str = "mini"
    data: Path | None = None
    seed: int = 0
    device: str = "auto"


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
    """

    manifest: Manifest
    split: Split
    audits: list[Audit]
    generated: Generated
    scores: list[Score]
    stages: Mapping[str, Stage]
    options: DemoOptions

    def settings(self) -> dict[str, Any]:
        """Options, digests, versions and times, for the page."""
        options = dataclasses.asdict(self.options)
        digests = {n: s.facts["digest"] for n, s in self.stages.items() if "digest" in s.facts}
        return {
            "dataset": self.stages["data"].facts["dataset"],
            "models": SHIPPED,
            "options": {k: str(v) if isinstance(v, Path) else v for k, v in options.items()},
            "digests": {"manifest": self.manifest.digest, "split": self.split.digest} | digests,
            "split rule": dict(self.split.rule),
            "stages": {
                name: {k: v for k, v in stage.facts.items() if k != "digest"}
                for name, stage in self.stages.items()
            },
            "seconds": {name: round(stage.seconds, 1) for name, stage in self.stages.items()},
            **self.stages["scores"].made_with,
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
        print_line: called with one line per stage, and with the time left.
        progress: called with what is done within a stage, and over the whole.

    Raises:
        PalpateError: on bad data or options; finished stages stay.
    """
    stages = run_graph(demo_nodes(options), folder, print_line=print_line, progress=progress)
    return demo_of(options, stages)


def demo_nodes(options: DemoOptions) -> list[Node]:
    """The graph of a demo.

    Raises:
        PalpateError: on bad options.
    """
    return _Demo(options).nodes()


def demo_of(options: DemoOptions, stages: Mapping[str, Stage]) -> DemoRun:
    """What finished stages hold."""
    after = {name: stage.folder for name, stage in stages.items()}
    manifest, split = _data(after)
    audits = [Audit.from_json(a) for a in read_json(after["split"] / "audits.json", "audits")]
    generated = Generated.load(after["generated"] / "generated")
    scores = [Score.from_json(s) for s in read_json(after["scores"] / "scores.json", "scores")]
    return DemoRun(manifest, split, audits, generated, scores, stages, options)


class _Demo:
    """The nodes, and the methods that build them: each fills its folder and reads earlier ones."""

    def __init__(self, options: DemoOptions) -> None:
        if options.data is not None and not options.data.exists():
            must, got = "must exist", f"nothing at {options.data}"
            raise PalpateError(must, got, "Check the path", argument="data")
        self.options = options
        require_choice("preset", options.preset, PRESETS)
        self.preset = PRESETS[options.preset]
        parts: tuple[Part, ...] = ("clip", "encoders", "autoencoder", "generator")
        self.models = {part: model_stamp(part, SHIPPED) for part in parts}

    def nodes(self) -> list[Node]:
        """The graph; data that is given has no node."""
        preset, seed, models = self.preset, {"seed": self.options.seed}, self.models
        data, nodes = self.options.data, list[Node]()
        if data is None:
            build = partial(make_world, options=preset.world)
            nodes.append(Node("world", build, {"options": preset.world}))
        inputs: dict[str, Any] = {"size": preset.diffusion.size}
        inputs |= {"source": data and str(data.resolve()), "stamp": data and stamp(data)}
        nodes.append(Node("data", self.data, inputs, ("world",) if data is None else ()))
        inputs = seed | {"train": preset.train}
        nodes.append(Node("split", self.split, inputs, ("data",), measures=True))
        inputs = {"preset": preset.encoder, "epochs": preset.tactile_epochs}
        inputs |= {"clip": models["clip"], "start": models["encoders"]}
        nodes.append(Node("encoders", self.encoders, seed | inputs, ("data", "split")))
        inputs = {"preset": preset.diffusion, "start": models["generator"]}
        inputs |= {"autoencoder": models["autoencoder"]}
        after = ["data", "split", "encoders"]
        nodes.append(Node("generator", self.generator, seed | inputs, after))
        nodes.append(Node("generated", self.generated, seed, ("data", "split", "generator")))
        after = ["data", "split", "generated", "encoders"]
        inputs = seed | {"controls": [NEAREST]}
        return [*nodes, Node("scores", self.scores, inputs, after, measures=True)]

    def how(self, place: Path, progress: Progress) -> dict[str, Any]:
        """Options of every training."""
        options = self.options
        common = {"seed": options.seed, "cache": cache_of(place), "device": options.device}
        return {**common, "progress": progress}

    def data(self, place: Path, after: After, progress: Progress) -> dict[str, Any]:
        """The manifest of the given data, or of the embedded world."""
        source = self.options.data or after["world"] / "tree"
        size = None if self.options.data is None else 4 * self.preset.diffusion.size
        require_unseen(source)
        imported = import_dataset(source, place, size=size, overwrite=True, progress=progress)
        # Images may lie elsewhere than the source.
        require_unseen(imported.manifest.root, imported.manifest.facts)
        return {
            "digest": imported.manifest.digest,
            "dataset": imported.facts.get("dataset", source.name),
            "samples": len(imported.manifest),
            "inconclusive": imported.inconclusive,
            "facts": dict(imported.facts),
        }

    def split(self, place: Path, after: After, progress: Progress) -> dict[str, Any]:
        """The leak-free split, and the audits of it and of the data set's own splits."""
        manifest, options = Manifest.load(after["data"]), self.options
        clean = leak_free_split(manifest, train=self.preset.train, by="auto", seed=options.seed)
        clean.save(place / "noleak.json")
        how: dict[str, Any] = {"cache": cache_of(place), "progress": progress}
        audits = [
            audit(manifest, split=path, name=path.stem, by="video", **how)
            for path in sorted((after["data"] / "splits").glob("*.json"))
            if Split.load(path).ids("test")
        ]
        group = str(clean.rule["group"])
        name = "NoLeak" if group == "video" else f"NoLeak by {group}"
        audits.append(audit(manifest, split=clean, by=group, name=name, **how))
        if group != "video" and not manifest.table["video"].null_count():
            name = f"{name}, seen by video"
            audits.append(audit(manifest, split=clean, by="video", name=name, images=False))
        write_json(place / "audits.json", [a.to_json() for a in audits])
        return {"digest": clean.digest, "counts": clean.counts(), "rule": dict(clean.rule)}

    def encoders(self, place: Path, after: After, progress: Progress) -> dict[str, Any]:
        """The frozen CLIP with a tactile encoder that goes on from the shipped one."""
        encoders = train_tactile(
            *_data(after),
            load_clip(SHIPPED, device=self.options.device),
            self.preset.encoder,
            place / "training",
            start=EncoderSet.load(SHIPPED),
            epochs=self.preset.tactile_epochs,
            **self.how(place, progress),
        )
        encoders.save(fresh(place / "encoders"))
        source = encoders.card.get("text_source")
        return {"digest": encoders.digest("tactile"), "text_source": source}

    def generator(self, place: Path, after: After, progress: Progress) -> dict[str, Any]:
        """The trained pipeline."""
        manifest, split = _data(after)
        pipeline = train_pipeline(
            manifest,
            split,
            EncoderSet.load(after["encoders"] / "encoders"),
            load_autoencoder(SHIPPED),
            self.preset.diffusion,
            place / "training",
            start=TactilePipeline.from_pretrained(SHIPPED),
            **self.how(place, progress),
        )
        pipeline.save(fresh(place / "model"))
        loop = pipeline.training["loop"]
        return {
            "ceiling": pipeline.training["ceiling"],
            "digest": pipeline.digest,
            "parameters": pipeline.training["parameters"],
            "steps": loop["steps"],
            "batch": loop["batch"],
            "learning_rate": loop["lr"],
            "source": pipeline.training["source"],
            "background": pipeline.background,
            "sampler": dataclasses.asdict(pipeline.sampler),
        }

    def generated(self, place: Path, after: After, progress: Progress) -> dict[str, Any]:
        """A tactile image for each photo of the test part."""
        manifest, split = _data(after)
        pipeline = TactilePipeline.from_pretrained(after["generator"] / "model")
        how: dict[str, Any] = {"seed": self.options.seed, "progress": progress}
        made = generate(manifest, split=split, model=pipeline, output=place / "generated", **how)
        return {"images": len(made.ids)}

    def scores(self, place: Path, after: After, progress: Progress) -> dict[str, Any]:
        """The scores of the generated images and of the controls."""
        manifest, split = _data(after)
        encoders, cache = EncoderSet.load(after["encoders"] / "encoders"), cache_of(place)
        train, test = manifest.part(split, "train"), manifest.part(split, "test")
        rows = nearest_rows(train, test, encoders, cache=cache, progress=progress)
        images = cached_images(train, "tactile", self.preset.diffusion.size, cache)
        write_images(place / "nearest", test.ids, images[rows])
        results = score(
            [after["generated"] / "generated", place / "nearest"],
            manifest,
            encoder=encoders,
            split=split,
            names=["generated", NEAREST],
            presets=("grouped", "paper"),
            companions=("ssim", "psnr"),
            seed=self.options.seed,
            cache=cache,
            progress=progress,
            allow_seen=True,  # an image may be in two videos; the scores say so
        )
        write_json(place / "scores.json", [s.to_json() for s in results])
        return {"scores": len(results)}


def _data(after: After) -> tuple[Manifest, Split]:
    """The manifest and the leak-free split."""
    return Manifest.load(after["data"]), Split.load(after["split"] / "noleak.json")


def model_stamp(part: Part, source: str | None) -> str | None:
    """What names a given model: the digest of its folder or file, or its hub id."""
    if source is None:
        return None
    if (shipped := shipped_folder(source, part)) is not None:
        record = read_json(shipped / "palpate.json", "model record")  # with digests of weights
        for card in {"card", "training"} & {*record}:  # what is trained from it carries the rest
            record[card] = {k: v for k, v in record[card].items() if k not in ("title", "summary")}
        return digest_json(record)
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
        raise PalpateError(must, f"{source}", "Write a world of another seed")


def stamp(source: Path) -> str:
    """Names, sizes and modification times of the files of a data set: changes when it does."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    return digest_lines(
        f"{p.relative_to(source)} {(s := p.stat()).st_size} {s.st_mtime_ns}" for p in files
    )
