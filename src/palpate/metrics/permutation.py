"""Permutation test of TMMD: are generated and real touches exchangeable, video by video?

Under the null hypothesis it does not matter which set a unit (a whole video) stands in. Frames of one video are not exchangeable with
frames of another: permuting frames rejects a true null in every data set of 40 videos. Units that both sets have (generated and real
touches of one test video) swap their two parts with probability one half; units of one set alone are dealt anew, as many to each set as
before. Everything follows from the sums of items with items: no kernel is evaluated again.
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
        p: (1 + number of relabellings with at least the observed value) / (1 + number of relabellings).
        null: (B,) values of the relabellings.
        swapped: units that both sets have.
        dealt: units of one set alone.
    """

    p: float
    null: Array
    swapped: int
    dealt: int


def permutation_test(sums: PairSums, estimator: str, scale: float, *, count: int = 999, seed: int = 0) -> Permuted | None:
    """Exchanges units between segments 0 and 1.

    Args:
        sums: two segments, with ``block``.
        estimator: ``"unbiased"``, ``"biased"`` or ``"grouped"``.
        scale: factor on the values.
        count: random relabellings.
        seed: of the relabellings.

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
    values = np.concatenate([_values(label[k : k + BATCH], sums, number, estimator) for k in range(0, count + 1, BATCH)])
    null = values[1:][np.isfinite(values[1:])]
    if not np.isfinite(values[0]) or not len(null):
        return None
    # Equal labellings differ in the last bits.
    hits = int((null >= values[0] - 1e-9 * max(abs(values[0]), 1e-9)).sum())
    return Permuted((1 + hits) / (1 + len(null)), scale * null, int(both.sum()), len(alone))


def _values(label: NDArray[np.bool_], sums: PairSums, unit: NDArray[np.intp], estimator: str) -> Array:
    """(B,) MMD^2 for (B, P) labels of the items."""
    second = label.astype(np.float64)
    first = 1 - second
    block = sums.block if sums.block is not None else np.zeros((0, 0))
    apart = unit[:, None] != unit[None]
    kernel = np.where(apart, block, 0.0) if estimator == "grouped" else block
    counts = np.outer(sums.n, sums.n) * (apart if estimator == "grouped" else 1)
    means = []
    for a, b in ((first, first), (second, second), (first, second)):
        total, pairs = ((a @ kernel) * b).sum(axis=1), ((a @ counts) * b).sum(axis=1)
        if a is b and estimator == "unbiased":
            pairs = pairs - a @ sums.n
        if a is b and estimator == "biased":
            total = total + a @ sums.own
        with np.errstate(divide="ignore", invalid="ignore"):
            means.append(total / pairs)
    return means[0] + means[1] - 2 * means[2]
