"""What a training does (:class:`LoopOptions`), how it is run (:class:`Compute`), the order of rows.

This file needs no torch: presets and the command line are made of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from palpate.core import require, rng_for

Precision = Literal["float32", "bf16", "fp16"]
Tracker = Literal["tensorboard", "wandb"]


@dataclass(frozen=True)
class LoopOptions:
    """What decides the result of a training.

    Attributes:
        steps: length in all [optimizer steps].
        batch: of a step, over all processes [rows].
        lr: peak learning rate (the effective one; nothing multiplies it later).
        warmup: length of the linear warm-up [optimizer steps].
        decay: ``cosine`` to zero after the warm-up, or ``constant``.
        weight_decay: of AdamW; applied to parameters of two or more dimensions.
        clip_norm: largest gradient norm, or None.
        ema: decay of the moving average that becomes the result, or None for the last weights.
        seed: of the order of rows and of the noise.
        betas: decay rates of AdamW's two moments.
        evaluations: how often the held-out part is evaluated, evenly spread over the steps.
        patience: stop after as many evaluations without a better held-out loss; None: never.
        keep: which weights become the result: those of the best held-out loss, where there is a
            held-out part and it is evaluated, or the last.

    Raises:
        PalpateError: if a number lies outside its range or a word is unknown.
    """

    steps: int
    batch: int
    lr: float
    warmup: int = 20
    decay: Literal["cosine", "constant"] = "cosine"
    weight_decay: float = 0.01
    clip_norm: float | None = 1.0
    ema: float | None = None
    seed: int = 0
    betas: tuple[float, float] = (0.9, 0.999)
    evaluations: int = 10
    patience: int | None = None
    keep: Literal["last", "best"] = "best"

    def __post_init__(self) -> None:
        valid = {
            "steps": (self.steps >= 0, "must be at least 0"),
            "batch": (self.batch >= 1, "must be at least 1"),
            "lr": (0 < self.lr < math.inf, "must be positive and finite"),
            "warmup": (self.warmup >= 0, "must be at least 0"),
            "decay": (self.decay in ("cosine", "constant"), "must be cosine or constant"),
            "weight_decay": (0 <= self.weight_decay < math.inf, "must be at least 0"),
            "clip_norm": (self.clip_norm is None or self.clip_norm > 0, "must be positive or None"),
            "ema": (self.ema is None or 0 <= self.ema < 1, "must lie in [0, 1) or be None"),
            "betas": (all(0 <= b < 1 for b in self.betas), "must lie in [0, 1)"),
            "evaluations": (self.evaluations >= 0, "must be at least 0"),
            "patience": (
                self.patience is None or (self.patience >= 1 and self.evaluations > 0),
                "must be at least 1, with evaluations",
            ),
            "keep": (self.keep in ("last", "best"), "must be last or best"),
        }
        for name, (holds, must) in valid.items():
            require(holds, name, must, repr(getattr(self, name)), fix="Choose another value")


@dataclass(frozen=True)
class Compute:
    """How to run a training on the machine at hand.

    It changes rounding, speed and memory, not what is computed, so a run may go on with another.

    Attributes:
        precision: of matrix products: ``bf16`` and ``fp16`` by autocast, weights stay float32. An
            x86 processor without bf16 computes in float32 in its place, many times faster; with
            bf16 but without AMX, Intel's was slower in it than in float32
            (docs/studies/generating.md).
        tf32: let float32 products on CUDA round their factors to 10 bits.
        compile: compile the loss with ``torch.compile``: minutes at the start, faster steps.
        channels_last: memory layout of convolutions.
        gradient_checkpointing: keep no activations inside of blocks, compute them twice.
        chunk: rows that a contrastive encoder sees at a time; the loss is over the whole batch all
            the same (cached gradients). None: all.
        checkpoint_minutes: time between checkpoints.
        trackers: ``tensorboard``, ``wandb``: the log, also there.
    """

    precision: Precision = "float32"
    tf32: bool = True
    compile: bool = False
    channels_last: bool = False
    gradient_checkpointing: bool = False
    chunk: int | None = None
    checkpoint_minutes: float = 5.0
    trackers: tuple[Tracker, ...] = ()

    def __post_init__(self) -> None:
        fits, fix = (
            self.chunk is None or self.chunk >= 1,
            "Leave it out for the whole batch at once",
        )
        require(fits, "chunk", "must be at least 1", self.chunk, fix=fix)
        minutes = self.checkpoint_minutes
        require(minutes >= 0, "checkpoint_minutes", "must be at least 0", minutes)
        for name in self.trackers:
            installed = find_spec(name) or find_spec(name + "X")  # tensorboardX writes the same
            fix = f"pip install {name}"
            require(installed is not None, "trackers", "must be installed", name, fix=fix)


def learning_rate(step: int, options: LoopOptions) -> float:
    """Linear warm-up, then cosine to zero or constant."""
    if step < options.warmup:
        return options.lr * (step + 1) / options.warmup
    if options.decay == "constant":
        return options.lr
    through = (step - options.warmup) / max(1, options.steps - options.warmup)
    return options.lr * 0.5 * (1 + math.cos(math.pi * min(1.0, through)))


class RowOrder:
    """The rows of each step: shuffled epochs end to end, no row twice in a batch.

    A batch that crosses the border of two epochs takes from the next one the first rows that it
    does not hold yet; the others follow in their order, so each epoch stays a permutation.
    """

    def __init__(self, n: int, batch: int, seed: int) -> None:
        """Take the number of rows, and of rows a step: at most ``n``."""
        self.n, self.batch, self.seed = n, batch, seed
        self._last = (-1, np.empty(0, np.int64))  # an epoch and its order

    def __call__(self, step: int) -> NDArray[np.int64]:
        """Return the row numbers of a step, (batch,)."""
        epoch, start = divmod(step * self.batch, self.n)
        rows = self._epoch(epoch)[start : start + self.batch]
        if len(rows) < self.batch:
            rows = np.concatenate([rows, self._epoch(epoch + 1)[: self.batch - len(rows)]])
        return rows

    def _epoch(self, epoch: int) -> NDArray[np.int64]:
        number, order = self._last
        if number > epoch:
            number = -1
        if self.n >= 2 * self.batch and number < epoch - 1:
            # So long an epoch ends in the same rows whatever its start was changed to.
            number, order = epoch - 1, self._shuffled(epoch - 1)
        while number < epoch:
            number += 1
            order = self._after(order, number)
        self._last = number, order
        return order

    def _shuffled(self, epoch: int) -> NDArray[np.int64]:
        return rng_for(self.seed, "order", epoch).permutation(self.n)

    def _after(self, before: NDArray[np.int64], epoch: int) -> NDArray[np.int64]:
        order = self._shuffled(epoch)
        carried = epoch * self.n % self.batch  # rows of the epoch before in the open batch
        if not carried:
            return order
        held = np.isin(order, before[-carried:])
        first = np.flatnonzero(~held)[: self.batch - carried]
        return np.concatenate([order[first], np.delete(order, first)])
