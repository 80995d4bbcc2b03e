"""Runs a graph: builds the stages that are missing, in this process or in several.

Nodes that do not depend on each other may be built by several processes at the same time; the
result does not depend on how many.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NoReturn, cast

from palpate.core import PalpateError, Progress, locked, quiet, require
from palpate.core.processes import exit_with_parent
from palpate.studies.graph import Node, Work, digests_of
from palpate.studies.stages import PrintLine, Stage, finished_stage, run_stage

Channel = Any  # one end of a pipe, whose type depends on the system


def run_graph(
    nodes: Sequence[Node],
    folder: Path,
    *,
    device: str = "auto",
    jobs: int = 1,
    print_line: PrintLine = lambda line: None,
    progress: Progress = quiet,
) -> dict[str, Stage]:
    """Build the nodes whose stages are not there yet, each after those that it reads.

    Run again with the same folder to go on after a stop of any kind, with the same result. One run
    at a time holds the folder.

    Args:
        nodes: of the graph, each after those that it reads.
        folder: run folder.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        jobs: processes that build nodes; 1: this one. Each computes with OMP_NUM_THREADS threads,
            or where that is not set with its share of the cores, when sums may differ from those of
            other ``jobs`` in the last bits. Several GPUs are dealt out in turn.
        print_line: called with one line for each stage begun, reused or done.
        progress: called with what is done within a node, and over all.

    Returns:
        the stages by name, in the order of ``nodes``.

    Raises:
        PalpateError: for a folder that another run holds, or under ``torchrun``; or the first that
            a node raises: finished stages stay.
    """
    processes = os.environ.get("WORLD_SIZE", "1")
    fix = "Run it once without torchrun, with several jobs"
    require(processes == "1", None, "A study must be begun by one process", processes, fix=fix)
    require(jobs >= 1, "jobs", "must be at least 1", jobs)
    run = _Run(nodes, Path(folder), device, jobs, print_line, progress)
    with locked(run.folder):
        if jobs == 1:
            _run_here(run)
        else:
            _run_in_workers(run)
    return {node.name: run.stages[node.name] for node in nodes}


def plan_graph(nodes: Sequence[Node], folder: Path) -> dict[str, bool]:
    """Whether each stage is done, by name, in the order of :func:`run_graph`; nothing is written.

    What comes after a stage that is not done may turn out to be, if that is made again with the
    same files.
    """
    run = _Run(nodes, Path(folder))
    while run.next_task():
        pass
    return {node.name: node.name in run.stages for node in nodes}


@dataclass(frozen=True)
class _Task:
    """A node that can be built: the stages that it reads are there."""

    node: Node
    before: Mapping[str, Stage]
    folder: Path
    device: str

    def build(self, print_line: PrintLine, progress: Progress) -> Stage:
        """Build the stage, in this process."""
        node, before = self.node, self.before

        def report(step: str, done: int, total: int, remark: str = "") -> None:
            progress(f"{node.name}: {step}", done, total, remark)

        def fill(folder: Path) -> Mapping[str, Any] | None:
            after = {name: stage.folder for name, stage in before.items()}
            return node.build(Work(folder, after, self.folder / "cache", self.device, report))

        try:
            return run_stage(
                self.folder / node.name,
                node.inputs({name: stage.digest for name, stage in before.items()}),
                fill,
                version=node.version,
                read={name: stage.outputs for name, stage in before.items()},
                print_line=print_line,
            )
        except Exception:
            print_line(f"{node.name}: stopped by an error")
            raise


@dataclass
class _Run:
    """All nodes of a run: which stages are there, and which are being built."""

    nodes: Sequence[Node]
    folder: Path
    device: str = "auto"
    jobs: int = 1
    print_line: PrintLine = lambda line: None
    progress: Progress = quiet
    stages: dict[str, Stage] = field(default_factory=dict[str, Stage])
    begun: set[str] = field(default_factory=set[str])

    @cached_property
    def digests(self) -> dict[str, str]:
        return digests_of(self.nodes)

    def next_task(self) -> _Task | None:
        """Begin the next node that can be built; None without one.

        What needs no work is taken on the way: from the start, or once what it reads has been made
        again.
        """
        for node in self.nodes:
            if node.name in {*self.stages, *self.begun} or not self.stages.keys() >= {*node.after}:
                continue
            before = {name: self.stages[name] for name in node.after}
            outputs = {name: stage.outputs for name, stage in before.items()}
            stage = finished_stage(self.folder / node.name, self.digests[node.name], outputs)
            if stage is None:
                self.begun.add(node.name)
                self.show()
                return _Task(node, before, self.folder, self.device)
            self.stages[node.name] = stage
            self.print_line(f"{node.name}: already done ({stage.seconds:.0f} s then)")
        return None

    def end(self, stage: Stage) -> None:
        self.begun.remove(stage.folder.name)
        self.stages[stage.folder.name] = stage
        self.show()
        if len(self.stages) < len(self.nodes):
            self.print_line(f"{len(self.stages)} of {len(self.nodes)} stages")

    def show(self) -> None:
        self.progress("all stages", len(self.stages), len(self.nodes))


def _run_here(run: _Run) -> None:
    def report(step: str, done: int, total: int, remark: str = "") -> None:
        run.show()
        run.progress(step, done, total, remark)

    while task := run.next_task():
        run.end(task.build(run.print_line, report))


def _run_in_workers(run: _Run) -> None:
    workers: dict[Channel, BaseProcess] = {}
    idle: list[Channel] = []
    try:
        while True:
            while (idle or len(workers) < run.jobs) and (task := run.next_task()):
                worker = idle.pop() if idle else _start_worker(workers, run)
                try:
                    worker.send(task)
                except OSError:  # it died while it was idle
                    _raise_dead(workers[worker])
            if not (running := [w for w in workers if w not in idle]):
                break
            for worker in wait(running, timeout=1.0):
                try:
                    kind, value = cast("Channel", worker).recv()
                except (EOFError, OSError):
                    _raise_dead(workers[worker])
                if kind == "stage":
                    idle.append(worker)
                    run.end(value)
                elif kind == "error":
                    raise value
                elif kind == "line":
                    run.print_line(value)
                else:
                    run.progress(*value)
            run.show()
    finally:  # what they were building stays, to go on from
        for process in workers.values():
            process.kill()
        for process in workers.values():
            process.join()


def _start_worker(workers: dict[Channel, BaseProcess], run: _Run) -> Channel:
    """Start a process that builds nodes; spawned, as a fork of threads can deadlock."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    nvidia = (f"{k}" for k, _ in enumerate(Path("/dev").glob("nvidia[0-9]*")))
    gpus = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(nvidia)).split(",")
    environment = {"CUDA_VISIBLE_DEVICES": gpus[len(workers) % len(gpus)]} if len(gpus) > 1 else {}
    threads = os.environ.get("OMP_NUM_THREADS", f"{cores // run.jobs or 1}")
    environment |= {"OMP_NUM_THREADS": threads}
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, environment))
    process.start()
    theirs.close()
    workers[ours] = process
    return ours


def _raise_dead(process: BaseProcess) -> NoReturn:
    process.join()
    got = f"one ended with status {process.exitcode}"
    fix = "Free some memory, or use one process; run it again to go on. A script must call this "
    fix += "under: if __name__ == '__main__'"
    raise PalpateError("The processes of a study must stay alive", got, fix)


def _work(channel: Channel, environment: Mapping[str, str]) -> None:
    """Build the nodes that arrive, in a worker, until its parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    exit_with_parent()
    os.environ.update(environment)  # before torch is loaded

    def send(kind: str, value: Any) -> None:
        channel.send((kind, value))

    def report(step: str, done: int, total: int, remark: str = "") -> None:
        send("progress", (step, done, total, remark))

    while True:
        try:
            task: _Task = channel.recv()
            send("stage", task.build(partial(send, "line"), report))
        except Exception as error:
            error.add_note(traceback.format_exc())  # a traceback is not sent along
            send("error", error)
