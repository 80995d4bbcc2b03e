"""What all verbs share: parsing with tyro, progress, tables, JSON, and errors in one line.

A verb's module has a frozen dataclass ``Options`` (its docstring and field docstrings are the help)
that derives from :class:`Common`, and ``run(options, terminal) -> dict | tuple[dict, int]``: the
JSON that ``--json`` prints, and an exit status if it is not 0. A nested dataclass is a group of
options in the help; its option names stay flat.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import difflib
import errno
import importlib
import importlib.util
import inspect
import io
import json
import os
import re
import shlex
import sys
import tempfile
import textwrap
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import tyro
from rich.console import Console

from palpate.cli.verbs import BUG, FAILED_CHECK, OK, USER_ERROR, VERBS
from palpate.core import (
    MissingExtraError,
    Note,
    PalpateError,
    PalpateWarning,
    Problem,
    ProblemsError,
    Progress,
    fact_lines,
    is_stream,
    problem_lines,
    quiet,
    write_text,
)
from palpate.core.files import NO_ROOM

if TYPE_CHECKING:
    from palpate.report.results import Audit, Results

#: Verb and argument of its function -> how the command line writes it, where that is not the
#: argument's own name ("--sigma"). '' is every verb.
OPTION_NAMES: dict[tuple[str, str], str] = {
    ("audit", "train_or_data"): "TRAIN",
    ("audit", "test"): "TEST",
    ("caption check", "captions"): "CAPTIONS",
    ("", "columns"): "--map",
    ("train encoder", "batch"): "--set tactile_course.batch",
    ("train generator", "batch"): "--set loop.batch",
    ("train generator", "source"): "--set condition.source",
    ("presets", "name"): "NAME",
    ("", "side"): "--as",
    ("", "data"): "PATH",
    ("", "source"): "PATH",
    ("generate", "photos"): "PATH",
}

#: Of several processes that torchrun started, the first one writes; errors are everyone's,
#: but for those that all of them raise.
FIRST = os.environ.get("RANK", "0") == "0"
#: What would break a line of the terminal, or color it.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")
#: A flag without its negation: for options that are off by default.
Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff]
OutPath = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
OptionalOutPath = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every verb."""

    as_json: Annotated[Switch, tyro.conf.arg(name="json")] = False
    """Print one JSON object on standard output instead of text."""
    quiet: Annotated[Switch, tyro.conf.arg(aliases=["-q"])] = False
    """No progress and no notes."""


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

    def deliver(
        self,
        results: Results,
        *,
        output: Path | None = None,
        page: Path | None = None,
        latex: Path | None = None,
    ) -> dict[str, Any]:
        """Show results, write the files, and return what ``--json`` prints."""
        results = dataclasses.replace(results, commands=[self.command])
        try:
            self.show(results)  # before saving: a full disk loses nothing
        finally:
            if output:
                results.save(output)
            if page:
                results.to_html(page)
            if latex:
                write_text(latex, results.to_latex())
        return results.to_json() if self.json else {}

    def skipped(self, problems: Sequence[Problem]) -> None:
        """List on standard error what ``--skip-bad`` skipped."""
        if problems:
            self.print_line(f"Skipped {len(problems)}:")
            list_problems(problems, self.print_line)

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

                def report(what: str, done: int, total: int, remark: str = "") -> None:
                    if what not in tasks:
                        tasks[what] = bars.add_task(what, total=total or None, remark="")
                    bars.update(tasks[what], completed=done, total=total or None, remark=remark)
                    if total and done >= total:  # a later task of the same name begins anew
                        tasks.pop(what)

                yield report


class _LogProgress:
    """At most a line every ten seconds, one at the end of what took long, and one at the start of
    what cannot be counted.
    """

    def __init__(self, print_line: Callable[[str], None], every: float = 10.0) -> None:
        self.print_line, self.every = print_line, every
        self.last = time.monotonic()
        self.shown: set[str] = set()

    def __call__(self, what: str, done: int, total: int, remark: str = "") -> None:
        ended = bool(total) and done >= total and what in self.shown
        begun = not total and what not in self.shown
        if ended or begun or time.monotonic() - self.last >= self.every:
            amount = f"{done}/{total}" if total else "..."
            self.print_line(f"  {what} {amount} {remark}".rstrip())
            self.last = time.monotonic()
            self.shown = self.shown - {what} if ended else self.shown | {what}


def list_problems(problems: Sequence[Problem], print_line: Callable[[str], None]) -> None:
    """Print the first problems, one a line."""
    for line in problem_lines(problems):
        print_line(line)


def parse(name: str, options: type[Any], args: Sequence[str]) -> Any:
    """Parse ``args`` as the ``Options`` of a verb; ``--help`` prints and exits.

    Raises:
        PalpateError: in one line what tyro would draw a box around.
    """
    join_help_lines(options)
    box, about = io.StringIO(), inspect.cleandoc(options.__doc__ or "")
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(
                options,
                prog=f"palpate {name}",
                args=list(args),
                description=f"{about}\n\nExample: {VERBS[name].example}",
                config=CONFIG,
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        words = " ".join(re.sub(r"[\u2500-\u257f]+", " ", box.getvalue()).split())
        raise _parse_error(name, options, words) from None


def _parse_error(name: str, options: type[Any], words: str) -> PalpateError:
    """Return tyro's message about arguments as must, got, fix."""
    fix = f"See: palpate {name} --help"
    if unknown := re.search(r"Unrecognized options: (\S+)", words):
        near = difflib.get_close_matches(unknown[1], _option_names(options), 1, 0.75)
        fix = f"Did you mean: {near[0]}" if near else fix
        kind = "An option" if unknown[1].startswith("-") else "An argument"
        must = f"{kind} of palpate {name} must be one of its help"
        return PalpateError(must, unknown[1].rstrip(","), fix)
    choice = re.search(
        r"invalid choice '(.*?)' for argument '(.*?)'. Expected one of \((.*?)\)", words
    )
    if choice:
        choices = sorted(set(re.findall(r"'(.*?)'", choice[3])) - {"None"})
        return PalpateError(f"{choice[2]} must be one of {', '.join(choices)}", choice[1], fix)
    value = re.search(
        r"Error parsing (\S+): no type matching (.+?) could .*? from \[(.*?)\]", words
    )
    if value:
        return PalpateError(f"{value[1]} must be {value[2]}", value[3], fix)
    if missing := re.search(r"Missing from palpate [a-z ]+: (.*)", words):
        first = (part.strip().removeprefix("-o PATH, ") for part in missing[1].split("(required)"))
        names = [part.split(" ")[0] for part in first if re.match(r"--\w|[A-Z]+ ", part)]
        return PalpateError(f"{' and '.join(names)} must be given", "none", fix)
    hints = r"For full helptext|Argument helptext|Full error|If your arguments"
    got = re.split(hints, words)[0].strip() or "arguments that cannot be parsed"
    return PalpateError(f"The options of palpate {name} must be as its help says", got, fix)


def join_help_lines(options: type[Any]) -> None:
    """Make the help of each option one paragraph with a default that says something.

    tyro keeps the line breaks of a docstring, and shows ``None`` for what is not given.
    """
    for cls in filter(dataclasses.is_dataclass, options.__mro__):
        hints = get_type_hints(cls, include_extras=True)
        for name in cls.__annotations__:
            default = cls.__dataclass_fields__[name].default
            many = default is dataclasses.MISSING and "tuple" in str(hints[name])
            if default is None or default is False or default == () or many:
                cls.__annotations__[name] = _without_default(hints[name])
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body  # type: ignore[attr-defined]
        for statement, doc in pairwise(body):
            if isinstance(statement, ast.AnnAssign) and isinstance(doc, ast.Expr):
                field: Any = cls.__dataclass_fields__[ast.unparse(statement.target)]
                text = " ".join(str(ast.literal_eval(doc.value)).split())
                field.metadata = {**field.metadata, "help": text}
    for field in dataclasses.fields(options):
        group: Any = field.default_factory
        if dataclasses.is_dataclass(field.default):
            group = type(field.default)
        # Groups made by `make_dataclass` have no source; they write their own help.
        name = getattr(group, "__name__", "")
        written = getattr(inspect.getmodule(group), name, None) is group
        if written and dataclasses.is_dataclass(group):
            join_help_lines(group)  # type: ignore[arg-type]


def _without_default(hint: Any) -> Any:
    """Annotate a type so that its help shows no default, unless it says so itself."""
    extras = list(getattr(hint, "__metadata__", ()))
    for k, extra in enumerate(extras):
        if hasattr(extra, "help_behavior_hint"):
            if extra.help_behavior_hint is None:
                extras[k] = dataclasses.replace(extra, help_behavior_hint="")
            return Annotated[hint.__origin__, *extras]
    return Annotated[hint, tyro.conf.arg(help_behavior_hint="")]


def _option_names(options: type[Any]) -> list[str]:
    """Return the option names of a verb, as its help shows them."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        tyro.cli(options, args=["--help"], config=CONFIG)
    return re.findall(r"^\W*(?:-\w\b[^,\n]*, )?(--[a-z][\w-]*)", text.getvalue(), re.MULTILINE)


def option_name(verb: str, argument: str) -> str:
    """Return how the command line writes an argument of the verb's function.

    A name with a dot is a field of a preset.
    """
    if "." in argument:
        return f"--set {argument}"
    name = OPTION_NAMES.get((verb, argument)) or OPTION_NAMES.get(("", argument))
    return name or f"--{argument.replace('_', '-')}"


def error_line(verb: str, error: PalpateError) -> str:
    """Return an error in one line, with options in place of arguments."""
    example = partial(_option, verb)
    return error.message(lambda argument: option_name(verb, argument), example)


def _option(verb: str, argument: str, value: Any) -> str:
    """Return how the command line writes an argument with its value."""
    name = option_name(verb, argument)
    if isinstance(value, bool):
        return name if value else name.replace("--", "--no-", 1)
    if isinstance(value, Mapping):  # e.g. columns={"vision": "rgb"}
        value = [f"{key}={cell}" for key, cell in value.items()]
    values = value if isinstance(value, list | tuple) else [value]
    words = shlex.join(map(str, values))
    return f"{name} {words}" if name.startswith("-") else words


def require_extra(purpose: str) -> None:
    """Check that the packages of the extra ``all`` are installed, before any work.

    Raises:
        MissingExtraError: if torch, diffusers, transformers or av is absent.
    """
    for package in ("torch", "diffusers", "transformers", "safetensors", "av"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(package, "all", purpose)


def guard_output(
    output: Path,
    inputs: Sequence[Path] = (),
    signatures: Sequence[bytes] = (b'"format": "palpate-',),
) -> None:
    """Check that an output file replaces neither an input nor a foreign file, and is writable.

    Args:
        output: the file to write.
        inputs: what the command reads.
        signatures: an existing file must hold one of these in its first 4 KB to be replaced; of a
            Parquet file, whose metadata are at its end, the whole name of its format.

    Raises:
        PalpateError: saying which.
        OSError: if the disk is full.
    """
    files = [*inputs, *(path / "manifest.parquet" for path in inputs)]
    if any(output.exists() and path.exists() and output.samefile(path) for path in files):
        must, fix = "An output must not replace an input of the same command", "Choose another file"
        raise PalpateError(must, str(output), fix)
    _require_writable(output)
    if output.is_file():
        with open(output, "rb") as file:
            head = file.read(4096)
            if head.startswith(b"PAR1"):
                file.seek(max(0, output.stat().st_size - 16_384))
                head, signatures = file.read(), [name for name in signatures if b"/" in name]
        if head and not any(each in head for each in signatures):
            must = f"{output} must be new, or a file of the kind that this command writes"
            raise PalpateError(must, "another file", "Choose another file, or remove it")


def _require_writable(output: Path) -> None:
    """Make a temporary file next to ``output`` now, rather than fail when all is computed."""
    if is_stream(output):
        return
    try:
        if output.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        place = next(p for p in output.absolute().parents if p.exists())
        with tempfile.NamedTemporaryFile(dir=place, prefix=f".{output.name}."):
            pass
    except OSError as error:
        if error.errno in NO_ROOM:
            raise OSError(error.errno, os.strerror(error.errno), str(output)) from None
        fix = "Choose another path, or check its rights"
        raise PalpateError(
            f"{output} must be writable", error.strerror or str(error), fix
        ) from None


def _set_threads() -> None:
    """Set thread counts for small models, before NumPy and torch load, unless the user has.

    Measured on two cores with the ``mini`` models: one thread trains 59 images a second, two 36,
    and fitting the probe with two BLAS threads takes 16 times as long as with one.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, min(4, cores // 2))))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _file_error(error: OSError) -> PalpateError:
    place = error.filename or "the files of this command"
    got = error.strerror or str(error)
    if error.errno in NO_ROOM:
        fix = "Free some space and run the same command again"
        return PalpateError(f"The disk must have room for {place}", got, fix)
    fix = "Check the path, its rights and the free space"
    return PalpateError(f"{place} must be readable and writable", got, fix)


def _print_error(line: str) -> None:
    sys.stderr.write(f"{_CONTROL.sub(lambda sign: ascii(sign[0])[1:-1], line)}\n")


def _write_json(data: Any) -> None:
    encoding = (getattr(sys.stdout, "encoding", None) or "").lower()
    ascii_only = not encoding.replace("-", "").startswith("utf")
    text = json.dumps(data, indent=1, ensure_ascii=ascii_only, allow_nan=False)
    sys.stdout.write(text + "\n")


def run_verb(name: str, args: Sequence[str]) -> int:
    """Run one verb with its arguments; see :func:`palpate.cli.main` for the exit statuses."""
    _set_threads()
    as_json = "--json" in args
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PalpateWarning)  # results carry them as notes
            _require_words(args)
            result, status = _call(name, args)
        if as_json and FIRST:
            _write_json(result)
        return status
    except (PalpateError, OSError) as caught:
        error = caught if isinstance(caught, PalpateError) else _file_error(caught)
        if error.shared and not FIRST:
            return USER_ERROR
        _print_error(f"palpate {name}: {error_line(name, error)}")
        if isinstance(error, ProblemsError):
            list_problems(error.problems, _print_error)
        for choice in error.choices:  # the same command with what it lacks
            more = [_option(name, argument, value) for argument, value in choice.items()]
            _print_error(f"  {' '.join([shlex.join(['palpate', *name.split(), *args]), *more])}")
        if as_json:
            _write_json(error.to_json())
        return USER_ERROR
    except Exception as bug:  # the traceback helps to report it
        traceback.print_exc()
        sys.stderr.write(
            f"palpate {name}: this is a bug in palpate; please report the lines above.\n"
        )
        if as_json:
            fix = "Report the traceback on standard error"
            error = PalpateError("palpate must not fail", str(bug), fix)
            _write_json(error.to_json() | {"error": type(bug).__name__})
        return BUG


def _require_words(args: Sequence[str]) -> None:
    """Reject what no option takes: an empty variable of the shell, a path that is not UTF-8."""
    for arg in args:
        if not arg or re.search("[\ud800-\udfff]", arg):
            must = "The arguments must be UTF-8 and not empty"
            raise PalpateError(must, ascii(arg), "Rename the path, or check the shell's variables")


def _call(name: str, args: Sequence[str]) -> tuple[Any, int]:
    if name not in VERBS:
        near = difflib.get_close_matches(" ".join([name, *args[:1]]), VERBS, 1)
        fix = f"Did you mean: palpate {near[0]}" if near else "See: palpate --help"
        raise PalpateError(f"The verb must be one of {', '.join(VERBS)}", repr(name), fix)
    module = importlib.import_module(f"palpate.cli.{VERBS[name].module}")
    options = parse(name, module.Options, args)
    terminal = Terminal(options, shlex.join(["palpate", *name.split(), *args]))
    answer = module.run(options, terminal)
    return answer if isinstance(answer, tuple) else (answer, OK)


__all__ = [
    "CONFIG",
    "FAILED_CHECK",
    "OPTION_NAMES",
    "Common",
    "OptionalOutPath",
    "OutPath",
    "Switch",
    "Terminal",
    "error_line",
    "guard_output",
    "list_problems",
    "require_extra",
    "run_verb",
]
