"""Two halves of a set: drawn at random, cut in file order, or made of whole groups; dist^2 between.

Random halves carry no signal: the average of the unbiased dist^2 over all halvings is 0 for every
data set, since a pair within a half and a pair across are both just pairs. Halves of whole groups
do: with W the sum of k over pairs inside groups, b the mean of k over pairs between groups and s_g
the group sizes, a balanced half (m = n/2) holds half of the pairs inside groups, so that the
average is

* unbiased: ``I = (W - b sum s_g(s_g-1)) / (m(m-1))``, which is ``sum s_g(s_g-1) / (m(m-1))`` times
* the between-group excess ``E = w - b``, w the mean of k over pairs i != j inside groups. 2E is the
  dist^2 of two random groups; I falls as the number of groups grows, E does not.
* biased: ``I = (W - b sum s_g^2) / m^2`` (W with the diagonal).

These closed forms need no seed, and equal the mean over all halvings exactly when groups are equal
in size and even in number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpate.core import seed_for
from palpate.metrics.inputs import Array, Index
from palpate.metrics.mmd import mmd_bound, mmd_matrix
from palpate.metrics.presets import Plan
from palpate.metrics.sums import Totals

#: More samples than this are left out in so many random blocks; in fewer where there are so many
#: that only moments are quick, whose size grows with the number of units.
BLOCKS, MANY, BLOCKS_OF_MANY = 1000, 100_000, 50


def half_of(ids: Sequence[str], within: Index, plan: Plan) -> Index:
    """0 or 1 for each sample, in halves whose sizes differ by at most one, in each value of
    ``within``.

    ``random`` depends on (seed, ids) and ``ordered`` on the order of the ids as strings, neither on
    the order of the rows. ``group`` gives 0 everywhere: its halves are never drawn.
    """
    half = np.zeros(len(ids), dtype=np.intp)
    if plan.halves == "group":
        return half
    keys = list(ids) if plan.halves == "ordered" else [seed_for(plan.seed, "half", i) for i in ids]
    order = np.array(sorted(range(len(ids)), key=lambda i: (keys[i], ids[i])), dtype=np.intp)
    for value in np.unique(within):
        at = order[within[order] == value]
        half[at[(len(at) + 1) // 2 :]] = 1
    return half


def sample_units(ids: Sequence[str], seed: int) -> tuple[Index, str, list[str]]:
    """Jackknife units where no groups are known: equal ids are one; many ids are random blocks.

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
    units = np.array([number[i] for i in ids], dtype=np.intp)
    return units, "random-block", [f"block {k}" for k in range(blocks)]


@dataclass(frozen=True)
class Design:
    """How E turns into dist^2 between halves, by the sizes of the groups alone.

    ``dist^2 = of_excess * E + of_spread * (mean diagonal k - b)``.

    Attributes:
        of_excess: (K,) ``sum s_g(s_g-1) / (m(m-1))``, or with m^2 below for the biased form.
        of_spread: (K,) 0, or n / m^2 for the biased form.
    """

    of_excess: Array
    of_spread: Array


def design_of(t: Totals, plan: Plan) -> Design:
    """The design of K sets, given 2K segments."""
    t = whole_sets(t)
    inner, m, biased = np.diagonal(t.pairs) - t.n, t.n / 2, plan.estimator == "biased"
    with np.errstate(divide="ignore", invalid="ignore"):
        of_excess = inner / (m**2 if biased else m * (m - 1))
        return Design(of_excess, t.n / m**2 if biased else np.zeros(len(t.n)))


def self_distances(t: Totals, plan: Plan, design: Design | None = None) -> tuple[Array, Array]:
    """dist^2 between the halves of each of K sets (Eq. 3, Eq. 5), and E.

    Args:
        t: 2K segments; 2c and 2c + 1 are the halves of set c (for ``group`` halves 2c + 1 is
            empty).
        plan: halves, estimator, scale. ``"grouped"`` acts as ``"unbiased"`` here: halves of whole
            groups share no group already, and without same-group pairs inside the halves the
            expectation would be 0 again.
        design: sizes of the groups to take instead of those of ``t``. dist^2 falls as the number of
            groups grows, so values without each group in turn must be those of the full design:
            else a jackknife takes the smaller number for noise (its intervals then covered 100 %
            with three videos a class). Ignored where it is of another number of sets.

    Returns:
        (K,) dist^2 and (K,) E, NaN where undefined: a set of one group, no group with two samples,
        or fewer than 4 samples.
    """
    whole = whole_sets(t)
    total, inside, pairs = (np.diagonal(a) for a in (whole.sums, whole.same, whole.pairs))
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (total - inside) / (whole.n**2 - pairs)
        excess = inside / (pairs - whole.n) - between  # E = w - b
        spread = whole.diagonal / whole.n - between
    bad = ~np.isfinite(excess) | (whole.n < 4)
    excess, spread = (np.where(bad, np.nan, plan.scale * a) for a in (excess, spread))
    if plan.halves == "group":
        if design is None or len(design.of_excess) != len(whole.n):
            design = design_of(t, plan)
        return design.of_excess * excess + design.of_spread * spread, excess
    return _between_halves(mmd_matrix(t, _estimator(plan), plan.scale)), excess


def halves_bound(remainder: Totals, plan: Plan) -> Array:
    """(K,) what :func:`self_distances` may be off by, where sums may be off by ``remainder``."""
    if plan.halves != "group":
        return _between_halves(mmd_bound(remainder, _estimator(plan), plan.scale))
    t = whole_sets(remainder)
    total, inside, pairs = (np.diagonal(a) for a in (t.sums, t.same, t.pairs))
    m = t.n / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (total - inside) / (t.n**2 - pairs)
        below = m**2 if plan.estimator == "biased" else m * (m - 1)
        return plan.scale * (inside + pairs * between) / below


def _estimator(plan: Plan) -> str:
    return "biased" if plan.estimator == "biased" else "unbiased"


def _between_halves(matrix: Array) -> Array:
    first = np.arange(0, len(matrix), 2)
    return matrix[first, first + 1]


def whole_sets(t: Totals) -> Totals:
    """The halves of each set joined: 2K segments -> K."""
    sets = len(t.n) // 2
    return t.merge(np.repeat(np.arange(sets), 2), sets)


def without_set(t: Totals, c: int) -> Totals:
    """All sets but c, both halves of each."""
    to = np.full(len(t.n), -1, dtype=np.intp)
    kept = np.setdiff1d(np.arange(len(t.n)), [2 * c, 2 * c + 1])
    to[kept] = np.arange(len(kept))
    return t.merge(to, len(kept))


def halves_of(n: Array) -> Array:
    """(K, 2) sizes of the halves of (K,) samples: as equal as they can be."""
    return np.stack([np.ceil(n / 2), np.floor(n / 2)], axis=1)


def dispersion_of(t: Totals, plan: Plan) -> Array:
    """(K,) average of the biased dist^2 over random halves of each of K segments.

    ``(1/m + 1/m') * scale * (mean diagonal k - mean off-diagonal k)``.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = t.diagonal / t.n - np.diagonal(t.sums) / (t.n * (t.n - 1))
        return (1 / halves_of(t.n)).sum(axis=1) * plan.scale * spread


def random_halves_sd(spread: Array, sizes: Array, estimator: str, scale: float) -> Array:
    """Standard deviation (K,) of dist^2 between two random halves of each of K sets, by closed
    form.

    Let s = +-1 mark halves of m and m' samples, n = m + m', D = m - m', and Kc be the doubly
    centered kernel matrix, whose rows add up to 0. With ``W = sum_{i != j} Kc_ij s_i s_j`` and
    ``L = sum_i Kc_ii s_i``

    biased = const + W (1/m + 1/m')^2 / 4,   unbiased = const + c W - 2 b L,

    c = [1/(m(m-1)) + 1/(m'(m'-1))] / 4 + 1/(2 m m'), b = [1/(m(m-1)) - 1/(m'(m'-1))] / 4. Variances
    follow from the mean products of one to four distinct signs over all halvings: p1 = D/n,
    p2 = (D^2 - n) / (n(n-1)), p3 = (D^3 - (3n-2) D) / (n(n-1)(n-2)),
    p4 = (D^4 - (6n-8) D^2 + 3n^2 - 6n) / (n(n-1)(n-2)(n-3)). The mean is exactly 0 for unbiased
    (for any data), and :func:`dispersion_of` for biased.

    Args:
        spread: (K, 3): S, sum over i != j of Kc_ij^2; T and Q, sums of Kc_ii and of their squares.
        sizes: (K, 2) m and m'.
        estimator: ``"biased"``, or any other for unbiased.
        scale: factor on the result.
    """
    (off, trace, squares), (x, y) = spread.T, sizes.T
    n, d = x + y, x - y
    with np.errstate(divide="ignore", invalid="ignore"):
        p1, p2 = d / n, (d**2 - n) / (n * (n - 1))
        p3 = (d**3 - (3 * n - 2) * d) / (n * (n - 1) * (n - 2))
        p4 = (d**4 - (6 * n - 8) * d**2 + 3 * n**2 - 6 * n) / (n * (n - 1) * (n - 2) * (n - 3))
        four = trace**2 - 2 * off - 4 * (squares - off)
        var_w = 2 * off + 4 * p2 * (squares - off) + p4 * four - (p2 * trace) ** 2
        var_l = squares * (1 - p1**2) + (trace**2 - squares) * (p2 - p1**2)
        both = -2 * p1 * squares + p3 * (2 * squares - trace**2) + p1 * p2 * trace**2
        if estimator == "biased":
            c, b = (1 / x + 1 / y) ** 2 / 4, 0.0
        else:
            of_x, of_y = 1 / (x * (x - 1)), 1 / (y * (y - 1))
            c, b = (of_x + of_y) / 4 + 1 / (2 * x * y), (of_x - of_y) / 4
        variance = c**2 * var_w + 4 * b**2 * var_l - 4 * b * c * both
        few = (n < 4) | (sizes.min(axis=1) < (1 if estimator == "biased" else 2))
        return np.where(few, np.nan, scale * np.sqrt(np.maximum(variance, 0)))
