"""Images as thumbnails of 32 x 32 pixels in RGB, 3 kB each.

They are squashed to a square on purpose: quarter turns and mirrors then permute pixels.

Each distinct file is decoded once, a JPEG at the smallest scale that libjpeg offers above 128
pixels (Pillow's ``draft``). Equal thumbnails are kept once. Files that are cut, empty or no images
are listed, not raised: an audit goes on without them. With a cache, thumbnails are written in
pieces of 1,024 files, so that a run that was stopped goes on where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import PalpateError, Progress, cached, digest_json, quiet, short
from palpate.data.images import file_stamp, in_threads, read_image

VERSION = 5
SIDE = 32
#: Files of one cached piece.
PIECE = 1024
#: Files that a thread decodes at a time: handing over each costs as much as decoding it.
AT_ONCE = 32
#: A JPEG is decoded at no less than this: libjpeg's reduction aliases, and faint contacts drown in
#: that where a copy is edited.
DRAFT = 128

#: Thumbnails of some files, and which of the files cannot be read, with the reason.
Decoded = tuple[NDArray[np.uint8], dict[int, str]]


@dataclass(frozen=True)
class Thumbnails:
    """Different images, decoded."""

    #: (n,) the thumbnail of each path; -1 without a path or where it cannot be read.
    row: NDArray[np.int64]
    pixels: NDArray[np.uint8]  # (u, 32, 32, 3) 0 to 255, all different
    unreadable: dict[str, str]  # path -> reason


def thumbnail(path: Path) -> NDArray[np.uint8] | str:
    """One image, (32, 32, 3); or why it cannot be read."""
    try:
        image = read_image(path, (DRAFT, DRAFT))
    except PalpateError as error:
        return error.got
    return np.asarray(image.resize((SIDE, SIDE), Image.Resampling.BOX))


def thumbnails(
    paths: Sequence[Path | None], *, cache: Path | None = None, progress: Progress = quiet
) -> Thumbnails:
    """Decode every distinct path once.

    Args:
        paths: (n,) files; None where a sample has no image.
        cache: folder for the pieces; their names change with paths, file sizes and modification
            times, so another split of the same files uses them. None keeps nothing.
        progress: called with the number of files done.
    """
    names = [None if path is None else str(path) for path in paths]  # hashed quicker than paths
    files = [Path(name) for name in sorted({name for name in names if name is not None})]
    rows: dict[bytes, int] = {}
    different: list[NDArray[np.uint8]] = []
    row_of: dict[str | None, int] = {None: -1}
    unreadable: dict[str, str] = {}
    for start in range(0, len(files), PIECE):
        progress("decoding images", start, len(files))
        piece = files[start : start + PIECE]
        pixels, reasons = _piece(piece, cache, progress)
        unreadable.update({str(piece[k]): reason for k, reason in sorted(reasons.items())})
        for k, name in enumerate(map(str, piece)):
            if k in reasons:
                row_of[name] = -1
                continue
            row_of[name] = rows.setdefault(pixels[k].tobytes(), len(rows))
            if row_of[name] == len(different):
                different.append(pixels[k].copy())
    progress("decoding images", len(files), len(files))
    row = np.array([row_of[name] for name in names], np.int64)
    empty = np.zeros((0, SIDE, SIDE, 3), np.uint8)
    return Thumbnails(row, np.stack(different) if different else empty, unreadable)


def _piece(files: Sequence[Path], cache: Path | None, progress: Progress) -> Decoded:
    """Thumbnails of some files, from the cache if they are there."""
    if cache is None:
        return _decode(files)
    key = digest_json([VERSION, [[str(path), *file_stamp(path)] for path in files]])

    def decode(part: Path) -> None:
        pixels, bad = _decode(files)
        why = np.array([*bad.values()], str)
        with open(part, "wb") as file:
            np.savez(file, pixels=pixels, bad=np.array(list(bad), int), why=why)

    return cached(cache / f"thumbnails-{short(key)}.npz", decode, _stored, progress)


def _stored(file: Path) -> Decoded:
    with np.load(file, allow_pickle=False) as piece:
        reasons = zip(piece["bad"].tolist(), piece["why"].tolist(), strict=True)
        return piece["pixels"], dict(reasons)


def _decode(files: Sequence[Path]) -> Decoded:
    pixels, reasons = np.zeros((len(files), SIDE, SIDE, 3), np.uint8), dict[int, str]()
    starts = range(0, len(files), AT_ONCE)
    some = lambda k: [thumbnail(file) for file in files[k : k + AT_ONCE]]
    for start, results in in_threads(some, starts):
        for k, result in enumerate(results, start):
            if isinstance(result, str):
                reasons[k] = result
            else:
                pixels[k] = result
    return pixels, reasons
