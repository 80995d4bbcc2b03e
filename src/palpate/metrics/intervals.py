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


def mean_interval(
    values: Array, groups: Sequence[str] | None, level: float
) -> tuple[Interval | None, str]:
    """Interval of the mean of ``values``, robust to whole groups deviating together.

    ``SE^2 = G/(G-1) * sum_g (sum_{i in g} (v_i - mean))^2 / n^2``; groups of equal size make it the t interval over group means,
    and groups of one the usual interval. Returns (interval or None, method).
    """
    names = (
        np.arange(len(values))
        if groups is None
        else np.unique(np.asarray(groups, dtype=str), return_inverse=True)[1]
    )
    what, g = ("group" if groups is not None else "image"), int(names.max(initial=-1)) + 1
    if g < 2:
        return None, ""
    drift = np.bincount(names, weights=values - values.mean())
    error = float(np.sqrt(g / (g - 1) * (drift**2).sum())) / len(values)
    if error == 0:  # no variation between groups is no evidence of certainty
        return None, ""
    method = (
        "cluster-robust over groups" if groups is not None else "per image, taken as independent"
    )
    return t_interval(
        float(values.mean()), error, g - 1, level
    ), f"{method}, t, {g - 1} df ({g} {what}s)"


def halves_of(n: Array) -> Array:
    """(K, 2) sizes of the halves of (K,) samples: as equal as they can be."""
    return np.stack([np.ceil(n / 2), np.floor(n / 2)], axis=1)


def random_halves_sd(spread: Array, sizes: Array, estimator: str, scale: float) -> Array:
    """Standard deviation (K,) of dist^2 between two random halves of each of K sets, by closed form.

    Let s = +-1 mark halves of m and m' samples, n = m + m', D = m - m', and Kc be the doubly centered kernel matrix, whose rows add up to 0. With
    ``W = sum_{i != j} Kc_ij s_i s_j`` and ``L = sum_i Kc_ii s_i``

    biased = const + W (1/m + 1/m')^2 / 4,   unbiased = const + c W - 2 b L,

    c = [1/(m(m-1)) + 1/(m'(m'-1))] / 4 + 1/(2 m m'), b = [1/(m(m-1)) - 1/(m'(m'-1))] / 4, which is 0 for equal halves. Variances follow from
    the mean products of one to four distinct signs over all halvings: p1 = D/n, p2 = (D^2 - n) / (n(n-1)),
    p3 = (D^3 - (3n-2) D) / (n(n-1)(n-2)), p4 = (D^4 - (6n-8) D^2 + 3n^2 - 6n) / (n(n-1)(n-2)(n-3)). The mean is exactly 0 for unbiased (for any
    data), and (1/m + 1/m') (mean diagonal k - mean off-diagonal k) for biased.

    Args:
        spread: (K, 3): S, sum over i != j of Kc_ij^2; T and Q, sums of Kc_ii and of their squares.
        sizes: (K, 2) m and m'.
        estimator: ``"biased"``, or any other for unbiased.
        scale: factor on the result.
    """
    (off, trace, squares), (x, y) = spread.T, sizes.T
    n, d = x + y, x - y
    with np.errstate(divide="ignore", invalid="ignore"):
        p1, p2, p3 = (
            d / n,
            (d**2 - n) / (n * (n - 1)),
            (d**3 - (3 * n - 2) * d) / (n * (n - 1) * (n - 2)),
        )
        p4 = (d**4 - (6 * n - 8) * d**2 + 3 * n**2 - 6 * n) / (n * (n - 1) * (n - 2) * (n - 3))
        var_w = (
            2 * off
            + 4 * p2 * (squares - off)
            + p4 * (trace**2 - 2 * off - 4 * (squares - off))
            - (p2 * trace) ** 2
        )
        var_l = squares * (1 - p1**2) + (trace**2 - squares) * (p2 - p1**2)
        both = -2 * p1 * squares + p3 * (2 * squares - trace**2) + p1 * p2 * trace**2
        if estimator == "biased":
            c, b = (1 / x + 1 / y) ** 2 / 4, 0.0
        else:
            own, other = 1 / (x * (x - 1)), 1 / (y * (y - 1))
            c, b = (own + other) / 4 + 1 / (2 * x * y), (own - other) / 4
        variance = c**2 * var_w + 4 * b**2 * var_l - 4 * b * c * both
        few = (n < 4) | (sizes.min(axis=1) < (1 if estimator == "biased" else 2))
        return np.where(few, np.nan, scale * np.sqrt(np.maximum(variance, 0)))
