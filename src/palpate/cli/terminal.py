"""What all verbs share: options, results on standard output, progress, and outputs that are safe.

A verb's module has a frozen dataclass ``Options`` (its docstring and field docstrings are the help)
that derives from :class:`Common`, and ``run(options, terminal) -> dict | tuple[dict, int]``: the
JSON that ``--json`` prints, and an exit status if it is not 0. A nested dataclass is a group of
options in the help; its option names stay flat.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import importlib.util
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

# Private, and so the version is pinned: tyro has no public way to learn what is wrong.
from palpate.core import (
    MissingExtraError,
    Note,
    PalpateError,
    Progress,
    fact_lines,
    quiet,
    require,
    write_text,
)
from palpate.core.files import NO_ROOM, is_stream

if TYPE_CHECKING:
    from palpate.report.results import Audit, Results


#: Of several processes that torchrun started, the first one writes; errors are everyone's,
#: but for those that all of them raise.
FIRST = os.environ.get("RANK", "0") == "0"
#: A flag without its negation: for options that are off by default.
Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff]
OutPath = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
OptionalOutPath = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)
#: What the first 4 KB of a file that palpate wrote as JSON hold.
JSON_MARK = b'"format": "palpate-'


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every verb."""

    as_json: Annotated[Switch, tyro.conf.arg(name="json")] = False
    """Print one JSON object on standard output instead of text."""
    quiet: Annotated[Switch, tyro.conf.arg(aliases=["-q"])] = False
    """No progress and no notes."""

    def keywords(self, *without: str, **instead: Any) -> dict[str, Any]:
        """The options by name, those of groups too, as arguments of the verb's function.

        What defaults to no items is None then. A group may say itself what it passes on.

        Args:
            without: options that are no arguments of the function.
            instead: arguments in place of options.
        """
        without = ("as_json", "quiet", *without)
        return {k: v for k, v in _keywords(self).items() if k not in without} | instead


def _keywords(options: Any) -> dict[str, Any]:
    names: dict[str, Any] = {}
    for each in dataclasses.fields(options):
        value = getattr(options, each.name)
        if own := getattr(value, "keywords", None):
            names |= own()
        elif dataclasses.is_dataclass(value):
            names |= _keywords(value)
        else:
            names[each.name] = None if value == () == each.default else value
    return names


@dataclass(frozen=True, kw_only=True)
class Files:
    """What is written."""

    output: OptionalOutPath = None
    """The results as JSON, for `palpate report`."""
    page: Path | None = None
    """The same as one self-contained page (.html), with .json and .md next to it."""
    latex: Path | None = None
    """The tables as LaTeX (booktabs)."""

    def keywords(self) -> dict[str, Any]:
        """No arguments of the verb's function."""
        return {}

    def guard(self, inputs: Sequence[Path]) -> None:
        """Check what :meth:`Terminal.deliver` is to write, as :func:`guard_output`.

        Raises:
            PalpateError: if the tables are to replace the results, or the page is no .html.
        """
        output, page, latex = self.output, self.page, self.latex
        is_page = page is None or page.suffix.lower() == ".html"
        require(is_page, "page", "must end in .html", page and page.name)
        pages = [page.with_suffix(suffix) for suffix in (".html", ".json", ".md")] if page else []
        same = output and latex and latex.resolve() == output.resolve()
        must, fix = "must not be the file of the results", "Choose another file for one of them"
        require(not same, "latex", must, str(latex), fix=fix)
        marks = (output, JSON_MARK), (latex, b"% palpate"), *((path, b"palpate") for path in pages)
        for path, mark in marks:
            if path is not None:
                guard_output(path, inputs, (mark,))


class Terminal:
    """Where a verb writes: results on standard output, progress and notes on standard error."""

    def __init__(self, options: Common, command: str = "") -> None:
        self.command = command
        self.json = options.as_json
        self.silent = options.quiet or not FIRST
        # Piped text is not wrapped: digests and paths must stay whole.
        width = None if sys.stdout.isatty() else 400
        self.out = Console(highlight=False, quiet=self.json or not FIRST, width=width)
        self.err = Console(stderr=True, highlight=False, quiet=self.silent)

    def print_line(self, line: str) -> None:
        """Print a remark on standard error."""
        self.err.print(line, markup=False, soft_wrap=True)

    def note(self, note: Note) -> None:
        """Print a note on standard error, with options in place of arguments."""
        from palpate.report.notes import COMMAND_LINE, sentence

        self.print_line(f"Note: {sentence(note, COMMAND_LINE)}")

    def print(self, line: str) -> None:
        """Print a line of the result on standard output."""
        self.out.print(line, markup=False, soft_wrap=True)

    def show(self, result: Results | Audit) -> None:
        """Print the tables of a result, as wide as the terminal."""
        from palpate.report.terminal import print_result

        print_result(result, self.out)

    def deliver(self, results: Results, files: Files) -> dict[str, Any]:
        """Show results, write the files, and return what ``--json`` prints."""
        results = dataclasses.replace(results, commands=[self.command])
        try:
            self.show(results)  # before saving: a full disk loses nothing
        finally:
            if files.output:
                results.save(files.output)
            if files.page:
                results.to_html(files.page)
            if files.latex:
                write_text(files.latex, results.to_latex())
        return results.to_json() if self.json else {}

    def facts(self, title: str, rows: Mapping[str, Any]) -> None:
        """Print a two-column table of names and values."""
        self.out.print(title, style="bold", markup=False)
        for line in fact_lines(rows):
            self.print(line)

    @contextlib.contextmanager
    def progress(self) -> Generator[Progress]:
        """Yield a callback: bars on a terminal, a line now and then in a log, or nothing."""
        if self.silent:
            yield quiet
        elif not self.err.is_terminal:
            yield _LogProgress(self.print_line)
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

                def report(task: str, done: int, total: int, remark: str = "") -> None:
                    if task not in tasks:
                        tasks[task] = bars.add_task(task, total=total or None, remark="")
                    bars.update(tasks[task], completed=done, total=total or None, remark=remark)
                    if total and done >= total:  # a later task of the same name begins anew
                        tasks.pop(task)

                yield report


class _LogProgress:
    """At most a line every ten seconds, one at the end of what took long, and one at the start of
    what cannot be counted.
    """

    def __init__(self, print_line: Callable[[str], None], every: float = 10.0) -> None:
        self.print_line, self.every = print_line, every
        self.last = time.monotonic()
        self.printed: set[str] = set()

    def __call__(self, task: str, done: int, total: int, remark: str = "") -> None:
        ended = bool(total) and done >= total and task in self.printed
        begun = not total and task not in self.printed
        if ended or begun or time.monotonic() - self.last >= self.every:
            amount = f"{done}/{total}" if total else "..."
            self.print_line(f"  {task} {amount} {remark}".rstrip())
            self.last = time.monotonic()
            self.printed = self.printed - {task} if ended else self.printed | {task}


def require_extra(purpose: str) -> None:
    """Check that the packages of the extra ``all`` are installed, before any work.

    Raises:
        MissingExtraError: if torch, diffusers, transformers or av is absent.
    """
    for package in ("torch", "diffusers", "transformers", "safetensors", "av"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(package, "all", purpose)


def guard_output(
    output: Path, inputs: Sequence[Path] = (), signatures: Sequence[bytes] = (JSON_MARK,)
) -> None:
    """Check that an output file replaces neither an input nor a foreign file, and is writable.

    Args:
        output: the file to write.
        inputs: what the command reads.
        signatures: an existing file must hold one of these in its first 4 KB to be replaced, a
            Parquet file in its last 16, where its metadata are.

    Raises:
        PalpateError: saying which.
        OSError: if the disk is full.
    """
    files = [*inputs, *(path / "manifest.parquet" for path in inputs)]
    is_input = any(output.exists() and p.exists() and output.samefile(p) for p in files)
    must, fix = "An output must not replace an input of the same command", "Choose another file"
    require(not is_input, None, must, str(output), fix=fix)
    try:
        if not is_stream(output):
            if output.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
            folder = next(p for p in output.absolute().parents if p.exists())
            # Fail now rather than when all is computed.
            with tempfile.NamedTemporaryFile(dir=folder, prefix=f".{output.name}."):
                pass
    except OSError as error:
        if error.errno in NO_ROOM:
            raise OSError(error.errno, os.strerror(error.errno), str(output)) from None
        got, fix = error.strerror or str(error), "Choose another path, or check its rights"
        raise PalpateError(f"{output} must be writable", got, fix) from None
    if output.is_file():
        with open(output, "rb") as file:
            head = file.read(4096)
            if head.startswith(b"PAR1"):
                file.seek(max(0, output.stat().st_size - 16_384))
                head = file.read()
        must = f"{output} must be new, or a file of the kind that this command writes"
        ours = not head or any(each in head for each in signatures)
        require(ours, None, must, "another file", fix="Choose another file, or remove it")


@contextlib.contextmanager
def working_folder(cache: Path | None, output: Path | None) -> Generator[Path | None]:
    """Yield the cache; without one a folder next to the output, from which an interrupted run
    resumes and which one that has ended removes.
    """
    if cache is not None or output is None or is_stream(output):
        yield cache
        return
    folder = output.absolute().parent / f".{output.name}.work"
    yield folder
    shutil.rmtree(folder, ignore_errors=True)
