"""From an estimate to a :class:`palpate.core.Score`: settings, sizes, digests, notes, and nothing that JSON cannot hold.

:class:`Scored` keeps the leave-one-unit-out values beside the score: the difference of two generators on the same videos is estimated
from them (:mod:`palpate.metrics.paired`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from palpate import __version__
from palpate.core import FeatureSet, Score
from palpate.metrics.intervals import Interval
from palpate.metrics.kernels import Array
from palpate.metrics.presets import Plan
from palpate.metrics.sums import PairSums
from palpate.metrics.tables import Estimate, Table

RANDOM_NOTE = "Random halves carry no signal: the unbiased value averages 0 over halvings for any data; halves of whole videos do (preset grouped)"


#: A bound at scale 1000 from which it is told.
TOLD = 1e-4
#: Floors are of designs that differ by less: what it changes is far below the noise of any floor.
ALIKE = 0.01
UNBOUNDED = 'Undefined: moments do not bound this value at this bandwidth; pass backend="blocked"'


@dataclass(frozen=True)
class Scored:
    """A score and how it moves.

    Attributes:
        score: the score.
        replicates: (G,) the value without each unit.
        units: (G,) names of the units; see :func:`over_classes` for the other choice.
        excess: (G,) of I- and CI-TMMD, the between-group excess E without each unit.
        design: what the value depends on beside the features: of halves of whole groups how their sizes turn E into dist^2
            (:class:`palpate.metrics.halves.Design`), of other biased values 1/m + 1/m' of the halves; empty where it depends on neither.
        groups: names of all units that the set has.
        without_class: (C, 2 or more) the value without each class, and what ``excess`` has; empty with fewer than three classes.
    """

    score: Score
    replicates: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    units: Sequence[str] = ()
    excess: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    design: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    groups: Sequence[str] = ()
    without_class: Array = field(default_factory=lambda: np.zeros((0, 4)), repr=False)


def scored(
    metric: str,
    table: Table,
    generated: FeatureSet,
    plan: Plan,
    settings: Sequence[str],
    *,
    found: Estimate | None = None,
    design: Array | None = None,
    bound: float = 0.0,
    limit: float | None = None,
    details: dict[str, Any],
    note: str = "",
    **rest: Any,
) -> Scored:
    """A score with everything that the plan and the set fix; NaN becomes None, and an undefined value loses its interval.

    Args:
        metric: its name.
        table: for kernel, back end, units.
        generated: for sizes and digests.
        plan: for subject, split, level, scale, and the options named in ``settings``.
        settings: options that bear on this metric.
        found: its first value is the score's; None for an undefined one.
        design: as :class:`Scored`; default empty.
        bound: the value is within this of the exact one, rounding aside.
        limit: the largest bound that leaves a value; default: as much as a distance can be.
        details: kept with the score.
        note: for people.
        **rest: further fields of the score.
    """
    value = plain(found.values[0]) if found else None
    if value is not None and not bound <= (2 * plan.scale if limit is None else limit):
        value, note = None, UNBOUNDED
    elif value is not None and bound > TOLD * (plan.scale / 1000 if limit is None else 1):
        note = ". ".join(filter(None, [within(bound), note]))
    interval = found.interval(0, plan.level) if found and value is not None else None
    method = found.method if found and interval else ""
    if value is None:
        rest["null"] = None
        details = {**details, **{name: None for name in ("p_value", "z") if name in details}}
        note = note or "Undefined: an average over no pairs"
    elif interval is None:
        note = ". ".join(
            filter(None, [note, "No interval: too few groups or samples to leave one out"])
        )
    details = plain(details) | {
        "unit": table.unit,
        "backend": table.sums.backend,
        "bound": plain(bound) if value is not None else None,
        "version": __version__,
    }
    score = Score(
        metric,
        plan.subject,
        value,
        interval,
        plan.level,
        method,
        bandwidth=table.kernel.bandwidth,
        scale=plan.scale,
        n=len(generated.ids),
        encoder=generated.encoder,
        split=plan.split,
        details=details,
        note=note,
        settings={
            **table.kernel.settings(),
            **{name: getattr(plan, name) for name in ("preset", "normalize", *settings)},
        },
        **{k: plain(v) for k, v in rest.items()},
    )
    design = np.zeros(0) if design is None else design
    if found is None or not len(found.units):
        return Scored(score, design=design)
    names = [table.names[int(u)] for u in found.units]
    excess = found.replicates[:, 1] if "E" in details else np.zeros(0)
    one = Scored(score, found.replicates[:, 0], names, excess, design, names, found.without_class)
    return over_classes(one) if found.of_classes else one


def over_classes(one: Scored) -> Scored:
    """The same score with classes left out in turn instead of units, where there are enough of them; ``details["left_out"]`` says so.

    For classes that cannot spare a unit, and for comparisons with a set that has such classes.
    """
    if not len(one.without_class):
        return one
    details = {**one.score.details, "left_out": "class"}
    excess = one.without_class[:, 1] if "E" in details else np.zeros(0)
    return replace(
        one,
        score=replace(one.score, details=details),
        replicates=one.without_class[:, 0],
        units=details["classes"],
        excess=excess,
    )


def left_out_alike(*some: Scored) -> Sequence[Scored]:
    """The same scores with the same units left out, or the same classes; as they are where neither can be."""
    alike = lambda sets: all(list(one.units) == list(sets[0].units) for one in sets)  # noqa: E731
    if alike(some):
        return some
    by_class = [over_classes(one) for one in some]
    return by_class if alike(by_class) else some


def excess_of(one: Scored) -> Scored | None:
    """The between-group excess E of an I- or CI-TMMD as a score of its own; None where there is none.

    It does not depend on the number of groups, and its floor is that of the same classes: it is what to report. Where moments do not bound
    it, it is undefined; where they bound it loosely, the note says so.
    """
    score, d = one.score, one.score.details
    if d.get("E") is None or score.settings.get("halves") != "group":
        return None
    bound = np.inf if d.get("E_bound") is None else float(d["E_bound"])  # JSON has no infinity
    known, interval = bound <= 2 * score.scale, d.get("E_interval")
    interval, note = (interval if known else None), "" if known else UNBOUNDED
    if known and bound > TOLD * score.scale / 1000:
        note = within(bound)
    kept = {
        name: d[name]
        for name in ("unit", "left_out", "units", "backend", "version", "classes", "excluded")
        if name in d
    }
    found = replace(
        score,
        metric=f"{score.metric} E",
        value=d["E"] if known else None,
        interval=None if interval is None else (interval[0], interval[1]),
        null=None,
        interval_method=score.interval_method if interval else "",
        floor=d.get("E_floor"),
        estimator="unbiased",
        seed=None,
        note=note,
        details=kept | {"bound": bound if known else None},
    )
    return Scored(
        found,
        one.excess,
        one.units if len(one.excess) else (),
        groups=one.groups,
        without_class=one.without_class[:, 1:],
    )


def within(bound: float) -> str:
    """What a reader must know of a bound that is not small."""
    return f"Within {bound:.2g} of the exact value, as the bandwidth is narrow for moments"


def not_comparable(one: Scored, floor: Scored) -> str:
    """Why real touches like these give another value of this metric than those the generator was asked for; '' if they do not.

    Halves of whole groups grow with the share of pairs inside groups, which falls with the number of groups and rises with the samples in
    each; a biased value falls as 1 / n; a mean over classes has a floor over the same classes alone.
    """
    mine, theirs = one.score, floor.score
    if mine.details.get("classes") != theirs.details.get("classes"):
        return "other classes"
    by_group = mine.settings.get("halves") == "group"
    if by_group and list(one.groups) != list(floor.groups):
        return "other groups"
    if one.design.shape != floor.design.shape or not np.allclose(
        one.design, floor.design, rtol=ALIKE, atol=0
    ):
        return "other numbers of samples" + (" a group" if by_group else "")
    return ""


def with_floor(one: Scored, floor: Scored, why: str = "") -> Scored:
    """The score beside that of real touches: its value where it is comparable, and E, which does not depend on the number of groups.

    E of CI-TMMD has that of the real touches of the generator's classes, E_ratio of D-TMMD none where the classes differ. ``why``: what else
    the real touches are of, where the two are known not to be comparable.
    """
    mine, theirs = one.score, floor.score
    why = not_comparable(one, floor) or why
    alike = mine.details.get("classes") == theirs.details.get("classes")
    details: dict[str, Any] = {}
    if "E" in mine.details:
        details["E_floor"] = (
            theirs.details.get("E")
            if alike
            else _mean_excess(theirs, mine.details.get("classes") or [])
        )
    if "E_ratio" in mine.details:
        details["E_ratio_floor"] = theirs.details.get("E_ratio") if alike else None
    said = (
        ""
        if not why or mine.value is None
        else f"No floor: real touches of {why} have another value"
    )
    note = ". ".join(filter(None, [mine.note, said]))
    return replace(
        one,
        score=replace(
            mine,
            floor=None if why else theirs.value,
            details={**mine.details, **details},
            note=note,
        ),
    )


def _mean_excess(score: Score, classes: Sequence[str]) -> float | None:
    """The mean E of some classes, None unless all are known."""
    each = [score.details.get("per_class", {}).get(name, {}).get("E") for name in classes]
    return sum(each) / len(each) if each and None not in each else None


def plain(value: Any) -> Any:
    """The same of JSON's types; NaN and infinity become None."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(plain(v) for v in value)
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def halves_fields(plan: Plan) -> dict[str, Any]:
    """Estimator, seed and direction of a metric of halves."""
    return {
        "higher_is_better": None,  # the paper says lower; a collapsed generator is lowest
        "estimator": "biased" if plan.estimator == "biased" else "unbiased",
        "seed": plan.seed if plan.halves == "random" else None,
    }


def halves_note(plan: Plan, sums: PairSums, *, grouped: bool) -> str:
    """What a reader of a metric of halves must know."""
    if not sums.rows.any() and not sums.own.any():
        return "All features are equal: complete collapse, which this metric calls perfect"
    found = [RANDOM_NOTE] if plan.halves == "random" and plan.estimator != "biased" else []
    if not grouped:
        found.append(
            "The interval takes samples as independent; frames of one video are not: give groups"
        )
    return ". ".join(found)


def null_band(center: float, sd: float) -> Interval | None:
    """95 % of random halves, by a normal approximation: the true distribution leans to the right where a few directions dominate."""
    return (
        (center - 1.96 * sd, center + 1.96 * sd)
        if np.isfinite(sd) and np.isfinite(center)
        else None
    )


def unfit(sums: PairSums, c: int, plan: Plan) -> str:
    """Why segment c cannot be cut into halves; '' if it can."""
    own = sums.segment == c
    sizes = (
        np.bincount(np.unique(sums.unit[own], return_inverse=True)[1], weights=sums.n[own])
        if own.any()
        else np.zeros(0)
    )
    if sizes.sum() < plan.min_samples:
        return f"fewer than {plan.min_samples} samples"
    if plan.halves == "group" and len(sizes) < 2:
        return "all samples are of one group"
    if plan.halves == "group" and sizes.max() < 2:
        return "no group has two samples"
    return ""


def units_of(sums: PairSums, c: int) -> int:
    """How many units segment c has."""
    return len(np.unique(sums.unit[sums.segment == c]))
