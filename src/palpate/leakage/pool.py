"""Every distinct image of one modality in train and test, ready to be compared.

An image shows nothing if its strength is below a limit: the root mean square, in gray levels, of
what varies over 16 x 16 cells of the thumbnail faster than a plane, for tactile images after the
background is subtracted. The limit for tactile images is what pairs of backgrounds of one video
show, untouched gel at two times. Without a background an image is called untouched only where it
shows no more than the median image of its sensor does: contact is never hidden for want of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import Note, Progress, quiet
from palpate.data.manifest import Manifest
from palpate.leakage.neighbors import Floats, Ints
from palpate.leakage.thumbnails import SIDE, Thumbnails, thumbnails

#: Strength below which a photo shows nothing; bounds of the limit for tactile images.
BLANK_PHOTO, UNTOUCHED = 0.6, (0.3, 0.6)
#: Pairs of backgrounds that a limit needs, and how many are compared; images of a median.
PAIRS, MOST = 5, 500
#: Difference of the channels, in gray levels, up to which a thumbnail has no color.
COLORLESS = 2
#: What names images that may show one contact, the first that is known.
UNITS = ("video", "session", "object", "contact")
BLOCK = 1024


@dataclass
class Pool:
    """Distinct images of train and test together."""

    #: (n,) for each sample, train first, the number of its image; -1 if it cannot be read.
    item: Ints
    unit: Ints  # (n,) codes of what names related images, -1 where unknown
    pixels: NDArray[np.uint8]  # (u, 32, 32, 3) thumbnails of images and backgrounds
    images: Ints  # (items,) rows in ``pixels``; -1 without a background
    backgrounds: Ints
    blank: NDArray[np.bool_]  # (items,) whether an image shows nothing
    notes: list[Note] = field(default_factory=list)  # what a reader must know

    def colorless(self) -> NDArray[np.bool_]:
        """(items,) whether an image has no color."""
        red, green, blue = (
            self.pixels[..., c] for c in range(3)
        )  # quicker than over the last axis
        most = np.maximum(np.maximum(red, green), blue)
        spread = most - np.minimum(np.minimum(red, green), blue)
        return (spread.max(axis=(1, 2), initial=0) <= COLORLESS)[self.images]


def pool(
    train: Manifest,
    test: Manifest,
    modality: str,
    *,
    cache: Path | None,
    progress: Progress = quiet,
) -> Pool:
    """Decode one modality, ``vision`` or ``tactile``, of two manifests."""
    parts = (train, test)
    paths = _paths(parts, modality)
    behind = _paths(parts, "background") if modality == "tactile" else [None] * len(paths)
    thumbs = thumbnails([*paths, *behind], cache=cache, progress=progress)
    row, recorded = thumbs.row[: len(paths)], thumbs.row[len(paths) :]
    notes = _unreadable_notes(paths, row, thumbs, modality)
    unit = next(
        (u for c in UNITS if (u := codes(parts, c)).max(initial=-1) >= 0), codes(parts, "video")
    )
    item = np.full(len(paths), -1, np.int64)
    readable = row >= 0
    key = np.stack([row, recorded], axis=1)[readable]
    different, number = np.unique(key, axis=0, return_inverse=True)
    item[readable] = number.ravel()
    images, backgrounds = different[:, 0], different[:, 1]
    result = Pool(
        item, unit, thumbs.pixels, images, backgrounds, np.zeros(len(images), bool), notes
    )
    limit, pairs = BLANK_PHOTO, 0
    reference = backgrounds
    if modality == "tactile":
        limit, pairs = _untouched(thumbs.pixels, recorded, unit)
        sensor = np.zeros(len(images), np.int64)
        sensor[item[readable]] = codes(parts, "sensor")[readable]
        result.pixels, reference = _with_medians(thumbs.pixels, images, backgrounds, sensor)
    result.blank = strength(result.pixels, images, reference) < limit
    if count := int(result.blank[item[readable]].sum()):
        params = {"count": count, "of": len(item), "limit": round(limit, 2), "pairs": pairs}
        notes.append(Note("blank-images", params | {"modality": modality}))
    return result


def strength(pixels: NDArray[np.uint8], images: Ints, reference: Ints) -> Floats:
    """(n,) what images show beyond a plane and the image ``reference`` (none if -1), in levels."""
    at = np.linspace(-1, 1, SIDE // 2)
    plane = np.stack([np.ones(at.size**2), np.repeat(at, at.size), np.tile(at, at.size)], axis=1)
    basis = np.linalg.qr(plane)[0].astype(np.float32)
    out = np.empty(len(images), np.float32)
    for start in range(0, len(images), BLOCK):
        part = slice(start, start + BLOCK)
        x = pixels[images[part]].astype(np.float32)
        x -= (
            np.where(reference[part] >= 0, 1.0, 0.0).astype(np.float32)[:, None, None, None]
            * pixels[reference[part]]
        )
        x = x[:, ::2] + x[:, 1::2]
        x = (x[:, :, ::2] + x[:, :, 1::2]).reshape(len(x), -1, 3) / np.float32(4)
        x -= basis @ (basis.T @ x)
        out[part] = np.sqrt(np.square(x).mean(axis=(1, 2)))
    return out


def codes(parts: Sequence[Manifest], column: str) -> Ints:
    """One column of several manifests as numbers; -1 where null."""
    values = pl.concat([m.table[column] for m in parts])
    return values.rank("dense").cast(pl.Int64).fill_null(0).to_numpy() - 1


def _with_medians(
    pixels: NDArray[np.uint8], images: Ints, backgrounds: Ints, sensor: Ints
) -> tuple[NDArray[np.uint8], Ints]:
    """Thumbnails with medians of each sensor's images, for images without a background."""
    reference, more = backgrounds.copy(), [pixels]
    for code in np.unique(sensor[backgrounds < 0]).tolist():
        rows = images[sensor == code]
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST)).astype(np.int64)]
        reference[(backgrounds < 0) & (sensor == code)] = len(pixels) + len(more) - 1
        more.append(np.median(pixels[rows], axis=0).astype(np.uint8)[None])
    return np.concatenate(more) if len(more) > 1 else pixels, reference


def _untouched(pixels: NDArray[np.uint8], recorded: Ints, unit: Ints) -> tuple[float, int]:
    """The strength that untouched gel shows, and from how many pairs of backgrounds."""
    pairs = np.unique(np.stack([unit, recorded], axis=1)[(unit >= 0) & (recorded >= 0)], axis=0)
    first = np.flatnonzero(pairs[1:, 0] == pairs[:-1, 0])
    if len(first) < PAIRS:
        return UNTOUCHED[0], 0
    first = first[np.linspace(0, len(first) - 1, min(len(first), MOST)).astype(np.int64)]
    levels = strength(pixels, pairs[first, 1], pairs[first + 1, 1])
    return float(np.clip(1.5 * np.quantile(levels, 0.1), *UNTOUCHED)), len(first)


def _paths(parts: Sequence[Manifest], column: str) -> list[Path | None]:
    return [None if v is None else m.path(v) for m in parts for v in m.column(column)]


def _unreadable_notes(
    paths: Sequence[Path | None], row: Ints, thumbs: Thumbnails, modality: str
) -> list[Note]:
    """What cannot be compared, with the first three files of each kind."""
    notes: list[Note] = []
    named = {str(path) for path in paths}
    if absent := sum(path is None for path in paths):
        notes.append(
            Note("images-absent", {"count": absent, "of": len(paths), "modality": modality})
        )
    bad = [f"{Path(p).name}: {why}" for p, why in thumbs.unreadable.items() if p in named]
    if bad:
        params = {"count": int((row < 0).sum()) - absent, "modality": modality, "files": bad[:3]}
        notes.append(Note("images-unreadable", params))
    if gels := [Path(p).name for p in thumbs.unreadable if p not in named]:
        notes.append(Note("backgrounds-unreadable", {"count": len(gels), "files": gels[:3]}))
    return notes
