"""What a split is worth to an encoder that is trained on it (the paper's tables 1 and 2, left).

One encoder is trained for each split and seed and scored on the test part of its own split. Every
training is a stage of a run folder (:mod:`palpate.studies.stages`): a killed study goes on where it
was, within a training as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from palpate.core import Progress, Split, quiet, require
from palpate.data.reading import load
from palpate.encoders import EncoderSet
from palpate.evaluation.probing import Plan, Probed, measure, named, plan_of, results_of
from palpate.report.results import Results
from palpate.studies.graph import Nodes, Stamped
from palpate.studies.making import make_encoders
from palpate.studies.running import run_graph
from palpate.studies.stages import PrintLine
from palpate.studies.stamps import model_stamp
from palpate.training.options import Compute


def compare_splits(  # noqa: PLR0913 - those of training
    data: Any,
    splits: Any,
    *,
    work: str | Path,
    preset: Any = "mini",
    clip: str | None = None,
    epochs: float | None = None,
    seeds: Sequence[int] = (0, 1, 2),
    device: str = "auto",
    compute: Compute | None = None,
    print_line: PrintLine = lambda line: None,
    progress: Progress = quiet,
    **options: Any,
) -> Results:
    """Train a tactile encoder on each split with each seed, and score it under that split.

    Args:
        data: a manifest, or its file or folder.
        splits: split files, as a list or name -> split; the first is compared with the others.
        work: run folder of the encoders; run again with the same folder to resume.
        preset: see :func:`palpate.train_encoder`.
        clip: see :func:`palpate.train_encoder`.
        epochs: see :func:`palpate.train_encoder`.
        seeds: one training each.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        compute: how to train on the machine at hand; see :func:`palpate.train_encoder`.
        print_line: called with one line a training.
        progress: called with what is done.
        options: of probing; see :func:`palpate.probe`.

    Returns:
        Scores that are means over seeds, with intervals over videos and seeds, and the paired
        differences of the splits; ``facts`` says what each score drops by.

    Raises:
        PalpateError: without seeds, or as training and probing do.
    """
    once = 0 < len(seeds) == len(set(seeds))
    require(once, "seeds", "must hold at least one seed, each once", list(seeds), (0, 1, 2))
    manifest, folder = load(data), Path(work)
    loaded = {name: Split.load(split) for name, split in named(splits, "split").items()}
    axis = "split" if len(loaded) > 1 else ""
    # A leaking split may hold a test image in train as well: that is what is measured.
    plan = plan_of(manifest, loaded, Plan(**options, allow_seen=True, axis=axis, trained=True))
    weights, pairs = model_stamp("clip", clip), list(product(loaded.items(), seeds))
    nodes = Nodes()
    for (name, split), seed in pairs:
        nodes.add(
            f"{name}-{seed}",
            make_encoders,
            split=name,
            seed=seed,
            preset=preset,
            clip=Stamped(clip, weights),
            data=Stamped((manifest, split), [manifest.digest, split.digest]),
            epochs=epochs,
            compute=Stamped(compute, ""),
        )
    stages = run_graph(nodes, folder, device=device, print_line=print_line, progress=progress)
    runs: dict[str, list[Probed]] = {}
    for (name, split), seed in pairs:
        stage = stages[f"{name}-{seed}"].folder
        encoders = EncoderSet.load(stage / "encoders", device=device)
        probed = measure(
            manifest, split, encoders, name, plan, cache=folder / "cache", progress=progress
        )
        runs.setdefault(name, []).append(probed)
    results = results_of("Encoders trained on each split", runs, plan, manifest, loaded)
    training = {
        "preset": getattr(preset, "name", preset),
        "clip": clip,
        "epochs": epochs,
        "device": device,
        "seeds": list(seeds),
        "clip weights": weights,
    }
    trainings = {
        name: {"encoder": stage.facts["digest"], "seconds": stage.seconds}
        for name, stage in stages.items()
    }
    settings = {**results.settings, "training": training, "trainings": trainings}
    return replace(results, settings=settings)
