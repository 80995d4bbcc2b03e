"""Paired differences of a study as evidence: over seeds, between splits, and who is ahead by them.

Limits are combined by recovery of variances (MOVER; Zou and Donner, 2008): with a_i in [l_i, u_i],
the lower limit of ``sum a_i`` is ``sum a_i - sqrt(sum (a_i - l_i)^2)``, the upper one alike. Of S
seeds the mean counts, with ``reach^2 = mean_s (v_s - l_s)^2 + (t(S-1) s / sqrt(S))^2``: the seeds
share their test videos, so the first term does not shrink with S; s is the deviation between seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from palpate.core import Note, Score, plain, require
from palpate.report.labels import digits_of, label_of, measured, number, subject_of, with_interval


def over_seeds(scores: Sequence[Score]) -> Score:
    """One score of several seeds' scores of one measure and subject, at the head of this file.

    Returns:
        The mean; ``details["by_seed"]`` has the values. Value or interval is None if one of the
        seeds has none. Of details remain those that all seeds share, the mean of the matrix, and
        that of the gap (:func:`difference_between`); the null, p-values and verdicts of single
        seeds do not. A single seed is returned as it is, but for ``by_seed``.

    Raises:
        PalpateError: without scores, or if metrics or subjects differ.
    """
    kinds, fix = {f"{label_of(s)} of {subject_of(s)}" for s in scores}, "Pass one score a seed"
    must, got = "Scores over seeds must be of one metric and subject", ", ".join(sorted(kinds))
    require(len(kinds) == 1, None, must, got or "none", fix=fix)
    first, values = scores[0], [s.value for s in scores]
    if len(values) == 1:
        return replace(first, details={**first.details, "by_seed": values})
    details = {**_shared_details(scores), "by_seed": values}
    if all("gap" in s.details for s in scores):
        gaps = ((s.details["gap"], s.details.get("gap_interval")) for s in scores)
        gap = over_seeds([replace(first, value=v, interval=i, details={}) for v, i in gaps])
        details |= {"gap": gap.value, "gap_interval": gap.interval}
    notes = list[Note]()
    for score in scores:
        notes += [note for note in score.notes if note not in notes]
    encoder = first.encoder if len({s.encoder for s in scores}) == 1 else None
    first = replace(first, null=None, seed=None, notes=notes, encoder=encoder)
    means = [value for value in values if value is not None]
    mean, count = float(np.mean(means)) if len(means) == len(values) else None, len(values)
    reaches = [reach for s in scores if (reach := _reach(s))]
    if mean is None or len(reaches) < count:
        return replace(first, value=mean, interval=None, interval_method="", details=details)
    between = float(scipy.special.stdtrit(count - 1, 0.5 + first.level / 2))
    between *= float(np.std(means, ddof=1)) / np.sqrt(count)
    low, high = np.sqrt(np.mean(np.square(reaches), axis=0) + between**2)
    return replace(
        first,
        value=mean,
        interval=(mean - float(low), mean + float(high)),
        interval_method=f"limits of {count} seeds and their deviation, by recovery of variances",
        details=details,
    )


#: Details that judge one seed.
_OF_ONE = ("p_value", "p_better", "p_adjusted", "p_difference", "better", "decided", "units")


def _shared_details(scores: Sequence[Score]) -> dict[str, Any]:
    """Details that are the same for all seeds, and the mean of a matrix of one set of classes."""
    each: list[Any] = [plain(s.details) for s in scores]
    shared = {
        key: value
        for key, value in scores[0].details.items()
        if key not in _OF_ONE and all(key in e and e[key] == each[0][key] for e in each)
    }
    matrices = [e.get("matrix") for e in each]
    if all(matrices) and all(e.get("classes") == each[0].get("classes") for e in each):
        shared["matrix"] = np.mean(np.array(matrices, dtype=float), axis=0).tolist()
    return shared


def difference_between(a: Sequence[Score], b: Sequence[Score], names: tuple[str, str]) -> Score:
    """``a - b`` of one metric on two splits, one score a seed each; limits taken as independent.

    Of metrics of which closer to the floor is better, ``details["gap"]`` is the difference of the
    distances ``|score - floor|``, each to the floor of its split, which is taken as known.

    Test parts of two splits share videos, which makes scores agree: the interval errs on the wide
    side.

    Args:
        a: scores under the first split.
        b: scores under the second one.
        names: of the splits.

    Raises:
        PalpateError: as :func:`over_seeds`, or if the two differ in metric.
    """
    x, y = over_seeds(a), over_seeds(b)
    must, got = "A difference must be of one metric", f"{measured(x)} and {measured(y)}"
    require(x.measure == y.measure, None, must, got, fix="Pair scores by their metric")
    value = None if x.value is None or y.value is None else x.value - y.value
    interval = _limits_of_difference(x, y)
    gap: dict[str, Any] = {}
    if x.higher_is_better is None and all(s.floor is not None for s in (*a, *b)):
        near, far = (over_seeds([_to_floor(s) for s in scores]) for scores in (a, b))
        if near.value is not None and far.value is not None:
            limits = _limits_of_difference(near, far)
            gap = {"gap": near.value - far.value, "gap_interval": limits}
    return replace(
        x,
        kind="difference",
        a=names[0],
        b=names[1],
        value=value,
        interval=interval,
        interval_method="recovery of variances, splits as independent" if interval else "",
        null=None,
        floor=None,
        split=None,
        reference=None,
        details={"values": [x.value, y.value], **gap},
    )


def _limits_of_difference(x: Score, y: Score) -> tuple[float, float] | None:
    """Limits of ``x - y``; None if one of the two has none."""
    of_x, of_y = _reach(x), _reach(y)
    if x.value is None or y.value is None or of_x is None or of_y is None:
        return None
    (low_a, high_a), (low_b, high_b), value = of_x, of_y, x.value - y.value
    return value - float(np.hypot(low_a, high_b)), value + float(np.hypot(high_a, low_b))


def _to_floor(score: Score) -> Score:
    """The distance to the floor, as a score."""
    if score.value is None or score.floor is None:
        return score
    above, reach = score.value >= score.floor, _reach(score)
    distance = abs(score.value - score.floor)
    low, high = (reach if above else reach[::-1]) if reach else (0.0, 0.0)
    interval = (distance - low, distance + high) if reach else None
    return replace(score, value=distance, interval=interval)


def _reach(score: Score) -> tuple[float, float] | None:
    """How far the limits lie below and above the value."""
    if score.value is None or score.interval is None:
        return None
    return score.value - score.interval[0], score.interval[1] - score.value


def ahead(difference: Score, name: str) -> Score:
    """By how much ``name`` is better in a difference of two; below 0 where the other one is.

    Metrics of which closer to the floor is better (I-, CI- and D-TMMD) count by
    ``details["gap"]``, the difference of the distances to the floor, and without a floor as in the
    paper, where lower is better.

    Raises:
        PalpateError: if the difference is not between ``name`` and another one.
    """
    pair, fix = (difference.a, difference.b), "Check the names"
    must = f"A difference must be between {name!r} and another"
    require(name in pair, None, must, subject_of(difference), fix=fix)
    value, interval = difference.value, difference.interval
    if difference.higher_is_better is None and "gap" in difference.details:
        value = difference.details["gap"]
        interval = difference.details.get("gap_interval")
    if (name == pair[0]) != bool(difference.higher_is_better):
        value = None if value is None else -value
        interval = interval and (-interval[1], -interval[0])
    other = pair[1] if name == pair[0] else pair[0]
    return replace(
        difference,
        kind="lead",
        a=name,
        b=other,
        value=value,
        interval=interval and (float(interval[0]), float(interval[1])),
        higher_is_better=True,
    )


def side_of(score: Score) -> int:
    """1 or -1 where the interval lies above or below 0; 0 where it holds 0 or there is none."""
    if score.value is None or score.interval is None:
        return 0
    return int(score.interval[0] > 0) - int(score.interval[1] < 0)


def in_words(score: Score) -> str:
    """The number with its interval, rounded as on the page: ``0.610 [0.300, 0.920]``."""
    if score.value is None:
        return "undefined"
    if score.interval is None:
        return f"{number(score.value)} (no interval)"
    return with_interval(score, digits_of([score]))
