"""Where a world is written: the folder that is meant, the hidden folder that it grows in, and the lock on that.

The lock is ``flock`` on a file within the unfinished world: the system lets go of it when its process ends, however that ends. Where there is no
``flock`` (Windows) nothing is locked.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from palpate.core import PalpateError, digest_json, read_json, short
from palpate.sim.materials.entries import added_materials
from palpate.sim.options import WorldOptions
from palpate.sim.saved import require_version
from palpate.sim.trees import WORK

LOCK = "lock"


def real_folder(out: Path) -> Path:
    """The folder that ``out`` stands for, links followed: it is replaced by the finished world.

    Raises:
        PalpateError: if ``out`` is a link to nothing.
    """
    fix = "Choose another folder or remove it"
    if out.is_symlink() and not out.exists():
        raise PalpateError(
            f"{out} must be absent, empty or a finished world", "a link to nothing", fix
        )
    try:
        return out.resolve()
    except (OSError, RuntimeError) as error:  # links in a circle
        raise PalpateError(f"{out} must be a path that can be followed", str(error), fix) from None


def require_free(out: Path, folder: Path) -> None:
    """Refuses a folder that cannot be replaced by a world.

    Args:
        out: the user's name for it.
        folder: that name resolved.

    Raises:
        PalpateError: if something is there, or it is the folder that this process stands in (which would be taken from under it).
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PalpateError(
            f"{out} must be absent, empty or a finished world",
            "something else there",
            "Choose another folder or remove it",
        )
    if folder.exists() and folder == Path.cwd().resolve():
        raise PalpateError(
            f"{out} must not be the folder that you are in",
            str(folder),
            "Name a folder within it, or go one up",
        )


def part_of(folder: Path, options: WorldOptions) -> Path:
    """The hidden sibling that a world grows in; another one for other options, or for materials that were added or edited."""
    added = added_materials(options.names)
    key = digest_json({"options": options.digest, "materials": added}) if added else options.digest
    return folder.parent / f".{folder.name}.{short(key)}.part"


def require_same_version(part: Path) -> None:
    """Refuses to start beside an unfinished world of the same name that another version of palpate began.

    Raises:
        PalpateError: naming its folder.
    """
    begin = part.name.rsplit(".", 2)[0]
    for other in sorted(part.parent.glob("*.part")) if part.parent.is_dir() else []:
        if (
            other.name.rsplit(".", 2)[0] != begin
            or not other.is_dir()
            or not any(p.name not in (WORK, LOCK) for p in other.rglob("*"))
        ):
            continue
        state = other / WORK / "state.json"
        data = read_json(state, "state of an unfinished world") if state.is_file() else {}
        if (other / "world.json").is_file():
            data = read_json(other / "world.json", "world record")
        require_version(
            data if isinstance(data, dict) else {},
            f"The unfinished world {other} (remove it to begin anew)",
        )


@contextmanager
def locked(part: Path, out: Path) -> Generator[None]:
    """Makes ``part`` and holds its lock.

    Raises:
        PalpateError: if another process, or another thread of this one, holds it.
    """
    (part / WORK).mkdir(parents=True, exist_ok=True)
    file = os.open(part / WORK / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _lock(file, out)
        yield
    finally:
        os.close(file)


def _lock(file: int, out: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not on Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise PalpateError(
            f"{out} must be written by one run",
            "another run is writing this world",
            "Wait for it, or stop it",
        ) from None
    except OSError:  # a file system without locks
        return
