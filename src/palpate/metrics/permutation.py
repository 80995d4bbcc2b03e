"""Permutation test of TMMD: are generated and real touches exchangeable, video by video?

Under the null hypothesis it does not matter which set a unit (a whole video) stands in. Frames of one video are not exchangeable with
frames of another: permuting frames rejects a true null in every data set of 40 videos. Units that both sets have (generated and real
touches of one test video) swap their two parts with probability one half; units of one set alone are dealt anew, as many to each set as
before. Everything follows from the sums of items with items: no kernel is evaluated again.

What is compared is TMMD over its own standard error (the leave-one-unit-out jackknife of that relabeling), not TMMD: where the sets have
unequal numbers of frames a video, relabeled sets are not like the observed ones, and TMMD itself rejects a true null in 29 % (6 videos of one frame
against 40 of 30) or never (2 generated frames a video against 20 real ones). The studentized value is asymptotically free of the sizes
(Janssen 1997; Chung and Romano 2013), and exact, as the plain one, where units are exchangeable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.core import rng_for
from palpate.metrics.kernels import Array
from palpate.metrics.sums import PairSums

BATCH = 256


@dataclass(frozen=True)
class Permuted:
    """A permutation test.

    Attributes:
        p: (1 + number of relabelings with at least the observed studentized value) / (1 + number of relabelings).
        null: (B,) studentized values of the relabelings, times the observed standard error: on the scale of TMMD.
        swapped: units that both sets have.
        dealt: units of one set alone.
    """

    p: float
    null: Array
    swapped: int
    dealt: int


def permutation_test(
    sums: PairSums, estimator: str, scale: float, *, count: int = 999, seed: int = 0
) -> Permuted | None:
    """Exchanges units between segments 0 and 1.

    Args:
        sums: two segments, with ``block``.
        estimator: ``"unbiased"``, ``"biased"`` or ``"grouped"``.
        scale: factor on the values.
        count: random relabelings.
        seed: of the relabelings.

    Returns:
        The test, or None where sums of items with items were not kept or there is nothing to exchange.
    """
    if sums.block is None or sums.segments != 2 or count < 1:
        return None
    units, number = np.unique(sums.unit, return_inverse=True)
    inside = np.zeros((len(units), 2), dtype=bool)
    inside[number, sums.segment] = True
    both: NDArray[np.bool_] = np.asarray(inside.all(axis=1), dtype=np.bool_)
    alone = np.flatnonzero(~both)
    if not both.any() and len(set(inside[alone, 1].tolist())) < 2:
        return None
    rng = rng_for(seed, "permutation test")
    label = np.tile(sums.segment == 1, (count + 1, 1))  # row 0: as observed
    swap: NDArray[np.bool_] = np.asarray(rng.random((count, len(units))) < 0.5, dtype=np.bool_)
    label[1:] ^= swap[:, number] & both[number]
    if len(alone):
        dealt = np.zeros((count, len(units)), dtype=bool)
        dealt[:, alone] = rng.permuted(np.tile(inside[alone, 1], (count, 1)), axis=1)
        label[1:] = np.where(both[number], label[1:], dealt[:, number])
    found = [
        _studentized(label[k : k + BATCH], sums, number, estimator)
        for k in range(0, count + 1, BATCH)
    ]
    values, errors = (np.concatenate(column) for column in zip(*found, strict=True))
    if not np.isfinite(errors[0]):  # a set of two groups cannot spare one: TMMD itself
        errors = np.ones_like(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = values / errors
    null = t[1:][np.isfinite(t[1:])]
    if not np.isfinite(t[0]) or not len(null):
        return None
    # Equal labelings differ in the last bits.
    hits = int((null >= t[0] - 1e-9 * max(abs(float(t[0])), 1e-9)).sum())
    return Permuted(
        (1 + hits) / (1 + len(null)), scale * errors[0] * null, int(both.sum()), len(alone)
    )


def _studentized(
    label: NDArray[np.bool_], sums: PairSums, unit: NDArray[np.intp], estimator: str
) -> tuple[Array, Array]:
    """(B,) MMD^2 for (B, P) labels of the items, and its (B,) standard errors by leaving out each of U units."""
    second, units = label.astype(np.float64), int(unit.max()) + 1
    first = 1 - second
    of_unit = np.zeros((len(unit), units))
    of_unit[np.arange(len(unit)), unit] = 1
    same = unit[:, None] == unit[None]
    block = sums.block if sums.block is not None else np.zeros((0, 0))
    counts = np.outer(sums.n, sums.n)
    value, without = np.zeros(len(label)), np.zeros((len(label), units))
    for a, b, weight in ((first, first, 1), (second, second, 1), (first, second, -2)):
        own, alone = (
            np.zeros_like(sums.n),
            np.zeros_like(sums.n),
        )  # what i = j adds to the sum and to the number of pairs
        if weight > 0:
            own, alone = (
                (sums.own, 0 * sums.n)
                if estimator == "biased"
                else (own, -sums.n if estimator == "unbiased" else alone)
            )
        total = _with_and_without(a, b, block, own, same, of_unit, grouped=estimator == "grouped")
        pairs = _with_and_without(
            a, b, counts, alone, same, of_unit, grouped=estimator == "grouped"
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            value += weight * total[0] / pairs[0]
            without += weight * total[1] / pairs[1]
    error = np.sqrt(
        (units - 1) / units * ((without - without.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    )
    return value, np.where(error > 0, error, np.nan)


def _with_and_without(
    a: Array,
    b: Array,
    matrix: Array,
    own: Array,
    same: NDArray[np.bool_],
    of_unit: Array,
    *,
    grouped: bool,
) -> tuple[Array, Array]:
    """(B,) ``a' matrix b + a' own``, and (B, U) the same without each unit; ``grouped`` leaves out pairs of one unit."""
    inner = np.where(same, matrix, 0.0)
    if grouped:
        matrix, inner = matrix - inner, np.zeros_like(inner)
    right, alone = a * (b @ matrix.T), a * own
    left = right if a is b else b * (a @ matrix)
    total = right.sum(axis=1) + alone.sum(axis=1)
    return total, total[:, None] - (right + left + alone - a * (b @ inner.T)) @ of_unit
