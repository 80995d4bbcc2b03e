"""Models inside the package: no file is fetched and the network is not used.

::

    palpate/mini/encoders/      vision, text and tactile (:mod:`palpate.encoders.encoder_set`);
                                clip/ in it is a plain CLIP folder
    palpate/mini/autoencoder/   autoencoder of tactile images (:mod:`palpate.diffusion.autoencoder`)
    palpate/mini/generator/     photo to tactile image (:mod:`palpate.diffusion.pipeline`); refers
                                to the other two by name and digest

A *string* that begins with ``palpate/`` is a shipped name, whatever lies in the working directory;
then comes a folder of that name, then a hub id. A folder ``palpate/mini`` is named
``./palpate/mini``, or passed as a :class:`pathlib.Path`, which is always a folder.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from palpate.core.errors import PalpateError

Part = Literal["clip", "encoders", "autoencoder", "generator"]
#: The shipped names, and the folder of each in :func:`shipped_root`.
SHIPPED = {"palpate/mini": "mini"}
#: Where the parts lie in the folder of a name.
PARTS: dict[Part, str] = {
    "clip": "encoders/clip",
    "encoders": "encoders",
    "autoencoder": "autoencoder",
    "generator": "generator",
}
_PREFIX = "palpate/"
_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


def shipped_root() -> Path:
    """Return the folder of the installed package, which holds the folders of :data:`SHIPPED`."""
    return Path(__file__).resolve().parents[1]


def is_shipped(name: str | Path) -> bool:
    """Return whether ``name`` refers to a shipped model, known or not."""
    return isinstance(name, str) and name.startswith(_PREFIX)


def shipped_folder(name: str | Path, part: Part) -> Path | None:
    """Return the folder of one part of a shipped model, or None where ``name`` is no shipped name.

    Args:
        name: a shipped name, a folder or a hub id.
        part: which of its models.

    Raises:
        PalpateError: for an unknown name that begins with ``palpate/``, or if the files are absent.
    """
    if not is_shipped(name):
        return None
    name = str(name)
    if name not in SHIPPED:
        must = f"A name that begins with {_PREFIX} must be one of {', '.join(SHIPPED)}"
        fix = f"Choose one of these; a folder of that name is written ./{name}"
        raise PalpateError(must, repr(name), fix)
    folder = shipped_root() / SHIPPED[name] / PARTS[part]
    if not (folder / "palpate.json").is_file():
        must, got = f"{name} must lie in the installed package", f"no {part} in {shipped_root()}"
        raise PalpateError(must, got, "Install palpate again, from its wheel")
    return folder


def is_hub_id(name: str | Path) -> bool:
    """Return whether ``name`` is a hub id: a string ``owner/name``, not shipped, no folder here."""
    return (
        isinstance(name, str)
        and not is_shipped(name)
        and bool(_HUB_ID.fullmatch(name))
        and not Path(name).is_dir()
    )
