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
from typing import Any, Unpack

import numpy as np

from palpate.core import FeatureSet, Note, Score, require, require_comparable
from palpate.core.features import Array
from palpate.metrics.inputs import feature_sets, require_one_encoder, require_same_ids
from palpate.metrics.intervals import Interval, Scored, Spread, spread_of_values
from palpate.metrics.means import Mean, spread_of
from palpate.metrics.mmd import Settings, build_table, shared_ids
from palpate.metrics.tactile import ci_tmmd_of, d_tmmd_of, i_tmmd_of, tmmd_of

#: Designs that differ by less have one floor: the change is far below the noise of any floor.
SAME_DESIGN = 0.01


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


def four_scores(
    generated: Any, reference: Any, *, floor: Any = None, **options: Unpack[Settings]
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
    x, y = feature_sets(generated=generated, reference=reference)
    subject = options.pop("subject", "generated")
    scores, _ = _four_of_each({subject: x}, y, floor, options)
    return [result.score for result in scores[subject]]


#: The metrics of one set alone, from a table.
FREE = (i_tmmd_of, ci_tmmd_of, d_tmmd_of)


def _four_of_each(
    sets: Mapping[str, FeatureSet], reference: FeatureSet, floor: Any, options: Mapping[str, Any]
) -> tuple[dict[str, list[Scored]], list[Scored | None]]:
    """The four metrics of each set in the order of the paper, and those of the floor."""
    scores = {name: _four(s, reference, {**options, "subject": name}) for name, s in sets.items()}
    if floor is None:
        return scores, [None] * 4
    (floor,), first = feature_sets(floor=floor), next(iter(sets.values()))
    require_one_encoder(first, floor, "Generated and floor")
    must, got = "The floor must be scored like the generated samples", "groups in one of the two"
    same = (floor.groups is None) == (first.groups is None)
    require(same, None, must, got, fix="Give groups to both, or to none")
    table = build_table(floor, None, options, median_of=reference)
    real = [metric(table) for metric in FREE]
    floored = {n: [tmmd, *map(with_floor, free, real)] for n, (tmmd, *free) in scores.items()}
    return floored, [None, *real]


def _four(generated: FeatureSet, reference: FeatureSet, options: Mapping[str, Any]) -> list[Scored]:
    table = build_table(generated, reference, options)
    first = tmmd_of(table)
    alone = generated.groups is None and not shared_ids(generated, reference)
    if not (table.grouped or alone):  # else the other three have the same units and options
        table = build_table(generated, None, options, median_of=reference)
    return [first, *(metric(table) for metric in FREE)]


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
    generators: Mapping[str, Any], reference: Any, *, floor: Any = None, **options: Unpack[Settings]
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
    (reference,) = feature_sets(reference=reference)
    scores, floors = _four_of_each(same_samples(generators), reference, floor, options)
    return compared({n: _with_excess(s) for n, s in scores.items()}, _with_excess(floors))


def _with_excess(four: Sequence[Scored | None]) -> list[Scored | None]:
    """TMMD, I- and CI-TMMD, each followed by its E, and D-TMMD."""
    return [x for s in four for x in (s, s and excess_of(s))]


def compared(
    sets: Mapping[str, Sequence[Scored | None]], floors: Sequence[Scored | None] = (None,)
) -> Comparison:
    """Scores of each generator, and differences of those that both of a pair have."""
    differences: list[Score] = []
    for k, floor in enumerate(floors):
        pairs = [(sets[a][k], sets[b][k]) for a, b in combinations(sets, 2)]
        differences += holm([difference(a, b, floor) for a, b in pairs if a and b])
    return Comparison([s.score for row in sets.values() for s in row if s], differences)


def compare_tmmd(
    generators: Mapping[str, Any], reference: Any, **options: Unpack[Settings]
) -> Comparison:
    """As :func:`compare`, TMMD alone.

    With ``kernel=Polynomial()``, ``normalize=False`` and ``preset="paper"`` it is KID, with
    intervals.

    Raises:
        PalpateError: as :func:`compare`.
    """
    (reference,) = feature_sets(reference=reference)
    sets = same_samples(generators)
    return compared(
        {
            name: [tmmd_of(build_table(features, reference, {**options, "subject": name}))]
            for name, features in sets.items()
        }
    )


def same_samples(generators: Mapping[str, Any]) -> dict[str, FeatureSet]:
    """The generators with their rows in the order of the first.

    Raises:
        PalpateError: if there is none, or if they differ in ids, labels, groups or encoder.
    """
    must, fix = "must hold a generator", "Pass its features by name"
    require(len(generators) > 0, "generators", must, "none", fix=fix)
    sets = {name: feature_sets(generated=x)[0] for name, x in generators.items()}
    first = next(iter(sets))
    return {name: _ordered(sets[first], first, x, name) for name, x in sets.items()}


def _ordered(first: FeatureSet, first_name: str, other: FeatureSet, name: str) -> FeatureSet:
    """``other`` in the order of ``first``."""
    names = repr(first_name), repr(name)
    require_same_ids(first.ids, other.ids, names)
    both = " and ".join(names)
    require_one_encoder(first, other, both)
    other = other if list(other.ids) == list(first.ids) else other.take(list(first.ids))
    for column in ("labels", "groups"):
        values = [getattr(s, column) for s in (first, other)]
        texts = [None if v is None else list(map(str, v)) for v in values]
        must, same = f"{both} must have the same {column}", texts[0] == texts[1]
        require(same, None, must, "different ones", fix="Take both from one manifest")
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
    x, y = a.score, b.score
    require_comparable([x, y])
    if x.value is None or y.value is None:
        return _paired(x, y, None, {}, "score")
    if not a.units or list(a.units) != list(b.units):
        reason = "different-units" if a.units else "no-units"
        return _paired(x, y, Spread(x.value - y.value, np.nan, 0, ""), {}, reason)
    unit = x.details.get("left_out", x.details["unit"])
    spread = Spread.of(x.value - y.value, a.replicates - b.replicates, unit)
    p = 2 * min(spread.shares()) if spread.known else None
    details: dict[str, Any] = {"p_value": p}
    if x.higher_is_better is not None:
        details = _verdict(x, y, spread)
    elif floor and floor.score.value is not None and not not_comparable(a, floor):
        center, real = floor.score.value, floor.replicates
        if list(floor.units) == list(a.units):
            moved = np.abs(a.replicates - real) - np.abs(b.replicates - real)
            gap = Spread.of(abs(x.value - center) - abs(y.value - center), moved)
            details = {"gap": gap.value, "gap_interval": gap.interval(), "p_difference": p}
            details |= _verdict(x, y, gap)
    return _paired(x, y, spread, details, "no-change")


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


def _verdict(x: Score, y: Score, spread: Spread) -> dict[str, Any]:
    """Which of two is ahead, by a difference of which 0 is a tie."""
    ahead = spread.value if x.higher_is_better else -spread.value
    better = x.a if ahead > 0 else y.a if ahead < 0 else None
    if (interval := spread.interval()) is None:
        return {"better": better, "p_value": None}
    return {
        "better": better,
        "p_better": spread.shares()[bool(x.higher_is_better)],
        "p_value": 2 * min(spread.shares()),
        "decided": not interval[0] <= 0 <= interval[1],
    }


def _paired(
    x: Score,
    y: Score,
    spread: Spread | None,
    details: Mapping[str, Any],
    reason: str,
    *,
    bounds: Interval = (-np.inf, np.inf),
) -> Score:
    """The difference of two scores; ``reason`` why it has no interval, or, without a spread, no
    value.
    """
    empty = {"better": None, "p_better": None, "p_value": None, "decided": False}
    interval = spread.interval(*bounds) if spread else None
    note = Note("no-interval" if spread else "undefined", {"reason": reason})
    return replace(
        x,
        kind="excess" if x.kind == "excess" else "difference",
        b=y.a,
        value=spread.value if spread else None,
        interval=interval,
        interval_method=f"paired {spread.method}" if spread and interval else "",
        null=None,
        floor=None,
        details={**empty, **details},
        notes=() if interval else (note,),
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
    details = _verdict(x, y, spread)
    if min(run.score.value or 0 for run in a) > 0:
        with np.errstate(divide="ignore", invalid="ignore"):  # a mean may be 0 without one group
            relative = spread_of([a, b], lambda m: 1 - m[..., 1] / m[..., 0])
        details |= {"relative": relative.value, "relative_interval": relative.interval(high=1.0)}
    return _paired(x, y, spread, details, "no-change", bounds=(-1.0, 1.0))


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
        return _paired(x, y, None, {}, "no-images")
    names = None if groups is None else list(np.asarray(groups)[finite])
    spread = spread_of_values(delta[finite], names)
    verdict = {} if x.higher_is_better is None else _verdict(x, y, spread)
    return _paired(x, y, spread, verdict, "few-images")


def holm(differences: Sequence[Score]) -> list[Score]:
    """The differences of one metric with ``p_adjusted``, by Holm's step-down method."""
    p = {k: d.details["p_value"] for k, d in enumerate(differences)}
    tested = sorted((k for k in p if p[k] is not None), key=lambda k: p[k])
    each = [min(1.0, (len(tested) - rank) * p[k]) for rank, k in enumerate(tested)]
    adjusted = dict(zip(tested, accumulate(each, max), strict=True))
    return [
        replace(d, details={**d.details, "p_adjusted": adjusted.get(k)})
        for k, d in enumerate(differences)
    ]
