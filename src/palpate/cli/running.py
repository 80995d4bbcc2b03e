"""From the words of a command to its exit status: parsed by tyro, run, errors in one line each."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import inspect
import json
import os
import re
import shlex
import sys
import traceback
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import dropwhile, takewhile
from typing import Annotated, Any, get_type_hints

import docstring_parser
import tyro

# Private, and so the version is pinned: tyro has no public way to learn what is wrong.
from tyro._errors import (
    InstantiationFailure,
    InvalidChoice,
    MissingArgs,
    ParseErrorEvent,
    UnrecognizedArgs,
    on_parse_error,
)

from palpate.cli.terminal import CONFIG, FIRST, Terminal
from palpate.cli.verbs import BUG, OK, USER_ERROR, VERBS
from palpate.core import PalpateError, PalpateWarning, ProblemsError, problem_lines, require
from palpate.core.files import NO_ROOM

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
#: What would break a line of the terminal, or color it.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")
#: The default of an option in its help, unless it says nothing.
DEFAULT = tyro.conf.arg(
    help_behavior_hint=lambda text: "" if text in ("None", "False", "") else f"(default: {text})"
)


def parse(name: str, options: type[Any], args: Sequence[str]) -> Any:
    """Parse ``args`` as the ``Options`` of a verb; ``--help`` prints and exits.

    Raises:
        PalpateError: in one line what tyro would draw a box around.
    """

    def refuse(event: ParseErrorEvent) -> None:
        raise _parse_error(name, options, event, args)

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
    if isinstance(value, bool):
        return name if value else name.replace("--", "--no-", 1)
    if isinstance(value, Mapping):  # e.g. columns={"vision": "rgb"}
        value = [f"{key}={cell}" for key, cell in value.items()]
    values = value if isinstance(value, list | tuple) else [value]
    words = shlex.join(map(str, values))
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


def _file_error(error: OSError) -> PalpateError:
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


def _call(name: str, args: Sequence[str]) -> tuple[Any, int]:
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
    module = importlib.import_module(f"palpate.cli.{VERBS[name].module}")
    options = parse(name, module.Options, args)
    terminal = Terminal(options, shlex.join(["palpate", *name.split(), *args]))
    answer = module.run(options, terminal)
    return answer if isinstance(answer, tuple) else (answer, OK)
