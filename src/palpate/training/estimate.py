"""What a training takes, before it is started: parameters, steps, time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from palpate.training.options import LoopOptions

#: (model, rows, device) -> an output that depends on all parameters.
Forward = Callable[[nn.Module, int, torch.device], Tensor]
#: A model of more parameters is timed by one row; a smaller one by a batch.
SMALL = 10_000_000


def estimate(
    build: Callable[[], nn.Module],
    forward: Forward,
    options: LoopOptions,
    n: int,
    device: torch.device,
) -> dict[str, Any]:
    """Estimate a training in float32 on this machine, without its data.

    Args:
        build: makes the model that trains.
        forward: its forward pass for so many random rows.
        options: steps and batch.
        n: training rows.
        device: where a step is timed, forward and backward; the second of two counts.
    """
    batch, model = min(options.batch, n), build().to(device)
    parameters = sum(p.numel() for p in model.parameters())
    rows, seconds = batch if parameters < SMALL else 1, 0.0
    for _ in range(2):
        began = time.perf_counter()
        forward(model, rows, device).sum().backward()
        if device.type == "cuda":
            torch.cuda.synchronize()
        seconds = time.perf_counter() - began
    return {
        "parameters": parameters,
        "train_samples": n,
        "steps": options.steps,
        "batch": batch,
        "learning_rate": options.lr,
        "device": device.type,
        "seconds": round(seconds / rows * batch * options.steps, 1),
    }
