"""The TMMD family of several sets: every preset and bandwidth, floors, paired differences.

Metrics of one name with another bandwidth get names of their own (``TMMD (σ median)``), so that no
two of them share a column.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

from palpate import __version__
from palpate.core import FeatureSet, Note, PalpateError, Progress, Score, quiet
from palpate.evaluation.companions import Features, Outcome
from palpate.evaluation.inputs import Inputs
from palpate.metrics import PRESETS, compare, distance, tmmd

#: Bandwidth of the paper; the name of a metric says any other one where several are requested.
SIGMA = 10.0
#: Metrics that look at one set alone.
REFERENCE_FREE = ("I-TMMD", "CI-TMMD", "D-TMMD", "material accuracy")
#: Error of streamed moments at scale 1000 from which a note reports it.
BOUND = 1e-4


@dataclass(frozen=True, kw_only=True)
class Family:
    """How the TMMD family is computed.

    Attributes:
        presets: empty for those that fit the groups.
        sigmas: bandwidths.
        estimator: in place of the presets' own.
        options: backend, permutations, normalize; the companion ``cmmd`` takes them as well.
        common: seed and digest of the split, for all metrics.
    """

    presets: Sequence[str]
    sigmas: Sequence[float | str]
    estimator: str | None
    options: Mapping[str, Any]
    common: Mapping[str, Any]

    def presets_for(self, *, grouped: bool) -> Sequence[str]:
        """The requested presets, or those that fit."""
        fits = grouped and self.estimator in (None, "grouped")
        return self.presets or (("grouped", "paper") if fits else ("paper",))

    def label(self, preset: str) -> str:
        """A preset as tables name it: with the estimator if that is not its usual one."""
        usual = self.estimator in (None, PRESETS[preset].estimator)
        return preset if usual else f"{preset}, {self.estimator}"

    def named(self, score: Score, preset: str, sigma: float | str) -> Score:
        """A score with its preset, and an unusual bandwidth of several in the metric's name."""
        score = replace(score, settings={**score.settings, "preset": self.label(preset)})
        if len(self.sigmas) < 2 or sigma == SIGMA:
            return score
        tag = f"(σ {sigma})" if isinstance(sigma, str) else f"(σ = {sigma:g})"
        base = score.metric.removesuffix(" difference")
        return replace(score, metric=f"{base} {tag}" + score.metric[len(base) :])


def score_family(
    features: Features, family: Family, *, train: FeatureSet | None, progress: Progress = quiet
) -> Outcome:
    """TMMD, I-, CI- and D-TMMD of every set by preset and bandwidth, with paired differences.

    Args:
        features: of generators, controls and reference.
        family: presets, bandwidths, options.
        train: further real features, whose TMMD to the reference is the floor of TMMD.
        progress: called with how many columns are done.
    """
    sets = {**features.generators, **features.controls}
    grouped = [s.groups is not None for s in (features.reference, *sets.values())]
    floor = features.reference if len(set(grouped)) == 1 else None
    columns = [(p, s) for p in family.presets_for(grouped=all(grouped)) for s in family.sigmas]
    outcome = Outcome()
    for done, (preset, sigma) in enumerate(columns):
        options: dict[str, Any] = {
            **features.family,
            **features.common,
            "preset": preset,
            "sigma": sigma,
            **({"estimator": family.estimator} if family.estimator else {}),
        }
        least = None
        if train is not None:
            fast: dict[str, Any] = {**options, "permutations": 0}
            least = tmmd(train, features.reference, **fast).value
        for some in features.batches():
            result = compare(some, features.reference, floor=floor, **options)
            assert result.excess is not None  # `compare` always gives it
            scores = [replace(s, floor=least) if s.metric == "TMMD" else s for s in result.scores]
            both = (
                (outcome.scores, scores, result.excess.scores),
                (outcome.differences, result.differences, result.excess.differences),
            )
            for results, own, excess in both:
                named = (family.named(s, preset, sigma) for s in _interleaved(own, excess))
                results += named
        progress("TMMD family", done + 1, len(columns))
    return outcome


def _interleaved(scores: Sequence[Score], excess: Sequence[Score]) -> Iterator[Score]:
    """Every score followed by its excess E."""
    excess_of = {(e.metric.replace(" E", "", 1), e.subject): e for e in excess}
    for s in scores:
        yield s
        if (s.metric, s.subject) in excess_of:
            yield excess_of[s.metric, s.subject]


def score_streamed(
    inputs: Inputs, family: Family, companions: Sequence[str] | None, progress: Progress
) -> Outcome:
    """TMMD of arrays that are too long to hold: rows are read once, and only moments are kept."""
    if inputs.train is not None or companions:
        must, fix = "must go with rows that fit in memory", "Pass groups, or drop it"
        got = "so many rows without groups, which are streamed for TMMD alone"
        argument = "companions" if companions else "split"
        raise PalpateError(must, got, fix, argument=argument)
    options = dict(family.options)
    del options["permutations"]
    auto = options["backend"] == "auto"
    if auto:
        options["backend"] = "moments"
    columns = [(p, s) for p in family.presets_for(grouped=False) for s in family.sigmas]
    todo = [(n, s, p, sigma) for n, s in inputs.generators.items() for p, sigma in columns]
    outcome = Outcome(notes=[*inputs.notes, Note("streamed")])
    for done, (name, samples, preset, sigma) in enumerate(todo):
        progress("streaming", done, len(todo))
        x, y = samples.features, inputs.reference.features
        estimator: Any = family.estimator or PRESETS[preset].estimator
        called = (f"The features of {name!r}", "The reference features")
        d = distance(x, y, sigma=cast("Any", sigma), estimator=estimator, names=called, **options)
        notes = [Note("no-interval-streamed")]
        if d.bound > BOUND and auto:
            fix, example = "Choose a larger one, or wait for the exact sum", {"backend": "blocked"}
            must, got = "must be wide for streamed rows", f"an error of {d.bound:.2g} at {sigma}"
            raise PalpateError(must, got, fix, argument="sigma", example=example)
        if d.bound > BOUND:
            notes.append(Note("within-bound", {"bound": d.bound}))
        streamed = Score(
            "TMMD",
            name,
            d.value,
            estimator=d.estimator,
            bandwidth=d.bandwidth,
            scale=d.scale,
            n=d.m,
            m=d.n,
            split=family.common["split"],
            settings={**d.kernel, "preset": preset, "normalize": options["normalize"]},
            details={"backend": d.backend, "bound": d.bound, "version": __version__},
            notes=notes,
        )
        outcome.scores.append(family.named(streamed, preset, sigma))
    outcome.scores = compared_with(outcome.scores, inputs.reference.digest)
    return outcome


def compared_with(scores: Sequence[Score], reference: str) -> list[Score]:
    """Scores with the digest of the real images, where they compare with them."""
    return [
        s if s.metric.startswith(REFERENCE_FREE) else replace(s, reference=reference)
        for s in scores
    ]
