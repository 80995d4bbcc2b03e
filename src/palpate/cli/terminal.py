"""What all verbs share: parsing with tyro, progress, tables, JSON, and errors in one line.

A verb's module has a frozen dataclass ``Options`` (its docstring and field docstrings are the help) that
derives from :class:`Common`, and ``run(options, terminal) -> dict | tuple[dict, int]``: the JSON that
``--json`` prints, and an exit status if it is not 0.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import importlib
import importlib.util
import io
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from palpate.cli import BUG, FAILED_CHECK, INTERRUPTED, OK, USER_ERROR, VERBS
from palpate.core import MissingExtraError, PalpateError, Problem, ProblemsError, Progress, quiet
from palpate.core.files import NO_ROOM

#: Lines of problems shown in the terminal; ``--json`` gives all.
SHOWN_PROBLEMS = 40

JsonFlag = Annotated[
    bool,
    tyro.conf.arg(name="json", help="Print one JSON object on standard output instead of text."),
]
QuietFlag = Annotated[bool, tyro.conf.arg(aliases=["-q"], help="No progress.")]
OutPath = Annotated[Path, tyro.conf.arg(aliases=["-o"])]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every verb."""

    as_json: JsonFlag = False
    quiet: QuietFlag = False


class Terminal:
    """Where a verb writes: results on standard output, progress and remarks on standard error."""

    def __init__(self, options: Common, command: str = "") -> None:
        self.command = command
        self.json = options.as_json
        self.silent = options.quiet
        # Piped text is not wrapped: digests and paths must stay whole.
        self.out = Console(
            highlight=False, quiet=self.json, width=None if sys.stdout.isatty() else 400
        )
        self.err = Console(stderr=True, highlight=False, quiet=self.silent)

    def say(self, line: str) -> None:
        """A remark on standard error."""
        self.err.print(line, markup=False, soft_wrap=True)

    def print(self, line: str) -> None:
        """A line of the result, on standard output."""
        self.out.print(line, markup=False, soft_wrap=True)

    def skipped(self, problems: Sequence[Problem]) -> None:
        """Lists what ``--skip-bad`` left out."""
        if problems:
            self.say(f"Skipped {len(problems)}:")
            _list_problems(problems, self.say)

    def facts(self, title: str, rows: Mapping[str, Any]) -> None:
        """Prints a two-column table of names and values."""
        self.out.print(title, style="bold")
        table = Table(show_header=False, box=None, pad_edge=False)
        table.add_column(style="dim")
        table.add_column(overflow="fold")
        for name, value in rows.items():
            table.add_row(name, "-" if value is None else str(value))
        self.out.print(table)

    @contextlib.contextmanager
    def progress(self) -> Generator[Progress]:
        """A progress callback: bars on a terminal, a line now and then in a log, nothing with ``--quiet``."""
        if self.silent:
            yield quiet
        elif not self.err.is_terminal:
            yield _LogProgress(self.say)
        else:
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bars

            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.fields[remark]}"),
            )
            with Bars(*columns, console=self.err) as bars:
                tasks: dict[str, Any] = {}

                def report(what: str, done: int, total: int, remark: str = "") -> None:
                    if what not in tasks:
                        tasks[what] = bars.add_task(what, total=total or None, remark="")
                    bars.update(tasks[what], completed=done, total=total or None, remark=remark)
                    if total and done >= total:  # finished: a task of the same name begins anew
                        tasks.pop(what)

                yield report


class _LogProgress:
    """Progress for logs: at most a line every ten seconds, and one at the end of what took long."""

    def __init__(self, say: Any, every: float = 10.0) -> None:
        self.say, self.every = say, every
        self.last = time.monotonic()
        self.shown: set[str] = set()

    def __call__(self, what: str, done: int, total: int, remark: str = "") -> None:
        ended = bool(total) and done >= total and what in self.shown
        if ended or time.monotonic() - self.last >= self.every:
            self.say(f"  {what} {done}{f'/{total}' if total else ''} {remark}".rstrip())
            self.last = time.monotonic()
            self.shown = self.shown - {what} if ended else self.shown | {what}


def _list_problems(problems: Sequence[Problem], say: Any) -> None:
    for problem in problems[:SHOWN_PROBLEMS]:
        say(f"  {problem}")
    if len(problems) > SHOWN_PROBLEMS:
        say(f"  ... and {len(problems) - SHOWN_PROBLEMS} more (--json lists all)")


def parse(name: str, options: type[Any], args: Sequence[str]) -> Any:
    """``args`` as an ``Options`` of the verb; ``--help`` prints and exits.

    Raises:
        PalpateError: one line for what tyro would draw a box around.
    """
    verb = VERBS[name]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            text = f"{options.__doc__}\n\nExample: {verb.example}"
            return tyro.cli(
                options,
                prog=f"palpate {name}",
                args=list(args),
                description=text,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        words = re.sub(r"[\u2500-\u257f]+|─+", " ", said.getvalue())
        words = (
            re.split(
                r"For full helptext|Argument helptext|Full error|If your arguments",
                " ".join(words.split()),
            )[0].strip()
            or "arguments that cannot be parsed"
        )
        raise PalpateError(
            f"The options of palpate {name} must be as its help says",
            words,
            f"See: palpate {name} --help",
        ) from None


def require_extra(purpose: str) -> None:
    """Says which ``pip install`` is missing, before any work is done.

    Raises:
        MissingExtraError: if torch, diffusers, transformers or av is absent.
    """
    for package in ("torch", "diffusers", "transformers", "safetensors", "av"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(package, "all", purpose)


@contextlib.contextmanager
def working_folder(output: Path, terminal: Terminal) -> Generator[Path]:
    """``.<name>.work`` beside an output folder: checkpoints and caches, found again by the same command, removed when it succeeds.

    Raises:
        PalpateError: if the output exists already, before any work is done.
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise PalpateError(
            f"{output} must be absent or an empty folder",
            "something there",
            "Choose another -o, or remove it",
        )
    work = output.absolute().parent / f".{output.name}.work"
    if work.exists():
        terminal.say(f"Going on from {work}")
    work.mkdir(parents=True, exist_ok=True)
    try:
        yield work
    except PalpateError:
        if not any(p.is_file() for p in work.rglob("*")):  # refused before any work was done
            shutil.rmtree(work)
        raise
    shutil.rmtree(work, ignore_errors=True)


def guard_output(
    output: Path, inputs: Sequence[Path] = (), marks: Sequence[bytes] = (b'"format": "palpate-',)
) -> None:
    """Refuses an output file that would replace an input, or anything that palpate did not write, or that cannot be written at all.

    Args:
        output: the file to write.
        inputs: what the command reads.
        marks: an existing file must hold one of these in its first 4 KB to be replaced.

    Raises:
        PalpateError: saying which.
        OSError: if the disk is full.
    """
    if any(output.exists() and path.exists() and output.samefile(path) for path in inputs):
        raise PalpateError(
            "An output must not replace an input of the same command",
            str(output),
            "Choose another -o",
        )
    _require_writable(output)
    if output.is_file():
        with open(output, "rb") as file:
            head = file.read(4096)
        if head and not any(mark in head for mark in marks):
            raise PalpateError(
                f"{output} must be new, or a file of the kind that this command writes",
                "another file",
                "Choose another -o, or remove it",
            )


def _require_writable(output: Path) -> None:
    """Tells now, rather than when all is computed, that no file can be made there: rights alone do not tell, so one is made beside it."""
    try:
        if output.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        place = next(
            p for p in output.absolute().parents if p.exists()
        )  # the folders below it are made when the file is
        handle, name = tempfile.mkstemp(dir=place, prefix=f".{output.name}.")
    except OSError as error:
        if error.errno in NO_ROOM:
            raise OSError(error.errno, os.strerror(error.errno), str(output)) from None
        raise PalpateError(
            f"{output} must be writable",
            error.strerror or str(error),
            "Choose another path, or check its rights",
        ) from None
    os.close(handle)
    Path(name).unlink()


def _set_threads() -> None:
    """Thread counts for small models, unless the user has set them; must come before NumPy and torch load.

    Measured on two cores with the ``mini`` models: one thread trains 59 images a second, two 36, and fitting the probe with two
    BLAS threads takes 16 times as long as with one. Spinning while waiting makes it worse still.
    """
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, min(4, cores // 2))))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _file_error(error: OSError) -> PalpateError:
    """A file or folder that cannot be read or written, as must / got / fix."""
    place = error.filename or "the files of this command"
    if error.errno in NO_ROOM:
        return PalpateError(
            f"The disk must have room for {place}",
            error.strerror or str(error),
            "Free some space and run the same command again",
        )
    return PalpateError(
        f"{place} must be readable and writable as asked",
        error.strerror or str(error),
        "Check the path, its rights and the free space",
    )


def _write_json(data: Any) -> None:
    """On standard output, as it is read back whatever letters the stream has."""
    plain = (
        not (getattr(sys.stdout, "encoding", None) or "").lower().replace("-", "").startswith("utf")
    )
    sys.stdout.write(json.dumps(data, indent=1, ensure_ascii=plain, allow_nan=False) + "\n")


def run_verb(name: str, args: Sequence[str]) -> int:
    """Runs one verb with its arguments; see :func:`palpate.cli.main` for the exit statuses."""
    _set_threads()
    as_json = "--json" in args
    try:
        if name not in VERBS:
            near = difflib.get_close_matches(name, VERBS, 1)
            raise PalpateError(
                f"The verb must be one of {', '.join(VERBS)}",
                repr(name),
                f"Did you mean: palpate {near[0]}" if near else "See: palpate --help",
            )
        module = importlib.import_module(f"palpate.cli.{VERBS[name].module}")
        options = parse(name, module.Options, args)
        terminal = Terminal(options, shlex.join(["palpate", name, *args]))
        answer = module.run(options, terminal)
        result, status = answer if isinstance(answer, tuple) else (answer, OK)
        if as_json:
            _write_json(result)
        return int(status)
    except (PalpateError, OSError) as caught:
        error = caught if isinstance(caught, PalpateError) else _file_error(caught)
        sys.stderr.write(f"palpate {name}: {error}\n")
        if isinstance(error, ProblemsError):
            _list_problems(error.problems, lambda line: sys.stderr.write(f"{line}\n"))
        if as_json:
            _write_json(error.to_json())
        return USER_ERROR
    except KeyboardInterrupt:
        sys.stderr.write(
            f"\npalpate {name}: stopped. Run the same command again: with an output or a cache it goes on from what is done.\n"
        )
        return INTERRUPTED
    except Exception as bug:  # our own mistake: the traceback helps to report it, and the status differs from a failed check
        traceback.print_exc()
        sys.stderr.write(
            f"palpate {name}: this is a bug in palpate; please report the lines above.\n"
        )
        if as_json:
            told = PalpateError(
                "palpate must not fail of itself",
                str(bug),
                "Report the traceback on standard error",
            ).to_json()
            _write_json(told | {"error": type(bug).__name__})
        return BUG


__all__ = [
    "FAILED_CHECK",
    "Common",
    "OutPath",
    "Terminal",
    "guard_output",
    "require_extra",
    "run_verb",
    "working_folder",
]
