"""Thresholds from matches that are known to be unrelated, and what the flags then say.

For a train image its best match in *other videos* is known to be no leak. Their similarities are
the null: above its 90 % quantile u an exponential tail of mean excess b is fitted, and a share
``rate`` of unrelated images lies over

    t(rate) = u + b log(.1 / rate).

Where no video is known, images more than ``WINDOW`` apart in recording order take that place, if
the order says anything: an image's best match must lie within the window more often than chance
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

#: Rows in recording order within which two images may show one contact.
WINDOW = 16
#: Unrelated matches that a null needs; from how many videos a rate is more than a guess.
FEWEST, VIDEOS = 30, 80
TAIL, BINS = 0.9, 50
#: Least scale of a tail.
NARROWEST = 0.02
#: Matches that must be rarer by chance than this before they are leaks, and by how much more rarely
#: a match must be expected before a few of them are enough.
CHANCE, STRICTER = 0.01, 100.0


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


def measured(nulls: Sequence[Floats], groups: Ints, rate: float) -> float | None:
    """The share of unrelated images over a threshold from the other half of the groups.

    None where a half is too small.
    """
    half = np.unique(groups, return_inverse=True)[1] % 2 == 0
    over = 0
    for fold in (half, ~half):
        fitted = tails([null[~fold] for null in nulls])
        if not fitted:
            return None
        values = score([null[fold] for null in nulls], fitted)
        over += int((values >= threshold(fitted, rate)).sum())
    return over / len(groups)


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
