"""From a study to its results: the nodes, and what is written of the finished ones.

::

    world -> data -> split -> encoder-SPLIT-SEED -> probe-SPLIT-SEED
                     split -> autoencoder-SPLIT -> controls-SPLIT
             autoencoder-SPLIT -> METHOD-SPLIT-SEED -> images-METHOD-SPLIT-SEED
    images, controls, encoder -> scores-SPLIT-by-JUDGE-SEED; scores and probes -> results

``results`` holds the means over seeds, tables and samples; ``results.json`` of the run folder is
that with the record of the run (settings, versions, times), and ``page.html`` and others show it.
The demo (:mod:`palpate.studies.demo`) is run in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpate.core import Progress, digest_file, quiet, require, require_choice
from palpate.data.samples import read_samples
from palpate.evaluation.scorers import Weights
from palpate.preference.scoring import PREFERENCE
from palpate.report.results import SILENT, Results
from palpate.sim.options import WorldOptions
from palpate.sim.presets import MINI_SEEDS
from palpate.studies import making
from palpate.studies.collecting import collect
from palpate.studies.graph import Node, Nodes, Stamped
from palpate.studies.judging import judge_images, probe_encoders
from palpate.studies.making import Training, require_unseen
from palpate.studies.methods import Method, shipped
from palpate.studies.names import NOLEAK, SHIPPED, SPLITS, images_node, scores_node, slug
from palpate.studies.running import run_graph
from palpate.studies.stages import PrintLine, Stage, record_of
from palpate.studies.stamps import data_stamp, function_stamp, model_stamp
from palpate.studies.study import STUDIES, Preset, Study
from palpate.studies.utility import USEFUL, Draws, measure_utility

if TYPE_CHECKING:
    from palpate.studies.demo import Demo


@dataclass(frozen=True)
class Plan:
    """A study with everything that a run of it chooses; checked before any work.

    Attributes:
        study: what is run.
        preset: name of its size.
        seeds: one training of every encoder and method each; splits and autoencoders are made once.
        root: the data set on disk, for a study that is not of the world.
        systems: name -> folder of images of the test part (of the split without leaks) that another
            system made.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        people: results of ``palpate preference score`` on images of the methods, or None.
        steps: optimizer steps of each method, in place of the preset's.
        vq: autoencoder of the paper's kind, in place of the preset's.
        weights: of FID, CMMD and LPIPS as published; without them their columns
            are missing.

    Raises:
        PalpateError: for a study of another's name, an unknown preset, no seeds, a root that is
            missing or not wanted, or a folder that is not there or has the name of a method.
    """

    study: Study
    preset: str = "mini"
    seeds: Sequence[int] = (0,)
    root: Path | str | None = None
    systems: Mapping[str, Path | str] = field(default_factory=dict[str, Path | str])
    device: str = "auto"
    people: Path | str | None = None
    steps: int | None = None
    vq: Path | str | None = None
    weights: Weights = field(default_factory=Weights)

    def __post_init__(self) -> None:
        study, seeds, root, people = self.study, self.seeds, self.root, self.people
        own, fix = STUDIES.get(study.name, study) == study, 'Use replace(study, name="mine", ...)'
        require(own, "study", "must have a name of its own", f"another {study.name}", fix=fix)
        require_choice("preset", self.preset, study.presets)
        once = 0 < len(seeds) == len({*seeds})
        require(once, "seeds", "must hold at least one seed, each once", list(seeds), (0, 1, 2))
        wanted = study.world is None
        must = f"must be {'given' if wanted else 'left out'} for the study {study.name}"
        fix = "Name the folder of the data set" if wanted else "Its data are made"
        require((root is not None) == wanted, "root", must, str(root or "none"), fix=fix)
        exists = root is None or Path(root).exists()
        require(exists, "root", "must exist", f"nothing at {root}", fix="Check the path")
        votes = [] if people is None else [s.metric for s in Results.load(people).scores]
        must, fix = "must hold scores of palpate preference score", "Pass what its -o wrote"
        require(people is None or PREFERENCE in votes, "people", must, f"{people}", fix=fix)
        size = self.size
        require(size.steps >= 4, "steps", "must be at least 4", size.steps)
        coded = size.vq is not None or not any(method.vq for method in study.methods)
        fix = "Pass the folder, hub id or .ckpt of latent diffusion's vq-f4"
        require(coded, "vq", f"must be given for preset {self.preset}", "none", fix=fix)
        taken = {slug(name) for name in (*(m.name for m in study.methods), *study.controls)}
        for name, folder in self.systems.items():
            must, fix = "must have a name of its own", "Choose another name"
            require(slug(name) not in taken, "method", must, name, fix=fix)
            must, got = f"{name} must be a folder of images", f"nothing at {folder}"
            require(Path(folder).is_dir(), "method", must, got, fix="Check the path")
        files = {"inception": [self.weights.inception], "lpips": self.weights.lpips or ()}
        for name, path in ((n, p) for n, paths in files.items() for p in paths if p is not None):
            exists = Path(path).is_file()
            require(exists, name, "must be a file", f"nothing at {path}", fix="Check the path")
        if size.clip == SHIPPED:
            seed = self.world and self.world.seed
            require(seed not in MINI_SEEDS, "world", "must be one that no shipped model saw", seed)
            if root is not None:
                require_unseen(Path(root))

    @property
    def size(self) -> Preset:
        """The preset, with what replaces its fields."""
        size = self.study.presets[self.preset]
        vq = size.vq if self.vq is None else str(self.vq)
        return replace(size, steps=size.steps if self.steps is None else self.steps, vq=vq)

    @property
    def world(self) -> WorldOptions | None:
        """The embedded world, where the data are that."""
        changes = self.study.world
        return None if changes is None else replace(self.size.world, **changes)

    def nodes(self) -> list[Node]:
        """The stages; those of another seed, method or split come on top of what is there."""
        graph = _Graph(self)
        graph.add_data()
        for split in SPLITS:
            graph.add_split(split)
        for seed, split in product(self.seeds, SPLITS):
            graph.add_encoders(split, seed)
            for method in self.study.trained_on(split):
                graph.add_method(method, split, seed)
        for name, folder in self.systems.items():
            graph.add(
                images_node(name, NOLEAK),
                making.take_images,
                *DATA,
                split=NOLEAK,
                folder=Stamped(folder, read_samples(folder, str(folder)).image_digest()),
                size=self.size.diffusion.size,
            )
        for seed, split, judge in product(self.seeds, SPLITS, SPLITS):
            graph.add_scores(split, judge, seed)
        graph.add_utility()
        graph.add_results()
        return graph

    def results(self, stages: Mapping[str, Stage], jobs: int = 1) -> Results:
        """The results of finished stages, with what was chosen, digests, versions and times."""
        facts, seeds = {name: stage.facts for name, stage in stages.items()}, self.seeds
        digests = {"manifest": facts["data"]["digest"]}
        digests |= {f"split {name}": facts["split"][name]["digest"] for name in SPLITS}
        for seed, split in product(seeds, SPLITS):
            digests[f"encoder {split} {seed}"] = facts[f"encoder-{split}-{seed}"]["digest"]
        digests |= {f"weights of {n}": stamp for n, stamp in _stamps(self.weights).items()}
        if self.people is not None:
            digests["people"] = digest_file(Path(self.people))
        results = Results.load(stages["results"].folder / "results.json")
        settings = {
            **results.settings,
            "study": self.study.name,
            "dataset": facts["data"]["dataset"],
            "preset": self.preset,
            "seeds": list(seeds),
            "options": {
                "root": self.root and str(self.root),
                "methods of others": {name: str(folder) for name, folder in self.systems.items()},
                "people": self.people and str(self.people),
                "steps of a method": self.size.steps,
                "vq": self.size.vq if isinstance(self.size.vq, str) else None,
                "weights": {
                    n: _absolute(path)
                    for n, path in vars(self.weights).items()
                    if path and n not in SILENT
                },
                "device": self.device,
                "jobs": jobs,
            },
            "digests": digests,
            **record_of(stages),
        }
        return replace(results, settings=settings)


def _absolute(path: Any) -> Any:
    """A path, or each of two, from anywhere; a hub id as it is."""
    if isinstance(path, tuple):
        return [_absolute(one) for one in path]
    return str(Path(path).resolve()) if Path(path).exists() else str(path)


def _stamps(weights: Weights) -> dict[str, Any]:
    """What names the weights of published metrics that are given."""
    stamps = {
        "clip": model_stamp("clip", weights.clip and str(weights.clip)),
        "inception": weights.inception and digest_file(Path(weights.inception)),
        "lpips": weights.lpips and [digest_file(Path(path)) for path in weights.lpips],
    }
    return {name: stamp for name, stamp in stamps.items() if stamp}


#: What nearly every node reads.
DATA = ("data", "split")


class _Graph(Nodes):
    """The nodes of a plan."""

    def __init__(self, plan: Plan) -> None:
        super().__init__()
        self.plan, self.study, self.size = plan, plan.study, plan.size
        # Other weights under the same name make other stages.
        self.clip = Stamped(self.size.clip, model_stamp("clip", self.size.clip))
        self.weights = Stamped(plan.weights, _stamps(plan.weights))

    def add_data(self) -> None:
        """World, data and splits."""
        study, root = self.study, self.plan.root
        if (world := self.plan.world) is not None:
            self.add("world", making.make_world, options=Stamped(world, [world, world.digest]))
        self.add(
            "data",
            making.read_data,
            *(node.name for node in self),
            read=Stamped(study.read, function_stamp(study.read)),
            root=root and Stamped(Path(root), [_absolute(root), data_stamp(Path(root))]),
            name=study.name,
            unseen=self.size.clip == SHIPPED,
        )
        self.add("split", making.make_splits, "data", noleak=study.noleak, measures=True)

    def add_split(self, split: str) -> None:
        """Autoencoders and controls of a split."""
        controls, size = self.study.controls, self.size.diffusion.size
        kinds: dict[str, Any] = {f"autoencoder-{split}": self.size.autoencoder}
        if any(m.vq for m in self.study.trained_on(split)):
            kinds[f"autoencoder-vq-{split}"] = self.size.vq
        for name, options in kinds.items():
            if isinstance(options, str):
                options = Stamped(options, model_stamp("autoencoder", options))
            self.add(name, making.make_autoencoder, *DATA, split=split, options=options, size=size)
        self.add(
            f"controls-{split}",
            making.make_controls,
            *DATA,
            f"autoencoder-{split}",
            split=split,
            controls=Stamped(controls, {n: function_stamp(make) for n, make in controls.items()}),
            size=size,
            clip=self.clip,
        )

    def add_encoders(self, split: str, seed: int) -> None:
        """Encoders of a split, and what they know of it."""
        name, preset = f"encoder-{split}-{seed}", self.size.encoder
        self.add(
            name,
            making.make_encoders,
            *DATA,
            version=2,
            split=split,
            seed=seed,
            preset=preset,
            clip=self.clip,
        )
        probe = f"probe-{split}-{seed}"
        self.add(probe, probe_encoders, *DATA, name, split=split, encoders=name, measures=True)

    def add_method(self, method: Method, split: str, seed: int) -> None:
        """Training, unless it shares that of another or makes its images itself, and images."""
        size, images = self.size, images_node(method.name, split, seed)
        autoencoder = f"autoencoder-vq-{split}" if method.vq else f"autoencoder-{split}"
        if (make := method.make) is not None:
            stamp: Any = function_stamp(make)
            if make is shipped:
                stamp = [stamp, model_stamp("generator", SHIPPED)]
            self.add(
                images,
                making.make_own_images,
                *DATA,
                autoencoder,
                split=split,
                seed=seed,
                name=method.name,
                make=Stamped(make, stamp),
                size=size.diffusion.size,
                steps=size.steps,
                clip=self.clip,
            )
            return
        generator, by_text = f"{slug(method.text_of or method.name)}-{split}-{seed}", method.text_of
        if not by_text:
            diffusion = method.preset(size.diffusion).with_steps(size.steps)
            self.add(
                generator,
                making.make_generator,
                *DATA,
                autoencoder,
                split=split,
                seed=seed,
                training=Training(diffusion, method.background, size.precision),
                clip=self.clip,
                autoencoder=autoencoder,
            )
        self.add(
            images,
            making.make_images,
            *DATA,
            generator,
            split=split,
            seed=seed,
            generator=generator,
            by_text=bool(by_text),
        )

    def add_scores(self, split: str, judge: str, seed: int) -> None:
        """What the encoder of ``judge`` says of the images of ``split``."""
        study, size, encoder = self.study, self.size, f"encoder-{judge}-{seed}"
        chosen = [m.name for m in study.trained_on(split)] if judge == split else study.on_both
        methods = {name: images_node(name, split, seed) for name in chosen}
        if split == judge == NOLEAK:
            methods |= {name: images_node(name, NOLEAK) for name in self.plan.systems}
        metrics = [function_stamp(metric) for metric in study.metrics]
        sizes = [size.diffusion.size, size.permutations, self.clip.stamp]
        self.add(
            scores_node(split, judge, seed),
            judge_images,
            *DATA,
            encoder,
            f"controls-{split}",
            *methods.values(),
            study=Stamped(study, {"controls": list(study.controls), "metrics": metrics}),
            preset=Stamped(size, sizes),
            split=split,
            encoders=encoder,
            methods=methods,
            seed=seed,
            weights=self.weights,
            measures=True,
        )

    def add_utility(self) -> None:
        """What generated images add for a classifier of materials, where there are some."""
        study, trained = self.study, self.study.trained_on(NOLEAK)
        useful = [m.name for m in trained if m.make is None and m.name in study.useful]
        if 2 in study.tables or not useful:
            return
        runs = {
            f"encoder-{NOLEAK}-{seed}": {name: images_node(name, NOLEAK, seed) for name in useful}
            for seed in self.plan.seeds
        }
        images = [node for nodes in runs.values() for node in nodes.values()]
        self.add(
            "utility",
            measure_utility,
            *DATA,
            *runs,
            f"controls-{NOLEAK}",
            *images,
            runs=runs,
            controls=[name for name in USEFUL if name in study.controls],
            draws=Draws(),
            measures=True,
        )

    def add_results(self) -> None:
        """Tables, claims and pictures."""
        plan, study = self.plan, self.study
        read = ("scores-", "probe-", "utility")
        self.add(
            "results",
            collect,
            *DATA,
            images_node(study.on_both[0], NOLEAK, plan.seeds[0]),
            *(node.name for node in self if node.name.startswith(read)),
            study=Stamped(
                study, [study.name, study.title, study.tables, study.paper, *study.controls]
            ),
            methods=[*(m.name for m in study.methods), *plan.systems],
            seeds=plan.seeds,
            people=plan.people and Stamped(Path(plan.people), digest_file(Path(plan.people))),
            measures=True,
        )


def run_study(
    plan: Plan | Demo,
    folder: Path | str,
    *,
    command: str = "",
    jobs: int = 1,
    print_line: PrintLine = lambda line: None,
    progress: Progress = quiet,
) -> Results:
    """Run a study or the demo, or what is not there yet of it; write ``results.json``.

    Args:
        plan: see :class:`Plan`.
        folder: run folder; run again with the same one to go on.
        command: the command line that makes the run again.
        jobs: processes.
        print_line: called with one line a stage.
        progress: called with what is done.

    Raises:
        PalpateError: on bad data or a folder in use; finished stages stay.
    """
    folder = Path(folder)
    try:
        stages = run_graph(
            plan.nodes(),
            folder,
            device=plan.device,
            jobs=jobs,
            print_line=print_line,
            progress=progress,
        )
    finally:
        if folder.is_dir() and not any(folder.iterdir()):  # nothing was done
            folder.rmdir()
    results = plan.results(stages, jobs)
    commands = [command] if command else []
    results = replace(results, commands=[*commands, *results.commands])
    results.save(folder / "results.json")
    return results


def plan_again(settings: Mapping[str, Any], folder: Path, trust_torchscript: bool) -> Plan:
    """The plan of a run by its record; what was given to it lies in the run folder.

    Raises:
        PalpateError: for a study that is not of palpate, or as :class:`Plan`.
    """
    fix = "Verify it where it is defined"
    must = f"The study must be one of {', '.join(STUDIES)}, to be made again"
    require(settings["study"] in STUDIES, None, must, repr(settings["study"]), fix=fix)
    options = settings["options"]
    systems = {n: folder / images_node(n, NOLEAK) / "images" for n in options["methods of others"]}
    return Plan(
        STUDIES[settings["study"]],
        preset=settings["preset"],
        seeds=settings["seeds"],
        root=options["root"] and folder / "data",
        systems=systems,
        people=options["people"] and folder / "results" / "people.json",
        steps=options["steps of a method"],
        vq=options["vq"],
        weights=Weights(
            **{n: files for n, files in options["weights"].items() if n not in SILENT},
            trust_torchscript=trust_torchscript,
        ),
    )
