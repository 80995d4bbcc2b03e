"""The four tactile metrics: MMD on features of a tactile encoder (paper, Eq. 2-7).

G: generated features (n rows), R: reference features (m rows), G^c: those of class c. Lower is
better for all four.

* **TMMD** ``= dist^2(G, R)``, Eq. 2.
* **I-TMMD** ``= dist^2(G_1, G_2)`` for two disjoint halves of G, Eq. 3.
* **CI-TMMD** ``= 1/C sum_c dist^2(G^c_1, G^c_2)``, Eq. 4.
* **D-TMMD** ``= 1/C sum_c D_cc / sum_c' D_cc'`` (Eq. 7) with ``D_cc = dist^2(G^c_1, G^c_2)`` (Eq.
  5), ``D_cc' = dist^2(G^c, G^c')`` (Eq. 6).

One pass over the pairs fills a :class:`Table` of kernel sums; a metric merges its segments and
computes a statistic of the totals, and the jackknife the same statistic without each unit.

Read the last three next to the same metric on real samples (``Score.floor``) and next to TMMD: a
generator that collapses to one image has a perfect I- and CI-TMMD. A score that is not defined has
value None and a note; classes that are excluded are in ``details``.

KID and CMMD are TMMD with other settings, over all pairs instead of random subsets. KID (Binkowski
et al., arXiv 1801.01401): the unbiased MMD^2 with the kernel ``(x.y / d + 1)^3`` on features of
Inception. CMMD (Jayasumana et al., arXiv 2401.09603): the biased one with a Gaussian of bandwidth
10 on embeddings of CLIP.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from palpate._version import __version__
from palpate.core import FeatureSet, Note, PalpateError, Score
from palpate.core.digest import plain
from palpate.core.features import is_missing
from palpate.metrics.inputs import (
    Array,
    Index,
    checked_features,
    checked_names,
    checked_pair,
    copies_across,
    feature_set,
    require_one_encoder,
)
from palpate.metrics.intervals import (
    Estimate,
    PairSums,
    Scored,
    Totals,
    class_estimate,
    estimate,
    permutation_test,
)
from palpate.metrics.kernels import (
    TOLERANCE,
    Kernel,
    Polynomial,
    centered_squares,
    gaussian,
    kernel_sums,
)
from palpate.metrics.mmd import (
    AGGREGATES,
    DENOMINATORS,
    LEAST,
    Options,
    design_of,
    dispersion_of,
    half_of,
    halves_of,
    largest_bound,
    mmd_bound,
    mmd_matrix,
    plan_for,
    random_halves_sd,
    sample_units,
    self_distances,
    unit_index,
    whole_sets,
)


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
        x: (n, d) generated features.
        label: (n,) class number of each.
        copies: generated rows that are bit for bit rows of the reference.
    """

    sums: PairSums
    classes: Sequence[str]
    unit: str
    names: Sequence[str]
    kernel: Kernel
    x: Any
    label: Index
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
        return self.sums.merge(np.append(np.arange(self.sums.segments - 1) % 2, -1), 2, 0)

    def class_halves(self, kept: Index) -> PairSums:
        """Segments 2k, 2k + 1: the halves of class number ``kept[k]``."""
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


def build_table(
    generated: FeatureSet,
    reference: FeatureSet | None,
    plan: Options,
    *,
    grouped: bool,
    median_of: FeatureSet | None = None,
) -> Table:
    """Check the sets and pass once over all their pairs.

    Args:
        generated: the set that is halved and divided into classes.
        reference: real samples, or None where no metric needs them.
        plan: options.
        grouped: whether the groups of the sets are the jackknife's units; else samples are.
        median_of: whose median distance ``sigma="median"`` takes; else the last set's.

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
    label, reference_segment = segment // 4, 4 * len(classes)
    segment = np.append(segment, np.full(len(units) - len(segment), reference_segment))
    kernel = plan.kernel
    if kernel is None and isinstance(plan.sigma, str) and median_of is not None:
        name = "The features that the median distance is taken over"
        rows = checked_features(name, median_of.features, normalize=plan.normalize)
        kernel = gaussian(plan.sigma, rows, median_of.groups)
    kernel = kernel or gaussian(plan.sigma, parts[-1], sets[-1].groups)

    def table_of(sums: PairSums) -> Table:
        return Table(sums, classes, unit, unit_names, kernel, parts[0], label)

    sums = kernel_sums(
        parts,
        np.stack([segment, units]),
        reference_segment + 1,
        kernel,
        lambda sums: _bound(table_of(sums), plan),
        backend=plan.backend,
        weights=_even_weights(units, segment, len(generated.ids)) if grouped else (),
    )
    copies = copies_across(*parts) if reference is not None else 0
    return replace(table_of(sums), copies=copies)


def _even_weights(unit: Index, segment: Index, generated: int) -> list[Array]:
    """(N,) weights with which units weigh the same in the generated set, and in each class."""
    weights: list[Array] = []
    for of_class in (np.zeros_like(segment), segment // 4):
        key = np.stack([unit, of_class])[:, :generated]
        _, at, size = np.unique(key, axis=1, return_inverse=True, return_counts=True)
        real = np.zeros(len(unit) - generated)
        weights.append(np.append(1 / size[at.reshape(-1)], real))
    return weights


def _segments(generated: FeatureSet, plan: Options) -> tuple[list[str], Index]:
    """The classes, and (n,) the segment of each sample."""
    ids = [str(i) for i in generated.ids]
    labels = [""] * len(ids)
    if generated.labels is not None:
        labels = ["" if is_missing(v) else str(v) for v in generated.labels]
    classes = sorted(set(labels))
    label = np.searchsorted(classes, labels)
    whole = np.zeros_like(label)
    return classes, 4 * label + 2 * half_of(ids, label, plan) + half_of(ids, whole, plan)


def _bound(table: Table, plan: Options) -> float:
    """What moments may change, at scale 1000, in TMMD, or between classes; of one set alone in any
    distance.
    """
    of_classes = largest_bound(table.whole_classes(), plan.estimator, 1000.0)
    tmmd = table.tmmd()
    if tmmd.segment.any():
        return max(of_classes, largest_bound(tmmd, plan.estimator, 1000.0))
    assert tmmd.bound is not None  # moments have one
    return max(of_classes, float(mmd_bound(tmmd.bound.totals, "biased", 1000.0)[0, 0]))


#: Designs that differ by less have one floor: the change is far below the noise of any floor.
SAME_DESIGN = 0.01


def scored(
    metric: str,
    table: Table,
    generated: FeatureSet,
    plan: Options,
    settings: Sequence[str],
    *,
    estimate: Estimate | None = None,
    design: Array | None = None,
    details: dict[str, Any],
    notes: Sequence[Note] = (),
    **fields: Any,
) -> Scored:
    """A score with everything that the plan and the set fix; ``fields`` are further ones.

    NaN becomes None, and an undefined value loses its interval and has a note ``undefined``.
    ``settings`` names the options that bear on the metric, and are recorded.
    """
    value = plain(estimate.values[0]) if estimate else None
    notes = list(notes)
    interval = estimate.interval(0) if estimate and value is not None else None
    if value is None:
        fields["null"] = None
        notes = notes or [Note("undefined", {"reason": "no-pairs"})]
    elif interval is None:
        notes.append(Note("no-interval", {"reason": "too-few"}))
    common = {"unit": table.unit, "backend": table.sums.backend, "version": __version__}
    recorded = ("preset", "normalize", *settings)
    score = Score(
        metric,
        plan.subject,
        value,
        interval,
        interval_method=estimate.method if estimate and interval else "",
        bandwidth=table.kernel.bandwidth,
        scale=plan.scale,
        n=len(generated.ids),
        encoder=generated.encoder,
        split=plan.split,
        details=plain(details) | common,
        notes=tuple(notes),
        settings=table.kernel.settings() | {name: getattr(plan, name) for name in recorded},
        **fields,
    )
    design = np.zeros(0) if design is None else design
    if estimate is None or not len(estimate.units):
        return Scored(score, design=design)
    names = units = [table.names[int(u)] for u in estimate.units]
    if estimate.of_classes:
        units = score.details["classes"]
        score = replace(score, details={**score.details, "left_out": "class"})
    excess = estimate.replicates[:, 1] if "E" in details else np.zeros(0)
    return Scored(score, estimate.replicates[:, 0], units, excess, design, names)


def not_comparable(result: Scored, floor: Scored) -> str:
    """Why real samples like these give another value of this metric; '' if they do not.

    Values of halves of whole groups depend on the sizes of the groups, biased values on n, a mean
    over classes on the classes.

    Returns:
        ``"classes"``, ``"groups"``, ``"group-sizes"``, ``"sizes"`` or ``""``.
    """
    if result.score.details.get("classes") != floor.score.details.get("classes"):
        return "classes"
    by_group = result.score.settings.get("halves") == "group"
    if by_group and list(result.groups) != list(floor.groups):
        return "groups"
    same = result.design.shape == floor.design.shape
    if not same or not np.allclose(result.design, floor.design, rtol=SAME_DESIGN, atol=0):
        return "group-sizes" if by_group else "sizes"
    return ""


def with_floor(result: Scored, floor: Scored) -> Scored:
    """The score with that of real samples as its floor, where the two are comparable.

    E of CI-TMMD has as its floor that of the real samples of the generator's classes, E_ratio of
    D-TMMD none where the classes differ.
    """
    details, real = result.score.details, floor.score.details
    reason = not_comparable(result, floor)
    classes = details.get("classes")
    more: dict[str, Any] = {}
    if "E" in details:
        same = classes == real.get("classes")
        more["E_floor"] = real.get("E") if same else _mean_excess(floor.score, classes or [])
    if "E_ratio" in details:
        more["E_ratio_floor"] = real.get("E_ratio") if classes == real.get("classes") else None
    notes = list(result.score.notes)
    if reason and result.score.value is not None:
        notes.append(Note("no-floor", {"reason": reason}))
    value = None if reason else floor.score.value
    score = replace(result.score, floor=value, details={**details, **more}, notes=tuple(notes))
    return replace(result, score=score)


def _mean_excess(score: Score, classes: Sequence[str]) -> float | None:
    """The mean E of some classes, None unless all are known."""
    per_class = score.details.get("per_class", {})
    each = [per_class.get(name, {}).get("E") for name in classes]
    return sum(each) / len(each) if each and None not in each else None


INDEPENDENT = Note("independent-samples")


def tmmd(
    generated: Any,
    reference: Any,
    *,
    ids: Any = None,
    labels: Any = None,
    groups: Any = None,
    reference_ids: Any = None,
    reference_groups: Any = None,
    encoder: str | None = None,
    **options: Any,
) -> Score:
    """TMMD: dist^2 between generated and real samples (paper, Eq. 2).

    Args:
        generated: (n, d) features of generated tactile images: an array, a tensor, a list of rows,
            or a FeatureSet.
        reference: (m, d) features of real tactile images; n and m may differ.
        ids: n ids of ``generated``; without, all rows are different samples.
        labels: n classes, for CI- and D-TMMD.
        groups: n groups (videos), which are left out as a whole.
        reference_ids: m ids; an id in both sets is the same scene. Without groups of both sets,
            shared ids act as groups: the default preset excludes the pairs of one scene.
        reference_groups: m groups; groups count only if both sets have them, and a group in both
            sets is the same group.
        encoder: digest of the encoder of both.
        **options: see :class:`palpate.metrics.Options`.

    Returns:
        Value with a leave-one-group-out interval; ``details``: the p-value of a permutation of
        whole groups (:mod:`palpate.metrics.intervals`), rows that are copies of reference rows.

    Raises:
        PalpateError: on features that are rejected, unequal widths, or encoders of different
            digests.

    Example:
        >>> import numpy as np
        >>> x, y = np.random.default_rng(0).normal(size=(2, 50, 8))
        >>> tmmd(x, y, normalize=True).n
        50
    """
    x = feature_set(generated, ids=ids, labels=labels, groups=groups, encoder=encoder)
    y = feature_set(
        reference, argument="reference", ids=reference_ids, groups=reference_groups, encoder=encoder
    )
    return tmmd_scored(x, y, options).score


def tmmd_scored(generated: FeatureSet, reference: FeatureSet, options: Mapping[str, Any]) -> Scored:
    """TMMD with its leave-one-unit-out values."""
    require_one_encoder(generated, reference, "Generated and reference")
    grouped = generated.groups is not None and reference.groups is not None
    plan = plan_for(options, grouped=grouped or bool(shared_ids(generated, reference)))
    table = build_table(generated, reference, plan, grouped=grouped)
    return tmmd_of(table, generated, reference, plan)


def shared_ids(generated: FeatureSet, reference: FeatureSet) -> int:
    """How many ids both sets have: a generated and a real image of one scene are dependent."""
    return len({str(i) for i in generated.ids} & {str(i) for i in reference.ids})


def tmmd_of(table: Table, generated: FeatureSet, reference: FeatureSet, plan: Options) -> Scored:
    """TMMD from a table."""
    sums, notes = table.tmmd(), list[Note]()
    est = estimate(sums, lambda t: mmd_matrix(t, plan.estimator, plan.scale)[:1, 1], table.unit)
    if not np.isfinite(est.values[0]):
        reason = "few-groups" if plan.estimator == "grouped" else "one-sample"
        notes.append(Note("undefined", {"reason": reason}))
    if table.copies:
        notes.append(Note("copied-rows", {"count": table.copies, "n": len(generated.ids)}))
    if not table.grouped:
        notes.append(INDEPENDENT)
        if plan.estimator != "grouped" and (count := shared_ids(generated, reference)):
            notes.append(Note("dependent-pairs", {"count": count}))
    bound = largest_bound(sums, plan.estimator, plan.scale)
    if bound > TOLERANCE * plan.scale / 1000:
        notes.append(Note("within-bound", {"bound": bound}))
    details: dict[str, Any] = {"units": len(sums.units), "copies": table.copies, "bound": bound}
    details |= {"p_value": None, "permutations": None}
    test = permutation_test(
        sums, plan.estimator, plan.scale, count=plan.permutations, seed=plan.seed
    )
    null = None
    if test:
        details["p_value"], values, details["permutations"] = test
        null = (float(np.quantile(values, 0.025)), float(np.quantile(values, 0.975)))
    return scored(
        "TMMD",
        table,
        generated,
        plan,
        (),
        estimate=est,
        estimator=plan.estimator,
        m=len(reference.ids),
        reference=reference.digest if reference.features.shape[1] else None,
        details=details,
        notes=notes,
        null=null,
    )


def i_tmmd(
    generated: Any,
    *,
    ids: Any = None,
    labels: Any = None,
    groups: Any = None,
    encoder: str | None = None,
    **options: Any,
) -> Score:
    """I-TMMD: dist^2 between two halves of the generated samples (paper, Eq. 3).

    With ``halves="group"`` the value is the average over halvings by whole groups, in closed form
    (:mod:`palpate.metrics.mmd`).

    Args:
        generated: (n, d) features: an array, a tensor, a list of rows, or a FeatureSet.
        ids: n ids, on which random and ordered halves depend; without, the row numbers.
        labels: n classes, for CI- and D-TMMD.
        groups: n groups (videos).
        encoder: digest of the encoder.
        **options: see :class:`palpate.metrics.Options`.

    Returns:
        Value, interval, ``null`` (95 % of random halves by a normal approximation with the exact
        variance); ``details``: ``E`` (between-group excess, independent of the number of groups)
        and its interval, ``z`` (distance from the null in standard deviations), ``dispersion``.

    Raises:
        PalpateError: on features that are rejected, or ``halves="group"`` without groups.
    """
    x = feature_set(generated, ids=ids, labels=labels, groups=groups, encoder=encoder)
    return reference_free(i_tmmd_of, x, None, options).score


def ci_tmmd(
    generated: Any,
    *,
    ids: Any = None,
    labels: Any = None,
    groups: Any = None,
    encoder: str | None = None,
    **options: Any,
) -> Score:
    """CI-TMMD: the mean over classes of dist^2 between two halves of a class (paper, Eq. 4).

    A class counts with at least four samples and, for halves by group, two groups of
    which one has two samples. Arguments and errors as :func:`i_tmmd`.

    Returns:
        Value, interval (over groups; over classes where a class has only two groups), ``null``;
        ``details``: ``E``, ``per_class``, ``excluded``.
    """
    x = feature_set(generated, ids=ids, labels=labels, groups=groups, encoder=encoder)
    return reference_free(ci_tmmd_of, x, None, options).score


def d_tmmd(
    generated: Any,
    *,
    ids: Any = None,
    labels: Any = None,
    groups: Any = None,
    encoder: str | None = None,
    **options: Any,
) -> Score:
    """D-TMMD: how much a class differs from itself, against how much from the others (Eq. 5-7).

    ``denominator``: ``"sum"`` over c' including c (Eq. 7), ``"mean"`` of the same, or
    ``"mean_off_diagonal"``. ``aggregate``: the mean over classes of the ratios (Eq. 7), or the
    ratio of the means, which stays finite where one class has a small denominator. Arguments and
    errors as :func:`i_tmmd`.

    Returns:
        Value and interval; ``details``: ``matrix`` (D, in the order of ``classes``), ``variants``
        (all denominators and aggregates), ``ratio_of_means`` with its interval, ``inter`` (the mean
        divergence between classes) with its interval, ``E_ratio`` (mean E over ``inter``; None
        where ``inter`` is not two standard errors above 0), ``unstable`` (classes whose denominator
        is not two standard errors above 0), ``excluded``.
    """
    x = feature_set(generated, ids=ids, labels=labels, groups=groups, encoder=encoder)
    return reference_free(d_tmmd_of, x, None, options).score


def reference_free(
    metric: Any, generated: FeatureSet, real: FeatureSet | None, options: Mapping[str, Any]
) -> Scored:
    """One of the reference-free metrics, with real samples for its floor."""
    [result] = _from_one_table([metric], generated, options, real)
    if real is None:
        return result
    _require_same_groups(generated, real)
    return with_floor(result, *_from_one_table([metric], real, options, real))


def _from_one_table(
    metrics: Sequence[Any],
    features: FeatureSet,
    options: Mapping[str, Any],
    median_of: FeatureSet | None,
) -> list[Scored]:
    """Reference-free metrics of one set from one pass over its pairs."""
    grouped = features.groups is not None
    plan = plan_for(options, grouped=grouped)
    table = build_table(features, None, plan, grouped=grouped, median_of=median_of)
    return [metric(table, features, plan) for metric in metrics]


def i_tmmd_of(table: Table, generated: FeatureSet, plan: Options) -> Scored:
    """I-TMMD from a table."""
    sums = table.set_halves()
    reason, details, notes = unfit(sums, [0, 1], plan), dict[str, Any](), list[Note]()
    if reason:
        params = {"reason": reason, "least": LEAST, "n": len(generated.ids)}
        notes = [Note("undefined", params)]
    given: dict[str, Any] = {"spread": table.spread(), "details": details, "notes": notes}
    return _mean_of_halves("I-TMMD", table, generated, plan, sums=sums, **given)


def ci_tmmd_of(table: Table, generated: FeatureSet, plan: Options) -> Scored:
    """CI-TMMD from a table."""
    kept, details = _usable(table, plan)
    if not len(kept):
        labeled = generated.labels is not None
        notes = [Note("undefined", {"reason": "no-class", "labeled": labeled})]
        common: dict[str, Any] = {"details": details, "notes": notes, **_halves_fields(plan)}
        return scored("CI-TMMD", table, generated, plan, ("halves",), **common)
    sums, spread = table.class_halves(kept), table.spread(kept)
    each, excess = self_distances(sums.totals, plan)
    sizes = whole_sets(sums.totals).n
    details["per_class"] = {}
    for k, name in enumerate(details["classes"]):
        units = len(np.unique(sums.unit[sums.segment // 2 == k]))
        of_class = {"value": each[k], "E": excess[k] if table.grouped else None}
        details["per_class"][name] = of_class | {"n": int(sizes[k]), "units": units}
    given: dict[str, Any] = {"spread": spread, "details": details}
    return _mean_of_halves("CI-TMMD", table, generated, plan, sums=sums, **given)


def _mean_of_halves(
    metric: str,
    table: Table,
    generated: FeatureSet,
    plan: Options,
    *,
    sums: PairSums,
    spread: Array,
    details: dict[str, Any],
    notes: Sequence[Note] = (),
) -> Scored:
    """The mean of dist^2 between the halves of K sets (Eq. 3: K = 1, Eq. 4), given 2K segments."""
    design = design_of(sums.totals, plan)
    est = class_estimate(
        sums, lambda t: np.array([v.mean() for v in self_distances(t, plan, design)]), table.unit
    )
    whole = whole_sets(sums.totals)
    sizes = halves_of(whole.n)
    sds = random_halves_sd(spread, whole.n, plan.estimator, plan.scale)
    sd = float(np.sqrt((sds**2).sum())) / len(sds)
    dispersion = float(dispersion_of(whole, plan).mean())
    center = dispersion if plan.estimator == "biased" else 0.0
    details |= {"z": (est.values[0] - center) / sd if sd > 0 else None, "dispersion": dispersion}
    details |= {"units": len(sums.units), "E": None, "E_interval": None}
    if table.grouped:
        details["E"], details["E_interval"] = est.values[1], est.interval(1)
    # 95 % of random halves; the true distribution leans to the right where few directions dominate.
    null = (center - 1.96 * sd, center + 1.96 * sd) if np.isfinite(sd + center) else None
    return scored(
        metric,
        table,
        generated,
        plan,
        ("halves",),
        estimate=None if notes else est,
        design=_design(design, sizes, plan),
        null=null,
        details=details,
        notes=notes or _halves_notes(plan, sums, grouped=table.grouped),
        **_halves_fields(plan),
    )


def _halves_notes(plan: Options, sums: PairSums, *, grouped: bool) -> list[Note]:
    """Notes of a metric of halves."""
    if not sums.rows.any() and not sums.diagonal.any():
        return [Note("collapse")]
    random = plan.halves == "random" and plan.estimator != "biased"
    return [Note("random-halves")] * random + [INDEPENDENT] * (not grouped)


def _halves_fields(plan: Options) -> dict[str, Any]:
    """Estimator, seed and direction of a metric of halves."""
    return {
        "higher_is_better": None,  # the paper says lower; a collapsed generator is lowest
        "estimator": "biased" if plan.estimator == "biased" else "unbiased",
        "seed": plan.seed if plan.halves == "random" else None,
    }


def _design(design: Array, sizes: Array, plan: Options) -> Array:
    """What the value depends on besides the features, see :class:`Scored`."""
    if plan.halves == "group":
        return design.ravel()
    with np.errstate(divide="ignore"):
        return (1 / sizes).sum(axis=1) if plan.estimator == "biased" else np.zeros(0)


def unfit(sums: PairSums, segments: list[int], plan: Options) -> str:
    """Why these segments cannot be cut into halves together; '' if they can.

    Returns:
        ``"few-samples"``, ``"one-group"``, ``"single-samples"`` or ``""``.
    """
    at = np.isin(sums.segment, segments)
    sizes = np.bincount(np.unique(sums.unit[at], return_inverse=True)[1], weights=sums.n[at])
    if sizes.sum() < LEAST:
        return "few-samples"
    if plan.halves == "group" and len(sizes) < 2:
        return "one-group"
    return "single-samples" if plan.halves == "group" and sizes.max() < 2 else ""


def _usable(table: Table, plan: Options) -> tuple[Index, dict[str, Any]]:
    """Classes that can be cut into halves; ``classes`` and ``excluded`` of details."""
    whole = table.whole_classes()
    names = table.classes
    reasons = [unfit(whole, [c], plan) if name else "no-label" for c, name in enumerate(names)]
    kept = np.array([c for c, reason in enumerate(reasons) if not reason], dtype=np.intp)
    excluded = {
        name or "(no label)": reason for name, reason in zip(names, reasons, strict=True) if reason
    }
    return kept, {"classes": [names[c] for c in kept], "excluded": excluded}


def d_matrix(t: Totals, plan: Options, design: Array | None = None) -> Array:
    """D (C, C) from 2C segments: halves of a class on the diagonal (Eq. 5), Eq. 6 off it."""
    matrix = mmd_matrix(whole_sets(t), plan.estimator, plan.scale)
    np.fill_diagonal(matrix, self_distances(t, plan, design)[0])
    return matrix


def d_ratio(matrix: Array, denominator: str, aggregate: str) -> float:
    """Eq. 7 and its variants; NaN where a denominator is 0 or, for ratio of means, not positive."""
    inner, below = np.diagonal(matrix), denominators(matrix, denominator)
    if aggregate == "ratio_of_means":
        return float(inner.mean() / below.mean()) if below.mean() > 0 else np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        value = float((inner / below).mean())  # Eq. 7
    return value if np.isfinite(value) else np.nan


def denominators(matrix: Array, denominator: str) -> Array:
    """(C,) denominators of Eq. 7: row sums, row means, or row means without the diagonal."""
    if denominator == "mean_off_diagonal":
        others = np.where(np.eye(len(matrix), dtype=bool), 0.0, matrix)
        return others.sum(axis=1) / max(len(matrix) - 1, 1)
    return matrix.sum(axis=1) / (1 if denominator == "sum" else len(matrix))


def d_tmmd_of(table: Table, generated: FeatureSet, plan: Options) -> Scored:
    """D-TMMD from a table."""
    kept, details = _usable(table, plan)
    fields: dict[str, Any] = _halves_fields(plan) | {"estimator": plan.estimator}
    fields |= {"details": details}
    settings = ("halves", "denominator", "aggregate")
    if len(kept) < 2:
        params = {"classes": len(kept), "labeled": generated.labels is not None}
        notes = [Note("undefined", {"reason": "one-class", **params})]
        return scored("D-TMMD", table, generated, plan, settings, notes=notes, **fields)
    sums = table.class_halves(kept)
    design = design_of(sums.totals, plan)

    def statistic(t: Totals) -> Array:
        matrix = d_matrix(t, plan, design)
        below = denominators(matrix, plan.denominator)
        inter = float(denominators(matrix, "mean_off_diagonal").mean())
        ratio = d_ratio(matrix, plan.denominator, plan.aggregate)
        pooled = d_ratio(matrix, plan.denominator, "ratio_of_means")
        excess = float(self_distances(t, plan)[1].mean()) / (inter or np.nan)
        return np.array([ratio, excess, pooled, inter, *below])

    est = class_estimate(sums, statistic, table.unit)
    matrix, below, errors = d_matrix(sums.totals, plan), est.values[4:], est.errors[4:]
    # A ratio over a mean that may well be 0 is noise.
    apart = est.values[3] > (2 * est.errors[3] if np.isfinite(est.errors[3]) else 0.0)
    stable = below > np.where(np.isfinite(errors), 2 * errors, np.inf)
    unstable = [name for name, ok in zip(details["classes"], stable, strict=True) if not ok]
    use_excess = table.grouped and apart
    details |= {
        "matrix": matrix,
        "variants": {f"{d}/{a}": d_ratio(matrix, d, a) for d in DENOMINATORS for a in AGGREGATES},
        "ratio_of_means": {"value": est.values[2], "interval": est.interval(2)},
        "unstable": unstable,
        "inter": {"value": est.values[3], "interval": est.interval(3)},
        "E_ratio": est.values[1] if use_excess else None,
        "E_ratio_interval": est.interval(1) if use_excess else None,
        "units": len(sums.units),
    }
    notes: list[Note] = []
    if not np.isfinite(est.values[0]):
        notes = [Note("undefined", {"reason": "not-separate"})]
    elif unstable:
        known = bool(np.isfinite(errors).all())
        notes = [Note("unstable-denominators", {"classes": unstable, "known_errors": known})]
    return scored(
        "D-TMMD",
        table,
        generated,
        plan,
        settings,
        estimate=est,
        design=_design(design, halves_of(whole_sets(sums.totals).n), plan),
        notes=notes,
        **fields,
    )


def four_scores(
    generated: FeatureSet, reference: FeatureSet, *, floor: FeatureSet | None = None, **options: Any
) -> list[Score]:
    """TMMD, I-TMMD, CI-TMMD and D-TMMD from one sweep over the pairs.

    Args:
        generated: features of generated samples, with labels (for CI and D) and groups.
        reference: features of the real test samples.
        floor: real samples for ``Score.floor`` of the other three; usually ``reference``. Values
            of halves of whole groups depend on the sizes of the groups, biased ones on n:
            ``Score.floor`` is given where these are the same (within 1 %, else a note gives the
            reason), ``details["E_floor"]`` for any groups of the same classes.
        **options: see :class:`palpate.metrics.Options`; the same for all four.

    Raises:
        PalpateError: as the single metrics do.
    """
    generated, reference = feature_set(generated), feature_set(reference, argument="reference")
    first, *others = four_of(generated, reference, options)
    if floor is not None:
        real = floors_of(feature_set(floor, argument="floor"), reference, generated, options)
        others = map(with_floor, others, real)
    return [result.score for result in (first, *others)]


def four_of(
    generated: FeatureSet, reference: FeatureSet, options: Mapping[str, Any]
) -> list[Scored]:
    """The four metrics as :class:`Scored`, in the order of the paper."""
    require_one_encoder(generated, reference, "Generated and reference")
    both = generated.groups is not None and reference.groups is not None
    paired = not both and bool(shared_ids(generated, reference))
    plan, metrics = plan_for(options, grouped=both or paired), (i_tmmd_of, ci_tmmd_of, d_tmmd_of)
    table = build_table(generated, reference, plan, grouped=both)
    first = tmmd_of(table, generated, reference, plan)
    if both or (generated.groups is None and not paired):
        return [first, *(metric(table, generated, plan) for metric in metrics)]
    return [first, *_from_one_table(metrics, generated, options, reference)]


def floors_of(
    floor: FeatureSet, reference: FeatureSet, like: FeatureSet, options: Mapping[str, Any]
) -> list[Scored]:
    """I-, CI- and D-TMMD of real samples, computed as those of ``like``.

    Raises:
        PalpateError: if one of the two has groups and the other none, or encoders differ.
    """
    require_one_encoder(like, floor, "Generated and floor")
    _require_same_groups(like, floor)
    return _from_one_table((i_tmmd_of, ci_tmmd_of, d_tmmd_of), floor, options, reference)


def _require_same_groups(generated: FeatureSet, floor: FeatureSet) -> None:
    if (floor.groups is None) != (generated.groups is None):
        must = "The floor must be scored like the generated samples"
        raise PalpateError(must, "groups in one of the two", "Give groups to both, or to none")


def kid(generated: Any, reference: Any, **options: Any) -> Score:
    """KID between generated and real features, times 1000; lower is better.

    Args:
        generated: (n, d) features; as published, the 2048 pool features of Inception.
        reference: (m, d) features of real images.
        **options: of :func:`palpate.metrics.tmmd`, e.g. ``groups`` and ``reference_groups`` for an
            interval over whole groups, or ``scale=1`` for the plain value.

    Raises:
        PalpateError: as :func:`palpate.metrics.tmmd`.
    """
    settings: dict[str, Any] = {"normalize": False, "permutations": 0} | options
    score = tmmd(generated, reference, kernel=Polynomial(), preset="paper", **settings)
    return _named("KID", score)


def cmmd(generated: Any, reference: Any, **options: Any) -> Score:
    """CMMD between generated and real embeddings, times 1000; lower is better.

    Args:
        generated: (n, d) L2-normalized features; as published, image embeddings of CLIP.
        reference: (m, d) features of real images.
        **options: of :func:`palpate.metrics.tmmd`.

    Raises:
        PalpateError: as :func:`palpate.metrics.tmmd`.
    """
    settings: dict[str, Any] = {"permutations": 0} | options
    return _named("CMMD", tmmd(generated, reference, preset="cmmd", **settings))


def _named(name: str, score: Score) -> Score:
    settings = {k: v for k, v in score.settings.items() if k != "preset"}
    return replace(score, metric=name, settings=settings)
