"""Squared maximum mean discrepancy in three estimators, from kernel sums.

For sets X (m rows) and Y (n rows), with mean kernels XX, YY inside the sets and XY across:

``dist^2(X, Y) = scale * (XX + YY - 2 XY)``  (paper, Eq. 2, times scale)

* ``unbiased``: XX and YY over pairs i != j, divided by m(m-1) and n(n-1): Eq. 2 as printed. Can be
  negative.
* ``biased``: XX and YY over all pairs, divided by m^2 and n^2; what CMMD's published code computes.
  Larger by ``scale * [(1 - XX)/m + (1 - YY)/n]``.
* ``grouped``: pairs of the same group (video) are excluded from all three sums. Frames of a video
  are not independent; with 40 videos of 15 frames the unbiased form is +0.1 too large under the
  null.

The kernel is linear in x.y to one per cent on unit-norm features with sigma = 10: the value is
about 9.9 ||mean(X) - mean(Y)||^2 at scale 1000.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from palpate.core import PalpateError, PalpateWarning
from palpate.metrics.inputs import (
    Array,
    Index,
    Normalize,
    checked_choice,
    checked_names,
    checked_number,
    checked_pair,
    checked_whole,
    copies_across,
    invalid,
)
from palpate.metrics.kernels import Kernel, Sigma, checked_kernel, gaussian
from palpate.metrics.pairs import BACKENDS, Backend, kernel_sums
from palpate.metrics.sums import PairSums, Totals

Estimator = Literal["unbiased", "biased", "grouped"]
ESTIMATORS = ("unbiased", "biased", "grouped")


def mmd_matrix(t: Totals, estimator: str, scale: float) -> Array:
    """Eq. 2 between every two segments, (S, S); NaN where there are no pairs to average.

    The diagonal has no meaning. A constant in k cancels, as XX + YY - 2 XY weighs it 1 + 1 - 2.
    """
    inner, cross = _means(t, estimator)
    with np.errstate(invalid="ignore"):
        return scale * (inner[:, None] + inner[None, :] - 2 * cross)  # Eq. 2


def mmd_bound(remainder: Totals, estimator: str, scale: float) -> Array:
    """What :func:`mmd_matrix` may be off by, where sums may be off by ``remainder``."""
    inner, cross = _means(remainder, estimator)
    with np.errstate(invalid="ignore"):
        return scale * (inner[:, None] + inner[None, :] + 2 * cross)


def _means(t: Totals, estimator: str) -> tuple[Array, Array]:
    """Mean kernel inside segments (S,) and between them (S, S), over an estimator's pairs."""
    sums, pairs = t.sums, np.outer(t.n, t.n)
    if estimator == "grouped":
        sums, pairs = t.sums - t.same, pairs - t.pairs
    inner_sums, inner_pairs = np.diagonal(sums), np.diagonal(pairs)
    if estimator == "unbiased":
        inner_pairs = t.n * (t.n - 1)
    if estimator == "biased":
        inner_sums = inner_sums + t.diagonal
    with np.errstate(divide="ignore", invalid="ignore"):
        return inner_sums / inner_pairs, sums / pairs


def largest_bound(sums: PairSums, estimator: str, scale: float) -> float:
    """The largest :func:`mmd_bound` between two segments; 0 where sums are exact."""
    if sums.bound is None:
        return 0.0
    # Where there are no pairs there is nothing to bound; elsewhere a bound that overflowed is none.
    known = np.isfinite(mmd_matrix(sums.totals, estimator, scale))
    known &= ~np.eye(sums.segments, dtype=bool)
    off = mmd_bound(sums.bound.totals, estimator, scale)[known]
    return float(np.where(np.isfinite(off), off, np.inf).max(initial=0.0))


def unit_index(*columns: Sequence[str]) -> Index:
    """Integers for the names of all columns, one column after the other."""
    names = np.concatenate([np.asarray(c, dtype=object).astype(str) for c in columns])
    return np.unique(names, return_inverse=True)[1].astype(np.intp)


@dataclass(frozen=True)
class Distance:
    """A squared MMD and how it was computed.

    Attributes:
        value: times ``scale``; negative values are possible for ``unbiased`` and ``grouped``.
        bound: the value is within this of the exact one (rounding aside); 0 for the blocked back
            end.
        backend: ``"blocked"`` or ``"moments"``.
        estimator: which pairs were averaged.
        kernel: the kernel's settings.
        bandwidth: sigma, or None where there are several or none.
        scale: factor on the raw value.
        m: rows of x.
        n: rows of y.
    """

    value: float
    bound: float
    backend: str
    estimator: Estimator
    kernel: dict[str, Any]
    bandwidth: float | None
    scale: float
    m: int
    n: int

    def __float__(self) -> float:
        """The value."""
        return self.value


def distance(  # noqa: PLR0913
    x: Any,
    y: Any,
    *,
    sigma: Sigma = 10.0,
    kernel: Kernel | None = None,
    scale: float = 1000.0,
    estimator: Estimator = "unbiased",
    groups_x: Any = None,
    groups_y: Any = None,
    normalize: Normalize = "check",
    backend: Backend = "auto",
    tolerance: float = 1e-4,
    block: int = 1024,
    names: tuple[str, str] = ("x", "y"),
) -> Distance:
    """Squared MMD between two sets of features (paper, Eq. 2), times ``scale``.

    Args:
        x: (m, d) features: anything ``np.asarray`` takes, an array on disk (``np.memmap``), or an
            array of a library of the array-API standard (torch on CPU or CUDA), which stays on its
            device.
        y: (n, d) features of the same library; m and n may differ.
        sigma: bandwidth of the Gaussian kernel; several are averaged; ``"median"`` and ``"multi"``
            take the median distance of ``y``.
        kernel: instead of the Gaussian, e.g. :class:`palpate.metrics.Polynomial`.
        scale: factor on the result; 1000 as in CMMD.
        estimator: ``"unbiased"``, ``"biased"`` or ``"grouped"``, see the module.
        groups_x: m group names, for ``"grouped"``; the same name in both sets is the same group.
        groups_y: n group names.
        normalize: ``"check"`` rejects rows not of unit length (1e-3), ``True`` normalizes,
            ``False`` takes them as they are.
        backend: ``"auto"``, ``"blocked"`` or ``"moments"``, see :mod:`palpate.metrics.pairs`.
        tolerance: largest bound that ``auto`` accepts, at scale 1000.
        block: rows of a kernel block; memory is about ``block^2`` numbers a thread.
        names: what errors and warnings call the two sets.

    Returns:
        The value. Blocked: float32 unit-norm features with an error below 1e-4 at scale 1000,
        float64 below 1e-9.

    Raises:
        PalpateError: on features that :func:`palpate.metrics.inputs.checked_features` rejects,
            fewer than two rows for ``"unbiased"``, or groups that are missing or too few for
            ``"grouped"``.
    """
    checked_choice("estimator", estimator, ESTIMATORS)
    checked_choice("backend", backend, BACKENDS)
    checked_number(positive=True, scale=scale)
    checked_number(tolerance=tolerance)
    checked_whole(1, block=block)
    checked_kernel(kernel)
    least = 1 if estimator == "biased" else 2
    x, y = checked_pair(x, y, normalize=normalize, least=least, names=names)
    if copies := copies_across(x, y):
        text = f"{copies} rows of {names[0]} are bit for bit rows of {names[1]}"
        warnings.warn(f"{text}: a copy is not a generator", PalpateWarning, stacklevel=2)
    segment = np.repeat(np.arange(2), [len(x), len(y)])
    unit = segment  # no pair is excluded: a set is one item
    gx = checked_names("groups_x", groups_x, len(x))
    gy = checked_names("groups_y", groups_y, len(y))
    if estimator == "grouped":
        if gx is None or gy is None:
            must = "must be unbiased or biased where the groups of a set are unknown"
            raise invalid("estimator", must, "'grouped'", "Pass groups_x and groups_y")
        unit = unit_index(gx, gy)
    kernel = gaussian(sigma, y, gy) if kernel is None else kernel
    sums = kernel_sums(
        [x, y],
        segment,
        unit,
        segments=2,
        kernel=kernel,
        backend=backend,
        tolerance=tolerance * scale / 1000,
        block=block,
        bound=lambda sums: largest_bound(sums, estimator, scale),
    ).sums
    value = float(mmd_matrix(sums.totals, estimator, scale)[0, 1])
    bound = largest_bound(sums, estimator, scale)
    if not np.isfinite(sums.totals.sums).all():
        fix = "Normalize the rows, or scale them down"
        raise PalpateError("Kernel values must be finite", "infinity or NaN", fix)
    if not np.isfinite(value):
        got = f"{len(set(gx or ()))} and {len(set(gy or ()))} groups"
        must = "Each set must have at least two groups, not all shared"
        raise PalpateError(must, got, "Pass more groups", example={"estimator": "unbiased"})
    if bound > 2 * scale:  # more than the metric can be
        must = "must be wide against the features for the moments back end"
        got = f"a bound of {bound:.2g}"
        raise invalid("sigma", must, got, "Sum blocks", backend="blocked")
    settings, bandwidth = kernel.settings(), kernel.bandwidth
    return Distance(
        value, bound, sums.backend, estimator, settings, bandwidth, scale, len(x), len(y)
    )


def mmd2(x: Any, y: Any, **options: Any) -> float:
    """The value of :func:`distance`, with the same options."""
    return distance(x, y, **options).value
