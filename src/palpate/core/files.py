"""Files that are either whole or absent: written to a temporary sibling, then renamed."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from palpate.core.errors import PalpateError

#: The error numbers of a full disk, a quota and a limit on file sizes.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def is_stream(path: Path) -> bool:
    """Whether there is something at ``path`` but neither a file nor a folder: a device, a pipe."""
    return path.exists() and not path.is_file() and not path.is_dir()


@contextmanager
def atomic_path(path: Path) -> Generator[Path]:
    """Yield a temporary file to write to; rename it to ``path`` on success, else remove it.

    A device or a pipe is written to and never replaced; a link stays, and its target is replaced.

    Raises:
        OSError: if the disk is full.
        PalpateError: if nothing can be written there.
    """
    path = Path(path)
    try:
        stream = is_stream(path)  # the real path of a pipe names nothing
        final = path if stream else Path(os.path.realpath(path))
        if final.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        parent = Path(tempfile.gettempdir()) if stream else final.parent
        parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=parent, prefix=f".{final.name}.", suffix=final.suffix)
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
        if stream:
            with open(part, "rb") as source, open(final, "wb") as target:
                shutil.copyfileobj(source, target)
        else:
            part.replace(final)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Generator[Path]:
    """Yield a temporary folder to fill; rename it to ``folder`` on success, else remove it.

    Raises:
        PalpateError: if ``folder`` is not empty, is the current folder, or is written by another
            process.
    """
    folder = Path(folder)
    require_new_folder(folder)
    part = folder.parent / f".{folder.name}.part"
    with locked(part, folder):
        try:
            for stale in part.iterdir():  # of a run that was killed
                shutil.rmtree(stale) if stale.is_dir() else stale.unlink()
            yield part
            if folder.exists():
                folder.rmdir()
            part.replace(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def require_new_folder(folder: Path) -> None:
    """Check that a folder to be made is absent or empty, and is not the current folder.

    Raises:
        PalpateError: saying which.
    """
    fix = "Choose another folder or remove it"
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PalpateError(f"{folder} must be absent or an empty folder", "something there", fix)
    if folder.resolve() == Path.cwd():  # it is replaced when the new one is whole
        fix = "Name a folder within it"
        raise PalpateError(
            "A folder to write must have a name", f"the current folder {folder}", fix
        )


@contextmanager
def locked(folder: Path, output: Path | None = None) -> Generator[None]:
    """Make ``folder`` and hold it for one process; the lock ends with the process, also if killed.

    A folder that was made here and is empty at the end is removed.

    Args:
        folder: what to hold.
        output: what the user named, for the error; default: ``folder``.

    Raises:
        PalpateError: if another process holds it, or it cannot be made.
    """
    new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno in NO_ROOM:
            raise
        must, got = f"{output or folder} must be writable", error.strerror or str(error)
        raise PalpateError(must, got, "Choose another path, or check its rights") from None
    handle = -1
    try:
        import fcntl  # not on Windows, where a folder cannot be opened either

        handle = os.open(folder, os.O_RDONLY)
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        must, got = f"{output or folder} must be written by one run", "another run writes there"
        raise PalpateError(must, got, "Wait for it, or choose another folder") from None
    except (ImportError, OSError):  # Windows, a network disk without locks
        pass
    try:
        yield
    finally:
        if new:
            with suppress(OSError):
                folder.rmdir()
        if handle >= 0:
            os.close(handle)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    with atomic_path(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON atomically; ValueError for NaN and infinity, which JSON has not."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: Path, role: str) -> Any:
    """Read a JSON file.

    Args:
        path: the file.
        role: its role, for the error (``"split file"``).

    Raises:
        PalpateError: if the file is missing or is not JSON.
    """
    require_regular(Path(path))
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
        # No NaN and no infinity, which JSON has not, and no halves of characters.
        json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
        return value
    except FileNotFoundError:
        raise PalpateError(f"The {role} must exist", f"no file {path}", "Check the path") from None
    except IsADirectoryError:
        fix = "Name the file itself"
        raise PalpateError(f"The {role} must be a file", f"the folder {path}", fix) from None
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, nested too deep
        fix = "Write it again with palpate"
        raise PalpateError(f"The {role} {path} must be JSON", str(error), fix) from None


def read_record(
    path: Path, role: str, *, form: str | Sequence[str] | None = None, keys: Sequence[str] = ()
) -> dict[str, Any]:
    """Read a JSON object that a loader takes its settings from.

    Args:
        path: the file.
        role: its role, for the error (``"pipeline card"``).
        form: its ``format``, newest first where several are read; None: a foreign file without one.
        keys: keys that it must have.

    Raises:
        PalpateError: if the file is missing, is not JSON, or is no object of that format with
            those keys.
    """
    record, fix = read_json(path, role), "Name another folder, or copy the whole folder again"
    if not isinstance(record, dict):
        got = f"a {type(record).__name__}"
        raise PalpateError(f"The {role} {path} must be a JSON object", got, fix)
    forms = [form] if isinstance(form, str) else form
    if forms is not None and record.get("format") not in forms:
        got = repr(record.get("format"))
        fix = "Name another folder, or install the release of palpate that wrote it"
        raise PalpateError(f"The {role} {path} must have the format {forms[0]}", got, fix)
    if missing := [name for name in keys if name not in record]:
        must = f"The {role} {path} must have the keys {', '.join(keys)}"
        raise PalpateError(must, f"no {', no '.join(missing)}", fix)
    return record


@contextmanager
def reading_entry(path: Path, key: str) -> Generator[None]:
    """Raise what goes wrong inside, while a value of ``path`` is used, as a mistake in ``key``."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        must = f"{key} in {path} must be as palpate writes it"
        got = f"{type(error).__name__}: {error}"
        raise PalpateError(must, got, "Copy the whole folder again") from None


def require_regular(path: Path) -> None:
    """Check that an input is no pipe or device, which cannot be read twice.

    Raises:
        PalpateError: if it is one.
    """
    if is_stream(path):
        got, fix = f"{path}, a pipe or a device", "Write it to a file first"
        raise PalpateError("An input must be a file or a folder", got, fix)


def inside(root: Path, relative: str) -> Path | None:
    """Return ``root / relative`` if that stays inside ``root`` (links resolved), else None."""
    root = Path(os.path.realpath(root))  # unlike Path.resolve, not stopped by a loop of links
    try:
        path = Path(os.path.realpath(root / relative))
    except ValueError:  # a zero character, half a character
        return None
    return path if path.is_relative_to(root) else None
