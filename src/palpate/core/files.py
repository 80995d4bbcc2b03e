"""Files that are either whole or absent: written to a temporary sibling, then renamed."""

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

#: The error numbers of a full disk, a quota and a limit on file sizes.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_path(path: Path) -> Generator[Path]:
    """Yield a temporary file to write to; rename it to ``path`` on success, else remove it.

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
    except OSError as error:  # name the user's path, not the temporary one
        reason = error.strerror or str(error)
        if error.errno in NO_ROOM:
            raise OSError(error.errno, reason, str(path)) from None
        fix = "Choose another path, or check its rights"
        raise PalpateError(f"{path} must be writable", reason, fix) from None
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
    """Yield a temporary folder to fill; rename it to ``folder`` on success, else remove it.

    Raises:
        PalpateError: if ``folder`` exists and is not empty.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        fix = "Choose another folder or remove it"
        raise PalpateError(f"{folder} must be absent or an empty folder", "something there", fix)
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
    """Write UTF-8 text atomically."""
    with atomic_path(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON atomically; ValueError for NaN and infinity, which JSON has not."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file.

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
        fix = "Name the file itself"
        raise PalpateError(f"The {what} must be a file", f"the folder {path}", fix) from None
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, nested too deep
        fix = "Write it again with palpate"
        raise PalpateError(f"The {what} {path} must be JSON", str(error), fix) from None


def read_record(
    path: Path, what: str, *, form: str | Sequence[str] | None = None, keys: Sequence[str] = ()
) -> dict[str, Any]:
    """Read a JSON object that a loader takes its settings from.

    Args:
        path: the file.
        what: its role, for the error (``"pipeline card"``).
        form: its ``format``, newest first where several are read; None: a foreign file without one.
        keys: keys that it must have.

    Raises:
        PalpateError: if the file is missing, is not JSON, or is no object of that format with
            those keys.
    """
    record, fix = read_json(path, what), "Name another folder, or copy the whole folder again"
    if not isinstance(record, dict):
        got = f"a {type(record).__name__}"
        raise PalpateError(f"The {what} {path} must be a JSON object", got, fix)
    forms = [form] if isinstance(form, str) else form
    if forms is not None and record.get("format") not in forms:
        got = repr(record.get("format"))
        raise PalpateError(f"The {what} {path} must have the format {forms[0]}", got, fix)
    if missing := [name for name in keys if name not in record]:
        must = f"The {what} {path} must have the keys {', '.join(keys)}"
        raise PalpateError(must, f"no {', no '.join(missing)}", fix)
    try:
        json.dumps(record, allow_nan=False)
    except ValueError as error:
        raise PalpateError(f"The {what} {path} must hold finite numbers", str(error), fix) from None
    return record


@contextmanager
def reading_entry(path: Path, key: str) -> Generator[None]:
    """Raise what goes wrong inside, while a value of ``path`` is used, as a mistake in ``key``."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        must, got = (
            f"{key} in {path} must be as palpate writes it",
            f"{type(error).__name__}: {error}",
        )
        raise PalpateError(must, got, "Copy the whole folder again") from None


def inside(root: Path, relative: str) -> Path | None:
    """Return ``root / relative`` if that stays inside ``root`` (links resolved), else None."""
    root = root.resolve()
    path = (root / relative).resolve()
    return path if path.is_relative_to(root) else None
