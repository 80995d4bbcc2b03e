"""Files that are either whole or absent: everything is written beside its place and then renamed."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from palpate.core.errors import PalpateError

#: What a disk answers on which no room is left, or a quota or limit on file sizes.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_path(path: Path) -> Generator[Path]:
    """A temporary sibling of ``path`` to write to; renamed to ``path`` on success, removed on failure.

    Raises:
        OSError: if the disk is full.
        PalpateError: if nothing can be written there.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.name}.", suffix=path.suffix
        )
    except OSError as error:  # told with the user's path, not with that of the temporary file
        if error.errno in NO_ROOM:
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from None
        raise PalpateError(
            f"{path} must be writable",
            error.strerror or str(error),
            "Choose another path, or check its rights",
        ) from None
    os.close(handle)
    part = Path(name)
    part.chmod(0o644)
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Generator[Path]:
    """A temporary sibling folder to fill; renamed to ``folder`` on success, removed on failure.

    Raises:
        PalpateError: if ``folder`` exists and is not empty.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PalpateError(
            f"{folder} must be absent or an empty folder",
            "something there",
            "Choose another folder or remove it",
        )
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    part.chmod(0o755)
    try:
        yield part
        if folder.exists():
            folder.rmdir()
        part.replace(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Writes UTF-8 text atomically."""
    with atomic_path(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Writes indented JSON atomically; NaN and infinity are refused, as JSON has none."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: Path, what: str) -> Any:
    """Reads a JSON file.

    Args:
        path: the file.
        what: its role, for the error (``"split file"``).

    Raises:
        PalpateError: if the file is missing or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise PalpateError(f"The {what} must exist", f"no file {path}", "Check the path") from None
    except IsADirectoryError:
        raise PalpateError(
            f"The {what} must be a file", f"the folder {path}", "Name the file itself"
        ) from None
    except (
        ValueError,
        RecursionError,
    ) as error:  # no JSON, no UTF-8, a number of too many digits, too deep
        raise PalpateError(
            f"The {what} {path} must be JSON", str(error), "Write it again with palpate"
        ) from None


def read_record(
    path: Path, what: str, *, form: str | Sequence[str] | None = None, keys: Sequence[str] = ()
) -> dict[str, Any]:
    """Reads a JSON object that a loader takes its settings from.

    Args:
        path: the file.
        what: its role, for the error (``"pipeline card"``).
        form: what its ``format`` must be, newest first where several are read; None: a foreign file without one.
        keys: that it must have.

    Raises:
        PalpateError: if the file is missing, is not JSON, holds NaN or infinity, or is no object of that format with those keys.
    """
    record, fix = read_json(path, what), "Name another folder, or copy the whole folder again"
    if not isinstance(record, dict):
        raise PalpateError(
            f"The {what} {path} must be a JSON object", f"a {type(record).__name__}", fix
        )
    forms = [form] if isinstance(form, str) else form
    if forms is not None and record.get("format") not in forms:
        raise PalpateError(
            f"The {what} {path} must have the format {forms[0]}", repr(record.get("format")), fix
        )
    if missing := [name for name in keys if name not in record]:
        raise PalpateError(
            f"The {what} {path} must have the keys {', '.join(keys)}",
            f"no {', no '.join(missing)}",
            fix,
        )
    try:
        json.dumps(record, allow_nan=False)
    except ValueError as error:
        raise PalpateError(f"The {what} {path} must hold finite numbers", str(error), fix) from None
    return record


@contextmanager
def told_of(path: Path, key: str) -> Generator[None]:
    """What goes wrong inside while values of a file are used is told as a mistake in its entry ``key``."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        must = f"{key} in {path} must be as palpate writes it"
        raise PalpateError(
            must, f"{type(error).__name__}: {error}", "Copy the whole folder again"
        ) from None


def inside(root: Path, relative: str) -> Path | None:
    """``root / relative`` if that stays inside ``root`` (links resolved), else None."""
    root = root.resolve()
    path = (root / relative).resolve()
    return path if path.is_relative_to(root) else None
