"""The four tactile metrics: MMD on features of a tactile encoder, one with reference and three without (paper, Eq. 2-7).

G: generated features (n rows), R: reference features (m rows), G^c: those of class c. Lower is better for all four.

* **TMMD** ``= dist^2(G, R)``, Eq. 2.
* **I-TMMD** ``= dist^2(G_1, G_2)`` for two disjoint halves of G, Eq. 3.
* **CI-TMMD** ``= 1/C sum_c dist^2(G^c_1, G^c_2)``, Eq. 4.
* **D-TMMD** ``= 1/C sum_c D_cc / sum_c' D_cc'`` (Eq. 7) with ``D_cc = dist^2(G^c_1, G^c_2)`` (Eq. 5), ``D_cc' = dist^2(G^c, G^c')`` (Eq. 6).

All come from one table of kernel sums (:mod:`palpate.metrics.kernels`). Read the last three beside the same metric on real touches
(``Score.floor``) and beside TMMD: a generator that collapses to one image has a perfect I- and CI-TMMD. A score that is not
defined has value None and a note; samples and classes left out are listed in ``details``.
"""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np

from palpate.core import FeatureSet, PalpateError, Score
from palpate.metrics.halves import Design, design_of, halves_bound, self_distances, whole_sets
from palpate.metrics.inputs import feature_set, require_one_encoder
from palpate.metrics.intervals import halves_of, random_halves_sd
from palpate.metrics.kernels import Array, Index
from palpate.metrics.mmd import largest_bound, mmd_bound, mmd_matrix
from palpate.metrics.permutation import permutation_test
from palpate.metrics.presets import AGGREGATES, DENOMINATORS, Options, Plan, plan_for
from palpate.metrics.scored import (
    UNBOUNDED,
    Scored,
    halves_fields,
    halves_note,
    null_band,
    scored,
    unfit,
    units_of,
    with_floor,
)
from palpate.metrics.sums import PairSums, Totals
from palpate.metrics.tables import Table, build_table, class_estimate, estimate


def tmmd(  # noqa: PLR0913
    generated: Any,
    reference: Any,
    *,
    ids: Any = None,
    labels: Any = None,
    groups: Any = None,
    reference_ids: Any = None,
    reference_groups: Any = None,
    encoder: str | None = None,
    **options: Unpack[Options],
) -> Score:
    """TMMD: dist^2 between generated and real touches (paper, Eq. 2).

    Args:
        generated: (n, d) features of generated tactile images: an array, a tensor, a list of rows, or a FeatureSet.
        reference: (m, d) features of real tactile images; n and m may differ.
        ids, labels, groups: n each, of ``generated``; see :func:`palpate.metrics.inputs.feature_set`.
        reference_ids, reference_groups: m each, of ``reference``. The same id or group in both sets is the same sample or group.
        encoder: digest of the encoder of both.
        **options: see :class:`Options`. Groups count only if both sets have them; the same name is the same group in both.

    Returns:
        Value with a leave-one-group-out interval; ``details``: counts of groups, the p-value of a permutation of whole groups
        (:mod:`palpate.metrics.permutation`), rows that are copies of reference rows.

    Raises:
        PalpateError: on features that are refused, unequal widths, or encoders of different digests.
    """
    generated = feature_set(
        generated, argument="generated", ids=ids, labels=labels, groups=groups, encoder=encoder
    )
    reference = feature_set(
        reference, argument="reference", ids=reference_ids, groups=reference_groups, encoder=encoder
    )
    require_one_encoder(generated, reference, "reference")
    grouped = generated.groups is not None and reference.groups is not None
    plan = plan_for(options, grouped=grouped)
    return tmmd_of(
        build_table(generated, reference, plan, grouped=grouped), generated, reference, plan
    ).score


def tmmd_of(table: Table, generated: FeatureSet, reference: FeatureSet, plan: Plan) -> Scored:
    """TMMD from a table."""
    sums = table.tmmd()
    found = estimate(sums, lambda t: mmd_matrix(t, plan.estimator, plan.scale)[:1, 1], table.unit)
    notes = []
    if not np.isfinite(found.values[0]):
        needs = (
            "two groups, not all shared, for the grouped estimator"
            if plan.estimator == "grouped"
            else "two samples"
        )
        notes.append(f"Undefined: each set needs {needs}")
    if table.copies is None:
        notes.append("Copies of reference rows were not looked for on the device")
    elif table.copies:
        notes.append(
            f"{table.copies} of {len(generated.ids)} generated rows are bit for bit rows of the reference: a copy is not a generator"
        )
    if not table.grouped:
        notes.append(
            "The interval takes samples as independent; frames of one video are not: give groups"
        )
    test = permutation_test(
        sums, plan.estimator, plan.scale, count=plan.permutations, seed=plan.seed
    )
    details = {
        "units": sums.units,
        "copies": table.copies,
        "p_value": test.p if test else None,
        "permutations": None
        if test is None
        else {
            "count": len(test.null),
            "swapped": test.swapped,
            "dealt": test.dealt,
            "seed": plan.seed,
        },
    }
    null = (
        None
        if test is None
        else (float(np.quantile(test.null, 0.025)), float(np.quantile(test.null, 0.975)))
    )
    return scored(
        "TMMD",
        table,
        generated,
        plan,
        (),
        found=found,
        bound=largest_bound(sums, plan.estimator, plan.scale),
        estimator=plan.estimator,
        m=len(reference.ids),
        reference=reference.digest if reference.features.shape[1] else None,
        details=details,
        note=". ".join(notes),
        null=null,
    )


def i_tmmd(
    generated: Any,
    *,
    ids: Any = None,
    labels: Any = None,
    groups: Any = None,
    encoder: str | None = None,
    **options: Unpack[Options],
) -> Score:
    """I-TMMD: dist^2 between two halves of the generated touches (paper, Eq. 3).

    With ``halves="group"`` the value is the average over halvings by whole groups, in closed form (:mod:`palpate.metrics.halves`).

    Returns:
        Value, interval, ``null`` (95 % of random halves by a normal approximation with the exact variance); ``details``: ``E`` (between-group excess, independent of the
        number of groups) and its interval, ``z`` (distance from the null in its standard deviations), ``dispersion``.

    Raises:
        PalpateError: on features that are refused, or ``halves="group"`` without groups.
    """
    generated = feature_set(
        generated, argument="generated", ids=ids, labels=labels, groups=groups, encoder=encoder
    )
    plan = plan_for(options, grouped=generated.groups is not None)
    return i_tmmd_of(
        build_table(generated, None, plan, grouped=generated.groups is not None), generated, plan
    ).score


def i_tmmd_of(table: Table, generated: FeatureSet, plan: Plan) -> Scored:
    """I-TMMD from a table."""
    sums = table.set_halves()
    design = design_of(sums.totals, plan)
    found = estimate(sums, lambda t: np.concatenate(self_distances(t, plan, design)), table.unit)
    whole = sums.merge(np.zeros(2, dtype=np.intp), 1)
    sizes, n = (
        (halves_of(whole.totals.n) if table.sizes is None else table.sizes[:1]),
        len(generated.ids),
    )
    sd = float(random_halves_sd(table.spread[:1], sizes, plan.estimator, plan.scale)[0])
    dispersion = _dispersion(whole.totals, sizes, plan)[0]
    center = dispersion if plan.estimator == "biased" else 0.0
    reason = unfit(whole, 0, plan)
    details = {
        "E": found.values[1] if table.grouped else None,
        "E_interval": found.interval(1, plan.level) if table.grouped else None,
        "E_bound": _excess_bound(sums, design, plan) if table.grouped else None,
        "z": (found.values[0] - center) / sd if sd > 0 else None,
        "dispersion": dispersion,
        "units": sums.units,
    }
    note = (
        f"Undefined: {reason} (n = {n})"
        if reason
        else halves_note(plan, sums, grouped=table.grouped)
    )
    return scored(
        "I-TMMD",
        table,
        generated,
        plan,
        ("halves",),
        found=None if reason else found,
        design=_design(design, sizes, plan),
        bound=_halves_bound(sums, plan)[0],
        null=null_band(center, sd),
        details=details,
        note=note,
        **halves_fields(plan),
    )


def _design(design: Design, sizes: Array, plan: Plan) -> Array:
    """What the value depends on beside the features, see :class:`palpate.metrics.scored.Scored`; ``sizes`` (K, 2) of the halves."""
    if plan.halves == "group":
        return np.concatenate([design.own, design.rest])
    with np.errstate(divide="ignore"):
        return (1 / sizes).sum(axis=1) if plan.estimator == "biased" else np.zeros(0)


def _halves_bound(sums: PairSums, plan: Plan) -> Array:
    """(K,) bounds of the distances between halves; zeros where sums are exact."""
    return (
        np.zeros(sums.segments // 2)
        if sums.bound is None
        else halves_bound(sums.bound.totals, plan)
    )


def _excess_bound(sums: PairSums, design: Design, plan: Plan) -> float | None:
    """What the mean E may be off by: dist^2 of halves of whole groups is E times a number of the design."""
    if sums.bound is None:
        return 0.0
    return (
        float((_halves_bound(sums, plan) / design.own).mean()) if (design.own > 0).all() else None
    )


def _dispersion(t: Totals, sizes: Array, plan: Plan) -> Array:
    """What biased dist^2 averages over random halves: (1/m + 1/m') scale (mean diagonal k - mean off-diagonal k), for each segment."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return (
            (1 / sizes).sum(axis=1)
            * plan.scale
            * (t.own / t.n - np.diagonal(t.sums) / (t.n * (t.n - 1)))
        )


def _usable(table: Table, plan: Plan) -> tuple[Index, dict[str, str]]:
    """Class numbers that can be cut into halves, and why the others cannot."""
    whole = table.whole_classes()
    reasons = {
        name or "(no label)": unfit(whole, c, plan) if name else "no label"
        for c, name in enumerate(table.classes)
    }
    kept = np.array([c for c, reason in enumerate(reasons.values()) if not reason], dtype=np.intp)
    return kept, {name: reason for name, reason in reasons.items() if reason}


def ci_tmmd(
    generated: Any,
    *,
    ids: Any = None,
    labels: Any = None,
    groups: Any = None,
    encoder: str | None = None,
    **options: Unpack[Options],
) -> Score:
    """CI-TMMD: the mean over classes of dist^2 between two halves of a class (paper, Eq. 4).

    A class counts with at least ``min_samples`` samples and, for halves by group, two groups of which one has two samples.

    Returns:
        Value, interval (over groups; over classes where a class has only two groups), ``null``; ``details``: ``E``, ``per_class``, ``excluded``.

    Raises:
        PalpateError: on features that are refused, or ``halves="group"`` without groups.
    """
    generated = feature_set(
        generated, argument="generated", ids=ids, labels=labels, groups=groups, encoder=encoder
    )
    plan = plan_for(options, grouped=generated.groups is not None)
    return ci_tmmd_of(
        build_table(generated, None, plan, grouped=generated.groups is not None), generated, plan
    ).score


def ci_tmmd_of(table: Table, generated: FeatureSet, plan: Plan) -> Scored:
    """CI-TMMD from a table."""
    kept, excluded = _usable(table, plan)
    details: dict[str, Any] = {"classes": [table.classes[c] for c in kept], "excluded": excluded}
    if not len(kept):
        note = "Undefined: no class can be cut into halves" + (
            "" if generated.labels is not None else " (the samples have no labels)"
        )
        return scored(
            "CI-TMMD",
            table,
            generated,
            plan,
            ("halves",),
            details=details,
            note=note,
            **halves_fields(plan),
        )
    sums = table.class_halves(kept)
    design = design_of(sums.totals, plan)
    found = class_estimate(
        sums, lambda t: np.array([v.mean() for v in self_distances(t, plan, design)]), table.unit
    )  # Eq. 4
    each, excess = self_distances(sums.totals, plan)
    whole = sums.merge(np.repeat(np.arange(len(kept)), 2), len(kept))
    sizes = halves_of(whole.totals.n) if table.sizes is None else table.sizes[1 + kept]
    spread = random_halves_sd(table.spread[1 + kept], sizes, plan.estimator, plan.scale)
    sd = float(np.sqrt((spread**2).sum())) / len(kept)
    dispersion = float(_dispersion(whole.totals, sizes, plan).mean())
    center = dispersion if plan.estimator == "biased" else 0.0
    details |= {
        "E": found.values[1] if table.grouped else None,
        "E_interval": found.interval(1, plan.level) if table.grouped else None,
        "E_bound": _excess_bound(sums, design, plan) if table.grouped else None,
        "z": (found.values[0] - center) / sd if sd > 0 else None,
        "dispersion": dispersion,
        "per_class": {
            name: {
                "value": each[k],
                "E": excess[k] if table.grouped else None,
                "n": int(whole.totals.n[k]),
                "units": units_of(whole, k),
            }
            for k, name in enumerate(details["classes"])
        },
        "units": sums.units,
    }
    return scored(
        "CI-TMMD",
        table,
        generated,
        plan,
        ("halves",),
        found=found,
        design=_design(design, sizes, plan),
        bound=float(_halves_bound(sums, plan).mean()),
        null=null_band(center, sd),
        details=details,
        note=halves_note(plan, sums, grouped=table.grouped),
        **halves_fields(plan),
    )


def d_tmmd(
    generated: Any,
    *,
    ids: Any = None,
    labels: Any = None,
    groups: Any = None,
    encoder: str | None = None,
    **options: Unpack[Options],
) -> Score:
    """D-TMMD: how much a class differs from itself, against how much from the others (paper, Eq. 5-7).

    ``denominator``: ``"sum"`` over c' including c (Eq. 7), ``"mean"`` of the same, or ``"mean_off_diagonal"``. ``aggregate``: the mean over
    classes of the ratios (Eq. 7), or the ratio of the means, which stays finite where one class has a small denominator.

    Returns:
        Value and interval; ``details``: ``matrix`` (D, classes in the order of ``classes``), ``variants`` (all denominators and
        aggregates), ``ratio_of_means`` with its interval (the mean of ratios has heavy tails), ``inter`` (the mean divergence between classes) with its
        interval, ``E_ratio`` (mean E over ``inter``; None where ``inter`` is not two standard errors above 0), ``unstable`` (classes whose denominator is not two standard errors above 0), ``excluded``.

    Raises:
        PalpateError: on features that are refused, or ``halves="group"`` without groups.
    """
    generated = feature_set(
        generated, argument="generated", ids=ids, labels=labels, groups=groups, encoder=encoder
    )
    plan = plan_for(options, grouped=generated.groups is not None)
    return d_tmmd_of(
        build_table(
            generated, None, plan, grouped=generated.groups is not None, further=ratio_bound
        ),
        generated,
        plan,
    ).score


def d_matrix(t: Totals, plan: Plan, design: Design | None = None) -> Array:
    """D (C, C) from 2C segments: halves of a class on the diagonal (Eq. 5), whole classes off it (Eq. 6)."""
    matrix = mmd_matrix(whole_sets(t), plan.estimator, plan.scale)
    np.fill_diagonal(matrix, self_distances(t, plan, design)[0])
    return matrix


def d_ratio(matrix: Array, denominator: str, aggregate: str) -> float:
    """Eq. 7 and its variants; NaN where a denominator is 0 or, for the ratio of means, not positive."""
    own, below = np.diagonal(matrix), denominators(matrix, denominator)
    if aggregate == "ratio_of_means":
        return float(own.mean() / below.mean()) if below.mean() > 0 else np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        value = float((own / below).mean())  # Eq. 7
    return value if np.isfinite(value) else np.nan


def denominators(matrix: Array, denominator: str) -> Array:
    """(C,) denominators of Eq. 7: row sums, row means, or row means without the diagonal."""
    if denominator == "mean_off_diagonal":
        others = np.where(np.eye(len(matrix), dtype=bool), 0.0, matrix)
        return others.sum(axis=1) / max(len(matrix) - 1, 1)
    return matrix.sum(axis=1) / (1 if denominator == "sum" else len(matrix))


def d_tmmd_of(table: Table, generated: FeatureSet, plan: Plan) -> Scored:
    """D-TMMD from a table."""
    kept, excluded = _usable(table, plan)
    details: dict[str, Any] = {"classes": [table.classes[c] for c in kept], "excluded": excluded}
    fields: dict[str, Any] = halves_fields(plan) | {"estimator": plan.estimator}
    settings = ("halves", "denominator", "aggregate")
    if len(kept) < 2:
        note = f"Undefined: needs two classes that can be cut into halves, has {len(kept)}"
        note += "" if generated.labels is not None else " (the samples have no labels)"
        return scored(
            "D-TMMD", table, generated, plan, settings, details=details, note=note, **fields
        )
    sums = table.class_halves(kept)

    design = design_of(sums.totals, plan)
    sizes = halves_of(whole_sets(sums.totals).n) if table.sizes is None else table.sizes[1 + kept]

    def statistic(t: Totals) -> Array:
        matrix = d_matrix(t, plan, design)
        inter = float(denominators(matrix, "mean_off_diagonal").mean())
        excess = float(self_distances(t, plan)[1].mean()) / (inter or np.nan)
        pooled = d_ratio(matrix, plan.denominator, "ratio_of_means")
        return np.array(
            [
                d_ratio(matrix, plan.denominator, plan.aggregate),
                excess,
                pooled,
                inter,
                *denominators(matrix, plan.denominator),
            ]
        )

    found = class_estimate(sums, statistic, table.unit)
    matrix, below, errors = d_matrix(sums.totals, plan), found.values[4:], found.errors[4:]
    apart = found.values[3] > (2 * found.errors[3] if np.isfinite(found.errors[3]) else 0.0)
    unstable = [
        name
        for k, name in enumerate(details["classes"])
        if not below[k] > (2 * errors[k] if np.isfinite(errors[k]) else np.inf)
    ]
    details |= {
        "matrix": matrix,
        "variants": {f"{d}/{a}": d_ratio(matrix, d, a) for d in DENOMINATORS for a in AGGREGATES},
        "ratio_of_means": {"value": found.values[2], "interval": found.interval(2, plan.level)},
        "unstable": unstable,
        "inter": {"value": found.values[3], "interval": found.interval(3, plan.level)},
        # A ratio over a mean that may well be 0 is noise.
        "E_ratio": found.values[1] if table.grouped and apart else None,
        "E_ratio_interval": found.interval(1, plan.level) if table.grouped and apart else None,
        "units": sums.units,
    }
    bound, note = _d_bound(sums, matrix, plan), ""
    if not np.isfinite(found.values[0]):
        unknown = (
            not bound <= 1
            and largest_bound(sums, plan.estimator, plan.scale) > plan.tolerance * plan.scale / 1000
        )
        note = (
            UNBOUNDED
            if unknown
            else "Undefined: the classes do not separate (a denominator is not positive)"
        )
    if not note and unstable:
        why = (
            "within two standard errors of 0"
            if np.isfinite(errors).all()
            else "of unknown error (too few groups)"
        )
        note = f"Denominators {why}, so the ratio is unreliable: {', '.join(unstable)}"
    return scored(
        "D-TMMD",
        table,
        generated,
        plan,
        settings,
        found=found,
        design=_design(design, sizes, plan),
        bound=bound,
        limit=1.0,
        details=details,
        note=note,
        **fields,
    )


def ratio_bound(table: Table, plan: Plan) -> float:
    """How far D-TMMD from this table may be from the exact one; 0 where it is not defined anyhow."""
    kept, _ = _usable(table, plan)
    if len(kept) < 2:
        return 0.0
    sums = table.class_halves(kept)
    return _d_bound(sums, d_matrix(sums.totals, plan), plan)


def _d_bound(sums: PairSums, matrix: Array, plan: Plan) -> float:
    """How far the ratio may be from the exact one: numerators and denominators moved apart as far as their bounds allow."""
    if sums.bound is None:
        return 0.0
    rest = mmd_bound(whole_sets(sums.bound.totals), plan.estimator, plan.scale)
    np.fill_diagonal(rest, _halves_bound(sums, plan))
    own, off = np.diagonal(matrix), denominators(matrix, plan.denominator)
    wide, low = np.diagonal(rest), denominators(rest, plan.denominator)
    if plan.aggregate == "ratio_of_means":
        own, off, wide, low = (np.array([v.mean()]) for v in (own, off, wide, low))
    own, off = np.abs(own), np.abs(off)
    return (
        float(((own + wide) / (off - low) - own / off).mean())
        if (off > low).all()
        else float("inf")
    )


def four_scores(
    generated: FeatureSet,
    reference: FeatureSet,
    *,
    floor: FeatureSet | None = None,
    **options: Unpack[Options],
) -> list[Score]:
    """TMMD, I-TMMD, CI-TMMD and D-TMMD from one sweep over the pairs.

    Args:
        generated: features of generated touches, with labels (for CI and D) and groups.
        reference: features of the real test touches.
        floor: real touches on which the three reference-free metrics are computed for ``Score.floor``; usually ``reference``. With halves of
            whole groups their values depend on the number of groups and of samples in each, biased ones on the number of samples:
            ``Score.floor`` is given where these are the same (within 1 %, else a note says why not), and the floor of what does not depend on
            them, ``details["E_floor"]``, for any groups of the same classes.
        **options: see :class:`Options`; the same for all four.

    Raises:
        PalpateError: as the single metrics do.
    """
    require_one_encoder(generated, reference, "reference")
    floors = [] if floor is None else floors_of(floor, reference, generated, options)
    first, *rest = four_of(generated, reference, options)
    return [one.score for one in (first, *(map(with_floor, rest, floors) if floors else rest))]


def floors_of(
    floor: FeatureSet, reference: FeatureSet, like: FeatureSet, options: Options
) -> list[Scored]:
    """I-, CI- and D-TMMD of real touches, made like those of ``like``.

    Raises:
        PalpateError: if one of the two has groups and the other none, or encoders differ.
    """
    require_one_encoder(like, floor, "floor")
    if (floor.groups is None) != (like.groups is None):
        must = "The floor must be scored like the generated touches"
        raise PalpateError(must, "groups in one of the two", "Give groups to both, or to none")
    plan = plan_for(options, grouped=floor.groups is not None)
    table = build_table(
        floor,
        None,
        plan,
        grouped=floor.groups is not None,
        median_of=reference,
        further=ratio_bound,
    )
    return [f(table, floor, plan) for f in (i_tmmd_of, ci_tmmd_of, d_tmmd_of)]


def four_of(generated: FeatureSet, reference: FeatureSet, options: Options) -> list[Scored]:
    """The four metrics with their leave-one-unit-out values."""
    own = generated.groups is not None
    both = own and reference.groups is not None
    plan, joint = plan_for(options, grouped=own), plan_for(options, grouped=both)
    table = build_table(generated, reference, joint, grouped=both, further=ratio_bound)
    alone = (
        table
        if own == both
        else build_table(
            generated, None, plan, grouped=own, median_of=reference, further=ratio_bound
        )
    )
    return [
        tmmd_of(table, generated, reference, joint),
        *(f(alone, generated, plan) for f in (i_tmmd_of, ci_tmmd_of, d_tmmd_of)),
    ]
