"""One table of kernel sums for one generated set and its reference, and what is estimated from it.

The pass over the pairs is made once (:func:`build_table`); a metric merges segments and computes
its statistic on the totals, and the jackknife computes the same statistic on the totals without
each unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from palpate.core import FeatureSet
from palpate.core.features import is_missing
from palpate.metrics.halves import half_of, halves_bound, sample_units, self_distances, without_set
from palpate.metrics.inputs import (
    Array,
    Index,
    checked_features,
    checked_names,
    checked_pair,
    copies_across,
)
from palpate.metrics.intervals import Interval, jackknife_errors, t_interval
from palpate.metrics.kernels import Kernel, gaussian
from palpate.metrics.mmd import largest_bound, unit_index
from palpate.metrics.pairs import kernel_sums
from palpate.metrics.presets import Plan
from palpate.metrics.sums import PairSums, Totals


@dataclass(frozen=True)
class Table:
    """Kernel sums of one generated set (and its reference): all that the four metrics need.

    Attributes:
        sums: segment ``4 c + 2 (half of the class) + (half of the set)`` for class number c; the
            last segment is the reference.
        classes: label of each class number; ``""`` holds samples without a label.
        unit: what the jackknife leaves out: ``"group"``, ``"sample"`` or ``"random-block"``.
        names: the name of each unit number.
        kernel: what was summed.
        spread: (1 + C, 3) centered squares (:mod:`palpate.metrics.pairs`) of the generated set and
            of each class.
        copies: generated rows that are bit for bit rows of the reference.
    """

    sums: PairSums
    classes: Sequence[str]
    unit: str
    names: Sequence[str]
    kernel: Kernel
    spread: Array
    copies: int | None = 0

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
        classes = len(self.classes)
        return self.sums.merge(np.append(np.repeat(np.arange(classes), 4), -1), classes)


def build_table(
    generated: FeatureSet,
    reference: FeatureSet | None,
    plan: Plan,
    *,
    grouped: bool,
    median_of: FeatureSet | None = None,
    further: Callable[[Table, Plan], float] | None = None,
) -> Table:
    """Check the sets and pass once over all their pairs.

    Args:
        generated: the set that is halved and divided into classes.
        reference: real samples, or None where no metric needs them.
        plan: halves, seed, bandwidth, back end, normalization.
        grouped: whether the groups of the sets are the jackknife's units; else samples are.
        median_of: the set whose median distance ``sigma="median"`` takes; else the reference, or
            the generated set without one.
        further: the bound of a statistic without scale, which moments must keep within the
            tolerance as well: D-TMMD is a ratio.

    Raises:
        PalpateError: on features or groups that are rejected.
    """
    name = "generated" if plan.subject == "generated" else f"The features of {plan.subject!r}"
    if reference is None:
        sets = [generated]
        parts = [checked_features(name, generated.features, normalize=plan.normalize)]
    else:
        sets, features = [generated, reference], (generated.features, reference.features)
        names = (name, "reference")
        parts = [*checked_pair(*features, normalize=plan.normalize, least=1, names=names)]
    if grouped:
        groups = [checked_names("groups", s.groups, len(s.ids)) or [] for s in sets]
        units, unit = unit_index(*groups), "group"
        unit_names = sorted({name for group in groups for name in group})
    else:
        ids = [str(i) for s in sets for i in s.ids]
        units, unit, unit_names = sample_units(ids, plan.seed)
    classes, segment = _segments(generated, plan)
    reference_segment = 4 * len(classes)
    segment = np.append(segment, np.full(len(units) - len(segment), reference_segment))
    kernel = plan.kernel
    if kernel is None and isinstance(plan.sigma, str) and median_of is not None:
        kernel = gaussian(plan.sigma, _rows_of_median(median_of, plan), median_of.groups)
    if kernel is None:
        kernel = gaussian(plan.sigma, parts[-1], sets[-1].groups)

    def bound(sums: PairSums) -> float:
        table = Table(sums, classes, unit, unit_names, kernel, np.zeros((0, 3)))
        ratio = further(table, plan) * plan.scale / 1000 if further else 0.0
        return max(_bound(table, plan), ratio)

    of_class = [np.arange(4 * c, 4 * c + 4) for c in range(len(classes))]
    sweep = kernel_sums(
        parts,
        segment,
        units,
        segments=reference_segment + 1,
        kernel=kernel,
        backend=plan.backend,
        tolerance=plan.tolerance * plan.scale / 1000,
        bound=bound,
        block=plan.block,
        spread=[np.arange(reference_segment), *of_class],
    )
    copies = copies_across(*parts) if reference is not None else 0
    return Table(sweep.sums, classes, unit, unit_names, kernel, sweep.spread, copies)


def _segments(generated: FeatureSet, plan: Plan) -> tuple[list[str], Index]:
    """The classes, and (n,) the segment of each sample."""
    ids = [str(i) for i in generated.ids]
    labels = [""] * len(ids)
    if generated.labels is not None:
        labels = ["" if is_missing(v) else str(v) for v in generated.labels]
    classes = sorted(set(labels))
    label = np.searchsorted(classes, labels) if labels else np.zeros(0, dtype=np.intp)
    whole = np.zeros_like(label)
    return classes, 4 * label + 2 * half_of(ids, label, plan) + half_of(ids, whole, plan)


def _rows_of_median(median_of: FeatureSet, plan: Plan) -> Array:
    name = "The features that the median distance is taken over"
    return checked_features(name, median_of.features, normalize=plan.normalize)


def _bound(table: Table, plan: Plan) -> float:
    """What moments may change in TMMD, I-TMMD or an entry of the matrix D, at most."""
    halves, reference = table.set_halves(), table.sums.segment == table.sums.segments - 1
    bounds = [largest_bound(table.whole_classes(), plan.estimator, plan.scale)]
    if reference.any():
        bounds.append(largest_bound(table.tmmd(), plan.estimator, plan.scale))
    if halves.bound is not None and np.isfinite(self_distances(halves.totals, plan)[0][0]):
        bounds.append(float(halves_bound(halves.bound.totals, plan)[0]))
    return max(b if np.isfinite(b) else np.inf for b in bounds)


@dataclass(frozen=True)
class Estimate:
    """A statistic with its jackknife.

    Attributes:
        values: (K,).
        errors: (K,) standard errors.
        df: their degrees of freedom.
        method: in words.
        replicates: (G, K) values without each unit.
        units: (G,) units.
        without_class: (C, 4) the first four values without each class; empty with fewer than three.
        of_classes: whether the errors are those over classes.
    """

    values: Array
    errors: Array
    df: int
    method: str
    replicates: Array = field(repr=False)
    units: Index = field(repr=False)
    without_class: Array = field(default_factory=lambda: np.zeros((0, 4)), repr=False)
    of_classes: bool = False

    def interval(self, k: int, level: float) -> Interval | None:
        """Interval of value k, or None where it has none."""
        value, error = float(self.values[k]), float(self.errors[k])
        if not (np.isfinite(value) and np.isfinite(error) and error > 0):
            return None  # no variation between units is no evidence of certainty
        return t_interval(value, error, self.df, level)


def estimate(sums: PairSums, statistic: Callable[[Totals], Array], unit: str) -> Estimate:
    """The statistic on all samples, with its leave-one-unit-out jackknife."""
    replicates = np.array([statistic(t) for t in sums.leave_one_out()], dtype=np.float64)
    df = len(sums.units) - 1
    tail = "" if unit == "group" else ", samples taken as independent"
    method = f"leave-one-{unit}-out jackknife, t, {df} df{tail}"
    errors = jackknife_errors(replicates)
    return Estimate(statistic(sums.totals), errors, df, method, replicates, sums.units)


def class_estimate(sums: PairSums, statistic: Callable[[Totals], Array], unit: str) -> Estimate:
    """As :func:`estimate`, for 2C segments; over classes where one cannot spare a unit (two
    groups).

    The interval over classes also holds the differences between classes, so it errs on the wide
    side. The first four values of the statistic must be defined for fewer classes; only they get
    errors then.
    """
    over_units, classes = estimate(sums, statistic, unit), sums.segments // 2
    if classes < 3:
        return over_units
    without = np.array([statistic(without_set(sums.totals, c))[:4] for c in range(classes)])
    if np.isfinite(over_units.errors[0]):
        return replace(over_units, without_class=without)
    errors = np.full(len(over_units.values), np.nan)
    errors[: without.shape[1]] = jackknife_errors(without)
    reason = f"(a class has too few {unit}s to leave one out)"
    method = f"leave-one-class-out jackknife, t, {classes - 1} df {reason}"
    return replace(
        over_units,
        errors=errors,
        df=classes - 1,
        method=method,
        without_class=without,
        of_classes=True,
    )
