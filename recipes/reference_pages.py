"""Write the reference pages that are made from the code: commands and options of a world.

``make docs`` runs it before it builds the site; the pages are not committed.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from pathlib import Path

from palpate.cli import VERBS, main
from palpate.sim import MATERIALS
from palpate.sim.options import option_groups

DOCS = Path(__file__).resolve().parents[1] / "docs" / "reference"
GROUPS = {
    "world": "The world and its lists",
    "amounts": "Amounts",
    "physics": "Objects, gel and press (lengths in mm)",
    "photos": "Photos",
}


def number(value: object) -> str:
    """Return a default or a limit as text."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def world_options() -> str:
    """The page of :class:`palpate.sim.WorldOptions`."""
    lines = [
        "# Options of a world",
        "",
        "Fields of `palpate.sim.WorldOptions`; `palpate world` has an option for each. Presets "
        "differ from these defaults. Where two numbers are the default, values are drawn between "
        "them, or one of them is drawn.",
    ]
    for group, title in GROUPS.items():
        lines += [
            "",
            f"## {title}",
            "",
            "| option | default | allowed | meaning |",
            "|---|---|---|---|",
        ]
        for field in option_groups()[group]:
            limits, default = field.metadata, field.default
            values = default if isinstance(default, tuple) else (default,)
            allowed = {
                "choice": ", ".join(f"`{c}`" for c in limits.get("choices", ())),
                "materials": f"1 .. {len(MATERIALS)}, or names",
            }.get(limits["kind"]) or f"{number(limits['low'])} .. {number(limits['high'])}"
            shown = ", ".join(map(number, values))
            lines.append(f"| `{field.name}` | {shown} | {allowed} | {limits['help']} |")
    return "\n".join(lines) + "\n"


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


PAGES = {"world_options.md": world_options, "commands.md": commands}


def write(folder: Path) -> None:
    """Write both pages."""
    os.environ["COLUMNS"] = "96"
    for name, page in PAGES.items():
        (folder / name).write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    write(DOCS)
