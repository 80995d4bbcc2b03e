"""Means over samples, whose groups (videos) are left out in turn; one encoder or several trainings.

A mean is ``theta = sum_i w_i v_i / sum_i w_i``; ``theta_g`` is the same without group g, and
``SE_video^2 = (G-1)/G sum_g (theta_g - mean theta_g)^2`` the leave-one-group-out jackknife.

A statistic of several means (a difference, a ratio) loses group g from all of them at once, so what
is easy or hard about a video cancels. The means need not share samples: two splits test different
frames of the same videos, and a group that a mean lacks does not change it.

Of S trainings the mean over seeds counts, and ``SE^2 = SE_video^2 + s^2 / S`` with s the deviation
between seeds: both videos and seeds are samples of what could have been. What the two share is
counted twice, so the interval errs on the wide side. Degrees of freedom are Satterthwaite's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import Score
from palpate.metrics.inputs import Array
from palpate.metrics.intervals import Spread, jackknife_error, score_of

#: (..., K) means -> (...) their statistic.
Statistic = Callable[[Array], Array]


@dataclass(frozen=True)
class Mean:
    """A score in [0, 1] and the samples that it is the weighted mean of.

    Attributes:
        score: the score; its value is the mean.
        values, weights: (n,) one a sample.
        groups: n names.
    """

    score: Score
    values: Array
    weights: Array
    groups: NDArray[np.str_]

    def without(self, names: NDArray[np.str_]) -> Array:
        """(G,) the mean without each of the sorted ``names``; NaN where nothing is left."""
        listed = np.isin(self.groups, names)
        at = np.searchsorted(names, self.groups[listed])
        above, below = (
            part.sum() - np.bincount(at, part[listed], len(names))
            for part in (self.weights * self.values, self.weights)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(below > 1e-9 * self.weights.sum(), above / below, np.nan)


def mean_of(
    metric: str,
    values: NDArray[Any],
    groups: Sequence[str],
    *,
    subject: str,
    weights: Array | None = None,
    **fields: Any,
) -> Mean:
    """Mean of values (n,) in [0, 1], weighted (n,) or not, as a score with an interval over groups.

    ``subject`` is what is scored; ``fields`` are further fields of the score.
    """
    values = np.asarray(values, dtype=np.float64)
    weights = np.ones(len(values)) if weights is None else weights
    score = Score(metric, subject, float(weights @ values / weights.sum()))
    mean = Mean(score, values, weights, np.array(groups, dtype=str))
    score = score_of(
        metric,
        subject,
        spread_of([[mean]]),
        (0.0, 1.0),
        **{"higher_is_better": True, "n": len(values)} | fields,
    )
    return replace(mean, score=score)


def over_seeds(runs: Sequence[Mean]) -> Score:
    """The mean of several trainings as one score, with the interval over videos and seeds."""
    spread = spread_of([runs])
    first = runs[0].score
    interval = spread.interval(0.0, 1.0)
    return replace(
        first,
        value=spread.value,
        interval=interval,
        interval_method=spread.method if interval else "",
        encoder=None,
        seed=None,
        details={**first.details, "by_seed": [run.score.value for run in runs]},
    )


def spread_of(
    terms: Sequence[Sequence[Mean]], statistic: Statistic = lambda m: m[..., 0]
) -> Spread:
    """A statistic (..., K) of K means over S trainings, with its error by groups and seeds."""
    names = np.unique(np.concatenate([run.groups for runs in terms for run in runs]))
    by_seed = np.array([[run.score.value for run in runs] for runs in terms]).T  # (S, K)
    without = np.array([[run.without(names) for run in runs] for runs in terms])  # (K, S, G)
    g, s = len(names), len(by_seed)
    value = float(statistic(by_seed.mean(axis=0)))
    replicates = statistic(without.mean(axis=1).T)
    if s == 1:
        return Spread.of(value, replicates)
    of_groups = jackknife_error(replicates) ** 2
    of_seeds = float(np.var(statistic(by_seed), ddof=1)) / s
    parts = of_groups**2 / max(g - 1, 1) + of_seeds**2 / (s - 1)
    df = (of_groups + of_seeds) ** 2 / parts if parts > 0 else g - 1
    method = f"jackknife over {g} groups and deviation of {s} seeds, t, {df:.1f} df"
    return Spread(value, float(np.sqrt(of_groups + of_seeds)), df, method)
