"""Options of a world as a file, and the refusal of worlds that another version of palpate made.

A world of the same options but another ``VERSION`` has other pictures, so its digests would lie: such files and folders are refused, never guessed at.
Any finished world's ``world.json`` can be read, or a file of options alone::

    {"format": "palpate-world-options/1", "version": 2, "options": {"seed": 7, "size": 128}}
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, read_json, write_json
from palpate.sim.options import VERSION, WorldOptions

WORLD_FORMAT = "palpate-world/2"
OPTIONS_FORMAT = "palpate-world-options/1"


def save_options(options: WorldOptions, path: Path) -> None:
    """Writes the options with VERSION and digest."""
    settings = dataclasses.asdict(options)
    write_json(
        Path(path),
        {
            "format": OPTIONS_FORMAT,
            "version": VERSION,
            "options_digest": options.digest,
            "options": settings,
        },
    )


def load_options(path: Path) -> WorldOptions:
    """Reads options from a file that ``save_options`` wrote, from a ``world.json``, or from the folder of a world.

    Options that a file of options leaves out have their defaults.

    Raises:
        PalpateError: if the file is missing or no options, is of another version, has unknown options, or was changed since (where it has a digest).
        ProblemsError: if several options are out of range.
    """
    path = Path(path)
    path = path / "world.json" if path.is_dir() else path
    data = read_json(path, "file of a world's options")
    if isinstance(data, dict) and str(data.get("format", "")).startswith("palpate-world"):
        require_version(
            data, str(path)
        )  # first: another version may have another format, and the version says more
    if (
        not isinstance(data, dict)
        or data.get("format") not in (WORLD_FORMAT, OPTIONS_FORMAT)
        or not isinstance(data.get("options"), dict)
    ):
        got = (
            repr(data.get("format"))
            if isinstance(data, dict) and "format" in data
            else "something else"
        )
        must = f"{path} must be a world.json (format {WORLD_FORMAT}) or have the format {OPTIONS_FORMAT}"
        raise PalpateError(must, got, "Name the world.json of a finished world")
    known = [field.name for field in dataclasses.fields(WorldOptions)]
    for name in data["options"]:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            fix = f"Did you mean {near[0]!r}?" if near else f"Known: {', '.join(known)}"
            raise PalpateError(
                f"The options in {path} must be those of WorldOptions", repr(name), fix
            )
    options = WorldOptions(**data["options"])
    if "options_digest" in data and data["options_digest"] != options.digest:
        fix = "To change options, leave options_digest out of a copy, or use the command's own options"
        raise PalpateError(
            f"The digest in {path} must match its options", "options that were changed since", fix
        )
    return options


def require_version(data: Mapping[str, Any], what: str) -> None:
    """Refuses what another version of the world made.

    Args:
        data: with the key ``version``.
        what: names it in the message.

    Raises:
        PalpateError: if the version differs from VERSION, or is not told.
    """
    version = data.get("version")
    if version != VERSION:
        told = f"version {version}" if version is not None else "no version"
        fix = "The same options give other pictures in another version, so digests would lie: use the palpate that made it, or make it anew"
        raise PalpateError(
            f"{what} must be of version {VERSION} of the world, which this palpate makes", told, fix
        )
