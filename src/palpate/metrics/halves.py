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
from dataclasses import dataclass

import numpy as np

from palpate.core import seed_for
from palpate.metrics.kernels import Array, Index
from palpate.metrics.mmd import mmd_bound, mmd_matrix
from palpate.metrics.presets import Plan
from palpate.metrics.sums import Totals

#: More leave-one-out units than this are joined into random blocks where samples count as independent; fewer blocks where there are so many
#: samples that only moments are quick, whose room grows with the number of units.
BLOCKS, MANY, BLOCKS_OF_MANY = 1000, 100_000, 50


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


def sample_units(ids: Sequence[str], seed: int) -> tuple[Index, str, list[str]]:
    """Jackknife units where no groups are known: equal ids are one unit; above ``BLOCKS`` ids, random blocks of ids.

    Returns:
        (n,) units, what a unit is called, and the name of each.
    """
    names = sorted(set(ids))
    if len(names) <= BLOCKS:
        number = {name: k for k, name in enumerate(names)}
        return np.array([number[i] for i in ids], dtype=np.intp), "sample", names
    blocks = BLOCKS if len(names) <= MANY else BLOCKS_OF_MANY
    names.sort(key=lambda name: (seed_for(seed, "block", name), name))
    number = {name: k * blocks // len(names) for k, name in enumerate(names)}
    return (
        np.array([number[i] for i in ids], dtype=np.intp),
        "random-block",
        [f"block {k}" for k in range(blocks)],
    )


@dataclass(frozen=True)
class Design:
    """How E turns into dist^2 between halves, by the sizes of the groups alone: ``dist^2 = own * E + rest * (mean diagonal k - b)``.

    Attributes:
        own: (K,) ``sum s_g(s_g-1) / (m(m-1))``, or with m^2 below for the biased form.
        rest: (K,) 0, or n / m^2 for the biased form.
    """

    own: Array
    rest: Array


def design_of(t: Totals, plan: Plan) -> Design:
    """The design of K sets, given 2K segments."""
    t = whole_sets(t)
    inner, m, biased = np.diagonal(t.pairs) - t.n, t.n / 2, plan.estimator == "biased"
    with np.errstate(divide="ignore", invalid="ignore"):
        return Design(
            inner / (m**2 if biased else m * (m - 1)), t.n / m**2 if biased else np.zeros(len(t.n))
        )


def self_distances(t: Totals, plan: Plan, design: Design | None = None) -> tuple[Array, Array]:
    """dist^2 between the halves of each of K sets (Eq. 3, Eq. 5), and E; halves of whole groups by the closed form above.

    Args:
        t: 2K segments; 2c and 2c + 1 are the halves of set c (for ``group`` halves 2c + 1 is empty).
        plan: halves, estimator, scale. ``"grouped"`` acts as ``"unbiased"`` here: halves of whole groups share no group already,
            and without same-group pairs inside the halves the expectation would be 0 again.
        design: sizes of the groups to take instead of those of ``t``. dist^2 falls as the number of groups grows, so values without each group in
            turn must be those of the full design: else a jackknife takes the smaller number for noise (its intervals then covered 100 %
            with three videos a class). Ignored where it is of another number of sets.

    Returns:
        (K,) dist^2 and (K,) E, NaN where undefined: a set of one group, no group with two samples, or fewer than 4 samples.
    """
    whole, sets = whole_sets(t), len(t.n) // 2
    total, inside, pairs = (
        np.diagonal(whole.sums),
        np.diagonal(whole.same),
        np.diagonal(whole.pairs),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (total - inside) / (whole.n**2 - pairs)
        excess = inside / (pairs - whole.n) - between  # E = w - b
        beside = whole.own / whole.n - between
    bad = ~np.isfinite(excess) | (whole.n < 4)
    excess = np.where(bad, np.nan, plan.scale * excess)
    if plan.halves == "group":
        used = design if design is not None and len(design.own) == sets else design_of(t, plan)
        return used.own * excess + used.rest * np.where(bad, np.nan, plan.scale * beside), excess
    matrix = mmd_matrix(t, "biased" if plan.estimator == "biased" else "unbiased", plan.scale)
    first = 2 * np.arange(sets)
    return matrix[first, first + 1], excess


def halves_bound(rest: Totals, plan: Plan) -> Array:
    """(K,) what :func:`self_distances` may be off by, where the sums of its 2K segments may be off by ``rest``."""
    if plan.halves != "group":
        matrix = mmd_bound(rest, "biased" if plan.estimator == "biased" else "unbiased", plan.scale)
        first = 2 * np.arange(len(rest.n) // 2)
        return matrix[first, first + 1]
    t = whole_sets(rest)
    total, inside, pairs = np.diagonal(t.sums), np.diagonal(t.same), np.diagonal(t.pairs)
    m = t.n / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (total - inside) / (t.n**2 - pairs)
        return (
            plan.scale
            * (inside + pairs * between)
            / (m**2 if plan.estimator == "biased" else m * (m - 1))
        )


def whole_sets(t: Totals) -> Totals:
    """The halves of each set joined: 2K segments -> K."""
    sets = len(t.n) // 2
    return t.merge(np.repeat(np.arange(sets), 2), sets)


def take_sets(t: Totals, kept: Index) -> Totals:
    """Both halves of the sets ``kept``."""
    to = np.full(len(t.n), -1, dtype=np.intp)
    to[2 * kept], to[2 * kept + 1] = 2 * np.arange(len(kept)), 2 * np.arange(len(kept)) + 1
    return t.merge(to, 2 * len(kept))
