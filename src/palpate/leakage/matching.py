"""Best matches of images among train: by each way to compare them, as they are and as if edited."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress, quiet, rng_for
from palpate.leakage.descriptors import Whitened
from palpate.leakage.neighbors import Apart, Floats, Ints
from palpate.leakage.pool import Pool

#: Rows in recording order within which two images may show one contact.
WINDOW = 16
#: Train images whose unrelated matches make the null.
NULL_IMAGES = 2000


@dataclass(frozen=True)
class View:
    """One way to compare images."""

    descriptors: Whitened  # of all images
    usable: NDArray[np.bool_]  # (items,) those that can be compared so
    queries: NDArray[np.bool_]  # (items,) those whose matches are of interest
    shares: Sequence[float]  # of the rate of false positives of these, for each question


@dataclass(frozen=True)
class Unrelated:
    """Train images, and which others are known to be unrelated to each."""

    rows: Ints  # (k,) rows of the base
    apart: Apart  # of these against the base
    groups: Ints  # (k,) videos, or pieces of the recording order
    source: str  # ``videos`` or ``order``


def image_views(images: Pool, base: Ints, queries: Ints) -> list[View]:
    """Log thumbnails without and with backgrounds, in color; in gray for gray queries, and for all
    where train has gray images among others.
    """
    both = np.concatenate([base, queries])
    gray = images.colorless()
    kinds = [(bool(gray[base].any()) and not gray[both].all(), ~images.blank)]
    if gray[queries].any() and not gray[base].any():
        kinds = [(False, ~images.blank & ~gray), (True, gray)]
    views: list[View] = []
    for luma, wanted in kinds:
        descriptors: list[tuple[Whitened, NDArray[np.bool_]]] = []
        for backgrounds in (None, images.backgrounds):
            usable = ~images.blank if backgrounds is None else ~images.blank & (backgrounds >= 0)
            if backgrounds is None or (usable[base].any() and usable[queries].any()):
                described = Whitened(
                    images.pixels, images.images, backgrounds, gray=luma, fit=both[usable[both]]
                )
                descriptors.append((described, usable))
        total = sum(sum(described.shares) for described, _ in descriptors)
        views += [
            View(d, usable, wanted, tuple(share / total for share in d.shares))
            for d, usable in descriptors
        ]
    return views


def unrelated(unit: Ints, order: Ints) -> Unrelated | None:
    """What is known to be unrelated among train images; None if nothing is.

    Args:
        unit: (m,) video of each image of the base, negative where unknown.
        order: (m,) place in recording order, all different.
    """
    rng = rng_for(0, "near-duplicates", "null")
    rows = np.flatnonzero(unit >= 0)
    if len(np.unique(unit[rows])) >= 2:
        # An image without a video is unrelated to none for certain: the null is higher for it.
        keys = np.where(unit >= 0, unit, -1 - np.arange(len(unit)))
        rows = np.sort(rng.permutation(rows)[:NULL_IMAGES])
        return Unrelated(rows, Apart(keys[rows], keys), keys[rows], "videos")
    if len(unit) <= 3 * WINDOW or len(rows) == len(unit):
        return None
    keys = np.argsort(np.argsort(order))
    rows = np.sort(rng.permutation(len(unit))[:NULL_IMAGES])
    return Unrelated(rows, Apart(keys[rows], keys, WINDOW), keys[rows] // (2 * WINDOW), "order")


def ordered(view: View, base: Ints, null: Unrelated) -> bool:
    """Whether recording order says anything: whether best matches lie within the window."""
    itself = Apart(null.apart.queries, null.apart.base, 0)
    _, places = answers(view, base, [(base[null.rows], itself)], ways=1)[0]
    matched = places[0] >= 0
    near = np.abs(null.apart.queries - null.apart.base[places[0]])[matched] <= WINDOW
    chance = 2 * WINDOW / len(base)
    return bool(near.mean() > chance + 4 * np.sqrt(chance / max(len(near), 1)))


def answers(
    view: View,
    base: Ints,
    tasks: Sequence[tuple[Ints, Apart | None]],
    progress: Progress = quiet,
    ways: int | None = None,
) -> list[tuple[Floats, Ints]]:
    """Best matches of several sets of images among the base.

    Args:
        view: how they are compared.
        base: (m,) train images.
        tasks: images, and which of the base are no neighbors of them.
        progress: callback.
        ways: how many ways of the view are tried; None tries all.

    Returns:
        for each task the similarities and places in ``base``, (questions, n); NaN and -1 where
        there is none.
    """
    b = np.flatnonzero(view.usable[base])
    closest: list[tuple[Floats, Ints]] = []
    usable = [np.flatnonzero(view.usable[items]) for items, _ in tasks]
    for items, _ in tasks:
        shape = (len(view.descriptors.shares), len(items))
        closest.append((np.full(shape, np.nan, np.float32), np.full(shape, -1, np.int64)))
    for k, (question, index) in enumerate(view.descriptors.ways[:ways]):
        progress("comparing images", k, len(view.descriptors.ways))
        among = index(base[b])
        for (items, apart), q, (similarity, row) in zip(tasks, usable, closest, strict=True):
            if not len(q) or not len(b):
                continue
            if apart is not None:
                apart = Apart(apart.queries[q], apart.base[b], apart.window)
            rows, values = among.closest(items[q], 1, apart)
            rows, values = rows[:, 0], values[:, 0]
            better = (rows >= 0) & ~(values <= similarity[question, q])
            similarity[question, q[better]] = values[better]
            row[question, q[better]] = b[rows[better]]
    return closest


def links(
    view: View, base: Ints, count: int, progress: Progress = quiet
) -> Iterator[tuple[int, Ints, Ints, Floats]]:
    """Pairs of images that may be linked: (question, i, j, cosines)."""
    b = np.flatnonzero(view.usable[base])
    itself = Apart(np.arange(len(b)), np.arange(len(b)), 0)
    for k, (question, index) in enumerate(view.descriptors.ways):
        progress("comparing images", k, len(view.descriptors.ways))
        if not len(b):
            return
        rows, cosines = index(base[b]).closest(base[b], count, itself)
        matched = rows >= 0
        yield question, b[np.nonzero(matched)[0]], b[rows[matched]], cosines[matched]
