"""What a split is worth to an encoder that is trained on it (the paper's tables 1 and 2, left).

One encoder is trained for each split and seed and scored on the test part of its own split. Every
training is a stage of a run folder (:mod:`palpate.studies.stages`): a killed study goes on where it
was, within a training as well.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, Split, locked, quiet, require
from palpate.data.reading import load
from palpate.encoders import EncoderSet, train_encoder
from palpate.encoders.encoder_set import load_clip
from palpate.evaluation.probing import Plan, Probed, measure, named, plan_of, results_of
from palpate.report.results import Results
from palpate.studies.making import fresh
from palpate.studies.stages import Run
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
    print_line: Callable[[str], None] = lambda line: None,
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
    if (processes := os.environ.get("WORLD_SIZE", "1")) != "1":
        fix = "Run it once without torchrun; palpate train encoder takes several"
        raise PalpateError("A study of splits must run in one process", processes, fix)
    once = 0 < len(seeds) == len(set(seeds))
    require(once, "seeds", "must hold at least one seed, each once", list(seeds), (0, 1, 2))
    run = Run(Path(work), print_line)
    manifest, folder = load(data), run.folder
    loaded = {name: Split.load(split) for name, split in named(splits, "split").items()}
    axis = "split" if len(loaded) > 1 else ""
    # A leaking split may hold a test image in train as well: that is what is measured.
    plan = Plan(**options, allow_seen=True, axis=axis, trained=True)
    plan = plan_of(manifest, loaded, plan)
    training: dict[str, Any] = {"preset": preset, "clip": clip, "epochs": epochs, "device": device}
    frozen = {} if clip is None else _digests(clip)
    runs: dict[str, list[Probed]] = {}
    facts: dict[str, dict[str, Any]] = {}
    with locked(folder):
        for name, split in loaded.items():
            for number in seeds:
                stage = f"{name}-{number}"

                def build(
                    place: Path, split: Split = split, number: int = number
                ) -> dict[str, Any]:
                    output = fresh(place / "encoders")
                    encoders = train_encoder(
                        manifest,
                        split,
                        output=output,
                        seed=number,
                        compute=compute,
                        progress=progress,
                        **training,
                    )
                    return {"tactile": encoders.digest("tactile")}

                inputs = {"manifest": manifest.digest, "split": split.digest, "seed": number}
                inputs |= frozen
                done = run.stage(stage, inputs | training, build)
                encoders = EncoderSet.load(done.folder / "encoders", device=device)
                facts[stage] = {"encoder": done.facts["tactile"], "seconds": done.seconds}
                probed = measure(
                    manifest, split, encoders, name, plan, cache=folder / "cache", progress=progress
                )
                runs.setdefault(name, []).append(probed)
    results = results_of("Encoders trained on each split", runs, plan, manifest, loaded)
    settings = {**training, "preset": getattr(preset, "name", preset), "seeds": list(seeds)}
    settings |= frozen
    more = {"training": settings, "trainings": facts}
    return replace(results, settings={**results.settings, **more})


def _digests(clip: str) -> dict[str, str]:
    """Digests of frozen encoders: another model of one name makes other stages."""
    encoders = load_clip(clip)
    modalities = ("vision", "text") if encoders.tokenizer is not None else ("vision",)
    return {f"{modality} encoder": encoders.digest(modality) for modality in modalities}
