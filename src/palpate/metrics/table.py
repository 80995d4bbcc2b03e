"""One pass over the pairs of a generated set and its reference: all that the four metrics need.

Sums are kept by *segment*, the cells of (class, half of the class, half of the set), and by *unit*,
what the jackknife leaves out; each metric merges the segments that it does not tell apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.core import FeatureSet
from palpate.core.features import is_missing
from palpate.metrics.inputs import (
    Array,
    Index,
    checked_features,
    checked_names,
    checked_pair,
    copies_across,
    require_one_encoder,
)
from palpate.metrics.intervals import PairSums
from palpate.metrics.kernels import Kernel, centered_squares, gaussian, kernel_sums
from palpate.metrics.mmd import (
    Options,
    half_of,
    largest_bound,
    mmd_bound,
    plan_for,
    sample_units,
    unit_index,
)


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
    if reference is None:
        parts = [checked_features(name, generated.features, normalize=plan.normalize)]
    else:
        both, names = (generated.features, reference.features), (name, "reference")
        parts = [*checked_pair(*both, normalize=plan.normalize, least=1, names=names)]
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
    halves = 2 * half_of(ids, label, plan) + half_of(ids, np.zeros_like(label), plan)
    return classes, label, 4 * label + halves
