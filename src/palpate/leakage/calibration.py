"""Thresholds from matches that are known to be unrelated, and what the flags then say.

For a train image its best match in *other videos* is known to be no leak. Their similarities are
the null: above its 90 % quantile u an exponential tail of mean excess b is fitted, and a share
``rate`` of unrelated images lies over

    t(rate) = u + b log(.1 / rate).

Where no video is known, images far apart in recording order take that place, if
the order says anything: an image's best match must lie near it more often than chance
has it. A threshold is never replaced by a looser one; without a null nothing is promised.

Several questions (as it is, moved, edited) share the rate. The answer that is rarest by chance
counts, and the score is the similarity of the first question that would be as rare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import poisson

from palpate.leakage.neighbors import Floats, Ints

#: Unrelated matches that a null needs; from how many videos a rate is more than a guess.
FEWEST, VIDEOS = 30, 80
#: Videos below which best matches in other videos say nothing of the tail.
GROUPS = 20
TAIL, BINS = 0.9, 50
#: Least scale of a tail.
NARROWEST = 0.02
#: Flags that chance explains no more often than this are leaks, and a null that is over its
#: threshold so rarely by chance contradicts a rate of MISSED times the promised one.
CHANCE, MISSED = 0.01, 3.0


@dataclass(frozen=True)
class Tail:
    """The exponential tail of a null: location at the 90 % quantile, and mean excess."""

    location: float
    scale: float

    @classmethod
    def of(cls, null: Floats) -> Tail | None:
        """Fit one to (n,) similarities of unrelated images; None if too few are known."""
        known = null[np.isfinite(null)].astype(np.float64)
        if len(known) < FEWEST:
            return None
        location = float(np.quantile(known, TAIL))
        over = known[known > location]
        return cls(location, max(float((over - location).mean()) if len(over) else 0, NARROWEST))

    def threshold(self, rate: float) -> float:
        """The similarity that a share ``rate`` of unrelated images exceeds."""
        return self.location + self.scale * float(np.log(max((1 - TAIL) / rate, 1.0)))


def tails(nulls: Sequence[Floats]) -> list[Tail]:
    """One for each question, that of the question before where its null is too small.

    Args:
        nulls: (n,) similarities of unrelated images for each question; NaN where it has no answer.

    Returns:
        As many; none if the first is too small.
    """
    fitted: list[Tail] = []
    for null in nulls:
        tail = Tail.of(null)
        if tail is None and not fitted:
            return []
        fitted.append(tail or fitted[-1])
    return fitted


def excess(similarities: Any, fitted: Sequence[Tail]) -> Floats:
    """(questions, n): similarities over the location, in units of the scale."""
    return np.stack([(s - t.location) / t.scale for s, t in zip(similarities, fitted, strict=True)])


def score(similarities: Any, fitted: Sequence[Tail]) -> Floats:
    """(n,) of the rarest of (questions, n) answers, the first question's similarity as rare."""
    rarest = np.fmax.reduce(excess(similarities, fitted))
    return (fitted[0].location + fitted[0].scale * rarest).astype(np.float32)


def threshold(fitted: Sequence[Tail], rate: float) -> float:
    """The score that a share ``rate`` of unrelated images exceeds, by any question."""
    return fitted[0].threshold(rate / len(fitted))


def rate_of(score: float, fitted: Sequence[Tail]) -> float:
    """The share of unrelated images that exceeds a score: the inverse of :func:`threshold`."""
    over = np.exp((fitted[0].location - score) / fitted[0].scale)
    return float(len(fitted) * (1 - TAIL) * min(over, 1.0))


def measured(nulls: Sequence[Floats], groups: Ints, rate: float) -> float:
    """The share of unrelated images over a threshold from the other half of the groups.

    Where a half is too small, over the threshold from all.
    """
    half = np.unique(groups, return_inverse=True)[1] % 2 == 0
    over = 0
    for fold in (half, ~half):
        fitted = tails([null[~fold] for null in nulls]) or tails(nulls)
        values = score([null[fold] for null in nulls], fitted)
        over += int((values >= threshold(fitted, rate)).sum())
    return over / len(groups)


def missed(measured: float, count: int, rate: float) -> bool:
    """Whether a measured rate contradicts MISSED times the promised one."""
    over = round(measured * count)
    return over > 0 and bool(poisson.sf(over - 1, MISSED * rate * count) < CHANCE)


def beyond_chance(
    flags: Sequence[tuple[NDArray[np.bool_], float]], groups: Ints, checked: int
) -> bool:
    """Whether there are more flags than chance explains.

    Args:
        flags: (n,) which samples are over the threshold of a rate, for several rates.
        groups: (n,) videos; frames of one are flagged together, so videos are counted.
        checked: samples that could be flagged.
    """
    return any(
        poisson.sf(len(np.unique(groups[flag])) - 1, rate * checked) < CHANCE
        for flag, rate in flags
        if flag.any()
    )


def histograms(unrelated: Floats, scores: Floats) -> tuple[list[float], list[int], list[int]]:
    """Counts of both over the same 50 bins of [0, 1]; NaN counts nowhere."""
    edges = np.linspace(0, 1, BINS + 1)
    first, second = (
        np.histogram(np.clip(x[np.isfinite(x)], 0, 1), edges)[0].tolist()
        for x in (unrelated, scores)
    )
    return edges.tolist(), first if sum(first) else [], second if sum(first) else []
