"""The TMMD family (TMMD, I-, CI- and D-TMMD) of every set of features, by preset and bandwidth.

Scores of one metric with another bandwidth say so as their ``kernel``, so that no two of them share
a column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from palpate.core import FeatureSet, Note, Progress, Score, quiet
from palpate.evaluation.companions import MANY, Features, Outcome
from palpate.evaluation.controls import matched_features
from palpate.metrics import compare, compare_tmmd, tmmd
from palpate.report.labels import measured

#: Bandwidth of the paper; scores name any other one as their kernel where several are requested.
SIGMA = 10.0


@dataclass(frozen=True, kw_only=True)
class Family:
    """How the TMMD family is computed.

    Attributes:
        presets: empty for those that fit the groups.
        sigmas: bandwidths; empty for the default.
    """

    presets: Sequence[str]
    sigmas: Sequence[float | str]

    def columns(self, *, grouped: bool, rows: int) -> list[tuple[str | None, float | str]]:
        """(preset, bandwidth) of each column; None is the preset that fits the ids of a metric.

        Of bandwidths that nobody requested, ``multi`` is for TMMD alone, of the first preset.
        """
        presets: Sequence[str | None] = self.presets or (
            ("grouped", "paper") if grouped else (None,)
        )
        columns: list[tuple[str | None, float | str]]
        columns = [(p, s) for p in presets for s in self.sigmas or (SIGMA,)]
        return columns + [(presets[0], "multi")] * (not self.sigmas and rows <= MANY)

    def named(self, score: Score, sigma: float | str) -> Score:
        """A score that names an unusual bandwidth."""
        if len(self.sigmas) == 1 or sigma == SIGMA:
            return score
        return replace(score, kernel=f"σ {sigma}" if isinstance(sigma, str) else f"σ = {sigma:g}")


def score_family(
    features: Features, family: Family, *, train: FeatureSet | None, progress: Progress = quiet
) -> Outcome:
    """TMMD, I-, CI- and D-TMMD of every set by preset and bandwidth, with paired differences.

    The floor of TMMD is that of features of ``train``, whole videos in the place of the reference's
    (:func:`palpate.evaluation.controls.matched_rows`): the pairs of one video that are left out on
    one side are then left out on the other. The floor of the others is of the reference itself.
    """
    sets = {**features.generators, **features.controls}
    grouped = [s.groups is not None for s in (features.reference, *sets.values())]
    floor = features.reference if len(set(grouped)) == 1 else None
    columns = family.columns(grouped=all(grouped), rows=features.rows)
    further = train and matched_features(train, features.reference, features.settings.seed)
    outcome = Outcome()
    if not family.sigmas and features.rows > MANY:
        outcome.notes.append(Note("wide-sigma-alone", {"rows": MANY}))
    for done, (preset, sigma) in enumerate(columns):
        least = None
        if further is not None:
            untested = replace(features.settings, permutations=0)
            least = tmmd(
                further, features.reference, preset=preset, sigma=sigma, **untested.family
            ).value
        every = sigma in (family.sigmas or (SIGMA,))
        compared = partial(compare, floor=floor) if every else compare_tmmd
        for some in features.batches():
            result = compared(
                some, features.reference, preset=preset, sigma=sigma, **features.settings.family
            )
            scores = [replace(s, floor=least) if s.metric == "TMMD" else s for s in result.scores]
            outcome.differences += [family.named(s, sigma) for s in result.differences]
            for s in scores:
                outcome.scores.append(named := family.named(s, sigma))
                if s.kind == "excess" and s.floor and s.interval and s.interval[1] < s.floor:
                    params = {"metric": measured(named), "subject": s.a}
                    outcome.notes.append(Note("below-floor", params))
        progress("TMMD family", done + 1, len(columns))
    return outcome
