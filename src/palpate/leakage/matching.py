"""Matching of test against train for one kind of features: best matches, levels of unrelated pictures, the null, scores and causes.

The unit is the entry, a distinct (picture, video) pair: two million samples of one picture in one video are one entry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress, rng_for
from palpate.leakage import calibrate
from palpate.leakage.calibrate import Calibration
from palpate.leakage.causes import blank_matches
from palpate.leakage.compare import Comparer, best_matches
from palpate.leakage.pool import Pool
from palpate.leakage.verify import Floats, Ints

#: Samples whose best match in other videos makes the null.
NULL_SAMPLES = 4000
#: Queries that random pairs are drawn for where no videos are known.
RANDOM_QUERIES = 1500
#: In how many rounds, and how many train pictures each round draws.
RANDOM_ROUNDS, RANDOM_WIDTH = 12, 64


@dataclass(frozen=True)
class Entries:
    """Distinct (picture, video) pairs of one part, so that equal samples are searched once.

    Attributes:
        item: (e,) pictures; videos: (e,) codes; sample: (e,) the first sample of each.
        back: (n,) the entry of each sample, -1 where it has no picture.
    """

    item: Ints
    videos: Ints
    sample: Ints
    back: Ints

    @classmethod
    def of(cls, item: Ints, videos: Ints) -> Entries:
        """Of samples with their pictures and videos; -1 stands for no picture and for an unknown video."""
        use = np.flatnonzero(item >= 0)
        pairs, first, place = np.unique(
            np.stack([item[use], videos[use]], axis=1),
            axis=0,
            return_index=True,
            return_inverse=True,
        )
        back = np.full(len(item), -1, np.int64)
        back[use] = place.ravel()
        return cls(pairs[:, 0], pairs[:, 1], use[first], back)

    def __len__(self) -> int:
        return len(self.item)

    def only(self, use: NDArray[np.bool_]) -> Entries:
        """Some of the entries; ``back`` no longer holds."""
        return Entries(self.item[use], self.videos[use], self.sample[use], np.zeros(0, np.int64))


@dataclass(frozen=True)
class Found:
    """Results for the entries of test; ``by_videos``: scores are above the level of unrelated pictures."""

    score: Floats
    place: Ints
    similarity: Floats
    cause: NDArray[np.str_]
    calibration: Calibration
    by_videos: bool


def match(
    comparer: Comparer,
    base: Entries,
    queries: Entries,
    rate: float,
    pictures: Pool | None,
    progress: Progress,
) -> Found:
    """Best matches of all test entries, their scores and causes (but for drift)."""
    place, similarity = best_matches(comparer, queries.item, base.item, progress=progress)
    calibration, by_videos = calibrated(comparer, base, queries, rate, pictures, progress)
    level = (
        levels_of(comparer, base, queries, place, progress)
        if by_videos
        else np.zeros(len(queries), np.float32)
    )
    score = calibrate.score(calibrate.fisher(similarity), level)
    equal = similarity >= comparer.same
    if len(base):
        equal |= (place >= 0) & (queries.item == base.item[place])
    score[equal] = 1.0  # the same picture is the same picture, however many others are like it
    cause = np.where(score >= calibration.threshold, "content", "").astype("<U15")
    if pictures is not None:
        score, place, cause = blank_matches(
            pictures, queries.item, base.item, score, place, cause, calibration.threshold
        )
    return Found(score, place, similarity, cause, calibration, by_videos)


def calibrated(
    comparer: Comparer,
    base: Entries,
    queries: Entries,
    rate: float,
    pictures: Pool | None,
    progress: Progress,
) -> tuple[Calibration, bool]:
    """The threshold, and whether it comes from videos, so that scores are above the level of unrelated pictures."""
    null, told = (
        null_sample(base),
        "Train has too few samples of two known videos to tell unrelated pictures by.",
    )
    if null is not None:
        apart, alike = best_matches(
            comparer, null.item, base.item, null.videos, base.videos, progress
        )
        # The same picture in two videos is a copy for certain and says nothing of unrelated ones.
        use = (apart >= 0) & (alike < comparer.same) & (null.item != base.item[apart])
        if pictures is not None:
            use &= ~pictures.blank[null.item]
        if use.sum() >= calibrate.FEWEST:
            level = levels_of(comparer, base, null, apart, progress)
            found = calibrate.other_videos(calibrate.fisher(alike[use]) - level[use], rate)
            if found.threshold <= calibrate.TRUSTED:
                return found, True
            told = (
                f"Best matches in other videos would set the threshold to {found.threshold:.3f}: many recordings of train are copies of one another, or"
                " these features cannot tell pictures apart. Random pairs set it instead."
            )
    found = from_random_pairs(comparer, base, queries, rate, pictures, progress)
    return replace(found, notes=[told, *found.notes]), False


def null_sample(base: Entries) -> Entries | None:
    """The train samples whose best match in other videos of train makes the null, None if videos do not tell.

    Test never enters it: copies of train pictures are what test is searched for.
    """
    rows = np.flatnonzero(base.videos >= 0)
    if len(np.unique(base.videos[rows])) < 2 or len(rows) < calibrate.FEWEST:
        return None
    chosen = np.sort(rng_for(0, "near-duplicates", "null").permutation(rows)[:NULL_SAMPLES])
    return Entries(
        base.item[chosen], base.videos[chosen], np.arange(len(chosen)), np.arange(len(chosen))
    )


def levels_of(
    comparer: Comparer, base: Entries, queries: Entries, match: Ints, progress: Progress
) -> Floats:
    """How alike unrelated pictures are to each query; the cohort is the same random train entries for all. ``match``: (q,) places in base or -1."""
    cohort = np.sort(
        rng_for(0, "near-duplicates", "cohort").permutation(len(base))[: calibrate.COHORT]
    )
    if not len(cohort) or not len(queries):
        return np.zeros(len(queries), np.float32)
    z = calibrate.fisher(comparer.grid(queries.item, base.item[cohort], progress))
    # Copies of the query among them are not unrelated, and must not raise the level that the copy searched for is held against.
    z[(queries.item[:, None] == base.item[cohort][None]) | (z >= calibrate.COPY)] = np.nan
    matched = np.where(match >= 0, base.videos[np.maximum(match, 0)], -1)
    return calibrate.levels(z, queries.videos, matched, base.videos[cohort])


def from_random_pairs(
    comparer: Comparer,
    base: Entries,
    queries: Entries,
    rate: float,
    pictures: Pool | None,
    progress: Progress,
) -> Calibration:
    """The threshold where no videos are known."""
    if pictures is not None:
        base, queries = (e.only(~pictures.blank[e.item]) for e in (base, queries))
    count = len(base)
    if not count or not len(queries):
        return calibrate.uncalibrated(rate)
    rng = rng_for(0, "near-duplicates", "random pairs")
    asked = rng.permutation(len(queries))[:RANDOM_QUERIES]
    rows: list[Floats] = []
    for part in np.array_split(
        asked, min(RANDOM_ROUNDS, len(asked))
    ):  # each with other train pictures
        chosen = rng.permutation(count)[:RANDOM_WIDTH]
        other, theirs = base.item[chosen], base.videos[chosen]
        found = calibrate.fisher(comparer.grid(queries.item[part], other, progress))
        mine = queries.videos[part][:, None]
        found[
            (queries.item[part][:, None] == other[None]) | ((mine == theirs[None]) & (mine >= 0))
        ] = np.nan
        rows.append(rng.permuted(found, axis=1))
    z = np.concatenate(rows)
    return calibrate.random_blocks(z, count, rate)
