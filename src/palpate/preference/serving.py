"""A study served over a network; the server itself, with its packages, loads when it is used."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from palpate.core import MissingExtraError
from palpate.preference.plan import Plan
from palpate.preference.votes import DATABASE


def serve(
    study: str | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    invite: int = 0,
    reinvite: Sequence[str] = (),
    until: str | None = None,
    ready: Callable[[str, Mapping[str, str]], None] = lambda url, tokens: None,
) -> None:
    """Serve a study until Ctrl-C; votes go to ``study.db`` in its folder.

    Args:
        study: its folder.
        host: address to listen at; the default is reached from this machine alone.
        port: 0 for any free one.
        invite: number of raters to invite now, in the order of the plan.
        reinvite: raters whose link is lost: they get another, and the former opens nothing.
        until: ISO date of the last day, instead of the plan's.
        ready: called with the URL and the new tokens by rater, which are kept nowhere else.

    Raises:
        MissingExtraError: without the extra ``preference``.
        PalpateError: if a rater cannot be invited, ``until`` is no date, or the address is taken.
    """
    plan = Plan.load(study)
    for package in ("starlette", "uvicorn"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(package, "preference", "The server of a study")
    from palpate.preference.server import serve as serve_page

    folder = Path(study) if Path(study).is_dir() else Path(study).parent
    serve_page(
        plan.public(),
        folder / DATABASE,
        host=host,
        port=port,
        invite=invite,
        reinvite=reinvite,
        until=until,
        ready=ready,
    )
