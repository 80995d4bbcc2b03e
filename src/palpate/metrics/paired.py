"""Generators side by side on the same test videos: differences with intervals, and how sure it is that one beats the other.

Two generators that are scored on the same samples share what is hard about them, so their scores move together when a video is left out, and the
interval of the difference is far narrower than the two intervals suggest. The leave-one-unit-out jackknife is applied to the difference
itself: ``SE^2 = (G-1)/G sum_g (delta_g - mean delta)^2`` with ``delta_g = a_g - b_g``, Student's t with G - 1 degrees of freedom.

``p_better`` is the confidence that a is the better of the two: the share of that t distribution on the side where a is ahead. It is no
probability of a hypothesis, and it is not adjusted for the number of pairs; ``p_adjusted`` (Holm) is the two-sided p-value that is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Unpack, cast

import numpy as np
from scipy import special

from palpate.core import FeatureSet, PalpateError, Score, require_comparable
from palpate.metrics.intervals import jackknife_errors, t_interval
from palpate.metrics.presets import Options, plan_for
from palpate.metrics.scored import Scored, require_one_encoder
from palpate.metrics.tables import build_table
from palpate.metrics.tactile import ci_tmmd_of, d_tmmd_of, four_of, i_tmmd_of


@dataclass(frozen=True)
class Comparison:
    """Scores of several generators, and their differences.

    Attributes:
        scores: the four metrics of each generator, in the order given; ``subject`` is its name.
        differences: one score a metric and pair, ``value`` = a - b; ``details``: ``a``, ``b``, ``better``, ``p_better``, ``p_value``, ``p_adjusted``.
    """

    scores: list[Score]
    differences: list[Score]


def compare(
    generators: Mapping[str, FeatureSet], reference: FeatureSet, *, floor: FeatureSet | None = None, **options: Unpack[Options]
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
    if not generators:
        raise PalpateError("There must be a generator to score", "none", "Pass at least one")
    first, *others = generators
    sets = {first: generators[first]} | {name: _like(generators[first], first, generators[name], name) for name in others}
    found = {name: four_of(of, reference, cast("Options", {**options, "subject": name})) for name, of in sets.items()}
    if floor is not None:
        floors = _floors(floor, reference, sets[first], options)
        found = {name: [four[0], *map(_with_floor, four[1:], floors)] for name, four in found.items()}
    pairs = [(a, b) for a, b in combinations(found, 2)]
    differences = [difference(x, y) for k in range(4) for x, y in ((found[a][k], found[b][k]) for a, b in pairs)]
    scores = [one.score for four in found.values() for one in four]
    return Comparison(scores, [d for k in range(4) for d in holm(differences[k * len(pairs) : (k + 1) * len(pairs)])])


def _like(wanted: FeatureSet, name: str, other: FeatureSet, called: str) -> FeatureSet:
    """``other`` in the order of ``wanted``."""
    missing, surplus = sorted(set(wanted.ids) - set(other.ids)), sorted(set(other.ids) - set(wanted.ids))
    if missing or surplus or len(other.ids) != len(wanted.ids) or len(set(wanted.ids)) != len(wanted.ids):
        got = f"{len(missing)} missing and {len(surplus)} surplus ids" + (
            f", first {(missing + surplus)[0]!r}" if missing or surplus else ", repeated ids"
        )
        raise PalpateError(
            f"{called!r} and {name!r} must have the same samples, each once", got, "Generate for the same manifest and split"
        )
    require_one_encoder(wanted, other, repr(called))
    other = other if list(other.ids) == list(wanted.ids) else other.take(list(wanted.ids))
    for column in ("labels", "groups"):
        mine, yours = (None if (c := getattr(s, column)) is None else list(map(str, c)) for s in (wanted, other))
        if mine != yours:
            raise PalpateError(f"{called!r} and {name!r} must have the same {column}", "different ones", "Take both from one manifest")
    return other


def _floors(floor: FeatureSet, reference: FeatureSet, like: FeatureSet, options: Options) -> list[float | None]:
    require_one_encoder(like, floor, "floor")
    if (floor.groups is None) != (like.groups is None):
        must = "The floor must be scored like the generated touches"
        raise PalpateError(must, "groups in one of the two", "Give groups to both, or to none")
    plan = plan_for(options, grouped=floor.groups is not None)
    table = build_table(floor, None, plan, grouped=floor.groups is not None, median_of=reference)
    return [f(table, floor, plan).score.value for f in (i_tmmd_of, ci_tmmd_of, d_tmmd_of)]


def _with_floor(one: Scored, floor: float | None) -> Scored:
    return replace(one, score=replace(one.score, floor=floor))


def difference(a: Scored, b: Scored) -> Score:
    """``a - b`` of one metric, with the jackknife of the difference.

    Raises:
        PalpateError: if the two scores are of different settings.
    """
    x, y = a.score, b.score
    require_comparable([x, y])
    details: dict[str, Any] = {"a": x.subject, "b": y.subject, "better": None, "p_better": None, "p_value": None}
    interval, method, note = None, "", ""
    value = None if x.value is None or y.value is None else x.value - y.value
    if value is None:
        note = "Undefined: one of the two scores is"
    elif not a.units or list(a.units) != list(b.units):
        note = "No interval: the two scores share no units to leave out"
    else:
        error = float(jackknife_errors((a.replicates - b.replicates)[:, None])[0])
        df = len(a.units) - 1
        method = f"paired leave-one-{x.details['unit']}-out jackknife, t, {df} df"
        if np.isfinite(error) and error > 0:
            interval = t_interval(value, error, df, x.level)
            ahead = float(special.stdtr(df, -value / error))  # lower is better
            ahead = 1 - ahead if x.higher_is_better else ahead
            details |= {"p_better": ahead, "p_value": 2 * min(ahead, 1 - ahead)}
        else:
            note, method = "No interval: leaving out a unit is undefined, or changes nothing", ""
        sign = value * (-1 if x.higher_is_better else 1)
        details["better"] = x.subject if sign < 0 else y.subject if sign > 0 else None
    return replace(
        x, metric=f"{x.metric} difference", subject=f"{x.subject} - {y.subject}", value=value, interval=interval, interval_method=method,
        null=None, floor=None, details=details, note=note,
    )  # fmt: skip


def holm(differences: Sequence[Score]) -> list[Score]:
    """The differences of one metric with ``p_adjusted``: two-sided p-values by Holm's step-down method over these pairs."""
    known = [k for k, d in enumerate(differences) if d.details["p_value"] is not None]
    known.sort(key=lambda k: differences[k].details["p_value"])
    adjusted, last = {}, 0.0
    for rank, k in enumerate(known):
        last = max(last, min(1.0, (len(known) - rank) * differences[k].details["p_value"]))
        adjusted[k] = last
    return [replace(d, details={**d.details, "p_adjusted": adjusted.get(k)}) for k, d in enumerate(differences)]
