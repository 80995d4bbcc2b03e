"""From an estimate to a :class:`palpate.core.Score`, and a score next to that of real samples.

:class:`Scored` keeps the leave-one-unit-out values with the score: the difference of two generators
on the same videos is estimated from them (:mod:`palpate.metrics.paired`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from palpate import __version__
from palpate.core import FeatureSet, Note, Score
from palpate.core.plain import plain
from palpate.metrics.inputs import Array
from palpate.metrics.presets import Plan
from palpate.metrics.tables import Estimate, Table

#: A bound at scale 1000 from which a note reports it.
LOOSE_BOUND = 1e-4
#: Designs that differ by less have one floor: the change is far below the noise of any floor.
SAME_DESIGN = 0.01
UNBOUNDED = Note("undefined", {"reason": "moments"})


@dataclass(frozen=True)
class Scored:
    """A score and how it moves.

    Attributes:
        score: the score.
        replicates: (G,) the value without each unit.
        units: (G,) names of the units; see :func:`over_classes` for the other choice.
        excess: (G,) of I- and CI-TMMD, the between-group excess E without each unit.
        design: what the value depends on besides the features: of halves of whole groups how their
            sizes turn E into dist^2 (:class:`palpate.metrics.halves.Design`), of other biased
            values 1/m + 1/m' of the halves; empty where it depends on neither.
        groups: names of all units that the set has.
        without_class: (C, 2 or more) the value without each class, and what ``excess`` has; empty
            with fewer than three classes.
    """

    score: Score
    replicates: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    units: Sequence[str] = ()
    excess: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    design: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    groups: Sequence[str] = ()
    without_class: Array = field(default_factory=lambda: np.zeros((0, 4)), repr=False)


def scored(  # noqa: PLR0913
    metric: str,
    table: Table,
    generated: FeatureSet,
    plan: Plan,
    settings: Sequence[str],
    *,
    estimate: Estimate | None = None,
    design: Array | None = None,
    bound: float = 0.0,
    limit: float | None = None,
    details: dict[str, Any],
    notes: Sequence[Note] = (),
    **fields: Any,
) -> Scored:
    """A score with everything that the plan and the set fix.

    NaN becomes None, and an undefined value loses its interval.

    Args:
        metric: its name.
        table: for kernel, back end, units.
        generated: for sizes and digests.
        plan: for subject, split, level, scale, and the options named in ``settings``.
        settings: options that bear on this metric.
        estimate: its first value is the score's; None for an undefined one.
        design: as :class:`Scored`; default empty.
        bound: the value is within this of the exact one, rounding aside.
        limit: the largest bound that leaves a value; default: as much as a distance can be.
        details: kept with the score.
        notes: an undefined score has one of code ``undefined``.
        **fields: further fields of the score.
    """
    value = plain(estimate.values[0]) if estimate else None
    notes = list(notes)
    if value is not None and not bound <= (2 * plan.scale if limit is None else limit):
        value, notes = None, [UNBOUNDED]
    elif value is not None and bound > LOOSE_BOUND * (plan.scale / 1000 if limit is None else 1):
        notes.insert(0, Note("within-bound", {"bound": float(bound)}))
    interval = estimate.interval(0, plan.level) if estimate and value is not None else None
    if value is None:
        fields["null"] = None
        details |= {name: None for name in ("p_value", "z") if name in details}
        notes = notes or [Note("undefined", {"reason": "no-pairs"})]
    elif interval is None:
        notes.append(Note("no-interval", {"reason": "too-few"}))
    score = Score(
        metric,
        plan.subject,
        value,
        interval,
        plan.level,
        estimate.method if estimate and interval else "",
        bandwidth=table.kernel.bandwidth,
        scale=plan.scale,
        n=len(generated.ids),
        encoder=generated.encoder,
        split=plan.split,
        details={
            **plain(details),
            "unit": table.unit,
            "backend": table.sums.backend,
            "bound": plain(float(bound)) if value is not None else None,
            "version": __version__,
        },
        notes=tuple(notes),
        settings={
            **table.kernel.settings(),
            **{name: getattr(plan, name) for name in ("preset", "normalize", *settings)},
        },
        **fields,
    )
    design = np.zeros(0) if design is None else design
    if estimate is None or not len(estimate.units):
        return Scored(score, design=design)
    names = [table.names[int(u)] for u in estimate.units]
    excess = estimate.replicates[:, 1] if "E" in details else np.zeros(0)
    replicates, without = estimate.replicates[:, 0], estimate.without_class
    result = Scored(score, replicates, names, excess, design, names, without)
    return over_classes(result) if estimate.of_classes else result


def over_classes(one: Scored) -> Scored:
    """The same with classes left out in turn instead of units; ``details["left_out"]`` records it.

    For classes that cannot spare a unit, and for comparisons with a set that has such classes.
    """
    if not len(one.without_class):
        return one
    details = {**one.score.details, "left_out": "class"}
    return replace(
        one,
        score=replace(one.score, details=details),
        replicates=one.without_class[:, 0],
        units=details["classes"],
        excess=one.without_class[:, 1] if "E" in details else np.zeros(0),
    )


def same_units(*sets: Scored) -> Sequence[Scored]:
    """The sets with the same units left out, or the same classes; unchanged where neither works."""
    by_class = [over_classes(s) for s in sets]
    for choice in (sets, by_class):
        if all(list(s.units) == list(choice[0].units) for s in choice):
            return choice
    return sets


def excess_of(one: Scored) -> Scored | None:
    """The between-group excess E of an I- or CI-TMMD as its own score; None where there is none.

    It does not depend on the number of groups, and its floor is that of the same classes: it is
    what to report. Where moments do not bound it, it is undefined.
    """
    score, d = one.score, one.score.details
    if d.get("E") is None or score.settings.get("halves") != "group":
        return None
    bound = np.inf if d.get("E_bound") is None else float(d["E_bound"])  # JSON has no infinity
    known = bound <= 2 * score.scale
    interval = d.get("E_interval") if known else None
    notes = [] if known else [UNBOUNDED]
    if known and bound > LOOSE_BOUND * score.scale / 1000:
        notes = [Note("within-bound", {"bound": bound})]
    kept = ("unit", "left_out", "units", "backend", "version", "classes", "excluded")
    of_excess = replace(
        score,
        metric=f"{score.metric} E",
        value=d["E"] if known else None,
        interval=tuple(interval) if interval else None,
        null=None,
        interval_method=score.interval_method if interval else "",
        floor=d.get("E_floor"),
        estimator="unbiased",
        seed=None,
        notes=tuple(notes),
        details={k: d[k] for k in kept if k in d} | {"bound": bound if known else None},
    )
    units = one.units if len(one.excess) else ()
    without = one.without_class[:, 1:]
    return Scored(of_excess, one.excess, units, groups=one.groups, without_class=without)


def not_comparable(one: Scored, floor: Scored) -> str:
    """Why real samples like these give another value of this metric; '' if they do not.

    Halves of whole groups grow with the share of pairs inside groups, which falls with the number
    of groups and rises with the samples in each; a biased value falls as 1 / n; a mean over classes
    has a floor over the same classes alone.

    Returns:
        ``"classes"``, ``"groups"``, ``"group-sizes"``, ``"sizes"`` or ``""``.
    """
    if one.score.details.get("classes") != floor.score.details.get("classes"):
        return "classes"
    by_group = one.score.settings.get("halves") == "group"
    if by_group and list(one.groups) != list(floor.groups):
        return "groups"
    same = one.design.shape == floor.design.shape
    if not same or not np.allclose(one.design, floor.design, rtol=SAME_DESIGN, atol=0):
        return "group-sizes" if by_group else "sizes"
    return ""


def with_floor(one: Scored, floor: Scored) -> Scored:
    """The score with that of real samples as its floor, where the two are comparable.

    E of CI-TMMD has as its floor that of the real samples of the generator's classes, E_ratio of
    D-TMMD none where the classes differ.
    """
    details, real = one.score.details, floor.score.details
    reason = not_comparable(one, floor)
    classes = details.get("classes")
    more: dict[str, Any] = {}
    if "E" in details:
        same = classes == real.get("classes")
        more["E_floor"] = real.get("E") if same else _mean_excess(floor.score, classes or [])
    if "E_ratio" in details:
        more["E_ratio_floor"] = real.get("E_ratio") if classes == real.get("classes") else None
    notes = list(one.score.notes)
    if reason and one.score.value is not None:
        notes.append(Note("no-floor", {"reason": reason}))
    value = None if reason else floor.score.value
    score = replace(one.score, floor=value, details={**details, **more}, notes=tuple(notes))
    return replace(one, score=score)


def _mean_excess(score: Score, classes: Sequence[str]) -> float | None:
    """The mean E of some classes, None unless all are known."""
    per_class = score.details.get("per_class", {})
    each = [per_class.get(name, {}).get("E") for name in classes]
    return sum(each) / len(each) if each and None not in each else None
