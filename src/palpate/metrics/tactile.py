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

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Unpack

import numpy as np

from palpate import __version__
from palpate.core import FeatureSet, PalpateError, Score
from palpate.metrics.halves import self_distances, whole_sets
from palpate.metrics.intervals import Interval, random_halves_sd
from palpate.metrics.kernels import Array, Index, PairSums, Totals
from palpate.metrics.mmd import mmd_matrix
from palpate.metrics.presets import AGGREGATES, DENOMINATORS, Options, Plan, plan_for
from palpate.metrics.tables import Table, build_table, class_estimate, estimate

RANDOM_NOTE = (
    "Random halves carry no signal: the unbiased value averages 0 over halvings for any data; give groups for halves of whole videos"
)


def _score(metric: str, generated: FeatureSet, plan: Plan, settings: Sequence[str], **rest: Any) -> Score:
    """A score with everything that the plan and the set fix; NaN becomes None, and an undefined value loses its interval."""
    rest = {k: _plain(v) for k, v in rest.items()}
    if rest["value"] is None:
        rest |= {"interval": None, "interval_method": "", "null": None}
        rest["note"] = rest.get("note") or "Undefined: an average over no pairs"
    elif rest.get("interval") is None:
        rest["interval_method"] = ""
        rest["note"] = ". ".join(filter(None, [rest.get("note"), "No interval: too few groups or samples to leave one out"]))
    return Score(
        metric, plan.subject, level=plan.level, bandwidth=plan.sigma, scale=plan.scale, n=len(generated.ids), encoder=generated.encoder,
        split=plan.split, settings={"kernel": "gaussian", **{name: getattr(plan, name) for name in ("preset", "normalize", *settings)}}, **rest,
    )  # fmt: skip


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(v) for v in value)
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _same_encoder(a: FeatureSet, b: FeatureSet, what: str) -> None:
    if a.encoder is not None and b.encoder is not None and a.encoder != b.encoder:
        raise PalpateError(
            f"Generated and {what} features must come from one encoder",
            f"digests {a.encoder[:12]} and {b.encoder[:12]}",
            "Embed both with the same encoder",
        )


def tmmd(generated: FeatureSet, reference: FeatureSet, **options: Unpack[Options]) -> Score:
    """TMMD: dist^2 between generated and real touches (paper, Eq. 2).

    Args:
        generated: (n, d) features of generated touches.
        reference: (m, d) features of real touches; n and m may differ.
        **options: see :class:`Options`. Groups count only if both sets have them; the same name is the same group in both.

    Returns:
        Value with a leave-one-group-out interval; ``details`` holds the counts of groups.

    Raises:
        PalpateError: on features that are refused, unequal widths, or encoders of different digests.
    """
    _same_encoder(generated, reference, "reference")
    grouped = generated.groups is not None and reference.groups is not None
    plan = plan_for(options, grouped=grouped)
    return _tmmd(build_table(generated, reference, plan, grouped=grouped), generated, reference, plan)


def _tmmd(table: Table, generated: FeatureSet, reference: FeatureSet, plan: Plan) -> Score:
    sums = table.tmmd()
    found = estimate(sums, lambda t: mmd_matrix(t, plan.estimator, plan.scale)[:1, 1], table.unit)
    note = ""
    if not np.isfinite(found.values[0]):
        note = "Undefined: " + (
            "each set needs two groups, not all shared, for the grouped estimator"
            if plan.estimator == "grouped"
            else "each set needs two samples"
        )
    details = {"unit": table.unit, "units": sums.units, "version": __version__}
    return _score(
        "TMMD", generated, plan, (), value=found.values[0], interval=found.interval(0, plan.level), interval_method=found.method,
        estimator=plan.estimator, m=len(reference.ids), details=details, note=note,
    )  # fmt: skip


def _halves_fields(plan: Plan) -> dict[str, Any]:
    return {
        "estimator": "biased" if plan.estimator == "biased" else "unbiased",
        "seed": plan.seed if plan.halves == "random" else None,
    }


def _halves_note(plan: Plan, sums: PairSums) -> str:
    if not sums.rows.any():
        return "All features are equal: complete collapse, which this metric calls perfect"
    return RANDOM_NOTE if plan.halves == "random" and plan.estimator != "biased" else ""


def _null(centre: float, sd: float) -> Interval | None:
    return (centre - 1.96 * sd, centre + 1.96 * sd) if np.isfinite(sd) and np.isfinite(centre) else None


def i_tmmd(generated: FeatureSet, **options: Unpack[Options]) -> Score:
    """I-TMMD: dist^2 between two halves of the generated touches (paper, Eq. 3).

    With ``halves="group"`` the value is the average over halvings by whole groups, in closed form (:mod:`palpate.metrics.halves`).

    Returns:
        Value, interval, ``null`` (95 % of random halves, closed form); ``details``: ``E`` (between-group excess, independent of the
        number of groups) and its interval, ``z`` (distance from the null in its standard deviations), ``dispersion``.

    Raises:
        PalpateError: on features that are refused, or ``halves="group"`` without groups.
    """
    plan = plan_for(options, grouped=generated.groups is not None)
    return _i_tmmd(build_table(generated, None, plan, grouped=generated.groups is not None), generated, plan)


def _i_tmmd(table: Table, generated: FeatureSet, plan: Plan) -> Score:
    sums = table.set_halves()
    found = estimate(sums, lambda t: np.concatenate(self_distances(t, plan)), table.unit)
    whole = sums.merge(np.zeros(2, dtype=np.intp), 1)
    sd, n = float(random_halves_sd(whole, plan.estimator, plan.scale)[0]), len(generated.ids)
    dispersion = _dispersion(whole.totals, plan)[0]
    centre = dispersion if plan.estimator == "biased" else 0.0
    value = found.values[0]
    reason = _unfit(whole, 0, plan)
    details = {
        "E": found.values[1] if table.grouped else None,
        "E_interval": found.interval(1, plan.level) if table.grouped else None,
        "z": (value - centre) / sd if sd > 0 else None,
        "dispersion": dispersion,
        "unit": table.unit,
        "units": sums.units,
        "version": __version__,
    }
    return _score(
        "I-TMMD", generated, plan, ("halves",), value=None if reason else value, interval=found.interval(0, plan.level),
        interval_method=found.method, null=_null(centre, sd), details=details,
        note=f"Undefined: {reason} (n = {n})" if reason else _halves_note(plan, sums), **_halves_fields(plan),
    )  # fmt: skip


def _dispersion(t: Totals, plan: Plan) -> Array:
    """What biased dist^2 averages over random halves: (4/n) scale (1 - mean off-diagonal k), for each segment."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return -4 / t.n * plan.scale * np.diagonal(t.sums) / (t.n * (t.n - 1))


def _unfit(sums: PairSums, c: int, plan: Plan) -> str:
    """Why segment c cannot be cut into halves; '' if it can."""
    units = np.unique(sums.unit[sums.segment == c], return_counts=True)[1]
    if units.sum() < plan.min_samples:
        return f"fewer than {plan.min_samples} samples"
    if plan.halves == "group" and len(units) < 2:
        return "all samples are of one group"
    if plan.halves == "group" and units.max() < 2:
        return "no group has two samples"
    return ""


def _usable(table: Table, plan: Plan) -> tuple[Index, dict[str, str]]:
    """Class numbers that can be cut into halves, and why the others cannot."""
    whole = table.sums.merge(np.append(np.repeat(np.arange(len(table.classes)), 4), -1), len(table.classes))
    reasons = {name or "(no label)": _unfit(whole, c, plan) if name else "no label" for c, name in enumerate(table.classes)}
    kept = np.array([c for c, reason in enumerate(reasons.values()) if not reason], dtype=np.intp)
    return kept, {name: reason for name, reason in reasons.items() if reason}


def ci_tmmd(generated: FeatureSet, **options: Unpack[Options]) -> Score:
    """CI-TMMD: the mean over classes of dist^2 between two halves of a class (paper, Eq. 4).

    A class counts with at least ``min_samples`` samples and, for halves by group, two groups of which one has two samples.

    Returns:
        Value, interval (over groups; over classes where a class has only two groups), ``null``; ``details``: ``E``, ``per_class``, ``excluded``.

    Raises:
        PalpateError: on features that are refused, or ``halves="group"`` without groups.
    """
    plan = plan_for(options, grouped=generated.groups is not None)
    return _ci_tmmd(build_table(generated, None, plan, grouped=generated.groups is not None), generated, plan)


def _ci_tmmd(table: Table, generated: FeatureSet, plan: Plan) -> Score:
    kept, excluded = _usable(table, plan)
    details: dict[str, Any] = {
        "classes": [table.classes[c] for c in kept],
        "excluded": excluded,
        "unit": table.unit,
        "version": __version__,
    }
    if not len(kept):
        note = "Undefined: no class can be cut into halves" + ("" if generated.labels is not None else " (the samples have no labels)")
        return _score("CI-TMMD", generated, plan, ("halves",), value=None, details=details, note=note, **_halves_fields(plan))
    sums = table.class_halves(kept)
    found = class_estimate(sums, lambda t: np.array([v.mean() for v in self_distances(t, plan)]), table.unit)  # Eq. 4
    each, excess = self_distances(sums.totals, plan)
    whole = sums.merge(np.repeat(np.arange(len(kept)), 2), len(kept))
    sd = float(np.sqrt((random_halves_sd(whole, plan.estimator, plan.scale) ** 2).sum())) / len(kept)
    dispersion = float(_dispersion(whole.totals, plan).mean())
    centre = dispersion if plan.estimator == "biased" else 0.0
    details |= {
        "E": found.values[1] if table.grouped else None,
        "E_interval": found.interval(1, plan.level) if table.grouped else None,
        "z": (found.values[0] - centre) / sd if sd > 0 else None,
        "dispersion": dispersion,
        "per_class": {
            name: {"value": each[k], "E": excess[k] if table.grouped else None, "n": int(whole.totals.n[k]), "units": _units(whole, k)}
            for k, name in enumerate(details["classes"])
        },
        "units": sums.units,
    }
    return _score(
        "CI-TMMD", generated, plan, ("halves",), value=found.values[0], interval=found.interval(0, plan.level),
        interval_method=found.method, null=_null(centre, sd), details=details, note=_halves_note(plan, sums), **_halves_fields(plan),
    )  # fmt: skip


def _units(sums: PairSums, c: int) -> int:
    return len(np.unique(sums.unit[sums.segment == c]))


def d_tmmd(generated: FeatureSet, **options: Unpack[Options]) -> Score:
    """D-TMMD: how much a class differs from itself, against how much from the others (paper, Eq. 5-7).

    ``denominator``: ``"sum"`` over c' including c (Eq. 7), ``"mean"`` of the same, or ``"mean_off_diagonal"``. ``aggregate``: the mean over
    classes of the ratios (Eq. 7), or the ratio of the means, which stays finite where one class has a small denominator.

    Returns:
        Value and interval; ``details``: ``matrix`` (D, classes in the order of ``classes``), ``variants`` (all denominators and
        aggregates), ``unstable`` (classes whose denominator is not two standard errors above 0), ``excluded``.

    Raises:
        PalpateError: on features that are refused, or ``halves="group"`` without groups.
    """
    plan = plan_for(options, grouped=generated.groups is not None)
    return _d_tmmd(build_table(generated, None, plan, grouped=generated.groups is not None), generated, plan)


def d_matrix(t: Totals, plan: Plan) -> Array:
    """D (C, C) from 2C segments: halves of a class on the diagonal (Eq. 5), whole classes off it (Eq. 6)."""
    matrix = mmd_matrix(whole_sets(t), plan.estimator, plan.scale)
    np.fill_diagonal(matrix, self_distances(t, plan)[0])
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


def _d_tmmd(table: Table, generated: FeatureSet, plan: Plan) -> Score:
    kept, excluded = _usable(table, plan)
    details: dict[str, Any] = {
        "classes": [table.classes[c] for c in kept],
        "excluded": excluded,
        "unit": table.unit,
        "version": __version__,
    }
    fields = _halves_fields(plan) | {"estimator": plan.estimator}
    settings = ("halves", "denominator", "aggregate")
    if len(kept) < 2:
        note = f"Undefined: needs two classes that can be cut into halves, has {len(kept)}"
        note += "" if generated.labels is not None else " (the samples have no labels)"
        return _score("D-TMMD", generated, plan, settings, value=None, details=details, note=note, **fields)
    sums = table.class_halves(kept)

    def statistic(t: Totals) -> Array:
        matrix = d_matrix(t, plan)
        excess = float(self_distances(t, plan)[1].mean()) / float(denominators(matrix, "mean_off_diagonal").mean() or np.nan)
        return np.array([d_ratio(matrix, plan.denominator, plan.aggregate), excess, *denominators(matrix, plan.denominator)])

    found = class_estimate(sums, statistic, table.unit)
    matrix, below, errors = d_matrix(sums.totals, plan), found.values[2:], found.errors[2:]
    unstable = [name for k, name in enumerate(details["classes"]) if below[k] <= (2 * errors[k] if np.isfinite(errors[k]) else 0.0)]
    details |= {
        "matrix": matrix,
        "variants": {f"{d}/{a}": d_ratio(matrix, d, a) for d in DENOMINATORS for a in AGGREGATES},
        "unstable": unstable,
        "E_ratio": found.values[1] if table.grouped else None,
        "E_ratio_interval": found.interval(1, plan.level) if table.grouped else None,
        "units": sums.units,
    }
    note = "Undefined: the classes do not separate (a denominator is not positive)" if not np.isfinite(found.values[0]) else ""
    if not note and unstable:
        note = f"Denominators within two standard errors of 0, so the ratio is unreliable: {', '.join(unstable)}"
    return _score(
        "D-TMMD", generated, plan, settings, value=found.values[0], interval=found.interval(0, plan.level), interval_method=found.method,
        details=details, note=note, **fields,
    )  # fmt: skip


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
        floor: real touches on which the three reference-free metrics are computed for ``Score.floor``; usually ``reference``.
        **options: see :class:`Options`; the same for all four.

    Raises:
        PalpateError: as the single metrics do.
    """
    _same_encoder(generated, reference, "reference")
    own = generated.groups is not None
    both = own and reference.groups is not None
    plan, joint = plan_for(options, grouped=own), plan_for(options, grouped=both)
    table = build_table(generated, reference, joint, grouped=both)
    alone = table if own == both else build_table(generated, None, plan, grouped=own)
    scores = [_tmmd(table, generated, reference, joint)] + [f(alone, generated, plan) for f in (_i_tmmd, _ci_tmmd, _d_tmmd)]
    if floor is None:
        return scores
    _same_encoder(generated, floor, "floor")
    if (floor.groups is None) != (generated.groups is None):
        raise PalpateError(
            "The floor must be scored like the generated touches", "groups in one of the two", "Give groups to both, or to none"
        )
    real = build_table(floor, None, plan, grouped=own)
    floors = [f(real, floor, plan).value for f in (_i_tmmd, _ci_tmmd, _d_tmmd)]
    return [scores[0], *(replace(s, floor=v) for s, v in zip(scores[1:], floors, strict=True))]
