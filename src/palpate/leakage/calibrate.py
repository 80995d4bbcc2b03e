"""From similarities to a score with one threshold, calibrated on pairs known to be unrelated.

*Score.* Some pictures are like everything (the round print of a flat thing on a gel), others like nothing, so a similarity s says little alone. With
z = artanh s (Fisher) and c the level of unrelated pictures for this query (the mean of its highest 1/32 of z against 128 random train pictures, those of
its own video and of the match's left out; Auckenthaler et al. 2000 call this test normalization), the score is

    tanh(z - c),  0 where that is negative:

0 = no more alike than unrelated pictures are, 1 = the same picture. Without a video column c is 0, since a query's own video cannot be left out: the score is s.

*Threshold with videos known.* The scores of samples' best matches among OTHER videos are the null. Real near-duplicates may hide in it (a recording that was
uploaded twice), so its tail cannot be trusted: a Gumbel distribution, the limit law of a best match among many, is fitted to the quantiles 10 to
70 %; what lies so high that not one in 6 sets of q unrelated matches would hold it is taken for such duplicates and left out (three rounds); of the rest the highest tenth gives an exponential tail
(rate = mean excess), and the threshold is where that tail falls to the wanted rate, but at least 0.55. The share of the null above it is told. Above 0.9 it is not
trusted: train is full of copies (a third of the null is enough), and random pairs set the threshold. Equal pictures score 1, whatever the level.

*Threshold without.* A random pair is almost always unrelated. Queries are compared with random train pictures in blocks of B, a Gumbel distribution is fitted to the
bulk of the blocks' best z in the same way, and since the best of m independent blocks is Gumbel again, moved by scale * ln m, the threshold is the quantile for
a train part of N pictures, m = N / B. B = 1 bears the most related pairs among the random ones (up to a quarter) but is carried furthest; the lowest threshold of
B = 1, 2, 4 ... 64 counts, larger blocks only where a fit up to their 90 % quantile is no more than 1.25 times as wide; never below 0.86.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.leakage.verify import Floats, Ints

COHORT = 128
#: Share of the cohort that makes a query's level.
TOP = 1 / 32
#: z of two equal pictures would be infinite.
HIGHEST = 0.9995
#: Sizes of the blocks of random pairs, and how much wider the fit up to their 90 % quantile may be than that up to 70 %.
BLOCKS = (1, 2, 4, 8, 16, 32, 64)
SPREAD = 1.25
#: Unrelated best matches that a calibration needs.
FEWEST = 30
#: Threshold where nothing can be calibrated: z = 1.1 above the level.
DEFAULT = 0.8
#: Rounds of leaving copies out of the null, and one unrelated best match in how many sets of that size may be lost by it.
ROUNDS, ODDS = 3, 6
#: Lowest threshold with videos: a small excess is no near-duplicate, however alike unrelated pictures are to one another.
LEAST_EXCESS = 0.55
#: Above it a threshold from other videos tells of copies in train, or of features without use, and random pairs set one instead.
TRUSTED = 0.9
#: z from which a picture of the cohort is a copy of the query: a similarity of 0.95.
COPY = float(np.arctanh(0.95))
#: Without videos, pictures less alike than this are no near-duplicates, however unlike unrelated ones are.
LEAST = 0.86
BINS = 50


@dataclass(frozen=True)
class Calibration:
    """A threshold and where it comes from.

    Attributes:
        threshold: scores from here on are near-duplicates.
        unrelated: (q,) the scores of unrelated pairs that it was made from.
        notes: sentences for people.
    """

    threshold: float
    unrelated: Floats
    notes: list[str]


def fisher(similarity: Floats) -> Floats:
    """artanh, of similarities clipped to [0, 0.9995]."""
    return np.arctanh(np.clip(similarity, 0, HIGHEST)).astype(np.float32)


def levels(z: Floats, own: Ints, match: Ints, cohort: Ints) -> Floats:
    """How alike unrelated pictures are to each query.

    Args:
        z: (q, m) of queries and cohort; may be NaN where they are the same picture.
        own: (q,) group of each query, -1 unknown.
        match: (q,) group of its best match, -1 unknown.
        cohort: (m,) groups of the cohort.

    Returns:
        (q,) the mean of the highest 1/32 (at least one). If fewer than 8 are left, those of the match's group are let in again; a query with none at all
        takes the median of the others.
    """
    other = (cohort[None] != own[:, None]) | (own[:, None] < 0)
    strict = other & ((cohort[None] != match[:, None]) | (match[:, None] < 0))
    few = strict.sum(axis=1) < 8
    strict[few] = other[few]
    left = np.where(strict & np.isfinite(z), z, -np.inf)
    left = -np.sort(-left, axis=1)
    count = np.isfinite(left).sum(axis=1)
    top = np.maximum(1, np.round(count * TOP)).astype(np.int64)
    held = np.arange(left.shape[1])[None] < top[:, None]
    level = np.where(held & np.isfinite(left), left, 0).sum(axis=1) / top
    if (count == 0).any():
        level[count == 0] = np.median(level[count > 0]) if (count > 0).any() else 0.0
    return level.astype(np.float32)


def score(z: Floats, level: Floats) -> Floats:
    """tanh(z - level), at least 0; NaN stays NaN."""
    return np.maximum(np.tanh(z - level), 0).astype(np.float32)


def gumbel(values: Floats, low: float = 0.1, high: float = 0.7) -> tuple[float, float]:
    """Location and scale of the Gumbel distribution whose quantiles from ``low`` to ``high`` fit those of ``values`` best (least squares)."""
    at = np.linspace(low, high, 25)
    scale, place = np.polyfit(-np.log(-np.log(at)), np.quantile(values.astype(np.float64), at), 1)
    return float(place), float(max(scale, 1e-4))


def other_videos(excess: Floats, rate: float) -> Calibration:
    """The threshold from best matches among other videos.

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
    mean = max(
        float((tail - shoulder).mean()) if len(tail) else scale, scale / 2
    )  # ties at the shoulder must not make it vanish
    threshold = max(float(np.tanh(shoulder + mean * np.log(max(0.1 / rate, 1.0)))), LEAST_EXCESS)
    unrelated = score(excess, np.zeros_like(excess))
    over = float((unrelated >= threshold).mean())
    lowest = (
        " (the lowest that is allowed; the data alone would set it lower)"
        if threshold <= LEAST_EXCESS
        else ""
    )
    notes = [
        f"Threshold {threshold:.3f}{lowest} from the best matches of {len(excess)} samples in other videos, for {rate:.2%} of unrelated samples; {over:.2%}"
        " of those lie over it."
    ]
    if dropped := len(excess) - len(kept):
        share = f"{dropped} of them ({dropped / len(excess):.1%})"
        notes.append(
            f"{share} are so alike that they are taken for copies across videos and do not set the threshold."
        )
    return Calibration(threshold, unrelated, notes)


def random_blocks(z: Floats, count: int, rate: float) -> Calibration:
    """The threshold from random pairs.

    Args:
        z: (q, m) of queries and random train pictures; NaN where they are the same picture.
        count: train pictures that a query is compared with in earnest.
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
        # Related pairs among the random ones, and families of pictures that are alike, widen the upper part of larger blocks first.
        if block > 1 and gumbel(maxima, high=0.9)[1] > SPREAD * scale:
            continue
        if best is None or cut < best[0]:
            best = (cut, block, (maxima + moved).astype(np.float32))
    if best is None:
        return uncalibrated(rate)
    threshold = max(float(np.tanh(best[0])), LEAST)
    lowest = (
        " (the lowest that is allowed; the data alone would set it lower)"
        if threshold <= LEAST
        else ""
    )
    note = (
        f"Threshold {threshold:.3f}{lowest} from random pairs (in blocks of {best[1]}), carried over to the best of"
        f" {count} train pictures, for {rate:.2%} of unrelated samples."
    )
    return Calibration(threshold, np.tanh(best[2]).astype(np.float32), [note])


def uncalibrated(rate: float) -> Calibration:
    """The answer for sets too small to calibrate on."""
    note = f"Fewer than {FEWEST} pairs are known to be unrelated: the threshold {DEFAULT} is a default, not calibrated to {rate:.2%}."
    return Calibration(DEFAULT, np.zeros(0, np.float32), [note])


def histograms(unrelated: Floats, found: Floats) -> tuple[list[float], list[int], list[int]]:
    """Counts of both over the same 50 bins of [0, 1]; NaN counts nowhere."""
    edges = np.linspace(0, 1, BINS + 1)
    counts: list[NDArray[np.int64]] = [
        np.histogram(x[np.isfinite(x)], edges)[0] for x in (unrelated, found)
    ]
    return edges.round(4).tolist(), counts[0].tolist(), counts[1].tolist()
