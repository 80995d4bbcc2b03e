"""Photos outside a manifest: their ids, and a look at them before anything is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from pathlib import Path

from palpate.core import PalpateError, Problem, ProblemsError
from palpate.data.images import SUFFIXES, check_image

MEND = "Mend or remove these photos, or pass --skip-bad"
#: Photos that are so few, and so small in all, that reading them once more takes about a second.
FEW, FEW_BYTES = 64, 2**25


def photo_ids(photos: Path | Sequence[Path] | Mapping[str, Path]) -> dict[str, Path]:
    """Ids of photos: paths below a folder (sorted), or file names of a list.

    Raises:
        PalpateError: if a folder is missing or two files have one name.
    """
    if isinstance(photos, Mapping):
        return {i: Path(p) for i, p in photos.items()}
    if isinstance(photos, Path):
        if photos.is_file():
            return {photos.name: photos}
        if not photos.is_dir():
            raise PalpateError(
                "The photos must be a folder or files", f"no such path {photos}", "Check the path"
            )
        if (photos / "palpate.json").is_file():
            raise PalpateError(
                "The photos must be a folder of images",
                f"{photos}, a saved model",
                "Pass models with --model",
            )
        files = sorted(p for p in photos.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
        return {p.relative_to(photos).as_posix(): p for p in files}
    table: dict[str, Path] = {}
    for path in map(Path, photos):
        if path.name in table:
            raise PalpateError(
                "Photos in a list must differ in name",
                f"{path.name!r} twice",
                "Pass their common folder instead",
            )
        table[path.name] = path
    return table


def require_some(photos: Sized) -> None:
    """Refuses an empty collection of photos.

    Raises:
        PalpateError: saying so.
    """
    if not len(photos):
        raise PalpateError(
            "There must be at least one photo", "none", "Check the folder, the split or the ids"
        )


def require_readable(photos: Path | Sequence[Path], fix: str = MEND) -> None:
    """Refuses no photos at all, and broken ones where they are few.

    Many photos, or large ones, are not read here: that would double the time that reading takes.

    Args:
        photos: a folder or files.
        fix: what to do about broken ones.

    Raises:
        PalpateError: if there are none, a folder is missing or two have one name.
        ProblemsError: naming every unreadable photo, if they are few.
    """
    paths = list(photo_ids(photos).values())
    require_some(paths)
    if len(paths) > 1 and (
        len(paths) > FEW or sum(p.stat().st_size for p in paths if p.is_file()) > FEW_BYTES
    ):
        return
    if bad := [
        Problem(str(p), "bad-image", reason)
        for p in paths
        if (reason := check_image(p)) is not None
    ]:
        raise ProblemsError(bad, fix)
