"""Squared maximum mean discrepancy with the Gaussian kernel, in three estimators, from blocked sums.

For sets X (m rows) and Y (n rows), with mean kernels XX, YY inside the sets and XY across:

``dist^2(X, Y) = scale * (XX + YY - 2 XY)``  (paper, Eq. 2, times scale)

* ``unbiased``: XX and YY over pairs i != j, divided by m(m-1) and n(n-1) -- Eq. 2 as printed. Can be negative.
* ``biased``: XX and YY over all pairs, divided by m^2 and n^2; what CMMD's published code computes. Larger by ``scale * [(1 - XX)/m + (1 - YY)/n]``.
* ``grouped``: pairs of the same group (video) are left out of all three sums, divided by the pairs that are left. Frames of a
  video are not independent; with 40 videos of 15 frames the unbiased form is +0.1 too large under the null, this one is not.

The kernel is linear in x.y to one per cent on unit-norm features with sigma = 10: the value is about 9.9 ||mean(X) - mean(Y)||^2 at scale 1000.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from palpate.core import PalpateError
from palpate.metrics.checks import Normalize, checked_choice, checked_names, checked_pair, checked_positive
from palpate.metrics.kernels import Array, Index, Totals, pair_sums

Estimator = Literal["unbiased", "biased", "grouped"]
ESTIMATORS = ("unbiased", "biased", "grouped")


def mmd_matrix(t: Totals, estimator: Estimator, scale: float) -> Array:
    """Eq. 2 between every two segments, (S, S); NaN where an estimator has no pairs to average. The diagonal has no meaning.

    k - 1 stands for k everywhere: the constant cancels, as XX + YY - 2 XY weighs it 1 + 1 - 2.
    """
    cross_sums, cross_pairs = t.sums, np.outer(t.n, t.n)
    if estimator == "grouped":
        cross_sums, cross_pairs = t.sums - t.same, cross_pairs - t.pairs
    inner_sums, inner_pairs = np.diagonal(cross_sums), np.diagonal(cross_pairs)
    if estimator == "unbiased":
        inner_pairs = t.n * (t.n - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inner, cross = inner_sums / inner_pairs, cross_sums / cross_pairs
        return scale * (inner[:, None] + inner[None, :] - 2 * cross)  # Eq. 2


def unit_index(*columns: Sequence[str]) -> list[Index]:
    """Integers for names, the same integer for the same name in every column."""
    _, inverse = np.unique(np.concatenate([np.asarray(c, dtype=object).astype(str) for c in columns]), return_inverse=True)
    return list(np.split(inverse.astype(np.intp), np.cumsum([len(c) for c in columns])[:-1]))


def mmd2(
    x: Any,
    y: Any,
    *,
    sigma: float = 10.0,
    scale: float = 1000.0,
    estimator: Estimator = "unbiased",
    groups_x: Sequence[str] | None = None,
    groups_y: Sequence[str] | None = None,
    normalize: Normalize = "check",
    block: int = 2048,
) -> float:
    """Squared MMD between two sets of features (paper, Eq. 2), times ``scale``.

    Args:
        x: (m, d) features; anything ``np.asarray`` takes.
        y: (n, d) features; m and n may differ.
        sigma: bandwidth of the Gaussian kernel.
        scale: factor on the result; 1000 as in CMMD.
        estimator: ``"unbiased"``, ``"biased"`` or ``"grouped"``, see the module.
        groups_x: m group names, for ``"grouped"``; the same name in both sets is the same group.
        groups_y: n group names.
        normalize: ``"check"`` refuses rows not of unit length (1e-3), ``True`` normalises, ``False`` takes them as they are.
        block: rows of a kernel block; memory is about ``block^2`` numbers.

    Returns:
        The value; float32 features with an error below 1e-6 at scale 1000, float64 below 1e-9.

    Raises:
        PalpateError: on features that :func:`palpate.metrics.checks.checked_features` refuses, fewer than two rows for
            ``"unbiased"``, missing groups, or fewer than two groups a set for ``"grouped"``.
    """
    checked_choice("estimator", estimator, ESTIMATORS)
    checked_positive(sigma=sigma, scale=scale, block=block)
    x, y = checked_pair(x, y, normalize=normalize, least=1 if estimator == "biased" else 2)
    units = np.arange(len(x) + len(y))
    if estimator == "grouped":
        gx, gy = checked_names("groups_x", groups_x, len(x)), checked_names("groups_y", groups_y, len(y))
        if gx is None or gy is None:
            raise PalpateError('estimator="grouped" must know the groups of both sets', "none", "Pass groups_x and groups_y")
        units = np.concatenate(unit_index(gx, gy))
    sets = np.repeat(np.arange(2), [len(x), len(y)])
    sums = pair_sums(np.concatenate([x, y]), sets, units, segments=2, sigma=sigma, block=block)
    value = float(mmd_matrix(sums.totals, estimator, scale)[0, 1])
    if not np.isfinite(value):
        got = f"{len(set(groups_x or ()))} and {len(set(groups_y or ()))} groups"
        raise PalpateError("Each set must have at least two groups, not all shared", got, 'Use estimator="unbiased", or more groups')
    return value
