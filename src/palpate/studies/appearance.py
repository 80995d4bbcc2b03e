"""Text as a filter (paper, section 3.1): text drops color, light and unrelated objects. Does it?

The world shows the same contacts under other light, another white balance and with clutter beside
the surface (:mod:`palpate.sim.appearance`); real touch is the same. A generator that reads the
surface alone makes the same image, of the same noise. For each method and change:

- *movement*: mean Euclidean distance of tactile features between the image of the changed photo and
  that of the recorded one, of the same noise;
- *relative movement*: that, divided by the distance between two noise seeds on recorded photos: 1
  means that the change of the photo matters as much as chance does;
- *change of TMMD* and *of material accuracy*: of the changed photos less of the recorded ones.

Intervals leave out one video at a time from all terms at once, and add the deviation between
trainings where there are several (:mod:`palpate.metrics.means`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from palpate.core import FeatureSet, PalpateError, Score
from palpate.metrics import compare_tmmd, mean_score
from palpate.metrics.intervals import Spread
from palpate.metrics.means import Mean, mean_of, spread_of
from palpate.metrics.paired import differences_of_means
from palpate.metrics.probe import Probe, fit_probe
from palpate.report.study import Claim, StudyTable
from palpate.studies.claims import decide
from palpate.studies.evidence import in_words, over_seeds, side_of

RECORDED, AGAIN = "as recorded", "another noise seed"
MOVEMENT, RELATIVE = "movement", "relative movement"
TMMD, ACCURACY = "change of TMMD", "change of accuracy"


@dataclass(frozen=True)
class Moves:
    """How far the images and scores of one training move.

    Attributes:
        distances: change (:data:`AGAIN` included) -> distance of every sample's features.
        changes: change -> scores ``change of TMMD`` and, with materials, ``change of accuracy``.
    """

    distances: Mapping[str, Mean]
    changes: Mapping[str, Sequence[Score]]


def moves(
    renderings: Mapping[str, FeatureSet],
    again: FeatureSet | None,
    real: FeatureSet,
    *,
    train: FeatureSet | None = None,
    subject: str,
    split: str | None = None,
) -> Moves:
    """Compare the images of one training made from photos of several appearances.

    Args:
        renderings: appearance -> features of the images, of one noise seed and the same ids;
            ``as recorded`` among them.
        again: the same of recorded photos with another noise seed; None: there is no noise.
        real: features of the real test images.
        train: real features of the train part with materials, for a probe; None: no accuracy.
        subject: the method, kept in the scores.
        split: digest of the split, kept in the scores.

    Raises:
        PalpateError: without recorded photos, or if the sets differ in ids, or as TMMD does.
    """
    if RECORDED not in renderings or len(renderings) < 2:
        got, fix = ", ".join(renderings) or "none", "Generate from the recorded photos as well"
        must = f"must hold {RECORDED!r} and a change"
        raise PalpateError(must, got, fix, argument="renderings")
    base, others = renderings[RECORDED], {n: x for n, x in renderings.items() if n != RECORDED}
    others |= {} if again is None else {AGAIN: again}
    others = {name: x.take(list(base.ids)) for name, x in others.items()}
    probe = None if train is None or not base.labels else fit_probe(train)
    distances: dict[str, Mean] = {}
    changes: dict[str, list[Score]] = {}
    for name, x in others.items():
        values = np.linalg.norm(x.features.astype(np.float64) - base.features, axis=1)
        groups = [str(g) for g in base.groups or base.ids]
        fields = {"subject": f"{subject}, {name}", "split": split, "encoder": base.encoder}
        how: dict[str, Any] = {"higher_is_better": False, **fields}
        score = mean_score(MOVEMENT, values, ids=base.ids, groups=groups, **how)
        distances[name] = Mean(score, values, np.ones(len(values)), np.array(groups, dtype=str))
        pair = {name: x, RECORDED: base}
        made = compare_tmmd(pair, real, preset="grouped", permutations=0, split=split)
        measured = [(TMMD, made.differences[0])]
        if probe is not None:
            hits = {n: [_accuracy(probe, y, groups, n, split)] for n, y in pair.items()}
            measured.append((ACCURACY, differences_of_means(hits)[0]))
        changes[name] = [replace(d, metric=m, subject=fields["subject"]) for m, d in measured]
    return Moves(distances, changes)


def _accuracy(
    probe: Probe, x: FeatureSet, groups: Sequence[str], name: str, split: str | None
) -> Mean:
    hits = np.array(probe.predict(x.features)) == np.array([str(v) for v in x.labels or ()])
    fields: dict[str, Any] = {"subject": name, "split": split, "encoder": x.encoder}
    return mean_of("material accuracy", hits, groups, estimator="mean", **fields)


def _as_score(score: Score, metric: str, spread: Spread, low: float = -np.inf) -> Score:
    interval = spread.interval(low)
    return replace(
        score,
        metric=metric,
        value=float(spread.value),
        interval=interval,
        interval_method=spread.method if interval else "",
        details={},
        notes=(),
    )


def _distance(runs: Sequence[Moves], name: str) -> Score:
    """The movement over trainings."""
    means = [run.distances[name] for run in runs]
    return _as_score(means[0].score, MOVEMENT, spread_of([means]), 0.0)


def _relative(runs: Sequence[Moves], name: str) -> Score:
    """The movement over that between noise seeds, over trainings."""
    terms = [[run.distances[n] for run in runs] for n in (name, AGAIN)]
    spread = spread_of(terms, lambda m: m[..., 0] / m[..., 1])
    return _as_score(terms[0][0].score, RELATIVE, spread, 0.0)


def appearance_table(methods: Mapping[str, Sequence[Moves]]) -> StudyTable:
    """Rows of methods and changes, the distance between noise seeds last.

    Args:
        methods: method -> its trainings, one a seed.
    """
    columns = [MOVEMENT, RELATIVE, TMMD, ACCURACY]
    rows: list[list[Score | str | None]] = []
    for method, runs in methods.items():
        for name in runs[0].distances:
            noisy = name != AGAIN and AGAIN in runs[0].distances
            relative = _relative(runs, name) if noisy else None
            changes = {
                parts[0].metric: over_seeds(parts)
                for parts in zip(*(run.changes[name] for run in runs), strict=True)
            }
            cells = (_distance(runs, name), relative, changes.get(TMMD), changes.get(ACCURACY))
            rows.append([method, name, *cells])
    return StudyTable(
        "The same contacts, photographed otherwise",
        "How far generated images move in tactile features when the photo alone changes, of the "
        "same noise; relative to the distance between two noise seeds; and what it does to scores. "
        "Touch is the same, so 0 is right.",
        ["method", "change", *columns],
        rows,
    )


def appearance_claims(
    methods: Mapping[str, Sequence[Moves]], ours: str = "Ours", other: str = "GVST"
) -> list[Claim]:
    """Text drops color, light and unrelated objects: one row a change, by relative movement.

    It holds where the method trained on text moves less, relative to noise, than the one trained on
    images; paired by videos.

    Args:
        methods: method -> its trainings, one a seed; as many of both.
        ours: the method trained on text.
        other: the one trained on images.
    """
    what = {"other light": "light", "other white balance": "color", "clutter": "unrelated objects"}
    claims: list[Claim] = []
    source = "paper, section 3.1"
    pair = [methods[name] for name in (ours, other) if name in methods]
    for change, dropped in what.items():
        claim = f"Text drops {dropped}"
        if len(pair) < 2 or any(change not in run.distances for runs in pair for run in runs):
            why = f"{ours} and {other} were not both given photos with {change}."
            claims.append(Claim(claim, source, "undecided", why, measured=False))
            continue
        terms = [[run.distances[n] for run in runs] for runs in pair for n in (change, AGAIN)]
        spread = spread_of(terms, lambda m: m[..., 2] / m[..., 3] - m[..., 0] / m[..., 1])
        gain = replace(
            _as_score(terms[0][0].score, f"{RELATIVE}, {change}", spread),
            subject=f"{other} - {ours}",
            higher_is_better=True,
            details={"a": other, "b": ours},
        )
        each = [_relative(runs, change) for runs in pair]
        why = (
            f"By {change}, images of {ours} move {in_words(each[0])} and those of {other} "
            f"{in_words(each[1])} times as far as between noise seeds; the difference is "
            f"{in_words(gain)}."
        )
        claims.append(Claim(claim, source, decide([side_of(gain)]), why, [gain, *each]))
    return claims
