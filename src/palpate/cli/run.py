"""``palpate run``: all slices of a verb on an engine: processes, Slurm or Ray."""

from __future__ import annotations

import importlib.util
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, Terminal, checked, option_group
from palpate.cli.verbs import FAILED_CHECK, OK
from palpate.core import (
    MissingExtraError,
    PalpateError,
    digest_json,
    few,
    require,
    require_choice,
    short,
)
from palpate.core.files import is_there

#: Verbs whose work is cut into slices.
SLICED = ("embed", "generate")


@option_group
class Options(Common):
    """Make all slices of a verb on datatrove's executors. Run again, it makes those that are
    missing.

    What is no option below belongs to the verb, as it is written for that verb alone.
    """

    command: Annotated[tuple[str, ...], tyro.conf.Positional]
    """The verb (embed or generate) with its options."""
    slices: int
    """Into how many slices."""
    executor: Literal["local", "slurm", "ray"] = "local"
    """Processes of this machine, an array of Slurm, or a cluster of Ray."""
    workers: int = 2
    """Slices at a time."""
    partition: str = ""
    """Of Slurm."""
    time: str = "24:00:00"
    """Slurm: the longest time of a slice."""
    mem: int = 4
    """Slurm and Ray: GB of memory of a slice."""
    gpus: int = 0
    """Slurm and Ray: GPUs of a slice."""

    @staticmethod
    def arranged(args: Sequence[str]) -> list[str]:
        """Arguments with the options of ``run`` first: all others are the verb's."""
        own, verb, words = list[str](), list[str](), iter(args)
        valued = {f"--{field.name}" for field in fields(Options)} - {"--quiet"}
        for word in words:
            name, equals, _ = word.partition("=")
            if name in valued:
                own += [word, *([] if equals else [next(words, "")])]
            elif word in ("--json", "--quiet", "-q") or (word in ("--help", "-h") and not verb):
                own.append(word)
            elif word != "--":
                verb.append(word)
        return [*own, *["--"] * bool(verb), *verb]


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Start the engine, and say what is left."""
    name, *args = options.command or ("",)
    require_choice("command", name, SLICED)
    require(options.slices >= 1, "slices", "must be at least 1", options.slices)
    require(options.workers >= 1, "workers", "must be at least 1", options.workers)
    _, verb = checked(name, [*args, "--slice", f"1/{options.slices}"])
    paths = [value for value in vars(verb).values() if isinstance(value, Path)]
    if importlib.util.find_spec("datatrove") is None:
        raise MissingExtraError("datatrove", "scale", "palpate run")
    if options.executor == "ray" and importlib.util.find_spec("ray") is None:
        require(False, "executor", "must find Ray", "no package ray", fix="pip install ray")
    if options.executor == "slurm":
        found, fix = shutil.which("sbatch") is not None, "Run it on a node of the cluster"
        require(found, "executor", "must find Slurm", "no command sbatch", fix=fix)
        fix = "Name one that sinfo lists"
        require(bool(options.partition), "partition", "must be given for Slurm", "none", fix=fix)
    from palpate.cli.engine import Resources, executor_of

    output: Path = verb.output
    # The engine's marks are of this command on these files: after a change all are looked at anew.
    files = [f for p in paths for f in (p, p / "manifest.parquet") if is_there(f) and f.is_file()]
    stamps = [[str(file), file.stat().st_mtime_ns] for file in files]
    key = digest_json([options.command, options.slices, stamps])
    logs = output.with_name(f"{output.name}.logs") / short(key)
    for k in range(options.slices):
        if not (output / f"part-{k + 1}-of-{options.slices}").exists():
            (logs / f"completions/{k:05d}").unlink(missing_ok=True)
    resources = Resources(**{key: getattr(options, key) for key in Resources.__dataclass_fields__})
    executor = executor_of(options.command, options.slices, resources, logs)
    try:
        executor.run()
    except subprocess.CalledProcessError as error:  # sbatch has said why on standard error
        got, fix = str(error), "See what Slurm printed above, and: sinfo"
        raise PalpateError("Slurm must take the job", got, fix) from None
    left = [f"{k + 1}/{options.slices}" for k in executor.get_incomplete_ranks()]
    terminal.print(f"{shlex.join(options.command)}: {options.slices - len(left)} slices are made")
    if left and options.executor != "slurm":
        terminal.print_line(f"Not made: {few(left)}; see {logs}/logs. Run again to make them")
    job = getattr(executor, "job_id", None)
    if job and options.executor == "slurm":
        terminal.print_line(f"Slurm runs the others as job {job}; logs: {logs}/logs")
    failed = bool(left) and options.executor != "slurm"
    answer = {"slices": options.slices, "left": left, "logs": str(logs), "job": job}
    return answer, FAILED_CHECK if failed else OK
