"""Matching of test against train for one kind of features: best matches, levels of unrelated pictures, the null, scores and causes.

The unit is the entry, a distinct (picture, video) pair: two million samples of one picture in one video are one entry.
"""

from __future__ import annotations

from dataclasses import dataclass

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
#: So many of train are enough, else those of test are added.
ENOUGH = 100
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
        pairs, first, place = np.unique(np.stack([item[use], videos[use]], axis=1), axis=0, return_index=True, return_inverse=True)
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
    """Results for the entries of test."""

    score: Floats
    place: Ints
    similarity: Floats
    cause: NDArray[np.str_]
    calibration: Calibration


def match(comparer: Comparer, base: Entries, queries: Entries, rate: float, pictures: Pool | None, progress: Progress) -> Found:
    """Best matches of all test entries, their scores and causes (but for drift)."""
    place, similarity = best_matches(comparer, queries.item, base.item, progress=progress)
    calibration, by_videos = calibrated(comparer, base, queries, rate, pictures, progress)
    level = levels_of(comparer, base, queries, place, progress) if by_videos else np.zeros(len(queries), np.float32)
    score = calibrate.score(calibrate.fisher(similarity), level)
    cause = np.where(score >= calibration.threshold, "content", "").astype("<U15")
    if pictures is not None:
        score, place, cause = blank_matches(pictures, queries.item, base.item, score, place, cause, calibration.threshold)
    return Found(score, place, similarity, cause, calibration)


def calibrated(
    comparer: Comparer, base: Entries, queries: Entries, rate: float, pictures: Pool | None, progress: Progress
) -> tuple[Calibration, bool]:
    """The threshold, and whether it comes from videos, so that scores are above the level of unrelated pictures."""
    null = null_sample(base, queries)
    if null is None:
        return from_random_pairs(comparer, base, queries, rate, pictures, progress), False
    apart, alike = best_matches(comparer, null.item, base.item, null.videos, base.videos, progress)
    level = levels_of(comparer, base, null, apart, progress)
    use = apart >= 0 if pictures is None else (apart >= 0) & ~pictures.blank[null.item]
    if use.sum() < calibrate.FEWEST:
        return calibrate.uncalibrated(rate), False
    return calibrate.other_videos(calibrate.fisher(alike[use]) - level[use], rate), True


def null_sample(base: Entries, queries: Entries) -> Entries | None:
    """The samples whose best match in other videos of train makes the null, None if videos do not tell.

    Those of train come first: copies of train pictures are what test is searched for, and would spoil the null.
    """
    known = np.unique(base.videos[base.videos >= 0])
    if len(known) < 2:
        others = queries.videos[queries.videos >= 0]
        if not len(known) or not (others != known[0]).any():
            return None
    parts = [np.flatnonzero(e.videos >= 0) for e in (base, queries)]
    if len(parts[0]) + len(parts[1]) < calibrate.FEWEST:
        return None
    rng = rng_for(0, "near-duplicates", "null")
    chosen = [np.sort(rng.permutation(rows)[:NULL_SAMPLES]) for rows in parts]
    if len(known) > 1 and len(chosen[0]) >= ENOUGH:
        chosen[1] = chosen[1][:0]
    item = np.concatenate([base.item[chosen[0]], queries.item[chosen[1]]])
    videos = np.concatenate([base.videos[chosen[0]], queries.videos[chosen[1]]])
    return Entries(item, videos, np.arange(len(item)), np.arange(len(item)))


def levels_of(comparer: Comparer, base: Entries, queries: Entries, match: Ints, progress: Progress) -> Floats:
    """How alike unrelated pictures are to each query; the cohort is the same random train entries for all. ``match``: (q,) places in base or -1."""
    cohort = np.sort(rng_for(0, "near-duplicates", "cohort").permutation(len(base))[: calibrate.COHORT])
    if not len(cohort) or not len(queries):
        return np.zeros(len(queries), np.float32)
    z = calibrate.fisher(comparer.grid(queries.item, base.item[cohort], progress))
    z[queries.item[:, None] == base.item[cohort][None]] = np.nan
    matched = np.where(match >= 0, base.videos[np.maximum(match, 0)], -1)
    return calibrate.levels(z, queries.videos, matched, base.videos[cohort])


def from_random_pairs(
    comparer: Comparer, base: Entries, queries: Entries, rate: float, pictures: Pool | None, progress: Progress
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
    for part in np.array_split(asked, min(RANDOM_ROUNDS, len(asked))):  # each with other train pictures
        other = base.item[rng.permutation(count)[:RANDOM_WIDTH]]
        found = calibrate.fisher(comparer.grid(queries.item[part], other, progress))
        found[queries.item[part][:, None] == other[None]] = np.nan
        rows.append(rng.permuted(found, axis=1))
    z = np.concatenate(rows)
    return calibrate.random_blocks(z, count, rate)
