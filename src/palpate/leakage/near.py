"""Near-duplicate images in vision and tactile, which no metadata reveals.

Every test sample gets the train sample with the most similar image and a score, its cosine
(:mod:`palpate.leakage.calibration`). Images that show nothing, blank photos and untouched gel, are
named before anything is matched. The answer is one of three verdicts:

=================  ===============================================================================
verdict            when
=================  ===============================================================================
``leaks``          more samples are over the threshold than chance explains
``no leak found``  no more than chance explains
``cannot tell``    nothing was touched, or there is no null: unrelated images are not known to be
                   so, or are all similar. Samples are ranked; only equal images are flagged: then
                   they are leaks
=================  ===============================================================================

Images are compared as they are and as if edited, tactile ones with their backgrounds, where these
are known, and without (:mod:`palpate.leakage.descriptors`); gray copies among colored images by
their luma. All questions share one rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from palpate.core import Note, Progress, quiet
from palpate.data.manifest import Manifest
from palpate.leakage import calibration
from palpate.leakage.calibration import Tail
from palpate.leakage.matching import (
    Unrelated,
    View,
    answers,
    image_views,
    links,
    ordered,
    unrelated,
)
from palpate.leakage.neighbors import Floats, Ints
from palpate.leakage.pool import Pool, pool
from palpate.leakage.signals import Flags
from palpate.report.records import CANNOT_TELL, LEAKS, NO_LEAK

#: Nearest images that an image may be linked to in a cluster.
LINKS = 16
#: Cosine from which images are linked in any case.
LINKED = 0.75
#: A threshold above this finds no copies: no verdict is given.
TIGHT = 0.97
#: Videos from which a rate is more than a guess.
VIDEOS = 80
#: Rate of false positives by default, and of what a split keeps together.
RATE = 0.001
#: Cosine of equal images.
SAME = 0.9995


#: One thread, so that scores do not depend on how many a machine has; the products are small, and
#: more threads make them slower.
one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")


@one_blas_thread
def near_duplicates(
    train: Manifest,
    test: Manifest,
    modality: str,
    *,
    false_positives: float = RATE,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> Flags:
    """Flag test samples whose image is nearly that of a train sample.

    Args:
        train: the samples to compare with.
        test: the samples in question.
        modality: ``vision`` or ``tactile``.
        false_positives: share of unrelated samples that may be flagged, in (0, 0.1].
        cache: folder for thumbnails, so that a rerun is quick; None keeps nothing.
        progress: callback.
    """
    images = pool(train, test, modality, cache=cache, progress=progress)
    base, queries = _shown(images, slice(len(train))), _shown(images, slice(len(train), None))
    matches = _match(images, base, queries, false_positives, progress)
    cut = len(train)
    return _flags(modality, images, (base, queries), matches, cut=cut, rate=false_positives)


@one_blas_thread
def near_groups(
    manifest: Manifest, modality: str, *, cache: Path | None = None, progress: Progress = quiet
) -> Ints:
    """Clusters of near-duplicates, to be kept whole by a split.

    Two images are linked if one is near the other by the rules of :func:`near_duplicates`, and from
    a cosine of 0.75 in any case: other videos may hold copies here, which raise the threshold. A
    cluster is a connected component. Clusters chain: the first and the last frame of a long slide
    may share nothing, so a cluster may be as large as a recording. That is what a split needs, but
    a cluster is no list of duplicates.

    Returns:
        (n,) the number of each sample's cluster; -1 for samples that are near no other image, that
        show nothing, or that cannot be read.
    """
    none = Manifest(manifest.table.clear(), manifest.root)
    images = pool(manifest, none, modality, cache=cache, progress=progress)
    base = _shown(images, slice(None))
    views = image_views(images, base, base) if len(base) else []
    null = _null(images, base, views)
    tasks = [] if null is None else [(base[null.rows], null.apart)]
    i, j = [base[:0]], [base[:0]]
    for view in views:
        nulls = [row for values, _ in answers(view, base, tasks, progress) for row in values]
        fitted = calibration.tails(nulls, null.groups, view.shares) if null is not None else []
        for question, first, second, cosine in links(view, base, LINKS, progress):
            limits = [t.similarity(t.surprise_at(RATE)) for t in fitted[question:][:1]]
            limit = min([*limits, LINKED])
            i.append(first[cosine >= limit])
            j.append(second[cosine >= limit])
    return _clusters(images, base[np.concatenate(i)], base[np.concatenate(j)])


@dataclass(frozen=True)
class Matches:
    """The answer for the images of test."""

    score: Floats  # (n,) NaN where there is nothing to compare with
    row: Ints  # (n,) the best match in the base, -1 for none
    threshold: float  # score from which images are flagged
    note: Note  # where the threshold is from
    tails: Sequence[Tail] = ()  # of the null, one for each question; none without a null
    #: (k,) scores of the null.
    unrelated: Floats = field(default_factory=lambda: np.zeros(0, np.float32))
    measured: float | None = None  # share of the null that is over a threshold from its other half


def _match(images: Pool, base: Ints, queries: Ints, rate: float, progress: Progress) -> Matches:
    """Match images with train, over a threshold from what is unrelated."""
    if not len(base) or not len(queries):
        note = Note("cannot-tell-untouched", {"part": "train" if len(queries) else "test"})
        nothing = np.full(len(queries), np.nan, np.float32), np.full(len(queries), -1, np.int64)
        return Matches(*nothing, 1.0, note)
    views = image_views(images, base, queries)
    null = _null(images, base, views)
    matches: list[tuple[Floats, Ints]] = []
    nulls: list[Floats] = []
    for view in views:
        tasks = [(queries, None)] + ([] if null is None else [(base[null.rows], null.apart)])
        (similarity, row), *more = answers(view, base, tasks, progress)
        similarity[:, ~view.queries[queries]] = np.nan
        matches += zip(similarity, row, strict=True)
        # Equal images of two videos are copies for certain, and say nothing of unrelated ones.
        nulls += [np.where(row < SAME, row, np.nan) for values, _ in more for row in values]
    similarities, places = (np.stack(x) for x in zip(*matches, strict=True))
    shares = [share for view in views for share in view.shares]
    tails = [] if null is None else calibration.tails(nulls, null.groups, shares)
    fitted = tails or [Tail(0, 1, 1, 1)] * len(shares)  # the highest cosine
    rarest = np.nan_to_num(calibration.surprises(similarities, fitted), nan=-np.inf).argmax(axis=0)
    score = calibration.score(similarities, fitted)
    row = np.take_along_axis(places, rarest[None], axis=0)[0]
    limit = calibration.threshold(fitted, rate)
    if null is None or not tails or limit > TIGHT:
        params = {"images": len(base), "threshold": round(limit, 3) if tails else None}
        return Matches(score, row, 1.0, Note("cannot-tell-no-null", params))
    groups = len(np.unique(null.groups))
    first = np.count_nonzero(np.cumsum(shares) < 1 + 1e-6)  # of images in color, or of all
    params = {"threshold": round(limit, 3), "samples": len(null.rows), "groups": groups}
    return Matches(
        score,
        row,
        limit,
        Note(f"threshold-{null.source}", params | {"rate": rate, "few": groups < VIDEOS}),
        fitted,
        calibration.score(nulls[:first], fitted[:first]),
        calibration.measured(nulls[:first], null.groups, shares[:first], rate),
    )


def _flags(
    modality: str,
    images: Pool,
    parts: tuple[Ints, Ints],
    matches: Matches,
    *,
    cut: int,
    rate: float,
) -> Flags:
    """From images to the samples of test, with the verdict."""
    base, queries = parts
    item, first = images.item[cut:], _first(images.item[:cut], len(images.images))
    at = np.full(len(images.images) + 1, -1, np.int64)  # the last for samples without an image
    at[queries] = np.arange(len(queries))
    at, present = at[item], at[item] >= 0
    score, nearest = np.full(len(item), np.nan, np.float32), np.full(len(item), -1, np.int64)
    if present.any() and len(base):
        score[present] = matches.score[at[present]]
        nearest[present] = first[base[matches.row[at[present]]]]
    thumbs, rows = np.unique(images.images[base], return_index=True)
    same = present.copy()
    same[present] = np.isin(images.images[item[present]], thumbs)
    score[same] = 1.0
    nearest[same] = first[base[rows[np.searchsorted(thumbs, images.images[item[same]])]]]
    flag = same | (np.nan_to_num(score) >= matches.threshold)
    checked = int(np.isfinite(score).sum())
    verdict = _verdict(matches, images.unit[cut:], score, flag, same, rate=rate)
    score = np.clip(score, 0, 1)
    cause = np.where(flag, "content", "").astype("<U15")
    cause[np.append(images.blank, False)[item]] = "nothing touched"  # the last for no image
    edges, unrelated_scores, histogram = calibration.histograms(matches.unrelated, score)
    return Flags.of(
        f"near-duplicate {modality}",
        score,
        flag,
        nearest,
        min(matches.threshold, 1.0),
        counts=verdict == LEAKS,
        false_positives=rate,
        edges=edges,
        unrelated=unrelated_scores,
        matches=histogram,
        cause=cause,
        notes=[*images.notes, matches.note],
        verdict=verdict,
        expected=None if not matches.tails else round(rate * checked, 2),
        measured=matches.measured,
        unread=float(max((images.item[:cut] < 0).mean(), (images.item[cut:] < 0).mean())),
    )


def _verdict(
    matches: Matches,
    unit: Ints,
    score: Floats,
    flag: NDArray[np.bool_],
    same: NDArray[np.bool_],
    *,
    rate: float,
) -> str:
    """Whether the flags are more than chance explains: all of them, or the strongest alone."""
    if same.any() or not flag.any():
        return LEAKS if same.any() else NO_LEAK if matches.tails else CANNOT_TELL
    count = np.isfinite(matches.unrelated).sum()
    if matches.measured and calibration.missed(matches.measured, int(count), rate):
        return CANNOT_TELL
    groups = np.where(unit >= 0, unit, -1 - np.arange(len(unit)))
    strongest = float(np.nanmax(score))
    levels = [
        (flag, rate),
        (np.nan_to_num(score) >= strongest, calibration.rate_of(strongest, matches.tails)),
    ]
    beyond = calibration.beyond_chance(levels, groups, int(np.isfinite(score).sum()))
    return LEAKS if beyond else NO_LEAK


def _shown(images: Pool, part: slice) -> Ints:
    """The different images of some samples that show something."""
    items = np.unique(images.item[part])
    items = items[items >= 0]
    return items[~images.blank[items]]


def _first(item: Ints, count: int) -> Ints:
    """(count,) the first sample of each image; -1 for none."""
    first, present = np.full(count, -1, np.int64), np.flatnonzero(item >= 0)[::-1]
    first[item[present]] = present
    return first


def _null(images: Pool, base: Ints, views: list[View]) -> Unrelated | None:
    """What is known to be unrelated among train images."""
    first = _first(images.item, len(images.images))[base]
    null = unrelated(images.unit[first], first)
    if null is None or (null.source == "order" and not ordered(views[0], base, null)):
        return None
    return null


def _clusters(images: Pool, i: Ints, j: Ints) -> Ints:
    """Components of images that are linked, or belong to several samples; -1 for samples alone."""
    count = len(images.blank)
    graph = scipy.sparse.coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(count, count))
    component = (
        scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
        if count
        else np.zeros(1, np.int64)
    )
    usable = images.item >= 0
    usable[usable] = ~images.blank[images.item[usable]]
    label = np.where(usable, component[images.item], -1).astype(np.int64)
    sizes = np.bincount(label[usable], minlength=count + 1)
    return np.where(usable & (sizes[label] > 1), label, -1)
