"""What a split is worth to an encoder that is trained on it (the paper's tables 1 and 2, left).

One encoder is trained for each split and seed and scored on the test part of its own split. Every
training is a stage of a run folder (:mod:`palpate.studies.stages`): a killed study goes on where it
was, within a training as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core import Progress, Split, quiet, require
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.encoders import EncoderSet, train_encoder
from palpate.encoders.encoder_set import load_clip
from palpate.evaluation.probing import Plan, Probed, measure, named, plan_of, results_of
from palpate.report.results import Results
from palpate.studies.files import fresh
from palpate.studies.graph import Named, Node, Work, run_graph
from palpate.studies.stages import Facts, PrintLine
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
    frozen = {} if clip is None else _digests(clip)
    pairs = {f"{name}-{seed}": (name, seed) for name in loaded for seed in seeds}
    nodes = [
        Node(
            stage,
            train_on_split,
            {
                "manifest": Named(manifest, manifest.digest),
                "split": Named(loaded[name], loaded[name].digest),
                "seed": seed,
                "preset": preset,
                "clip": Named(clip, frozen),
                "epochs": epochs,
                "compute": Named(compute, ""),
            },
        )
        for stage, (name, seed) in pairs.items()
    ]
    stages = run_graph(nodes, folder, device=device, print_line=print_line, progress=progress)
    runs: dict[str, list[Probed]] = {}
    for stage, (name, _) in pairs.items():
        encoders = EncoderSet.load(stages[stage].folder / "encoders", device=device)
        probed = measure(
            manifest, loaded[name], encoders, name, plan, cache=folder / "cache", progress=progress
        )
        runs.setdefault(name, []).append(probed)
    results = results_of("Encoders trained on each split", runs, plan, manifest, loaded)
    training = {
        "preset": getattr(preset, "name", preset),
        "clip": clip,
        "epochs": epochs,
        "device": device,
        "seeds": list(seeds),
        **frozen,
    }
    trainings = {
        name: {"encoder": stage.facts["tactile"], "seconds": stage.seconds}
        for name, stage in stages.items()
    }
    settings = {**results.settings, "training": training, "trainings": trainings}
    return replace(results, settings=settings)


def train_on_split(
    work: Work,
    *,
    manifest: Manifest,
    split: Split,
    seed: int,
    preset: Any,
    clip: str | None,
    epochs: float | None,
    compute: Compute | None,
) -> Facts:
    """A tactile encoder of one split and seed, in ``encoders``."""
    encoders = train_encoder(
        manifest,
        split,
        preset=preset,
        clip=clip,
        output=fresh(work.folder / "encoders"),
        epochs=epochs,
        seed=seed,
        device=work.device,
        compute=compute,
        progress=work.progress,
    )
    return {"tactile": encoders.digest("tactile")}


def _digests(clip: str) -> dict[str, str]:
    """Digests of frozen encoders: another model of one name makes other stages."""
    encoders = load_clip(clip)
    return {f"{modality} encoder": encoders.digest(modality) for modality in encoders.modalities}
