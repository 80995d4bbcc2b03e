"""Photos outside a manifest: their ids, and a check before anything is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from pathlib import Path

from palpate.core import PalpateError, Problem, ProblemsError
from palpate.data.images import SUFFIXES, check_image

MEND = "Correct or remove these photos, or skip the bad ones"
#: So many photos of so many bytes in all are checked in about a second.
FEW, FEW_BYTES = 64, 2**25


def photo_ids(photos: Path | Sequence[Path] | Mapping[str, Path]) -> dict[str, Path]:
    """Ids of photos: paths below a folder (sorted), or the file names of a list.

    Raises:
        PalpateError: if a folder is missing or two files have one name.
    """
    if isinstance(photos, Mapping):
        return {i: Path(p) for i, p in photos.items()}
    if isinstance(photos, Path) and photos.is_dir():
        if (photos / "palpate.json").is_file():
            got = f"{photos}, a saved model"
            raise PalpateError("must be images", got, "Pass it as the model", argument="photos")
        files = sorted(p for p in photos.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
        return {p.relative_to(photos).as_posix(): p for p in files}
    if isinstance(photos, Path) and not photos.is_file():
        got = f"no such path {photos}"
        raise PalpateError("must be a folder or files", got, "Check the path", argument="photos")
    table: dict[str, Path] = {}
    for path in map(Path, [photos] if isinstance(photos, Path) else photos):
        if path.name in table:
            got = f"{path.name!r} twice"
            fix = "Pass their common folder instead"
            raise PalpateError("must differ in name", got, fix, argument="photos")
        table[path.name] = path
    return table


def require_some(photos: Sized) -> None:
    """Reject an empty collection of photos.

    Raises:
        PalpateError: saying so.
    """
    if not len(photos):
        fix = "Check the folder, the split or the ids"
        raise PalpateError("There must be at least one photo", "none", fix)


def require_readable(photos: Path | Sequence[Path], fix: str = MEND) -> None:
    """Reject no photos at all, and broken ones where they are few.

    Many or large photos are not read here, since that would double the time that reading takes.

    Args:
        photos: a folder or files.
        fix: what to do about broken ones.

    Raises:
        PalpateError: if there are none, a folder is missing or two have one name.
        ProblemsError: naming every unreadable photo, if they are few.
    """
    paths = list(photo_ids(photos).values())
    require_some(paths)
    size = sum(p.stat().st_size for p in paths if p.is_file())
    if len(paths) > 1 and (len(paths) > FEW or size > FEW_BYTES):
        return
    reasons = ((path, check_image(path)) for path in paths)
    if bad := [Problem(str(path), "bad-image", reason) for path, reason in reasons if reason]:
        raise ProblemsError(bad, fix, example={"skip_bad": True})
