"""Which ruler: do encoders of other training rank generators alike?

TMMD is measured by a tactile encoder: one trained under Orig, one under NoLeak, public ones. Each
ranks the same generators, methods x seeds, by their TMMD; two rankings are compared by Kendall's
tau-b (1: the same order, -1: the reverse, 0: unrelated). The interval resamples methods, and the
seeds of each, 2,000 times: another choice of generators could have been ranked. Rankings that agree
in every replicate have no interval; then the exact test of the methods' means against unrelated
rankings (Kendall 1938) decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from palpate.core import Note, PalpateError, Progress, Score, Split, quiet, require, rng_for
from palpate.data.manifest import Manifest
from palpate.encoders.embed import embed
from palpate.encoders.encoder_set import EncoderSet
from palpate.evaluation.inputs import guard
from palpate.metrics import tmmd
from palpate.metrics.inputs import Array
from palpate.preference.statistics import percentiles, tau_b
from palpate.report.study import Claim, StudyTable
from palpate.studies.claims import decide
from palpate.studies.embedding import embed_generated
from palpate.studies.evidence import in_words, side_of

#: (method, seed) of a generator.
Generator = tuple[str, int]
REPLICATES = 2000
TAU = "Kendall's tau of rankings"


def measure_rulers(
    rulers: Mapping[str, EncoderSet],
    images: Mapping[Generator, Path],
    manifest: Manifest,
    split: Split,
    *,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> dict[str, dict[Generator, Score]]:
    """TMMD of every generator's images by every encoder, for :func:`ruler_scores`.

    An encoder that was trained under Orig has seen test images of NoLeak; what that does to its
    ranking is the question, and its scores say it.

    Args:
        rulers: name -> encoders with a tactile one.
        images: (method, seed) -> folder of the images of the test part.
        manifest: the samples.
        split: whose test part the images are of.
        cache: folder for embeddings of real images.
        progress: progress callback.
    """
    test = manifest.part(split, "test")
    made: dict[str, dict[Generator, Score]] = {}
    for name, encoders in rulers.items():
        notes = guard(encoders, "tactile", test, split=split, allow_seen=True, progress=progress)
        real = embed(test, encoders, "tactile", cache=cache, still=True, progress=progress)
        made[name] = {}
        for (method, seed), folder in images.items():
            x = embed_generated(folder, test, encoders, progress)
            how: dict[str, Any] = {"subject": f"{method}, seed {seed}", "split": split.digest}
            score = tmmd(x, real, preset="grouped", permutations=0, **how)
            made[name][method, seed] = replace(score, notes=[*score.notes, *notes])
    return made


def ruler_scores(
    rulers: Mapping[str, Mapping[Generator, Score]], *, replicates: int = REPLICATES, seed: int = 0
) -> list[Score]:
    """Kendall's tau-b of the rankings of every two rulers.

    Args:
        rulers: name of an encoder -> (method, seed) -> the TMMD of that generator by it; lower is
            better. The same generators in all.
        replicates: resamplings of the interval.
        seed: of the resampling.

    Returns:
        A score for each pair, in [-1, 1]; ``details["by_method"]`` is the tau of the methods' mean
        TMMD, ``"p_value"`` of its test. The interval is None where replicates do not vary. Notes
        of the TMMD, such as on images that an encoder has seen, are taken over.

    Raises:
        PalpateError: with fewer than two rulers or three generators, generators that differ, or a
            score without a value.
    """
    require(replicates >= 100, "replicates", "must be at least 100", replicates, REPLICATES)
    if len(rulers) < 2:
        must, fix = "There must be two rulers to compare", "Score with another encoder as well"
        raise PalpateError(must, f"{len(rulers)}", fix)
    generators = sorted(next(iter(rulers.values())))
    for name, scores in rulers.items():
        if sorted(scores) != generators or len(generators) < 3:
            must = "Rulers must rank the same generators, three at least"
            got = f"{len(scores)} by {name!r}, {len(generators)} by {next(iter(rulers))!r}"
            raise PalpateError(must, got, "Score the same ones by every encoder")
        if unknown := [g for g, s in scores.items() if s.value is None]:
            must, got = "Every generator must have a score", f"none of {unknown[0]} by {name!r}"
            raise PalpateError(must, got, "See the score's notes")
    values = {n: np.array([float(of[g]) for g in generators]) for n, of in rulers.items()}
    draws = _draws(generators, replicates, seed)
    made: list[Score] = []
    for pair in combinations(rulers, 2):
        score = _agreement(values, pair, generators, draws, seed)
        notes = [*score.notes]
        for note in (n for name in pair for s in rulers[name].values() for n in s.notes):
            notes += [] if note in notes else [note]
        made.append(replace(score, notes=notes))
    return made


def _draws(generators: list[Generator], replicates: int, seed: int) -> Array:
    """(B, n) how often each generator is drawn: methods, then seeds of each drawn method."""
    rng, at = rng_for(seed, "rulers"), dict[str, list[int]]()
    for k, (method, _) in enumerate(generators):
        at.setdefault(method, []).append(k)
    rows = list(at.values())
    weights = np.zeros((replicates, len(generators)))
    for weight in weights:
        for m in rng.integers(len(rows), size=len(rows)):
            of_method = np.array(rows[m])
            np.add.at(weight, rng.choice(of_method, len(of_method)), 1)
    return weights


def _agreement(
    values: Mapping[str, Array],
    pair: tuple[str, str],
    generators: list[Generator],
    draws: Array,
    seed: int,
) -> Score:
    x, y = (values[name] for name in pair)
    tau = tau_b(x, y, np.ones(len(x)))
    interval = percentiles(np.array([tau_b(x, y, weight) for weight in draws]))
    methods = sorted({method for method, _ in generators})
    of_method = [[k for k, (method, _) in enumerate(generators) if method == m] for m in methods]
    mean_x, mean_y = (np.array([v[rows].mean() for rows in of_method]) for v in (x, y))
    by_method = tau_b(mean_x, mean_y, np.ones(len(methods)))
    test: Any = stats.kendalltau(mean_x, mean_y)
    known = bool(np.isfinite(tau))
    return Score(
        TAU,
        " and ".join(pair),
        tau if known else None,
        interval if known else None,
        interval_method="methods and their seeds resampled" if interval and known else "",
        estimator="tau-b",
        n=len(generators),
        seed=seed,
        higher_is_better=True,
        settings={"methods": len(methods), "generators": len(generators)},
        details={"a": pair[0], "b": pair[1], "by_method": by_method, "p_value": float(test.pvalue)},
        notes=() if interval else (Note("no-interval", {"reason": "no-change"}),),
    )


def ruler_tables(
    rulers: Mapping[str, Mapping[Generator, Score]],
    agreement: list[Score],
    *,
    controls: Sequence[str] = (),
) -> list[StudyTable]:
    """How rulers agree, and the rank that each gives to every method by its mean TMMD over seeds.

    Args:
        rulers: see :func:`ruler_scores`; here with controls.
        agreement: of :func:`ruler_scores`.
        controls: methods that are none.
    """
    names, of_pair = list(rulers), {(s.details["a"], s.details["b"]): s for s in agreement}
    matrix = [[a, *(of_pair.get((a, b)) or of_pair.get((b, a)) for b in names)] for a in names]
    methods = list(dict.fromkeys(method for method, _ in next(iter(rulers.values()))))
    ranks: list[list[Score | str | None]] = [[method] for method in methods]
    for scores in rulers.values():
        means = {
            m: float(np.mean([float(s) for (method, _), s in scores.items() if method == m]))
            for m in methods
        }
        for row, method in zip(ranks, methods, strict=True):
            others = (means[m] for m in methods if m != method and m not in controls)
            rank = 1.0 + sum(mean < means[method] for mean in others)
            row.append(Score("rank", method, rank, details={"mean TMMD": means[method]}))
    return [
        StudyTable(
            "Which ruler",
            "Kendall's tau of the rankings of generators by TMMD, measured by encoders of other "
            "training: 1 is the same order, 0 an unrelated one."
            + " Controls have no part in it."
            * bool(controls),
            ["encoder", *names],
            matrix,
        ),
        StudyTable(
            "Ranks by ruler",
            "The rank of each method by its mean TMMD over seeds, by each encoder; 1 is best."
            + " Of a control: the rank that it would have among them." * bool(controls),
            ["method", *names],
            ranks,
            controls=[name for name in controls if name in methods],
        ),
    ]


def _side(score: Score) -> int:
    """1 for agreement, -1 for the reverse, 0 where that is not decided."""
    if score.interval is None and score.details["p_value"] < 0.05:  # not for NaN
        return int(np.sign(float(score)))
    return side_of(score)


def ruler_claim(agreement: list[Score]) -> Claim:
    """Encoders of other training rank generators alike: every interval of tau lies above 0."""
    verdict = decide([_side(s) for s in agreement], every=True)
    words = [f"tau of {s.subject} is {in_words(s)}" for s in agreement]
    why = f"{'; '.join(words)}; over {agreement[0].n} generators." if agreement else "No rulers."
    claim = "Encoders of other training rank generators alike"
    return Claim(claim, "beyond the paper", verdict, why[:1].upper() + why[1:], agreement)
