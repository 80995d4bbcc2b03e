"""``palpate validate``: check a data set without writing anything."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import tyro

from palpate.cli.importing import SourceOptions
from palpate.cli.terminal import Switch, Terminal, option_group
from palpate.core import require


@option_group
class Options(SourceOptions):
    """Check a data set: facts, and what is missing, invalid or suspicious. Nothing is written.

    The exit status is 1 if something is missing or invalid.
    """

    source: Annotated[Path | None, tyro.conf.Positional] = None
    """Root of the data set, a table, or with `--format hf` a name on the hub."""
    show_list: Annotated[Switch, tyro.conf.arg(name="list")] = False
    """Show the known formats, their facts and their options."""


def run(options: Options, terminal: Terminal) -> Any:
    """Validate and print the result."""
    from palpate.data import validate

    if options.show_list:
        return _formats(terminal)
    fix = "See the formats: palpate validate --list"
    require(options.source is not None, "source", "must be named", "none", fix=fix)
    return terminal.run(validate, **options.keywords("show_list"))


def _formats(terminal: Terminal) -> dict[str, Any]:
    """Print facts and options of every format; return them."""
    from palpate.data.formats import FORMATS
    from palpate.data.imported import readable

    formats: dict[str, Any] = {}
    for name, form in FORMATS.items():
        options = [o for o in form.options if o not in ("skip_bad", "check", "progress")]
        about = {"looks for": form.looks_for, "options": ", ".join(options) or None}
        terminal.facts(name, readable(form.facts) | about)
        formats[name] = asdict(form.facts) | {"looks_for": form.looks_for, "options": options}
    return formats
