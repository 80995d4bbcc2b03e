"""The Hugging Face hub: what is fetched from it by name, and what is put there with its card.

A hub id is ``owner/name``, or ``owner/name@revision`` for a branch, tag or commit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, TypedDict, Unpack

from palpate.core.messages import MissingExtraError, PalpateError

HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*(@\w[\w./-]*)?")
Kind = Literal["model", "dataset"]


def _hub() -> Any:
    try:
        import huggingface_hub
    except ImportError:
        must = "Names on the Hugging Face hub must find the package huggingface_hub"
        raise MissingExtraError("torch", must, "none installed") from None
    return huggingface_hub


def at_revision(name: str | Path, revision: str | None) -> str | Path:
    """``name@revision``; the name alone without one."""
    return name if revision is None else f"{name}@{revision}"


def fetch(name: str, files: Sequence[str], role: str, fix: str, kind: Kind = "model") -> Path:
    """The local folder of a hub id, with the files of these patterns.

    Raises:
        PalpateError: if the hub is out of reach, or has none of that name.
    """
    hub = _hub()
    hub.utils.disable_progress_bars()
    owner, _, revision = name.partition("@")
    try:
        folder = hub.snapshot_download(
            owner, allow_patterns=list(files), revision=revision or None, repo_type=kind
        )
        return Path(folder)
    except (OSError, ValueError) as error:
        must = f"The {role} {name} must be a hub id within reach, a local folder or a shipped model"
        got = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise PalpateError(must, got.removeprefix("Got: "), fix) from None


def fetched_file(source: str | Path, file: str, role: str, fix: str) -> Path:
    """The path itself, or the file of a data set on the hub where it is a hub id."""
    named = isinstance(source, str) and HUB_ID.fullmatch(source) and not source.endswith(".json")
    if not named or Path(source).exists():
        return Path(source)
    return fetch(str(source), [file], role, fix, "dataset") / file


class PushOptions(TypedDict, total=False):
    """What ``push_to_hub`` takes by name.

    Attributes:
        private: whether the place is, if it is made; default: as the owner has it.
        revision: branch to commit to; made if it is not there.
        token: default: that of ``hf auth login``.
    """

    private: bool | None
    revision: str | None
    token: str | None


def push(
    write: Callable[[Path], object],
    name: str,
    *,
    kind: Kind = "model",
    **options: Unpack[PushOptions],
) -> str:
    """Put what ``write`` writes into a new folder on the hub, and return its address.

    Args:
        write: called with the path of a folder that is not there yet, and makes it.
        name: ``owner/name``; made if it is not there.
        kind: ``model`` or ``dataset``.
        options: ``private``, ``revision``, ``token``.

    Raises:
        PalpateError: if the hub is out of reach or rejects it.
    """
    hub = _hub()
    private, revision = (options.get(key) for key in ("private", "revision"))
    api = hub.HfApi(token=options.get("token"))
    try:
        with TemporaryDirectory() as parent:
            folder = Path(parent) / "pushed"
            write(folder)
            made = api.create_repo(name, repo_type=kind, private=private, exist_ok=True)
            if revision is not None:
                api.create_branch(made.repo_id, branch=revision, repo_type=kind, exist_ok=True)
            api.upload_folder(
                repo_id=made.repo_id, folder_path=folder, repo_type=kind, revision=revision
            )
    except (OSError, ValueError) as error:
        must, fix = f"{name} must be a place on the hub that you may write to", "hf auth login"
        got = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise PalpateError(must, got, fix) from None
    return str(made)


def write_card(folder: Path, title: str, text: str, tags: Sequence[str]) -> None:
    """The ``README.md`` of a data set on the hub, whose license its owner has to say."""
    from palpate.core.files import write_text  # late: files that the hub gives are read by others

    head = "".join(f"- {tag}\n" for tag in ("palpate", "tactile", *tags))
    write_text(folder / "README.md", f"---\ntags:\n{head}---\n\n# {title}\n\n{text}\n")
