"""Kernels: what is summed over pairs, and how wide it is.

Every kernel is a function of one matrix product, so that a block of values costs one product and
little more. A constant that is added to a kernel cancels in every MMD estimator; the Gaussian is
therefore summed as ``k - 1 = expm1(-||x - y||^2 / (2 sigma^2))``: on unit-norm features with
sigma = 10, k lies in [0.98, 1], and sums of k itself in float32 lose what matters.

* :class:`Gaussian`: one bandwidth, or the mean over several. ``"median"`` is the median distance
  between samples of different groups, ``"multi"`` the mean of five Gaussians at 1/4 to 4 times
  that.
* :class:`Polynomial`: ``(gamma x.y + coef0)^degree``; degree 3, gamma 1/d, coef0 1 is KID's.
* :class:`Linear`: ``x.y``; its MMD^2 is ``||mean x - mean y||^2``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from palpate.core import PalpateError, rng_for
from palpate.metrics.arrays import host, rows_at
from palpate.metrics.inputs import Index, invalid, release

#: Factors on the median distance that make the bandwidths of ``"multi"``: two octaves around it.
FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
#: Rows that the median distance is taken over; its standard error is then below one per cent.
MEDIAN_ROWS = 1000

Sigma = float | str | Sequence[float]


class Kernel:
    """A kernel on rows; subclass it for another one.

    Attributes:
        stationary: whether it depends on x - y alone. Rows are then centered and computed in
            float32 where that is exact enough; other kernels are computed in float64.
        bandwidth: sigma, where there is one.
    """

    stationary: ClassVar[bool] = False
    bandwidth: float | None = None

    def unit(self, width: int) -> float:
        """What rows (n, width) are divided by."""
        return 1.0

    def values(self, t: Any, xp: Any) -> Any:
        """Kernel values; ``t`` is ``x.y``, or ``-||x - y||^2 / 2`` for stationary kernels.

        Args:
            t: a block of pairs, of rows divided by :meth:`unit`; may be overwritten.
            xp: the array-API namespace of ``t``.
        """
        raise NotImplementedError

    def settings(self) -> dict[str, Any]:
        """What a score records."""
        return {"kernel": type(self).__name__.lower()}


@dataclass(frozen=True)
class Gaussian(Kernel):
    """``mean over sigmas of exp(-||x - y||^2 / (2 sigma^2)) - 1``.

    Attributes:
        sigmas: bandwidths, each positive; a number is one.
        name: how it was requested: ``"gaussian"``, or with ``"median"`` or ``"multi"``.
    """

    sigmas: Any = (10.0,)
    name: str = "gaussian"

    stationary = True

    def __post_init__(self) -> None:
        given = np.atleast_1d(np.asarray(self.sigmas))
        if given.dtype.kind not in "iuf" or not (
            given.size and np.isfinite(given).all() and (given > 0).all()
        ):
            fix = "Choose a bandwidth, or several"
            raise invalid("sigma", "must be positive", repr(self.sigmas), fix, sigma=10)
        object.__setattr__(self, "sigmas", tuple(given.ravel().tolist()))

    def unit(self, width: int) -> float:
        """The first bandwidth."""
        return float(self.sigmas[0])

    def values(self, t: Any, xp: Any) -> Any:
        """``expm1(t)``, averaged over the bandwidths."""
        if len(self.sigmas) == 1:
            return xp.expm1(t)
        ratios = [(self.sigmas[0] / sigma) ** 2 for sigma in self.sigmas]
        return sum(xp.expm1(t * ratio) for ratio in ratios) / len(ratios)

    def settings(self) -> dict[str, Any]:
        """The name; one bandwidth is in ``Score.bandwidth``, several are here."""
        several = {"sigmas": list(self.sigmas)} if len(self.sigmas) > 1 else {}
        return {"kernel": self.name} | several

    @property
    def bandwidth(self) -> float | None:  # type: ignore[override]
        """The bandwidth where there is one."""
        return self.sigmas[0] if len(self.sigmas) == 1 else None


@dataclass(frozen=True)
class Polynomial(Kernel):
    """``(gamma x.y + coef0)^degree``; ``gamma`` None is 1 / d, as in KID (Binkowski 2018)."""

    degree: int = 3
    gamma: float | None = None
    coef0: float = 1.0

    def __post_init__(self) -> None:
        degree, gamma = self.degree, 1.0 if self.gamma is None else self.gamma
        if isinstance(degree, bool) or not isinstance(degree, int | np.integer) or degree < 1:
            must = "must be a whole number of at least 1"
            raise invalid("degree", must, repr(degree), "KID's is 3")
        for name, value, least in (("gamma", gamma, 0.0), ("coef0", self.coef0, -math.inf)):
            if not (isinstance(value, int | float | np.number) and least < value < math.inf):
                must = "must be a positive number" if name == "gamma" else "must be a finite number"
                raise invalid(name, must, repr(value), "Drop it for KID's")

    def unit(self, width: int) -> float:
        """``1 / sqrt(gamma)``, so that t is ``gamma x.y``."""
        return math.sqrt(width if self.gamma is None else 1 / self.gamma)

    def values(self, t: Any, xp: Any) -> Any:
        """The power."""
        base = t + self.coef0
        k = base
        for _ in range(self.degree - 1):
            k = k * base
        return k

    def settings(self) -> dict[str, Any]:
        """All parameters."""
        gamma = self.gamma or "1/d"
        return super().settings() | {"degree": self.degree, "gamma": gamma, "coef0": self.coef0}


@dataclass(frozen=True)
class Linear(Kernel):
    """``x.y``."""

    def values(self, t: Any, xp: Any) -> Any:
        """The product."""
        return t


def checked_kernel(kernel: Any) -> None:
    """Reject what is no kernel; None stands for the Gaussian of ``sigma``."""
    if kernel is not None and not isinstance(kernel, Kernel):
        must = "must be a kernel: Gaussian(), Polynomial(), Linear() or another Kernel"
        raise invalid("kernel", must, repr(kernel), "Import one from palpate.metrics")


def gaussian(sigma: Sigma, x: Any, groups: Sequence[str] | Index | None = None) -> Gaussian:
    """The Gaussian kernel that ``sigma`` names.

    Args:
        sigma: a bandwidth, several, ``"median"`` or ``"multi"``.
        x: (n, d) rows that the median is taken over. Take the reference, not what is scored, so
            that all generators share one kernel.
        groups: (n,) group of each row; only distances between different groups count, where there
            are any.

    Raises:
        PalpateError: on another word, a bandwidth that is not positive, or rows that are all equal.
    """
    if not isinstance(sigma, str):
        return Gaussian(sigma)
    if sigma not in ("median", "multi"):
        must = 'must be positive, several of that, "median" or "multi"'
        raise invalid("sigma", must, repr(sigma), "Choose one of these", sigma=10)
    middle = median_distance(x, groups)
    factors = FACTORS if sigma == "multi" else (1.0,)
    return Gaussian(tuple(f * middle for f in factors), f"gaussian, {sigma}")


def median_distance(
    x: Any, groups: Sequence[str] | Index | None = None, rows: int = MEDIAN_ROWS
) -> float:
    """The median Euclidean distance between rows of different groups, over ``rows`` random rows.

    Where all rows are of one group, all pairs count.

    Raises:
        PalpateError: with fewer than two rows, or where the median is 0.
    """
    n = len(x)
    at = np.sort(rng_for(0, "median distance").permutation(n)[:rows])
    some = host(rows_at(x, at))
    release(x)
    squares = (some**2).sum(axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares - 2 * some @ some.T, 0))
    wanted = np.triu(np.ones(distance.shape, dtype=bool), 1)
    if groups is not None:
        names = np.unique(np.asarray(groups)[at], return_inverse=True)[1]
        apart = wanted & (names[:, None] != names)
        wanted = apart if apart.any() else wanted
    middle = float(np.median(distance[wanted])) if wanted.any() else 0.0
    if not middle > 1e-12:
        got = f"{n} row{'s' * (n != 1)}, {'all equal' if n > 1 else 'no pair'}"
        must = "The median distance needs rows that differ"
        raise PalpateError(must, got, "Choose a bandwidth", example={"sigma": 10})
    return middle
