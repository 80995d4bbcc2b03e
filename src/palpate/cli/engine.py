"""Slices on datatrove's executors: logs, retries, requeues and marks of completion are theirs.

Each task is one slice of a verb, which the verb's own function makes in a process of its own: that
it is killed is an error of this task, and not one that its executor waits for without end.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datatrove.executor.base import PipelineExecutor
from datatrove.executor.local import LocalPipelineExecutor
from datatrove.executor.ray import RayPipelineExecutor
from datatrove.executor.slurm import SlurmPipelineExecutor
from datatrove.utils.stats import PipelineStats

from palpate.core.processes import worker_pool


@dataclass(frozen=True)
class Step:
    """A task: slice ``rank + 1`` of ``world_size`` of a command, without the word palpate."""

    command: tuple[str, ...]

    def __call__(self, data: Any, rank: int = 0, world_size: int = 1) -> None:
        """Make the slice; its mistakes are raised."""
        with worker_pool(1) as pool:
            pool.submit(_make, self.command, f"{rank + 1}/{world_size}").result()


def _make(command: tuple[str, ...], part: str) -> None:
    from palpate.cli.terminal import call_verb

    name, *args = command
    call_verb(name, [*args, "--slice", part, "--quiet"])


class Local(LocalPipelineExecutor):
    """Processes of this machine; a task that fails, which is logged, does not end the others."""

    def _launch_run_for_rank(self, rank: int, *args: Any, **options: Any) -> PipelineStats:
        try:
            return super()._launch_run_for_rank(rank, *args, **options)
        except Exception:
            return PipelineStats()  # it has no mark of completion


@dataclass(frozen=True, kw_only=True)
class Resources:
    """Where slices run: how many at a time, and what a cluster is asked for each.

    Attributes:
        executor: ``local``, ``slurm`` or ``ray``.
        workers: slices at a time.
        partition: of Slurm.
        time: longest time of a slice, ``hours:minutes:seconds``.
        mem: GB of memory.
        gpus: of a node.
    """

    executor: str
    workers: int
    partition: str
    time: str
    mem: int
    gpus: int


def executor_of(
    command: tuple[str, ...], slices: int, resources: Resources, logs: Path
) -> PipelineExecutor:
    """The executor of all slices of a command, which knows those that are finished by its logs."""
    steps, r = [Step(command)], resources
    if r.executor == "local":
        return Local(steps, slices, r.workers, str(logs))
    if r.executor == "ray":
        return RayPipelineExecutor(
            steps,
            slices,
            r.workers,
            mem_per_cpu_gb=r.mem,
            gpus_per_task=r.gpus,
            logging_dir=str(logs),
        )
    return SlurmPipelineExecutor(
        steps,
        slices,
        r.time,
        r.partition,
        mem_per_cpu_gb=r.mem,
        gpus_per_task=r.gpus,
        workers=r.workers,
        job_name=f"palpate-{command[0]}",
        qos="",
        env_command=f"export PATH={Path(sys.executable).parent}:$PATH",
        logging_dir=str(logs.absolute()),
    )
