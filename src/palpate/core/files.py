"""Files that are either whole or absent, values as JSON, digests and seeds.

Files are written to a temporary sibling, flushed to the disk, then renamed. Digests are SHA-256
over canonical forms: equal content has one name, and a random draw depends on (seed, purpose,
sample), never on order.

What palpate reads back is checked before it is believed: an object in JSON holds its own digest,
see :func:`sealed`; for other files see :mod:`palpate.core.caches`.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from itertools import islice
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from palpate.core.messages import PalpateError

#: The error numbers of a full disk, a quota and a limit on file sizes.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: The key of an object's own digest.
SEAL = "sealed"

#: Format without its version -> what it is, and what reads it.
READERS = {
    "palpate-manifest": ("a manifest", "palpate audit"),
    "palpate-split": ("a split", "palpate audit DATA --split SPLIT"),
    "palpate-audit": ("an audit", "palpate report"),
    "palpate-results": ("results", "palpate report"),
    "palpate-generated": ("generated images", "palpate score --generated"),
    "palpate-clip": ("a vision and a text encoder", "palpate train encoder DATA --clip CLIP"),
    "palpate-encoders": ("encoders", "palpate probe --encoder"),
    "palpate-autoencoder": ("an autoencoder", "palpate train generator DATA --autoencoder DIR"),
    "palpate-pipeline": ("a generator", "palpate generate PHOTO --model DIR"),
    "palpate/preference": ("a study", "palpate preference score"),
    "palpate/preference-votes": ("votes", "palpate preference score"),
}
#: The files that tell of a folder what it is.
MARKS, MANIFEST = ("palpate.json", "index.json", "plan.json"), "manifest.parquet"
_VERSION = re.compile(r"[/@]\d+$")
#: Bytes of the largest file that is read at once, a table or list or JSON; some ten times as much
#: of memory.
LARGEST = 1 << 28


def plain(value: Any) -> Any:
    """Return ``value`` with only the types of JSON: dataclasses, paths and arrays are converted.

    NaN and infinity, which JSON has not, become null. Fields of dataclasses that are not compared
    are skipped.

    Raises:
        TypeError: for any other type.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = (field.name for field in dataclasses.fields(value) if field.compare)
        return {name: plain(getattr(value, name)) for name in fields}
    if isinstance(value, PurePath):
        return value.as_posix()
    raise TypeError(f"cannot put a {type(value).__name__} into JSON")


def fact_lines(rows: Mapping[str, Any]) -> list[str]:
    """Return one line per name, the values below each other; ``-`` for none."""
    width = max(map(len, rows), default=0)
    return [f"{name:<{width}}  {_as_text(value) or '-'}" for name, value in rows.items()]


def _as_text(value: Any) -> str:
    """Return a value as a person writes it: ``train 16, test 4`` for a mapping."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_as_text(cell)}" for name, cell in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_as_text, value))
    return "" if value is None else str(value)


def canonical_json(value: Any) -> str:
    """Return ``value`` as JSON with sorted keys and no spaces; dataclasses and paths are accepted.

    Raises:
        ValueError: for NaN or infinity, which JSON cannot hold.
    """
    return json.dumps(
        value,
        sort_keys=True,
        separators=(",", ":"),
        default=plain,
        allow_nan=False,
        ensure_ascii=False,
    )


def digest_json(value: Any) -> str:
    """Return the SHA-256 (64 hex digits) of the canonical JSON of ``value``."""
    return hashlib.sha256(canonical_json(value).encode(errors="surrogatepass")).hexdigest()


def digest_lines(lines: Iterable[str]) -> str:
    """Return the SHA-256 of the lines, each ended by a newline, in the order given."""
    state, rest = hashlib.sha256(), iter(lines)
    while block := list(islice(rest, 1 << 14)):  # line by line takes thrice as long
        state.update("\n".join([*block, ""]).encode(errors="surrogatepass"))
    return state.hexdigest()


def digest_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_folder(folder: Path, pattern: str = "**/*", *, without: str = "") -> str:
    """Return the SHA-256 over names and bytes of the files in ``folder`` that match ``pattern``.

    ``without``: name of a file of the folder that is left out.
    """
    files = sorted(p for p in folder.glob(pattern) if p.is_file() and p != folder / without)
    return digest_lines(f"{p.relative_to(folder).as_posix()} {digest_file(p)}" for p in files)


def short(digest: str) -> str:
    """Return the first 12 digits: enough for people and folder names."""
    return digest[:12]


def seed_for(seed: int, *names: str | int) -> int:
    """Return a 63-bit seed that depends on ``seed`` and ``names`` alone, on every machine."""
    text = "\x1f".join([str(int(seed)), *map(str, names)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """Return a NumPy generator for (seed, names), e.g. ``rng_for(0, "noise", sample_id)``."""
    return np.random.default_rng(seed_for(seed, *names))


def is_there(path: Path) -> bool:
    """Whether there is something at a path; a name that no file can have is none."""
    return os.path.exists(path)  # noqa: PTH110 - Path.exists raises for some names


def is_stream(path: Path) -> bool:
    """Whether there is something at ``path`` but neither a file nor a folder: a device, a pipe."""
    return path.exists() and not path.is_file() and not path.is_dir()


@contextmanager
def starting_to_write(path: Path) -> Generator[None]:
    """Raise what stops something from being written with the path that the user named."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        if error.errno in NO_ROOM:
            raise OSError(error.errno, reason, str(path)) from None
        fix = "Choose another path, or check its rights"
        raise PalpateError(f"{path} must be writable", reason, fix) from None


def _move(part: Path, final: Path, flush: bool) -> None:
    """Rename a file or folder, by default after all of it has reached the disk."""
    if flush:
        for path in (part, *part.rglob("*")):
            _flush(path)
    part.replace(final)
    if flush:
        _flush(final.parent)


def _flush(path: Path) -> None:
    if os.name != "posix" or not path.exists():  # Windows flushes only what is open to write
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError) if path.is_dir() else nullcontext():  # not on every network disk
            os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def atomic_path(path: Path, *, flush: bool = True) -> Generator[Path]:
    """Yield a temporary file to write to; rename it to ``path`` on success, else remove it.

    A device or a pipe is written to and never replaced; a link stays, and its target is replaced.

    Args:
        path: the file.
        flush: wait until it is on the disk, some milliseconds.

    Raises:
        OSError: if the disk is full.
        PalpateError: if nothing can be written there.
    """
    path = Path(path)
    with starting_to_write(path):
        stream = is_stream(path)  # the real path of a pipe names nothing
        final = path if stream else Path(os.path.realpath(path))
        if final.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        parent = Path(tempfile.gettempdir()) if stream else final.parent
        parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=parent, prefix=f".{final.name}.", suffix=final.suffix)
    os.close(handle)
    part = Path(name)
    part.chmod(0o644)
    try:
        yield part
        if stream:
            with open(part, "rb") as source, open(final, "wb") as target:
                shutil.copyfileobj(source, target)
        else:
            _move(part, final, flush)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path, *, flush: bool = True, instead: bool = False) -> Generator[Path]:
    """Yield a temporary folder to fill; rename it to ``folder`` on success, else remove it.

    Args:
        folder: absent or empty.
        flush: wait until all files are on the disk, some milliseconds each.
        instead: take the place of a folder with files.

    Raises:
        PalpateError: if ``folder`` is not empty, is the current folder, or is written by another
            process.
    """
    folder = Path(folder)
    if not instead:
        require_new_folder(folder)
    part = folder.parent / f".{folder.name}.part"
    with locked(part, folder):
        try:
            for stale in part.iterdir():  # of a run that was killed
                shutil.rmtree(stale) if stale.is_dir() else stale.unlink()
            yield part
            if folder.exists():
                shutil.rmtree(folder) if instead else folder.rmdir()
            _move(part, folder, flush)
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
        PalpateError: if another process holds it, it cannot be made, or a link leads out of it,
            through which another file would be written.
    """
    new = not folder.exists()
    with starting_to_write(output or folder):
        folder.mkdir(parents=True, exist_ok=True)
    for path in folder.rglob("*"):
        if path.is_symlink() and not inside(folder, path.relative_to(folder)):
            must = f"{output or folder} must hold no link out of it"
            raise PalpateError(must, str(path), "Choose another folder")
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


def sealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return an object for JSON with its own digest, which :func:`unsealed` checks.

    Raises:
        ValueError: for NaN or infinity, which JSON has not.
    """
    record = json.loads(json.dumps(record, default=plain, allow_nan=False))
    return {**record, SEAL: digest_json(record)}


def unsealed(record: Any) -> Any:
    """Return a value from JSON, an object without the digest that it may hold.

    Raises:
        ValueError: if that is of another object.
    """
    digest = record.pop(SEAL, None) if isinstance(record, dict) else None
    if digest is not None and digest != digest_json(record):
        raise ValueError("damaged: its digest is of another content")
    return record


def content_of(path: Path) -> bytes:
    """The bytes of a file that is read at once.

    Raises:
        OSError: if it cannot be read.
        PalpateError: if it is larger than any that can be.
    """
    size, must = path.stat().st_size, f"A file of text must have at most {LARGEST >> 20} MiB"
    if size > LARGEST:
        fix = "Check that it is the right one; write a large table in parts, or as Parquet"
        raise PalpateError(must, f"{path} of {size >> 20:,} MiB", fix)
    return path.read_bytes()


def read_json(path: Path, role: str) -> Any:
    """Read a JSON file, and check its digest if it is :func:`sealed`.

    Args:
        path: the file.
        role: its role, for the error (``"split file"``).

    Raises:
        PalpateError: if the file is missing, is too large, is not JSON, or is damaged.
    """
    require_regular(Path(path))
    try:
        value = json.loads(content_of(Path(path)).decode())
        # No NaN and no infinity, which JSON has not, and no halves of characters.
        json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
        return unsealed(value)
    except FileNotFoundError:
        got, fix = f"no file {path}", "Check the path"
        if Path(path).name in MARKS:
            got, fix = got_and_fix(Path(path).parent, got, fix)
        raise PalpateError(f"The {role} must exist", got, fix) from None
    except IsADirectoryError:
        got, fix = got_and_fix(Path(path), f"the folder {path}", "Name the file itself")
        raise PalpateError(f"The {role} must be a file", got, fix) from None
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, nested too deep
        got, fix = str(error), "Take a whole copy, or make it again in another folder"
        if isinstance(error, UnicodeDecodeError):  # no text at all: it may be a manifest
            got, fix = got_and_fix(Path(path), got, fix)
        raise PalpateError(f"The {role} {path} must be JSON", got, fix) from None


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
    record, fix = read_json(path, role), "Name another one, or copy its whole folder again"
    if not isinstance(record, dict):
        got = f"a {type(record).__name__}"
        raise PalpateError(f"The {role} {path} must be a JSON object", got, fix)
    forms = [form] if isinstance(form, str) else form
    if forms is not None and record.get("format") not in forms:
        got = repr(record.get("format"))
        fix = "Name another one, or install the release of palpate that wrote it"
        if _VERSION.sub("", str(record.get("format"))) != _VERSION.sub("", forms[0]):
            got, fix = got_and_fix(Path(path), got, fix)
        raise PalpateError(f"The {role} {path} must have the format {forms[0]}", got, fix)
    if missing := [name for name in keys if name not in record]:
        must = f"The {role} {path} must have the keys {', '.join(keys)}"
        raise PalpateError(must, f"no {', no '.join(missing)}", fix)
    return record


def kind_of(path: Path) -> tuple[str, str] | None:
    """What a file or folder that palpate wrote is, and what reads it; None for all else."""
    for file in [path / name for name in MARKS] if path.is_dir() else [path]:
        with suppress(OSError, ValueError, RecursionError, AttributeError, PalpateError):
            form = str(json.loads(content_of(file)).get("format"))
            if kind := READERS.get(_VERSION.sub("", form)):
                return kind
    manifest = path / MANIFEST if path.is_dir() else path
    there = manifest.name == MANIFEST and manifest.is_file()
    return READERS["palpate-manifest"] if there else None


def got_and_fix(path: Path, got: str, fix: str) -> tuple[str, str]:
    """Return ``got`` and ``fix`` of an error about a path that holds something else than it must.

    If palpate wrote it, they say what it is and which command reads it.
    """
    if (kind := kind_of(path)) is None:
        return got, fix
    return f"{path}, {kind[0]}", f"Name another one: this is for {kind[1]}"


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


def inside(root: Path, relative: str | Path) -> Path | None:
    """Return ``root / relative`` if that stays inside ``root`` (links resolved), else None."""
    root = Path(os.path.realpath(root))  # unlike Path.resolve, not stopped by a loop of links
    try:
        path = Path(os.path.realpath(root / relative))
    except ValueError:  # a zero character, half a character
        return None
    return path if path.is_relative_to(root) else None
