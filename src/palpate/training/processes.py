"""Several processes that train one model (``torchrun``), through Hugging Face accelerate.

Each process holds the whole model and takes an equal part of every batch; gradients are averaged.
One process needs no process group: everything here is then the identity.
"""

from __future__ import annotations

import atexit
import os
import signal
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import (
    Tensor,
    _utils,  # those of DistributedDataParallel
)
from torch import distributed as dist

from palpate.core import PalpateError, require

T = TypeVar("T")
#: How long a process waits for another: the first one may decode a whole data set meanwhile.
PATIENCE = timedelta(hours=12)
#: Bytes that are averaged at once: a message has its cost, however short it is.
BUCKET = 1 << 25


def connect(device: str = "auto") -> str:
    """Join the other processes that ``torchrun`` started, if any.

    Returns:
        the device of this process: its own GPU where several processes share a machine.

    Raises:
        PalpateError: if torch was built without ``torch.distributed``.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return device
    must, fix = "torch must be built with torch.distributed", "Run it in one process"
    require(dist.is_available(), None, must, "a build without it", fix=fix)
    from accelerate import PartialState

    joined = dist.is_initialized()
    state = PartialState(cpu=device == "cpu", timeout=PATIENCE)
    if not joined:
        atexit.register(state.destroy_process_group)
        signal.signal(signal.SIGTERM, _terminated)
    return str(state.device) if device in ("auto", "cuda") and state.device else device


def place() -> tuple[int, int]:
    """This process's number, and how many there are."""
    if not (dist.is_available() and dist.is_initialized()):
        return 0, 1
    return dist.get_rank(), dist.get_world_size()


@contextmanager
def first_alone() -> Generator[None]:
    """Let one process of each machine go first: it fills caches that the others then read."""
    first = place()[1] == 1 or os.environ.get("LOCAL_RANK", "0") == "0"
    if not first:
        barrier()
    try:
        yield
    finally:
        if first:
            barrier()


@contextmanager
def _together() -> Generator[None]:
    """Turn the error of a message to a process that is gone into one line."""
    try:
        yield
    except RuntimeError as error:
        raise _ended(error) from None


def barrier() -> None:
    """Wait until all processes are here.

    Raises:
        PalpateError: if another process has ended.
    """
    if place()[1] > 1:
        with _together():
            dist.barrier()


def average(tensors: Sequence[Tensor]) -> None:
    """Replace each tensor by its mean over the processes.

    Raises:
        PalpateError: if another process has ended.
    """
    if (size := place()[1]) == 1:
        return
    for some in _utils._take_tensors(tensors, BUCKET):  # pyright: ignore
        flat = _utils._flatten_dense_tensors(some)  # pyright: ignore
        with _together():
            dist.all_reduce(flat)
        means = _utils._unflatten_dense_tensors(flat / size, some)  # pyright: ignore
        torch._foreach_copy_(some, means)  # pyright: ignore


def merged(table: dict[str, T]) -> dict[str, T]:
    """The entries of the tables of all processes; all of them have been here when it returns."""
    if place()[1] == 1:
        return table
    tables: list[Any] = [None] * place()[1]
    with _together():
        dist.all_gather_object(tables, table)
    return {key: value for each in tables for key, value in each.items()}


def shared(error: PalpateError) -> PalpateError:
    """The same error, which all processes raise: the first one alone prints it."""
    error.shared = True
    return error


@contextmanager
def agreed() -> Generator[None]:
    """Checks that every process makes: the first one alone prints what they raise."""
    try:
        yield
    except PalpateError as error:
        raise shared(error) from None


def gather_rows(rows: Tensor, batch: int | None = None) -> Tensor:
    """The rows of all processes, (processes * n, ...), differentiable.

    Rows that are the whole ``batch`` already, as in an evaluation, are returned as they are.

    Every process computes the same loss over all rows, and :func:`average` divides the gradients by
    the number of processes. So the rows of this process get their gradient times that number; the
    others are constants here and get theirs in their own process.
    """
    rank, size = place()
    if size == 1 or len(rows) == batch:
        return rows
    parts = [torch.empty_like(rows, requires_grad=False) for _ in range(size)]
    with _together():
        dist.all_gather(parts, rows.detach().contiguous())
    parts[rank] = rows.detach() + size * (rows - rows.detach())  # the value of rows, size gradients
    return torch.cat(parts)


def _ended(error: RuntimeError) -> PalpateError:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # torchrun's, which is faster or slower than this
    got = f"one has ended ({str(error).splitlines()[0][:120]})"
    return PalpateError("All processes must stay alive", got, "Run the same command again")


def _terminated(*_: object) -> None:
    """Torchrun ends the others when a process has ended."""
    raise _ended(RuntimeError("SIGTERM"))
