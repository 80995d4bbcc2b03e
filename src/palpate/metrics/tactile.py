"""The four tactile metrics: MMD on features of a tactile encoder (paper, Eq. 2-7).

G: generated features (n rows), R: reference features (m rows), G^c: those of class c. Lower is
better for all four.

* **TMMD** ``= dist^2(G, R)``, Eq. 2.
* **I-TMMD** ``= dist^2(G_1, G_2)`` for two disjoint halves of G, Eq. 3.
* **CI-TMMD** ``= 1/C sum_c dist^2(G^c_1, G^c_2)``, Eq. 4.
* **D-TMMD** ``= 1/C sum_c D_cc / sum_c' D_cc'`` (Eq. 7) with ``D_cc = dist^2(G^c_1, G^c_2)`` (Eq.
  5), ``D_cc' = dist^2(G^c, G^c')`` (Eq. 6).

One pass over the pairs fills a table of kernel sums (:class:`palpate.metrics.mmd.Table`); a metric
merges its segments and computes a statistic of the totals, and the jackknife the same statistic
without each unit.

Read the last three next to the same metric on real samples (``Score.floor``) and next to TMMD: a
generator that collapses to one image has a perfect I- and CI-TMMD. A score that is not defined has
value None and a note; classes that are excluded are in ``details``.

KID and CMMD are TMMD with other settings, over all pairs instead of random subsets. KID (Binkowski
et al., arXiv 1801.01401): the unbiased MMD^2 with the kernel ``(x.y / d + 1)^3`` on features of
Inception. CMMD (Jayasumana et al., arXiv 2401.09603): the biased one with a Gaussian of bandwidth
10 on embeddings of CLIP.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Unpack, get_args

import numpy as np

from palpate._version import __version__
from palpate.core import Note, Score
from palpate.core.features import Array, Index
from palpate.core.files import plain
from palpate.metrics.inputs import with_columns
from palpate.metrics.intervals import (
    NONE,
    Estimate,
    Interval,
    PairSums,
    Scored,
    Spread,
    Totals,
    class_estimate,
    estimate,
    permutation_test,
    score_of,
)
from palpate.metrics.kernels import TOLERANCE, Polynomial
from palpate.metrics.mmd import (
    LEAST,
    Aggregate,
    Denominator,
    Options,
    PairOptions,
    SetOptions,
    Table,
    build_table,
    design_of,
    dispersion_of,
    estimator_of_halves,
    halves_of,
    largest_bound,
    mmd_matrix,
    random_halves_sd,
    self_distances,
    shared_ids,
    whole_sets,
)

INDEPENDENT, UNDEFINED = Note("independent-samples"), Spread(np.nan, np.nan, 0, "")
#: Options that bear on a metric and are recorded, besides preset and normalize.
SETTINGS = {
    "TMMD": (),
    "I-TMMD": ("halves",),
    "CI-TMMD": ("halves",),
    "D-TMMD": ("halves", "denominator", "aggregate"),
}


def tmmd(generated: Any, reference: Any, **options: Unpack[PairOptions]) -> Score:
    """TMMD: dist^2 between generated and real samples (paper, Eq. 2).

    Args:
        generated: (n, d) features of generated tactile images: an array, a tensor, a list of rows,
            or a FeatureSet.
        reference: (m, d) features of real tactile images; n and m may differ.
        **options: columns of both, and those of :class:`palpate.metrics.Options`:

            * ``ids``: n ids of ``generated``; without, all rows are different samples.
            * ``groups``: n groups (videos), which are left out as a whole.
            * ``labels``: n classes, for CI- and D-TMMD.
            * ``reference_ids``: m ids; an id in both sets is the same scene. Without groups of both
              sets, shared ids act as groups: the default preset excludes the pairs of one scene.
            * ``reference_groups``: m groups; groups count only if both sets have them, and a group
              in both sets is the same group.
            * ``encoder``: digest of the encoder of both.

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
    (x, y), settings = with_columns(options, generated=generated, reference=reference)
    return tmmd_of(build_table(x, y, settings)).score


def i_tmmd(generated: Any, **options: Unpack[SetOptions]) -> Score:
    """I-TMMD: dist^2 between two halves of the generated samples (paper, Eq. 3).

    With ``halves="group"`` the value is the average over halvings by whole groups, in closed form
    (:mod:`palpate.metrics.mmd`).

    Args:
        generated: (n, d) features: an array, a tensor, a list of rows, or a FeatureSet.
        **options: as of :func:`tmmd`. Random and ordered halves depend on ``ids``; without, on the
            row numbers.

    Returns:
        Value, interval, ``null`` (95 % of random halves by a normal approximation with the exact
        variance); ``details``: ``E`` (between-group excess, independent of the number of groups)
        and its interval, ``z`` (distance from the null in standard deviations), ``dispersion``.

    Raises:
        PalpateError: on features that are rejected, or ``halves="group"`` without groups.
    """
    return i_tmmd_of(_table(generated, options)).score


def ci_tmmd(generated: Any, **options: Unpack[SetOptions]) -> Score:
    """CI-TMMD: the mean over classes of dist^2 between two halves of a class (paper, Eq. 4).

    A class (``labels``) counts with at least four samples and, for halves by group, two groups of
    which one has two samples. Arguments and errors as :func:`i_tmmd`.

    Returns:
        Value, interval (over groups; over classes where a class has only two groups), ``null``;
        ``details``: ``E``, ``per_class``, ``excluded``.
    """
    return ci_tmmd_of(_table(generated, options)).score


def d_tmmd(generated: Any, **options: Unpack[SetOptions]) -> Score:
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
    return d_tmmd_of(_table(generated, options)).score


def _table(generated: Any, options: SetOptions) -> Table:
    """The table of one set."""
    (x,), settings = with_columns(options, generated=generated)
    return build_table(x, None, settings)


def kid(generated: Any, reference: Any, **options: Unpack[PairOptions]) -> Score:
    """KID between generated and real features, times 1000; lower is better.

    Args:
        generated: (n, d) features; as published, the 2048 pool features of Inception.
        reference: (m, d) features of real images.
        **options: of :func:`palpate.metrics.tmmd`, e.g. ``groups`` and ``reference_groups`` for an
            interval over whole groups, or ``scale=1`` for the plain value.

    Raises:
        PalpateError: as :func:`palpate.metrics.tmmd`.
    """
    defaults: PairOptions = {
        "kernel": Polynomial(),
        "preset": "paper",
        "normalize": False,
        "permutations": 0,
    }
    return _named("KID", generated, reference, {**defaults, **options})


def cmmd(generated: Any, reference: Any, **options: Unpack[PairOptions]) -> Score:
    """CMMD between generated and real embeddings, times 1000; lower is better.

    Args:
        generated: (n, d) L2-normalized features; as published, image embeddings of CLIP.
        reference: (m, d) features of real images.
        **options: of :func:`palpate.metrics.tmmd`.

    Raises:
        PalpateError: as :func:`palpate.metrics.tmmd`.
    """
    defaults: PairOptions = {"preset": "cmmd", "permutations": 0}
    return _named("CMMD", generated, reference, {**defaults, **options})


def _named(name: str, generated: Any, reference: Any, options: PairOptions) -> Score:
    score = tmmd(generated, reference, **options)
    settings = {k: v for k, v in score.settings.items() if k != "preset"}
    return replace(score, metric=name, settings=settings)


def tmmd_of(table: Table) -> Scored:
    """TMMD from a table."""
    plan, sums, reference = table.plan, table.tmmd(), table.reference
    assert reference is not None  # TMMD is of two sets
    notes: list[Note] = []
    distance = lambda t: mmd_matrix(t, plan.estimator, plan.scale)[..., :1, 1]
    est = estimate(sums, distance, table.unit, together=True)
    if not np.isfinite(est.spreads[0].value):
        reason = "few-groups" if plan.estimator == "grouped" else "one-sample"
        notes.append(Note("undefined", {"reason": reason}))
    notes += copied_rows(table.copies, len(table.label))
    if not table.grouped:
        notes.append(INDEPENDENT)
        count = shared_ids(table.generated, reference) * (plan.estimator != "grouped")
        notes += [Note("dependent-pairs", {"count": count})] * (count > 0)
    bound = largest_bound(sums, plan.estimator, plan.scale)
    if bound > TOLERANCE * plan.scale / 1000:
        notes.append(Note("within-bound", {"bound": bound}))
    details: dict[str, Any] = {"units": len(sums.units), "copies": table.copies, "bound": bound}
    details |= {"p_value": None, "permutations": None}
    null = None
    test = permutation_test(
        sums, plan.estimator, plan.scale, count=plan.permutations, seed=plan.seed
    )
    if test is not None:
        details["p_value"], values, details["permutations"] = test
        null = (float(np.quantile(values, 0.025)), float(np.quantile(values, 0.975)))
    return _scored(table, "TMMD", est, details, notes, null=null)


def copied_rows(count: int | None, n: int) -> list[Note]:
    """A note of generated rows that are bit for bit rows of the reference."""
    return [Note("copied-rows", {"count": count, "n": n})] if count else []


def i_tmmd_of(table: Table) -> Scored:
    """I-TMMD from a table."""
    reason = unfit(table.halves(), [0, 1], table.plan)
    params = {"reason": reason, "least": LEAST, "n": len(table.label)}
    return _mean_of_halves(table, "I-TMMD", {}, [Note("undefined", params)] if reason else [])


def ci_tmmd_of(table: Table) -> Scored:
    """CI-TMMD from a table."""
    kept, details = _usable(table)
    if len(kept):
        return _mean_of_halves(table, "CI-TMMD", details, [], kept)
    labeled = table.generated.labels is not None
    notes = [Note("undefined", {"reason": "no-class", "labeled": labeled})]
    return _scored(table, "CI-TMMD", None, details, notes)


def _mean_of_halves(
    table: Table,
    metric: str,
    details: dict[str, Any],
    notes: Sequence[Note],
    kept: Index | None = None,
) -> Scored:
    """The mean of dist^2 between the halves of K sets: all samples (Eq. 3), or classes (Eq. 4)."""
    plan, sums, spread = table.plan, table.halves(kept), table.spread(kept)
    design, joined = design_of(sums.totals, plan), whole_sets(sums.totals)
    est = class_estimate(
        sums, lambda t: np.array([v.mean() for v in self_distances(t, plan, design)]), table.unit
    )
    if kept is not None:
        each, excess = self_distances(sums.totals, plan)
        details["per_class"] = {
            name: {
                "value": each[k],
                "E": excess[k] if table.grouped else None,
                "n": int(joined.n[k]),
                "units": len(np.unique(sums.unit[sums.segment // 2 == k])),
            }
            for k, name in enumerate(details["classes"])
        }
    sds = random_halves_sd(spread, joined.n, plan.estimator, plan.scale)
    sd = float(np.sqrt((sds**2).sum())) / len(sds)
    dispersion = float(dispersion_of(joined, plan).mean())
    center = dispersion if plan.estimator == "biased" else 0.0
    details |= {
        "z": (est.spreads[0].value - center) / sd if sd > 0 else None,
        "dispersion": dispersion,
        "units": len(sums.units),
        "E": est.spreads[1].value if table.grouped else None,
        "E_interval": est.spreads[1].interval() if table.grouped else None,
    }
    collapsed = not sums.rows.any() and not sums.diagonal.any()
    random = plan.halves == "random" and plan.estimator != "biased"
    usual = [Note("random-halves")] * random + [INDEPENDENT] * (not table.grouped)
    return _scored(
        table,
        metric,
        None if notes else est,
        details,
        notes or ([Note("collapse")] if collapsed else usual),
        design=_design(design, joined.n, plan),
        # 95 % of random halves; the true distribution leans to the right where few directions
        # dominate.
        null=(center - 1.96 * sd, center + 1.96 * sd) if np.isfinite(sd + center) else None,
    )


def _design(design: Array, n: Array, plan: Options) -> Array:
    """What the value of sets of (K,) samples depends on but the features, see :class:`Scored`."""
    if plan.halves == "group":
        return design.ravel()
    with np.errstate(divide="ignore"):
        return (1 / halves_of(n)).sum(axis=1) if plan.estimator == "biased" else NONE


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


def _usable(table: Table) -> tuple[Index, dict[str, Any]]:
    """Classes that can be cut into halves; ``classes`` and ``excluded`` of details."""
    sums = table.whole_classes()
    reasons = {
        name: unfit(sums, [c], table.plan) if name else "no-label"
        for c, name in enumerate(table.classes)
    }
    kept = [c for c, reason in enumerate(reasons.values()) if not reason]
    excluded = {name or "(no label)": reason for name, reason in reasons.items() if reason}
    details = {"classes": [table.classes[c] for c in kept], "excluded": excluded}
    return np.array(kept, dtype=np.intp), details


def d_tmmd_of(table: Table) -> Scored:
    """D-TMMD from a table."""
    plan, (kept, details) = table.plan, _usable(table)
    if len(kept) < 2:
        labeled = table.generated.labels is not None
        params = {"reason": "one-class", "classes": len(kept), "labeled": labeled}
        return _scored(table, "D-TMMD", None, details, [Note("undefined", params)])
    sums = table.halves(kept)
    design = design_of(sums.totals, plan)

    def matrix_of(t: Totals) -> tuple[Array, float]:  # D (C, C), and the mean E
        matrix = mmd_matrix(whole_sets(t), plan.estimator, plan.scale)  # Eq. 6
        own, excess = self_distances(t, plan, design)
        np.fill_diagonal(matrix, own)  # Eq. 5
        return matrix, float(excess.mean())

    def statistic(t: Totals) -> Array:
        matrix, excess = matrix_of(t)
        inter = float(denominators(matrix, "mean_off_diagonal").mean())
        ratio = d_ratio(matrix, plan.denominator, plan.aggregate)
        pooled = d_ratio(matrix, plan.denominator, "ratio_of_means")
        each = denominators(matrix, plan.denominator)
        return np.array([ratio, excess / (inter or np.nan), pooled, inter, *each])

    est, (matrix, _) = class_estimate(sums, statistic, table.unit), matrix_of(sums.totals)
    _, excess, pooled, inter, *below = est.spreads
    # A ratio over a mean that may well be 0 is noise.
    apart = inter.value > (2 * inter.error if np.isfinite(inter.error) else 0.0)
    names = details["classes"]
    unstable = [n for n, s in zip(names, below, strict=True) if not s.value > 2 * s.error]
    use_excess = table.grouped and apart
    details |= {
        "matrix": matrix,
        "variants": {
            f"{d}/{a}": d_ratio(matrix, d, a)
            for d in get_args(Denominator)
            for a in get_args(Aggregate)
        },
        "ratio_of_means": {"value": pooled.value, "interval": pooled.interval()},
        "unstable": unstable,
        "inter": {"value": inter.value, "interval": inter.interval()},
        "E_ratio": excess.value if use_excess else None,
        "E_ratio_interval": excess.interval() if use_excess else None,
        "units": len(sums.units),
    }
    notes: list[Note] = []
    if not np.isfinite(est.spreads[0].value):
        notes = [Note("undefined", {"reason": "not-separate"})]
    elif unstable:
        params = {"classes": unstable, "known_errors": all(np.isfinite(s.error) for s in below)}
        notes = [Note("unstable-denominators", params)]
    design = _design(design, whole_sets(sums.totals).n, plan)
    return _scored(table, "D-TMMD", est, details, notes, design=design)


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
        apart = np.where(np.eye(len(matrix), dtype=bool), 0.0, matrix)
        return apart.sum(axis=1) / max(len(matrix) - 1, 1)
    return matrix.sum(axis=1) / (1 if denominator == "sum" else len(matrix))


def _scored(
    table: Table,
    metric: str,
    estimate: Estimate | None,
    details: dict[str, Any],
    notes: Sequence[Note],
    *,
    design: Array = NONE,
    null: Interval | None = None,
) -> Scored:
    """A score with everything that the plan and the sets fix; an undefined one says why."""
    plan, spread = table.plan, estimate.spreads[0] if estimate else UNDEFINED
    if not np.isfinite(spread.value):
        null, notes = None, notes or [Note("undefined", {"reason": "no-pairs"})]
    elif not spread.known:
        notes = [*notes, Note("no-interval", {"reason": "too-few"})]
    common = {"unit": table.unit, "backend": table.sums.backend, "version": __version__}
    recorded = ("preset", "normalize", *SETTINGS[metric])
    real, of_halves = table.reference if metric == "TMMD" else None, metric != "TMMD"
    in_halves = metric in ("I-TMMD", "CI-TMMD")  # see self_distances
    score = score_of(
        metric,
        plan.subject,
        spread,
        null=null,
        estimator=estimator_of_halves(plan) if in_halves else plan.estimator,
        bandwidth=table.kernel.bandwidth,
        scale=plan.scale,
        n=len(table.label),
        m=real and len(real.ids),
        seed=plan.seed if of_halves and plan.halves == "random" else None,
        encoder=table.generated.encoder,
        reference=real.digest if real and real.features.shape[1] else None,
        split=plan.split,
        # The paper says lower; a collapsed generator is lowest.
        higher_is_better=None if of_halves else False,
        details=plain(details) | common,
        notes=tuple(notes),
        settings=table.kernel.settings() | {name: getattr(plan, name) for name in recorded},
    )
    if estimate is None or not len(estimate.units):
        return Scored(score, design=design)
    names = units = [table.names[int(u)] for u in estimate.units]
    if estimate.of_classes:
        units = score.details["classes"]
        score = replace(score, details={**score.details, "left_out": "class"})
    excess = estimate.replicates[:, 1] if "E" in details else NONE
    return Scored(score, estimate.replicates[:, 0], units, excess, design, names)
