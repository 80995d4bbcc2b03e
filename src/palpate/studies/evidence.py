"""Paired differences of a study as evidence: over seeds, between splits, and who is ahead by them.

Limits are combined by recovery of variances (MOVER; Zou and Donner, 2008): with a_i in [l_i, u_i],
the lower limit of ``sum a_i`` is ``sum a_i - sqrt(sum (a_i - l_i)^2)``, the upper one alike. Of S
seeds the mean counts, with ``reach^2 = mean_s (v_s - l_s)^2 + (t(S-1) s / sqrt(S))^2``: the seeds
share their test videos, so the first term does not shrink with S; s is the deviation between seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from palpate.core import PalpateError, Score
from palpate.report.notes import decimals, number

#: End of the metric of every difference.
DIFFERENCE = " difference"


def over_seeds(scores: Sequence[Score]) -> Score:
    """One score of several seeds' scores of one metric and subject, at the head of this file.

    Returns:
        The mean; ``details["by_seed"]`` has the values. Value or interval is None if one of the
        seeds has none. A single seed is returned as it is, but for ``by_seed``.

    Raises:
        PalpateError: without scores, or if metrics or subjects differ.
    """
    if len(kinds := {(s.metric, s.subject) for s in scores}) != 1:
        got = ", ".join(f"{m} of {s}" for m, s in sorted(kinds)) or "none"
        fix = "Pass one score a seed"
        raise PalpateError("Scores over seeds must be of one metric and subject", got, fix)
    first, values = scores[0], [s.value for s in scores]
    details = {**first.details, "by_seed": values}
    known = [v for v in values if v is not None]
    if len(known) < len(values):
        return replace(first, value=None, interval=None, interval_method="", details=details)
    if len(values) == 1:
        return replace(first, details=details)
    mean, count = float(np.mean(known)), len(known)
    between = float(special.stdtrit(count - 1, 0.5 + first.level / 2))
    between *= float(np.std(known, ddof=1)) / np.sqrt(count)
    reaches = [reach for s in scores if (reach := _reach(s))]
    if len(reaches) < count:
        return replace(first, value=mean, interval=None, interval_method="", details=details)
    low, high = np.sqrt(np.mean(np.square(reaches), axis=0) + between**2)
    return replace(
        first,
        value=mean,
        interval=(mean - float(low), mean + float(high)),
        interval_method=f"limits of {count} seeds and their deviation, by recovery of variances",
        seed=None,
        encoder=first.encoder if len({s.encoder for s in scores}) == 1 else None,
        details=details,
    )


def difference_between(a: Sequence[Score], b: Sequence[Score], names: tuple[str, str]) -> Score:
    """``a - b`` of one metric on two splits, one score a seed each; limits taken as independent.

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
    if x.metric != y.metric:
        must, fix = "A difference must be of one metric", "Pair scores by their metric"
        raise PalpateError(must, f"{x.metric} and {y.metric}", fix)
    value = None if x.value is None or y.value is None else x.value - y.value
    interval, of_x, of_y = None, _reach(x), _reach(y)
    if value is not None and of_x and of_y:
        (low_a, high_a), (low_b, high_b) = of_x, of_y
        interval = (value - float(np.hypot(low_a, high_b)), value + float(np.hypot(high_a, low_b)))
    return replace(
        x,
        metric=x.metric + DIFFERENCE,
        subject=" - ".join(names),
        value=value,
        interval=interval,
        interval_method="recovery of variances, splits as independent" if interval else "",
        null=None,
        floor=None,
        split=None,
        reference=None,
        details={"a": names[0], "b": names[1], "values": [x.value, y.value]},
    )


def _reach(score: Score) -> tuple[float, float] | None:
    """How far the limits lie below and above the value."""
    if score.value is None or score.interval is None:
        return None
    return score.value - score.interval[0], score.interval[1] - score.value


def metric_of(difference: Score) -> str:
    """The metric that a difference is of."""
    return difference.metric.removesuffix(DIFFERENCE)


def ahead(difference: Score, name: str) -> Score:
    """By how much ``name`` is better in a difference of two; below 0 where the other one is.

    Metrics of which closer to the floor is better (I-, CI- and D-TMMD) count by
    ``details["gap"]``, the difference of the distances to the floor, and without a floor as in the
    paper, where lower is better.

    Raises:
        PalpateError: if the difference is not between ``name`` and another one.
    """
    pair = difference.details.get("a"), difference.details.get("b")
    if name not in pair:
        must, fix = f"A difference must be between {name!r} and another", "Check the names"
        raise PalpateError(must, difference.subject, fix)
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
        metric=f"{metric_of(difference)}, ahead",
        subject=f"{name} against {other}",
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
    digits = decimals([score.value, *score.interval])
    value, low, high = (number(v, digits) for v in (score.value, *score.interval))
    return f"{value} [{low}, {high}]"
