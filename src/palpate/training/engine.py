"""The training engine of every model: steps in a fixed order, checkpoints, resume by running again.

The rows and the noise of step k depend on (seed, k) alone, so a run that is stopped and started
again takes the same steps as one that was not, on any number of processes. A checkpoint is one
safetensors file (weights, moving average, both Adam moments) with the step and the log in its
metadata: one rename replaces all of it, and no pickle is involved. It is written in the background,
and sealed: one that was damaged since is refused.

The moving average of the weights is ``a <- d a + (1 - d) w`` with ``d = min(ema, (1 + k) / (10 +
k))``, the warm-up of latent diffusion (Rombach et al., CVPR 2022, public code).
"""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from palpate.core import (
    PalpateError,
    PalpateWarning,
    Progress,
    atomic_path,
    digest_json,
    few,
    is_whole,
    quiet,
    require,
    rng_for,
    save_image,
    sealed_path,
    short,
)
from palpate.training.options import Compute, LoopOptions, RowOrder, Tracker, learning_rate
from palpate.training.processes import agreed, average, barrier, merged, place, shared
from palpate.training.steps import Step

Batch = dict[str, Tensor]
#: The data of a step, on the CPU; called in a thread, ahead of the step.
Load = Callable[[Step], Batch]
CHECKPOINT, LOG = "checkpoint.safetensors", "log.jsonl"
SAMPLES = "samples"
MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # of AdamW, which counts the steps it did not skip
DTYPES = {"bf16": torch.bfloat16, "fp16": torch.float16}
EVERY = 10  # steps between two lines of the log


class Losses(NamedTuple):
    """The loss of a batch.

    Attributes:
        total: scalar, with its graph.
        logs: scalars to log.
        rows: a number for each row (n,), not finite where the row makes the loss so.
    """

    total: Tensor
    logs: dict[str, Tensor] = {}  # noqa: RUF012 - never changed
    rows: Tensor | None = None


Loss = Callable[[nn.Module, Batch], Losses]


@dataclass(frozen=True)
class Task:
    """What is trained on what.

    Attributes:
        name: of the training, for progress and errors.
        n: number of training rows.
        load: the data of a step.
        loss: the loss of what ``load`` gave, once it is on the module's device.
        key: digest of the data and of settings outside :class:`LoopOptions`.
        names: of the rows, for errors.
        held_out: rows of the held-out part, and ``load`` of it.
        samples: an image, bytes (h, w, 3), of what the module makes of a few samples; drawn with
            each checkpoint.
    """

    name: str
    n: int
    load: Load
    loss: Loss
    key: str = ""
    names: Sequence[str] | None = None
    held_out: tuple[int, Load] | None = None
    samples: Callable[[nn.Module], NDArray[np.uint8]] | None = None


def fit(
    module: nn.Module,
    task: Task,
    options: LoopOptions,
    folder: Path,
    *,
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> list[dict[str, float]]:
    """Train ``module`` in place; resume from ``folder`` if it holds a checkpoint of the same run.

    Args:
        module: parameters that require gradients are trained, on the module's device.
        task: see :class:`Task`.
        options: see :class:`LoopOptions`; no batch is larger than the set.
        folder: receives ``checkpoint.safetensors`` and ``log.jsonl``, ``best-<key>.safetensors``
            where there is a held-out part, and ``samples/<step>.png`` where the task draws them. A
            checkpoint of other rows, options, shapes or ``key`` is ignored and then replaced.
            Several processes must share it.
        compute: see :class:`Compute`.
        progress: called after each step with the smoothed loss and the last held-out one.

    Returns:
        The log: dictionaries with ``step``, ``loss``, ``lr``, ``seconds`` (of a step) and what the
        loss logged; ``held_out`` where the held-out part was evaluated.

    Raises:
        PalpateError: without rows or parameters to train, if the batch cannot be shared by the
            processes, if another process ends, or if the loss or its gradient stops being finite.
    """
    compute = compute or Compute()
    with _numerics(compute):
        run = _Run(module, task, options, folder, compute)
        start = run.restore()
        module.train()
        try:
            run.steps(start, progress)
        except KeyboardInterrupt:
            # Only between two steps is the state one that an uninterrupted run passes through.
            if run.step > start and not run.busy:
                run.save(wait=True)
            raise
        finally:
            run.close()
        run.finish()
    return run.log


class _Run:
    """A training under way, and all that a checkpoint holds.

    Attributes:
        step: whole steps done.
        busy: an update has begun and is not finished.
        resumed: it goes on from a checkpoint.
    """

    def __init__(
        self, module: nn.Module, task: Task, options: LoopOptions, folder: Path, compute: Compute
    ) -> None:
        self.part = place()
        fix = "Check the split: is its train part empty?"
        require(task.n >= 1, None, f"{task.name} needs at least one sample", "none", fix=fix)
        batch = min(options.batch, task.n)
        if batch % self.part[1]:
            must = f"must be a multiple of the {self.part[1]} processes"
            got = f"{batch}" + (", all training samples" if batch == task.n else "")
            fix = "Choose another, or another number of processes"
            raise shared(PalpateError(must, got, fix, argument="batch"))
        self.module, self.task, self.options = module, task, options
        self.folder, self.compute = folder, compute
        self.parameters = {k: p for k, p in module.named_parameters() if p.requires_grad}
        must, fix = f"{task.name} needs parameters that require gradients", "Freeze less of it"
        require(bool(self.parameters), None, must, "none", fix=fix)
        self.device = next(iter(self.parameters.values())).device
        self.dtype = DTYPES.get(compute.precision)
        if compute.precision == "bf16" and self.device.type == "cpu" and not has_bf16():
            self.dtype = None
            text = "This processor has no bf16 and would emulate it: training in float32"
            warnings.warn(text, PalpateWarning, stacklevel=3)
        matrices = [p for p in self.parameters.values() if p.ndim >= 2]
        vectors = [p for p in self.parameters.values() if p.ndim < 2]
        groups = [{"params": matrices, "weight_decay": options.weight_decay}]
        groups += [{"params": vectors, "weight_decay": 0.0}]
        cuda = self.device.type == "cuda"
        self.optimizer = torch.optim.AdamW(
            [g for g in groups if g["params"]],
            lr=options.lr,
            betas=options.betas,
            **({"fused": True} if cuda else {"foreach": True}),
        )
        self.scaler = torch.GradScaler(self.device.type, enabled=compute.precision == "fp16")
        averaged = self.parameters if options.ema is not None else {}
        self.average = {name: p.detach().clone() for name, p in averaged.items()}
        shapes = {name: list(p.shape) for name, p in self.parameters.items()}
        self.key = digest_json(["palpate-checkpoint/1", task.key, task.n, shapes, asdict(options)])
        self.best_file = folder / f"best-{short(self.key)}.safetensors"  # not of another run
        self.order = RowOrder(task.n, batch, options.seed)
        self.loss = torch.compile(task.loss) if compute.compile else task.loss
        if compute.gradient_checkpointing:
            _checkpoint_blocks(module)
        if compute.channels_last:
            module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.step, self.busy, self.resumed = 0, False, False
        self.log: list[dict[str, float]] = []
        self.reader, self.writer = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self.written: Future[None] | None = None
        self.trackers: list[Any] = []
        #: Step, names, values, gradient's norm and rows of steps, still on the device.
        self.unchecked: list[tuple[int, tuple[str, ...], Tensor, Tensor, Tensor | None]] = []

    # --- the steps -----------------------------------------------------------------------------

    def steps(self, start: int, progress: Progress) -> None:
        """Take the steps from ``start`` on, and write what comes of it."""
        options = self.options
        if start >= options.steps or self.stopped:
            return
        self.open_log()
        evaluations = self.evaluation_steps()
        smooth, saved, began = math.nan, time.monotonic(), time.monotonic()
        ahead = self.reader.submit(self.load, start)
        logged = start
        for step in range(start, options.steps):
            batch = ahead.result()
            if step + 1 < options.steps:
                ahead = self.reader.submit(self.load, step + 1)
            self.update(batch)
            last = step == options.steps - 1
            if self.device.type == "cpu" or step % EVERY == 0 or last:
                values = self.check()
                smooth = values["loss"] if math.isnan(smooth) else smooth
                smooth = 0.95 * smooth + 0.05 * values["loss"]
                if step % EVERY == 0 or last:
                    each = (time.monotonic() - began) / (step + 1 - logged)
                    facts = {"step": step, "loss": values.pop("loss")}
                    self.write_log(
                        facts | {"lr": learning_rate(step, options), "seconds": each} | values
                    )
                    began, logged = time.monotonic(), step + 1
            if step + 1 in evaluations:
                self.evaluate(step + 1)
            self.busy = False
            held = [f", held out {at['held_out']:.4f}" for at in self.log if "held_out" in at][-1:]
            progress(
                self.task.name, step + 1, options.steps, "".join([f"loss {smooth:.4f}", *held])
            )
            if self.stopped:
                break
            if time.monotonic() - saved > 60 * self.compute.checkpoint_minutes:
                self.save()
                self.draw()
                saved = time.monotonic()
        self.save(wait=True)
        self.draw()

    def load(self, step: int) -> Batch:
        """The data of this process's rows, ready to be copied to the device."""
        batch = self.task.load(Step(step, self.order(step), self.options.seed, self.part))
        if self.device.type == "cuda":
            return {name: value.pin_memory() for name, value in batch.items()}
        return batch

    def forward(self, batch: Batch) -> Losses:
        """The loss of a batch, in the requested precision."""
        batch = {k: v.to(self.device, non_blocking=True) for k, v in batch.items()}
        with torch.autocast(self.device.type, self.dtype, enabled=self.dtype is not None):
            return self.loss(self.module, batch)

    def update(self, batch: Batch) -> None:
        """One optimizer step and one step of the average, without waiting for the device."""
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.step, self.options)
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.forward(batch)
        self.scaler.scale(losses.total).backward()
        scalars = (losses.total, *losses.logs.values())
        values = torch.stack([scalar.detach().float() for scalar in scalars])
        gradients = [p.grad for p in self.parameters.values() if p.grad is not None]
        average([*gradients, values])
        self.scaler.unscale_(self.optimizer)
        limit = math.inf if self.options.clip_norm is None else self.options.clip_norm
        norm = nn.utils.clip_grad_norm_(list(self.parameters.values()), limit)
        self.busy = True
        self.scaler.step(self.optimizer)
        self.scaler.update()
        if self.options.ema is not None:
            d = min(self.options.ema, (1 + self.step) / (10 + self.step))
            with torch.no_grad():
                torch._foreach_lerp_(  # pyright: ignore
                    list(self.average.values()), list(self.parameters.values()), 1 - d
                )
        rows = None if losses.rows is None else losses.rows.detach()
        self.unchecked.append((self.step, tuple(losses.logs), values, norm.detach(), rows))
        self.step += 1

    def check(self) -> dict[str, float]:
        """Raise if a loss or gradient since the last check is not finite; return the last values.

        A checkpoint would keep the harm, so none is written before this.
        """
        last: dict[str, float] = {}
        # In 16 bits, gradients overflow now and then: that step is skipped, the scale lowered.
        skipped = self.scaler.is_enabled() and self.scaler.get_scale() >= 1
        for step, names, values, norm, rows in self.unchecked:
            last = dict(zip(("loss", *names), values.tolist(), strict=True))
            if not math.isfinite(last["loss"]):
                raise self.not_finite("loss", last["loss"], step, rows)
            if not (skipped or math.isfinite(float(norm))):
                raise self.not_finite("gradient", float(norm), step, rows)
        self.unchecked.clear()
        return last

    def not_finite(self, name: str, value: float, step: int, rows: Tensor | None) -> PalpateError:
        """Name the rows of the global batch that make it so, or all of them."""
        self.busy = True  # the weights may be harmed: nothing of them is kept
        batch = Step(step, self.order(step), self.options.seed, self.part)
        finite = np.full(len(batch.rows), True)
        if rows is not None:
            finite = torch.isfinite(rows.flatten()).cpu().numpy()
        parts = merged({str(self.part[0]): batch.rows[~finite]})
        bad = np.concatenate([parts[str(rank)] for rank in range(self.part[1])])
        bad, names = bad if len(bad) else batch.all_rows, self.task.names
        listed = few(f"row {row}" if names is None else names[row] for row in bad)
        must = f"The {name} of {self.task.name} must be finite"
        got = f"{value} at step {step}, with {listed}"
        kept = "; the last checkpoint is kept" if self.resumed or self.written else ""
        fix = f"Look at these samples, or lower the learning rate{kept}"
        return shared(PalpateError(must, got, fix))

    # --- the held-out part ---------------------------------------------------------------------

    def evaluation_steps(self) -> set[int]:
        """After how many steps the held-out part is evaluated."""
        if self.task.held_out is None:
            return set()
        k, steps = self.options.evaluations, self.options.steps
        return {math.ceil(steps * i / k) for i in range(1, k + 1)} if k else set()

    def evaluate(self, step: int) -> None:
        """Log the held-out loss of the weights that would be the result now."""
        self.check()
        assert self.task.held_out is not None
        with self.evaluating():
            loss = self.held_out_loss(*self.task.held_out)
            if not math.isfinite(loss):
                must = f"The held-out loss of {self.task.name} must be finite"
                self.busy = True
                fix = "Lower the learning rate"
                raise shared(PalpateError(must, f"{loss} after step {step - 1}", fix))
            if loss < self.best[0] and not self.part[0]:
                _save(_copies(self.module.state_dict()), self.best_file)
        self.write_log({"step": step - 1, "held_out": loss})

    def held_out_loss(self, n: int, load: Load) -> float:
        """The mean loss over all held-out rows, with the same batches and draws always.

        The rows are shuffled, as in training, and cut into batches of nearly equal size, none
        smaller than a training batch if there are as many rows. The processes share the batches,
        each of which one process sees as a whole.
        """
        rows = rng_for(self.options.seed, "held-out").permutation(n)
        batches = np.array_split(rows, max(1, n // self.order.batch))
        rank, size = self.part
        sums = torch.zeros(2, device=self.device)  # of the losses of the rows, and of the rows
        for k in range(rank, len(batches), size):
            losses = self.forward(load(Step(k, batches[k], self.options.seed + 1)))
            sums += len(batches[k]) * torch.stack([losses.total.float(), sums.new_ones(())])
        average([sums])
        return float(sums[0] / sums[1])

    @property
    def best(self) -> tuple[float, int]:
        """The lowest held-out loss so far, and how many evaluations ago it was."""
        losses = [line["held_out"] for line in self.log if "held_out" in line]
        low = min(losses, default=math.inf)
        return low, len(losses) - 1 - losses.index(low) if losses else 0

    @property
    def keeps_best(self) -> bool:
        """Whether weights of an evaluation are the result."""
        return self.options.keep == "best" and self.best[0] < math.inf

    @property
    def stopped(self) -> bool:
        """Whether the held-out loss has not become better for long enough."""
        patience = self.options.patience
        return patience is not None and self.best[1] >= patience

    @contextmanager
    def evaluating(self) -> Generator[None]:
        """The averaged weights in place of the last ones, in evaluation mode, inside."""
        last = {name: self.parameters[name].detach().clone() for name in self.average}
        self.copy(self.average)
        self.module.eval()
        with torch.no_grad():
            yield
        self.module.train()
        self.copy(last)

    def draw(self) -> None:
        """Draw what the weights that would be the result now make of a few samples."""
        if self.task.samples is None or self.part[0]:
            return
        with self.evaluating():
            image = self.task.samples(self.module)
        save_image(self.folder / SAMPLES / f"{self.step:07}.png", image)
        for tracker in self.trackers:
            log = tracker.log_images
            if tracker.name == "tensorboard":
                log = partial(log, dataformats="NHWC")
            log({"samples": image[None]}, step=self.step)

    def copy(self, weights: dict[str, Tensor]) -> None:
        """Copy these weights into the module."""
        with torch.no_grad():
            for name, value in weights.items():
                self.parameters[name].copy_(value)

    def finish(self) -> None:
        """Leave the weights that are the result in the module, in evaluation mode."""
        if self.keeps_best:
            barrier()  # the first process writes it
            best = load_file(self.best_file, device=str(self.device))
            self.module.load_state_dict(best)
        else:
            self.copy(self.average)
        self.module.eval()

    # --- files ---------------------------------------------------------------------------------

    def open_log(self) -> None:
        """Write the log so far, and start the trackers."""
        if self.part[0]:
            return
        with atomic_path(self.folder / LOG) as part:
            part.write_text("".join(json.dumps(line) + "\n" for line in self.log), "utf-8")
        self.trackers = [_tracker(each, self.folder) for each in self.compute.trackers]
        for tracker in self.trackers:
            if tracker.name == "wandb":  # TensorBoard's takes numbers and words alone
                tracker.store_init_configuration(asdict(self.options))

    def write_log(self, line: dict[str, float]) -> None:
        """Add a line to the log, its file and the trackers."""
        self.log.append(line)
        if self.part[0]:
            return
        with open(self.folder / LOG, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        for tracker in self.trackers:
            tracker.log({k: v for k, v in line.items() if k != "step"}, step=int(line["step"]))

    def save(self, *, wait: bool = False) -> None:
        """Copy the state now and write it in the background; the first process alone does."""
        self.check()
        if self.part[0]:
            return
        if self.written is not None:
            self.written.result()  # raises what went wrong with the one before
        tensors = {f"model.{k}": v for k, v in self.module.state_dict().items()}
        tensors |= {f"ema.{k}": v for k, v in self.average.items()}
        for name, p in self.parameters.items():
            moments = self.optimizer.state.get(p, {})  # none for a parameter that is not used yet
            tensors |= {f"{m}.{name}": moments[m] for m in MOMENTS if m in moments}
        tensors = _copies(tensors)
        metadata = {"key": self.key, "step": str(self.step), "log": json.dumps(self.log)}
        if self.scaler.is_enabled():
            metadata["scaler"] = json.dumps(self.scaler.state_dict())
        self.written = self.writer.submit(_save, tensors, self.folder / CHECKPOINT, metadata)
        if wait:
            self.written.result()

    def close(self) -> None:
        """Wait for the threads, and end the trackers."""
        self.reader.shutdown(cancel_futures=True)
        self.writer.shutdown()
        for tracker in self.trackers:
            tracker.finish()

    def restore(self) -> int:
        """Load a checkpoint of this run, if there is one; returns the step to go on from.

        Raises:
            PalpateError: if it is damaged.
        """
        path = self.folder / CHECKPOINT
        if path.is_file():
            self._require_whole(path)
            self._read(path)
        if self.keeps_best:  # what the log calls the best must be there at the end
            self._require_whole(self.best_file)
        if self.part[1] > 1:
            steps = torch.tensor([float(self.step)] * 2, device=self.device)
            average([steps[:1]])
            must = f"All processes must read the same checkpoint {path}"
            got, fix = f"step {self.step} in one of them", "Put it on a disk that all share"
            require(bool(steps[0] == steps[1]), None, must, got, fix=fix)
        return self.step

    def _require_whole(self, path: Path) -> None:
        must, fix = f"The checkpoint {path} must be whole", f"Remove {self.folder} to start again"
        with agreed():
            require(is_whole(path), None, must, "damaged: its digest is another", fix=fix)

    def _read(self, path: Path) -> None:
        with safe_open(path, framework="pt") as file:
            meta = file.metadata() or {}
            if meta.get("key") != self.key:
                return
            tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 - no iterator
        model = {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
        self.module.load_state_dict(model)
        for name, value in self.average.items():
            value.copy_(tensors[f"ema.{name}"])
        self.step, self.log, self.resumed = int(meta["step"]), json.loads(meta["log"]), True
        if "scaler" in meta and self.scaler.is_enabled():
            self.scaler.load_state_dict(json.loads(meta["scaler"]))
        counter = self.device if self.device.type == "cuda" else "cpu"
        for name, p in self.parameters.items():
            if f"{MOMENTS[0]}.{name}" in tensors:
                state = {m: tensors[f"{m}.{name}"].to(p.device) for m in MOMENTS}
                self.optimizer.state[p] = state | {"step": state["step"].to(counter)}


def _copies(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Copies in memory; tied weights share storage, which safetensors rejects."""
    return {k: v.detach().to("cpu", copy=True).contiguous() for k, v in tensors.items()}


def _save(tensors: dict[str, Tensor], path: Path, metadata: dict[str, str] | None = None) -> None:
    try:
        with sealed_path(path) as part:
            save_file(tensors, part, metadata=metadata)
    except SafetensorError as error:  # of a full disk, too
        must, fix = f"{path} must be writable", "Free some space and run the same command again"
        raise PalpateError(must, str(error), fix) from None


def _tracker(name: Tracker, folder: Path) -> Any:
    """A started tracker of accelerate; TensorBoard's files lie in ``tensorboard`` in the folder."""
    from accelerate import PartialState
    from accelerate.tracking import TensorBoardTracker, WandBTracker

    PartialState()  # which their logging needs, also in one process
    board = name == "tensorboard"
    tracker = TensorBoardTracker(name, folder) if board else WandBTracker("palpate")
    tracker.start()
    return tracker


def _checkpoint_blocks(module: nn.Module) -> None:
    """Switch on gradient checkpointing in the models of transformers and diffusers inside.

    Raises:
        PalpateError: if none of them can do it.
    """
    able = ("supports_gradient_checkpointing", "_supports_gradient_checkpointing")
    parts = [p for p in module.modules() if any(getattr(p, name, False) for name in able)]
    must, fix = "must go with a model whose blocks can be computed twice", "Leave it out"
    require(bool(parts), "gradient_checkpointing", must, type(module).__name__, fix=fix)
    calls = ("activation_checkpointing_enable", "gradient_checkpointing_enable")  # 5.23, before
    for part in parts:
        for name in (*calls, "enable_gradient_checkpointing"):
            if hasattr(part, name):
                getattr(part, name)()
                break


def has_bf16() -> bool:
    """Whether the processor multiplies in bf16; an x86 one that emulates it takes ten times as long
    as in float32.
    """
    able = torch.cpu.get_capabilities()
    return able["architecture"] != "x86_64" or able["avx512_bf16"] or able["amx_bf16"]


@contextmanager
def _numerics(compute: Compute) -> Generator[None]:
    """TF32 inside, of products and convolutions, where requested; the settings are restored."""
    backends: Any = torch.backends.cuda.matmul, torch.backends.cudnn
    before = [backend.allow_tf32 for backend in backends]
    for backend in backends:
        backend.allow_tf32 = compute.tf32
    try:
        yield
    finally:
        for backend, setting in zip(backends, before, strict=True):
            backend.allow_tf32 = setting
