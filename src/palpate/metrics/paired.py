"""Generators side by side on the same test videos: differences with intervals, and how sure it is that one beats the other.

Two generators that are scored on the same samples share what is hard about them, so their scores move together when a video is left out, and the
interval of the difference is far narrower than the two intervals suggest. The leave-one-unit-out jackknife is applied to the difference
itself: ``SE^2 = (G-1)/G sum_g (delta_g - mean delta)^2`` with ``delta_g = a_g - b_g``, Student's t with G - 1 degrees of freedom.

``p_better`` is the confidence that a is the better of the two: the share of that t distribution on the side where a is ahead. It is no
probability of a hypothesis, and it is not adjusted for the number of pairs; ``p_adjusted`` (Holm) is the two-sided p-value that is.

Metrics without reference have no better direction but towards the floor, what real touches score: collapse is lowest. There a is better where
its distance to the floor is smaller, ``gap = |a - floor| - |b - floor|`` is what p_better and ``better`` speak of, and the floor is
left-one-out along with the generators, and the p-value is that of the gap (``p_difference`` is that of a - b). Without a floor, or with one
of other videos, classes or numbers of samples, neither is given, and the p-value is that of a - b.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Unpack, cast

import numpy as np
from scipy import special

from palpate.core import FeatureSet, PalpateError, Score, require_comparable
from palpate.metrics.inputs import require_one_encoder
from palpate.metrics.intervals import Interval, jackknife_errors, mean_interval, t_interval
from palpate.metrics.kernels import Array
from palpate.metrics.presets import Options, plan_for
from palpate.metrics.scored import Scored, excess_of, left_out_alike, not_comparable, with_floor
from palpate.metrics.tables import build_table
from palpate.metrics.tactile import floors_of, four_of, tmmd_of


@dataclass(frozen=True)
class Comparison:
    """Scores of several generators, and their differences.

    Attributes:
        scores: the four metrics of each generator, in the order given; ``subject`` is its name.
        differences: one score a metric and pair, ``value`` = a - b; ``details`` as in :func:`difference`, and ``p_adjusted``.
        excess: of :func:`compare`: the same of E, the between-group excess of I- and CI-TMMD (``"I-TMMD E"``, ``"CI-TMMD E"``).
    """

    scores: list[Score]
    differences: list[Score]
    excess: Comparison | None = None


def compare(
    generators: Mapping[str, FeatureSet],
    reference: FeatureSet,
    *,
    floor: FeatureSet | None = None,
    **options: Unpack[Options],
) -> Comparison:
    """TMMD, I-, CI- and D-TMMD of several generators on the same samples, with paired differences.

    Args:
        generators: name -> features of its touches; all with the same ids (any order), labels and groups.
        reference: features of the real test touches.
        floor: real touches for ``Score.floor`` of the reference-free metrics.
        **options: see :class:`palpate.metrics.Options`; ``subject`` is the generator's name.

    Raises:
        PalpateError: if generators differ in ids, labels, groups or encoder, or as the metrics do.
    """
    sets = same_samples(generators)
    found = {
        name: four_of(of, reference, cast("Options", {**options, "subject": name}))
        for name, of in sets.items()
    }
    floors: list[Scored | None] = [None] * 4
    if floor is not None:
        real = floors_of(floor, reference, next(iter(sets.values())), options)
        found, floors = (
            {name: [four[0], *map(with_floor, four[1:], real)] for name, four in found.items()},
            [None, *real],
        )
    excess = {name: [excess_of(one) for one in four[1:3]] for name, four in found.items()}
    between = _compared(excess, [None if one is None else excess_of(one) for one in floors[1:3]])
    return replace(_compared(found, floors), excess=between)


def _compared(
    found: Mapping[str, Sequence[Scored | None]], floors: Sequence[Scored | None]
) -> Comparison:
    """Scores of each generator, and differences of those that both of a pair have, metric by metric."""
    differences: list[Score] = []
    for k, floor in enumerate(floors):
        pairs = [(found[a][k], found[b][k]) for a, b in combinations(found, 2)]
        differences += holm(
            [difference(a, b, floor) for a, b in pairs if a is not None and b is not None]
        )
    return Comparison(
        [one.score for some in found.values() for one in some if one is not None], differences
    )


def compare_tmmd(
    generators: Mapping[str, FeatureSet], reference: FeatureSet, **options: Unpack[Options]
) -> Comparison:
    """As :func:`compare`, TMMD alone: with ``kernel=Polynomial()``, ``normalize=False`` and ``preset="paper"`` it is KID, with intervals.

    Raises:
        PalpateError: as :func:`compare`.
    """
    found: dict[str, Scored] = {}
    for name, of in same_samples(generators).items():
        require_one_encoder(of, reference, "reference")
        grouped = of.groups is not None and reference.groups is not None
        plan = plan_for(cast("Options", {**options, "subject": name}), grouped=grouped)
        found[name] = tmmd_of(
            build_table(of, reference, plan, grouped=grouped), of, reference, plan
        )
    differences = [difference(found[a], found[b]) for a, b in combinations(found, 2)]
    return Comparison([one.score for one in found.values()], holm(differences))


def same_samples(generators: Mapping[str, FeatureSet]) -> dict[str, FeatureSet]:
    """The generators with their rows in the order of the first.

    Raises:
        PalpateError: if there is none, or if they differ in ids, labels, groups or encoder.
    """
    if not generators:
        raise PalpateError("There must be a generator to score", "none", "Pass at least one")
    first, *others = generators
    return {first: generators[first]} | {
        name: _like(generators[first], first, generators[name], name) for name in others
    }


def _like(wanted: FeatureSet, name: str, other: FeatureSet, called: str) -> FeatureSet:
    """``other`` in the order of ``wanted``."""
    missing, surplus = (
        sorted(set(wanted.ids) - set(other.ids)),
        sorted(set(other.ids) - set(wanted.ids)),
    )
    if (
        missing
        or surplus
        or len(other.ids) != len(wanted.ids)
        or len(set(wanted.ids)) != len(wanted.ids)
    ):
        got = f"{len(missing)} missing and {len(surplus)} surplus ids" + (
            f", first {(missing + surplus)[0]!r}" if missing or surplus else ", repeated ids"
        )
        raise PalpateError(
            f"{called!r} and {name!r} must have the same samples, each once",
            got,
            "Generate for the same manifest and split",
        )
    require_one_encoder(wanted, other, repr(called))
    other = other if list(other.ids) == list(wanted.ids) else other.take(list(wanted.ids))
    for column in ("labels", "groups"):
        mine, yours = (
            None if (c := getattr(s, column)) is None else list(map(str, c))
            for s in (wanted, other)
        )
        if mine != yours:
            raise PalpateError(
                f"{called!r} and {name!r} must have the same {column}",
                "different ones",
                "Take both from one manifest",
            )
    return other


def difference(a: Scored, b: Scored, floor: Scored | None = None) -> Score:
    """``a - b`` of one metric, with the jackknife of the difference.

    Args:
        a: one generator.
        b: the other.
        floor: real touches, for a metric without a better direction of its own.

    Returns:
        ``details``: ``a``, ``b``, ``better`` (a name or None), ``p_better``, ``decided`` (whether the interval of what decides leaves out 0),
        ``p_value``, and for metrics without reference ``gap``, ``gap_interval`` and ``p_difference``.

    Raises:
        PalpateError: if the two scores are of different settings.
    """
    require_comparable([a.score, b.score])
    a, b, *rest = left_out_alike(
        a, b, *([floor] if floor is not None and not not_comparable(a, floor) else [])
    )
    x, y, floor = a.score, b.score, rest[0] if rest else None
    names = ("better", "p_better", "p_value")
    details: dict[str, Any] = {"a": x.subject, "b": y.subject, "decided": False} | dict.fromkeys(
        names
    )
    interval, method, note = None, "", ""
    value = None if x.value is None or y.value is None else x.value - y.value
    if value is None:
        note = "Undefined: one of the two scores is"
    elif not a.units or list(a.units) != list(b.units):
        note = (
            "No interval: the two scores share no units to leave out"
            if a.units
            else "No interval: there is nothing to leave out"
        )
    else:
        method = f"paired leave-one-{x.details.get('left_out', x.details['unit'])}-out jackknife, t, {len(a.units) - 1} df"
        interval, ahead = _interval(value, a.replicates - b.replicates, x.level)
        if interval is None:
            note, method = "No interval: leaving out a unit is undefined, or changes nothing", ""
        else:
            details["p_value"] = 2 * min(
                ahead, _interval(-value, a.replicates - b.replicates, x.level)[1]
            )
        _decide(details, value, (interval, ahead), a, b, floor)
    return replace(
        x,
        metric=f"{x.metric} difference",
        subject=f"{x.subject} - {y.subject}",
        value=value,
        interval=interval,
        interval_method=method,
        null=None,
        floor=None,
        details=details,
        note=note,
    )


def _interval(value: float, replicates: Array, level: float) -> tuple[Interval | None, float]:
    """The jackknife's interval of a value, and the share of its t distribution below 0."""
    error, df = float(jackknife_errors(replicates[:, None])[0]), len(replicates) - 1
    if not (np.isfinite(error) and error > 0):
        return None, 0.5
    return t_interval(value, error, df, level), float(special.stdtr(df, -value / error))


def _decide(
    details: dict[str, Any],
    value: float,
    found: tuple[Interval | None, float],
    a: Scored,
    b: Scored,
    floor: Scored | None,
) -> None:
    """Fills in who is ahead."""
    x, y = a.score, b.score
    if x.higher_is_better is None:
        if floor is None or floor.score.value is None or x.value is None or y.value is None:
            return
        if list(a.units) != list(
            floor.units
        ):  # the floor is left-one-out along with the generators
            return
        value = abs(x.value - floor.score.value) - abs(y.value - floor.score.value)
        gaps = np.abs(a.replicates - floor.replicates) - np.abs(b.replicates - floor.replicates)
        found = _interval(value, gaps, x.level)
        p = None if found[0] is None else 2 * min(found[1], _interval(-value, gaps, x.level)[1])
        details |= {
            "gap": value,
            "gap_interval": found[0],
            "p_difference": details["p_value"],
            "p_value": p,
        }
    interval, below = found
    sign = -value if x.higher_is_better else value
    details["better"] = x.subject if sign < 0 else y.subject if sign > 0 else None
    if interval is not None:
        details["p_better"] = 1 - below if x.higher_is_better else below
        details["decided"] = not interval[0] <= 0 <= interval[1]


def mean_differences(
    scores: Mapping[str, Score], values: Mapping[str, Array], groups: Sequence[str] | None
) -> list[Score]:
    """Paired differences of a metric that is a mean over images.

    Args:
        scores: of the generators, of one metric.
        values: (n,) of each generator, image by image in one order; pairs in which one is not finite are left out.
        groups: n groups, or None.

    Raises:
        PalpateError: if the scores are of different settings.
    """
    return holm(
        [
            _mean_difference(scores[a], scores[b], values[a] - values[b], groups)
            for a, b in combinations(scores, 2)
        ]
    )


def _mean_difference(x: Score, y: Score, delta: Array, groups: Sequence[str] | None) -> Score:
    require_comparable([x, y])
    finite = np.isfinite(delta)
    kept = delta[finite]
    names = None if groups is None else [g for g, ok in zip(groups, finite, strict=True) if ok]
    value = float(kept.mean()) if len(kept) else None
    interval, method = mean_interval(kept, names, x.level)
    sign = (value or 0.0) * (1 if x.higher_is_better else -1)
    details: dict[str, Any] = {
        "a": x.subject,
        "b": y.subject,
        "p_better": None,
        "p_value": None,
        "better": None,
        "decided": False,
    }
    details["better"] = x.subject if sign > 0 else y.subject if sign < 0 else None
    if interval is not None and value is not None:
        df = (len(kept) if names is None else len(set(names))) - 1
        error = (interval[1] - interval[0]) / 2 / float(special.stdtrit(df, 0.5 + x.level / 2))
        ahead, behind = (
            float(special.stdtr(df, s / error)) for s in (sign, -sign)
        )  # either tail keeps its digits
        details |= {
            "p_better": ahead,
            "p_value": 2 * min(ahead, behind),
            "decided": not interval[0] <= 0 <= interval[1],
        }
    note = (
        "Undefined: no pair of images has a value"
        if value is None
        else ""
        if interval
        else "No interval: one image or one group, or no variation between them"
    )
    return replace(
        x,
        metric=f"{x.metric} difference",
        subject=f"{x.subject} - {y.subject}",
        value=value,
        interval=interval,
        interval_method=f"paired, {method}" if method else "",
        null=None,
        floor=None,
        details=details,
        note=note,
    )


def holm(differences: Sequence[Score]) -> list[Score]:
    """The differences of one metric with ``p_adjusted``: two-sided p-values by Holm's step-down method over these pairs."""
    known = [k for k, d in enumerate(differences) if d.details["p_value"] is not None]
    known.sort(key=lambda k: differences[k].details["p_value"])
    adjusted, last = {}, 0.0
    for rank, k in enumerate(known):
        last = max(last, min(1.0, (len(known) - rank) * differences[k].details["p_value"]))
        adjusted[k] = last
    return [
        replace(d, details={**d.details, "p_adjusted": adjusted.get(k)})
        for k, d in enumerate(differences)
    ]
