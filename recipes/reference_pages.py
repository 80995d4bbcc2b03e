"""Write the reference page of the commands, which is made from the code.

``make docs`` runs it before it builds the site; the page is not committed.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from pathlib import Path

from palpate.cli import VERBS, main

DOCS = Path(__file__).resolve().parents[1] / "docs" / "reference"


def help_of(verb: str) -> str:
    """The help text of a verb at 96 columns, without boxes."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*verb.split(), "--help"])
    lines = (re.sub(r"^[│╭╰]|[│╭╮╰╯─]", "", line).rstrip() for line in text.getvalue().splitlines())
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip("\n")


def commands() -> str:
    """The page of all commands."""
    lines = ["# Commands", "", "What `palpate VERB --help` prints.", ""]
    for name, verb in VERBS.items():
        lines += [
            f"## palpate {name}",
            "",
            f"{verb.help}.",
            "",
            "```text",
            help_of(name),
            "```",
            "",
        ]
    return "\n".join(lines)


def write(folder: Path) -> None:
    """Write the page."""
    os.environ["COLUMNS"] = "96"
    (folder / "commands.md").write_text(commands(), encoding="utf-8")


if __name__ == "__main__":
    write(DOCS)
