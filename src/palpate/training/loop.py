"""One training loop for every model: steps in a fixed order, checkpoints, resume by running again.

The rows and the noise of step k depend on (seed, k) alone, so a run that is stopped and started again
takes the same steps as one that was not. A checkpoint is safetensors (weights, moving average, both Adam
moments) with the step and the log in its metadata, so that one rename replaces all of it; no pickle is written
or read. ``log.jsonl`` is a copy for people.

The moving average of the weights is ``a <- d a + (1 - d) w`` with ``d = min(ema, (1 + k) / (10 + k))``, the
warm-up that latent diffusion uses (reference: Rombach et al., CVPR 2022, public code).
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from palpate.core import PalpateError, Progress, atomic_path, digest_json, quiet, rng_for, seed_for

#: (module, rows (batch,), generator, step) -> scalar loss, and numbers to log.
LossFunction = Callable[[nn.Module, Tensor, torch.Generator, int], tuple[Tensor, dict[str, float]]]


@dataclass(frozen=True)
class LoopOptions:
    """How to train.

    Attributes:
        steps: optimizer steps in all.
        batch: rows a step.
        lr: peak learning rate (the effective one; nothing multiplies it later).
        warmup: steps of linear warm-up.
        decay: ``cosine`` to zero after the warm-up, or ``constant``.
        weight_decay: AdamW's; applied to parameters of two or more dimensions.
        clip: largest gradient norm, or None.
        ema: decay of the moving average that becomes the result, or None for the last weights.
        seed: of the order of rows and of the noise.
        checkpoint_seconds: time between checkpoints.
        betas: AdamW's decay rates of the two moments.

    Raises:
        PalpateError: if a number lies outside its range or ``decay`` is unknown.
    """

    steps: int
    batch: int
    lr: float
    warmup: int = 20
    decay: str = "cosine"
    weight_decay: float = 0.01
    clip: float | None = 1.0
    ema: float | None = None
    seed: int = 0
    checkpoint_seconds: float = 60.0
    betas: tuple[float, float] = (0.9, 0.999)

    def __post_init__(self) -> None:
        wrong = {
            "steps must be at least 0": self.steps < 0,
            "batch must be at least 1": self.batch < 1,
            "lr must be positive and finite": not 0 < self.lr < math.inf,
            "warmup must be at least 0": self.warmup < 0,
            "decay must be cosine or constant": self.decay not in ("cosine", "constant"),
            "weight_decay must be at least 0": not self.weight_decay >= 0,
            "clip must be positive, or None": self.clip is not None and not self.clip > 0,
            "ema must lie in [0, 1), or be None": self.ema is not None and not 0 <= self.ema < 1,
        }
        for must, bad in wrong.items():
            if bad:
                name = must.split()[0]
                raise PalpateError(
                    f"Training option {must}",
                    repr(getattr(self, name)),
                    f"Change the option {name}",
                )


def rows_at(step: int, batch: int, n: int, seed: int) -> np.ndarray:
    """The ``batch`` row numbers of one step: shuffled epochs of ``n`` rows, laid end to end."""
    place = np.arange(step * batch, (step + 1) * batch)
    epochs, at = place // n, place % n
    order = {e: rng_for(seed, "order", int(e)).permutation(n) for e in np.unique(epochs)}
    return np.array([order[e][k] for e, k in zip(epochs, at, strict=True)], dtype=np.int64)


def learning_rate(step: int, options: LoopOptions) -> float:
    """Linear warm-up, then cosine to zero or constant."""
    if step < options.warmup:
        return options.lr * (step + 1) / options.warmup
    if options.decay == "constant":
        return options.lr
    through = (step - options.warmup) / max(1, options.steps - options.warmup)
    return options.lr * 0.5 * (1 + math.cos(math.pi * min(1.0, through)))


def fit(
    module: nn.Module,
    loss: LossFunction,
    n: int,
    options: LoopOptions,
    folder: Path,
    *,
    what: str = "training",
    key: str = "",
    progress: Progress = quiet,
) -> list[dict[str, float]]:
    """Trains ``module`` in place, resuming from ``folder/checkpoint.safetensors`` if that belongs to the same run.

    Args:
        module: parameters that require gradients are trained; on its own device.
        loss: see :data:`LossFunction`; the generator lives on the CPU.
        n: number of training rows.
        options: see :class:`LoopOptions`.
        folder: receives the checkpoint and ``log.jsonl`` (one line a logged step). A checkpoint of other rows, other
            options or other shapes is not used, and is replaced by the first one of this run.
        what: name for the progress bar.
        key: digest of the data and settings outside ``options``; a checkpoint with another key is not used.
        progress: called after each step with the smoothed loss as remark.

    Returns:
        The log: dictionaries with ``step``, ``loss``, ``lr``, ``seconds`` and what ``loss`` returned.

    Raises:
        PalpateError: without rows or parameters to train, or if the loss or its gradient stops being finite.
    """
    if n < 1:
        raise PalpateError(
            f"{what} needs at least one sample", "none", "Check the split: is its train part empty?"
        )
    folder.mkdir(parents=True, exist_ok=True)
    params = {name: p for name, p in module.named_parameters() if p.requires_grad}
    if not params:
        raise PalpateError(
            f"{what} needs parameters that require gradients",
            "none",
            "Do not freeze the whole model",
        )
    groups = [
        {
            "params": [p for p in params.values() if p.ndim >= 2],
            "weight_decay": options.weight_decay,
        },
        {"params": [p for p in params.values() if p.ndim < 2], "weight_decay": 0.0},
    ]
    optimizer = torch.optim.AdamW(
        [g for g in groups if g["params"]], lr=options.lr, betas=options.betas
    )
    average = (
        {name: p.detach().clone() for name, p in params.items()} if options.ema is not None else {}
    )
    # How often a checkpoint is written changes nothing in the result, so it is not part of the key.
    shapes = {name: list(p.shape) for name, p in params.items()}
    key = digest_json(
        [key, n, shapes, {k: v for k, v in asdict(options).items() if k != "checkpoint_seconds"}]
    )
    start, log = _restore(folder, key, module, optimizer, params, average)
    module.train()
    smooth, saved = None, time.monotonic()
    whole = applied = (
        start  # steps wholly done, and steps whose update has begun: equal between two steps
    )
    try:
        for step in range(start, options.steps):
            began = time.monotonic()
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(step, options)
            generator = torch.Generator().manual_seed(seed_for(options.seed, "step", step))
            rows = torch.from_numpy(rows_at(step, options.batch, n, options.seed))
            value, logs = loss(module, rows, generator, step)
            number = float(value.detach())
            if not math.isfinite(number):
                raise PalpateError(
                    f"The loss of {what} must stay finite",
                    f"{number} at step {step}",
                    "Lower the learning rate",
                )
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            # A limit of infinity only measures. Weights must never meet such a gradient: a checkpoint would keep the harm.
            norm = float(
                torch.nn.utils.clip_grad_norm_(
                    list(params.values()), math.inf if options.clip is None else options.clip
                )
            )
            if not math.isfinite(norm):
                raise PalpateError(
                    f"The gradient of {what} must stay finite",
                    f"norm {norm} at step {step}",
                    "Lower the learning rate",
                )
            applied = step + 1
            optimizer.step()
            if options.ema is not None:
                d = min(options.ema, (1 + step) / (10 + step))
                with torch.no_grad():
                    for name, value in average.items():
                        value.lerp_(params[name], 1 - d)
            if step % 10 == 0 or step == options.steps - 1:
                log.append(
                    {
                        "step": step,
                        "loss": number,
                        "lr": learning_rate(step, options),
                        "seconds": time.monotonic() - began,
                        **logs,
                    }
                )
            whole = step + 1
            smooth = number if smooth is None else 0.95 * smooth + 0.05 * number
            progress(what, step + 1, options.steps, f"loss {smooth:.4f}")
            if time.monotonic() - saved > options.checkpoint_seconds:
                _checkpoint(folder, key, step + 1, optimizer, module, params, average, log)
                saved = time.monotonic()
    except KeyboardInterrupt:
        # Only between two steps is the state one that an uninterrupted run passes through.
        if whole > start and whole == applied:
            _checkpoint(folder, key, whole, optimizer, module, params, average, log)
        raise
    if start < options.steps:
        _checkpoint(folder, key, options.steps, optimizer, module, params, average, log)
    with torch.no_grad():
        for name, value in average.items():
            params[name].copy_(value)
    module.eval()
    return log


def _checkpoint(
    folder: Path,
    key: str,
    step: int,
    optimizer: torch.optim.Optimizer,
    module: nn.Module,
    params: dict[str, nn.Parameter],
    average: dict[str, Tensor],
    log: list[dict[str, float]],
) -> None:
    tensors = {f"model.{k}": v for k, v in module.state_dict().items()} | {
        f"ema.{k}": v for k, v in average.items()
    }
    for name, p in params.items():
        for moment in ("exp_avg", "exp_avg_sq"):
            if moment in (state := optimizer.state.get(p, {})):
                tensors[f"{moment}.{name}"] = state[moment]
    # Tied weights share storage, which safetensors refuses: each entry gets its own.
    tensors = {k: v.detach().to("cpu", copy=True).contiguous() for k, v in tensors.items()}
    with atomic_path(folder / "checkpoint.safetensors") as part:
        save_file(tensors, part, metadata={"key": key, "step": str(step), "log": json.dumps(log)})
    with atomic_path(folder / "log.jsonl") as part:
        part.write_text("".join(json.dumps(line) + "\n" for line in log), encoding="utf-8")


def _restore(
    folder: Path,
    key: str,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    params: dict[str, nn.Parameter],
    average: dict[str, Tensor],
) -> tuple[int, list[dict[str, float]]]:
    """Loads a checkpoint of this run, if there is one; returns the step to go on from, and the log up to there."""
    path = folder / "checkpoint.safetensors"
    if not path.is_file():
        return 0, []
    with _opened(path) as file:
        meta = file.metadata() or {}
        if meta.get("key") != key:
            return 0, []
        step = int(meta["step"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no iterator of its own
    module.load_state_dict(
        {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
    )
    for name, value in average.items():
        value.copy_(tensors[f"ema.{name}"])
    for name, p in params.items():
        if f"exp_avg.{name}" in tensors:
            optimizer.state[p] = {
                "step": torch.tensor(float(step)),
                "exp_avg": tensors[f"exp_avg.{name}"].to(p.device),
                "exp_avg_sq": tensors[f"exp_avg_sq.{name}"].to(p.device),
            }
    return step, json.loads(meta["log"])


def _opened(path: Path) -> Any:
    """A checkpoint file, open for reading."""
    try:
        return safe_open(path, framework="pt")
    except SafetensorError as error:
        raise PalpateError(
            f"The checkpoint {path} must be a whole safetensors file",
            str(error),
            "Delete it to start anew",
        ) from None
