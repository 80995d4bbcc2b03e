"""Saved models by name: shipped with the package, in a local folder, or on the Hugging Face hub (see :mod:`palpate.core.shipped`).

From the hub, only JSON, text and safetensors are fetched; what was fetched once is found again without a network.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from huggingface_hub import snapshot_download
from huggingface_hub.utils import disable_progress_bars

from palpate.core import PalpateError
from palpate.core.shipped import SHIPPED, Part, is_hub_id, shipped_folder

#: What palpate's own folders hold.
PATTERNS = ("*.json", "*.txt", "*.md", "*.safetensors")


def find_model(source: str | Path, part: Part, what: str, fix: str) -> Path:
    """The local folder of a saved model, fetched from the hub if need be.

    Args:
        source: a shipped name, a folder, or a hub id; a :class:`~pathlib.Path` is always a folder.
        part: which part of a shipped model.
        what: the model's role, for the error (``"pipeline"``).
        fix: how to get one, for the error.

    Returns:
        A folder; one given as a path is not looked into.

    Raises:
        PalpateError: for an unknown shipped name, a string that is no folder and cannot be a hub id, or a hub out of reach.
    """
    if (shipped := shipped_folder(source, part)) is not None:
        return shipped
    if isinstance(source, Path) or (
        source and Path(source).is_dir()
    ):  # an empty name is not the folder that one is in
        return Path(source)
    if not is_hub_id(source):
        raise PalpateError(
            f"The {what} must be a folder, one of {', '.join(SHIPPED)}, or a hub id (owner/name)",
            f"no folder {source or repr('')}",
            fix,
        )
    return fetch(source, PATTERNS, what, fix)


def fetch(name: str, patterns: Sequence[str], what: str, fix: str) -> Path:
    """The local copy of the files of a hub repository that match ``patterns``.

    Raises:
        PalpateError: if the hub is out of reach or knows no such repository, and nothing was fetched before.
    """
    disable_progress_bars()
    try:
        return Path(snapshot_download(name, allow_patterns=list(patterns)))
    except (OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].removeprefix("Got: ")
        must = f"The {what} {name} must be a local folder, one of {', '.join(SHIPPED)}, or a hub id within reach"
        raise PalpateError(must, f"no such folder, and from the hub: {reason}", fix) from None
