"""One table of kernel sums for one generated set and its reference, and what is estimated from it.

The sweep over the pairs is done once (:func:`build_table`); a metric merges segments and computes its statistic on the totals, and
the jackknife computes the same statistic on the totals without each unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from palpate.core import FeatureSet
from palpate.metrics.checks import checked_features, checked_names, checked_pair
from palpate.metrics.halves import half_of, sample_units, take_sets
from palpate.metrics.intervals import Interval, jackknife_errors, leave_one_out, t_interval
from palpate.metrics.kernels import Array, Index, PairSums, Totals, pair_sums
from palpate.metrics.mmd import unit_index
from palpate.metrics.presets import Plan


@dataclass(frozen=True)
class Table:
    """Kernel sums of one generated set (and its reference): all that the four metrics need.

    Attributes:
        sums: segment ``4 c + 2 (half of the class) + (half of the set)`` for class number c; the last segment is the reference.
        classes: label of each class number; ``""`` holds samples without a label.
        unit: what the jackknife leaves out: ``"group"``, ``"sample"`` or ``"random-block"``.
    """

    sums: PairSums
    classes: Sequence[str]
    unit: str

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


def build_table(generated: FeatureSet, reference: FeatureSet | None, plan: Plan, *, grouped: bool) -> Table:
    """Checks the sets and sweeps over all their pairs.

    Args:
        generated: the set that is halved and divided into classes.
        reference: real touches, or None where no metric needs them.
        plan: halves, seed, bandwidth, block size, normalisation.
        grouped: whether the groups of the sets are the jackknife's units; else samples are.

    Raises:
        PalpateError: on features or groups that are refused.
    """
    if reference is None:
        x = checked_features("The generated features", generated.features, normalize=plan.normalize)
        sets = [generated]
    else:
        names = ("The generated features", "The reference features")
        x = np.concatenate(checked_pair(generated.features, reference.features, normalize=plan.normalize, least=1, names=names))
        sets = [generated, reference]
    if grouped:
        groups = [checked_names("groups", s.groups, len(s.ids)) or [] for s in sets]
        units, unit = np.concatenate(unit_index(*groups)), "group"
    else:
        units, unit = sample_units([str(i) for s in sets for i in s.ids], plan.seed)
    labels = ["" if v is None else str(v) for v in (generated.labels if generated.labels is not None else [None] * len(generated.ids))]
    classes = sorted(set(labels))
    number = {name: k for k, name in enumerate(classes)}
    label = np.array([number[v] for v in labels], dtype=np.intp)
    ids = [str(i) for i in generated.ids]
    own = 4 * label + 2 * half_of(ids, label, plan) + half_of(ids, np.zeros_like(label), plan)
    segment = np.concatenate([own, np.full(len(x) - len(own), 4 * len(classes))])
    sums = pair_sums(x, segment, units, segments=4 * len(classes) + 1, sigma=plan.sigma, block=plan.block, squares=True)
    return Table(sums, classes, unit)


@dataclass(frozen=True)
class Estimate:
    """A statistic with its jackknife: values (K,), standard errors (K,), their degrees of freedom, the method in words."""

    values: Array
    errors: Array
    df: int
    method: str

    def interval(self, k: int, level: float) -> Interval | None:
        """Interval of value k, or None where it has none."""
        if not (np.isfinite(self.values[k]) and np.isfinite(self.errors[k])):
            return None
        return t_interval(float(self.values[k]), float(self.errors[k]), self.df, level)


def estimate(sums: PairSums, statistic: Callable[[Totals], Array], unit: str) -> Estimate:
    """The statistic on all samples, with its leave-one-unit-out jackknife."""
    replicates = leave_one_out(sums.leave_one_out(), statistic)
    df = sums.units - 1
    tail = "" if unit == "group" else ", samples taken as independent"
    return Estimate(statistic(sums.totals), jackknife_errors(replicates), df, f"leave-one-{unit}-out jackknife, t, {df} df{tail}")


def class_estimate(sums: PairSums, statistic: Callable[[Totals], Array], unit: str) -> Estimate:
    """As :func:`estimate`, for 2C segments; where a class cannot spare a unit (two groups), the jackknife leaves out classes.

    The interval over classes also holds the differences between classes, so it errs on the wide side. The first two values of the
    statistic must be defined for fewer classes; only they get errors then.
    """
    over_units, classes = estimate(sums, statistic, unit), sums.segments // 2
    if np.isfinite(over_units.errors[0]) or classes < 3:
        return over_units
    rest = np.arange(classes)
    replicates = leave_one_out((take_sets(sums.totals, rest[rest != c]) for c in rest), lambda t: statistic(t)[:2])
    errors = np.concatenate([jackknife_errors(replicates), np.full(len(over_units.values) - 2, np.nan)])
    method = f"leave-one-class-out jackknife, t, {classes - 1} df (a class has too few {unit}s to leave one out)"
    return Estimate(over_units.values, errors, classes - 1, method)
