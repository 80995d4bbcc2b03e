"""Matching of test against train for one kind of features: best matches, scores, threshold.

The unit is the entry, a distinct (image, video) pair: two million samples of one image in one video
are one entry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import Note, Progress, rng_for
from palpate.leakage import calibration
from palpate.leakage.calibration import Calibration
from palpate.leakage.neighbors import Floats, Ints
from palpate.leakage.similarity import Similarity, best_matches

#: Samples whose best match in other videos makes the null.
NULL_SAMPLES = 4000
#: Queries that random pairs are drawn for where no videos are known, in how many rounds, and how
#: many train images each round draws.
RANDOM_QUERIES, RANDOM_ROUNDS, RANDOM_WIDTH = 1500, 12, 64


@dataclass(frozen=True)
class Entries:
    """Distinct (image, video) pairs of one part.

    Attributes:
        item: (e,) images; videos: (e,) codes; sample: (e,) the first sample of each.
        back: (n,) the entry of each sample, -1 where it has no image.
    """

    item: Ints
    videos: Ints
    sample: Ints
    back: Ints

    @classmethod
    def of(cls, item: Ints, videos: Ints) -> Entries:
        """Of samples with their images and videos; -1 for no image and for an unknown video."""
        known = np.flatnonzero(item >= 0)
        pairs, first, place = np.unique(
            np.stack([item, videos], axis=1)[known], axis=0, return_index=True, return_inverse=True
        )
        back = np.full(len(item), -1, np.int64)
        back[known] = place.ravel()
        return cls(pairs[:, 0], pairs[:, 1], known[first], back)

    def __len__(self) -> int:
        return len(self.item)

    def only(self, rows: Any) -> Entries:
        """Some of the entries, by mask or row numbers; ``back`` no longer holds."""
        return replace(
            self, item=self.item[rows], videos=self.videos[rows], sample=self.sample[rows]
        )


@dataclass(frozen=True)
class Matches:
    """Results for the entries of test.

    Attributes:
        score: (e,) in [0, 1].
        place: (e,) the best match among the entries of train, -1 for none.
        similarity: (e,) of the best match.
        cause: (e,) ``content`` at or over the threshold, else ''.
        calibration: the threshold.
        by_videos: whether scores are above the level of unrelated images.
    """

    score: Floats
    place: Ints
    similarity: Floats
    cause: NDArray[np.str_]
    calibration: Calibration
    by_videos: bool


@dataclass(frozen=True)
class Matcher:
    """One kind of features of one pool, and how they are judged.

    Attributes:
        similarity: the features.
        rate: share of unrelated samples that may be flagged.
        blank: (items,) images that show nothing and are no evidence; None: none.
        progress: callback.
    """

    similarity: Similarity
    rate: float
    blank: NDArray[np.bool_] | None
    progress: Progress

    def match(self, base: Entries, queries: Entries) -> Matches:
        """Best matches of all test entries with their scores."""
        place, similarity = best_matches(
            self.similarity, queries.item, base.item, progress=self.progress
        )
        limit, by_videos = self.calibrate(base, queries)
        level = self.levels(base, queries, place) if by_videos else 0.0
        score = calibration.score(calibration.fisher(similarity), level)
        equal = similarity >= self.similarity.same
        if len(base):
            equal |= (place >= 0) & (queries.item == base.item[place])
        score[equal] = 1.0  # however many others are similar to it
        cause = np.where(score >= limit.threshold, "content", "").astype("<U15")
        return Matches(score, place, similarity, cause, limit, by_videos)

    def calibrate(self, base: Entries, queries: Entries) -> tuple[Calibration, bool]:
        """The threshold, and whether it comes from videos.

        Test never enters the null: copies of train images are what test is searched for.
        """
        reason = Note("threshold-few-videos")
        rows = np.flatnonzero(base.videos >= 0)
        if len(np.unique(base.videos[rows])) >= 2 and len(rows) >= calibration.FEWEST:
            chosen = rng_for(0, "near-duplicates", "null").permutation(rows)[:NULL_SAMPLES]
            null = base.only(np.sort(chosen))
            videos = null.videos, base.videos
            apart, similarity = best_matches(
                self.similarity, null.item, base.item, videos, self.progress
            )
            # The same image in two videos is a copy for certain and says nothing of unrelated ones.
            same = (similarity >= self.similarity.same) | (null.item == base.item[apart])
            known = (apart >= 0) & ~same & self._shown(null)
            if known.sum() >= calibration.FEWEST:
                level = self.levels(base, null, apart)
                excess = calibration.fisher(similarity[known]) - level[known]
                limit = calibration.other_videos(excess, self.rate)
                if limit.threshold <= calibration.TRUSTED:
                    return limit, True
                reason = Note("threshold-untrusted", {"threshold": round(limit.threshold, 3)})
        limit = self._random_pairs(base.only(self._shown(base)), queries.only(self._shown(queries)))
        return replace(limit, notes=[reason, *limit.notes]), False

    def levels(self, base: Entries, queries: Entries, match: Ints) -> Floats:
        """How similar unrelated images are to each query, by the same random train entries for all.

        Args:
            base: of train.
            queries: of test.
            match: (q,) places in base, -1 for none; other images of its video are no evidence.
        """
        rng = rng_for(0, "near-duplicates", "cohort")
        cohort = np.sort(rng.permutation(len(base))[: calibration.COHORT])
        if not len(cohort) or not len(queries):
            return np.zeros(len(queries), np.float32)
        items = base.item[cohort]
        z = calibration.fisher(self.similarity.grid(queries.item, items, self.progress))
        # Copies of the query are not unrelated, and must not raise the level.
        z[(queries.item[:, None] == items) | (z >= calibration.COPY)] = np.nan
        videos = np.where(match >= 0, base.videos[match], -1)
        return calibration.levels(z, queries.videos, videos, base.videos[cohort])

    def _shown(self, entries: Entries) -> NDArray[np.bool_]:
        """Entries whose image shows something."""
        return np.ones(len(entries), bool) if self.blank is None else ~self.blank[entries.item]

    def _random_pairs(self, base: Entries, queries: Entries) -> Calibration:
        """The threshold where no videos are known."""
        count = len(base)
        if not count or not len(queries):
            return calibration.uncalibrated(self.rate)
        rng = rng_for(0, "near-duplicates", "random pairs")
        chosen = rng.permutation(len(queries))[:RANDOM_QUERIES]
        rows: list[Floats] = []
        for part in np.array_split(chosen, min(RANDOM_ROUNDS, len(chosen))):
            other = base.only(rng.permutation(count)[:RANDOM_WIDTH])
            items, videos = queries.item[part][:, None], queries.videos[part][:, None]
            z = calibration.fisher(self.similarity.grid(items[:, 0], other.item, self.progress))
            z[(items == other.item) | ((videos == other.videos) & (videos >= 0))] = np.nan
            rows.append(rng.permuted(z, axis=1))
        return calibration.random_pairs(np.concatenate(rows), count, self.rate)
