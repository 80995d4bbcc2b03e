"""The call that made a result, written into it so that ``palpate verify`` can make it again.

In JSON, an argument that is a path is ``{"$path": path, "$digest": SHA-256}``: of a file, of the
table of a manifest, or of the weights of an encoder. Other folders, of images, have no digest
there; ``Call.digests`` has those of the images that were read. An argument that was in memory alone
(an array, a frame) is ``{"$object": type}``: nobody can read it again.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

from palpate.core.files import digest_file, digest_folder

PATH, DIGEST, ROWS, OBJECT = "$path", "$digest", "$rows", "$object"
#: Arguments that are names of files and folders, if there is something of that name.
FILES = (
    *("generated", "reference", "encoder", "split", "labels", "groups", "background", "inception"),
    *(
        "clip",
        "lpips",
        "data",
        "captions",
        "train",
        "train_or_data",
        "test",
        "pretrain",
        "root",
        "classes",
    ),
    *("study", "votes", "metrics", "splits"),
)
#: Arguments that change no number.
SILENT = ("progress", "cache", "threads")
#: What is read of a manifest's folder, next to images.
TABLE = "manifest.parquet"


@dataclass(frozen=True)
class Call:
    """A call of a public function.

    Attributes:
        verb: the verb of the command line that makes the same call: ``score``, ``probe`` ...
        arguments: those that are not the defaults, as JSON; see the head of this module.
        digests: SHA-256 of what was read, by role, e.g. ``generated ours``, ``tactile encoder``.
    """

    verb: str
    arguments: Mapping[str, Any]
    digests: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, verb: str, function: Callable[..., Any], arguments: Mapping[str, Any]) -> Call:
        """The call of ``function`` with the ``arguments``; their files are digested."""
        defaults = {n: p.default for n, p in inspect.signature(function).parameters.items()}
        recorded = {
            name: _recorded(value, name)
            for name, value in arguments.items()
            if name not in SILENT and not _is(value, defaults.get(name, inspect.Parameter.empty))
        }
        return cls(verb, recorded)

    def with_digests(self, digests: Mapping[str, Any]) -> Call:
        """The call with digests, nested ones by both names: ``{"generated": {"ours": ...}}``."""
        flat: dict[str, str] = {}
        for name, value in digests.items():
            if isinstance(value, Mapping):
                flat |= {f"{name} {key}": str(each) for key, each in value.items()}
            elif value is not None:
                flat[name] = str(value)
        return replace(self, digests=flat)

    def with_paths(self, change: Callable[[str], str]) -> Call:
        """The call with ``change`` applied to every path."""
        changed = {name: _changed(value, change) for name, value in self.arguments.items()}
        return replace(self, arguments=changed)


def _is(value: Any, default: Any) -> bool:
    """Whether an argument is the default; arrays and frames have no truth."""
    simple = (str, int, float, bool, tuple, list)
    plain = isinstance(value, simple) and isinstance(default, simple)
    return value is default or (plain and value == default)


def _recorded(value: Any, name: str) -> Any:
    if isinstance(value, Mapping | list | tuple) and name in ("labels", "groups"):
        return {OBJECT: type(value).__name__}  # one for each sample
    if isinstance(value, Mapping):
        return {str(key): _recorded(item, _role(str(key), name)) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_recorded(item, name) for item in value]
    if isinstance(value, PurePath) or (
        isinstance(value, str) and name in FILES and value and is_there(Path(value))
    ):
        return _recorded_path(Path(value), name)
    if value is None or isinstance(value, str | bool | int | float):
        return value
    root = getattr(value, "root", None)  # of a manifest: its folder, if that still says the same
    if isinstance(root, Path) and hasattr(value, "table") and (root / TABLE).is_file():
        return {**_recorded_path(root, name), ROWS: value.digest}
    return {OBJECT: type(value).__name__}


def _role(key: str, name: str) -> str:
    """Of a mapping name -> path the argument's role; of options those of the option."""
    return name if name in FILES else key


def _recorded_path(path: Path, name: str) -> dict[str, Any]:
    record: dict[str, Any] = {PATH: str(path)}
    if (digest := digest_of(path, name)) is not None:
        record[DIGEST] = digest
    return record


def is_there(path: Path) -> bool:
    """Whether there is something at a path; a name that no file can have is none."""
    return os.path.exists(path)  # noqa: PTH110 - Path.exists raises for some names


def digest_of(path: Path, name: str) -> str | None:
    """SHA-256 of the file, manifest or encoder that the argument ``name`` is; None of others.

    Images that are scored have digests of their own, of those that were read.
    """
    if path.is_file():
        return None if name in ("generated", "reference") else digest_file(path)
    if (path / TABLE).is_file():
        return digest_file(path / TABLE)
    weights = name in ("encoder", "clip") and path.is_dir()
    return digest_folder(path, "**/*.safetensors") if weights else None


def _changed(value: Any, change: Callable[[str], str]) -> Any:
    if isinstance(value, Mapping):
        return {
            key: change(item) if key == PATH and isinstance(item, str) else _changed(item, change)
            for key, item in value.items()
        }
    return [_changed(item, change) for item in value] if isinstance(value, list) else value
