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

from palpate.core import PalpateError, Progress, digest_file, plain, quiet, read_json, require
from palpate.evaluation.companions import Weights
from palpate.evaluation.inputs import read as read_samples
from palpate.preference.scoring import PREFERENCE
from palpate.report.results import Results
from palpate.sim.presets import MINI_SEEDS
from palpate.studies import making
from palpate.studies.collecting import collect
from palpate.studies.controls import NEAREST
from palpate.studies.demo import model_stamp, require_unseen, stamp
from palpate.studies.graph import Node, Planned, plan_graph, run_graph
from palpate.studies.judging import Judging, judge_images, probe_encoders
from palpate.studies.lengths import SAMPLING, SHARES
from palpate.studies.making import slug
from palpate.studies.methods import BACKGROUND, GVST, OURS, SHIPPED, VQ, Method, shipped
from palpate.studies.questions import (
    MOVED,
    USEFUL,
    compare_on_forty,
    compare_rulers,
    measure_compute,
    measure_moves,
    measure_utility,
    move_images,
    retrieve_moved,
    sample_in_steps,
)
from palpate.studies.stages import Stage
from palpate.studies.study import NOLEAK, SPLITS, STUDIES, Preset, Study
from palpate.studies.utility import Draws

#: Stages whose tables, curves and claims come after those of the paper.
QUESTIONS = ("utility", "compute", "appearance", "forty", "rulers")


@dataclasses.dataclass(frozen=True)
class Plan:
    """A study with everything that a run of it chooses.

    Attributes:
        study: what is run.
        preset: how large.
        seeds: one training of every encoder and method each. Splits and autoencoders are made once;
            trainings of other lengths, numbers of sampling steps, and the encoders that rank the
            generators are of the first.
        root: the data set on disk, for a study that is not of the world.
        others: name -> folder of images of the test part (of the split without leaks) that another
            system made.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        people: results of ``palpate preference score`` on images of the methods, or None.
        weights: of FID, CMMD and LPIPS as published; without them stand-ins of the frozen vision
            encoder are all there is.
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
    require(preset in study.presets, "preset", f"must be one of {names}", preset)
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
    trained = set[str]()
    for split in SPLITS:
        nodes += _autoencoder_nodes(plan, split)
        after = ["data", "split", f"autoencoder-{split}"]
        make = partial(making.make_controls, split=split, controls=study.controls, preset=preset)
        inputs: dict[str, Any] = {"controls": {n: _source(f) for n, f in study.controls.items()}}
        inputs |= {"size": preset.diffusion.size, **_clip(preset)}
        name = f"controls-{split}"
        nodes.append(Node(name, partial(make, device=device), inputs, after, version=3, cost=20))
    for seed, split in product(plan.seeds, SPLITS):
        encoder = f"encoder-{split}-{seed}"
        how: dict[str, Any] = {"preset": preset.encoder, "clip": preset.clip}
        build = partial(making.make_encoders, split=split, seed=seed, device=device, **how)
        inputs = {"preset": preset.encoder, **_clip(preset), "seed": seed}
        nodes.append(Node(encoder, build, inputs, ["data", "split"], cost=preset.seconds[0]))
        build = partial(probe_encoders, split=split, encoders=encoder, device=device)
        after = ["data", "split", encoder]
        name = f"probe-{split}-{seed}"
        nodes.append(Node(name, build, {}, after, cost=15, measures=True))
        for method in study.trained_on(split):
            nodes += _method_nodes(plan, method, split, seed, trained)
    nodes += [
        Node(
            _images_of_others(name),
            partial(making.take_images, split=NOLEAK, folder=folder, size=preset.diffusion.size),
            {"folder": read_samples(folder, str(folder)).image_digest()},
            ["data", "split"],
            cost=5,
        )
        for name, folder in plan.others.items()
    ]
    for seed, split, judge in product(plan.seeds, SPLITS, SPLITS):
        nodes.append(_score_node(plan, split, judge, seed))
    questions = _question_nodes(plan)
    nodes += questions
    judgments = {(s, j): [_scores(s, j, n) for n in plan.seeds] for s, j in product(SPLITS, SPLITS)}
    probes = {split: [f"probe-{split}-{seed}" for seed in plan.seeds] for split in SPLITS}
    shown = {split: _images(study.on_both[0], split, plan.seeds[0]) for split in SPLITS}
    build = partial(
        collect,
        study=study,
        methods=plan.methods,
        judgments=judgments,
        probes=probes,
        gallery=shown,
        people=plan.people,
        questions=[node.name for node in questions if node.name in QUESTIONS],
    )
    read = [node for of in (judgments, probes) for nodes in of.values() for node in nodes]
    after = [
        "data",
        "split",
        *shown.values(),
        *read,
        *(n.name for n in questions if n.name in QUESTIONS),
    ]
    inputs = {"study": study.name, "title": study.title, "tables": study.tables}
    inputs |= {"paper": study.paper, "methods": plan.methods, "controls": list(study.controls)}
    inputs |= {"people": plan.people and digest_file(plan.people)}
    nodes.append(Node("results", build, inputs, after, version=7, cost=10, measures=True))
    return [_priced(node, preset.rest) for node in nodes]


def _priced(node: Node, rest: float) -> Node:
    """The node with the cost of its preset: a training has its own."""
    trains = (making.make_encoders, making.make_autoencoder, making.make_generator)
    trained = getattr(node.build, "func", node.build) in trains
    return node if trained else dataclasses.replace(node, cost=rest * node.cost)


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


def planned(plan: Plan, folder: Path) -> list[Planned]:
    """What a run would do with each stage; nothing is written."""
    return plan_graph(nodes_of(plan), folder)


def _world(study: Study, preset: Preset) -> Any:
    return dataclasses.replace(preset.world, **(study.world or {}))


def _data_nodes(plan: Plan) -> list[Node]:
    """World, data and splits."""
    study, nodes = plan.study, list[Node]()
    if study.world is not None:
        world = _world(study, plan.preset)
        build = partial(making.make_world, options=world)
        nodes.append(Node("world", build, {"options": world, "digest": world.digest}, cost=10))
    build = partial(making.read_data, study=study, root=plan.root)
    inputs: dict[str, Any] = {"read": _source(study.read)}
    if plan.root is not None:
        inputs |= {"root": str(plan.root.resolve()), "stamp": stamp(plan.root)}
    nodes.append(Node("data", build, inputs, [node.name for node in nodes], cost=10))
    inputs = {} if study.noleak is None else {"noleak": study.noleak}
    build = partial(making.make_splits, noleak=study.noleak)
    nodes.append(Node("split", build, inputs, ["data"], cost=25, measures=True))
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
        nodes.append(Node(name, build, inputs, ["data", "split"], cost=preset.seconds[1]))
    return nodes


def _question_nodes(plan: Plan) -> list[Node]:
    """What generation is for, what moves it, and which ruler: as far as the data allow."""
    study, preset = plan.study, plan.preset
    trained = {m.name: m for m in study.trained_on(NOLEAK) if m.make is None}
    nodes, controls, seeds = list[Node](), [*study.controls], len(plan.seeds)

    def made(names: Sequence[str]) -> list[dict[str, str]]:
        """The images of methods by name, one a seed."""
        return [{n: _images(n, NOLEAK, s) for n in names} for s in plan.seeds]

    useful = [n for n in study.useful if n in trained]
    if 2 not in study.tables and useful:
        judges = [f"encoder-{NOLEAK}-{s}" for s in plan.seeds]
        runs = dict(zip(judges, made(useful), strict=True))
        given: dict[str, Any] = {"draws": Draws(), "controls": [c for c in USEFUL if c in controls]}
        build = partial(measure_utility, runs=runs, device=plan.device, **given)
        after = ["data", "split", *judges, f"controls-{NOLEAK}"]
        after += [node for of in runs.values() for node in of.values()]
        inputs = {**given, "methods": useful}
        cost = 200 * seeds
        nodes.append(Node("utility", build, inputs, after, version=5, cost=cost, measures=True))
    if useful:
        nodes += _compute_nodes(plan, {n: trained[n] for n in useful})
    names = [n for n in study.moved if n in trained]
    if study.world is not None and len(names) > 1:
        nodes += _appearance_nodes(plan, {n: trained[n] for n in names})
    paired = [n for n in (OURS, GVST, VQ, BACKGROUND) if n in trained]
    if len(paired) > 1:
        how: dict[str, Any] = {"clip": preset.clip, "size": preset.diffusion.size}
        how |= {"controls": controls}
        build = partial(compare_on_forty, runs=made(paired), device=plan.device, **how)
        after = ["data", "split", *(node for of in made(paired) for node in of.values())]
        after.append(f"controls-{NOLEAK}")
        inputs = {**how, **_clip(preset)}
        nodes.append(Node("forty", build, inputs, after, version=3, cost=15 * seeds, measures=True))
    if len(trained) > 2:
        nodes.append(_ruler_node(plan, [*trained]))
    return nodes


def _ruler_node(plan: Plan, methods: Sequence[str]) -> Node:
    """Encoders of the first seed and, if there is one, the shipped one rank all images."""
    controls, shipped_one = [*plan.study.controls], plan.preset.ruler
    rulers = {f"trained on {s}": f"encoder-{s}-{plan.seeds[0]}" for s in SPLITS}
    images = {(n, seed): _images(n, NOLEAK, seed) for n, seed in product(methods, plan.seeds)}
    after = ["data", "split", f"controls-{NOLEAK}", *rulers.values(), *images.values()]
    rulers |= {} if shipped_one is None else {shipped_one: shipped_one}
    build = partial(compare_rulers, rulers=rulers, images=images, controls=controls)
    build = partial(build, device=plan.device)
    inputs: dict[str, Any] = {"rulers": rulers, "controls": controls}
    inputs["shipped"] = model_stamp("encoders", shipped_one)
    return Node("rulers", build, inputs, after, version=3, cost=75, measures=True)


def _compute_nodes(plan: Plan, methods: Mapping[str, Method]) -> list[Node]:
    """Shorter trainings, and other numbers of sampling steps, of the first seed."""
    preset, seed = plan.preset, plan.seeds[0]
    judge, nodes = f"encoder-{NOLEAK}-{seed}", list[Node]()
    trained, sampled = dict[str, dict[int, str]](), dict[str, str]()
    for name, method in methods.items():
        trained[name] = {preset.steps: _images(name, NOLEAK, seed)}
        for share in SHARES:
            steps = round(share * preset.steps)
            shorter = dataclasses.replace(method, name=f"{name} {steps} steps")
            nodes += _method_nodes(_of_one(plan, shorter, steps), shorter, NOLEAK, seed, set())
            trained[name][steps] = nodes[-1].name
        sampled[name] = f"sampled-{slug(name)}-{seed}"
        generator = _generator(plan.study, method, NOLEAK, seed)
        build = partial(sample_in_steps, generator=generator, encoders=judge, seed=seed)
        build = partial(build, device=plan.device)
        inputs = {"samples": MOVED, "steps": SAMPLING, "seed": seed}
        after = ["data", "split", generator, judge]
        nodes.append(Node(sampled[name], build, inputs, after, cost=60))
    build = partial(measure_compute, encoders=judge, trained=trained, sampled=sampled)
    images = [node for of in trained.values() for node in of.values()]
    after = ["data", "split", judge, *images, *sampled.values()]
    build = partial(build, device=plan.device)
    inputs = {"trained": {name: [*of.values()] for name, of in trained.items()}}
    return [*nodes, Node("compute", build, inputs, after, cost=20, measures=True)]


def _of_one(plan: Plan, method: Method, steps: int) -> Plan:
    """The plan of one method alone, trained for other steps."""
    (encoder, autoencoder, full), share = plan.preset.seconds, steps / plan.preset.steps
    seconds = encoder, autoencoder, full * share
    preset = dataclasses.replace(plan.preset, steps=steps, seconds=seconds)
    study = dataclasses.replace(plan.study, methods=[method])
    return dataclasses.replace(plan, study=study, preset=preset)


def _appearance_nodes(plan: Plan, methods: Mapping[str, Method]) -> list[Node]:
    nodes, moved = list[Node](), dict[str, list[tuple[str, str]]]()
    options = _world(plan.study, plan.preset)
    for (name, method), seed in product(methods.items(), plan.seeds):
        generator, judge = _generator(plan.study, method, NOLEAK, seed), f"encoder-{NOLEAK}-{seed}"
        node = f"moved-{slug(name)}-{seed}"
        build = partial(move_images, generator=generator, encoders=judge, options=options)
        build = partial(build, seed=seed, device=plan.device)
        after = ["data", "split", generator, judge]
        nodes.append(Node(node, build, {"samples": MOVED, "seed": seed}, after, cost=90))
        moved.setdefault(name, []).append((node, judge))
    for seed in plan.seeds if NEAREST in plan.study.controls else ():
        node, judge = f"moved-{slug(NEAREST)}-{seed}", f"encoder-{NOLEAK}-{seed}"
        build = partial(retrieve_moved, encoders=judge, options=options, clip=plan.preset.clip)
        build = partial(build, device=plan.device)
        inputs = {"samples": MOVED, **_clip(plan.preset)}
        after = ["data", "split", judge]
        nodes.append(Node(node, build, inputs, after, cost=30, measures=True))
        moved.setdefault(NEAREST, []).append((node, judge))
    read = [node for pairs in moved.values() for pair in pairs for node in pair]
    ours, other = plan.study.moved[:2]
    build = partial(measure_moves, moved=moved, ours=ours, other=other, device=plan.device)
    after = ["data", "split", *dict.fromkeys(read)]
    inputs = {"moved": list(moved)}
    return [*nodes, Node("appearance", build, inputs, after, version=3, cost=10, measures=True)]


def _generator(study: Study, method: Method, split: str, seed: int) -> str:
    """The node that trains a method: that of the first one of the same training."""
    same = (m for m in study.methods if m.make is None and m.training == method.training)
    return f"{slug(next(same).name)}-{split}-{seed}"


def _images_of_others(name: str) -> str:
    return f"images-{slug(name)}-{NOLEAK}"


def _images(method: str, split: str, seed: int) -> str:
    return f"images-{slug(method)}-{split}-{seed}"


def _scores(split: str, judge: str, seed: int) -> str:
    return f"scores-{split}-by-{judge}-{seed}"


def _method_nodes(
    plan: Plan, method: Method, split: str, seed: int, trained: set[str]
) -> list[Node]:
    """Training, unless another method shares it and has its node, and images."""
    preset, study = plan.preset, plan.study
    how: dict[str, Any] = {"split": split, "seed": seed, "preset": preset, "device": plan.device}
    nodes, generator = list[Node](), ""
    autoencoder = f"autoencoder-vq-{split}" if method.vq else f"autoencoder-{split}"
    if method.make is None:
        generator = _generator(study, method, split, seed)
        if generator not in trained:
            trained.add(generator)
            inputs = {"method": method.training, "diffusion": method.preset(preset.diffusion)}
            inputs |= {"steps": preset.steps, **_clip(preset), "seed": seed}
            inputs |= {"precision": preset.precision}
            build = partial(making.make_generator, method=method, autoencoder=autoencoder, **how)
            after = ["data", "split", autoencoder]
            nodes.append(Node(generator, build, inputs, after, cost=preset.seconds[2]))
    build = partial(making.make_images, method=method, generator=generator, **how)
    inputs = {"drive": method.drive, "seed": seed}
    if method.make is not None:
        inputs |= {"make": _source(method.make), "size": preset.diffusion.size}
        inputs |= {"steps": preset.steps, **_clip(preset)}
    if method.make is shipped:
        inputs |= {"weights": model_stamp("generator", SHIPPED)}
    after = ["data", "split", generator or autoencoder]
    nodes.append(Node(_images(method.name, split, seed), build, inputs, after, cost=75))
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
    return Node(name, build, inputs, after, version=4, cost=60, measures=True)


def _clip(preset: Preset) -> dict[str, str | None]:
    """What names the frozen encoders: other weights under the same name make other stages."""
    return {"clip": model_stamp("clip", preset.clip)}


def _stamps(weights: Weights) -> dict[str, Any]:
    """What names the weights of published metrics."""
    made: dict[str, Any] = {"clip": model_stamp("clip", weights.clip and str(weights.clip))}
    made["inception"] = weights.inception and digest_file(Path(weights.inception))
    made["lpips"] = weights.lpips and [digest_file(Path(path)) for path in weights.lpips]
    return {name: stamp for name, stamp in made.items() if stamp}


def _source(function: Any) -> Any:
    """What names a function: its module, its name, and the digest of its source.

    Of a partial one its arguments, too, and of one made within another what it holds of that.

    Raises:
        PalpateError: if it has no source, or holds what JSON cannot.
    """
    if isinstance(function, partial):
        return [_source(function.func), *map(_source, function.args), _source(function.keywords)]
    if isinstance(function, Mapping):
        return {key: _source(value) for key, value in function.items()}
    try:
        if not callable(function):
            return plain(function)
        text = hashlib.sha256(inspect.getsource(function).encode()).hexdigest()
    except (OSError, TypeError, SyntaxError):
        must = "What a study reads or makes its images with must be a function of a file, or a "
        must += "functools.partial of one with numbers and words"
        raise PalpateError(must, f"{function!r}"[:200], "Write it in a module") from None
    name = f"{function.__module__}.{function.__qualname__} {text}"
    cells = [_source(cell.cell_contents) for cell in getattr(function, "__closure__", None) or ()]
    return [name, *cells] if cells else name


def settings_of(plan: Plan, stages: Mapping[str, Stage], jobs: int) -> dict[str, Any]:
    """The record of a run: what was chosen, digests, versions, machine, and every stage."""
    records = {n: read_json(s.folder / "stage.json", "stage record") for n, s in stages.items()}
    kept = ("digest", "outputs", "seconds", "peak_mb", "date")
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
