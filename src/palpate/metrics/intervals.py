"""Uncertainty: the jackknife and a permutation test, from kernel sums.

**Kernel sums** are all that the metrics know of the pairs. A *segment* is a cell of (set, class,
half); a *unit* is what a jackknife leaves out (a video; a sample where no videos are known); an
*item* is all samples of one (unit, segment), or a single sample. Sums of items with segments give
every metric, every leave-one-unit-out value and the sums without same-unit pairs; sums of items
with items also any exchange of units between sets. They leave out i = j; what the diagonal would
add is separate (``diagonal``): 0 for the Gaussian, whose k - 1 vanishes there.

**Jackknife** over G units: ``SE^2 = (G-1)/G * sum_g (theta_g - mean theta)^2``, interval
``theta +- t(G-1) * SE``. Frames of one video are not independent: with 40 videos of 15 frames a
frame-level 95 % interval covers the truth in 0 to 41 % of the cases. Where an interval of TMMD
misses the truth it mostly lies below it, as the error grows with the value: small estimates have
short intervals (``benchmarks/metric_coverage.py 2000 --misses``). Intervals on the scale of the
root miss evenly where two sets differ, but far too often where they do not.

**Permutation test** of TMMD by whole units: permuting frames rejects a true null in every data set
of 40 videos. Units that both sets have (generated and real images of one test video) swap their two
parts with probability one half; units of one set alone are dealt anew, as many to each set as
before. Compared is TMMD over its standard error (the jackknife of that relabeling): with unequal
numbers of frames a video, TMMD itself rejects a true null in 29 % (6 videos of one frame against 40
of 30) or never. The studentized value is asymptotically free of the sizes (Janssen 1997; Chung and
Romano 2013), and exact where units are exchangeable.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import repeat
from typing import Any

import numpy as np
import scipy

from palpate.core import Score, rng_for
from palpate.core.features import Array, Index


@dataclass(frozen=True)
class Totals:
    """Sums by pair of segments; fields as :class:`PairSums`, of segments.

    Attributes:
        n: (S,) samples.
        sums: (S, S) sum of k over ordered pairs i != j.
        same: (S, S) the part of ``sums`` from pairs inside one unit.
        pairs: (S, S) ordered pairs inside one unit, a sample with itself included.
        diagonal: (S,) sum of k(x_i, x_i).
        squares: (S,) sum of squared weights: what i = j adds to ``pairs``.
        even: as :class:`PairSums`.
    """

    n: Array
    sums: Array
    same: Array
    pairs: Array
    diagonal: Array
    squares: Array
    even: Totals | None = None

    def at(self, k: int) -> Totals:
        """One of several totals."""
        sides = (self.n, self.sums, self.same, self.pairs, self.diagonal, self.squares)
        n, sums, same, pairs, diagonal, squares = (a[k] for a in sides)
        even = self.even and self.even.at(k)
        return Totals(n, sums, same, pairs, diagonal, squares, even)

    def merge(self, to: Index, segments: int) -> Totals:
        """Segments joined: segment s becomes ``to[s]``; -1 drops it."""
        m = one_hot(to, segments)
        n, diagonal, squares = (a @ m for a in (self.n, self.diagonal, self.squares))
        sums, same, pairs = (m.T @ a @ m for a in (self.sums, self.same, self.pairs))
        even = self.even and self.even.merge(to, segments)
        return Totals(n, sums, same, pairs, diagonal, squares, even)


@dataclass(frozen=True)
class PairSums:
    """Sums of k of each item with each segment.

    Attributes:
        n: (P,) samples of an item.
        squares: (P,) sum of squared weights of these; ``n`` where they weigh 1.
        rows: (P, S) sum over pairs of a sample of the item and another sample of a segment.
        same: (P, S) the part of ``rows`` from pairs inside one unit.
        diagonal: (P,) sum of k(x_i, x_i).
        segment: (P,) the item's segment, 0 <= segment < S.
        unit: (P,) the item's unit, any integers.
        block: (P, P) sums of items with items, or None where there would be too many.
        backend: ``"blocked"`` or ``"moments"``.
        bound: what the remainders of ``rows`` and ``same`` by moments cannot exceed; None if exact.
        weighings: the same sums with weights on the samples; see :meth:`weighed`.
        even: the one of ``weighings``, chosen by :meth:`merge`, in which every unit weighs the
            same, whatever its number of samples.
    """

    n: Array
    squares: Array
    rows: Array
    same: Array
    diagonal: Array
    segment: Index
    unit: Index
    block: Array | None = None
    backend: str = "blocked"
    bound: PairSums | None = None
    weighings: Sequence[PairSums] = ()
    even: PairSums | None = None

    @classmethod
    def from_block(
        cls, block: Array, n: Array, diagonal: Array, cells: Index, segments: int
    ) -> PairSums:
        """From sums of items with items; ``cells`` (2, P) are the segment and unit of each item."""
        m, same = one_hot(cells[0], segments), np.where(cells[1][:, None] == cells[1], block, 0.0)
        return cls(n, n, block @ m, same @ m, diagonal, cells[0], cells[1], block)

    @property
    def segments(self) -> int:
        """S."""
        return self.rows.shape[1]

    @cached_property
    def units(self) -> Index:
        """The different units, in the order of :meth:`leave_one_out`."""
        return np.unique(self.unit)

    def merge(self, to: Index, segments: int, weighing: int | None = None) -> PairSums:
        """Segments joined: segment s becomes ``to[s]``; -1 drops it and its items.

        ``weighing``: which of ``weighings`` is ``even`` from here on.
        """
        chosen = self.weighings[weighing] if weighing is not None and self.weighings else None
        m, keep = one_hot(to, segments), to[self.segment] >= 0
        return PairSums(
            self.n[keep],
            self.squares[keep],
            self.rows[keep] @ m,
            self.same[keep] @ m,
            self.diagonal[keep],
            to[self.segment][keep],
            self.unit[keep],
            None if self.block is None else self.block[np.ix_(keep, keep)],
            self.backend,
            self.bound and self.bound.merge(to, segments),
            even=chosen and chosen.merge(to, segments),
        )

    def weighed(self, weight: Array, rows: Array | None = None) -> PairSums:
        """The sums with a weight on every sample: ``n`` adds weights, the others products of two.

        Args:
            weight: (P,) of the samples of each item; equal for the items of a unit that are in one
                set, inside of which alone the sums of a unit with itself are then right.
            rows: (P, S) sums of each item with the weighted samples of segments; else from
                ``block``.
        """
        if rows is None:
            assert self.block is not None  # the caller has one of the two
            rows = (self.block * weight) @ one_hot(self.segment, self.segments)
        column = weight[:, None]
        return replace(
            self,
            n=weight * self.n,
            rows=column * rows,
            same=column**2 * self.same,
            diagonal=weight * self.diagonal,
            squares=weight**2 * self.n,
            block=None,
            bound=None,
        )

    @cached_property
    def totals(self) -> Totals:
        """Sums over all items."""
        m = one_hot(self.segment, self.segments)
        n, diagonal, squares = (a @ m for a in (self.n, self.diagonal, self.squares))
        cell = np.searchsorted(self.units, self.unit) * self.segments + self.segment
        count = np.bincount(cell, weights=self.n, minlength=len(self.units) * self.segments)
        count = count.reshape(-1, self.segments).astype(np.float64)
        even = self.even and self.even.totals
        return Totals(n, m.T @ self.rows, m.T @ self.same, count.T @ count, diagonal, squares, even)

    def leave_one_out(self) -> Iterator[Totals]:
        """The totals without each unit in turn: ``sums - C - C' + B``.

        C are the sums of the unit with all samples, B those of the unit with itself.
        """
        for t in self.without_units():
            yield from map(t.at, range(len(t.n)))

    def without_units(self) -> Iterator[Totals]:
        """The same for several units at a time, whose axis is the first."""
        full, segments, unit = self.totals, self.segments, np.searchsorted(self.units, self.unit)
        evens = self.even.without_units() if self.even else repeat(None)
        step = max(1, TOGETHER // segments**2)
        for at, even in zip(split_by(unit // step), evens, strict=False):
            place = unit[at] % step, self.segment[at]
            count = int(place[0].max()) + 1
            n, diagonal, squares = np.zeros((3, count, segments))
            with_all, inside = np.zeros((2, count, segments, segments))
            sides = (n, diagonal, squares, with_all, inside)
            parts = (self.n, self.diagonal, self.squares, self.rows, self.same)
            for side, part in zip(sides, parts, strict=True):
                np.add.at(side, place, part[at])
            yield Totals(
                full.n - n,
                full.sums - with_all - with_all.swapaxes(1, 2) + inside,
                full.same - inside,
                full.pairs - n[:, :, None] * n[:, None],
                full.diagonal - diagonal,
                full.squares - squares,
                even,
            )


def split_by(key: Index) -> list[Index]:
    """Positions of equal keys, one array a key, in the order of the keys."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1) if len(order) else []


def one_hot(to: Index, segments: int) -> Array:
    """(..., segments) float64 indicators; -1 is a row of zeros."""
    return (to[..., None] == np.arange(segments)).astype(np.float64)


def mean_of_pairs(sums: Array, pairs: Array) -> Array:
    """``sums / pairs``; NaN where there are no pairs, of which rounding may have left a sum."""
    none = np.full(np.broadcast_shapes(sums.shape, pairs.shape), np.nan)
    return np.divide(sums, pairs, out=none, where=pairs > 0)


Interval = tuple[float, float]
NONE: Array = np.zeros(0)
#: Coverage of every interval.
LEVEL = 0.95
#: Numbers of sums that are left out together.
TOGETHER = 1 << 16
#: Relabelings that are computed together.
BATCH = 256


def jackknife_error(replicates: Array) -> float:
    """Standard error from leave-one-out values (G,); NaN if one is undefined or G < 2."""
    g = len(replicates)
    if g < 2:
        return np.nan
    with np.errstate(invalid="ignore"):
        drift = replicates - np.mean(replicates)
        return float(np.sqrt((g - 1) / g * (drift**2).sum()))


@dataclass(frozen=True)
class Spread:
    """A statistic with its standard error, degrees of freedom, and how they came about."""

    value: float
    error: float
    df: float
    method: str

    @classmethod
    def of(cls, value: float, replicates: Array, unit: str = "group", tail: str = "") -> Spread:
        """A value with its jackknife, from the values (G,) without each unit."""
        df = len(replicates) - 1
        method = f"leave-one-{unit}-out jackknife, t, {df} df{tail}"
        return cls(value, jackknife_error(replicates), df, method)

    @property
    def known(self) -> bool:
        """Whether there is an error: no change without any group is no evidence of certainty."""
        return bool(1e-12 < self.error < np.inf and np.isfinite(self.value))  # not for NaN

    def interval(self, low: float = -np.inf, high: float = np.inf) -> Interval | None:
        """The 95 % t interval within [low, high], or None."""
        if not self.known:
            return None
        reach = float(scipy.special.stdtrit(self.df, 0.5 + LEVEL / 2)) * self.error
        return max(self.value - reach, low), min(self.value + reach, high)

    def shares(self) -> tuple[float, float]:
        """The shares of its t distribution below and above 0; halves where there is no error."""
        if not self.known:
            return 0.5, 0.5
        below, above = scipy.special.stdtr(self.df, np.array([-1, 1]) * self.value / self.error)
        return float(below), float(above)


def spread_of_values(values: Array, groups: Sequence[str] | None) -> Spread:
    """The mean of values (n,) with its error over groups, or over values taken as independent."""
    n, each, tail = len(values), "group", ""
    if groups is None:
        groups, each, tail = list(map(str, range(n))), "image", ", images taken as independent"
    of_group = np.unique(np.asarray(groups, dtype=str), return_inverse=True)[1]
    total, size = np.bincount(of_group, values), np.bincount(of_group)
    value = float(values.mean()) if n else np.nan
    with np.errstate(invalid="ignore", divide="ignore"):  # of one group nothing is left
        return Spread.of(value, (total.sum() - total) / (n - size), each, tail)


def score_of(
    metric: str, subject: str, spread: Spread, bounds: Interval = (-np.inf, np.inf), **fields: Any
) -> Score:
    """The score of a value with its interval within bounds; ``fields`` are further ones."""
    interval = spread.interval(*bounds)
    method = spread.method if interval else ""
    return Score(metric, subject, float(spread.value), interval, interval_method=method, **fields)


@dataclass(frozen=True)
class Estimate:
    """Statistics with their jackknife.

    Attributes:
        spreads: K values with their errors.
        replicates: (G, K) values without each unit, or (C, 4) without each class.
        units: (G,) units.
        of_classes: whether classes are left out.
    """

    spreads: Sequence[Spread]
    replicates: Array = field(repr=False)
    units: Index = field(repr=False)
    of_classes: bool = False


def estimate(
    sums: PairSums, statistic: Callable[[Totals], Array], unit: str, *, together: bool = False
) -> Estimate:
    """The statistics on all samples, with their leave-one-unit-out jackknife.

    ``together``: whether the statistic takes totals of several units.
    """
    left_out = sums.without_units() if together else sums.leave_one_out()
    replicates = (np.concatenate if together else np.array)([*map(statistic, left_out)])
    tail = "" if unit == "group" else ", samples taken as independent"
    pairs = zip(statistic(sums.totals), replicates.T, strict=True)
    return Estimate([Spread.of(*pair, unit, tail) for pair in pairs], replicates, sums.units)


def class_estimate(sums: PairSums, statistic: Callable[[Totals], Array], unit: str) -> Estimate:
    """As :func:`estimate`, for 2C segments; over classes where one cannot spare a unit (two
    groups).

    The interval over classes also holds the differences between classes, so it errs on the wide
    side. The first four values of the statistic must be defined for fewer classes; only they get
    errors then.
    """
    over_units, classes = estimate(sums, statistic, unit), sums.segments // 2
    if classes < 3 or np.isfinite(over_units.spreads[0].error):
        return over_units
    without = np.array([statistic(without_set(sums.totals, c))[:4] for c in range(classes)])
    tail, left = f" (a class has too few {unit}s to leave one out)", iter(without.T)
    none = np.full(classes, np.nan)
    spreads = [Spread.of(s.value, next(left, none), "class", tail) for s in over_units.spreads]
    return Estimate(spreads, without, over_units.units, of_classes=True)


def without_set(t: Totals, c: int) -> Totals:
    """All sets but c, both halves of each."""
    to = np.full(len(t.n), -1, dtype=np.intp)
    kept = np.setdiff1d(np.arange(len(t.n)), [2 * c, 2 * c + 1])
    to[kept] = np.arange(len(kept))
    return t.merge(to, len(kept))


@dataclass(frozen=True)
class Scored:
    """A score and how it moves.

    Attributes:
        score: the score.
        replicates: (G,) the value without each unit.
        units: (G,) names of the units: groups or samples, or classes where these cannot spare one.
        excess: (G,) of I- and CI-TMMD, the between-group excess E without each unit.
        design: what the value depends on besides the features: of halves of whole groups how their
            sizes turn E into dist^2 (:func:`palpate.metrics.mmd.design_of`), of other biased
            values 1/m + 1/m' of the halves; empty where it depends on neither.
        groups: names of all groups or samples that the set has.
    """

    score: Score
    replicates: Array = field(default_factory=lambda: NONE, repr=False)
    units: Sequence[str] = ()
    excess: Array = field(default_factory=lambda: NONE, repr=False)
    design: Array = field(default_factory=lambda: NONE, repr=False)
    groups: Sequence[str] = ()


def permutation_test(
    sums: PairSums, estimator: str, scale: float, *, count: int = 999, seed: int = 0
) -> tuple[float, Array, dict[str, int]] | None:
    """Exchange units between segments 0 and 1, in ``count`` random relabelings.

    Returns:
        The p-value, (1 + relabelings with at least the observed studentized value) / (1 +
        relabelings); (B,) studentized values of the relabelings, times the observed standard error:
        on the scale of TMMD; their number ``count``, the number of units that both sets have
        (``swapped``) and of one set alone (``dealt``), and the seed. None without sums of items
        with items, or where there is nothing to exchange.
    """
    if sums.block is None or count < 1:
        return None
    number = np.searchsorted(sums.units, sums.unit)
    inside = np.zeros((len(sums.units), 2), dtype=bool)
    inside[number, sums.segment] = True
    both: Any = inside.all(axis=1)
    alone = np.flatnonzero(~both)
    if not both.any() and len(set(inside[alone, 1].tolist())) < 2:
        return None
    rng = rng_for(seed, "permutation test")
    cells = 1 + bool(both.any())  # of a unit; alone, it has one
    label = np.tile([False, True], (count + 1, len(both), 1))  # row 0: as observed
    swap: Any = rng.random((count, len(both))) < 0.5
    label[1:] ^= (swap & both)[..., None]
    if len(alone):
        dealt = rng.permuted(np.tile(inside[alone, 1], (count, 1)), axis=1)
        label[1:, alone] = dealt[..., None]
    if cells == 1:
        label[0] = inside[:, 1:]
    label = label[..., :cells]
    m = one_hot(cells * number + sums.segment * (cells - 1), cells * len(both))
    block, n = m.T @ sums.block @ m, sums.n @ m
    block += np.diag(sums.diagonal @ m * (estimator == "biased"))
    batches = [
        _studentized(label[k : k + BATCH].astype(np.float64), block, n, estimator)
        for k in range(0, count + 1, BATCH)
    ]
    values, errors = (np.concatenate(batch) for batch in zip(*batches, strict=True))
    if not np.isfinite(errors[0]):  # a set of two groups cannot spare one: TMMD itself
        errors = np.ones_like(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = values / errors
    null = t[1:][np.isfinite(t[1:])]
    if not np.isfinite(t[0]) or not len(null):
        return None
    # Equal labelings differ in the last bits.
    hits = int((null >= t[0] - 1e-9 * max(abs(float(t[0])), 1e-9)).sum())
    counts = {"count": len(null), "swapped": int(both.sum()), "dealt": len(alone), "seed": seed}
    return (1 + hits) / (1 + len(null)), scale * errors[0] * null, counts


def _studentized(second: Array, block: Array, n: Array, estimator: str) -> tuple[Array, Array]:
    """(B,) MMD^2 for (B, U, c) labels, 1 for set 1, and its (B,) standard errors over U units.

    ``block`` (Uc, Uc) are the sums of the c cells of all units with each other, ``n`` (Uc,) their
    samples.
    """
    shape, grouped, first = second.shape, estimator == "grouped", 1 - second
    inner = np.einsum("uiuj->uij", block.reshape(*shape[1:], *shape[1:]))
    near = (second.reshape(len(second), -1) @ block).reshape(shape)  # sums with the second set
    far = block.sum(axis=0).reshape(shape[1:]) - near
    n = n.reshape(shape[1:])
    value, without = np.zeros((shape[0], 1)), np.zeros(shape[:2])

    def totals(right: Array, left: Array, inside: Array) -> tuple[Array, Array]:
        """(B, 1) of all units, and (B, U) without each."""
        right, left = (right - inside, left - inside) if grouped else (right, left)
        total = right.sum(axis=1, keepdims=True)
        without = total - right - left
        return total, without if grouped else without + inside

    def of_units(cells: Array) -> Array:  # a sum over so short an axis is slow
        return cells[..., 0] + cells[..., 1] if shape[2] > 1 else cells[..., 0]

    for (a, with_a), (b, with_b), weight in (
        ((first, far), (first, far), 1),
        ((second, near), (second, near), 1),
        ((first, far), (second, near), -2),
    ):
        own = of_units(a * of_units(inner * b[..., None, :]))
        right = of_units(a * with_b)
        sums = totals(right, right if a is b else of_units(b * with_a), own)
        x, y = of_units(a * n), of_units(b * n)
        alone = x * (weight > 0 and estimator == "unbiased")  # pairs i = j, which do not count
        every = (v.sum(axis=1, keepdims=True) for v in (y, x))
        right, left = (v * of_all - alone for v, of_all in zip((x, y), every, strict=True))
        pairs = zip((value, without), sums, totals(right, left, x * y - alone), strict=True)
        for side, kernels, count in pairs:
            side += weight * mean_of_pairs(kernels, count)
    drift = without - without.mean(axis=1, keepdims=True)
    error = np.sqrt((shape[1] - 1) / shape[1] * (drift**2).sum(axis=1))
    return value[:, 0], np.where(error > 0, error, np.nan)


def without_interval(score: Score) -> Score:
    """A score whose spread nobody knows: its value alone."""
    uncertain = ("interval", "p_value", "p_better", "p_adjusted", "p_difference")
    gone = [name for name in score.details if name.endswith(uncertain)]
    details = {**score.details, **dict.fromkeys(gone)}
    details |= {"decided": False} if "decided" in details else {}
    kept = [note for note in score.notes if note.code != "independent-samples"]
    return replace(score, interval=None, interval_method="", details=details, notes=kept)
