"""``palpate view``: a data set or results to look at in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from palpate.cli.terminal import Common, PathArgument, Terminal, option_group


@option_group
class Options(Common):
    """Look at a data set or results in a browser, and touch photos, until Ctrl-C.

    The page is for who has its link. Nothing is kept: neither photos, nor touches, nor settings.
    """

    source: PathArgument
    """A data set, or the JSON of `palpate score -o`."""
    split: Path | None = None
    """Split whose parts color the samples."""
    model: str = "palpate/mini"
    """Generator that touches dropped photos; `none` for none."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 is reached from other machines."""
    port: int = 7860
    """Port to listen at; 0 for any free one."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Serve until stopped."""
    from palpate.viewing import view

    facts: dict[str, Any] = {}

    def ready(url: str) -> None:
        facts["url"] = url
        terminal.print(f"Open {url}")

    model = None if options.model == "none" else options.model
    view(ready=ready, **options.keywords(model=model))
    return facts
