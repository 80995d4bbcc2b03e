"""From similarities to a score with one threshold, calibrated on pairs known to be unrelated.

*Score.* Some images are similar to everything (the round print of a flat thing on a gel), others to
nothing, so a similarity s says little alone. With z = artanh s (Fisher) and c the level of
unrelated images for this query (the mean of its highest 1/32 of z against 128 random train images,
without those of its video and of the match's; Auckenthaler et al. 2000 call this test
normalization), it is

    tanh(z - c),  0 where that is negative:

0 = no more similar than unrelated images are, 1 = the same image. Without videos c is 0.

*Threshold with videos.* The scores of samples' best matches in OTHER videos are the null. Real
near-duplicates may hide in it (a recording that was uploaded twice), so its tail cannot be
trusted: a Gumbel distribution, the limit law of a best match among many, is fitted to the
quantiles 10 to 70 %; matches so high that not one in 6 sets of q unrelated matches would hold them
are taken for such duplicates and excluded (three rounds); of the others the highest tenth gives an
exponential tail (rate = mean excess), and the threshold is where that tail falls to the wanted
rate, but at least 0.55. Above 0.9 it is not trusted: train is full of copies (a third of the null
is enough), and random pairs set the threshold.

*Threshold without.* A random pair is almost always unrelated. Queries are compared with random
train images in blocks of B, a Gumbel distribution is fitted to the bulk of the blocks' best z, and
since the best of m independent blocks is Gumbel again, moved by scale * ln m, the threshold is the
quantile for a train part of N images, m = N / B. B = 1 bears the most related pairs among the
random ones (up to a quarter) but is carried furthest; the lowest threshold of B = 1, 2, 4 ... 64
counts, larger blocks only where a fit up to their 90 % quantile is no more than 1.25 times as
wide; at least 0.86.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from palpate.core import Note
from palpate.leakage.correlation import Floats, Ints

COHORT = 128
#: Share of the cohort that makes a query's level.
TOP = 1 / 32
#: z of two equal images would be infinite.
HIGHEST = 0.9995
#: Sizes of the blocks of random pairs, and how much wider the fit up to their 90 % quantile may be.
BLOCKS, SPREAD = (1, 2, 4, 8, 16, 32, 64), 1.25
#: Unrelated best matches that a calibration needs, and the threshold with fewer: z = 1.1.
FEWEST, DEFAULT = 30, 0.8
#: Rounds of excluding copies from the null; one unrelated match in how many sets may be lost by it.
ROUNDS, ODDS = 3, 6
#: Lowest thresholds with videos and without: a small excess is no near-duplicate.
LEAST_EXCESS, LEAST = 0.55, 0.86
#: A higher threshold from other videos shows copies in train, or features without use.
TRUSTED = 0.9
#: z from which an image of the cohort is a copy of the query: a similarity of 0.95.
COPY = float(np.arctanh(0.95))
BINS = 50


@dataclass(frozen=True)
class Calibration:
    """A threshold, the (q,) scores of unrelated pairs that it was made from, and notes on it."""

    threshold: float
    unrelated: Floats = field(default_factory=lambda: np.zeros(0, np.float32))
    notes: list[Note] = field(default_factory=list)


def fisher(similarity: Floats) -> Floats:
    """artanh, of similarities clipped to [0, 0.9995]."""
    return np.arctanh(np.clip(similarity, 0, HIGHEST)).astype(np.float32)


def score(z: Floats, level: Floats | float = 0.0) -> Floats:
    """tanh(z - level), at least 0; NaN stays NaN."""
    return np.maximum(np.tanh(z - level), 0).astype(np.float32)


def levels(z: Floats, videos: Ints, match: Ints, cohort: Ints) -> Floats:
    """How similar unrelated images are to each query.

    Args:
        z: (q, m) of queries and cohort; NaN where they are the same image.
        videos: (q,) video of each query, -1 unknown.
        match: (q,) video of its best match, -1 unknown.
        cohort: (m,) videos of the cohort.

    Returns:
        (q,) the mean of the highest 1/32 (at least one). Where fewer than 8 are left, those of the
        match's video are let in again; a query with none at all takes the median of the others.
    """
    other = (cohort != videos[:, None]) | (videos[:, None] < 0)
    strict = other & ((cohort != match[:, None]) | (match[:, None] < 0))
    few = strict.sum(axis=1) < 8
    strict[few] = other[few]
    values = -np.sort(-np.where(strict & np.isfinite(z), z, -np.inf), axis=1)
    count = np.isfinite(values).sum(axis=1)
    top = np.maximum(1, np.round(count * TOP)).astype(np.int64)
    used = (np.arange(values.shape[1]) < top[:, None]) & np.isfinite(values)
    level = np.where(used, values, 0).sum(axis=1) / top
    if (count == 0).any():
        level[count == 0] = np.median(level[count > 0]) if (count > 0).any() else 0.0
    return level.astype(np.float32)


def gumbel(values: Floats, low: float = 0.1, high: float = 0.7) -> tuple[float, float]:
    """Location and scale of the Gumbel distribution fitted to quantiles of ``values``."""
    at = np.linspace(low, high, 25)
    scale, place = np.polyfit(-np.log(-np.log(at)), np.quantile(values.astype(np.float64), at), 1)
    return float(place), float(max(scale, 1e-4))


def other_videos(excess: Floats, rate: float) -> Calibration:
    """The threshold from best matches in other videos.

    Args:
        excess: (q,) z - level of each sample's best match in other videos; at least ``FEWEST``.
        rate: wanted share of unrelated samples over the threshold.
    """
    kept, scale = excess, 1.0
    for _ in range(ROUNDS):
        place, scale = gumbel(kept)
        kept = excess[excess <= place + scale * -np.log(-np.log1p(-1 / (ODDS * len(excess))))]
    shoulder = float(np.quantile(kept, 0.9))
    tail = kept[kept > shoulder]
    # Ties at the shoulder must not make the mean excess vanish.
    mean = max(float((tail - shoulder).mean()) if len(tail) else scale, scale / 2)
    threshold = max(float(np.tanh(shoulder + mean * np.log(max(0.1 / rate, 1.0)))), LEAST_EXCESS)
    unrelated = score(excess)
    params = {
        "threshold": round(threshold, 3),
        "lowest": threshold <= LEAST_EXCESS,
        "samples": len(excess),
        "rate": rate,
        "over": round(float((unrelated >= threshold).mean()), 4),
    }
    notes = [Note("threshold-other-videos", params)]
    if copies := len(excess) - len(kept):
        notes.append(Note("copies-across-videos", {"count": copies, "of": len(excess)}))
    return Calibration(threshold, unrelated, notes)


def random_pairs(z: Floats, count: int, rate: float) -> Calibration:
    """The threshold from random pairs.

    Args:
        z: (q, m) of queries and random train images; NaN where they are the same image.
        count: train images that a query is compared with in the audit.
        rate: as in :func:`other_videos`.
    """
    best: tuple[float, int, Floats] | None = None
    for block in BLOCKS:
        if block > z.shape[1] or (block > 1 and count < 4 * block):
            break
        blocks = z[:, : z.shape[1] // block * block].reshape(-1, block)
        maxima = np.where(np.isfinite(blocks), blocks, -1).max(axis=1)
        maxima = maxima[maxima > -1]
        if len(maxima) < FEWEST:
            break
        place, scale = gumbel(maxima)
        moved = scale * np.log(max(count / block, 1.0))
        cut = place + moved - scale * np.log(-np.log1p(-rate))
        # Related pairs, and families of similar images, widen the upper part of larger blocks
        # first.
        if block > 1 and gumbel(maxima, high=0.9)[1] > SPREAD * scale:
            continue
        if best is None or cut < best[0]:
            best = (cut, block, (maxima + moved).astype(np.float32))
    if best is None:
        return uncalibrated(rate)
    threshold = max(float(np.tanh(best[0])), LEAST)
    params = {
        "threshold": round(threshold, 3),
        "lowest": threshold <= LEAST,
        "block": best[1],
        "images": count,
        "rate": rate,
    }
    unrelated = np.tanh(best[2]).astype(np.float32)
    return Calibration(threshold, unrelated, [Note("threshold-random-pairs", params)])


def uncalibrated(rate: float) -> Calibration:
    """The answer for sets too small to calibrate on."""
    params = {"fewest": FEWEST, "threshold": DEFAULT, "rate": rate}
    return Calibration(DEFAULT, notes=[Note("threshold-default", params)])


def histograms(unrelated: Floats, scores: Floats) -> tuple[list[float], list[int], list[int]]:
    """Counts of both over the same 50 bins of [0, 1]; NaN counts nowhere."""
    edges = np.linspace(0, 1, BINS + 1)
    first, second = (
        np.histogram(x[np.isfinite(x)], edges)[0].tolist() for x in (unrelated, scores)
    )
    return edges.round(4).tolist(), first, second
