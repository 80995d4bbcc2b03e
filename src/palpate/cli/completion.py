"""``palpate completion``: completion of verbs and options in a shell."""

from __future__ import annotations

import contextlib
import importlib
import io
from dataclasses import dataclass, make_dataclass
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import CONFIG, Common, Terminal
from palpate.cli.verbs import VERBS


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Print the completion script of a shell."""

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """The shell."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Print the script for all verbs."""
    verbs: dict[str, Any] = {}
    groups: dict[str, dict[str, Any]] = {}
    for name, verb in VERBS.items():
        module = importlib.import_module(f"palpate.cli.{verb.module}")
        group, _, last = name.rpartition(" ")
        (groups.setdefault(group, {}) if group else verbs)[last] = module.Options
    for group, nested in groups.items():
        verbs[group] = make_dataclass(group, [("verb", _one_of(nested))])
    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        arguments = ["--tyro-print-completion", options.shell]
        config = (*CONFIG, tyro.conf.OmitSubcommandPrefixes)
        tyro.cli(_one_of(verbs), prog="palpate", args=arguments, config=config)
    terminal.print(script.getvalue())
    return {"shell": options.shell, "script": script.getvalue()}


def _one_of(verbs: dict[str, Any]) -> Any:
    types = (Annotated[kind, tyro.conf.subcommand(name)] for name, kind in verbs.items())
    return reduce(or_, types)
