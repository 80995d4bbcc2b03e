"""Near-duplicate pictures in vision and touch, which no metadata reveals.

Every test sample gets the train sample that its picture is most like, a score in [0, 1], and, at or over a threshold calibrated on the data, the cause:

=================  ========================================================================================================
cause              when
=================  ========================================================================================================
content            the pictures themselves are alike (touch: what the contact adds to the passive gel); only this is a leak
nothing touched    both show nothing: blank photos, or tactile images that are no more than untouched gel (``pool``)
sensor drift       touches alike only in what varies slowly over the picture, or in what the passive gel shows at another time
                   (other backgrounds of the same video): light, gel and residue, not contact
=================  ========================================================================================================

Steps: thumbnails and background (``descriptors``, ``background``), candidates by nearest neighbours (``search``), similarity (``verify``), score and threshold (``calibrate``).
Between blank pictures the score is 1 - (root mean square difference of the thumbnails, the whole picture) / 32 grey levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError, Progress, quiet, rng_for
from palpate.data.manifest import Manifest
from palpate.leakage import calibrate
from palpate.leakage.calibrate import Calibration
from palpate.leakage.causes import blank_matches, gel_at_other_times
from palpate.leakage.compare import Comparer, Embeddings, Plates, best_matches
from palpate.leakage.pool import Pool, codes, plates, pool
from palpate.leakage.verify import Floats, Ints

MODALITIES = ("vision", "touch")
#: Samples whose best match in other videos makes the null.
NULL_SAMPLES = 4000
#: So many of train are enough, else those of test are added.
ENOUGH = 100
#: Queries that random pairs are drawn for where no videos are known.
RANDOM_QUERIES = 1500
#: In how many rounds, and how many train pictures each round draws.
RANDOM_ROUNDS, RANDOM_WIDTH = 12, 64


@dataclass(frozen=True)
class NearMatches:
    """What near-duplicate detection found, sample by sample of test.

    Attributes:
        modality: ``vision`` or ``touch``.
        score: (n_test,) in [0, 1], of the most similar train sample (see ``calibrate``); NaN where the picture cannot be looked at.
        nearest: (n_test,) its row in train; -1 where there is none.
        flag: (n_test,) a near-duplicate of content: a leak.
        cause: (n_test,) one of ``palpate.core.CAUSES`` at or over the threshold, else ``""``.
        threshold: the score from which pictures are near-duplicates.
        false_positives: share of unrelated samples over it that it was calibrated to.
        edges, unrelated, found: histograms of the scores of unrelated best matches and of test against train, over the same bins.
        notes: sentences for people.
        settings: what was compared and how.
    """

    modality: str
    score: Floats
    nearest: Ints
    flag: NDArray[np.bool_]
    cause: NDArray[np.str_]
    threshold: float
    false_positives: float
    edges: list[float]
    unrelated: list[int]
    found: list[int]
    notes: list[str]
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Entries:
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
    def of(cls, item: Ints, videos: Ints) -> _Entries:
        use = np.flatnonzero(item >= 0)
        pairs, first, place = np.unique(np.stack([item[use], videos[use]], axis=1), axis=0, return_index=True, return_inverse=True)
        back = np.full(len(item), -1, np.int64)
        back[use] = place.ravel()
        return cls(pairs[:, 0], pairs[:, 1], use[first], back)

    def __len__(self) -> int:
        return len(self.item)


def near_duplicates(
    train: Manifest,
    test: Manifest,
    modality: str,
    *,
    false_positives: float = 0.001,
    features: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
    feature_name: str = "",
    cache: Path | None = None,
    processes: int | None = None,
    progress: Progress = quiet,
) -> NearMatches:
    """Finds test samples whose picture is nearly that of a train sample.

    Args:
        train: the samples to compare with.
        test: the samples to judge.
        modality: ``vision`` or ``touch``.
        false_positives: share of unrelated samples that may be flagged, in (0, 0.1].
        features: a trained tower's embeddings of train and test, (n_train, d) and (n_test, d), to compare instead of the pictures; causes are then all ``content``.
        feature_name: names them, e.g. an encoder's digest.
        cache: folder for thumbnails, so that a rerun is quick; None keeps nothing.
        processes: that decode; None takes one a core.
        progress: told about the work.

    Raises:
        PalpateError: on an unknown modality, a rate out of range, or embeddings that do not fit the samples.
    """
    _check(modality, false_positives, features, (len(train), len(test)))
    if features is not None:
        comparer: Comparer = Embeddings(np.concatenate([np.asarray(f, np.float32) for f in features]), feature_name or "embeddings given")
        item, videos, pictures = np.arange(len(train) + len(test)), codes((train, test), "video"), None
    else:
        pictures, fine = pool(train, test, modality, cache=cache, processes=processes, progress=progress)
        comparer, item, videos = Plates(fine), pictures.item, pictures.videos
    cut = len(train)
    base, queries = _Entries.of(item[:cut], videos[:cut]), _Entries.of(item[cut:], videos[cut:])
    found = _match(comparer, base, queries, false_positives, pictures, progress)
    if pictures is not None and modality == "touch":
        found = _name_drift(found, pictures, comparer, base, queries, false_positives, progress)
    return _spread(found, modality, false_positives, comparer, base, queries, len(test), pictures)


@dataclass(frozen=True)
class _Found:
    """Results for the entries of test."""

    score: Floats
    place: Ints
    similarity: Floats
    cause: NDArray[np.str_]
    calibration: Calibration


def _match(comparer: Comparer, base: _Entries, queries: _Entries, rate: float, pictures: Pool | None, progress: Progress) -> _Found:
    """Best matches of all test entries, their scores and causes (but for drift)."""
    place, similarity = best_matches(comparer, queries.item, base.item, progress=progress)
    null = _null_sample(base, queries)
    z = calibrate.fisher(similarity)
    level: Floats | float = 0.0
    cohort = _cohort(base)
    if null is None:
        calibration = _from_random_pairs(comparer, base, queries, rate, progress)
    else:
        level = _levels(comparer, base, queries, place, cohort, progress)
        apart, alike = best_matches(comparer, null.item, base.item, null.videos, base.videos, progress)
        has = apart >= 0
        excess = calibrate.fisher(alike) - _levels(comparer, base, null, apart, cohort, progress)
        use = has if pictures is None else has & ~pictures.blank[null.item]
        excess = excess[use]
        calibration = calibrate.other_videos(excess, rate) if len(excess) >= calibrate.FEWEST else calibrate.uncalibrated(rate)
    score = calibrate.score(z, level)
    cause = np.where(score >= calibration.threshold, "content", "").astype("<U15")
    if pictures is not None:
        score, place, cause = blank_matches(pictures, queries.item, base.item, score, place, cause, calibration.threshold)
    return _Found(score, place, similarity, cause, calibration)


def _null_sample(base: _Entries, queries: _Entries) -> _Entries | None:
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
    return _Entries(item, videos, np.arange(len(item)), np.arange(len(item)))


def _cohort(base: _Entries) -> Ints:
    """Random train entries, the same for all queries."""
    return np.sort(rng_for(0, "near-duplicates", "cohort").permutation(len(base))[: calibrate.COHORT])


def _levels(comparer: Comparer, base: _Entries, queries: _Entries, match: Ints, cohort: Ints, progress: Progress) -> Floats:
    """How alike unrelated pictures are to each query."""
    if not len(cohort) or not len(queries):
        return np.zeros(len(queries), np.float32)
    z = calibrate.fisher(comparer.grid(queries.item, base.item[cohort], progress))
    z[queries.item[:, None] == base.item[cohort][None]] = np.nan
    matched = np.where(match >= 0, base.videos[np.maximum(match, 0)], -1)
    return calibrate.levels(z, queries.videos, matched, base.videos[cohort])


def _from_random_pairs(comparer: Comparer, base: _Entries, queries: _Entries, rate: float, progress: Progress) -> Calibration:
    """The threshold where no videos are known."""
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


def _name_drift(
    found: _Found, pictures: Pool, comparer: Comparer, base: _Entries, queries: _Entries, rate: float, progress: Progress
) -> _Found:
    """Tells touches that are alike through the state of the sensor from those alike in content."""
    cause = found.cause.copy()
    content = np.flatnonzero(cause == "content")
    if len(content):
        gel = gel_at_other_times(pictures, queries.item[content], queries.videos[content])
        cause[content[gel >= found.similarity[content] * GEL_SHARE]] = "sensor drift"
    slow = _match(Plates(plates(pictures, slow=True)[0]), base, queries, rate, None, progress)
    only = (slow.cause == "content") & (found.cause == "") & ~pictures.blank[queries.item]
    score = np.where(only, np.maximum(slow.score, found.calibration.threshold), found.score).astype(np.float32)
    cause[only] = "sensor drift"
    return replace(found, cause=cause, score=score, place=np.where(only, slow.place, found.place))


#: Share of a pair's similarity that the passive gel must reach to be the reason for it.
GEL_SHARE = 0.65


def _spread(
    found: _Found, modality: str, rate: float, comparer: Comparer, base: _Entries, queries: _Entries, count: int, pictures: Pool | None
) -> NearMatches:
    """From entries to the samples of test."""
    has = queries.back >= 0
    score, nearest = np.full(count, np.nan, np.float32), np.full(count, -1, np.int64)
    cause = np.full(count, "", "<U15")
    if len(queries) and len(base):
        at = queries.back[has]
        score[has], cause[has] = found.score[at], found.cause[at]
        nearest[has] = np.where(found.place[at] >= 0, base.sample[np.maximum(found.place[at], 0)], -1)
    edges, unrelated, histogram = calibrate.histograms(found.calibration.unrelated, score)
    notes = [*(pictures.notes if pictures is not None else []), *found.calibration.notes]
    settings = {
        "features": comparer.name, "pictures": len(base) + len(queries), "false_positives": rate,
        "unrelated": len(found.calibration.unrelated), "blank_limit": pictures.limit if pictures is not None else None,
    }  # fmt: skip
    return NearMatches(
        modality, score, nearest, cause == "content", cause, found.calibration.threshold, rate, edges, unrelated, histogram, notes, settings
    )


def _check(modality: str, rate: float, features: tuple[NDArray[np.float32], NDArray[np.float32]] | None, counts: tuple[int, int]) -> None:
    if modality not in MODALITIES:
        raise PalpateError("The modality must be vision or touch", repr(modality), "Pass one of them")
    if not 0 < rate <= 0.1:
        raise PalpateError("The false-positive rate must lie in (0, 0.1]", str(rate), "Pass e.g. 0.001")
    if features is None:
        return
    shapes = [np.asarray(f).shape for f in features]
    if any(len(s) != 2 for s in shapes) or tuple(s[0] for s in shapes) != counts or shapes[0][1] != shapes[1][1]:
        raise PalpateError(
            f"The embeddings must be (n, d), a row a sample: {counts[0]} of train, {counts[1]} of test",
            " and ".join(str(s) for s in shapes), "Embed the same manifests",
        )  # fmt: skip
    if not all(np.isfinite(f).all() for f in features):
        raise PalpateError("The embeddings must be finite", "a number that is not", "Embed the pictures again")
