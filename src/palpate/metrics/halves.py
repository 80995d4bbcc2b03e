"""Two halves of a set: drawn at random, cut in file order, or made of whole groups; and dist^2 between them.

Random halves carry no signal: the average of the unbiased dist^2 over all halvings is 0 for every data set, since a pair within a half
and a pair across are both just pairs. Halves of whole groups do: with W the sum of k over pairs inside groups, b the
mean of k over pairs between groups and s_g the group sizes, a balanced half (m = n/2) holds half of the pairs inside groups, so that the average over halvings is

* unbiased: ``I = (W - b sum s_g(s_g-1)) / (m(m-1))``, which is ``sum s_g(s_g-1) / (m(m-1))`` times
* the between-group excess ``E = w - b``, w the mean of k over pairs i != j inside groups. 2E is the dist^2 of two random groups; I falls
  as the number of groups grows, E does not.
* biased: ``I = (W - b sum s_g^2) / m^2`` (W with the diagonal).

These closed forms need no seed, and equal the mean over all halvings exactly when groups are equal in size and even in number.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from palpate.core import seed_for
from palpate.metrics.kernels import Array, Index, Totals
from palpate.metrics.mmd import mmd_matrix
from palpate.metrics.presets import Plan

#: More leave-one-out units than this are joined into random blocks where samples count as independent.
BLOCKS = 1000


def half_of(ids: Sequence[str], within: Index, plan: Plan) -> Index:
    """0 or 1 for each sample, in halves whose sizes differ by at most one, inside each value of ``within``.

    ``random`` depends on (seed, ids) and ``ordered`` on the order of the ids as strings, neither on the order of the rows.
    ``group`` gives 0 everywhere: its halves are never drawn.
    """
    if plan.halves == "group":
        return np.zeros(len(ids), dtype=np.intp)
    keys = list(ids) if plan.halves == "ordered" else [seed_for(plan.seed, "half", i) for i in ids]
    half = np.zeros(len(ids), dtype=np.intp)
    order = np.array(sorted(range(len(ids)), key=lambda i: (keys[i], ids[i])), dtype=np.intp)
    for value in np.unique(within):
        at = order[within[order] == value]
        half[at[(len(at) + 1) // 2 :]] = 1
    return half


def sample_units(ids: Sequence[str], seed: int) -> tuple[Index, str]:
    """Jackknife units where no groups are known: equal ids are one unit; above ``BLOCKS`` ids, random blocks of ids.

    Returns:
        (n,) units, and what a unit is called.
    """
    names = sorted(set(ids))
    if len(names) <= BLOCKS:
        number = {name: k for k, name in enumerate(names)}
        return np.array([number[i] for i in ids], dtype=np.intp), "sample"
    names.sort(key=lambda name: (seed_for(seed, "block", name), name))
    number = {name: k * BLOCKS // len(names) for k, name in enumerate(names)}
    return np.array([number[i] for i in ids], dtype=np.intp), "random-block"


def group_halves(t: Totals, biased: bool, scale: float) -> tuple[Array, Array]:
    """dist^2 between halves made of whole groups, averaged over halvings, and the excess E, for each segment.

    Returns:
        (S,) dist^2 and (S,) E; NaN where a segment has one group, or no group has two samples.
    """
    total, inside, pairs = np.diagonal(t.sums), np.diagonal(t.same), np.diagonal(t.pairs)
    m = t.n / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (total - inside) / (t.n**2 - pairs)
        excess = inside / (pairs - t.n) - between  # E = w - b
        unbiased = (inside - (pairs - t.n) * between) / (m * (m - 1))
        value = (inside - pairs * between) / m**2 if biased else unbiased
    bad = ~np.isfinite(excess) | (t.n < 4)
    return np.where(bad, np.nan, scale * value), np.where(bad, np.nan, scale * excess)


def self_distances(t: Totals, plan: Plan) -> tuple[Array, Array]:
    """dist^2 between the halves of each of K sets (Eq. 3, Eq. 5), and E.

    Args:
        t: 2K segments; 2c and 2c + 1 are the halves of set c (for ``group`` halves 2c + 1 is empty).
        plan: halves, estimator, scale. ``"grouped"`` acts as ``"unbiased"`` here: halves of whole groups share no group already,
            and without same-group pairs inside the halves the expectation would be 0 again.

    Returns:
        (K,) dist^2 and (K,) E, NaN where undefined.
    """
    sets = len(t.n) // 2
    closed, excess = group_halves(whole_sets(t), plan.estimator == "biased", plan.scale)
    if plan.halves == "group":
        return closed, excess
    matrix = mmd_matrix(t, "biased" if plan.estimator == "biased" else "unbiased", plan.scale)
    first = 2 * np.arange(sets)
    return matrix[first, first + 1], excess


def whole_sets(t: Totals) -> Totals:
    """The halves of each set joined: 2K segments -> K."""
    sets = len(t.n) // 2
    return t.merge(np.repeat(np.arange(sets), 2), sets)


def take_sets(t: Totals, kept: Index) -> Totals:
    """Both halves of the sets ``kept``."""
    to = np.full(len(t.n), -1, dtype=np.intp)
    to[2 * kept], to[2 * kept + 1] = 2 * np.arange(len(kept)), 2 * np.arange(len(kept)) + 1
    return t.merge(to, 2 * len(kept))
