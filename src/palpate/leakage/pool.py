"""Every distinct picture of one modality in train and test, ready to be compared.

A picture is blank where it shows nothing: a photo without any structure (a lens cap, a black frame), a tactile image that differs from its background no
more than the passive gel differs from itself. The strength of a picture is the root mean square of its band-passed thumbnail in gray levels; the limit for touch comes from
pairs of different backgrounds of one video (without videos, of each and the one most like it), which show untouched gel at two times, as 1.5 times the
10 % quantile of their strength (the others may hold the beginning of a contact), within 0.3 and 1.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import Progress, quiet
from palpate.data.manifest import MODALITIES, Manifest
from palpate.leakage.background import Backgrounds, backgrounds, planar, remove_background
from palpate.leakage.descriptors import Thumbnails, thumbnails
from palpate.leakage.search import nearest
from palpate.leakage.verify import SIDE, Floats, Ints, band_pass, even, rms, smooth

#: Strength below which a photo shows nothing.
BLANK_PHOTO = 0.6
#: Bounds of the strength below which a touch shows nothing, and the value where no two backgrounds of a video are known.
BLANK_TOUCH = (0.3, 1.1)
BLANK_UNKNOWN = 1.1
#: Local contrast in gray levels up to which a picture counts less: noise and compression.
FLOOR = {"vision": 3.0, "tactile": 20.0}
#: Pairs of backgrounds that a limit needs, and how many are looked at.
PAIRS, MOST_PAIRS = 5, 2000
BLOCK = 1024


@dataclass(frozen=True)
class Pool:
    """Distinct pictures of train and test together.

    Attributes:
        item: (n,) for each sample, train first, the number of its picture; -1 where it cannot be looked at.
        split: where test begins.
        videos: (n,) codes; -1 where unknown.
        thumbs: the decoded pictures.
        thumb: (items,) row of each picture in ``thumbs.pixels``.
        background: for touch the backgrounds, and for each picture its row there; None for vision.
        strength: (items,) in gray levels.
        blank: (items,) whether a picture shows nothing.
        notes: sentences for people.
    """

    item: Ints
    split: int
    videos: Ints
    thumbs: Thumbnails
    thumb: Ints
    background: tuple[Backgrounds, Ints] | None
    strength: Floats
    blank: NDArray[np.bool_]
    limit: float
    notes: list[str] = field(default_factory=list)

    def planes(self, items: Ints) -> Floats:
        """(n, 3, 32, 32): photos, or touches without their background, in gray levels."""
        return _planes(
            self.thumbs.pixels,
            self.thumb[items],
            self.background and (self.background[0].pixels, self.background[1][items]),
        )

    def plates(self, *, slow: bool = False) -> NDArray[np.int8]:
        """All pictures band-passed (``slow``: with what varies slowly), each scaled to 127: (items, 3, 32, 32)."""
        return plates(self, slow)[0]


def pool(
    train: Manifest,
    test: Manifest,
    modality: str,
    *,
    cache: Path | None,
    processes: int | None,
    progress: Progress = quiet,
) -> tuple[Pool, NDArray[np.int8]]:
    """Decodes one modality of two manifests.

    Args:
        train: the samples to compare with.
        test: the samples to judge.
        modality: ``vision`` or ``touch``.
        cache: folder for thumbnails, or None.
        processes: that decode; None takes one a core.
        progress: told about files.

    Returns:
        The pool and its band-passed plates.
    """
    column = MODALITIES[modality]
    parts = (train, test)
    paths = [p for m in parts for p in _paths(m, column)]
    behind = [p for m in parts for p in _paths(m, "background")] if modality == "tactile" else []
    thumbs = thumbnails([*paths, *behind], cache=cache, processes=processes, progress=progress)
    videos = codes(parts, "video")
    row = thumbs.row[: len(paths)]
    notes = _told(paths, row, thumbs, column)
    background: tuple[Backgrounds, Ints] | None = None
    key = row[:, None]
    if modality == "tactile":
        found = backgrounds(
            row, thumbs.row[len(paths) :], thumbs.pixels, videos, codes(parts, "sensor")
        )
        notes += _told_medians(found)
        key = np.stack([row, found.row], axis=1)
        background = (found, found.row)
    different, item = np.unique(key, axis=0, return_inverse=True)
    item = item.ravel().astype(np.int64)
    if len(different) and different[0, 0] < 0:
        gone = int((different[:, 0] < 0).sum())  # unreadable ones sort first
        different, item = different[gone:], np.maximum(item - gone, -1)
    if background is not None:
        background = (background[0], different[:, 1].astype(np.int64))
    empty = np.zeros(len(different), np.float32)
    made = Pool(
        item,
        len(train),
        videos,
        thumbs,
        different[:, 0].astype(np.int64),
        background,
        empty,
        empty > 0,
        0.0,
        notes,
    )
    fine, strength = plates(made, slow=False, progress=progress)
    limit, note = (
        (BLANK_PHOTO, "")
        if background is None
        else _touch_limit(thumbs.pixels, thumbs.row[len(paths) :], videos)
    )
    blank = strength < limit
    if count := int(blank[item[item >= 0]].sum()):
        what = (
            "photos show nothing at all"
            if background is None
            else "touches show no more than untouched gel does"
        )
        notes.append(
            f"{count} of {len(item)} {what} (strength under {limit:.2f} gray levels{note})."
        )
    return Pool(
        item, len(train), videos, thumbs, made.thumb, background, strength, blank, limit, notes
    ), fine


def plates(pool: Pool, slow: bool, progress: Progress = quiet) -> tuple[NDArray[np.int8], Floats]:
    """All pictures of a pool filtered and scaled to 127, and their strength before that."""
    count = len(pool.thumb)
    out, strength = np.empty((count, 3, SIDE, SIDE), np.int8), np.empty(count, np.float32)
    for start in range(0, count, BLOCK):
        progress("describing pictures", start, count)
        items = np.arange(start, min(start + BLOCK, count))
        x = pool.planes(items)
        x = smooth(x) if slow else band_pass(x)
        strength[items] = rms(x)
        out[items] = quantized(
            x if slow else even(x, FLOOR["vision" if pool.background is None else "tactile"])
        )
    progress("describing pictures", count, count)
    return out, strength


def quantized(x: Floats) -> NDArray[np.int8]:
    """Each picture scaled so that its strongest value is 127."""
    return np.round(
        x * (127 / np.maximum(np.abs(x).max(axis=(1, 2, 3), keepdims=True), np.float32(1e-6)))
    ).astype(np.int8)


def _planes(
    pixels: NDArray[np.uint8], rows: Ints, behind: tuple[NDArray[np.uint8], Ints] | None
) -> Floats:
    x = planar(pixels[rows])
    return x if behind is None else remove_background(x, planar(behind[0][behind[1]]))


def small_pictures(pixels: NDArray[np.uint8], rows: Ints) -> Floats:
    """Thumbnails at 8 x 8, (n, 192), scaled so that distances are root mean square differences in gray levels."""
    out = np.empty((len(rows), 192), np.float32)
    for start in range(0, len(rows), BLOCK):
        part = pixels[rows[start : start + BLOCK]]
        out[start : start + BLOCK] = (
            part.reshape(len(part), 8, 4, 8, 4, 3).mean(axis=(2, 4)).reshape(len(part), -1)
        )
    return out / np.float32(np.sqrt(192))


def _paths(manifest: Manifest, column: str) -> list[Path | None]:
    return [None if v is None else manifest.path(v) for v in manifest.column(column)]


def codes(parts: Sequence[Manifest], column: str) -> Ints:
    """One column of several manifests, in a row, as numbers; -1 where null."""
    values = pl.concat([m.table[column] for m in parts])
    return (
        values.cast(pl.Categorical).to_physical().cast(pl.Int64).fill_null(-1).to_numpy()
        if len(values)
        else np.zeros(0, np.int64)
    )


def _told(paths: list[Path | None], row: Ints, thumbs: Thumbnails, column: str) -> list[str]:
    notes: list[str] = []
    if absent := sum(p is None for p in paths):
        notes.append(
            f"{absent} of {len(paths)} samples have no {column} picture and were not looked at."
        )
    if bad := int((row < 0).sum()) - absent:
        mine = {str(p) for p in paths}
        names = [
            f"{Path(name).name}: {why}" for name, why in thumbs.unreadable.items() if name in mine
        ][:3]
        notes.append(
            f"{bad} {column} pictures cannot be read and were not looked at ({'; '.join(names)})."
        )
    if others := [name for name in thumbs.unreadable if name not in {str(p) for p in paths}]:
        notes.append(
            f"{len(others)} background pictures cannot be read ({', '.join(Path(n).name for n in others[:3])}); medians stand in."
        )
    return notes


def _told_medians(found: Backgrounds) -> list[str]:
    texts = ("their video", "their sensor", "all frames")
    took = [
        f"{n} take the median of {what}" for n, what in zip(found.medians, texts, strict=True) if n
    ]
    return [f"Touches without a background of their own: {'; '.join(took)}."] if took else []


def _touch_limit(pixels: NDArray[np.uint8], own: Ints, videos: Ints) -> tuple[float, str]:
    """The strength that untouched gel shows, and where that is known from."""
    known = np.unique(np.stack([videos, own], axis=1)[(videos >= 0) & (own >= 0)], axis=0)
    after = np.flatnonzero(
        known[1:, 0] == known[:-1, 0]
    )  # neighbors in the list of one video's different backgrounds
    first, second, whose = known[after, 1], known[after + 1, 1], "of one video"
    if len(after) < PAIRS:
        first, whose = np.unique(own[own >= 0]), "most alike"
        if len(first) < 2 * PAIRS:
            return BLANK_UNKNOWN, ", a default, since too few backgrounds are known"
        small = small_pictures(pixels, first)
        second = first[nearest(small, small, 1, self_join=True).index[:, 0]]
    chosen = np.linspace(0, len(first) - 1, min(len(first), MOST_PAIRS)).astype(np.int64)
    strength: list[Floats] = []
    for start in range(0, len(chosen), BLOCK):
        k = chosen[start : start + BLOCK]
        strength.append(
            rms(band_pass(remove_background(planar(pixels[first[k]]), planar(pixels[second[k]]))))
        )
    limit = float(np.clip(1.5 * np.quantile(np.concatenate(strength), 0.1), *BLANK_TOUCH))
    return limit, f", from {len(chosen)} pairs of backgrounds {whose}"
