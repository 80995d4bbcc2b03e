"""What all verbs share: parsing with tyro, progress, results, safe outputs, errors in one line.

A verb's module has a class ``Options`` (its docstring and those of its fields are the help) that
derives from :class:`Common`, and ``run(options, terminal)``. That returns a record that says by
itself what it is (``str``, ``to_json``, and ``ok``: False for the exit status 1, None for 3), or
the JSON that ``--json`` prints, or that and an exit status. A nested class is a group of options in
the help; its option names stay flat.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import errno
import importlib
import importlib.util
import inspect
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from functools import partial
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, dataclass_transform, get_type_hints

import docstring_parser
import tyro
from rich.console import Console

# Private, and so the version is pinned: tyro has no public way to learn what is wrong.
from tyro._errors import (
    InstantiationFailure,
    InvalidChoice,
    MissingArgs,
    ParseErrorEvent,
    UnrecognizedArgs,
    on_parse_error,
)

from palpate.cli.verbs import BUG, FAILED_CHECK, OK, UNKNOWN, USER_ERROR, VERBS
from palpate.core import (
    MissingExtraError,
    Note,
    PalpateError,
    PalpateWarning,
    ProblemsError,
    Progress,
    fact_lines,
    locked,
    problem_lines,
    quiet,
    require,
    write_text,
)
from palpate.core.files import NO_ROOM, is_stream, is_there, starting_to_write

if TYPE_CHECKING:
    from palpate.report.results import Audit, Results

#: Arguments that are paths without a name on the command line.
_PATHS = ("data", "source", "photos", "paths", "study", "votes", "results", "manifest")
#: Options that are paths of what is written; and photos, of which absent ones may be skipped.
WRITTEN = ("output", "page", "latex", "figures", "lists", "cache", "work", "photos")
#: Verb and argument of its function -> how the command line writes it, where that is not the
#: argument's own name ("--sigma"). '' is every verb.
OPTION_NAMES: dict[tuple[str, str], str] = {
    ("run", "command"): "VERB",
    ("audit", "train_or_data"): "TRAIN",
    ("audit", "test"): "TEST",
    ("audit", "group"): "--by",
    ("caption check", "captions"): "CAPTIONS",
    ("caption check", "data"): "--data",
    ("demo", "data"): "--data",
    ("", "columns"): "--map",
    ("train encoder", "batch"): "--set tactile_course.batch",
    ("train generator", "batch"): "--set loop.batch",
    ("train encoder", "vocabulary"): "--set vocabulary",
    ("train generator", "unet"): "--set unet",
    ("train generator", "method"): "--set sampler.method",
    ("presets", "name"): "NAME",
    ("", "side"): "--as",
    ("reproduce", "study"): "STUDY",
    ("score", "names"): "--generated",
    **{("", name): "PATH" for name in _PATHS},
}
#: Arguments whose True and False are words of an option.
WORDED = ("normalize",)
#: Options that need the extra ``all`` in verbs that do without.
NEEDING_EXTRA = ("encoder", "inception", "lpips", "clip")
#: What would break a line of the terminal, or color it.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")
#: The default of an option in its help, unless it says nothing.
DEFAULT = tyro.conf.arg(
    help_behavior_hint=lambda text: "" if text in ("None", "False", "") else f"(default: {text})"
)
#: Of several processes that torchrun started, the first one writes; errors are everyone's,
#: but for those that all of them raise.
FIRST = os.environ.get("RANK", "0") == "0"
T = TypeVar("T")
#: A flag without its negation: for options that are off by default.
Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff]
OutPath = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
#: What has no name on the command line.
PathArgument = Annotated[Path, tyro.conf.Positional]
PathArguments = Annotated[tuple[Path, ...], tyro.conf.Positional]
OptionalOutPath = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)
#: What the first 4 KB of a file that palpate wrote as JSON hold.
JSON_MARK = b'"format": "palpate-'


@dataclass_transform(frozen_default=True, kw_only_default=True)
def option_group(group: type[T]) -> type[T]:
    """Make a class a group of options: an immutable record of keywords."""
    return dataclasses.dataclass(frozen=True, kw_only=True)(group)


@option_group
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


@option_group
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

    def facts(self, title: str, rows: dict[str, Any]) -> dict[str, Any]:
        """Print a two-column table of names and values, and return them."""
        self.out.print(title, style="bold", markup=False)
        for line in fact_lines(rows):
            self.print(line)
        return rows

    def run(self, function: Callable[..., T], *args: Any, **keywords: Any) -> T:
        """Call a function that reports progress."""
        with self.progress() as progress:
            return function(*args, progress=progress, **keywords)

    @contextlib.contextmanager
    def progress(self) -> Generator[Progress]:
        """Yield a callback: bars on a terminal, a line now and then in a log, or nothing."""
        if self.silent:
            yield quiet
        elif not self.err.is_terminal:
            yield _LogProgress(self.print_line)
        else:
            from rich.progress import MofNCompleteColumn, TextColumn
            from rich.progress import Progress as Bars

            remark_column = TextColumn("{task.fields[remark]}")
            columns = (*Bars.get_default_columns(), MofNCompleteColumn(), remark_column)
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


def _require_variables() -> None:
    """Check variables of the environment that break libraries while they load.

    Raises:
        PalpateError: naming one.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "0")
    for name, holds, form in (
        ("SOURCE_DATE_EPOCH", epoch.isdecimal() and int(epoch) < 1 << 32, "a number under 2**32"),
        ("PYTHONOPTIMIZE", sys.flags.optimize < 2, "0 or 1"),  # 2 removes docstrings
    ):
        must = f"The variable {name} must be {form}, as libraries need it"
        require(holds, None, must, os.environ.get(name, "-OO"), fix="Unset it")


def _require_extra(verb: str, options: Any) -> None:
    """Check before any work that the packages are there that a verb or its options need.

    Raises:
        MissingExtraError: if one of the extra ``all`` is absent.
    """
    values = _keywords(options)
    needing = [f" {option_name(verb, name)}" for name in NEEDING_EXTRA if values.get(name)]
    if VERBS[verb].extra or needing:
        for package in ("torch", "diffusers", "transformers", "safetensors", "av"):
            if importlib.util.find_spec(package) is None:
                raise MissingExtraError(package, "all", f"palpate {verb}{''.join(needing[:1])}")


def _require_inputs(options: Any) -> None:
    """Check that the files are there that a command names, before what takes seconds to import.

    Raises:
        PalpateError: naming the first that is not.
    """
    values = _keywords(options)
    values |= values.get("reading", {})
    if values.get("format") == "hf":  # named by its id
        del values["source"]
    for name, value in values.items():
        for path in value if isinstance(value, tuple) else (value,):
            if isinstance(path, Path) and name not in WRITTEN:
                hub = "; a data set on the hub needs the format hf" if name == "source" else ""
                got, fix = f"nothing at {path}", f"Check the path{hub}"
                require(is_there(path), name, "must exist", got, fix=fix)


def guard_output(
    output: Path, inputs: Sequence[Path] = (), signatures: Sequence[bytes] = (JSON_MARK,)
) -> None:
    """Check that an output file replaces neither an input nor a foreign file, and is writable.

    Args:
        output: the file to write.
        inputs: what the command reads.
        signatures: an existing file must hold one of these in its first 4 KB to be replaced, a
            Parquet file a whole name of a format in its last 16 KB, where its metadata are.

    Raises:
        PalpateError: saying which.
        OSError: if the disk is full.
    """
    files = [*inputs, *(path / "manifest.parquet" for path in inputs)]
    is_input = any(output.exists() and p.exists() and output.samefile(p) for p in files)
    must, fix = "An output must not replace an input of the same command", "Choose another file"
    require(not is_input, None, must, str(output), fix=fix)
    with starting_to_write(output):
        if not is_stream(output):
            if output.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
            folder = next(p for p in output.absolute().parents if p.exists())
            # Fail now rather than when all is computed.
            with tempfile.NamedTemporaryFile(dir=folder, prefix=f".{output.name}."):
                pass
    if output.is_file():
        with open(output, "rb") as file:
            head = file.read(4096)
            if head.startswith(b"PAR1"):
                file.seek(max(0, output.stat().st_size - 16_384))
                head, signatures = file.read(), [name for name in signatures if b"/" in name]
        must = f"{output} must be new, or a file of the kind that this command writes"
        ours = not head or any(each in head for each in signatures)
        require(ours, None, must, "another file", fix="Choose another file, or remove it")


@contextlib.contextmanager
def working_folder(cache: Path | None, output: Path | None) -> Generator[Path | None]:
    """Yield the cache; without one a folder next to the output, from which an interrupted run
    resumes and which one that has ended removes.

    Raises:
        PalpateError: if another run writes that output.
    """
    if cache is not None or output is None or is_stream(output):
        yield cache
        return
    folder = output.absolute().parent / f".{output.name}.work"
    with locked(folder, output):
        yield folder
        shutil.rmtree(folder, ignore_errors=True)


def parse(name: str, options: type[Any], args: Sequence[str]) -> Any:
    """Parse ``args`` as the ``Options`` of a verb; ``--help`` prints and exits.

    Raises:
        PalpateError: in one line what tyro would draw a box around.
    """

    def refuse(event: ParseErrorEvent) -> None:
        raise _parse_error(name, options, event, args)

    args = getattr(options, "arranged", list)(args)
    if not {"-h", "--help"}.isdisjoint(args):
        polish_help(options)
    about = inspect.cleandoc(options.__doc__ or "")
    with on_parse_error(refuse):
        return tyro.cli(
            options,
            prog=f"palpate {name}",
            args=list(args),
            description=f"{about}\n\nExample: {VERBS[name].example}",
            config=CONFIG,
        )


def _parse_error(
    name: str, options: type[Any], event: ParseErrorEvent, args: Sequence[str]
) -> PalpateError:
    """Return what tyro says of the arguments as must, got, fix."""
    fix = f"See: palpate {name} --help"
    match event:
        case UnrecognizedArgs(tokens=[word, *_]) | MissingArgs(unrecognized_tokens=[word, *_]):
            near = difflib.get_close_matches(word, option_strings(options), 1, 0.75)
            must = f"{'An option' if word[0] == '-' else 'An argument'} of palpate {name}"
            fix = f"Did you mean: {near[0]}" if near else fix
            return PalpateError(f"{must} must be one of its help", word, fix)
        case MissingArgs():
            names = " and ".join(_written(each.arg) for each in event.missing_arguments)
            return PalpateError(f"{names} must be given", "none", fix)
        case InvalidChoice():
            choices = sorted({*event.choices} - {"None"})
            must = f"{_written(event.argument)} must be one of {', '.join(choices)}"
            return PalpateError(must, event.value, fix)
        case InstantiationFailure(argument=argument, message=message) if argument is not None:
            words = [word for each in args for word in each.split("=", 1)]
            after = dropwhile(lambda word: word not in argument.lowered.name_or_flags, words)
            values = list(takewhile(lambda word: word[:1] != "-", [*after][1:]))
            must = f"{_written(argument)} must be {argument.lowered.metavar}"
            return PalpateError(must, " ".join(values) or message.partition("\n")[0], fix)
        case _:
            argument = getattr(event, "argument", None)
            must = f"{_written(argument) if argument else 'Each option'} must have its values"
            return PalpateError(must, "too few", fix)


def _written(argument: Any) -> str:
    """Return how an argument that tyro knows is written."""
    low = argument.lowered
    return str(low.metavar) if argument.is_positional() else low.name_or_flags[-1]


def option_strings(options: type[Any]) -> list[str]:
    """Return all that a verb's options may be called, ``--no-images`` as well."""
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        parser: Any = tyro.extras.get_parser(options, config=CONFIG)  # pyright: ignore[reportDeprecated]
        return list(parser._option_string_actions)


def polish_help(options: type[Any]) -> None:
    """Make the help of each option one paragraph with a default that says something.

    tyro keeps the line breaks of a docstring, and shows ``None`` for what is not given.
    """
    for cls in filter(dataclasses.is_dataclass, options.__mro__):
        for name, hint in get_type_hints(cls, include_extras=True).items():
            if name in cls.__annotations__:
                own = getattr(hint, "__metadata__", ())
                plain = hint.__origin__ if own else hint
                cls.__annotations__[name] = Annotated[plain, DEFAULT, *own]
        for param in docstring_parser.parse_from_object(cls).params:
            text = " ".join((param.description or "").split())
            cls.__dataclass_fields__[param.arg_name].metadata = {"help": text}  # type: ignore[misc]
    for each in dataclasses.fields(options):
        group: Any = each.default_factory
        group = type(each.default) if dataclasses.is_dataclass(each.default) else group
        if dataclasses.is_dataclass(group):
            polish_help(group)  # type: ignore[arg-type]


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
    if isinstance(value, bool) and argument in WORDED:
        value = "yes" if value else "no"
    if isinstance(value, bool):
        return name if value else name.replace("--", "--no-", 1)
    if isinstance(value, Mapping):  # e.g. columns={"vision": "rgb"}
        value = [f"{key}={cell}" for key, cell in value.items()]
    values = value if isinstance(value, list | tuple) else [value]
    words = shlex.join(map(str, values))
    if name.startswith("--set "):
        return f"{name}={words}"
    return f"{name} {words}" if name.startswith("-") else words


def _set_threads() -> None:
    """Set thread counts for small models, before NumPy and torch load, unless the user has.

    Measured on two cores with the ``mini`` models: one thread trains 59 images a second, two 36,
    and fitting the probe with two BLAS threads takes 16 times as long as with one.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, min(4, cores // 2))))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _explained(verb: str, error: OSError | ModuleNotFoundError) -> PalpateError:
    """What cannot be read, written or imported, as must, got, fix."""
    if isinstance(error, ModuleNotFoundError):
        return MissingExtraError((error.name or "").partition(".")[0], "all", f"palpate {verb}")
    file = error.filename or "the files of this command"
    got = error.strerror or str(error)
    if error.errno in NO_ROOM:
        fix = "Free some space and run the same command again"
        return PalpateError(f"The disk must have room for {file}", got, fix)
    fix = "Check the path, its rights and the free space"
    return PalpateError(f"{file} must be readable and writable", got, fix)


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
            result, status = call_verb(name, args)
        if as_json and FIRST:
            _write_json(result)
        return status
    except (PalpateError, OSError, ModuleNotFoundError) as caught:
        error = caught if isinstance(caught, PalpateError) else _explained(name, caught)
        if error.shared and not FIRST:
            return USER_ERROR
        _print_error(f"palpate {name}: {error_line(name, error)}")
        if isinstance(error, ProblemsError):
            for line in problem_lines(error.problems):
                _print_error(line)
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


def checked(name: str, args: Sequence[str]) -> tuple[Any, Any]:
    """Return the module of a verb and its options, once what they name was found."""
    module = importlib.import_module(f"palpate.cli.{VERBS[name].module}")
    options = parse(name, module.Options, args)
    _require_extra(name, options)
    _require_inputs(options)
    return module, options


def call_verb(name: str, args: Sequence[str]) -> tuple[Any, int]:
    """Return the JSON of a verb and its exit status; mistakes are raised."""
    _require_variables()
    for arg in args:  # an empty variable of the shell, a path that is not UTF-8
        fit = arg and not re.search("[\ud800-\udfff]", arg)
        must, fix = "must be UTF-8 and not empty", "Rename the path, or check the shell's variables"
        require(bool(fit), None, f"The arguments {must}", ascii(arg), fix=fix)
    if name not in VERBS:
        second = [word for word in args[:1] if word[0] != "-"]
        words = (" ".join([name, *second]), name)
        near = [n for word in words for n in difflib.get_close_matches(word, VERBS, 1)]
        fix = f"Did you mean: palpate {near[0]}" if near else "See: palpate --help"
        raise PalpateError(f"The verb must be one of {', '.join(VERBS)}", repr(name), fix)
    module, options = checked(name, args)
    terminal = Terminal(options, shlex.join(["palpate", *name.split(), *args]))
    answer = module.run(options, terminal)
    if hasattr(answer, "to_json"):
        terminal.print(str(answer))
        statuses = {True: OK, False: FAILED_CHECK, None: UNKNOWN}
        return answer.to_json(), statuses[getattr(answer, "ok", True)]
    return answer if isinstance(answer, tuple) else (answer, OK)
