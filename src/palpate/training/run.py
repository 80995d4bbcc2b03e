"""Where a training works and how it is run, what it takes, and what it leaves beside its result."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from palpate.core import (
    PalpateError,
    Progress,
    content_of,
    digest_file,
    digest_folder,
    digest_json,
    locked,
    quiet,
    require,
    require_new_folder,
    write_text,
)
from palpate.data.images import file_stamp
from palpate.data.manifest import IMAGE_COLUMNS, Manifest
from palpate.training.options import Compute, LoopOptions
from palpate.training.processes import barrier, connect, merged, place

#: (model, rows, device) -> an output that depends on all parameters.
Forward = Callable[[nn.Module, int, torch.device], Tensor]
#: A model of more parameters is timed by one row; a smaller one by a batch.
SMALL = 10_000_000
#: Of a result: the digest of what was requested.
REQUEST = "request.sha256"


@dataclass(frozen=True)
class TrainingRun:
    """A run of a training; of what is computed it decides the seed alone.

    Attributes:
        folder: for checkpoints and logs; nothing in it belongs to the result.
        seed: of weights, order, augmentation and noise.
        cache: folder for decoded pixels, latents and embeddings; None: memory, or ``folder``.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``, or a device of torch.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.
        request: see :func:`request_of`; stays with the result.
    """

    folder: Path
    seed: int = 0
    cache: Path | None = None
    device: str | torch.device = "cpu"
    compute: Compute = field(default_factory=Compute)
    progress: Progress = quiet
    request: str = ""

    def stage(self, name: str) -> TrainingRun:
        """The same with a folder of its own."""
        return replace(self, folder=self.folder / name)

    def keep(self, model: Any, output: Path | str | None) -> None:
        """Save a result, with the logs of its training; of several processes the first one."""
        if output is not None and place()[0] == 0:
            model.save(Path(output))
            keep_logs(self.folder, Path(output))
            write_text(Path(output) / REQUEST, self.request)


def request_of(seed: int, *parts: Any) -> str:
    """The digest of all that decides a training.

    Args:
        seed: of the training.
        parts: models, data and splits with a digest, paths of models, which count by content,
            presets and other values.
    """

    def content(part: Any) -> Any:
        if isinstance(part, Manifest):  # an image may be another under its name
            files = {name for c in IMAGE_COLUMNS for name in part.column(c) if name}
            return [part.digest, [file_stamp(part.path(name)) for name in sorted(files)]]
        if hasattr(part, "modalities"):  # a set of encoders
            return [part.digest(modality) for modality in sorted(part.modalities)]
        if isinstance(part, str | Path) and Path(part).exists():
            return (digest_folder if Path(part).is_dir() else digest_file)(Path(part))
        return getattr(part, "digest", repr(part))

    return digest_json([seed, *map(content, parts)])


def finished(output: Path | str | None, request: str) -> bool:
    """Whether ``output`` is the result of this very training, of which nothing is left to do.

    Raises:
        PalpateError: if it is that of another.
    """
    if output is None or not (Path(output) / "palpate.json").is_file():
        return False
    file = Path(output) / REQUEST
    same = file.is_file() and content_of(file) == request.encode()
    must, fix = f"{output} must be absent or empty", "Train from the start, in another folder"
    require(same, None, must, "the result of another training: it cannot go on", fix=fix)
    return True


@contextmanager
def run_for(
    output: Path | str | None,
    request: str,
    seed: int,
    *,
    device: str,
    compute: Compute | None,
    progress: Progress,
) -> Generator[TrainingRun]:
    """The run of a training whose result goes to ``output``, together with other processes.

    Raises:
        PalpateError: as :func:`work_folder`.
    """
    device = connect(device)
    with work_folder(None if output is None else Path(output)) as work:
        compute = compute or Compute()
        yield TrainingRun(work, seed, work / "cache", device, compute, progress, request)


@contextmanager
def work_folder(output: Path | None) -> Generator[Path]:
    """A folder for checkpoints and caches of a training whose result goes to ``output``.

    ``.<name>.work`` next to the output, which the same call finds again after a stop and which is
    removed on success; a temporary folder where there is no output. Of several processes the first
    holds it, and all are given the same.

    Raises:
        PalpateError: if the output exists already or is written by another run, before any work is
            done.
    """
    rank = place()[0]
    if output is None:
        with tempfile.TemporaryDirectory(prefix="palpate-") as name:
            yield Path(merged({str(rank): name})["0"])
            barrier()  # the first one is removed when nobody needs it
        return
    require_new_folder(output)
    work = output.absolute().parent / f".{output.name}.work"
    barrier()  # all have looked at the output before it is written
    if rank:
        yield work
        barrier()
        return
    with locked(work, output):
        try:
            yield work
        except PalpateError:
            if not any(p.is_file() for p in work.rglob("*")):  # rejected before any work was done
                shutil.rmtree(work)
            raise
    barrier()
    shutil.rmtree(work, ignore_errors=True)


def keep_logs(work: Path, output: Path) -> None:
    """Copy what a training wrote to its result: ``log-<stage>.jsonl``, images of samples, and
    TensorBoard's files.
    """
    for log in sorted(work.rglob("log.jsonl")):
        shutil.copy(log, output / f"log-{log.parent.name}.jsonl")
        for name in ("samples", "tensorboard"):
            if (folder := log.parent / name).is_dir():
                shutil.copytree(folder, output / name / log.parent.name)


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
