"""Every distinct image of one modality in train and test, ready to be compared.

An image is blank where it shows nothing: a photo without any structure (a lens cap, a black frame),
a tactile image that differs from its background no more than the passive gel differs from itself.
The strength of an image is the root mean square of its band-passed thumbnail in gray levels; the
limit for tactile images comes from pairs of different backgrounds of one video (without videos, of
each and the one most similar to it), which show untouched gel at two times, as 1.5 times the 10 %
quantile of their strength (the others may hold the beginning of a contact), within 0.3 and 1.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import Note, Progress, quiet
from palpate.data.manifest import Manifest
from palpate.leakage.background import Backgrounds, backgrounds, planar, remove_background
from palpate.leakage.correlation import Floats, Ints, band_pass, even, rms, smooth
from palpate.leakage.neighbors import other_nearest
from palpate.leakage.thumbnails import SIDE, Thumbnails, thumbnails

#: Strength below which a photo shows nothing.
BLANK_PHOTO = 0.6
#: Bounds of the limit for tactile images; the upper one where no two backgrounds are known.
BLANK_TACTILE = (0.3, 1.1)
#: Local contrast in gray levels up to which an image counts less: noise and compression.
FLOOR = {"vision": 3.0, "tactile": 20.0}
#: Pairs of backgrounds that a limit needs, and how many are compared.
PAIRS, MOST_PAIRS = 5, 2000
BLOCK = 1024


@dataclass
class Pool:
    """Distinct images of train and test together.

    Attributes:
        modality: ``vision`` or ``tactile``.
        item: (n,) for each sample, train first, the number of its image; -1 if it cannot be read.
        videos: (n,) codes; -1 where unknown.
        pixels: (u, 32, 32, 3) thumbnails of images and backgrounds.
        thumb: (items,) row of each image in ``pixels``.
        backgrounds: of all samples, for tactile images.
        behind: (items,) row of each image in ``backgrounds.pixels``.
        images: (items, 3, 32, 32) band-passed, each scaled to 127.
        blank: (items,) whether an image shows nothing.
        notes: what a reader must know.
    """

    modality: str
    item: Ints
    videos: Ints
    pixels: NDArray[np.uint8]
    thumb: Ints
    backgrounds: Backgrounds | None
    behind: Ints
    notes: list[Note] = field(default_factory=list)
    images: NDArray[np.int8] = field(init=False)
    blank: NDArray[np.bool_] = field(init=False)

    def planes(self, items: Ints) -> Floats:
        """(n, 3, 32, 32): photos, or tactile images without their background, in gray levels."""
        x = planar(self.pixels[self.thumb[items]])
        if self.backgrounds is None:
            return x
        return remove_background(x, planar(self.backgrounds.pixels[self.behind[items]]))

    def filtered(
        self, *, slow: bool = False, progress: Progress = quiet
    ) -> tuple[NDArray[np.int8], Floats]:
        """All images band-passed (``slow``: with what varies slowly), and their strength before."""
        count = len(self.thumb)
        images = np.empty((count, 3, SIDE, SIDE), np.int8)
        strength = np.empty(count, np.float32)
        for start in range(0, count, BLOCK):
            progress("describing images", start, count)
            items = np.arange(start, min(start + BLOCK, count))
            x = smooth(self.planes(items)) if slow else band_pass(self.planes(items))
            strength[items] = rms(x)
            images[items] = quantized(x if slow else even(x, FLOOR[self.modality]))
        progress("describing images", count, count)
        return images, strength


def pool(
    train: Manifest,
    test: Manifest,
    modality: str,
    *,
    cache: Path | None,
    threads: int | None = None,
    progress: Progress = quiet,
) -> Pool:
    """Decode one modality of two manifests.

    Args:
        train: the samples to compare with.
        test: the samples in question.
        modality: ``vision`` or ``tactile``.
        cache: folder for thumbnails, or None.
        threads: that decode; None takes one a core.
        progress: called with the number of files done.
    """
    parts = (train, test)
    paths = _paths(parts, modality)
    behind = _paths(parts, "background") if modality == "tactile" else []
    thumbs = thumbnails([*paths, *behind], cache=cache, threads=threads, progress=progress)
    videos, row, recorded = (
        codes(parts, "video"),
        thumbs.row[: len(paths)],
        thumbs.row[len(paths) :],
    )
    notes = _unreadable_notes(paths, row, thumbs, modality)
    gel: Backgrounds | None = None
    key = np.stack([row, np.zeros_like(row)], axis=1)
    if modality == "tactile":
        gel = backgrounds(row, recorded, thumbs.pixels, videos, codes(parts, "sensor"))
        levels: dict[str, Any] = dict(zip(("video", "sensor", "all"), gel.medians, strict=True))
        if any(gel.medians):
            notes.append(Note("median-backgrounds", levels))
        key[:, 1] = gel.row
    item = np.full(len(paths), -1, np.int64)
    readable = row >= 0
    different, place = np.unique(key[readable], axis=0, return_inverse=True)
    item[readable] = place.ravel()
    result = Pool(
        modality, item, videos, thumbs.pixels, different[:, 0], gel, different[:, 1], notes
    )
    result.images, strength = result.filtered(progress=progress)
    limit, source, pairs = BLANK_PHOTO, "photo", 0
    if modality == "tactile":
        limit, source, pairs = _tactile_limit(thumbs.pixels, recorded, videos)
    result.blank = strength < limit
    if count := int(result.blank[item[readable]].sum()):
        params = {"count": count, "of": len(item), "limit": round(limit, 2), "source": source}
        notes.append(Note("blank-images", params | {"pairs": pairs}))
    return result


def quantized(x: Floats) -> NDArray[np.int8]:
    """Each image scaled so that its strongest value is 127."""
    strongest = np.abs(x).max(axis=(1, 2, 3), keepdims=True)
    return np.round(x * (127 / np.maximum(strongest, np.float32(1e-6)))).astype(np.int8)


def small_images(pixels: NDArray[np.uint8], rows: Ints) -> Floats:
    """Thumbnails at 8 x 8, (n, 192), scaled so that distances are root mean square gray levels."""
    small = np.empty((len(rows), 192), np.float32)
    for start in range(0, len(rows), BLOCK):
        part = pixels[rows[start : start + BLOCK]]
        cells = part.reshape(len(part), 8, 4, 8, 4, 3).mean(axis=(2, 4))
        small[start : start + BLOCK] = cells.reshape(len(part), -1)
    return small / np.float32(np.sqrt(192))


def codes(parts: Sequence[Manifest], column: str) -> Ints:
    """One column of several manifests as numbers; -1 where null."""
    values = pl.concat([m.table[column] for m in parts])
    return values.rank("dense").cast(pl.Int64).fill_null(0).to_numpy() - 1


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


def _tactile_limit(
    pixels: NDArray[np.uint8], recorded: Ints, videos: Ints
) -> tuple[float, str, int]:
    """The strength that untouched gel shows, where that is known from, and from how many pairs."""
    known = np.unique(np.stack([videos, recorded], axis=1)[(videos >= 0) & (recorded >= 0)], axis=0)
    following = np.flatnonzero(known[1:, 0] == known[:-1, 0])
    first, second, source = known[following, 1], known[following + 1, 1], "video"
    if len(first) < PAIRS:
        first, source = np.unique(recorded[recorded >= 0]), "similar"
        if len(first) < 2 * PAIRS:
            return BLANK_TACTILE[1], "default", 0
        second = first[other_nearest(small_images(pixels, first), 1)[:, 0]]
    chosen = np.linspace(0, len(first) - 1, min(len(first), MOST_PAIRS)).astype(np.int64)
    strength = [
        rms(band_pass(remove_background(planar(pixels[first[k]]), planar(pixels[second[k]]))))
        for k in np.array_split(chosen, -(-len(chosen) // BLOCK))
    ]
    limit = float(np.clip(1.5 * np.quantile(np.concatenate(strength), 0.1), *BLANK_TACTILE))
    return limit, source, len(chosen)
