"""From a study to its results: the nodes, and what is written of the finished ones.

::

    world -> data -> split -> encoder-SPLIT-SEED -> probe-SPLIT-SEED
                     split -> autoencoder-SPLIT -> controls-SPLIT
             autoencoder-SPLIT -> METHOD-SPLIT-SEED -> images-METHOD-SPLIT-SEED
    images, controls, encoder -> scores-SPLIT-by-JUDGE-SEED; scores and probes -> results

``results`` holds the means over seeds, tables and samples; ``results.json`` of the run folder is
that with the record of the run (settings, versions, times), and ``page.html`` and others show it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, digest_file, quiet, read_json, require
from palpate.evaluation.companions import Weights
from palpate.evaluation.inputs import read as read_samples
from palpate.preference.scoring import PREFERENCE
from palpate.report.results import Results
from palpate.sim.presets import MINI_SEEDS
from palpate.studies import making
from palpate.studies.collecting import collect
from palpate.studies.demo import model_stamp, require_unseen, stamp
from palpate.studies.graph import Node, run_graph
from palpate.studies.judging import Judging, judge_images, probe_encoders
from palpate.studies.making import slug
from palpate.studies.methods import SHIPPED, Method, shipped
from palpate.studies.stages import Stage
from palpate.studies.study import NOLEAK, SPLITS, STUDIES, Preset, Study
from palpate.studies.utility import USEFUL, Draws, measure_utility


@dataclasses.dataclass(frozen=True)
class Plan:
    """A study with everything that a run of it chooses.

    Attributes:
        study: what is run.
        preset: how large.
        seeds: one training of every encoder and method each; splits and autoencoders are made once.
        root: the data set on disk, for a study that is not of the world.
        others: name -> folder of images of the test part (of the split without leaks) that another
            system made.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        people: results of ``palpate preference score`` on images of the methods, or None.
        weights: of FID, CMMD and LPIPS as published; without them their columns
            are missing.
    """

    study: Study
    preset: Preset
    seeds: Sequence[int]
    root: Path | None = None
    others: Mapping[str, Path] = dataclasses.field(default_factory=dict[str, Path])
    device: str = "auto"
    people: Path | None = None
    weights: Weights = dataclasses.field(default_factory=Weights)

    @property
    def methods(self) -> list[str]:
        """Names of all methods, of others last."""
        return [*(m.name for m in self.study.methods), *self.others]


def plan_of(
    study: Study,
    *,
    preset: str = "mini",
    seeds: Sequence[int] = (0,),
    root: Path | str | None = None,
    others: Mapping[str, Path | str] | None = None,
    device: str = "auto",
    people: Path | str | None = None,
    steps: int | None = None,
    vq: Path | str | None = None,
    weights: Weights | None = None,
) -> Plan:
    """The plan of a run, checked before any work; ``steps`` and ``vq`` replace the preset's.

    Raises:
        PalpateError: for a study of another's name, an unknown preset, no seeds, a root that is
            missing or not wanted, or a folder that is not there or has the name of a method.
    """
    if STUDIES.get(study.name, study) != study:
        must, got = "must have a name of its own", f"another {study.name}"
        raise PalpateError(must, got, 'Use replace(study, name="mine", ...)', argument="study")
    names = ", ".join(study.presets)
    require(preset in study.presets, "preset", f"must be one of {names}", repr(preset))
    once = 0 < len(seeds) == len({*seeds})
    require(once, "seeds", "must hold at least one seed, each once", list(seeds), (0, 1, 2))
    if (root is None) == (study.world is None):
        must = "must be given" if root is None else "must be left out"
        must += f" for the study {study.name}"
        fix = "Name the folder of the data set" if root is None else "Its data are made"
        raise PalpateError(must, "none" if root is None else str(root), fix, argument="root")
    if root is not None and not Path(root).exists():
        raise PalpateError("must exist", f"nothing at {root}", "Check the path", argument="root")
    folders = _folders(study, others or {})
    votes = [] if people is None else [s.metric for s in Results.load(people).scores]
    if people is not None and PREFERENCE not in votes:
        must, fix = "must hold scores of palpate preference score", "Pass what its -o wrote"
        raise PalpateError(must, str(people), fix, argument="people")
    chosen = study.presets[preset]
    given = {"steps": steps, "vq": None if vq is None else str(vq)}
    chosen = dataclasses.replace(chosen, **{k: v for k, v in given.items() if v is not None})
    require(chosen.steps >= 4, "steps", "must be at least 4", chosen.steps)
    if chosen.vq is None and any(method.vq for method in study.methods):
        fix = "Pass the folder, hub id or .ckpt of latent diffusion's vq-f4"
        raise PalpateError(f"must be given for preset {preset}", "none", fix, argument="vq")
    if study.world is not None and chosen.clip == "palpate/mini":
        seed = _world(study, chosen).seed
        require(seed not in MINI_SEEDS, "world", "must be one that no shipped model saw", seed)
    elif root is not None and chosen.clip == "palpate/mini":
        require_unseen(Path(root))
    place, votes = (None if path is None else Path(path) for path in (root, people))
    weights = _whole(weights or Weights())
    return Plan(study, chosen, tuple(seeds), place, folders, device, votes, weights)


def _whole(weights: Weights) -> Weights:
    """The weights by whole paths; a CLIP may be a hub id."""

    def whole(path: Path | str, name: str) -> str:
        if not Path(path).is_file():
            got, fix = f"nothing at {path}", "Check the path"
            raise PalpateError("must be a file", got, fix, argument=name)
        return str(Path(path).resolve())

    inception, clip, lpips = weights.inception, weights.clip, weights.lpips
    return Weights(
        inception=None if inception is None else whole(inception, "inception"),
        clip=str(Path(clip).resolve()) if clip and Path(clip).exists() else clip,
        lpips=None if lpips is None else (whole(lpips[0], "lpips"), whole(lpips[1], "lpips")),
    )


def _folders(study: Study, others: Mapping[str, Path | str]) -> dict[str, Path]:
    """Folders of images of other systems, under names of their own."""
    folders = {name: Path(folder) for name, folder in others.items()}
    for name, folder in folders.items():
        if slug(name) in {slug(m.name) for m in study.methods} | {slug(c) for c in study.controls}:
            must, fix = "must have a name of its own", "Choose another name"
            raise PalpateError(must, name, fix, argument="method")
        if not folder.is_dir():
            must, fix = f"{name} must be a folder of images", "Check the path"
            raise PalpateError(must, f"nothing at {folder}", fix, argument="method")
    return folders


def nodes_of(plan: Plan) -> list[Node]:
    """The nodes of a run; those of another seed, method or split come on top of what is there."""
    study, preset, device = plan.study, plan.preset, plan.device
    nodes = [*_data_nodes(plan)]
    for split in SPLITS:
        nodes += _autoencoder_nodes(plan, split)
        after = ["data", "split", f"autoencoder-{split}"]
        make = partial(making.make_controls, split=split, controls=study.controls, preset=preset)
        inputs: dict[str, Any] = {"controls": {n: _source(f) for n, f in study.controls.items()}}
        inputs |= {"size": preset.diffusion.size, **_clip(preset)}
        name = f"controls-{split}"
        nodes.append(Node(name, partial(make, device=device), inputs, after))
    for seed, split in product(plan.seeds, SPLITS):
        encoder = f"encoder-{split}-{seed}"
        how: dict[str, Any] = {"preset": preset.encoder, "clip": preset.clip}
        build = partial(making.make_encoders, split=split, seed=seed, device=device, **how)
        inputs = {"preset": preset.encoder, **_clip(preset), "seed": seed}
        nodes.append(Node(encoder, build, inputs, ["data", "split"]))
        build = partial(probe_encoders, split=split, encoders=encoder, device=device)
        after = ["data", "split", encoder]
        name = f"probe-{split}-{seed}"
        nodes.append(Node(name, build, {}, after, measures=True))
        for method in study.trained_on(split):
            nodes += _method_nodes(plan, method, split, seed)
    nodes += [
        Node(
            _images_of_others(name),
            partial(making.take_images, split=NOLEAK, folder=folder, size=preset.diffusion.size),
            {"folder": read_samples(folder, str(folder)).image_digest()},
            ["data", "split"],
        )
        for name, folder in plan.others.items()
    ]
    for seed, split, judge in product(plan.seeds, SPLITS, SPLITS):
        nodes.append(_score_node(plan, split, judge, seed))
    useful = _utility_nodes(plan)
    nodes += useful
    judgments = {(s, j): [_scores(s, j, n) for n in plan.seeds] for s, j in product(SPLITS, SPLITS)}
    probes = {split: [f"probe-{split}-{seed}" for seed in plan.seeds] for split in SPLITS}
    shown = _images(study.on_both[0], NOLEAK, plan.seeds[0])
    build = partial(
        collect,
        study=study,
        methods=plan.methods,
        judgments=judgments,
        probes=probes,
        gallery=shown,
        people=plan.people,
        useful=bool(useful),
    )
    read = [node for of in (judgments, probes) for nodes in of.values() for node in nodes]
    after = ["data", "split", shown, *read, *(node.name for node in useful)]
    inputs = {"study": study.name, "title": study.title, "tables": study.tables}
    inputs |= {"paper": study.paper, "methods": plan.methods, "controls": list(study.controls)}
    inputs |= {"people": plan.people and digest_file(plan.people)}
    nodes.append(Node("results", build, inputs, after, measures=True))
    return nodes


def run_study(
    plan: Plan,
    folder: Path | str,
    *,
    command: str = "",
    jobs: int = 1,
    print_line: Callable[[str], None] = lambda line: None,
    progress: Progress = quiet,
) -> Results:
    """Run a study, or what is not there yet of it; write ``results.json`` and its tables.

    Args:
        plan: see :func:`plan_of`.
        folder: run folder; run again with the same one to go on.
        command: the command line that makes the run again.
        jobs: processes.
        print_line: called with one line a stage.
        progress: called with what is done.

    Raises:
        PalpateError: on bad data or a folder in use; finished stages stay.
    """
    folder = Path(folder)
    stages = run_graph(nodes_of(plan), folder, jobs=jobs, print_line=print_line, progress=progress)
    results = Results.load(folder / "results" / "results.json")
    settings = {**results.settings, **settings_of(plan, stages, jobs)}
    results = dataclasses.replace(results, settings=settings, commands=[command] if command else [])
    results.save(folder / "results.json")
    return results


def _world(study: Study, preset: Preset) -> Any:
    return dataclasses.replace(preset.world, **(study.world or {}))


def _data_nodes(plan: Plan) -> list[Node]:
    """World, data and splits."""
    study, nodes = plan.study, list[Node]()
    if study.world is not None:
        world = _world(study, plan.preset)
        build = partial(making.make_world, options=world)
        nodes.append(Node("world", build, {"options": world, "digest": world.digest}))
    build = partial(making.read_data, study=study, root=plan.root)
    inputs: dict[str, Any] = {"read": _source(study.read)}
    if plan.root is not None:
        inputs |= {"root": str(plan.root.resolve()), "stamp": stamp(plan.root)}
    nodes.append(Node("data", build, inputs, [node.name for node in nodes]))
    inputs = {} if study.noleak is None else {"noleak": study.noleak}
    build = partial(making.make_splits, noleak=study.noleak)
    nodes.append(Node("split", build, inputs, ["data"], measures=True))
    return nodes


def _autoencoder_nodes(plan: Plan, split: str) -> list[Node]:
    preset = plan.preset
    kinds: dict[str, Any] = {f"autoencoder-{split}": preset.autoencoder}
    if any(m.vq for m in plan.study.trained_on(split)):
        kinds[f"autoencoder-vq-{split}"] = preset.vq
    nodes: list[Node] = []
    for name, options in kinds.items():
        how: dict[str, Any] = {"split": split, "options": options, "size": preset.diffusion.size}
        inputs = how
        if isinstance(options, str):
            inputs = {**how, "options": model_stamp("autoencoder", options)}
        build = partial(making.make_autoencoder, device=plan.device, **how)
        nodes.append(Node(name, build, inputs, ["data", "split"]))
    return nodes


def _utility_nodes(plan: Plan) -> list[Node]:
    """What generated images add for a classifier of materials, where there are some."""
    study = plan.study
    useful = [m.name for m in study.trained_on(NOLEAK) if m.make is None and m.name in study.useful]
    if 2 in study.tables or not useful:
        return []
    runs = {
        f"encoder-{NOLEAK}-{seed}": {name: _images(name, NOLEAK, seed) for name in useful}
        for seed in plan.seeds
    }
    inputs: dict[str, Any] = {
        "draws": Draws(),
        "controls": [c for c in USEFUL if c in study.controls],
    }
    build = partial(measure_utility, runs=runs, device=plan.device, **inputs)
    after = ["data", "split", *runs, f"controls-{NOLEAK}"]
    after += [node for of in runs.values() for node in of.values()]
    inputs["methods"] = useful
    return [Node("utility", build, inputs, after, measures=True)]


def _images_of_others(name: str) -> str:
    return f"images-{slug(name)}-{NOLEAK}"


def _images(method: str, split: str, seed: int) -> str:
    return f"images-{slug(method)}-{split}-{seed}"


def _scores(split: str, judge: str, seed: int) -> str:
    return f"scores-{split}-by-{judge}-{seed}"


def _method_nodes(plan: Plan, method: Method, split: str, seed: int) -> list[Node]:
    """Training, unless it shares that of another or makes its images itself, and images."""
    preset = plan.preset
    how: dict[str, Any] = {"split": split, "seed": seed, "preset": preset, "device": plan.device}
    nodes, generator = list[Node](), ""
    autoencoder = f"autoencoder-vq-{split}" if method.vq else f"autoencoder-{split}"
    if method.make is None:
        generator = f"{slug(method.text_of or method.name)}-{split}-{seed}"
    if generator and not method.text_of:
        inputs = {"diffusion": method.preset(preset.diffusion), "background": method.background}
        inputs |= {"steps": preset.steps, **_clip(preset), "seed": seed}
        inputs |= {"precision": preset.precision}
        build = partial(making.make_generator, method=method, autoencoder=autoencoder, **how)
        nodes.append(Node(generator, build, inputs, ["data", "split", autoencoder]))
    build = partial(making.make_images, method=method, generator=generator, **how)
    inputs = {"seed": seed, **({"text": True} if method.text_of else {})}
    if method.make is not None:
        inputs |= {"make": _source(method.make), "size": preset.diffusion.size}
        inputs |= {"steps": preset.steps, **_clip(preset)}
    if method.make is shipped:
        inputs |= {"weights": model_stamp("generator", SHIPPED)}
    after = ["data", "split", generator or autoencoder]
    nodes.append(Node(_images(method.name, split, seed), build, inputs, after))
    return nodes


def _score_node(plan: Plan, split: str, judge: str, seed: int) -> Node:
    """What the encoder of ``judge`` says of the images of ``split``."""
    study, preset, encoder = plan.study, plan.preset, f"encoder-{judge}-{seed}"
    chosen = [m.name for m in study.trained_on(split)]
    if judge != split:
        chosen = list(study.on_both)
    methods = {name: _images(name, split, seed) for name in chosen}
    if split == judge == NOLEAK:
        methods |= {name: _images_of_others(name) for name in plan.others}
    judging = Judging(
        split,
        encoder,
        methods,
        list(study.controls),
        study.metrics,
        preset.clip,
        preset.diffusion.size,
        seed,
        preset.permutations,
        plan.weights,
    )
    build = partial(judge_images, judging=judging, device=plan.device)
    inputs = {**vars(judging), **_clip(preset), "metrics": [_source(m) for m in study.metrics]}
    del inputs["weights"]
    if plan.weights.companions:
        inputs["weights"] = _stamps(plan.weights)
    after = ["data", "split", encoder, f"controls-{split}", *methods.values()]
    name = _scores(split, judge, seed)
    return Node(name, build, inputs, after, measures=True)


def _clip(preset: Preset) -> dict[str, str | None]:
    """What names the frozen encoders: other weights under the same name make other stages."""
    return {"clip": model_stamp("clip", preset.clip)}


def _stamps(weights: Weights) -> dict[str, Any]:
    """What names the weights of published metrics."""
    made: dict[str, Any] = {"clip": model_stamp("clip", weights.clip and str(weights.clip))}
    made["inception"] = weights.inception and digest_file(Path(weights.inception))
    made["lpips"] = weights.lpips and [digest_file(Path(path)) for path in weights.lpips]
    return {name: stamp for name, stamp in made.items() if stamp}


def _source(function: Callable[..., Any]) -> str:
    """What names a function: its module, its name, and the digest of its source.

    Raises:
        PalpateError: if it has no source, or holds values of another function.
    """
    try:
        text = hashlib.sha256(inspect.getsource(function).encode()).hexdigest()
    except (OSError, TypeError):
        text = ""
    if not text or getattr(function, "__closure__", None):
        must = "What a study reads or makes its images with must be a function of a file"
        raise PalpateError(must, f"{function!r}"[:200], "Write it in a module")
    return f"{function.__module__}.{function.__qualname__} {text}"


def settings_of(plan: Plan, stages: Mapping[str, Stage], jobs: int) -> dict[str, Any]:
    """The record of a run: what was chosen, digests, versions, machine, and every stage."""
    records = {n: read_json(s.folder / "stage.json", "stage record") for n, s in stages.items()}
    kept = ("digest", "outputs", "seconds", "date")
    digests: dict[str, Any] = {"manifest": stages["data"].facts["digest"]}
    digests |= {f"split {s}": stages["split"].facts[s]["digest"] for s in SPLITS}
    for seed, split in product(plan.seeds, SPLITS):
        name = f"encoder-{split}-{seed}"
        digests[f"encoder {split} {seed}"] = stages[name].facts["digest"]
    digests |= {f"weights of {name}": of for name, of in _stamps(plan.weights).items()}
    if plan.people is not None:
        digests["people"] = digest_file(plan.people)
    return {
        "study": plan.study.name,
        "dataset": stages["data"].facts["dataset"],
        "preset": plan.preset.name,
        "seeds": list(plan.seeds),
        "options": {
            "root": str(plan.root) if plan.root else None,
            "methods of others": {name: str(folder) for name, folder in plan.others.items()},
            "people": str(plan.people) if plan.people else None,
            "steps of a method": plan.preset.steps,
            "vq": plan.preset.vq if isinstance(plan.preset.vq, str) else None,
            "weights": {name: of for name, of in vars(plan.weights).items() if of},
            "device": plan.device,
            "jobs": jobs,
        },
        "digests": digests,
        "stages": {n: {k: r[k] for k in kept if k in r} for n, r in records.items()},
        "seconds": {"all stages": round(sum(s.seconds for s in stages.values()))},
        **stages["results"].made_with,
    }
