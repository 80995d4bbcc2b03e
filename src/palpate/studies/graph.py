"""A graph of stages: each node a stage of a run folder that reads earlier ones.

A node is built by a function of its folder and of the folders of the nodes it comes after. Its
digest holds those of the nodes before it (:mod:`palpate.studies.stages`), so that a changed option
builds again what depends on it and nothing else; its record holds those of their files, so that it
is built again after a stage that was made again with other files (trained on a GPU, say). Nodes
that do not depend on each other may be built by several processes; the result does not depend on
how many.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NoReturn

from palpate.core import PalpateError, Progress, few, locked, quiet, require
from palpate.core.processes import exit_with_parent
from palpate.studies.stages import Run, Stage, finished_stage, stage_digest

Build = Callable[[Path, Mapping[str, Path], Progress], Mapping[str, Any] | None]
PrintLine = Callable[[str], None]
Channel = Any  # one end of a pipe, whose type depends on the system


@dataclass(frozen=True)
class Node:
    """A stage of a study.

    Attributes:
        name: folder of the stage in the run folder.
        build: fills its folder, and returns facts (JSON) for ``stage.json``; called with the
            folder, the folders of ``after`` by name, and a progress. For several processes a
            function of a module, or a ``functools.partial`` of one.
        inputs: what it reads besides earlier stages: options, digests, seeds.
        after: names of earlier nodes; their digests enter its own.
        version: raised by hand when the stage comes to write other bytes.
        measures: it trains nothing: ``palpate verify`` builds it again, to compare.
    """

    name: str
    build: Build
    inputs: Mapping[str, Any]
    after: Sequence[str] = ()
    version: int = 1
    measures: bool = False


def run_graph(
    nodes: Sequence[Node],
    folder: Path,
    *,
    jobs: int = 1,
    print_line: PrintLine = lambda line: None,
    progress: Progress = quiet,
) -> dict[str, Stage]:
    """Build the nodes whose stages are not there yet, each after those that it reads.

    Run again with the same folder to go on after a stop of any kind, with the same result. One run
    at a time holds the folder.

    Args:
        nodes: of the graph; those that are ready are begun in this order.
        folder: run folder.
        jobs: processes that build nodes; 1: this one. Each computes with OMP_NUM_THREADS threads,
            or where that is not set with its share of the cores, when sums may differ from those of
            other ``jobs`` in the last bits. Several GPUs are dealt out in turn.
        print_line: called with one line for each stage begun, reused or done.
        progress: called with what is done within a node, and over the whole.

    Returns:
        the stages by name, in the order of ``nodes``.

    Raises:
        PalpateError: for two nodes of one name, an unknown ``after``, a circle, a folder that
            another run holds, or under ``torchrun``; or the first that a node raises: finished
            stages stay.
    """
    if (processes := os.environ.get("WORLD_SIZE", "1")) != "1":
        fix = "Run it once without torchrun, with several jobs"
        raise PalpateError("A study must be begun by one process", processes, fix)
    require(jobs >= 1, "jobs", "must be at least 1", jobs)
    ordered, folder = in_order(nodes), Path(folder)
    with locked(folder):
        whole = _Whole(ordered, folder, jobs, print_line, progress)
        whole.take_finished()
        if jobs == 1:
            _run_here(whole)
        else:
            _run_in_workers(whole)
    return {node.name: whole.stages[node.name] for node in nodes}


def plan_graph(nodes: Sequence[Node], folder: Path) -> dict[str, bool]:
    """Whether each stage is done, by name, in the order of :func:`run_graph`; nothing is written.

    What comes after a stage that is not done may turn out to be, if that is made again with the
    same files.
    """
    whole = _Whole(in_order(nodes), Path(folder), 1, lambda line: None, quiet)
    whole.take_finished()
    return {node.name: node.name in whole.stages for node in whole.ordered}


def in_order(nodes: Sequence[Node]) -> list[Node]:
    """Return the nodes so that each comes after those it reads, otherwise in the order given.

    Raises:
        PalpateError: for two nodes of one name, a name that is no folder's, an unknown ``after``,
            or a circle.
    """
    names = [node.name for node in nodes]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise PalpateError("Each stage must have a name of its own", few(twice), "Rename one")
    if bad := [name for name in names if Path(name).name != name or name.startswith(".")]:
        raise PalpateError("The name of a stage must be that of a folder", few(bad), "Rename it")
    for node in nodes:
        if unknown := sorted(set(node.after) - set(names)):
            must = f"Stage {node.name} must come after stages of the same graph"
            raise PalpateError(must, few(unknown), "Add it, or correct the name")
    ordered: dict[str, Node] = {}
    while len(ordered) < len(nodes):
        ready = (n for n in nodes if n.name not in ordered and ordered.keys() >= set(n.after))
        if (node := next(ready, None)) is None:
            circle = few(name for name in names if name not in ordered)
            raise PalpateError("No stage may come after itself", circle, "Break the circle")
        ordered[node.name] = node
    return list(ordered.values())


def _reads(ordered: Sequence[Node]) -> dict[str, dict[str, Any]]:
    """What each stage reads, by name: its inputs and the digests of the nodes before it."""
    digests: dict[str, str] = {}
    reads: dict[str, dict[str, Any]] = {}
    for node in ordered:
        reads[node.name] = {**node.inputs, "after": {name: digests[name] for name in node.after}}
        digests[node.name] = stage_digest(node.name, reads[node.name], node.version)
    return reads


@dataclass
class _Whole:
    """All nodes of a run: what is done, and what is running."""

    ordered: Sequence[Node]
    folder: Path
    jobs: int
    print_line: PrintLine
    progress: Progress
    stages: dict[str, Stage] = field(default_factory=dict[str, Stage])
    begun: set[str] = field(default_factory=set[str])

    def take_finished(self) -> None:
        """Take what needs no work, from now on or once what it reads has been made again."""
        reads = _reads(self.ordered)
        for node in self.ordered:
            if node.name in {*self.stages, *self.begun} or not self.stages.keys() >= {*node.after}:
                continue
            digest = stage_digest(node.name, reads[node.name], node.version)
            outputs = {name: self.stages[name].outputs for name in node.after}
            if (stage := finished_stage(self.folder / node.name, digest, outputs)) is not None:
                self.stages[node.name] = stage
                self.print_line(f"{node.name}: already done ({stage.seconds:.0f} s then)")

    def ready(self) -> _Task | None:
        """The first node that may begin."""
        waiting = (n for n in self.ordered if n.name not in {*self.stages, *self.begun})
        node = next((n for n in waiting if self.stages.keys() >= set(n.after)), None)
        if node is None:
            return None
        outputs = {name: self.stages[name].outputs for name in node.after}
        return _Task(node, self.folder, _reads(self.ordered)[node.name], outputs)

    def begin(self, node: Node) -> None:
        self.begun.add(node.name)
        self.show()

    def end(self, stage: Stage) -> None:
        self.begun.remove(stage.folder.name)
        self.stages[stage.folder.name] = stage
        self.take_finished()
        self.show()
        if len(self.stages) < len(self.ordered):
            self.print_line(f"{len(self.stages)} of {len(self.ordered)} stages")

    def show(self) -> None:
        self.progress("all stages", len(self.stages), len(self.ordered))


@dataclass(frozen=True)
class _Task:
    """A node to build: in which run folder, with what it reads, of which files of earlier nodes."""

    node: Node
    folder: Path
    inputs: Mapping[str, Any]
    read: Mapping[str, str]


def _build_node(task: _Task, print_line: PrintLine, progress: Progress) -> Stage:
    """Build a node in this process."""
    node, folder = task.node, task.folder
    before = {name: folder / name for name in node.after}

    def report(what: str, done: int, total: int, remark: str = "") -> None:
        progress(f"{node.name}: {what}", done, total, remark)

    def build(place: Path) -> Mapping[str, Any] | None:
        return node.build(place, before, report)

    try:
        how: dict[str, Any] = {"version": node.version, "read": task.read}
        return Run(folder, print_line).stage(node.name, task.inputs, build, **how)
    except Exception:
        print_line(f"{node.name}: stopped by an error")
        raise


def _run_here(whole: _Whole) -> None:
    def report(what: str, done: int, total: int, remark: str = "") -> None:
        whole.show()
        whole.progress(what, done, total, remark)

    while (task := whole.ready()) is not None:
        whole.begin(task.node)
        whole.end(_build_node(task, whole.print_line, report))


def _run_in_workers(whole: _Whole) -> None:
    workers: dict[Channel, BaseProcess] = {}
    idle: list[Channel] = []
    with _ended_with(workers):
        while len(whole.stages) < len(whole.ordered):
            while (idle or len(workers) < whole.jobs) and (task := whole.ready()) is not None:
                worker = idle.pop() if idle else _start_worker(workers, whole.jobs)
                try:
                    worker.send(task)
                except OSError:  # it died while it was idle
                    _raise_dead(workers[worker])
                whole.begin(task.node)
            for worker in wait([w for w in workers if w not in idle], timeout=1.0):
                kind, value = _received(worker, workers[worker])
                if kind == "stage":
                    idle.append(worker)
                    whole.end(value)
                elif kind == "error":
                    raise value
                elif kind == "line":
                    whole.print_line(value)
                else:
                    whole.progress(*value)
            whole.show()


@contextmanager
def _ended_with(workers: Mapping[Channel, BaseProcess]) -> Generator[None]:
    """Kill the workers at the end: what they were building stays, to go on from."""
    try:
        yield
    finally:
        for process in workers.values():
            process.kill()
        for process in workers.values():
            process.join()


def _start_worker(workers: dict[Channel, BaseProcess], jobs: int) -> Channel:
    """Start a process that builds nodes; spawned, as a fork of threads can deadlock."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    gpus = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(_gpus())).split(",")
    environment = {"CUDA_VISIBLE_DEVICES": gpus[len(workers) % len(gpus)]} if len(gpus) > 1 else {}
    environment |= {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", f"{cores // jobs or 1}")}
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, environment))
    process.start()
    theirs.close()
    workers[ours] = process
    return ours


def _gpus() -> list[str]:
    """Numbers of the NVIDIA GPUs of a Linux machine."""
    return [f"{number}" for number, _ in enumerate(Path("/dev").glob("nvidia[0-9]*"))]


def _received(worker: Channel, process: BaseProcess) -> tuple[str, Any]:
    """The next message of a worker: its kind and its value.

    Raises:
        PalpateError: if the worker has died.
    """
    try:
        return worker.recv()
    except (EOFError, OSError):
        _raise_dead(process)


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
    send = partial(_send, channel)

    def report(what: str, done: int, total: int, remark: str = "") -> None:
        send("progress", (what, done, total, remark))

    while True:
        try:
            task = channel.recv()
            send("stage", _build_node(task, partial(send, "line"), report))
        except Exception as error:
            error.add_note(traceback.format_exc())  # a traceback is not sent along
            send("error", error)


def _send(channel: Channel, kind: str, value: Any) -> None:
    channel.send((kind, value))
