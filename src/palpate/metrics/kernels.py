"""Kernels, and one pass over all pairs of samples by the cheaper of two back ends.

Every kernel is a function of one matrix product, so that a block of values costs one product and
little more. A constant that is added to a kernel cancels in every MMD estimator; the Gaussian is
therefore summed as ``k - 1 = expm1(-||x - y||^2 / (2 sigma^2))``: on unit-norm features with
sigma = 10, k lies in [0.98, 1], and sums of k itself in float32 lose what matters.

* :class:`Gaussian`: one bandwidth, or the mean over several. ``"median"`` is the median distance
  between samples of different groups, ``"multi"`` the mean of five Gaussians at 1/4 to 4 times
  that.
* :class:`Polynomial`: ``(gamma x.y + coef0)^degree``; degree 3, gamma 1/d, coef0 1 is KID's.
* :class:`Linear`: ``x.y``; its MMD^2 is ``||mean x - mean y||^2``.

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
from typing import Any, ClassVar, Literal

import numpy as np
from array_api_compat import array_namespace

from palpate.core import PalpateError, PalpateWarning, rng_for
from palpate.metrics.inputs import (
    Array,
    Index,
    checked_whole,
    host,
    in_threads,
    invalid,
    like,
    release,
    row_norms,
    rows_at,
)
from palpate.metrics.intervals import PairSums, one_hot, split_by
from palpate.metrics.moments import Moments, center_of

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
        checked_whole(1, degree=self.degree)
        gamma = 1.0 if self.gamma is None else self.gamma
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
    """Reject what is no kernel; None is the Gaussian of ``sigma``."""
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


Backend = Literal["auto", "blocked", "moments"]
BACKENDS = ("auto", "blocked", "moments")
#: ``auto`` tries moments from so many rows on, in units of the width and in all.
ROWS_A_WIDTH, LEAST_ROWS = 8, 4096
#: Bytes of the moments of all items: at most, and four times that where pairs would take hours; up
#: to the second number in any case, beyond it no more than the features.
MOMENT_BYTES, STATE_BYTES = 512 << 20, 64 << 20
#: From so many rows on a fall back to blocks warns: it takes hours.
LONG = 300_000
#: Rows of an array on disk that are added to moments together.
STREAM = 1 << 15
#: Up to this many rows float64 costs nothing.
FLOAT64_BELOW = 1024
#: Largest ``||z||^2`` in float32: an exponent is then rounded by less than 1e-7, so that MMD^2 at
#: scale 1000 keeps 1e-4 even where all errors have one direction.
FLOAT32_RADIUS = 0.25
#: Blocks are not made smaller than this for speed; the caller may request less.
SMALL_BLOCK = 256
#: Up to this many items their sums with one another are kept (34 MB).
MOST_ITEMS = 2048


@dataclass(frozen=True)
class Sweep:
    """Sums by item and segment, and (K, 3) :func:`centered_squares` of the requested segments."""

    sums: PairSums
    spread: Array


def kernel_sums(  # noqa: PLR0913
    parts: Sequence[Any],
    segment: Index,
    unit: Index,
    *,
    segments: int,
    kernel: Kernel,
    bound: Callable[[PairSums], float],
    backend: Backend = "auto",
    tolerance: float = 1e-4,
    block: int = 1024,
    spread: Sequence[Index] = (),
    weights: Sequence[Array] = (),
) -> Sweep:
    """Sums of k by item and segment.

    Args:
        parts: feature arrays (n_k, d), checked, of one type and library; arrays on disk
            (``np.memmap``) are streamed by moments.
        segment: (N,) in [0, segments) over all parts, one after the other.
        unit: (N,).
        segments: S.
        kernel: what is summed.
        bound: what the remainders of moments can change in the statistic that matters.
        backend: see the module.
        tolerance: largest ``bound`` that ``auto`` takes moments with.
        block: most rows of a block.
        spread: sets of segments whose :func:`centered_squares` are computed.
        weights: (N,) each, the same for samples of one (segment, unit): of
            ``PairSums.weighings``.

    Raises:
        PalpateError: if moments are requested for another kernel, or for too many items.
    """
    width, rows = int(parts[0].shape[1]), len(segment)
    items, number = np.unique(np.stack([segment, unit]), axis=1, return_inverse=True)
    size = items.shape[1] * width**2 * 4
    room = MOMENT_BYTES if rows <= LONG else 4 * MOMENT_BYTES
    reason = ""
    if not isinstance(kernel, Gaussian) or kernel.bandwidth is None:
        reason = f"the kernel is {kernel.settings()}, not one Gaussian"
    elif size > room:
        cells = f"{items.shape[1]} (unit, segment) cells of width {width}"
        reason = f"second moments of {cells} take more than {room >> 20} MiB"
    if backend == "moments" and reason:
        must = "The moments back end needs one Gaussian bandwidth and few groups"
        raise PalpateError(must, reason, "Sum blocks", example={"backend": "blocked"})
    cheap = size <= max(STATE_BYTES, rows * width * 4)
    many = rows >= max(LEAST_ROWS, ROWS_A_WIDTH * width)
    if backend == "moments" or (backend == "auto" and not reason and cheap and many):
        sigma = float(kernel.bandwidth or 0)
        number = number.reshape(-1)
        sweep = _moments(parts, items, number, segments=segments, sigma=sigma, spread=spread)
        one_of = np.unique(number, return_index=True)[1]
        weighings = [sweep.sums.weighed(w[one_of]) for w in weights]
        sweep = replace(sweep, sums=replace(sweep.sums, weighings=weighings))
        remainder = bound(sweep.sums)
        if backend == "moments" or remainder <= tolerance:
            return sweep
        reason = f"their bound {remainder:.2g} exceeds the tolerance {tolerance:.2g}"
    if rows > LONG:
        why = f" Moments were not taken: {reason}." if backend == "auto" and reason else ""
        text = f"All {rows**2 / 2:.2g} pairs are formed, which takes long.{why}"
        warnings.warn(text, PalpateWarning, stacklevel=4)
    x = parts[0] if len(parts) == 1 else array_namespace(parts[0]).concat(list(parts), axis=0)
    options: dict[str, Any] = {"segments": segments, "kernel": kernel, "spread": spread}
    options |= {"weights": weights}
    return blocked_sums(x, segment, unit, block=block, **options)


def _moments(
    parts: Sequence[Any],
    items: Index,
    number: Index,
    *,
    segments: int,
    sigma: float,
    spread: Sequence[Index],
) -> Sweep:
    moments, first = Moments.empty(center_of(parts), sigma, items.shape[1]), 0
    for part in parts:
        for k in range(0, len(part), STREAM):
            slab = part[k : k + STREAM]
            moments.add(slab, number[first : first + len(slab)])
            release(part)
            first += len(slab)
    squares = [moments.spread(np.flatnonzero(np.isin(items[0], s))) for s in spread]
    return Sweep(moments.sums(items[0], items[1], segments), np.array(squares).reshape(-1, 3))


def blocked_sums(
    x: Any,
    segment: Index,
    unit: Index,
    *,
    segments: int,
    kernel: Kernel,
    block: int = 1024,
    spread: Sequence[Index] = (),
    weights: Sequence[Array] = (),
) -> Sweep:
    """As :func:`kernel_sums` by blocks, of the rows ``x`` (N, d)."""
    order = np.lexsort((unit, segment))
    segment, unit = segment[order].astype(np.intp), unit[order].astype(np.intp)
    new = (np.diff(segment, prepend=-1) != 0) | (np.diff(unit, prepend=unit[:1]) != 0)
    item, first, n = np.cumsum(new) - 1, np.flatnonzero(new), len(order)
    pairs, joined = _Pairs(x, order, kernel), len(first) <= MOST_ITEMS
    blocks = _slices(n, max(1, min(block, max(SMALL_BLOCK, -(-n // 8)))))
    by_item = _Cells(item, len(first), blocks, pairs.z) if joined else None
    by_segment = _Cells(segment, segments, blocks, pairs.z) if spread or not joined else None
    weights = [w[order] for w in weights]
    of_rows = [np.ones(n), *([] if joined else weights)]
    columns = [by_segment.weighed(w, blocks) for w in of_rows] if by_segment else []
    rows = np.zeros((len(columns), n, segments))

    def sums_of(pair: tuple[int, int]) -> tuple[Any, ...]:
        i, j = pair
        k = pairs.block(blocks[i], blocks[j], diagonal=0 if i == j else None)
        items = by_item.sums(k, i, j) if by_item else None
        if by_segment is None:
            return items, None, None, None
        across, down = ([host(v @ c[at]) for c in columns] for v, at in ((k, j), (k.T, i)))
        return items, across, down, by_segment.sums(k * k, i, j)

    todo = [(i, j) for i in range(len(blocks)) for j in range(i, len(blocks))]
    for (i, j), sums in zip(todo, in_threads(sums_of, todo, x), strict=True):
        if by_item:
            by_item.add(sums[0], i, j)
        if by_segment:
            for k, (across, down) in enumerate(zip(sums[1], sums[2], strict=True)):
                rows[k][blocks[i], by_segment.present[j]] += across
                if i != j:
                    rows[k][blocks[j], by_segment.present[i]] += down
            by_segment.add(sums[3], i, j)
    squares = by_segment.total if by_segment else np.zeros((0, 0))
    centered = [
        centered_squares(
            float(squares[np.ix_(s, s)].sum()), rows[0][np.isin(segment, s)][:, s].sum(axis=1)
        )
        for s in spread
    ]
    if by_item:
        each = (np.ones(n), pairs.diagonal())
        size, diagonal = (np.bincount(item, v, len(first)).astype(np.float64) for v in each)
        of_items = PairSums.from_block(
            by_item.total, size, diagonal, segment[first], unit[first], segments=segments
        )
        weighings = [of_items.weighed(w[first]) for w in weights]
    else:
        same = _same_unit(pairs, segment, unit, np.zeros((n, segments)), block)
        of_items = PairSums(np.ones(n), rows[0], same, pairs.diagonal(), segment, unit)
        weighings = [of_items.weighed(w, r) for w, r in zip(weights, rows[1:], strict=True)]
    of_items = replace(of_items, weighings=weighings)
    return Sweep(of_items, np.array(centered).reshape(-1, 3))


def _same_unit(pairs: _Pairs, segment: Index, unit: Index, same: Array, block: int) -> Array:
    """(N, S) sums of each sample with those of its unit, into ``same``."""
    for at in split_by(unit):
        for part in _slices(len(at), block if len(at) > 1 else 0):
            k = pairs.block(at[part], at, diagonal=part.start)
            same[at[part]] = host(k @ like(one_hot(segment[at], same.shape[1]), k))
    return same


class _Pairs:
    """Kernel values of blocks of pairs of the rows of ``x`` in this order.

    Rows of a stationary kernel are centered, which changes no value but the rounding, and all are
    in units of the kernel. Norms are those of the same rounded rows as the products.
    """

    def __init__(self, x: Any, order: Index, kernel: Kernel) -> None:
        self.kernel, self.xp = kernel, array_namespace(x)
        xp, z, single = self.xp, rows_at(x, order), False
        if kernel.stationary and len(order):
            z = z - xp.mean(z, axis=0)  # any center is right: float32 is near enough
        z = z / kernel.unit(x.shape[1])
        if z.dtype != xp.float64 and kernel.stationary and len(order) > FLOAT64_BELOW:
            single = float(row_norms(z).max()) ** 2 <= FLOAT32_RADIUS
        if z.dtype != xp.float64 and not single:
            wide = xp.astype(rows_at(x, order), xp.float64)
            wide = wide - like(host(xp.mean(wide, axis=0)), wide) if kernel.stationary else wide
            z = wide / kernel.unit(x.shape[1])
        self.z = z
        self.half = row_norms(z) ** 2 / 2
        self.shift = like(self.half, z)

    def block(self, rows: Any, columns: Any, diagonal: int | None = None) -> Any:
        """(n, m) float64 values, 0 at i = j; ``diagonal``: the column of the first row, if any."""
        k = self._rows(self.z, rows) @ self._rows(self.z, columns).T
        if self.kernel.stationary:
            k -= self._rows(self.shift, rows)[:, None]
            k -= self._rows(self.shift, columns)
        k = self.xp.astype(self.kernel.values(k, self.xp), self.xp.float64, copy=False)
        if diagonal is not None:
            at = np.arange(k.shape[0])
            k[at, at + diagonal] = 0
        return k

    def diagonal(self) -> Array:
        """(n,) k(x_i, x_i), shifted by the same constant as :meth:`block`."""
        return host(self.kernel.values(2 * self.half * (not self.kernel.stationary), np))

    def _rows(self, x: Any, at: Any) -> Any:
        return x[at] if isinstance(at, slice) else rows_at(x, at)


def _slices(n: int, step: int) -> list[slice]:
    return [slice(i, min(i + step, n)) for i in range(0, n, step)] if step else []


class _Cells:
    """Sums over blocks by pair of cells (items, or segments).

    Attributes:
        present: of each block the cells that occur, ascending.
        indicators: of each block (n, R) indicators of these, in float64 on the device of the rows.
        total: (C, C) sums so far.
    """

    def __init__(self, cell: Index, cells: int, blocks: Sequence[slice], z: Any) -> None:
        self.present = [np.unique(cell[b]) for b in blocks]
        wide = array_namespace(z).astype(z[:0], array_namespace(z).float64)
        indicators = (cell[b][:, None] == p for b, p in zip(blocks, self.present, strict=True))
        self.indicators = [like(m.astype(np.float64), wide) for m in indicators]
        self.total = np.zeros((cells, cells))

    def weighed(self, weight: Array, blocks: Sequence[slice]) -> list[Any]:
        """The indicators times (n,) weights of the rows."""
        return [
            m * like(weight[b][:, None], m) for m, b in zip(self.indicators, blocks, strict=True)
        ]

    def sums(self, k: Any, i: int, j: int) -> Array:
        """The sums of a block of values."""
        return host(self.indicators[i].T @ k @ self.indicators[j])

    def add(self, sums: Array, i: int, j: int) -> None:
        """Add the sums of block (i, j), and of its mirror image."""
        self.total[np.ix_(self.present[i], self.present[j])] += sums
        if i != j:
            self.total[np.ix_(self.present[j], self.present[i])] += sums.T


def centered_squares(squares: float, row_sums: Array) -> tuple[float, float, float]:
    """Sum of squares over i != j, trace and squared diagonal of the doubly centered kernel.

    From sum_ij k^2 and row sums of a matrix whose diagonal is 0:
    ``Kc_ij = k_ij - r_i - r_j + r`` with r the row means, and ``Kc_ii = r - 2 r_i``.
    """
    n = len(row_sums)
    if n < 2:
        return np.nan, np.nan, np.nan
    r = row_sums / n
    mean = r.mean()
    diagonal = mean - 2 * r
    inner = float((diagonal**2).sum())
    every = float(squares - 2 * n * (r**2).sum() + n**2 * mean**2)
    return max(every - inner, 0.0), float(diagonal.sum()), inner
