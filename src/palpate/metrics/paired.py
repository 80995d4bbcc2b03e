"""Generators compared on the same test videos: differences with intervals, and which is better.

Two generators that are scored on the same samples share what is hard about them, so their scores
move together when a video is left out, and the interval of the difference is far narrower than the
two intervals suggest. The leave-one-unit-out jackknife is applied to the difference itself:
``SE^2 = (G-1)/G sum_g (delta_g - mean delta)^2`` with ``delta_g = a_g - b_g``, Student's t with G -
1 degrees of freedom.

``p_better`` is the confidence that a is the better of the two: the share of that t distribution on
the side where a is ahead. It is no probability of a hypothesis, and it is not adjusted for the
number of pairs; ``p_adjusted`` (Holm) is the two-sided p-value that is.

Metrics without reference have no better direction but towards the floor, what real samples score:
collapse is lowest. There a is better where its distance to the floor is smaller:
``gap = |a - floor| - |b - floor|`` is what ``p_better``, ``better`` and ``p_value`` speak of
(``p_difference`` is the p-value of a - b), and the floor is left-one-out along with the generators.
Without a floor, or with one of other videos, classes or numbers of samples, neither ``p_better``
nor ``better`` is given, and the p-value is that of a - b.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, combinations
from typing import Any

import numpy as np

from palpate.core import FeatureSet, Note, PalpateError, Score, require_comparable
from palpate.metrics.inputs import Array, feature_set, require_one_encoder
from palpate.metrics.intervals import Interval, Scored, Spread, jackknife_errors, spread_of_values
from palpate.metrics.means import Mean, spread_of
from palpate.metrics.table import build_table
from palpate.metrics.tactile import floors_of, four_of, not_comparable, tmmd_of, with_floor


@dataclass(frozen=True)
class Comparison:
    """Scores of several generators, and their differences.

    Attributes:
        scores: the metrics of each generator, in the order given; ``a`` is its name.
        differences: one score a metric and pair of names ``a`` and ``b``, ``value`` = a - b;
            ``details`` as in :func:`difference`, and ``p_adjusted``.
    """

    scores: list[Score]
    differences: list[Score]


def compare(
    generators: Mapping[str, Any], reference: Any, *, floor: Any = None, **options: Any
) -> Comparison:
    """TMMD, I-, CI- and D-TMMD of several generators on the same samples, with paired differences.

    I- and CI-TMMD of halves of whole groups are followed by their between-group excess E, a score
    of the kind ``"excess"``.

    Args:
        generators: name -> features of its samples; all with the same ids (any order), labels and
            groups. Arrays without ids are taken row by row for the same samples.
        reference: features of the real test samples.
        floor: real samples for ``Score.floor`` of the reference-free metrics.
        **options: see :class:`palpate.metrics.Options`; ``subject`` is the generator's name.

    Raises:
        PalpateError: if generators differ in ids, labels, groups or encoder, or as the metrics do.
    """
    reference = feature_set(reference, argument="reference")
    sets = same_samples(generators)
    scores = {
        name: four_of(of, reference, {**options, "subject": name}) for name, of in sets.items()
    }
    floors: list[Scored | None] = [None] * 4
    if floor is not None:
        first = next(iter(sets.values()))
        real = floors_of(feature_set(floor, argument="floor"), reference, first, options)
        floors = [None, *real]
        scores = {n: [s[0], *map(with_floor, s[1:], real)] for n, s in scores.items()}
    return _compared({n: _with_excess(s) for n, s in scores.items()}, _with_excess(floors))


def _with_excess(four: Sequence[Scored | None]) -> list[Scored | None]:
    """TMMD, I- and CI-TMMD, each followed by its E, and D-TMMD."""
    return [x for s in four for x in (s, s and excess_of(s))]


def _compared(
    sets: Mapping[str, Sequence[Scored | None]], floors: Sequence[Scored | None]
) -> Comparison:
    """Scores of each generator, and differences of those that both of a pair have."""
    differences: list[Score] = []
    for k, floor in enumerate(floors):
        pairs = [(sets[a][k], sets[b][k]) for a, b in combinations(sets, 2)]
        differences += holm([difference(a, b, floor) for a, b in pairs if a and b])
    return Comparison([s.score for row in sets.values() for s in row if s], differences)


def compare_tmmd(generators: Mapping[str, Any], reference: Any, **options: Any) -> Comparison:
    """As :func:`compare`, TMMD alone.

    With ``kernel=Polynomial()``, ``normalize=False`` and ``preset="paper"`` it is KID, with
    intervals.

    Raises:
        PalpateError: as :func:`compare`.
    """
    reference = feature_set(reference, argument="reference")
    sets = {
        name: [tmmd_of(build_table(of, reference, {**options, "subject": name}))]
        for name, of in same_samples(generators).items()
    }
    return _compared(sets, [None])


def same_samples(generators: Mapping[str, Any]) -> dict[str, FeatureSet]:
    """The generators with their rows in the order of the first.

    Raises:
        PalpateError: if there is none, or if they differ in ids, labels, groups or encoder.
    """
    if not generators:
        must = "must hold a generator"
        raise PalpateError(must, "none", "Pass its features by name", argument="generators")
    sets = {name: feature_set(x) for name, x in generators.items()}
    first = next(iter(sets))
    return {name: _ordered(sets[first], first, x, name) for name, x in sets.items()}


def _ordered(first: FeatureSet, first_name: str, other: FeatureSet, name: str) -> FeatureSet:
    """``other`` in the order of ``first``."""
    a, b = set(first.ids), set(other.ids)
    both = f"{name!r} and {first_name!r}"
    if a != b or not len(a) == len(first.ids) == len(other.ids):
        odd = sorted(a - b) + sorted(b - a)
        named = f", first {odd[0]!r}" if odd else ", repeated ids"
        got = f"{len(a - b)} missing and {len(b - a)} surplus ids{named}"
        fix = "Generate for the same manifest and split"
        raise PalpateError(f"{both} must have the same samples, each once", got, fix)
    require_one_encoder(first, other, both)
    other = other if list(other.ids) == list(first.ids) else other.take(list(first.ids))
    for column in ("labels", "groups"):
        values = [getattr(s, column) for s in (first, other)]
        known = [None if v is None else list(map(str, v)) for v in values]
        if known[0] != known[1]:
            fix = "Take both from one manifest"
            raise PalpateError(f"{both} must have the same {column}", "different ones", fix)
    return other


def difference(a: Scored, b: Scored, floor: Scored | None = None) -> Score:
    """``a - b`` of one metric, with the jackknife of the difference.

    Args:
        a: one generator.
        b: the other.
        floor: real samples, for a metric without a better direction.

    Returns:
        ``details``: ``better`` (a name or None), ``p_better``, ``decided`` (whether
        the interval of what decides excludes 0), ``p_value``, and for metrics without reference
        ``gap``, ``gap_interval`` and ``p_difference``.

    Raises:
        PalpateError: if the two scores are of different settings.
    """
    require_comparable([a.score, b.score])
    use_floor = floor is not None and not not_comparable(a, floor)
    others = [floor] if floor and use_floor else []
    x, y = a.score, b.score
    if x.value is None or y.value is None:
        return _as_difference(x, y, None, {}, note=Note("undefined", {"reason": "score"}))
    value, df = x.value - y.value, len(a.units) - 1
    if not a.units or list(a.units) != list(b.units):
        reason = "different-units" if a.units else "no-units"
        return _as_difference(x, y, value, {}, note=Note("no-interval", {"reason": reason}))
    spread = _spread(value, a.replicates - b.replicates, df)
    interval = spread.interval()
    note = Note("no-interval", {"reason": "no-change"}) if interval is None else None
    unit = x.details.get("left_out", x.details["unit"])
    method = f"paired leave-one-{unit}-out jackknife, t, {df} df" if interval else ""
    p = 2 * min(spread.shares()) if interval else None
    details: dict[str, Any] = {"p_value": p}
    if x.higher_is_better is not None:
        details = _verdict(x, y, spread, interval)
    elif others and others[0].score.value is not None and list(others[0].units) == list(a.units):
        real, center = others[0].replicates, others[0].score.value
        gap = abs(x.value - center) - abs(y.value - center)
        moved = np.abs(a.replicates - real) - np.abs(b.replicates - real)
        of_gap = _spread(gap, moved, df)
        gap_interval = of_gap.interval()
        details = {"gap": gap, "gap_interval": gap_interval, "p_difference": p}
        details |= _verdict(x, y, of_gap, gap_interval)
    return _as_difference(x, y, value, details, note=note, interval=interval, method=method)


def excess_of(result: Scored) -> Scored | None:
    """The between-group excess E of an I- or CI-TMMD as a score; None where there is none.

    It does not depend on the number of groups, and its floor is that of the same classes.
    """
    score, d = result.score, result.score.details
    if d.get("E") is None or score.settings.get("halves") != "group":
        return None
    interval = d.get("E_interval")
    kept = ("unit", "left_out", "units", "backend", "version", "classes", "excluded")
    of_excess = replace(
        score,
        kind="excess",
        value=d["E"],
        interval=tuple(interval) if interval else None,
        null=None,
        interval_method=score.interval_method if interval else "",
        floor=d.get("E_floor"),
        estimator="unbiased",
        seed=None,
        notes=(),
        details={k: d[k] for k in kept if k in d},
    )
    units = result.units if len(result.excess) else ()
    return Scored(of_excess, result.excess, units, groups=result.groups)


def _spread(value: float, replicates: Array, df: int) -> Spread:
    return Spread(value, float(jackknife_errors(replicates[:, None])[0]), df, "")


def _verdict(x: Score, y: Score, spread: Spread, interval: Interval | None) -> dict[str, Any]:
    """Which of two is ahead, by a difference of which 0 is a tie."""
    ahead = spread.value if x.higher_is_better else -spread.value
    better = x.a if ahead > 0 else y.a if ahead < 0 else None
    if interval is None:
        return {"better": better, "p_value": None}
    return {
        "better": better,
        "p_better": spread.shares()[bool(x.higher_is_better)],
        "p_value": 2 * min(spread.shares()),
        "decided": not interval[0] <= 0 <= interval[1],
    }


def _as_difference(
    x: Score,
    y: Score,
    value: float | None,
    details: Mapping[str, Any],
    *,
    note: Note | None = None,
    interval: Interval | None = None,
    method: str = "",
) -> Score:
    empty = {"better": None, "p_better": None, "p_value": None, "decided": False}
    return replace(
        x,
        kind="excess" if x.kind == "excess" else "difference",
        b=y.a,
        value=value,
        interval=interval,
        interval_method=method,
        null=None,
        floor=None,
        details={**empty, **details},
        notes=(note,) if note else (),
    )


def differences_of_means(sets: Mapping[str, Sequence[Mean]]) -> list[Score]:
    """Paired differences of one metric between encoders or splits, each trained with several seeds.

    Args:
        sets: name -> the means of its trainings (one, or one a seed); a group is left out of all at
            once, and the means need not share samples (:mod:`palpate.metrics.means`).

    Returns:
        One score a pair, ``details`` as in :func:`difference`, and ``relative``: (a - b) / a, with
        ``relative_interval``.

    Raises:
        PalpateError: if the scores are of different settings.
    """
    return holm([_difference_of_means(sets[a], sets[b]) for a, b in combinations(sets, 2)])


def _difference_of_means(a: Sequence[Mean], b: Sequence[Mean]) -> Score:
    x, y = a[0].score, b[0].score
    require_comparable([x, y])
    spread = spread_of([a, b], lambda m: m[..., 0] - m[..., 1])
    more: dict[str, Any] = {}
    if min(run.score.value or 0 for run in a) > 0:
        with np.errstate(divide="ignore", invalid="ignore"):  # a mean may be 0 without one group
            relative = spread_of([a, b], lambda m: 1 - m[..., 1] / m[..., 0])
        bounds = relative.interval(high=1.0)
        more = {"relative": relative.value, "relative_interval": bounds}
    return _by_spread(x, y, spread, (-1.0, 1.0), reason="no-change", **more)


def _by_spread(
    x: Score, y: Score, spread: Spread, bounds: Interval, *, reason: str, **more: Any
) -> Score:
    """The difference with the interval of a spread; ``reason`` where there is none."""
    interval = spread.interval(*bounds)
    return _as_difference(
        x,
        y,
        spread.value,
        {**_verdict(x, y, spread, interval), **more},
        note=None if interval else Note("no-interval", {"reason": reason}),
        interval=interval,
        method=f"paired, {spread.method}" if interval else "",
    )


def mean_differences(
    scores: Mapping[str, Score], values: Mapping[str, Array], groups: Sequence[str] | None
) -> list[Score]:
    """Paired differences of a metric that is a mean over images; notes are of the difference alone.

    ``values`` (n,) of each generator go image by image in one order; pairs of which one is not
    finite are skipped.

    Raises:
        PalpateError: if the scores are of different settings.
    """
    pairs = [(scores[a], scores[b], values[a] - values[b]) for a, b in combinations(scores, 2)]
    return holm([_mean_difference(*pair, groups) for pair in pairs])


def _mean_difference(x: Score, y: Score, delta: Array, groups: Sequence[str] | None) -> Score:
    require_comparable([x, y])
    finite = np.isfinite(delta)
    if not finite.any():
        return _as_difference(x, y, None, {}, note=Note("undefined", {"reason": "no-images"}))
    names = None if groups is None else list(np.asarray(groups)[finite])
    spread = spread_of_values(delta[finite], names)
    return _by_spread(x, y, spread, (-np.inf, np.inf), reason="few-images")


def holm(differences: Sequence[Score]) -> list[Score]:
    """The differences of one metric with ``p_adjusted``, by Holm's step-down method."""
    p = {k: d.details["p_value"] for k, d in enumerate(differences)}
    known = sorted((k for k in p if p[k] is not None), key=lambda k: p[k])
    each = [min(1.0, (len(known) - rank) * p[k]) for rank, k in enumerate(known)]
    adjusted = dict(zip(known, accumulate(each, max), strict=True))
    return [
        replace(d, details={**d.details, "p_adjusted": adjusted.get(k)})
        for k, d in enumerate(differences)
    ]
