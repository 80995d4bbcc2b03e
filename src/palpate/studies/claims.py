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
from dataclasses import dataclass, replace
from itertools import groupby
from statistics import fmean

import numpy as np
from scipy import special

from palpate.core import Measure, Score
from palpate.report.labels import measured
from palpate.report.numbers import number
from palpate.report.study import Claim, StudyTable, Verdict
from palpate.studies.evidence import ahead, in_words, over_seeds, side_of

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
Z = float(special.ndtri(0.975))


@dataclass(frozen=True)
class Names:
    """What the methods of the paper's claims are called in the scores.

    Attributes:
        ours: trained on text.
        images: trained on images.
        background, plain: with the no-contact image as a condition, and the same without.
    """

    ours: str = "Ours"
    images: Sequence[str] = ("GVST",)
    background: str = "Ours w/ BG"
    plain: str = "Ours"

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """The paper's comparisons, its method first."""
        return [*((self.ours, other) for other in self.images), (self.plain, self.background)]


def differences_over_seeds(runs: Sequence[Iterable[Score]]) -> list[Score]:
    """The paired differences of a study, each over its seeds.

    Args:
        runs: all scores of each seed, as ``Results.scores`` has them. Of several presets of a
            metric ``grouped`` counts.

    Returns:
        One score for each metric and pair of methods that every seed has.
    """
    listed = [_chosen(s for s in run if s.b is not None) for run in runs]
    shared = [key for key in listed[0] if all(key in run for run in listed)] if listed else []
    return [_combined([run[key] for run in listed]) for key in shared]


def _chosen(scores: Iterable[Score]) -> dict[tuple[Measure, str, str | None], Score]:
    """By measure and pair; of several presets ``grouped``, else the first."""
    chosen: dict[tuple[Measure, str, str | None], Score] = {}
    for score in scores:
        key = score.measure, score.a, score.b
        if key not in chosen or score.settings.get("preset") == "grouped":
            chosen[key] = score
    return chosen


def _combined(scores: Sequence[Score]) -> Score:
    """A difference over seeds, and the difference of its distances to the floor."""
    made = over_seeds(scores)
    if any("gap" not in s.details for s in scores):
        return made
    gaps = [
        replace(s, value=s.details["gap"], interval=s.details.get("gap_interval")) for s in scores
    ]
    gap = over_seeds(gaps)
    more = {"gap": gap.value, "gap_interval": gap.interval}
    return replace(made, details={**made.details, **more})


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


def leak_claims(
    tasks: Mapping[str, Score], names: tuple[str, str] = ("Orig", "NoLeak")
) -> list[Claim]:
    """Leakage inflates every task: one row for all with a better direction, and one a task.

    I-, CI- and D-TMMD have none: leaks inflate them if they bring images closer to their floor.

    Args:
        tasks: task -> paired difference of its score between the splits ``names``, of
            :func:`palpate.studies.evidence.difference_between` or of
            :func:`palpate.studies.split_study.compare_splits`.
        names: of the leaking split and the leak-free one, as in the differences.
    """
    gains = {task: ahead(difference, names[0]) for task, difference in tasks.items()}
    source, rows = "paper, tables 1 and 2", list[Claim]()
    for task, gain in gains.items():
        lead = f"Lead of {names[0]} over {names[1]} in {measured(tasks[task])}"
        why = f"{lead} ({BEHIND}): {in_words(gain)}{_runs(gain)}"
        verdict = decide([side_of(gain)])
        claim, known = f"Leakage inflates {task}", gain.interval is not None
        rows.append(Claim(claim, source, verdict, f"{why}.", [gain], known))
    directed = [g for task, g in gains.items() if tasks[task].higher_is_better is not None]
    sides = [side_of(gain) for gain in directed]
    counts = f"{sides.count(1)} of {len(sides)} tasks inflated, {sides.count(-1)} deflated"
    why = f"{counts}, {sides.count(0)} with an interval that holds 0 or is missing."
    verdict, known = decide(sides, every=True), any(gain.interval for gain in directed)
    overall = Claim("Leakage inflates every task", source, verdict, why, directed, known)
    return [overall, *rows]


def _runs(score: Score) -> str:
    """The number of seeds in brackets, where it is known."""
    count = len(score.details.get("by_seed", ()))
    return f" ({count} seed{'s' * (count != 1)})" if count else ""


def _of_metric(metric: str, difference: Score) -> bool:
    """Whether a difference is of one of the paper's metrics, on features it may be called after."""
    measure = difference.measure
    usual = not measure.kernel and not measure.excess and measure.features != TACTILE
    return measure.metric == metric and usual


def _between(differences: Iterable[Score], metric: str, a: str, b: str) -> list[Score]:
    """Differences of a metric between two methods."""
    return [d for d in differences if {d.a, d.b} == {a, b} and _of_metric(metric, d)]


def preference_claims(
    differences: Sequence[Score], people: Sequence[Score], names: Names | None = None
) -> list[Claim]:
    """Which metrics prefer what people prefer: one row a metric, over the paper's two comparisons.

    Args:
        differences: of :func:`differences_over_seeds`.
        people: scores of ``palpate preference score`` (``Results.load(path).scores``); empty
            without a human study, and then every row is undecided.
        names: of the methods.
    """
    names, votes = names or Names(), [s for s in people if s.b is not None]
    return [
        _preference_claim(metric, differences, votes, names) for metric in (*TRADITIONAL, *FAMILY)
    ]


def _preference_claim(
    metric: str, differences: Sequence[Score], votes: Sequence[Score], names: Names
) -> Claim:
    against = metric in TRADITIONAL
    does = "prefers what people do not" if against else "prefers what people prefer"
    of_metric, of_people, signs = list[Score](), list[Score](), list[int]()
    for pair in names.pairs:
        scores = [ahead(d, pair[0]) for d in _between(differences, metric, *pair)]
        people = [ahead(v, pair[0]) for v in _between(votes, PEOPLE, *pair)]
        signs += [side_of(score) * side_of(vote) for score in scores for vote in people]
        of_metric, of_people = of_metric + scores, of_people + people
    parts = [_leads(of_metric), _leads(of_people)]
    if not of_metric:
        parts[0] = f"{metric} was not computed (its weights may be missing)"
    if not of_people:
        parts[1] = "the human study compared other methods" if votes else "no human study was given"
    verdict = decide([-sign if against else sign for sign in signs])
    why, evidence = f"{_capital('; '.join(parts))}.", [*of_metric, *of_people]
    return Claim(f"{metric} {does}", "paper, table 3", verdict, why, evidence, bool(signs))


def _leads(scores: Sequence[Score]) -> str:
    """``lead by TMMD (below 0: behind): of Ours over GVST 0.6 [0.3, 0.9], over X 1 [0.5, 1.5]``."""
    if not scores:
        return ""
    parts: list[str] = []
    for front, same in groupby(scores, key=lambda s: s.a):
        each = [f"over {s.b} {in_words(s)}" for s in same]
        parts.append(f"of {front} {', '.join(each)}")
    return f"lead by {measured(scores[0])} ({BEHIND}): {'; '.join(parts)}"


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def ranking_claims(
    differences: Sequence[Score], people: Sequence[Score] = (), names: Names | None = None
) -> list[Claim]:
    """Text as a bridge beats images; conditioning on the background hurts.

    TMMD and, if given, people decide; I-, CI- and D-TMMD, which say how images vary and not how
    close they are, are listed as evidence alone.
    """
    names = names or Names()
    wanted = [f"Text as a bridge beats images ({other})" for other in names.images]
    wanted.append("Conditioning on the background hurts")
    return [
        _ranking_claim(claim, *pair, differences, people)
        for claim, pair in zip(wanted, names.pairs, strict=True)
    ]


def _ranking_claim(
    claim: str, front: str, other: str, differences: Sequence[Score], people: Sequence[Score]
) -> Claim:
    pair = front, other
    votes = [s for s in people if s.b is not None]
    compared = _between(differences, "TMMD", *pair) + _between(votes, PEOPLE, *pair)
    deciding = [ahead(d, front) for d in compared]
    others = [
        ahead(d, front) for metric in FAMILY[1:] for d in _between(differences, metric, *pair)
    ]
    why = f"{other} was not compared with {front}"
    if scores := [*deciding, *others]:
        each = ", ".join(f"{measured(s)} {in_words(s)}" for s in scores)
        why = f"Lead of {front} over {other} ({BEHIND}): {each}{_runs(scores[0])}"
        if deciding and others:
            people_too = any(d.metric == PEOPLE for d in compared)
            why += f". {'TMMD and people decide' if people_too else 'TMMD decides'}"
    sides = [side_of(s) for s in deciding]
    source = "paper, tables 3 and 4" if "images" in claim else "paper, table 3"
    known = any(score.interval for score in deciding)
    return Claim(claim, source, decide(sides), f"{why}.", [*deciding, *others], known)


def effect_size(difference: Score) -> Score | None:
    """``|difference| / standard error`` of a metric for two methods; None without an interval."""
    if difference.value is None or difference.interval is None:
        return None
    low, high = difference.interval
    if not high > low:
        return None
    value = abs(difference.value) / ((high - low) / (2 * Z))
    return replace(
        difference,
        kind="effect size",
        value=value,
        interval=None,
        interval_method="",
        estimator="difference over its standard error",
        scale=1.0,
        higher_is_better=True,
        details={"difference": difference.value, "error": (high - low) / (2 * Z)},
    )


def effect_table(differences: Sequence[Score]) -> StudyTable:
    """How well each metric tells methods apart: effect sizes, a row a metric, a column a pair."""
    pairs = list(dict.fromkeys((d.a, d.b) for d in differences))
    rank = {Measure(name): k for k, name in enumerate((*TRADITIONAL, *FAMILY))}
    bare = lambda d: d.measure._replace(features="", kernel="")
    place = lambda d: (rank.get(bare(d), len(rank)), measured(d))
    rows: list[list[Score | str | None]] = []
    for (_, name), same in groupby(sorted(differences, key=place), key=place):
        of_pair = {(d.a, d.b): effect_size(d) for d in same}
        rows.append([name, *(of_pair.get(pair) for pair in pairs)])
    return StudyTable(
        "What tells methods apart",
        "The difference of two methods over its standard error, of every metric; 2 is about where "
        "an interval of 95 % leaves 0. It says how sure a metric is, not whether it is right.",
        ["metric", *(f"{a} against {b}" for a, b in pairs)],
        rows,
    )


def discrimination_claim(differences: Sequence[Score], names: Names | None = None) -> Claim:
    """Traditional metrics hardly discriminate: their mean effect size against the TMMD family's.

    Over the pairs of the paper's methods that both kinds have; each mean has an error of at most 1,
    so means that differ by less than ``1.96 sqrt(2)`` are undecided.
    """
    names = names or Names()
    known = [{*pair} for pair in names.pairs]
    differences = [d for d in differences if {d.a, d.b} in known]
    claim, source = "Traditional metrics hardly discriminate between methods", "paper, section 1"
    sizes: dict[str, dict[tuple[str, str | None], list[float]]] = {"traditional": {}, "family": {}}
    evidence: list[Score] = []
    for kind, metrics in (("traditional", TRADITIONAL), ("family", FAMILY)):
        for d in differences:
            effect = effect_size(d) if any(_of_metric(m, d) for m in metrics) else None
            if effect is not None and effect.value is not None:
                pair = d.a, d.b
                sizes[kind].setdefault(pair, []).append(effect.value)
                evidence.append(effect)
    shared = [pair for pair in sizes["traditional"] if pair in sizes["family"]]
    if not shared:
        why = "No two methods were compared by both kinds of metrics with intervals."
        return Claim(claim, source, "undecided", why, evidence, measured=False)
    means = {kind: fmean(fmean(of[pair]) for pair in shared) for kind, of in sizes.items()}
    gap, reach = means["family"] - means["traditional"], Z * np.sqrt(2)
    pairs = f"{len(shared)} pair{'s' * (len(shared) != 1)}"
    why = (
        f"The mean effect size of the TMMD family is {means['family']:.2g}, of traditional metrics "
        f"{means['traditional']:.2g}, over {pairs} of methods; the difference is {number(gap, 1)} "
        f"[{number(gap - reach, 1)}, {number(gap + reach, 1)}]."
    )
    return Claim(claim, source, decide([int(gap > reach) - int(gap < -reach)]), why, evidence)


def paper_claims(
    noleak: Sequence[Iterable[Score]],
    *,
    tasks: Mapping[str, Score],
    people: Sequence[Score] = (),
    names: Names | None = None,
    splits: tuple[str, str] = ("Orig", "NoLeak"),
) -> list[Claim]:
    """All claims of the paper.

    Args:
        noleak: scores and differences of the methods under the leak-free split, a list a seed.
        tasks: see :func:`leak_claims`.
        people: see :func:`preference_claims`.
        names: of the methods.
        splits: see :func:`leak_claims`.
    """
    differences = differences_over_seeds(noleak)
    return [
        *leak_claims(tasks, splits),
        *ranking_claims(differences, people, names),
        *preference_claims(differences, people, names),
        discrimination_claim(differences, names),
    ]
