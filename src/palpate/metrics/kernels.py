"""Kernels: what is summed over pairs, and how wide it is.

Every kernel is given as a function of one matrix product, and a number a row, so that a block of kernel values costs one product and
little more, in place. A constant that is added to a kernel cancels in every MMD estimator; the Gaussian is therefore summed as
``k - 1 = expm1(-||x - y||^2 / (2 sigma^2))``: on unit-norm features with sigma = 10, k lies in [0.98, 1], and sums of k itself in float32
lose what matters.

* :class:`Gaussian`: one bandwidth, or the mean over several. ``"median"`` is the median distance between samples of different groups, and
  ``"multi"`` the mean of five Gaussians at 1/4, 1/2, 1, 2 and 4 times that.
* :class:`Polynomial`: ``(gamma x.y + coef0)^degree``; degree 3, gamma 1/d, coef0 1 is KID's.
* :class:`Linear`: ``x.y``; its MMD^2 is ``||mean x - mean y||^2``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from palpate.core import PalpateError, rng_for
from palpate.metrics.arrays import Ops, ops_of
from palpate.metrics.inputs import Array, Index, release

#: Factors on the median distance that make the bandwidths of ``"multi"``: two octaves around it.
FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
#: Rows that the median distance is taken over; its standard error is then below one per cent.
MEDIAN_ROWS = 1000


class Kernel(Protocol):
    """A kernel on rows, evaluated block by block."""

    @property
    def bandwidth(self) -> float | None:
        """Sigma, where there is one."""
        ...

    @property
    def stationary(self) -> bool:
        """Whether it depends on differences of rows alone: they are then centered before they are given to the rest."""
        ...

    @property
    def unit(self) -> float:
        """What rows are divided by before they are given to the rest."""
        ...

    @property
    def single(self) -> bool:
        """Whether float32 serves at all."""
        ...

    @property
    def radius_limit(self) -> float:
        """Largest ``max ||x - center||^2`` for which float32 keeps 1e-6 (x1000); 2^31 times that is too much for float64."""
        ...

    def factors(self, x: Any, ops: Ops) -> tuple[Any, Any]:
        """Left and right factors (n, d'), whose product ``left @ right.T`` :meth:`values` takes."""
        ...

    def shift(self, x: Any, ops: Ops) -> Any:
        """(n,) what each row adds to its products, of the type of ``x``; or None."""
        ...

    def values(self, product: Any, ops: Ops, radius: float, shift: tuple[Any, Any] | None) -> Any:
        """Kernel values of a block, in place where the array library can.

        Args:
            product: of some rows with others.
            ops: of their library.
            radius: the largest squared norm of a row.
            shift: what :meth:`shift` gave for the rows on either side.
        """
        ...

    def diagonal(self, x: Any, ops: Ops) -> Array:
        """(n,) k(x_i, x_i), shifted by the same constant as :meth:`values`."""
        ...

    def settings(self) -> dict[str, Any]:
        """What a score has to record."""
        ...


def checked_kernel(kernel: Any) -> None:
    """Refuses what is no kernel, the class of one too; None stands for the Gaussian of ``sigma``."""
    needs = (
        "bandwidth",
        "stationary",
        "unit",
        "single",
        "radius_limit",
        "factors",
        "shift",
        "values",
        "diagonal",
        "settings",
    )
    if kernel is not None and (
        isinstance(kernel, type) or not all(hasattr(kernel, name) for name in needs)
    ):
        raise PalpateError(
            "kernel must be a kernel, e.g. Gaussian(), Polynomial() or Linear()",
            repr(kernel),
            "Import it from palpate.metrics",
        )


@dataclass(frozen=True)
class Gaussian:
    """``mean over sigmas of exp(-||x - y||^2 / (2 sigma^2)) - 1``; the diagonal is exactly 0.

    Attributes:
        sigmas: bandwidths, each positive; a number is one.
        name: how it was asked for: ``"gaussian"``, or with ``"median"`` or ``"multi"``.
    """

    sigmas: tuple[float, ...] = (10.0,)
    name: str = "gaussian"

    #: Differences alone count.
    stationary = True

    def __post_init__(self) -> None:
        given: Any = self.sigmas if np.iterable(self.sigmas) else (self.sigmas,)
        try:  # the characters of a word are no bandwidths, nor is True
            several = (
                ()
                if isinstance(self.sigmas, str | bytes | bool)
                else tuple(float(sigma) for sigma in given)
            )
        except (TypeError, ValueError, OverflowError, RuntimeError):
            several = ()
        if not several or not all(np.isfinite(s) and 1e-100 < s < 1e100 for s in several):
            raise PalpateError(
                "sigma must be positive",
                repr(self.sigmas),
                "Pass e.g. sigma=10, or Gaussian((5.0, 10.0))",
            )
        object.__setattr__(self, "sigmas", several)

    @property
    def unit(self) -> float:
        """The first bandwidth."""
        return self.sigmas[0]

    @property
    def single(self) -> bool:
        """Not where float32 rounds the squared ratio of two bandwidths, which moves all pairs in one direction."""
        return all(float(np.float32(f)) == f for f in self._ratios)

    @property
    def radius_limit(self) -> float:
        """The exponents stay below one eighth: sigma >= 4 for unit-norm features."""
        return min(self.sigmas) ** 2 / 16

    @property
    def _ratios(self) -> list[float]:
        return [(self.unit / sigma) ** 2 for sigma in self.sigmas[1:]]

    def factors(self, x: Any, ops: Ops) -> tuple[Any, Any]:
        """The rows themselves."""
        return x, x

    def shift(self, x: Any, ops: Ops) -> Any:
        """``-||x||^2 / 2`` of the same rounded rows: ``x.y - ||x||^2 / 2 - ||y||^2 / 2 = -||x - y||^2 / 2``."""
        return ops.like(-0.5 * ops.squares(x), x)

    def values(self, product: Any, ops: Ops, radius: float, shift: tuple[Any, Any] | None) -> Any:
        """``expm1(product + shifts)``, averaged over the bandwidths; no two rows are farther apart than twice the radius."""
        ratios = self._ratios
        if ratios and shift is not None:
            product, shift = ops.add_outer_(product, *shift), None
        rest = [ops.expm1_(product * f, -2 * radius * f) for f in ratios]
        k = ops.expm1_(product, -2 * radius, shift)
        for other in rest:
            k += other
        return ops.divide_(k, len(self.sigmas))

    def diagonal(self, x: Any, ops: Ops) -> Array:
        """Zeros: k(x, x) = 1."""
        return np.zeros(len(x))

    def settings(self) -> dict[str, Any]:
        """The name; one bandwidth stands in ``Score.bandwidth``, several here."""
        return {"kernel": self.name} | (
            {"sigmas": list(self.sigmas)} if len(self.sigmas) > 1 else {}
        )

    @property
    def bandwidth(self) -> float | None:
        """The bandwidth where there is one."""
        return self.sigmas[0] if len(self.sigmas) == 1 else None


@dataclass(frozen=True)
class Polynomial:
    """``(gamma x.y + coef0)^degree``; ``gamma`` None is 1 / d, as in KID (Binkowski et al. 2018)."""

    degree: int = 3
    gamma: float | None = None
    coef0: float = 1.0
    bandwidth: float | None = None

    #: Rows are taken as they are, in float64: KID's values are far smaller than the kernel's rounding in float32.
    stationary, unit, single, radius_limit = False, 1.0, False, float("inf")

    def __post_init__(self) -> None:
        if (
            isinstance(self.degree, bool)
            or not isinstance(self.degree, int | np.integer)
            or self.degree < 1
        ):
            raise PalpateError(
                "The degree of a polynomial kernel must be a whole number from 1 on",
                repr(self.degree),
                "KID's is 3",
            )
        for name in ("gamma", "coef0"):
            value = getattr(self, name)
            if not (name == "gamma" and value is None) and not (
                isinstance(value, int | float | np.number) and np.isfinite(value)
            ):
                raise PalpateError(
                    f"{name} of a polynomial kernel must be a finite number",
                    repr(value),
                    "Leave it out for KID's",
                )

    def factors(self, x: Any, ops: Ops) -> tuple[Any, Any]:
        """``[gamma x, coef0] . [y, 1]``."""
        gamma = 1 / x.shape[1] if self.gamma is None else self.gamma
        ones = ops.ones(len(x), x)
        return ops.columns(gamma * x, self.coef0 * ones), ops.columns(x, ones)

    def shift(self, x: Any, ops: Ops) -> Any:
        """Nothing."""
        return

    def values(self, product: Any, ops: Ops, radius: float, shift: tuple[Any, Any] | None) -> Any:
        """The power."""
        k = product
        for _ in range(self.degree - 1):
            k = k * product
        return k

    def diagonal(self, x: Any, ops: Ops) -> Array:
        """``(gamma ||x||^2 + coef0)^degree``."""
        gamma = 1 / x.shape[1] if self.gamma is None else self.gamma
        return (gamma * ops.numpy(ops.squares(x)) + self.coef0) ** self.degree

    def settings(self) -> dict[str, Any]:
        """All parameters."""
        return {
            "kernel": "polynomial",
            "degree": self.degree,
            "gamma": self.gamma or "1/d",
            "coef0": self.coef0,
        }


@dataclass(frozen=True)
class Linear:
    """``x.y``."""

    bandwidth: float | None = None

    #: Rows are taken as they are, in float64.
    stationary, unit, single, radius_limit = False, 1.0, False, float("inf")

    def factors(self, x: Any, ops: Ops) -> tuple[Any, Any]:
        """The rows themselves."""
        return x, x

    def shift(self, x: Any, ops: Ops) -> Any:
        """Nothing."""
        return

    def values(self, product: Any, ops: Ops, radius: float, shift: tuple[Any, Any] | None) -> Any:
        """The product."""
        return product

    def diagonal(self, x: Any, ops: Ops) -> Array:
        """``||x||^2``."""
        return ops.numpy(ops.squares(x))

    def settings(self) -> dict[str, Any]:
        """The name."""
        return {"kernel": "linear"}


Sigma = float | str | Sequence[float]


def gaussian(sigma: Sigma, x: Any, groups: Sequence[str] | Index | None = None) -> Gaussian:
    """The Gaussian kernel that ``sigma`` names.

    Args:
        sigma: a bandwidth, several, ``"median"`` or ``"multi"``.
        x: (n, d) rows that the median is taken over. Take the reference, not what is scored: else every generator has a kernel of its own.
        groups: (n,) what each row belongs to; only distances between different groups count, where there are any.

    Raises:
        PalpateError: on another word, a bandwidth that is not positive, none, or rows that are all equal.
    """
    if isinstance(sigma, str):
        if sigma not in ("median", "multi"):
            raise PalpateError(
                'sigma must be positive, several of that, "median" or "multi"',
                repr(sigma),
                "Pass e.g. sigma=10",
            )
        middle = median_distance(x, groups)
        return Gaussian(
            tuple(f * middle for f in (FACTORS if sigma == "multi" else (1.0,))),
            f"gaussian, {sigma}",
        )
    return Gaussian(sigma)  # type: ignore[arg-type]


def median_distance(
    x: Any, groups: Sequence[str] | Index | None = None, rows: int = MEDIAN_ROWS
) -> float:
    """The median Euclidean distance between rows of different groups (of any rows where there is one group), over ``rows`` rows.

    Raises:
        PalpateError: with fewer than two rows, or where the median is 0.
    """
    n = len(x)
    at = np.sort(rng_for(0, "median distance").permutation(n)[:rows])
    ops, picked = ops_of(x), [np.zeros((0, x.shape[1]))]
    for k in range(
        0, len(at), 32
    ):  # an array on disk is mapped by large pages: a few rows of it at a time
        picked.append(ops.numpy(x[at[k : k + 32].tolist()]))
        release(x)
    some = np.concatenate(picked)
    squares = (some**2).sum(axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares[None] - 2 * some @ some.T, 0))
    wanted = np.triu(np.ones(distance.shape, dtype=bool), 1)
    if groups is not None:
        names = np.unique(np.asarray(groups)[at], return_inverse=True)[1]
        apart = wanted & (names[:, None] != names[None])
        wanted = apart if apart.any() else wanted
    middle = float(np.median(distance[wanted])) if wanted.any() else 0.0
    if not middle > 1e-12:
        got = f"{n} row{'s' * (n != 1)}, {'all equal' if n > 1 else 'no pair'}"
        raise PalpateError(
            "The median distance needs rows that differ", got, "Pass a bandwidth, e.g. sigma=10"
        )
    return middle
