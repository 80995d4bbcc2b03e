"""Parts of the impact of a leak: 1-NN with ties, even thinning, the paired jackknife.

1-NN: a test row x gets the label of the train row z with the smallest ||x - z||^2. Equal images are
common (an untouched gel, a frame stored twice), so where several train rows are equally near, the
hit is the share of them with the right label: what a random choice among them would score on
average. Equally near means within the rounding of float32, ``TIE (||x||^2 + max ||z||^2)``.

Tables: hits and samples of a test part by group g and class c, (G, C). The accuracy is sum hits /
sum samples, or the mean over classes of that ratio. Jackknife: theta_g is the statistic without row
g, SE^2 = (G-1)/G sum_g (theta_g - mean theta)^2, interval theta +- t(G-1) SE. For a difference both
tables lose row g at once, so what a group does to both cancels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.core import rng_for
from palpate.metrics.intervals import Interval, jackknife_errors, t_interval

#: Entries of a block of distances (float32: 64 MB), of some test rows by all train rows.
CELLS = 1 << 24
#: Rounding of a float32 distance, relative to the squared lengths.
TIE = 2e-6

Floats = NDArray[np.float64]
Codes = NDArray[np.int64]


@dataclass(frozen=True)
class Table:
    """Hits and samples of a test part by group and class: two (G, C) arrays."""

    hits: Floats
    samples: Floats

    def __add__(self, other: Table) -> Table:
        return Table(self.hits + other.hits, self.samples + other.samples)


def tabulate(hits: Floats, groups: Codes, classes: Codes, shape: tuple[int, int]) -> Table:
    """Sum the hits of test rows (each in [0, 1]) by group and class numbers."""
    cell = groups * shape[1] + classes
    sums = [
        np.bincount(cell, weights=w, minlength=shape[0] * shape[1]).reshape(shape)
        for w in (hits, np.ones(len(cell)))
    ]
    return Table(sums[0].astype(np.float64), sums[1].astype(np.float64))


def nearest_hits(
    queries: NDArray[np.float32], base: NDArray[np.float32], query_class: Codes, base_class: Codes
) -> Floats:
    """Probability that 1-NN gets each query right, ties being broken at random.

    Args:
        queries: (m, d).
        base: (n, d).
        query_class: class numbers from 0, (m,).
        base_class: the same, (n,).

    Returns:
        (m,), in [0, 1].
    """
    classes = int(max(query_class.max(), base_class.max())) + 1
    one_hot = np.zeros((len(base), classes), np.float32)
    one_hot[np.arange(len(base)), base_class] = 1
    length = np.einsum("ij,ij->i", base, base)
    out = np.empty(len(queries))
    step = max(1, CELLS // len(base))
    for start in range(0, len(queries), step):
        x = queries[start : start + step]
        distance = x @ base.T
        distance *= -2
        distance += length
        rounding = TIE * (np.einsum("ij,ij->i", x, x) + length.max())
        tied = distance <= (distance.min(axis=1) + rounding)[:, None]
        # Sums of at most 2^24 ones are exact in float32.
        votes = tied.astype(np.float32) @ one_hot
        right = votes[np.arange(len(x)), query_class[start : start + step]]
        out[start : start + step] = right / votes.sum(axis=1)
    return out


def thin(rows: Codes, groups: Codes, classes: Codes, count: int, seed: int) -> Codes:
    """Choose rows evenly: every class keeps its share (at least one row), and so every group.

    Each class gets ``count * n_c / n`` rows, rounded so that the sum is ``count``; within a class
    the rows, sorted by group and at random within it, are taken at equal steps from a random start,
    so a group keeps its share to within one row.

    Args:
        rows: row numbers to choose from.
        groups: number of the group of each of ``rows``.
        classes: number of the class of each.
        count: rows to keep, at least the number of classes.
        seed: of the choice.

    Returns:
        ``count`` of ``rows`` (all of them, if they are no more), in a random order.
    """
    rng = rng_for(seed, "impact thin", count)
    order = rng.permutation(len(rows))
    if len(rows) <= count:
        return rows[order]
    sizes = np.bincount(classes)
    exact = count * sizes / len(rows)
    quota = np.where(sizes > 0, np.maximum(np.floor(exact), 1), 0).astype(np.int64)
    while (off := count - int(quota.sum())) != 0:
        room = (quota < sizes) if off > 0 else (quota > 1)
        gap = np.where(room, (exact - quota) * np.sign(off), -np.inf)
        quota[int(gap.argmax())] += np.sign(off)
    chosen: list[Codes] = []
    for c in np.flatnonzero(quota):
        of_class = order[classes[order] == c]
        line = of_class[np.argsort(groups[of_class], kind="stable")]
        at = (np.arange(quota[c]) + rng.random()) * len(line) / quota[c]
        chosen.append(line[at.astype(np.int64)])
    return rows[rng.permutation(np.concatenate(chosen))]


def accuracy(table: Table, balanced: bool = False) -> float:
    """Accuracy of a table, in [0, 1]; NaN without samples."""
    return float(
        _accuracy(table.hits.sum(axis=0)[None], table.samples.sum(axis=0)[None], balanced)[0]
    )


def _accuracy(hits: Floats, samples: Floats, balanced: bool) -> Floats:
    """Accuracy of each row of (R, C) sums."""
    with np.errstate(invalid="ignore", divide="ignore"):
        if not balanced:
            return hits.sum(axis=1) / samples.sum(axis=1)
        recall = np.where(samples > 0, hits / samples, 0)
        return recall.sum(axis=1) / (samples > 0).sum(axis=1)


def jackknife(
    plus: Table, minus: Table | None = None, *, balanced: bool = False
) -> tuple[float, Interval | None, int]:
    """An accuracy, or the difference of two, with its interval over groups.

    Args:
        plus: table of one test part.
        minus: table of the other, over the same groups and classes; None for the accuracy of
            ``plus`` alone.
        balanced: mean over classes of their accuracies, over the classes that are left.

    Returns:
        (value, interval, groups). The interval is at 95 %, cut to the possible range; None with
        fewer than two groups, where a table has samples of one group only, or where no group
        changes anything (no variation is no evidence of certainty).
    """
    tables = [plus] if minus is None else [plus, minus]
    used = np.any([table.samples.sum(axis=1) > 0 for table in tables], axis=0)
    signs = (1.0, -1.0)
    value = sum(
        sign * accuracy(table, balanced) for sign, table in zip(signs, tables, strict=False)
    )
    without = sum(
        sign
        * _accuracy(
            table.hits.sum(axis=0) - table.hits[used],
            table.samples.sum(axis=0) - table.samples[used],
            balanced,
        )
        for sign, table in zip(signs, tables, strict=False)
    )
    count = int(used.sum())
    error = float(jackknife_errors(np.asarray(without)[:, None])[0])
    if not error > 1e-12:  # NaN as well
        return float(value), None, count
    low, high = t_interval(float(value), error, count - 1, 0.95)
    return float(value), (max(low, 0.0 if minus is None else -1.0), min(high, 1.0)), count


def code(names: Sequence[str]) -> tuple[list[str], Codes]:
    """The distinct names, sorted, and the number of each."""
    values, codes = np.unique(np.asarray(list(names), dtype=str), return_inverse=True)
    return [str(v) for v in values], codes.astype(np.int64)
