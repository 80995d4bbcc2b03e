"""Squared maximum mean discrepancy: of two sets, and of two halves of one set.

**Two sets** X (m rows) and Y (n rows), with mean kernels XX, YY inside the sets and XY across:

``dist^2(X, Y) = scale * (XX + YY - 2 XY)``  (paper, Eq. 2, times scale)

* ``unbiased``: XX and YY over pairs i != j, divided by m(m-1) and n(n-1): Eq. 2 as printed. Can be
  negative.
* ``biased``: XX and YY over all pairs, divided by m^2 and n^2; what CMMD's published code computes.
  Larger by ``scale * [(1 - XX)/m + (1 - YY)/n]``.
* ``grouped``: pairs of the same group (video) are excluded from all three sums. Frames of a video
  are not independent; with 40 videos of 15 frames the unbiased form is +0.1 too large under the
  null. Nor are a generated and a real image of one scene: with no groups but shared ids, pairs of
  one id are excluded (of many ids, pairs of one random block of them); the unbiased form of 12
  such pairs lies 0.3 below the truth, and its interval never holds it.

On unit-norm features with sigma = 10 the value is about 9.9 ||mean(X) - mean(Y)||^2 at scale 1000.

**Two halves of a set.** Random halves carry no signal: the average of the unbiased dist^2 over all
halvings is 0 for every data set, since a pair within a half and a pair across are both just pairs.
Halves of whole groups do. The **between-group excess** ``E = w - b`` is the mean of k over pairs
i != j inside groups less that over pairs between groups; 2E is the dist^2 of two random groups. A
sample weighs 1 / s_g, the size of its group, and a pair the product of two: groups weigh the same,
whatever their sizes (but one with few pairs less in w). With all pairs weighing the same, long
videos decide alone: E then spreads half as much again where a few are far longer than others.

With s_g the group sizes and balanced halves (m = n/2), which hold half of the pairs inside groups:

* unbiased: ``I = E sum s_g(s_g-1) / (m(m-1))``; I falls as the number of groups grows, E does not.
* biased: ``I = [E sum s_g(s_g-1) + n (d - b)] / m^2``, d the mean of k(x, x).

These closed forms need no seed. They are the mean over all halvings into equally many groups where
groups are equal in size and even in number; else they stand for halves that cannot be drawn.

**Presets** fix all options of a column of the paper's table at once:

============  =========  =======  =================  ==============  ===============================
preset        estimator  halves   denominator        aggregate       what it is
============  =========  =======  =================  ==============  ===============================
paper         unbiased   random   sum                mean_of_ratios  Eq. 2-7 to the letter: I- and
                                                                     CI-TMMD have expectation 0
paper-tables  biased     ordered  mean_off_diagonal  mean_of_ratios  the reading whose magnitudes
                                                                     fit the printed tables
cmmd          biased     random   sum                mean_of_ratios  as CMMD's published code
grouped       grouped    group    sum                ratio_of_means  the default where groups are
                                                                     known: videos stay whole
============  =========  =======  =================  ==============  ===============================
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from palpate.core import PalpateWarning, require, require_choice, seed_for
from palpate.metrics.inputs import (
    Array,
    Index,
    Normalize,
    check,
    checked_names,
    checked_pair,
    checked_scale,
    checked_whole,
    copies_across,
)
from palpate.metrics.intervals import PairSums, Totals, mean_of_pairs
from palpate.metrics.kernels import (
    BACKENDS,
    Backend,
    Kernel,
    Sigma,
    checked_kernel,
    gaussian,
    kernel_sums,
)

Estimator = Literal["unbiased", "biased", "grouped"]
Halves = Literal["group", "random", "ordered"]
Denominator = Literal["sum", "mean", "mean_off_diagonal"]
Aggregate = Literal["mean_of_ratios", "ratio_of_means"]
HALVES = ("group", "random", "ordered")
DENOMINATORS = ("sum", "mean", "mean_off_diagonal")
AGGREGATES = ("mean_of_ratios", "ratio_of_means")
ESTIMATORS = ("unbiased", "biased", "grouped")
CHOICES = {
    "estimator": ESTIMATORS,
    "halves": HALVES,
    "denominator": DENOMINATORS,
    "aggregate": AGGREGATES,
    "backend": BACKENDS,
}


def mmd_matrix(t: Totals, estimator: str, scale: float) -> Array:
    """Eq. 2 between every two segments, (S, S); NaN where there are no pairs to average.

    The diagonal has no meaning. A constant in k cancels, as XX + YY - 2 XY weighs it 1 + 1 - 2.
    """
    inner, cross = _means(t, estimator)
    return scale * (inner[:, None] + inner[None, :] - 2 * cross)  # Eq. 2


def mmd_bound(remainder: Totals, estimator: str, scale: float) -> Array:
    """What :func:`mmd_matrix` may be off by, where sums may be off by ``remainder``."""
    inner, cross = _means(remainder, estimator)
    return scale * (inner[:, None] + inner[None, :] + 2 * cross)


def _means(t: Totals, estimator: str) -> tuple[Array, Array]:
    """Mean kernel inside segments (S,) and between them (S, S), over an estimator's pairs."""
    sums, pairs = t.sums, np.outer(t.n, t.n)
    if estimator == "grouped":
        sums, pairs = t.sums - t.same, pairs - t.pairs
    inner_sums, inner_pairs = np.diagonal(sums), np.diagonal(pairs)
    if estimator == "unbiased":
        inner_pairs = t.n * (t.n - 1)
    if estimator == "biased":
        inner_sums = inner_sums + t.diagonal
    return mean_of_pairs(inner_sums, inner_pairs), mean_of_pairs(sums, pairs)


def largest_bound(sums: PairSums, estimator: str, scale: float) -> float:
    """The largest :func:`mmd_bound` between two segments; 0 where sums are exact."""
    if sums.bound is None:
        return 0.0
    # Where there are no pairs there is nothing to bound; elsewhere a bound that overflowed is none.
    defined = np.isfinite(mmd_matrix(sums.totals, estimator, scale))
    defined &= ~np.eye(sums.segments, dtype=bool)
    off = mmd_bound(sums.bound.totals, estimator, scale)[defined]
    return float(np.where(np.isfinite(off), off, np.inf).max(initial=0.0))


def unit_index(*columns: Sequence[str]) -> Index:
    """Integers for the names of all columns, one column after the other."""
    names = np.concatenate([np.asarray(c, dtype=object).astype(str) for c in columns])
    return np.unique(names, return_inverse=True)[1].astype(np.intp)


@dataclass(frozen=True)
class Distance:
    """A squared MMD and how it was computed.

    Attributes:
        value: times ``scale``; may be negative for ``unbiased`` and ``grouped``.
        bound: the value is within this of the exact one (rounding aside); 0 for ``blocked``.
        backend: ``"blocked"`` or ``"moments"``.
        estimator: which pairs were averaged.
        kernel: settings of the kernel.
        bandwidth: sigma, or None where there are several or none.
        scale: factor on the raw value.
        m: rows of x.
        n: rows of y.
    """

    value: float
    bound: float
    backend: str
    estimator: Estimator
    kernel: dict[str, Any]
    bandwidth: float | None
    scale: float
    m: int
    n: int

    def __float__(self) -> float:
        """The value."""
        return self.value


def distance(  # noqa: PLR0913
    x: Any,
    y: Any,
    *,
    sigma: Sigma = 10.0,
    kernel: Kernel | None = None,
    scale: float = 1000.0,
    estimator: Estimator = "unbiased",
    groups_x: Any = None,
    groups_y: Any = None,
    normalize: Normalize = "check",
    backend: Backend = "auto",
    block: int = 1024,
) -> Distance:
    """Squared MMD between two sets of features (paper, Eq. 2), times ``scale``.

    Args:
        x: (m, d) features, see :mod:`palpate.metrics.inputs`; an array on disk is streamed.
        y: (n, d) features of the same library; m and n may differ.
        sigma: bandwidth of the Gaussian kernel; several are averaged; ``"median"`` and ``"multi"``
            take the median distance of ``y``.
        kernel: instead of the Gaussian, e.g. :class:`palpate.metrics.Polynomial`.
        scale: factor on the result; 1000 as in CMMD.
        estimator: ``"unbiased"``, ``"biased"`` or ``"grouped"``, see the module.
        groups_x: m group names, for ``"grouped"``; the same name in both sets is the same group.
        groups_y: n group names.
        normalize: ``"check"`` rejects rows not of unit length (1e-3), ``True`` normalizes,
            ``False`` takes them as they are.
        backend: ``"auto"``, ``"blocked"`` or ``"moments"``, see :mod:`palpate.metrics.kernels`.
        block: rows of a kernel block; memory is about ``block^2`` numbers a thread.

    Returns:
        The value. Blocked: float32 unit-norm features with an error below 1e-4 at scale 1000,
        float64 below 1e-9.

    Raises:
        PalpateError: on features that :func:`palpate.metrics.inputs.checked_features` rejects,
            fewer than two rows for ``"unbiased"``, or groups that are missing or too few for
            ``"grouped"``.
    """
    require_choice("estimator", estimator, ESTIMATORS)
    require_choice("backend", backend, BACKENDS)
    checked_scale(scale)
    checked_whole(1, block=block)
    checked_kernel(kernel)
    least = 1 if estimator == "biased" else 2
    x, y = checked_pair(x, y, normalize=normalize, least=least)
    if copies := copies_across(x, y):
        text = f"{copies} rows of x are bit for bit rows of y: a copy is not a generator"
        warnings.warn(text, PalpateWarning, stacklevel=2)
    segment = np.repeat(np.arange(2), [len(x), len(y)])
    unit = segment  # no pair is excluded: a set is one item
    gx = checked_names("groups_x", groups_x, len(x))
    gy = checked_names("groups_y", groups_y, len(y))
    if estimator == "grouped":
        must = "must be unbiased or biased where the groups of a set are unknown"
        both = gx is not None and gy is not None
        require(both, "estimator", must, repr(estimator), fix="Pass groups_x and groups_y")
        unit = unit_index(gx or (), gy or ())
    kernel = gaussian(sigma, y, gy) if kernel is None else kernel
    sums = kernel_sums(
        [x, y],
        np.stack([segment, unit]),
        2,
        kernel,
        lambda sums: largest_bound(sums, estimator, 1000.0),
        backend=backend,
        block=block,
    )
    value = float(mmd_matrix(sums.totals, estimator, scale)[0, 1])
    bound = largest_bound(sums, estimator, scale)
    finite = bool(np.isfinite(sums.totals.sums).all())
    fix = "Normalize the rows, or scale them down"
    check(finite, "Kernel values", "must be finite", "infinity or NaN", fix)
    got = f"{len(set(gx or ()))} and {len(set(gy or ()))} groups"
    must, fix = "must have at least two groups, not all shared", "Pass more groups"
    check(math.isfinite(value), "Each set", must, got, fix, estimator="unbiased")
    settings = (sums.backend, estimator, kernel.settings(), kernel.bandwidth, scale)
    return Distance(value, bound, *settings, m=len(x), n=len(y))


@dataclass(frozen=True)
class Options:
    """Options of ``tmmd``, ``i_tmmd``, ``ci_tmmd``, ``d_tmmd``; each records those that bear on it.

    Attributes:
        preset: one of ``PRESETS``; default ``"grouped"`` where groups are known (for TMMD also
            where ids are shared), else ``"paper"``.
        estimator, halves, denominator, aggregate: override one entry of the preset.
        sigma: kernel bandwidth; several are averaged; ``"median"``: the median distance of the
            reference; ``"multi"``: five bandwidths around it (:mod:`palpate.metrics.kernels`).
        kernel: instead of the Gaussian of ``sigma``, e.g. :class:`palpate.metrics.Polynomial`.
        scale: factor on the result.
        normalize: rows that are not of unit length: ``"check"`` rejects them, True divides by the
            norm, False takes them as they are.
        backend: ``"auto"``, ``"blocked"`` or ``"moments"`` (:mod:`palpate.metrics.kernels`).
        permutations: relabelings of the permutation test of TMMD; 0 for none.
        seed: of random halves.
        subject: what is scored.
        split: digest of the split, kept with the score.
    """

    preset: str
    estimator: Estimator
    halves: Halves
    denominator: Denominator
    aggregate: Aggregate
    sigma: Sigma = 10.0
    kernel: Kernel | None = None
    scale: float = 1000.0
    normalize: Normalize = "check"
    backend: Backend = "auto"
    permutations: int = 999
    seed: int = 0
    subject: str = "generated"
    split: str | None = None


PRESETS: dict[str, Options] = {
    plan.preset: plan
    for plan in (
        Options("paper", "unbiased", "random", "sum", "mean_of_ratios"),
        Options("paper-tables", "biased", "ordered", "mean_off_diagonal", "mean_of_ratios"),
        Options("cmmd", "biased", "random", "sum", "mean_of_ratios"),
        Options("grouped", "grouped", "group", "sum", "ratio_of_means"),
    )
}


def plan_for(options: Mapping[str, Any], *, grouped: bool) -> Options:
    """The options completed; ``grouped``: whether groups are known.

    Raises:
        PalpateError: on an unknown word, a parameter out of range, or options that need groups
            where none are known.
    """
    preset = options.get("preset") or ("grouped" if grouped else "paper")
    require_choice("preset", preset, tuple(PRESETS))
    names = [f.name for f in fields(Options)]
    unknown = sorted(set(options) - set(names))
    must = f"must not be given: options are {', '.join(names)}"
    require(not unknown, "".join(unknown[:1]), must, ", ".join(unknown), fix="Check the spelling")
    plan = replace(PRESETS[preset], **{**options, "preset": preset})
    for name, choices in CHOICES.items():
        require_choice(name, getattr(plan, name), choices)
    checked_scale(plan.scale)
    checked_whole(0, permutations=plan.permutations, seed=plan.seed)
    checked_kernel(plan.kernel)
    for name, value in (("estimator", "grouped"), ("halves", "group")):
        must = f"must know the group of every sample for {name}={value!r}"
        fits = grouped or getattr(plan, name) != value
        check(fits, "groups", must, "none", "Pass groups, or another preset", preset="paper")
    return plan


#: A set with fewer samples is not halved: two for each half.
LEAST = 4
#: More samples than this are left out in so many random blocks; in fewer where there are so many
#: that only moments are quick, whose size grows with the number of units.
BLOCKS, MANY, BLOCKS_OF_MANY = 1000, 100_000, 50


def half_of(ids: Sequence[str], within: Index, plan: Options) -> Index:
    """0 or 1 for each sample: halves of each value of ``within``, equal in size to one sample.

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


def design_of(t: Totals, plan: Options) -> Array:
    """(2, K) how E turns into dist^2 between halves of K sets, by the sizes of the groups alone.

    ``dist^2 = first * E + second * (mean diagonal k - b)``: first ``sum s_g(s_g-1) / (m(m-1))``, or
    with m^2 below for the biased form; second 0, or n / m^2 for the biased form.
    """
    t = whole_sets(t)
    inner, m, biased = np.diagonal(t.pairs) - t.n, t.n / 2, plan.estimator == "biased"
    with np.errstate(divide="ignore", invalid="ignore"):
        of_excess = inner / (m**2 if biased else m * (m - 1))
        return np.stack([of_excess, t.n / m**2 if biased else np.zeros(len(t.n))])


def self_distances(t: Totals, plan: Options, design: Array | None = None) -> tuple[Array, Array]:
    """dist^2 between the halves of each of K sets (Eq. 3, Eq. 5), and E.

    Args:
        t: 2K segments; 2c and 2c + 1 are the halves of set c (for ``group`` halves 2c + 1 is
            empty).
        plan: halves, estimator, scale. ``"grouped"`` acts as ``"unbiased"`` here: halves of whole
            groups share no group already, and without same-group pairs inside the halves the
            expectation would be 0 again.
        design: of the sizes to take instead of those of ``t``. dist^2 falls as the number of
            groups grows, so values without each group in turn must be those of the full design:
            else a jackknife takes the smaller number for noise (its intervals then covered 100 %
            with three videos a class). Ignored where it is of another number of sets.

    Returns:
        (K,) dist^2 and (K,) E, NaN where undefined: a set of one group, no group with two samples,
        or fewer than 4 samples.
    """
    joined = whole_sets(t)
    within, between, same = _even_means(joined.even or joined)
    excess, spread = within - between, same - between  # E = w - b
    pairs = np.diagonal(joined.pairs)  # whole numbers, unlike sums of weights
    bad = ~np.isfinite(excess) | (joined.n < LEAST) | (pairs == joined.n) | (pairs == joined.n**2)
    excess, spread = (np.where(bad, np.nan, plan.scale * a) for a in (excess, spread))
    if plan.halves == "group":
        if design is None or design.shape[1] != len(joined.n):
            design = design_of(t, plan)
        return design[0] * excess + design[1] * spread, excess
    return _between_halves(mmd_matrix(t, _estimator(plan), plan.scale)), excess


def _even_means(t: Totals) -> tuple[Array, Array, Array]:
    """(K,) means of k over pairs i != j inside groups, between groups, and of k(x, x)."""
    total, inside, pairs = (np.diagonal(a) for a in (t.sums, t.same, t.pairs))
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (total - inside) / (t.n**2 - pairs)
        return inside / (pairs - t.squares), between, t.diagonal / t.n


def _estimator(plan: Options) -> str:
    return "biased" if plan.estimator == "biased" else "unbiased"


def _between_halves(matrix: Array) -> Array:
    first = np.arange(0, len(matrix), 2)
    return matrix[first, first + 1]


def whole_sets(t: Totals) -> Totals:
    """The halves of each set joined: 2K segments -> K."""
    sets = len(t.n) // 2
    return t.merge(np.repeat(np.arange(sets), 2), sets)


def halves_of(n: Array) -> Array:
    """(K, 2) sizes of the halves of (K,) samples: as equal as they can be."""
    return np.stack([np.ceil(n / 2), np.floor(n / 2)], axis=1)


def dispersion_of(t: Totals, plan: Options) -> Array:
    """(K,) average of the biased dist^2 over random halves of each of K segments.

    ``(1/m + 1/m') * scale * (mean diagonal k - mean off-diagonal k)``.
    """
    spread = t.diagonal / t.n - mean_of_pairs(np.diagonal(t.sums), t.n * (t.n - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return (1 / halves_of(t.n)).sum(axis=1) * plan.scale * spread


def random_halves_sd(spread: Array, n: Array, estimator: str, scale: float) -> Array:
    """Standard deviation (K,) of dist^2 between two random halves of each of K sets.

    Let s = +-1 mark the halves, m = n/2 samples each (of odd n nearly), and Kc be the doubly
    centered kernel matrix. ``W = sum_{i != j} Kc_ij s_i s_j`` times c, up to a constant, is

    biased: ``c = 4 / n^2``, unbiased: ``c = 1/(2m(m-1)) + 1/(2m^2)``.

    Its variance follows from the mean products of two and four signs over all halvings, p2 = -1 /
    (n-1) and p4 = 3 / ((n-1)(n-3)). The mean is 0 for unbiased (for any data), and
    :func:`dispersion_of` for biased.

    Args:
        spread: (K, 3): S, sum over i != j of Kc_ij^2; T and Q, sums of Kc_ii and of their squares.
        n: (K,) samples.
        estimator: ``"biased"``, or any other for unbiased.
        scale: factor on the result.
    """
    (off, trace, squares), m = spread.T, n / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        p2, p4 = -1 / (n - 1), 3 / ((n - 1) * (n - 3))
        four = trace**2 - 2 * off - 4 * (squares - off)
        variance = 2 * off + 4 * p2 * (squares - off) + p4 * four - (p2 * trace) ** 2
        c = 1 / m**2 if estimator == "biased" else (1 / (m * (m - 1)) + 1 / m**2) / 2
        return np.where(n < 4, np.nan, scale * c * np.sqrt(np.maximum(variance, 0)))
