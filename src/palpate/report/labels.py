"""Words for people: names of scores, and numbers with the decimals that their intervals warrant.

Every front end writes by these. Nothing else joins the fields of a score, and nothing takes a name
apart.
"""

from __future__ import annotations

import itertools
import math
import re
import statistics
from collections.abc import Iterable, Sequence

from palpate.core import Measure, Note, SampleRef, Score


def measured(score: Score | Measure) -> str:
    """Return what is measured, as the head of a column says it; of a difference what both are.

    ``FID (Inception)``, ``TMMD (σ median)``, ``I-TMMD E``, ``top-5 of 480 (text by tactile)``.
    """
    measure = score.measure if isinstance(score, Score) else score
    pool = score.settings.get("pool") if isinstance(score, Score) else None
    name = measure.metric + (f" of {pool}" if pool else "") + " E" * measure.excess
    return name + "".join(f" ({field})" for field in (measure.features, measure.kernel) if field)


def label_of(score: Score) -> str:
    """Return what a score is: of a comparison ``TMMD difference``, ``effect size of TMMD``."""
    name = measured(score)
    if score.b is None:
        return name
    if score.kind == "effect size":
        return f"effect size of {name}"
    return f"{name}, ahead" if score.kind == "lead" else f"{name} difference"


def subject_of(score: Score) -> str:
    """Return what was scored, as the head of its row says it: ``ours``, ``ours - GVST``."""
    if score.b is None:
        return score.a
    return f"{score.a} {'against' if score.kind == 'lead' else '-'} {score.b}"


def count(value: int | None) -> str:
    """Return a whole number with comma thousands; a dash for None."""
    return "–" if value is None else f"{value:,}"


def percent(fraction: float) -> str:
    """Return a fraction in [0, 1] in percent, never rounded to 0 % or 100 %."""
    if not math.isfinite(fraction):
        return "–"
    if 0 < fraction < 0.0001:
        return "< 0.01 %"
    if 0.9999 < fraction < 1:
        return "> 99.99 %"
    if fraction in (0, 1):
        return f"{100 * fraction:.0f} %"
    return f"{100 * fraction:.{1 if 0.01 <= fraction < 0.99 else 2}f} %"


def decimals(values: Iterable[float]) -> int:
    """Return the decimals that give the largest of ``values`` three or four digits."""
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if largest == 0:
        return 1
    power = math.floor(math.log10(largest))
    return max(0, min(8, 3 - max(0, power) if largest >= 0.1 else 2 - power))


def digits_of(scores: Iterable[Score], *, finest: bool = False) -> int:
    """Return the decimals of scores that are written in one way, those of a column or one alone.

    The median interval gets two digits for its half, so that one that is narrow does not lengthen
    all others, and no limit is written as the 0 that it excludes; with ``finest`` the narrowest
    one. The largest number has at most five. None of ranks and counts. Every front end rounds by
    this.
    """
    scores = list(scores)
    values = [abs(float(s)) for s in scores if s.value is not None]
    intervals = [s.interval for s in scores if s.interval]
    halves = [half for low, high in intervals if (half := (high - low) / 2) > 0]
    largest = max(values, default=0.0)
    if not halves:
        integers = not intervals and largest > 1 and all(v == round(v) for v in values)
        return 0 if integers else decimals([*values, *(v for pair in intervals for v in pair)])
    digits, most = (
        1 - math.floor(math.log10(half)) for half in (statistics.median_low(halves), min(halves))
    )
    limits = [min(map(abs, pair)) for pair in intervals if pair[0] * pair[1] > 0]
    while digits < most and any(round(limit, digits) == 0 for limit in limits):
        digits += 1
    room = 4 - math.floor(math.log10(largest)) if largest else most
    return max(0, min(8, most if finest else digits, room))


def p_text(p: float | None) -> str:
    """Return a p-value in words for every front end; '' for None."""
    return "" if p is None else "< 0.001" if p < 0.001 else f"{p:.3g}"


def number(value: float | None, digits: int | None = None) -> str:
    """Return a number with ``digits`` decimals, by default those of :func:`decimals`."""
    if value is None or not math.isfinite(value):
        return "–"
    digits = decimals([value]) if digits is None else digits
    return f"{value:z,.{digits}f}".replace("-", "−")


def interval(pair: Sequence[float] | None, digits: int) -> str:
    """Return ``"[1.01, 1.75]"``; '' for None."""
    return f"[{', '.join(number(v, digits) for v in pair)}]" if pair else ""


def with_interval(score: Score, digits: int) -> str:
    """Return ``"1.37 [1.01, 1.75]"``, or ``"undefined"``."""
    if score.value is None:
        return "undefined"
    return f"{number(score.value, digits)} {interval(score.interval, digits)}".rstrip()


def score_text(value: float) -> str:
    """Return a score in [0, 1] with three decimals, or as many as distinguish it from 1."""
    if not math.isfinite(value):
        return "–"
    digits = next((d for d in range(3, 9) if f"{value:.{d}f}" != f"{1:.{d}f}"), 9)
    return f"{value:.{3 if value >= 1 else digits}f}"


def plural(n: int, singular: str) -> str:
    """Return ``"1 video"``, ``"1,234 videos"``."""
    return f"{n:,} {singular}{'s' * (n != 1)}"


def where(sample: SampleRef) -> str:
    """Return ``"video, frame 12"``, or the id where the sample has no video."""
    if sample.video is None:
        return sample.id
    return sample.video if sample.frame is None else f"{sample.video}, frame {sample.frame}"


def confidence(share: float) -> str:
    """A share in [0, 1] in percent, never rounded to certainty."""
    return "> 99.9 %" if share > 0.999 else "< 0.1 %" if share < 0.001 else f"{100 * share:.1f} %"


def file_names(kind: str, titles: Sequence[str]) -> list[str]:
    """Return a name for each file: its kind and title in a short form, and a number if needed."""
    names: list[str] = []
    for title in titles:
        words = re.sub("[^a-z0-9]+", "-", title.lower()).strip("-")[:48].strip("-")
        name = words if words.startswith(f"{kind}-") else f"{kind}-{words}".strip("-")
        same = itertools.chain([name], (f"{name}-{k}" for k in itertools.count(2)))
        names.append(next(n for n in same if n not in names))
    return names


def verdict_of_two(names: Iterable[str], scores: Sequence[Score]) -> list[Note]:
    """Which of two is better by which metrics, from their paired differences; of three, tables rank
    them.
    """
    a, b = names
    better: dict[str, list[str]] = {a: [], b: [], "": []}
    for d in scores:
        if d.b is not None and d.value is not None and d.details.get("better"):
            winner = d.details["better"] if d.details.get("decided") else ""
            every = [name for names in better.values() for name in names]
            better[winner] += [measured(d)] * (measured(d) not in every)
    params = {"a": a, "b": b, "by_a": better[a], "by_b": better[b], "open": better[""]}
    return [Note("verdict-of-two", params)] if any(better.values()) else []
