"""From votes to scores: preferences, strengths, agreement, and which metrics agree with people.

The scores are :class:`palpate.core.Score`, so that tables, LaTeX and the page of other results take
them as they are: ``palpate report scores.json preference.json -o page.html``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core import Note, Progress, Score, few, plain, quiet, require
from palpate.metrics.paired import holm
from palpate.preference.agreement import agreement_scores, metrics_of_files, shown_metrics
from palpate.preference.arrays import VoteArrays
from palpate.preference.plan import REFERENCE, Plan
from palpate.preference.raters import RaterFacts, rater_facts
from palpate.preference.statistics import (
    ENOUGH,
    FEW_RATERS,
    REPLICATES,
    Array,
    cohen_kappa,
    krippendorff_alpha,
    method_preferences,
    outcome_counts,
    preferences,
    prior_decides,
    raw_agreement,
    sign_test,
)
from palpate.preference.votes import DATABASE, read_votes
from palpate.report.results import Call, Results

PREFERENCE, STRENGTH = "human preference", "human strength"
ACCURACY = "human accuracy of material"


def score(
    study: str | Path,
    votes: str | Path | Iterable[str | Path] = (),
    *,
    metrics: Sequence[str | Path] = (),
    replicates: int = REPLICATES,
    seed: int = 0,
    progress: Progress = quiet,
) -> Results:
    """Score the votes of a study.

    Args:
        study: its folder, with ``plan.json`` and, of a served study, ``study.db``.
        votes: downloads of raters, or folders of them.
        metrics: which of these agree with people? Files of ``palpate score`` of the same methods.
            SSIM and PSNR of the shown images are always compared.
        replicates: resamplings of an interval.
        seed: of the resamplings.
        progress: progress callback.

    Returns:
        Scores of the task ``pair``: ``human preference`` of each method in [0, 1], ties as half,
        over its comparisons; their differences in [-1, 1]; ``human strength``, Davidson's, in
        logits of mean 0; Kendall's tau-b of metrics with people. Of the task ``sort``: ``human
        accuracy of material`` of all images and of each shown material. Intervals resample items
        and raters; with two raters or fewer items alone, and say that they are for these raters.
        ``settings["preference"]`` has agreement, raters, exclusions and comparisons.

    Raises:
        PalpateError: if there are no votes, a file is none of this study, or all raters are
            excluded.
    """
    call = Call.of("preference score", score, locals())
    require(100 <= replicates <= 100_000, "replicates", "must lie in 100 .. 100,000", replicates)
    plan, folder = Plan.load(study), Path(study)
    folder = folder if folder.is_dir() else folder.parent
    files = [Path(votes)] if isinstance(votes, str | Path) else [Path(path) for path in votes]
    files += [folder / DATABASE] * (folder / DATABASE).is_file()
    read = read_votes(plan, files)
    everyone = rater_facts(plan, read)
    kept = [rater.code for rater in everyone if not rater.excluded]
    got = few(f"{r.code} excluded by the rule {r.excluded}" for r in everyone)
    fix = "Pass votes of further raters"
    require(bool(kept), None, "There must be votes to score", got, fix=fix)
    arrays = VoteArrays(plan, read, kept, seed, replicates)
    agreement = agreement_of(arrays, everyone)
    settings: dict[str, Any] = {
        "study": plan.study,
        "task": plan.task,
        "question": plan.text,
        "rule": plan.rule,
        "expected": plan.expected,
        "agreement": agreement,
        "raters": everyone,
    }
    if plan.task == "sort":
        require(not metrics, "metrics", "must be left out where people sort", metrics)
        scores = accuracy_scores(arrays)
    else:
        shares = shares_of(arrays)
        settings["comparisons"] = comparisons(arrays, shares)
        compared = [*shown_metrics(plan, progress), *metrics_of_files(plan, metrics)]
        scores = [*preference_scores(arrays, shares), *strength_scores(arrays)]
        scores += agreement_scores(compared, arrays, progress)
    return Results(
        title="Human preference" if plan.task == "pair" else "Materials sorted by people",
        scores=scores,
        settings={"preference": plain(settings)},
        notes=[
            *(note for note in plan.notes if note.code != "these-raters"),  # of those who voted
            *read.notes,
            *_unshown(plan),
            *_rater_notes(plan, everyone, len(kept)),
            Note("human-agreement", agreement),
        ],
        calls=[call],
    )


def _unshown(plan: Plan) -> list[Note]:
    """Materials that were answers but no trial."""
    unshown = {*plan.choices} - {item.material for item in plan.items}
    if plan.task == "pair" or not unshown:
        return []
    return [Note("materials-unshown", {"count": len(unshown), "of": len(plan.choices)})]


def _rater_notes(plan: Plan, raters: Sequence[RaterFacts], kept: int) -> list[Note]:
    notes = [
        Note(
            "rater-excluded", {"rater": r.code, "rule": r.excluded, "limit": limit, "value": value}
        )
        for r in raters
        if r.excluded
        for limit, value in [(getattr(plan.rule, r.excluded), getattr(r, r.excluded))]
    ]
    if kept <= FEW_RATERS:
        return [*notes, Note("these-raters", {"count": kept})]
    return [*notes, Note("few-raters", {"count": kept})] if kept < ENOUGH else notes


def agreement_of(arrays: VoteArrays, raters: Sequence[RaterFacts]) -> dict[str, Any]:
    """Raw agreement, kappa, alpha, agreement with oneself, and the bias to the left, as JSON."""
    codes = arrays.codes  # chance of a pair is within its comparison
    if arrays.plan.task == "sort":  # all answers are open to all images
        codes = codes.reshape(len(arrays.raters), -1)
    kept = [rater for rater in raters if not rater.excluded]
    names = ("repeats", "consistent", "left", "right")
    repeats, consistent, left, right = (sum(getattr(r, name) for r in kept) for name in names)
    # Sides are random: without a bias each vote for a side is left with probability 1/2.
    p = sign_test(left, right)
    return plain(
        {
            "raters": len(kept),
            "agree": raw_agreement(codes),
            "kappa": cohen_kappa(codes),
            "alpha": krippendorff_alpha(codes),
            "self": consistent / repeats if repeats else None,
            "repeats": repeats,
            "left": left / (left + right) if left + right else None,
            "sides": left + right,
            "p_left": p,
        }
    )


def shares_of(arrays: VoteArrays) -> list[Score]:
    """The share of the first method in every comparison."""
    shares, replicates = preferences(arrays.counts), preferences(arrays.replicated)
    votes = arrays.counts.sum(axis=1)
    return [
        arrays.score(PREFERENCE, a, shares[c], replicates[:, c], votes[c], items=arrays.answered(c))
        for c, (a, _) in enumerate(arrays.columns)
    ]


def comparisons(arrays: VoteArrays, shares: Sequence[Score]) -> list[dict[str, Any]]:
    """Every comparison: votes, and the share of the first method with its interval."""
    rows: list[dict[str, Any]] = []
    for share, (a, b), votes in zip(shares, arrays.columns, arrays.counts, strict=True):
        wins, ties, losses = map(int, votes)
        row = {"a": a, "b": b, "votes_a": wins, "ties": ties, "votes_b": losses}
        rows.append(row | {"share": share.value, "interval": share.interval})
    return rows


def preference_scores(arrays: VoteArrays, shares: Sequence[Score]) -> list[Score]:
    """The preference of each method, and the differences of all comparisons."""
    methods, votes = arrays.plan.methods, arrays.counts.sum(axis=1)
    replicates = preferences(arrays.replicated)
    means = method_preferences(preferences(arrays.counts), arrays.pairs, len(methods))
    spread = method_preferences(replicates, arrays.pairs, len(methods))
    scores: list[Score] = []
    for k, name in enumerate(methods):
        own = [c for c, pair in enumerate(arrays.pairs) if k in pair]
        items, n = arrays.answered(*own), sum(votes[own])
        scores.append(arrays.score(PREFERENCE, name, means[k], spread[:, k], n, items=items))
    differences: list[Score] = []
    for c, (share, pair) in enumerate(zip(shares, arrays.columns, strict=True)):
        difference = share
        if share.value is not None:
            low, high = share.interval or (np.nan, np.nan)
            interval = (2 * low - 1, 2 * high - 1)  # NaN is none
            difference = replace(share, value=2 * share.value - 1, interval=interval)
        verdict = _verdict(difference, pair, 2 * replicates[:, c] - 1, arrays.answered(c))
        differences.append(replace(difference, kind="difference", b=pair[1], details=verdict))
    return [*scores, *holm(differences)]


def _verdict(
    difference: Score, pair: tuple[str, str], replicates: Array, items: int
) -> dict[str, Any]:
    """Which of two is ahead, and how sure that is; of unanimous votes by the sign test."""
    sign = np.sign(float(difference))
    better = pair[int(sign < 0)] if abs(sign) == 1 else None
    verdict = {"better": better, "p_better": None, "p_value": None, "decided": False}
    if difference.interval is None:
        return verdict
    finite = replicates[np.isfinite(replicates)]
    above = float((finite > 0).mean() + (finite == 0).mean() / 2)
    if difference.notes:
        above = 0.5 + sign * (0.5 - 0.5**items)
    low, high = difference.interval
    p = max(2 * min(above, 1 - above), 1 / len(replicates))
    return verdict | {"p_better": above, "p_value": p, "decided": not low <= 0 <= high}


def strength_scores(arrays: VoteArrays) -> list[Score]:
    """Davidson's strength of each method; the tie parameter nu is in the details."""
    votes, spread = arrays.counts.sum(), arrays.strength_replicates
    unbounded = prior_decides(arrays.counts, arrays.pairs, len(arrays.plan.methods))
    return [
        replace(
            arrays.score(STRENGTH, name, arrays.strength[k], spread[:, k], votes),
            estimator="Davidson",
            details={"nu": float(np.exp(arrays.strength[-1]))},
            notes=(Note("strength-of-prior"),) * unbounded,
        )
        for k, name in enumerate(arrays.plan.methods)
    ]


def accuracy_scores(arrays: VoteArrays) -> list[Score]:
    """How often people name the material of real images and of each method's: all, then each."""
    names, codes = arrays.slots, arrays.codes
    truth = np.array([names.index(str(item.material)) for item in arrays.plan.items])
    right = np.where(codes == truth, 1.0, -1.0)  # as a vote without ties
    right[codes < 0] = np.nan
    scores: list[Score] = []
    for c, (name, _) in enumerate(arrays.columns):
        counts = np.zeros((len(names), len(names)), int)
        for row in codes[:, c]:
            np.add.at(counts, (truth[row >= 0], row[row >= 0]), 1)
        with np.errstate(invalid="ignore"):
            shares = counts / counts.sum(axis=1, keepdims=True)
        by_material = dict(zip(names, plain(shares.diagonal().tolist()), strict=True))
        details: dict[str, Any] = {
            "chance": 1 / len(names),
            "classes": names,
            "matrix": plain(shares.tolist()),
            "counts": counts.tolist(),
            "by_material": by_material,
        }
        subject = "real images" if name == REFERENCE else name
        score = _accuracy(arrays, subject, right[:, [c]])
        scores.append(replace(score, details=details))
        for k, material in enumerate(names):
            if by_material[material] is not None:
                own = np.where(truth == k, right[:, [c]], np.nan)
                scores.append(_accuracy(arrays, f"{subject}, {material}", own))
    return scores


def _accuracy(arrays: VoteArrays, subject: str, votes: Array) -> Score:
    """The accuracy of votes (R, 1, N): 1 right, -1 wrong, NaN for none."""
    answered = np.isfinite(votes)
    share = preferences(outcome_counts(votes, arrays.once))[0, 0]
    spread = preferences(outcome_counts(votes, arrays.resampled))[:, 0]
    items = int(answered.any(axis=(0, 1)).sum())
    return arrays.score(ACCURACY, subject, share, spread, answered.sum(), items=items)
