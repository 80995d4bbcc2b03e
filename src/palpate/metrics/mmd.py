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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, TypedDict, get_args

import numpy as np

from palpate.core import FeatureSet, require, require_choice, seed_for
from palpate.core.features import Array, Index, is_missing
from palpate.metrics.inputs import (
    Columns,
    Normalize,
    PairColumns,
    check,
    checked_features,
    checked_names,
    checked_pair,
    checked_whole,
    copies_across,
    require_one_encoder,
)
from palpate.metrics.intervals import PairSums, Totals, mean_of_pairs
from palpate.metrics.kernels import Backend, Kernel, Sigma, centered_squares, gaussian, kernel_sums

Preset = Literal["grouped", "paper", "paper-tables", "cmmd"]
Estimator = Literal["unbiased", "biased", "grouped"]
Halves = Literal["group", "random", "ordered"]
Denominator = Literal["sum", "mean", "mean_off_diagonal"]
Aggregate = Literal["mean_of_ratios", "ratio_of_means"]
#: Options that are words.
CHOICES = {
    "estimator": Estimator,
    "halves": Halves,
    "denominator": Denominator,
    "aggregate": Aggregate,
    "backend": Backend,
}


def mmd_matrix(t: Totals, estimator: str, scale: float) -> Array:
    """Eq. 2 between every two segments, (..., S, S); NaN where there are no pairs to average.

    The diagonal has no meaning. A constant in k cancels, as XX + YY - 2 XY weighs it 1 + 1 - 2.
    """
    inner, cross = _means(t, estimator)
    return scale * (inner[..., None] + inner[..., None, :] - 2 * cross)  # Eq. 2


def mmd_bound(remainder: Totals, estimator: str, scale: float) -> Array:
    """What :func:`mmd_matrix` may be off by, where sums may be off by ``remainder``."""
    inner, cross = _means(remainder, estimator)
    return scale * (inner[:, None] + inner[None, :] + 2 * cross)


def _means(t: Totals, estimator: str) -> tuple[Array, Array]:
    """Mean kernel inside segments (S,) and between them (S, S), over an estimator's pairs."""
    sums, pairs = t.sums, t.n[..., None] * t.n[..., None, :]
    if estimator == "grouped":
        sums, pairs = t.sums - t.same, pairs - t.pairs
    inner_sums, inner_pairs = (np.diagonal(a, axis1=-2, axis2=-1) for a in (sums, pairs))
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


class Settings(TypedDict, total=False):
    """What a call may set of :class:`Options`."""

    preset: Preset | None
    estimator: Estimator
    halves: Halves
    denominator: Denominator
    aggregate: Aggregate
    sigma: Sigma
    kernel: Kernel | None
    scale: float
    normalize: Normalize
    backend: Backend
    permutations: int
    seed: int
    subject: str
    split: str | None


class SetOptions(Settings, Columns, total=False):
    """Settings, and the columns of one set."""


class PairOptions(Settings, PairColumns, total=False):
    """Settings, and the columns of two sets."""


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
        require_choice(name, getattr(plan, name), get_args(choices))
    scale: Any = plan.scale
    number = isinstance(scale, int | float | np.number) and not isinstance(scale, bool)
    positive = number and bool(0 < scale < np.inf)
    require(positive, "scale", "must be positive", repr(scale), fix="Drop it for the default")
    checked_whole(0, permutations=plan.permutations, seed=plan.seed)
    kernel: Any = plan.kernel
    must, fix = "must be a kernel: Gaussian(), Polynomial()", "Import one from palpate.metrics"
    require(kernel is None or isinstance(kernel, Kernel), "kernel", must, repr(kernel), fix=fix)
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
    return _between_halves(mmd_matrix(t, estimator_of_halves(plan), plan.scale)), excess


def _even_means(t: Totals) -> tuple[Array, Array, Array]:
    """(K,) means of k over pairs i != j inside groups, between groups, and of k(x, x)."""
    total, inside, pairs = (np.diagonal(a) for a in (t.sums, t.same, t.pairs))
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (total - inside) / (t.n**2 - pairs)
        return inside / (pairs - t.squares), between, t.diagonal / t.n


def estimator_of_halves(plan: Options) -> str:
    """``"grouped"`` acts as ``"unbiased"`` between halves, see :func:`self_distances`."""
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


@dataclass(frozen=True)
class Table:
    """Kernel sums of one generated set (and its reference).

    Attributes:
        plan: the options completed.
        generated: the set that is halved and divided into classes.
        reference: real samples, or None where no metric needs them.
        sums: segment ``4 c + 2 (half of the class) + (half of the set)`` for class number c; the
            last segment is the reference.
        classes: label of each class number; ``""`` holds samples without a label.
        unit: what the jackknife leaves out: ``"group"``, ``"sample"`` or ``"random-block"``.
        names: the name of each unit number.
        kernel: what was summed.
        x: (n, d) generated features.
        label: (n,) class number of each.
        copies: generated rows that are bit for bit rows of the reference.
    """

    plan: Options
    generated: FeatureSet
    reference: FeatureSet | None
    sums: PairSums
    classes: Sequence[str]
    unit: str
    names: Sequence[str]
    kernel: Kernel
    x: Any
    label: Index
    copies: int | None

    @property
    def grouped(self) -> bool:
        """Whether units are groups."""
        return self.unit == "group"

    def tmmd(self) -> PairSums:
        """Segments 0: generated, 1: reference."""
        return self.sums.merge(np.repeat([0, 1], [self.sums.segments - 1, 1]), 2)

    def halves(self, kept: Index | None = None) -> PairSums:
        """Segments 2k, 2k + 1: the halves of class number ``kept[k]``, or of the whole set."""
        if kept is None:
            return self.sums.merge(np.append(np.arange(self.sums.segments - 1) % 2, -1), 2, 0)
        to = np.full(self.sums.segments, -1, dtype=np.intp)
        for k, c in enumerate(kept):
            to[4 * c : 4 * c + 4] = [2 * k, 2 * k, 2 * k + 1, 2 * k + 1]
        return self.sums.merge(to, 2 * len(kept), 1)

    def spread(self, kept: Index | None = None) -> Array:
        """(K, 3) centered squares of these classes, or (1, 3) of the whole generated set."""
        every = [np.arange(len(self.label))]
        rows = every if kept is None else [np.flatnonzero(self.label == c) for c in kept]
        return np.array([centered_squares(self.x, at, self.kernel) for at in rows])

    def whole_classes(self) -> PairSums:
        """Segment c: class number c, whole."""
        classes = len(self.classes)
        return self.sums.merge(np.append(np.repeat(np.arange(classes), 4), -1), classes)

    def bound(self) -> float:
        """What moments may change, at scale 1000: TMMD, or a distance between classes; of one set
        alone any distance.
        """
        of_classes = largest_bound(self.whole_classes(), self.plan.estimator, 1000.0)
        tmmd = self.tmmd()
        if self.reference is not None:
            return max(of_classes, largest_bound(tmmd, self.plan.estimator, 1000.0))
        assert tmmd.bound is not None  # moments have one
        return max(of_classes, float(mmd_bound(tmmd.bound.totals, "biased", 1000.0)[0, 0]))


def build_table(
    generated: FeatureSet,
    reference: FeatureSet | None,
    options: Mapping[str, Any],
    median_of: FeatureSet | None = None,
) -> Table:
    """Check the sets and the options, and pass once over all pairs.

    Units are groups where all sets have them, else samples; the preset is ``"grouped"`` also where
    the sets share ids.

    Args:
        generated: the set that is halved and divided into classes.
        reference: real samples, or None where no metric needs them.
        options: those of :class:`palpate.metrics.Options` that are not the preset's.
        median_of: whose median distance ``sigma="median"`` takes; else the last set's.

    Raises:
        PalpateError: on features, groups or options that are rejected.
    """
    sets = [generated] if reference is None else [generated, reference]
    grouped, shared = all(s.groups is not None for s in sets), 0
    if reference is not None:
        require_one_encoder(generated, reference, "Generated and reference")
        shared = shared_ids(generated, reference)
    plan = plan_for(options, grouped=grouped or shared > 0)
    name = "generated" if plan.subject == "generated" else f"The features of {plan.subject!r}"
    x, normalize = generated.features, plan.normalize
    if reference is None:
        parts = [checked_features(name, x, normalize=normalize)]
    else:
        parts = checked_pair(x, reference.features, normalize=normalize, least=1, name=name)
    if grouped:
        groups = [checked_names("groups", s.groups, len(s.ids)) or [] for s in sets]
        units, unit = unit_index(*groups), "group"
        unit_names = sorted({name for group in groups for name in group})
    else:
        ids = [str(i) for s in sets for i in s.ids]
        units, unit, unit_names = sample_units(ids, plan.seed)
    classes, label, cell = _segments(generated, plan)
    last = 4 * len(classes)
    segment = np.append(cell, np.full(len(units) - len(cell), last))
    kernel = plan.kernel
    if kernel is None and isinstance(plan.sigma, str) and median_of is not None:
        name = "The features that the median distance is taken over"
        rows = checked_features(name, median_of.features, normalize=plan.normalize)
        kernel = gaussian(plan.sigma, rows, median_of.groups)
    kernel = kernel or gaussian(plan.sigma, parts[-1], sets[-1].groups)
    copies = 0 if reference is None else copies_across(*parts)

    def table_of(sums: PairSums) -> Table:
        sides = (plan, generated, reference)
        return Table(*sides, sums, classes, unit, unit_names, kernel, parts[0], label, copies)

    sums = kernel_sums(
        parts,
        np.stack([segment, units]),
        last + 1,
        kernel,
        lambda sums: table_of(sums).bound(),
        backend=plan.backend,
        weights=_even_weights(units, segment, len(label)) if grouped else (),
    )
    return table_of(sums)


def shared_ids(generated: FeatureSet, reference: FeatureSet) -> int:
    """How many ids both sets have: a generated and a real image of one scene are dependent."""
    return len({str(i) for i in generated.ids} & {str(i) for i in reference.ids})


def _even_weights(unit: Index, segment: Index, generated: int) -> list[Array]:
    """(N,) weights with which units weigh the same in the generated set, and in each class."""
    weights: list[Array] = []
    for of_class in (np.zeros_like(segment), segment // 4):
        key = np.stack([unit, of_class])[:, :generated]
        _, at, size = np.unique(key, axis=1, return_inverse=True, return_counts=True)
        real = np.zeros(len(unit) - generated)
        weights.append(np.append(1 / size[at.reshape(-1)], real))
    return weights


def _segments(generated: FeatureSet, plan: Options) -> tuple[list[str], Index, Index]:
    """The classes, and (n,) the class number and the segment of each sample."""
    ids = [str(i) for i in generated.ids]
    labels = ["" if is_missing(v) else str(v) for v in generated.labels or [""] * len(ids)]
    classes = sorted(set(labels))
    label = np.searchsorted(classes, labels)
    of_set = half_of(ids, np.zeros_like(label), plan)
    halves = 2 * (half_of(ids, label, plan) if len(classes) > 1 else of_set) + of_set
    return classes, label, 4 * label + halves
