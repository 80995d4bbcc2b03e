"""``palpate preference serve``: a study over a network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from palpate.cli.terminal import Common, PathArgument, Terminal, option_group


@option_group
class Options(Common):
    """Serve the page of a study and keep the votes, until Ctrl-C.

    Every rater has a link of their own, which is printed once and kept nowhere; votes are in
    study.db in the folder of the study, and each is on disk before it is acknowledged.
    """

    study: PathArgument
    """Folder of palpate preference make."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 is reached from other machines."""
    port: int = 8080
    """Port to listen at; 0 for any free one."""
    invite: int = 0
    """Invite this many further raters now, and print their links."""
    reinvite: tuple[str, ...] = ()
    """Raters whose link is lost, e.g. r03: print another; the former opens nothing."""
    until: str | None = None
    """Last day whose votes count, instead of the plan's."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Serve until stopped."""
    from palpate.preference import serve

    facts: dict[str, Any] = {}

    def ready(url: str, tokens: Mapping[str, str]) -> None:
        links = {rater: f"{url}?token={token}" for rater, token in tokens.items()}
        facts.update({"url": url, "invitations": links})
        terminal.print(f"Serving {options.study} at {url}")
        for rater, link in links.items():
            terminal.print(f"  {rater}  {link}")

    serve(ready=ready, **options.keywords(reinvite=options.reinvite))
    return facts
