"""Kernels, and one pass over all pairs of samples by the cheaper of two back ends.

Every kernel is a function of one matrix product, so that a block of values costs one product and
little more. A constant that is added to a kernel cancels in every MMD estimator; the Gaussian is
therefore summed as ``k - 1 = expm1(-||x - y||^2 / (2 sigma^2))``: on unit-norm features with
sigma = 10, k lies in [0.98, 1], and sums of k itself in float32 lose what matters.

* :class:`Gaussian`: one bandwidth, or the mean over several. ``"median"`` is the median distance
  between samples of different groups, ``"multi"`` the mean of five Gaussians at 1/4 to 4 times
  that.
* :class:`Polynomial`: ``(gamma x.y + coef0)^degree``; degree 3, gamma 1/d, coef0 1 is KID's.

The back ends give the same sums:

* ``moments`` (:mod:`palpate.metrics.moments`): O(N d^2) time, for one Gaussian that is wide against
  the spread of the features. Its remainder is bounded, and the bound is part of the result.
* ``blocked``: O(N^2 d) time, any kernel, exact to rounding. The N x N matrix never exists: samples
  are sorted by item, each block on or above the diagonal is one product, one ``expm1`` in place,
  and sums by item in float64. Blocks run in threads and are added in a fixed order.

``auto`` takes moments where they are cheaper and their bound stays within the tolerance, else
blocks; the result records which.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, repeat
from typing import Any, ClassVar, Literal

import numpy as np
from array_api_compat import array_namespace

from palpate.core import PalpateWarning, require, rng_for
from palpate.metrics.inputs import (
    Array,
    Index,
    check,
    host,
    in_threads,
    like,
    release,
    row_norms,
    rows_at,
)
from palpate.metrics.intervals import PairSums, one_hot, split_by
from palpate.metrics.moments import moments_of

#: Factors on the median distance that make the bandwidths of ``"multi"``: two octaves around it.
FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
#: Sizes of exponents up to which a series is short.
SHORT = 0.1
#: Rows that the median distance is taken over; its standard error is then below one per cent.
MEDIAN_ROWS = 1000

Sigma = float | str | Sequence[float]


class Kernel:
    """A kernel on rows; subclass it for another one.

    Attributes:
        stationary: whether it depends on x - y alone. Rows are then centered and computed in
            float32 where that is exact enough; other kernels are computed in float64.
        bandwidth: sigma of a kernel that is one Gaussian, which moments can sum; else None.
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
        sigmas = np.atleast_1d(np.asarray(self.sigmas))
        positive = sigmas.dtype.kind in "iuf" and bool(np.isfinite(sigmas).all())
        positive = positive and sigmas.size > 0 and bool((sigmas > 0).all())
        fix = "Choose a bandwidth, or several"
        require(positive, "sigma", "must be positive", repr(self.sigmas), 10, fix=fix)
        object.__setattr__(self, "sigmas", tuple(sigmas.ravel().tolist()))

    def unit(self, width: int) -> float:
        """The first bandwidth."""
        return float(self.sigmas[0])

    def values(self, t: Any, xp: Any) -> Any:
        """``expm1(t)``, averaged over the bandwidths."""
        ratios = [(self.sigmas[0] / sigma) ** 2 for sigma in self.sigmas]
        if len(ratios) == 1:
            return _expm1(t, xp)
        if not all(math.isclose(a, 4 * b, rel_tol=1e-12) for a, b in pairwise(ratios)):
            return sum(_expm1(t * ratio, xp) for ratio in ratios) / len(ratios)
        k = total = _expm1(t * ratios[-1], xp)  # the widest
        for _ in ratios[1:]:  # each bandwidth is half of the one before
            k = k * (k + 2)  # (1 + k)^2 - 1
            k *= k + 2
            total = total + k
        return total / len(ratios)

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

    def unit(self, width: int) -> float:
        """``1 / sqrt(gamma)``, so that t is ``gamma x.y``."""
        return math.sqrt(width if self.gamma is None else 1 / self.gamma)

    def values(self, t: Any, xp: Any) -> Any:
        """The power."""
        t += self.coef0
        k = xp.asarray(t, copy=True)
        for _ in range(self.degree - 1):
            k *= t
        return k

    def settings(self) -> dict[str, Any]:
        """All parameters."""
        gamma = self.gamma or "1/d"
        return super().settings() | {"degree": self.degree, "gamma": gamma, "coef0": self.coef0}


def _expm1(t: Any, xp: Any) -> Any:
    """``expm1(t)`` of t <= 0; by its series where that is short: a third of the time."""
    if type(t) is not np.ndarray or -t.min() > SHORT:
        return xp.expm1(t)
    terms = 5 if t.dtype == np.float32 else 9
    k = t / (terms + 1)
    for n in range(terms, 0, -1):  # t (1 + t/2 (1 + t/3 (...)))
        k += 1
        k *= t
        k *= 1 / n
    return k


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
    must = 'must be positive, several of that, "median" or "multi"'
    by_name = sigma in ("median", "multi")
    require(by_name, "sigma", must, repr(sigma), 10, fix="Choose one of these")
    middle = median_distance(x, groups)
    factors = FACTORS if sigma == "multi" else (1.0,)
    return Gaussian(tuple(f * middle for f in factors), f"gaussian, {sigma}")


def median_distance(x: Any, groups: Sequence[str] | Index | None = None) -> float:
    """The median Euclidean distance between rows of different groups, over some random rows.

    Where all rows are of one group, all pairs count.

    Raises:
        PalpateError: with fewer than two rows, or where the median is 0.
    """
    n = len(x)
    at = np.sort(rng_for(0, "median distance").permutation(n)[:MEDIAN_ROWS])
    some = host(rows_at(x, at))
    release(x)
    squares, pairs = (some**2).sum(axis=1), np.tri(len(at), k=-1, dtype=bool)
    products = squares[:, None] + squares - 2 * some @ some.T
    if groups is not None:
        names = np.asarray(groups)[at]
        apart = pairs & (names[:, None] != names)
        pairs = apart if apart.any() else pairs
    distances = np.sqrt(np.maximum(products[pairs], 0))
    middle = float(np.median(distances)) if distances.size else 0.0
    got = f"{n} row{'s' * (n != 1)}, {'all equal' if n > 1 else 'no pair'}"
    must = "must be a number where the median distance has no rows that differ"
    require(middle > 1e-12, "sigma", must, got, 10, fix="Choose a bandwidth")
    return middle


Backend = Literal["auto", "blocked", "moments"]
#: Largest bound that ``auto`` accepts, at scale 1000.
TOLERANCE = 1e-4
#: ``auto`` tries moments from so many rows on, in units of the width and in all.
ROWS_A_WIDTH, LEAST_ROWS = 8, 4096
#: Bytes of the moments of all items: at most, and four times that where pairs would take hours; up
#: to the second number in any case, beyond it no more than the features.
MOMENT_BYTES, STATE_BYTES = 512 << 20, 64 << 20
#: From so many rows on a fall back to blocks warns: it takes hours.
LONG = 300_000
#: Largest ``||z||^2`` in float32: an exponent is then rounded by less than 1e-7, so that MMD^2 at
#: scale 1000 keeps 1e-4 even where all errors have one direction.
FLOAT32_RADIUS = 0.25
#: Blocks are not made smaller than this for speed; the caller may request less.
SMALL_BLOCK = 256
#: Up to this many items their sums with one another are kept (34 MB).
MOST_ITEMS = 2048
#: Rows that the spread of random halves is taken over; their deviation is then known to 3 %.
SPREAD_ROWS = 1000


def kernel_sums(
    parts: Sequence[Any],
    cells: Index,
    segments: int,
    kernel: Kernel,
    bound: Callable[[PairSums], float],
    *,
    backend: Backend = "auto",
    block: int = 1024,
    weights: Sequence[Array] = (),
) -> PairSums:
    """Sums of k by item and segment.

    Args:
        parts: feature arrays (n_k, d), checked, of one type and library; arrays on disk
            (``np.memmap``) are streamed by moments.
        cells: (2, N) segment, in [0, segments), and unit of each row of all parts, one after the
            other.
        segments: S.
        kernel: what is summed.
        bound: what the remainders of moments can change in the statistic that matters, at scale
            1000, where it is at most 2000.
        backend: see the module.
        block: most rows of a block.
        weights: (N,) each, the same for samples of one (segment, unit): of
            ``PairSums.weighings``.

    Raises:
        PalpateError: if moments are requested for another kernel, a bandwidth that is too narrow,
            or too many items.
    """
    width, rows = int(parts[0].shape[1]), cells.shape[1]
    items, first, item = np.unique(cells, axis=1, return_index=True, return_inverse=True)
    size = items.shape[1] * width**2 * 4
    room = MOMENT_BYTES if rows <= LONG else 4 * MOMENT_BYTES
    reason = ""
    if not isinstance(kernel, Gaussian) or kernel.bandwidth is None:
        reason = f"the kernel is {kernel.settings()}, not one Gaussian"
    elif size > room:
        count = f"{items.shape[1]} (unit, segment) cells of width {width}"
        reason = f"second moments of {count} take more than {room >> 20} MiB"
    requested = backend == "moments"
    must, holds = "needs one Gaussian bandwidth and few groups", not (requested and reason)
    check(holds, "The moments back end", must, reason, "Sum blocks", backend="blocked")
    cheap = size <= max(STATE_BYTES, rows * width * 4)
    many = rows >= max(LEAST_ROWS, ROWS_A_WIDTH * width)
    if requested or (backend == "auto" and not reason and cheap and many):
        moments = moments_of(parts, item.reshape(-1), items.shape[1], kernel.bandwidth or 0.0)
        sums = moments.sums(items, segments)
        sums = replace(sums, weighings=[sums.weighed(w[first]) for w in weights])
        remainder = bound(sums)
        reason = f"their bound is {remainder:.2g}"
        must = "must be wide against the features for the moments back end"
        fits = not requested or remainder <= 2000
        check(fits, "sigma", must, reason, "Sum blocks", backend="blocked")
        if requested or remainder <= TOLERANCE:
            return sums
    if rows > LONG:
        why = f" Moments were not taken: {reason}." if backend == "auto" and reason else ""
        text = f"All {rows**2 / 2:.2g} pairs are formed, which takes long.{why}"
        warnings.warn(text, PalpateWarning, stacklevel=4)
    x = parts[0] if len(parts) == 1 else array_namespace(parts[0]).concat(list(parts), axis=0)
    return blocked_sums(x, cells[0], cells[1], segments, kernel, block=block, weights=weights)


def blocked_sums(
    x: Any,
    segment: Index,
    unit: Index,
    segments: int,
    kernel: Kernel,
    *,
    block: int = 1024,
    weights: Sequence[Array] = (),
) -> PairSums:
    """As :func:`kernel_sums` by blocks, of the rows ``x`` (N, d)."""
    cells = np.stack([segment, unit])
    items, first, item = np.unique(cells, axis=1, return_index=True, return_inverse=True)
    order = np.argsort(item.reshape(-1), kind="stable")
    item, (segment, unit), n = item.reshape(-1)[order], cells[:, order], len(order)
    pairs = _Pairs(x, order, kernel)
    blocks = _slices(n, max(1, min(block, max(SMALL_BLOCK, -(-n // 8)))))
    by_item = [_sums_of_equal(item[b], pairs.z) for b in blocks]
    present = [np.unique(item[b]) for b in blocks]
    count = width = items.shape[1]
    dense, columns = [], present
    if not (joined := count <= MOST_ITEMS):  # sums with weighted segments instead of items
        each = (np.ones(n), *(w[order] for w in weights))
        weighted = np.hstack([one_hot(segment, segments) * w[:, None] for w in each])
        width = weighted.shape[1]
        dense = [_wide(weighted[b], pairs.z) for b in blocks]
        columns = [np.arange(width)] * len(blocks)
    total = np.zeros((count, width))

    def sums_of(pair: tuple[int, int]) -> list[Array]:
        i, j = pair
        k = pairs.block(blocks[i], blocks[j], diagonal=0 if i == j else None)
        if joined:
            sums = host(by_item[j](by_item[i](k).T))
            return [sums.T, sums]
        return [host(by_item[i](k @ dense[j])), host(by_item[j](k.T @ dense[i]))]

    todo = [(i, j) for i in range(len(blocks)) for j in range(i, len(blocks))]
    for (i, j), sums in zip(todo, in_threads(sums_of, todo, x), strict=True):
        for values, a, b in list(zip(sums, (i, j), (j, i), strict=True))[: 1 + (i != j)]:
            total[np.ix_(present[a], columns[b])] += values
    each = (np.ones(n), pairs.diagonal())
    size, diagonal = (np.bincount(item, v, count).astype(np.float64) for v in each)
    if joined:
        sums, weighed = PairSums.from_block(total, size, diagonal, items, segments), repeat(None)
    else:
        with_segments, *weighed = np.hsplit(total, len(weights) + 1)
        same = np.zeros((count, segments))
        each = split_by(unit)
        for of_size in split_by(np.array([len(at) for at in each])):  # units of one size together
            of = np.stack([each[k] for k in of_size])
            length = of.shape[1]
            for some in _slices(len(of), max(1, (SMALL_BLOCK // length) ** 2)):
                columns_of = _wide(one_hot(segment[of[some]], segments), pairs.z)
                for part in _slices(length, block):
                    k = pairs.block(of[some, part], of[some], diagonal=part.start)
                    np.add.at(same, item[of[some, part]], host(k @ columns_of))
        sums = PairSums(size, size, with_segments, same, diagonal, *items)
    each = zip(weights, weighed, strict=False)
    return replace(sums, weighings=[sums.weighed(w[first], v) for w, v in each])


class _Pairs:
    """Kernel values of blocks of pairs of the rows of ``x`` in this order.

    Rows of a stationary kernel are centered, which changes no value but the rounding, and all are
    in units of the kernel. Norms are those of the same rounded rows as the products.
    """

    def __init__(self, x: Any, order: Index, kernel: Kernel) -> None:
        self.kernel, self.xp = kernel, array_namespace(x)
        xp, z = self.xp, rows_at(x, order)
        if not kernel.stationary:
            z = xp.astype(z, xp.float64)
        elif len(order):
            z -= xp.mean(z, axis=0)  # any center is right: float32 is near enough
        z /= kernel.unit(x.shape[1])
        if float(row_norms(z).max(initial=0)) ** 2 > FLOAT32_RADIUS:
            z = xp.astype(z, xp.float64, copy=False)
        self.z = z
        self.half = row_norms(self.z) ** 2 / 2
        self.shift = like(self.half, self.z)

    def block(self, rows: Any, columns: Any, diagonal: int | None = None) -> Any:
        """(n, m) float64 values, 0 at i = j; ``diagonal``: the column of the first row, if any.

        Of indices (b, n) and (b, m) it is (b, n, m).
        """
        k = self._rows(self.z, rows) @ self._rows(self.z, columns).swapaxes(-1, -2)
        if self.kernel.stationary:
            k -= self._rows(self.shift, rows)[..., None]
            k -= self._rows(self.shift, columns)[..., None, :]
        k = self.xp.astype(self.kernel.values(k, self.xp), self.xp.float64, copy=False)
        if diagonal is not None:
            at = np.arange(k.shape[-2])
            k[..., at, at + diagonal] = 0
        return k

    def diagonal(self) -> Array:
        """(n,) k(x_i, x_i), shifted by the same constant as :meth:`block`."""
        return host(self.kernel.values(2 * self.half * (not self.kernel.stationary), np))

    def _rows(self, x: Any, at: Any) -> Any:
        if isinstance(at, slice):
            return x[at]
        return rows_at(x, at.reshape(-1)).reshape(*at.shape, *x.shape[1:])


def _slices(n: int, step: int) -> list[slice]:
    return [slice(i, min(i + step, n)) for i in range(0, n, step)] if step else []


def _wide(values: Array, z: Any) -> Any:
    """``values`` in float64 in the library and on the device of ``z``."""
    xp = array_namespace(z)
    return like(values, xp.astype(z[:0], xp.float64))


def _sums_of_equal(cell: Index, z: Any) -> Callable[[Any], Any]:
    """What sums rows (n, m) of one cell to (R, m); ``cell`` (n,) ascending."""
    present, first = np.unique(cell, return_index=True)
    if type(z) is np.ndarray:
        return lambda rows: np.add.reduceat(rows, first, axis=0)
    indicators = _wide(present[:, None] == cell, z)
    return lambda rows: indicators @ rows


def centered_squares(x: Any, rows: Index, kernel: Kernel) -> tuple[float, float, float]:
    """Sum of squares over i != j, trace and squared diagonal of the doubly centered kernel of rows.

    With the diagonal 0, ``Kc_ij = k_ij - r_i - r_j + r`` with r the row means, ``Kc_ii = r -
    2 r_i``. Of more than :data:`SPREAD_ROWS` rows it is estimated from so many random ones.
    """
    n = len(rows)
    if n < 2:
        return np.nan, np.nan, np.nan
    some = np.sort(rng_for(0, "centered squares").permutation(rows)[:SPREAD_ROWS])
    m, every = len(some), slice(None)
    k = host(_Pairs(x, some, kernel).block(every, every, diagonal=0))
    r = k.mean(axis=0)
    centered = k - r - r[:, None] + r.mean()
    own = np.diagonal(centered)
    inner = float((own**2).sum())
    off = (float((centered**2).sum()) - inner) * n * (n - 1) / (m * (m - 1))
    return off, float(own.sum()) * (n - 1) / (m - 1), inner * n / m
