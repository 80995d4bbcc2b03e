"""What a training takes, before it is started: parameters, memory, operations, time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils.flop_counter import FlopCounterMode

from palpate.training.options import LoopOptions

#: (model, rows, device) -> an output that depends on all parameters.
Forward = Callable[[nn.Module, int, torch.device], Tensor]
PROBE = 5e10  # operations of the timed step, at most


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
        device: where a step of a few rows is timed, forward and backward.

    Returns:
        Counts; bytes of weights, gradients, moments and average, and of what a batch keeps for the
        backward pass; operations of a step (a multiplication and an addition are two; the backward
        pass counts as two forward passes); seconds.
    """
    batch, meta = min(options.batch, n), torch.device("meta")
    kept: dict[StorageWeakRef, int] = {}  # bytes; several operations may keep one tensor

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[StorageWeakRef(storage)] = storage.nbytes()
        return tensor

    with meta:
        model = build()
        keeping = torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor)
        with FlopCounterMode(display=False) as counter, keeping:
            forward(model, 1, meta)
    parameters = sum(p.numel() for p in model.parameters())
    weights = sum(p.numel() * p.element_size() for p in model.parameters())
    for p in model.parameters():  # products keep their weights, too
        kept.pop(StorageWeakRef(p.untyped_storage()), None)
    activations = sum(kept.values())
    row = 3 * counter.get_total_flops()
    seconds = _seconds(build, forward, max(1, min(batch, int(PROBE // max(1, row)))), device)
    return {
        "parameters": parameters,
        "train_samples": n,
        "steps": options.steps,
        "batch": batch,
        "learning_rate": options.lr,
        "learning_rate_per_sample": options.lr / batch,
        "state_bytes": (4 + (options.ema is not None)) * weights,
        "activation_bytes": activations * batch,
        "flop_per_step": row * batch,
        "flop": row * batch * options.steps,
        "device": device.type,
        "seconds": round(seconds * batch * options.steps, 1),
    }


def _seconds(
    build: Callable[[], nn.Module], forward: Forward, rows: int, device: torch.device
) -> float:
    """Seconds a row, forward and backward; the second of two runs."""
    model, taken = build().to(device), 0.0
    for _ in range(2):
        began = time.perf_counter()
        forward(model, rows, device).sum().backward()
        if device.type == "cuda":
            torch.cuda.synchronize()
        taken = time.perf_counter() - began
    return taken / rows
