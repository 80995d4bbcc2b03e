"""One table of kernel sums for one generated set and its reference, and what is estimated from it.

The pass over the pairs is made once (:func:`build_table`); a metric merges segments and computes its statistic on the totals, and
the jackknife computes the same statistic on the totals without each unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from palpate.core import FeatureSet
from palpate.core.features import is_missing
from palpate.metrics.engine import kernel_sums
from palpate.metrics.halves import half_of, halves_bound, sample_units, self_distances, take_sets
from palpate.metrics.inputs import checked_features, checked_names, checked_pair, copies_across
from palpate.metrics.intervals import Interval, jackknife_errors, leave_one_out, t_interval
from palpate.metrics.kernels import Array, Index, Kernel, gaussian
from palpate.metrics.mmd import largest_bound, unit_index
from palpate.metrics.presets import Plan
from palpate.metrics.sums import PairSums, Totals


@dataclass(frozen=True)
class Table:
    """Kernel sums of one generated set (and its reference): all that the four metrics need.

    Attributes:
        sums: segment ``4 c + 2 (half of the class) + (half of the set)`` for class number c; the last segment is the reference.
        classes: label of each class number; ``""`` holds samples without a label.
        unit: what the jackknife leaves out: ``"group"``, ``"sample"`` or ``"random-block"``.
        names: the name of each unit number.
        kernel: what was summed.
        spread: (1 + C, 3) centered squares (:mod:`palpate.metrics.blocked`) of the generated set and of each class.
        copies: generated rows that are bit for bit rows of the reference; None where they were not looked for.
        sizes: (1 + C, 2) sizes of the halves of the set and of each class, where they are not as equal as they can be.
    """

    sums: PairSums
    classes: Sequence[str]
    unit: str
    names: Sequence[str]
    kernel: Kernel
    spread: Array
    copies: int | None = 0
    sizes: Array | None = None

    @property
    def grouped(self) -> bool:
        """Whether units are groups."""
        return self.unit == "group"

    def tmmd(self) -> PairSums:
        """Segments 0: generated, 1: reference."""
        return self.sums.merge(np.repeat([0, 1], [self.sums.segments - 1, 1]), 2)

    def set_halves(self) -> PairSums:
        """Segments 0, 1: the halves of the generated set."""
        return self.sums.merge(np.append(np.arange(self.sums.segments - 1) % 2, -1), 2)

    def class_halves(self, kept: Index) -> PairSums:
        """Segments 2k, 2k + 1: the halves of class number ``kept[k]``."""
        to = np.full(self.sums.segments, -1, dtype=np.intp)
        for k, c in enumerate(kept):
            to[4 * c : 4 * c + 4] = [2 * k, 2 * k, 2 * k + 1, 2 * k + 1]
        return self.sums.merge(to, 2 * len(kept))

    def whole_classes(self) -> PairSums:
        """Segment c: class number c, whole."""
        return self.sums.merge(
            np.append(np.repeat(np.arange(len(self.classes)), 4), -1), len(self.classes)
        )


def build_table(
    generated: FeatureSet,
    reference: FeatureSet | None,
    plan: Plan,
    *,
    grouped: bool,
    median_of: Any = None,
    further: Callable[[Table, Plan], float] | None = None,
) -> Table:
    """Checks the sets and passes once over all their pairs.

    Args:
        generated: the set that is halved and divided into classes.
        reference: real touches, or None where no metric needs them.
        plan: halves, seed, bandwidth, back end, normalization.
        grouped: whether the groups of the sets are the jackknife's units; else samples are.
        further: the bound of a statistic without scale, which moments must keep within the tolerance as well: D-TMMD is a ratio.
        median_of: the set whose median distance ``sigma="median"`` takes; else the reference, or the generated set without one.

    Raises:
        PalpateError: on features or groups that are refused.
    """
    own = (
        "The generated features"
        if plan.subject == "generated"
        else f"The features of {plan.subject!r}"
    )
    copies: int | None = 0
    if reference is None:
        parts = [checked_features(own, generated.features, normalize=plan.normalize)]
        sets = [generated]
    else:
        names = (own, "The reference features")
        parts = list(
            checked_pair(
                generated.features,
                reference.features,
                normalize=plan.normalize,
                least=1,
                names=names,
            )
        )
        sets, copies = [generated, reference], copies_across(*parts)
    if grouped:
        groups = [checked_names("groups", s.groups, len(s.ids)) or [] for s in sets]
        units, unit = np.concatenate(unit_index(*groups)), "group"
        names = sorted({name for column in groups for name in column})
    else:
        units, unit, names = sample_units([str(i) for s in sets for i in s.ids], plan.seed)
    labels = [
        "" if is_missing(v) else str(v)
        for v in (generated.labels if generated.labels is not None else [None] * len(generated.ids))
    ]
    classes = sorted(set(labels))
    number = {name: k for k, name in enumerate(classes)}
    label = np.array([number[v] for v in labels], dtype=np.intp)
    ids = [str(i) for i in generated.ids]
    halves = 4 * label + 2 * half_of(ids, label, plan) + half_of(ids, np.zeros_like(label), plan)
    segment = np.concatenate(
        [halves, np.full(len(units) - len(halves), 4 * len(classes), dtype=np.intp)]
    )
    if plan.kernel is not None:
        kernel = plan.kernel
    elif median_of is None or not isinstance(plan.sigma, str):
        kernel = gaussian(plan.sigma, parts[-1], sets[-1].groups)
    else:
        rows = checked_features(
            "The features that the median distance is taken over",
            median_of.features,
            normalize=plan.normalize,
        )
        kernel = gaussian(plan.sigma, rows, median_of.groups)

    def bound(sums: PairSums) -> float:
        table = Table(sums, classes, unit, names, kernel, np.zeros((0, 3)))
        return max(
            _bound(table, plan),
            further(table, plan) * plan.scale / 1000 if further is not None else 0.0,
        )

    rest = [
        np.arange(4 * len(classes)),
        *(np.arange(4 * c, 4 * c + 4) for c in range(len(classes))),
    ]
    found = kernel_sums(
        parts,
        segment,
        units,
        segments=4 * len(classes) + 1,
        kernel=kernel,
        backend=plan.backend,
        tolerance=plan.tolerance * plan.scale / 1000,
        bound=bound,
        block=plan.block,
        spread=rest,
    )
    return Table(found.sums, classes, unit, names, kernel, found.spread, copies)


def _bound(table: Table, plan: Plan) -> float:
    """What moments may change in TMMD, I-TMMD or an entry of the matrix D, at most; classes too small to be scored are left out."""
    whole = table.set_halves()
    own = whole.bound
    joint = (
        0.0
        if not table.sums.n[table.sums.segment == table.sums.segments - 1].sum()
        else largest_bound(table.tmmd(), plan.estimator, plan.scale)
    )
    known = np.isfinite(self_distances(whole.totals, plan)[0])
    halves = halves_bound(own.totals, plan)[known] if own is not None else np.zeros(1)
    halves = np.where(np.isfinite(halves), halves, np.inf)
    return max(
        joint,
        largest_bound(table.whole_classes(), plan.estimator, plan.scale),
        float(halves.max(initial=0.0)),
    )


@dataclass(frozen=True)
class Estimate:
    """A statistic with its jackknife: values (K,), standard errors (K,), their degrees of freedom, the method in words.

    ``replicates`` (G, K) are the values without each unit, ``units`` (G,) the units. ``without_class`` (C, 4) are the first four without each
    class, empty with fewer than three; the errors are theirs where ``of_classes``.
    """

    values: Array
    errors: Array
    df: int
    method: str
    replicates: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    units: Index = field(default_factory=lambda: np.zeros(0, dtype=np.intp), repr=False)
    without_class: Array = field(default_factory=lambda: np.zeros((0, 4)), repr=False)
    of_classes: bool = False

    def interval(self, k: int, level: float) -> Interval | None:
        """Interval of value k, or None where it has none."""
        if not (np.isfinite(self.values[k]) and np.isfinite(self.errors[k]) and self.errors[k] > 0):
            return None  # no variation between units is no evidence of certainty
        return t_interval(float(self.values[k]), float(self.errors[k]), self.df, level)


def estimate(sums: PairSums, statistic: Callable[[Totals], Array], unit: str) -> Estimate:
    """The statistic on all samples, with its leave-one-unit-out jackknife."""
    replicates = leave_one_out(sums.leave_one_out(), statistic)
    df = sums.units - 1
    tail = "" if unit == "group" else ", samples taken as independent"
    method = f"leave-one-{unit}-out jackknife, t, {df} df{tail}"
    return Estimate(
        statistic(sums.totals),
        jackknife_errors(replicates),
        df,
        method,
        replicates,
        sums.unit_order,
    )


def class_estimate(sums: PairSums, statistic: Callable[[Totals], Array], unit: str) -> Estimate:
    """As :func:`estimate`, for 2C segments; where a class cannot spare a unit (two groups), the jackknife leaves out classes.

    The interval over classes also holds the differences between classes, so it errs on the wide side. The first four values of the
    statistic must be defined for fewer classes; only they get errors then.
    """
    over_units, classes = estimate(sums, statistic, unit), sums.segments // 2
    if classes < 3:
        return over_units
    rest = np.arange(classes)
    found = leave_one_out(
        (take_sets(sums.totals, rest[rest != c]) for c in rest), lambda t: statistic(t)[:4]
    )
    if np.isfinite(over_units.errors[0]):
        return replace(over_units, without_class=found)
    first = jackknife_errors(found)
    errors = np.concatenate([first, np.full(len(over_units.values) - len(first), np.nan)])
    method = f"leave-one-class-out jackknife, t, {classes - 1} df (a class has too few {unit}s to leave one out)"
    return replace(
        over_units,
        errors=errors,
        df=classes - 1,
        method=method,
        without_class=found,
        of_classes=True,
    )
