"""The paper's claims as rows: evidence over seeds and videos, a verdict, and why.

A claim *holds* where the intervals of its evidence lie on its side of 0, *does not hold* where they
lie on the other, and is *undecided* where they hold 0, contradict each other, or evidence is
missing (weights of LPIPS, a human study). "Prefers" is always a paired difference on the same test
samples, oriented by the metric (:func:`palpate.studies.evidence.ahead`).

Effect size of a metric for two methods: ``|difference| / standard error``, with the standard error
from the interval, ``(high - low) / (2 * 1.96)``. It is a difference in units of its error, so its
error is 1, and a mean of effects of correlated metrics has an error of at most 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from statistics import fmean

import numpy as np
import scipy

from palpate.core import Measure, Score
from palpate.report.labels import measured, number
from palpate.report.records import Claim, StudyTable, Verdict
from palpate.studies.evidence import ahead, in_words, side_of
from palpate.studies.names import BACKGROUND, GVST, NOLEAK, ORIG, OURS

#: Metrics that compare pixels, or features of networks trained on photos (paper, table 3).
TRADITIONAL = ("SSIM", "PSNR", "LPIPS", "FID", "CMMD")
#: Metrics on features of a tactile encoder (paper, Eq. 2-7).
FAMILY = ("TMMD", "I-TMMD", "CI-TMMD", "D-TMMD")
#: Features of a tactile encoder: none of the paper's traditional metrics are computed on them.
TACTILE = "tactile"
PEOPLE = "human preference"
#: How to read a lead.
BEHIND = "below 0: behind"
#: The 97.5 % point of the normal distribution.
Z = float(scipy.special.ndtri(0.975))


#: The paper's comparisons, its method first: with trainings on images, then with the no-contact
#: image as a further condition.
Pairs = Sequence[tuple[str, str]]
PAIRS: Pairs = ((OURS, GVST), (OURS, BACKGROUND))


def decide(sides: Sequence[int], *, every: bool = False) -> Verdict:
    """The verdict of evidence for (1), against (-1) and undecided (0).

    It holds with some evidence for and none against; ``every``: with all for. It does not hold with
    some against and none for; ``every``: with any against.
    """
    if -1 in sides and (every or 1 not in sides):
        return "does not hold"
    if sides and -1 not in sides and (0 not in sides if every else 1 in sides):
        return "holds"
    return "undecided"


def leak_claims(tasks: Mapping[str, Score]) -> list[Claim]:
    """Leakage inflates every task: one row for all with a better direction, and one a task.

    I-, CI- and D-TMMD have none: leaks inflate them if they bring images closer to their floor.

    Args:
        tasks: task -> paired difference of its score between the data set's own split and the
            leak-free one, of :func:`palpate.studies.evidence.difference_between` or of
            :func:`palpate.studies.split_study.compare_splits`.
    """
    gains = {task: ahead(difference, ORIG) for task, difference in tasks.items()}
    source, rows = "paper, tables 1 and 2", list[Claim]()
    for task, gain in gains.items():
        lead = f"Lead of {ORIG} over {NOLEAK} in {measured(gain)}"
        why = f"{lead} ({BEHIND}): {in_words(gain)}{_runs(gain)}."
        verdict, numbers = decide([side_of(gain)]), gain.interval is not None
        rows.append(Claim(f"Leakage inflates {task}", source, verdict, why, [gain], numbers))
    directed = [g for task, g in gains.items() if tasks[task].higher_is_better is not None]
    sides = [side_of(gain) for gain in directed]
    counts = f"{sides.count(1)} of {len(sides)} tasks inflated, {sides.count(-1)} deflated"
    why = f"{counts}, {sides.count(0)} with an interval that holds 0 or is missing."
    verdict, numbers = decide(sides, every=True), any(gain.interval for gain in directed)
    return [Claim("Leakage inflates every task", source, verdict, why, directed, numbers), *rows]


def _runs(score: Score) -> str:
    """The number of seeds in brackets, where it is known."""
    count = len(score.details.get("by_seed", ()))
    return f" ({count} seed{'s' * (count != 1)})" if count else ""


def _of_metric(metric: str, difference: Score) -> bool:
    """Whether a difference is of one of the paper's metrics, on features it may be called after."""
    measure = difference.measure
    usual = not measure.kernel and not measure.excess and measure.features != TACTILE
    return measure.metric == metric and usual


def _leads_of(scores: Iterable[Score], metric: str, front: str, other: str) -> list[Score]:
    """Differences of a metric between two methods, as leads of the first."""
    between = (d for d in scores if {d.a, d.b} == {front, other} and _of_metric(metric, d))
    return [ahead(d, front) for d in between]


def preference_claims(
    differences: Sequence[Score], people: Sequence[Score], pairs: Pairs = PAIRS
) -> list[Claim]:
    """Which metrics prefer what people prefer: one row a metric, over the paper's two comparisons.

    Args:
        differences: of methods, each over its seeds.
        people: scores of ``palpate preference score`` (``Results.load(path).scores``); empty
            without a human study, and then every row is undecided.
        pairs: of methods.
    """
    claims = list[Claim]()
    for metric in (*TRADITIONAL, *FAMILY):
        against = metric in TRADITIONAL
        does = "prefers what people do not" if against else "prefers what people prefer"
        leads, votes, signs = list[Score](), list[Score](), list[int]()
        for pair in pairs:
            scores = _leads_of(differences, metric, *pair)
            of_people = _leads_of(people, PEOPLE, *pair)
            signs += [side_of(score) * side_of(vote) for score in scores for vote in of_people]
            leads, votes = leads + scores, votes + of_people
        parts = [_leads(leads), _leads(votes)]
        if not leads:
            parts[0] = f"{metric} was not computed (its weights may be missing)"
        if not votes:
            compared = any(score.b is not None for score in people)
            parts[1] = "no human study was given"
            if compared:
                parts[1] = "the human study compared other methods"
        verdict = decide([-sign if against else sign for sign in signs])
        why = "; ".join(parts)
        why, evidence = f"{why[0].upper()}{why[1:]}.", [*leads, *votes]
        source = "paper, table 3"
        claims.append(Claim(f"{metric} {does}", source, verdict, why, evidence, bool(signs)))
    return claims


def _leads(scores: Sequence[Score]) -> str:
    """``lead by TMMD (below 0: behind): of Ours over GVST 0.6 [0.3, 0.9], over X 1 [0.5, 1.5]``."""
    if not scores:
        return ""
    parts: list[str] = []
    for front, same in groupby(scores, key=lambda s: s.a):
        each = [f"over {s.b} {in_words(s)}" for s in same]
        parts.append(f"of {front} {', '.join(each)}")
    return f"lead by {measured(scores[0])} ({BEHIND}): {'; '.join(parts)}"


def ranking_claims(
    differences: Sequence[Score], people: Sequence[Score] = (), pairs: Pairs = PAIRS
) -> list[Claim]:
    """Text as a bridge beats images; conditioning on the background hurts.

    TMMD and, if given, people decide; I-, CI- and D-TMMD, which say how images vary and not how
    close they are, are listed as evidence alone.
    """
    claims = list[Claim]()
    for pair in pairs:
        front, other = pair
        claim, source = f"Text as a bridge beats images ({other})", "paper, tables 3 and 4"
        if pair == pairs[-1]:
            claim, source = "Conditioning on the background hurts", "paper, table 3"
        votes = _leads_of(people, PEOPLE, *pair)
        deciding = [*_leads_of(differences, "TMMD", *pair), *votes]
        spread = [s for metric in FAMILY[1:] for s in _leads_of(differences, metric, *pair)]
        why = f"{other} was not compared with {front}"
        if scores := [*deciding, *spread]:
            each = ", ".join(f"{measured(s)} {in_words(s)}" for s in scores)
            why = f"Lead of {front} over {other} ({BEHIND}): {each}{_runs(scores[0])}"
            if deciding and spread:
                why += f". {'TMMD and people decide' if votes else 'TMMD decides'}"
        verdict = decide([side_of(score) for score in deciding])
        numbers = any(score.interval for score in deciding)
        claims.append(Claim(claim, source, verdict, f"{why}.", scores, numbers))
    return claims


def effect_size(difference: Score) -> Score | None:
    """``|difference| / standard error`` of a metric for two methods; None without an interval."""
    if difference.value is None or difference.interval is None:
        return None
    error = (difference.interval[1] - difference.interval[0]) / (2 * Z)
    if not error > 0:
        return None
    return replace(
        difference,
        kind="effect size",
        value=abs(difference.value) / error,
        interval=None,
        interval_method="",
        estimator="difference over its standard error",
        scale=1.0,
        higher_is_better=True,
        details={"difference": difference.value, "error": error},
    )


def effect_table(differences: Sequence[Score]) -> StudyTable:
    """How well each metric tells methods apart: effect sizes, a row a metric, a column a pair."""
    pairs = list(dict.fromkeys((d.a, d.b) for d in differences))
    rank = {Measure(name): k for k, name in enumerate((*TRADITIONAL, *FAMILY))}
    bare = lambda d: d.measure._replace(features="", kernel="")
    order = lambda d: (rank.get(bare(d), len(rank)), measured(d))
    rows: list[list[Score | str | None]] = []
    for (_, name), same in groupby(sorted(differences, key=order), key=order):
        of_pair = {(d.a, d.b): effect_size(d) for d in same}
        rows.append([name, *(of_pair.get(pair) for pair in pairs)])
    return StudyTable(
        "What tells methods apart",
        "The difference of two methods over its standard error, of every metric; 2 is about where "
        "an interval of 95 % leaves 0. It says how sure a metric is, not whether it is right.",
        ["metric", *(f"{a} against {b}" for a, b in pairs)],
        rows,
    )


def discrimination_claim(differences: Sequence[Score], pairs: Pairs = PAIRS) -> Claim:
    """Traditional metrics hardly discriminate: their mean effect size against the TMMD family's.

    Over the pairs of the paper's methods that both kinds have; each mean has an error of at most 1,
    so means that differ by less than ``1.96 sqrt(2)`` are undecided.
    """
    claim, source = "Traditional metrics hardly discriminate between methods", "paper, section 1"
    compared = [d for d in differences if {d.a, d.b} in [{*pair} for pair in pairs]]
    sizes = [
        [e for d in compared if any(_of_metric(m, d) for m in metrics) and (e := effect_size(d))]
        for metrics in (TRADITIONAL, FAMILY)
    ]
    traditional, family = ({(e.a, e.b) for e in effects} for effects in sizes)
    evidence = [effect for effects in sizes for effect in effects]
    if not (shared := traditional & family):
        why = "No two methods were compared by both kinds of metrics with intervals."
        return Claim(claim, source, "undecided", why, evidence, measured=False)
    low, high = (
        fmean(fmean(float(e) for e in effects if (e.a, e.b) == pair) for pair in shared)
        for effects in sizes
    )
    gap, reach = high - low, Z * np.sqrt(2)
    count = f"{len(shared)} pair{'s' * (len(shared) != 1)}"
    why = (
        f"The mean effect size of the TMMD family is {high:.2g}, of traditional metrics {low:.2g}, "
        f"over {count} of methods; the difference is {number(gap, 1)} [{number(gap - reach, 1)}, "
        f"{number(gap + reach, 1)}]."
    )
    return Claim(claim, source, decide([int(gap > reach) - int(gap < -reach)]), why, evidence)


def paper_claims(
    differences: Sequence[Score],
    *,
    tasks: Mapping[str, Score],
    people: Sequence[Score] = (),
    pairs: Pairs = PAIRS,
) -> list[Claim]:
    """All claims of the paper.

    Args:
        differences: of the methods under the leak-free split, each over its seeds.
        tasks: see :func:`leak_claims`.
        people: see :func:`preference_claims`.
        pairs: of methods.
    """
    return [
        *leak_claims(tasks),
        *ranking_claims(differences, people, pairs),
        *preference_claims(differences, people, pairs),
        discrimination_claim(differences, pairs),
    ]
