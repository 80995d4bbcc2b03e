"""What decides the result of a training of encoders, what it must have, and its card."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
import transformers
from torch import nn

from palpate._version import __version__
from palpate.core import Split, digest_lines, require
from palpate.data.images import image_stamp
from palpate.data.manifest import Manifest
from palpate.encoders.presets import EncoderPreset
from palpate.encoders.rows import with_values
from palpate.training.engine import Task, fit
from palpate.training.options import LoopOptions
from palpate.training.processes import place
from palpate.training.run import TrainingRun


def require_rows(
    train: Manifest, batch: int, noun: str = "samples", course: str = "tactile_course"
) -> None:
    """Raise unless there are two rows in the train part, and in a batch."""
    must = f"The train part must hold two {noun}: the loss compares them with each other"
    fix = "Make another split: palpate split"
    require(len(train) > 1, None, must, f"one, {train.ids[0]}", fix=fix)
    must = "must be at least 2: the loss compares rows"
    require(batch > 1, f"{course}.batch", must, batch, fix="Pass a larger one")


def require_held_out(held: Manifest, options: LoopOptions) -> None:
    """Raise unless there is a held-out part where patience needs one, of two samples."""
    must, fix = "needs a part val of the split", "Make one: palpate split --val 0.1"
    fits = len(held) > 0 or not options.patience
    require(fits, "tactile_course.patience", must, "none", fix=fix)
    must = "The held-out part must hold two samples: the loss compares them with each other"
    got, fix = f"one, {''.join(held.ids[:1])}", "Make another split: palpate split"
    require(len(held) != 1 or not options.evaluations, None, must, got, fix=fix)


def sides(train: Manifest) -> list[str]:
    """The image columns that training uses: without a single photo, the tactile images alone."""
    both = ["vision", "tactile"]
    return [side for side in both if train.table[side].count()] or both


def stamps(train: Manifest) -> list[str]:
    """What must not have changed on disk for a checkpoint to be continued."""
    columns = [*sides(train), "background"]
    return [image_stamp(with_values(train, column), column) for column in columns]


def facts_of(
    preset: EncoderPreset,
    train: Manifest,
    split: Split,
    texts: tuple[Sequence[str], str],
    options: LoopOptions,
) -> dict[str, Any]:
    """What decides the result of a training run; also the run's key."""
    return {
        "preset": preset.name,
        "settings": {k: v for k, v in asdict(preset).items() if k not in ("cost", "score")},
        "options": asdict(options),
        "seed": options.seed,
        "train_manifest": train.digest,
        "train_samples": len(train),
        "split": split.digest,
        "split_rule": dict(split.rule),
        "texts": digest_lines(texts[0]),
        "distinct_texts": len(set(texts[0])),
        "text_source": texts[1],
        "targets": preset.targets,
    }


def fitted(
    model: nn.Module, task: Task, options: LoopOptions, facts: Mapping[str, Any], run: TrainingRun
) -> dict[str, Any]:
    """Train and freeze a model.

    Returns:
        its card: the facts, the versions, and at most 50 points of the loss curve.
    """
    log = fit(model, task, options, run.folder, compute=run.compute, progress=run.progress)
    model.eval().requires_grad_(False)
    rows = sorted({round(k) for k in np.linspace(0, len(log) - 1, min(50, len(log)))})
    hidden = ("seconds", "lr")
    card = {
        **facts,
        "steps": options.steps,
        "device": next(model.parameters()).device.type,
        "versions": {
            "palpate": __version__,
            "torch": torch.__version__,
            "transformers": transformers.__version__,
            "python": platform.python_version(),
        },
        "processes": place()[1],
        "loss": [{k: round(v, 6) for k, v in log[r].items() if k not in hidden} for r in rows],
    }
    return json.loads(json.dumps(card))  # as it will be read back
