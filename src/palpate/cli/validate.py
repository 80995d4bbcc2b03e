"""``palpate validate``: looks a data set over without writing anything."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.importing import (
    FLAGS,
    SourceOptions,
    described,
    format_options,
    list_problems,
    source_options,
)
from palpate.cli.terminal import FAILED_CHECK, Terminal
from palpate.core import PalpateError, Problem

List = Annotated[
    bool,
    tyro.conf.arg(
        name="list",
        help="Tell the known formats, their facts and their options, and look at nothing.",
    ),
]
Kind = Literal["missing", "invalid", "suspicious"]


@dataclass(frozen=True, kw_only=True)
class Options(SourceOptions):
    """Look a data set over: facts, and what is missing, invalid or suspicious. Nothing is written.

    The exit status is 1 if it fails.
    """

    source: Annotated[Path | None, tyro.conf.Positional] = None
    """Root of the data set, a table, or with `--format hf` a name on the hub."""
    fail_on: tuple[Kind, ...] = ("missing", "invalid")
    """What makes it fail."""
    show_list: List = False


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Validates and prints what was found."""
    from palpate.data.formats import FORMATS
    from palpate.data.importing import validate_dataset

    if options.show_list:
        return {name: _show(name, terminal) for name in FORMATS}, 0
    if options.source is None:
        raise PalpateError(
            "A validation needs a SOURCE",
            "none",
            "E.g. palpate validate touch_and_go/, or palpate validate --list",
        )
    given = source_options(options, options.source)
    with terminal.progress() as progress:
        found = validate_dataset(
            options.source,
            format=options.format,
            check=options.check,
            progress=progress,
            **_of_scan(options, given),
        )
    lists: dict[str, Sequence[Problem]] = {
        "missing": found.missing,
        "invalid": found.invalid,
        "suspicious": found.suspicious,
    }
    failed = [kind for kind in dict.fromkeys(options.fail_on) if lists[kind]]
    counts = {
        "format": found.format,
        "samples": found.samples,
        **{kind: len(problems) for kind, problems in lists.items()},
    }
    facts = asdict(found.facts)
    terminal.facts(f"Validated {options.source}", counts | _readable(facts))
    for kind, problems in lists.items():
        list_problems(kind.capitalize(), problems, terminal.print)
    terminal.print(
        f"Not whole: {', '.join(failed)}."
        if failed
        else "Whole."
        if found.ok
        else "Passed, though not whole."
    )
    data = counts | {kind: [asdict(p) for p in problems] for kind, problems in lists.items()}
    return data | {"ok": found.ok, "failed": failed, "facts": facts}, FAILED_CHECK if failed else 0


def _of_scan(options: Options, given: dict[str, Any]) -> dict[str, Any]:
    """The given options without those that matter to an import only, which may stand in the same command line."""
    from palpate.data.formats import FORMATS

    if options.source is None:
        return given
    name = (
        options.format
        if options.format != "auto"
        else next((n for n, f in FORMATS.items() if f.detect(options.source)), "")
    )
    if name not in FORMATS:
        return given
    scan = inspect.signature(FORMATS[name].scan).parameters
    return {
        key: value
        for key, value in given.items()
        if key in scan or key not in FORMATS[name].options
    }


def _show(name: str, terminal: Terminal) -> dict[str, Any]:
    """Prints a format's facts and options; returns them."""
    from palpate.data.formats import FORMATS

    facts = asdict(FORMATS[name].facts)
    options = {key: described(kind) for key, kind in format_options(name).items()}
    flags = [
        flag
        for key, flag in FLAGS.items()
        if key in FORMATS[name].options and key not in ("check", "skip_bad", "progress")
    ]
    told = _readable(facts) | {
        "looks for": FORMATS[name].looks_for,
        "flags": " ".join(flags) or None,
    }
    told |= {f"--set {key}=": kind for key, kind in options.items()}
    terminal.facts(name, told)
    return facts | {"looks_for": FORMATS[name].looks_for, "options": options, "flags": flags}


def _readable(facts: dict[str, Any]) -> dict[str, Any]:
    """Facts for people."""
    size = facts["image_size"]
    told = {k: v for k, v in facts.items() if k not in ("normalization", "samples")} | {
        "published": facts["samples"],
        "image_size": f"{size[0]} x {size[1]}" if size else None,
    }
    normalization: dict[str, Any] = facts["normalization"]
    return told | {
        f"mean, std of {name}": f"{mean}, {std}" for name, (mean, std) in normalization.items()
    }
