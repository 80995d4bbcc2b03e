"""Intervals: the leave-one-unit-out jackknife, the cluster-robust mean, and the null of random halves.

Jackknife over G units: ``SE^2 = (G-1)/G * sum_g (theta_g - mean theta)^2``, interval ``theta +- t(G-1) * SE``. Units are whole videos
wherever videos are known: frames of one video are not independent, and a frame-level interval covers the truth in 0 to 41 % of
the cases instead of 95 % (40 videos of 15 frames).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy import special

from palpate.metrics.kernels import Array
from palpate.metrics.sums import Totals

Interval = tuple[float, float]


def t_interval(value: float, error: float, df: int, level: float) -> Interval:
    """``value +- t * error`` with ``df`` degrees of freedom."""
    reach = float(special.stdtrit(df, 0.5 + level / 2)) * error
    return value - reach, value + reach


def jackknife_errors(replicates: Array) -> Array:
    """Standard errors (K,) from leave-one-out values (G, K); NaN where a replicate is undefined or G < 2."""
    g = len(replicates)
    if g < 2:
        return np.full(replicates.shape[1:], np.nan)
    with np.errstate(invalid="ignore"):
        return np.sqrt((g - 1) / g * ((replicates - replicates.mean(axis=0)) ** 2).sum(axis=0))


def leave_one_out(totals: Iterable[Totals], statistic: Callable[[Totals], Array]) -> Array:
    """The statistic (K,) on each of the totals: (G, K)."""
    return np.array([statistic(t) for t in totals], dtype=np.float64)


def mean_interval(values: Array, groups: Sequence[str] | None, level: float) -> tuple[Interval | None, str]:
    """Interval of the mean of ``values``, robust to whole groups deviating together.

    ``SE^2 = G/(G-1) * sum_g (sum_{i in g} (v_i - mean))^2 / n^2``; groups of equal size make it the t interval over group means,
    and groups of one the usual interval. Returns (interval or None, method).
    """
    names = np.arange(len(values)) if groups is None else np.unique(np.asarray(groups, dtype=str), return_inverse=True)[1]
    what, g = ("group" if groups is not None else "image"), int(names.max(initial=-1)) + 1
    if g < 2:
        return None, ""
    drift = np.bincount(names, weights=values - values.mean())
    error = float(np.sqrt(g / (g - 1) * (drift**2).sum())) / len(values)
    if error == 0:  # no variation between groups is no evidence of certainty
        return None, ""
    method = "cluster-robust over groups" if groups is not None else "per image, taken as independent"
    return t_interval(float(values.mean()), error, g - 1, level), f"{method}, t, {g - 1} df ({g} {what}s)"


def random_halves_sd(spread: Array, n: Array, estimator: str, scale: float) -> Array:
    """Standard deviation (K,) of dist^2 between two random halves of each of K sets, by closed form.

    Let z = +-1 mark the halves of n = 2m samples and Kc be the doubly centred kernel matrix. Then biased = z'Kc z / m^2 and
    unbiased = const + z'Kc z (2m-1) / (2m^2 (m-1)), and the variance of z'Kc z over halvings is about 2 sum_{i != j} Kc_ij^2. The
    mean over all halvings is exactly 0 for unbiased (for any data), and (2/m) (1 - mean off-diagonal k) for biased.

    Args:
        spread: (K,) sum over i != j of Kc_ij^2.
        n: (K,) samples.
        estimator: ``"biased"``, or any other for unbiased.
        scale: factor on the result.
    """
    m = n / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = 1 / m**2 if estimator == "biased" else (2 * m - 1) / (2 * m**2 * (m - 1))
        return np.where(n < 4, np.nan, scale * factor * np.sqrt(2 * spread))
