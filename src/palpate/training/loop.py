"""The training loop of every model: steps in a fixed order, checkpoints, resume by running again.

The rows and the noise of step k depend on (seed, k) alone, so a run that is stopped and started
again takes the same steps as one that was not. A checkpoint is one safetensors file (weights,
moving average, both Adam moments) with the step and the log in its metadata: one rename replaces
all of it, and no pickle is involved.

The moving average of the weights is ``a <- d a + (1 - d) w`` with ``d = min(ema, (1 + k) / (10 +
k))``, the warm-up of latent diffusion (Rombach et al., CVPR 2022, public code).
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from palpate.core import (
    PalpateError,
    Progress,
    atomic_path,
    digest_json,
    locked,
    quiet,
    require_new_folder,
    rng_for,
    seed_for,
)

#: (module, rows (batch,), generator, step) -> scalar loss, and numbers to log.
LossFunction = Callable[[nn.Module, Tensor, torch.Generator, int], tuple[Tensor, dict[str, float]]]
CHECKPOINT, LOG = "checkpoint.safetensors", "log.jsonl"
MOMENTS = ("exp_avg", "exp_avg_sq")  # of AdamW


@dataclass(frozen=True)
class LoopOptions:
    """How to train.

    Attributes:
        steps: optimizer steps in all.
        batch: rows per step.
        lr: peak learning rate (the effective one; nothing multiplies it later).
        warmup: steps of linear warm-up.
        decay: ``cosine`` to zero after the warm-up, or ``constant``.
        weight_decay: of AdamW; applied to parameters of two or more dimensions.
        clip: largest gradient norm, or None.
        ema: decay of the moving average that becomes the result, or None for the last weights.
        seed: of the order of rows and of the noise.
        checkpoint_seconds: time between checkpoints.
        betas: decay rates of AdamW's two moments.

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
        valid = {
            "steps": (self.steps >= 0, "must be at least 0"),
            "batch": (self.batch >= 1, "must be at least 1"),
            "lr": (0 < self.lr < math.inf, "must be positive and finite"),
            "warmup": (self.warmup >= 0, "must be at least 0"),
            "decay": (self.decay in ("cosine", "constant"), "must be cosine or constant"),
            "weight_decay": (self.weight_decay >= 0, "must be at least 0"),
            "clip": (self.clip is None or self.clip > 0, "must be positive or None"),
            "ema": (self.ema is None or 0 <= self.ema < 1, "must lie in [0, 1) or be None"),
        }
        for name, (holds, must) in valid.items():
            if not holds:
                got, fix = repr(getattr(self, name)), "Choose another value"
                raise PalpateError(must, got, fix, argument=name)

    @property
    def facts(self) -> dict[str, object]:
        """The options that decide the result: all but the time between checkpoints."""
        return {k: v for k, v in asdict(self).items() if k != "checkpoint_seconds"}


def rows_at(step: int, batch: int, n: int, seed: int) -> np.ndarray:
    """The ``batch`` row numbers of one step: shuffled epochs of ``n`` rows, end to end."""
    position = np.arange(step * batch, (step + 1) * batch)
    epochs, at = position // n, position % n
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
    """Train ``module`` in place; resume from ``folder`` if it holds a checkpoint of the same run.

    Args:
        module: parameters that require gradients are trained, on the module's device.
        loss: see :data:`LossFunction`; its generator is on the CPU.
        n: number of training rows.
        options: see :class:`LoopOptions`.
        folder: receives ``checkpoint.safetensors`` and ``log.jsonl``. A checkpoint of other rows,
            options, shapes or ``key`` is ignored and then replaced.
        what: name for the progress bar and errors.
        key: digest of the data and of settings outside ``options``.
        progress: called after each step with the smoothed loss as remark.

    Returns:
        The log: dictionaries with ``step``, ``loss``, ``lr``, ``seconds`` and what ``loss``
        returned.

    Raises:
        PalpateError: without rows or parameters to train, or if the loss or its gradient stops
            being finite.
    """
    if n < 1:
        fix = "Check the split: is its train part empty?"
        raise PalpateError(f"{what} needs at least one sample", "none", fix)
    state = _State(module, options, key, n, what)
    start = state.restore(folder)
    smooth, saved = math.nan, time.monotonic()
    module.train()
    try:
        for step in range(start, options.steps):
            began = time.monotonic()
            generator = torch.Generator().manual_seed(seed_for(options.seed, "step", step))
            rows = torch.from_numpy(rows_at(step, options.batch, n, options.seed))
            value, logs = loss(module, rows, generator, step)
            number = state.update(value)
            if step % 10 == 0 or step == options.steps - 1:
                facts = {"step": step, "loss": number, "lr": learning_rate(step, options)}
                state.log.append(facts | {"seconds": time.monotonic() - began} | logs)
            state.busy = False
            smooth = number if math.isnan(smooth) else 0.95 * smooth + 0.05 * number
            progress(what, step + 1, options.steps, f"loss {smooth:.4f}")
            if time.monotonic() - saved > options.checkpoint_seconds:
                state.save(folder)
                saved = time.monotonic()
    except KeyboardInterrupt:
        # Only between two steps is the state one that an uninterrupted run passes through.
        if state.step > start and not state.busy:
            state.save(folder)
        raise
    if start < options.steps:
        state.save(folder)
    with torch.no_grad():
        for name, value in state.average.items():
            state.parameters[name].copy_(value)
    module.eval()
    return state.log


class _State:
    """All that a checkpoint holds.

    Attributes:
        step: whole steps done.
        busy: an update has begun and is not finished.
    """

    def __init__(
        self, module: nn.Module, options: LoopOptions, key: str, n: int, what: str
    ) -> None:
        self.module, self.options, self.what = module, options, what
        self.parameters = {k: p for k, p in module.named_parameters() if p.requires_grad}
        if not self.parameters:
            fix = "Do not freeze the whole model"
            raise PalpateError(f"{what} needs parameters that require gradients", "none", fix)
        matrices = [p for p in self.parameters.values() if p.ndim >= 2]
        vectors = [p for p in self.parameters.values() if p.ndim < 2]
        groups = [{"params": matrices, "weight_decay": options.weight_decay}]
        groups += [{"params": vectors, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(
            [g for g in groups if g["params"]], lr=options.lr, betas=options.betas
        )
        averaged = self.parameters if options.ema is not None else {}
        self.average = {name: p.detach().clone() for name, p in averaged.items()}
        shapes = {name: list(p.shape) for name, p in self.parameters.items()}
        self.key = digest_json([key, n, shapes, options.facts])
        self.step, self.busy = 0, False
        self.log: list[dict[str, float]] = []

    def update(self, loss: Tensor) -> float:
        """One optimizer step and one step of the average; returns the loss."""
        number = float(loss.detach())
        self._require_finite("loss", number)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.step, self.options)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        limit = math.inf if self.options.clip is None else self.options.clip
        norm = torch.nn.utils.clip_grad_norm_(list(self.parameters.values()), limit)
        self._require_finite("gradient", float(norm))  # a checkpoint would keep the harm
        self.busy = True
        self.optimizer.step()
        if self.options.ema is not None:
            d = min(self.options.ema, (1 + self.step) / (10 + self.step))
            with torch.no_grad():
                for name, value in self.average.items():
                    value.lerp_(self.parameters[name], 1 - d)
        self.step += 1
        return number

    def _require_finite(self, name: str, value: float) -> None:
        if not math.isfinite(value):
            must, got = f"The {name} of {self.what} must be finite", f"{value} at step {self.step}"
            raise PalpateError(must, got, "Lower the learning rate")

    def save(self, folder: Path) -> None:
        """Write the checkpoint and a readable copy of the log."""
        tensors = {f"model.{k}": v for k, v in self.module.state_dict().items()}
        tensors |= {f"ema.{k}": v for k, v in self.average.items()}
        for name, p in self.parameters.items():
            moments = self.optimizer.state.get(p, {})  # none for a parameter that is not used yet
            tensors |= {f"{m}.{name}": moments[m] for m in MOMENTS if m in moments}
        # Tied weights share storage, which safetensors rejects: each entry gets a copy.
        tensors = {k: v.detach().to("cpu", copy=True).contiguous() for k, v in tensors.items()}
        metadata = {"key": self.key, "step": str(self.step), "log": json.dumps(self.log)}
        with atomic_path(folder / CHECKPOINT) as part:
            save_file(tensors, part, metadata=metadata)
        with atomic_path(folder / LOG) as part:
            lines = "".join(json.dumps(line) + "\n" for line in self.log)
            part.write_text(lines, encoding="utf-8")

    def restore(self, folder: Path) -> int:
        """Load a checkpoint of this run, if there is one; returns the step to go on from."""
        path = folder / CHECKPOINT
        if not path.is_file():
            return 0
        try:
            with safe_open(path, framework="pt") as file:
                meta = file.metadata() or {}
                if meta.get("key") != self.key:
                    return 0
                tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 - no iterator
        except SafetensorError as error:
            must = f"The checkpoint {path} must be a whole safetensors file"
            raise PalpateError(must, str(error), "Delete it to start anew") from None
        model = {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
        self.module.load_state_dict(model)
        for name, value in self.average.items():
            value.copy_(tensors[f"ema.{name}"])
        self.step, self.log = int(meta["step"]), json.loads(meta["log"])
        for name, p in self.parameters.items():
            if f"{MOMENTS[0]}.{name}" in tensors:
                moments = {m: tensors[f"{m}.{name}"].to(p.device) for m in MOMENTS}
                self.optimizer.state[p] = {"step": torch.tensor(float(self.step)), **moments}
        return self.step


@contextmanager
def work_folder(output: Path | None) -> Generator[Path]:
    """A folder for checkpoints and caches of a training whose result goes to ``output``.

    ``.<name>.work`` next to the output, which the same call finds again after a stop and which is
    removed on success; a temporary folder where there is no output.

    Raises:
        PalpateError: if the output exists already or is written by another run, before any work is
            done.
    """
    if output is None:
        with tempfile.TemporaryDirectory(prefix="palpate-") as name:
            yield Path(name)
        return
    require_new_folder(output)
    work = output.absolute().parent / f".{output.name}.work"
    try:
        with locked(work, output):
            yield work
    except PalpateError:
        if not any(p.is_file() for p in work.rglob("*")):  # rejected before any work was done
            shutil.rmtree(work)
        raise
    shutil.rmtree(work, ignore_errors=True)
