"""Thresholds from matches that are known to be unrelated, and what the flags then say.

For a train image its best match in *other videos* is known to be no leak. Their similarities are
the null. A cosine c ends at 1, so tails are those of Fisher's z = artanh c: above its 90 % quantile
u, at least .2, an exponential of mean excess b. What is over u, a share a, comes from k videos
only; with a prior that weighs as much as four videos of mean excess .07, n = k + 4 and
B = (k b + .28) / n, the share of unrelated images that is expected above z is that of a Pareto
distribution,

    a (1 + (z - u) / (n B))^-n,

so thresholds rise where few videos are known, and the promised rate holds from three videos on
(docs/studies/near_duplicates.md).

Where no video is known, images far apart in recording order take that place, if
the order says anything: an image's best match must lie near it more often than chance
has it. A threshold is never replaced by a looser one; without a null nothing is promised.

Several questions (as it is, its cells, edited) share the rate. The answer that is rarest by chance
counts, and the score is the similarity of the first question that would be as rare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from palpate.leakage.neighbors import Floats, Ints

#: Unrelated matches that a null needs.
FEWEST = 20
TAIL, BINS = 0.9, 50
#: The least z of a tail and the fewest images in it: edits of few images of the null are plausible,
#: but those of a sensor that is mounted in another way are.
LEAST, RARE = 0.2, 3
#: The prior of a tail, its weight in videos and mean excess; the cosine at which z ends.
PRIOR, EXCESS, END = 4, 0.07, 0.99999
#: Flags that chance explains no more often than this are leaks, and a null that is over its
#: threshold so rarely by chance contradicts a rate of MISSED times the promised one.
CHANCE, MISSED = 0.01, 3.0


@dataclass(frozen=True)
class Tail:
    """The tail of a null: u, B, n and a of the formula above, and its share of the rate."""

    location: float
    scale: float
    weight: int
    share: float
    above: float = 0.1

    @classmethod
    def of(cls, null: Floats, groups: Ints, share: float) -> Tail | None:
        """Fit one to (n,) similarities of unrelated images; None if too few are known."""
        finite = np.isfinite(null)
        if finite.sum() < FEWEST:
            return None
        z = _fisher(null[finite])
        location = max(float(np.quantile(z, TAIL)), LEAST)
        over = z > location
        videos = len(np.unique(groups[finite][over]))
        excess = videos * float((z[over] - location).mean()) if videos else 0.0
        weight = videos + PRIOR
        scale = (excess + PRIOR * EXCESS) / weight
        return cls(location, scale, weight, share, max(int(over.sum()), RARE) / len(z))

    def surprise(self, similarity: Any) -> Any:
        """-log of the share of the tail that is expected above a similarity."""
        excess = (_fisher(similarity) - self.location) / self.scale
        return np.where(
            excess > 0, self.weight * np.log1p(np.maximum(excess, 0) / self.weight), excess
        )

    def surprise_at(self, rate: float) -> float:
        """The surprise that this question's share of a rate of unrelated images exceeds."""
        return float(np.log(self.above / (rate * self.share)))

    def similarity(self, surprise: Any) -> Any:
        """The inverse of :meth:`surprise`."""
        excess = np.where(
            surprise > 0, self.weight * np.expm1(np.maximum(surprise, 0) / self.weight), surprise
        )
        return np.tanh(self.location + self.scale * excess)


def tails(nulls: Sequence[Floats], groups: Ints, shares: Sequence[float]) -> list[Tail]:
    """One for each question, that of the question before where its null is too small.

    Args:
        nulls: (n,) similarities of unrelated images for each question; NaN where it has no answer.
        groups: (n,) videos of these images.
        shares: of the rate of false positives, for each question; together 1.

    Returns:
        As many; none if the first is too small.
    """
    fitted: list[Tail] = []
    for null, share in zip(nulls, shares, strict=True):
        tail = Tail.of(null, groups, share)
        if tail is None and not fitted:
            return []
        fitted.append(tail or replace(fitted[-1], share=share))
    return fitted


def surprises(similarities: Any, fitted: Sequence[Tail]) -> Floats:
    """(questions, n): how rare answers are by chance, as surprises of the first question."""
    weight = fitted[0].share / fitted[0].above
    return np.stack(
        [
            t.surprise(s) + np.log(t.share / t.above / weight)
            for s, t in zip(similarities, fitted, strict=True)
        ]
    )


def score(similarities: Any, fitted: Sequence[Tail]) -> Floats:
    """(n,) of the rarest of (questions, n) answers, the first question's similarity as rare."""
    rarest = np.fmax.reduce(surprises(similarities, fitted))
    return fitted[0].similarity(rarest).astype(np.float32)


def threshold(fitted: Sequence[Tail], rate: float) -> float:
    """The score that a share ``rate`` of unrelated images exceeds, by any question."""
    return float(fitted[0].similarity(fitted[0].surprise_at(rate)))


def rate_of(score: float, fitted: Sequence[Tail]) -> float:
    """The share of unrelated images that exceeds a score: the inverse of :func:`threshold`."""
    over = np.exp(-max(float(fitted[0].surprise(score)), 0.0))
    return float(fitted[0].above * over / fitted[0].share)


def _fisher(similarity: Any) -> Any:
    return np.arctanh(np.clip(similarity, -END, END))


def measured(nulls: Sequence[Floats], groups: Ints, shares: Sequence[float], rate: float) -> float:
    """The share of unrelated images over a threshold from the other half of the groups.

    Where a half is too small, over the threshold from all.
    """
    half = np.unique(groups, return_inverse=True)[1] % 2 == 0
    over = 0
    for fold in (half, ~half):
        complement = [null[~fold] for null in nulls]
        fitted = tails(complement, groups[~fold], shares) or tails(nulls, groups, shares)
        values = score([null[fold] for null in nulls], fitted)
        over += int((values >= threshold(fitted, rate)).sum())
    return over / len(groups)


def missed(measured: float, count: int, rate: float) -> bool:
    """Whether a measured rate contradicts MISSED times the promised one."""
    over = round(measured * count)
    return over > 0 and bool(scipy.special.pdtrc(over - 1, MISSED * rate * count) < CHANCE)


def beyond_chance(
    flags: Sequence[tuple[NDArray[np.bool_], float]], groups: Ints, checked: int
) -> bool:
    """Whether there are more flags than chance explains.

    Frames of one video may be flagged together. So either more videos are flagged than frames would
    be by chance, or more frames than chance flags in lumps of the most in one video (Bennett's
    inequality for a sum of lumps).

    Args:
        flags: (n,) which samples are over the threshold of a rate, for several rates.
        groups: (n,) videos.
        checked: samples that could be flagged.
    """
    for flag, rate in flags:
        lumps = np.unique(groups[flag], return_counts=True)[1]
        by_chance, found = max(rate * checked, 1e-9), int(lumps.sum())
        if found <= by_chance:
            continue
        ratio = found / by_chance
        bound = np.exp(-by_chance / lumps.max() * (ratio * np.log(ratio) - ratio + 1))
        if min(scipy.special.pdtrc(len(lumps) - 1, by_chance), bound) < CHANCE:
            return True
    return False


def histograms(unrelated: Floats, scores: Floats) -> tuple[list[float], list[int], list[int]]:
    """Counts of both over the same 50 bins of [0, 1]; NaN counts nowhere."""
    edges = np.linspace(0, 1, BINS + 1)
    first, second = (
        np.histogram(np.clip(x[np.isfinite(x)], 0, 1), edges)[0].tolist()
        for x in (unrelated, scores)
    )
    return edges.tolist(), first if sum(first) else [], second if sum(first) else []
