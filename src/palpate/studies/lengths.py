"""Quality against compute: trainings of other lengths, and other numbers of sampling steps.

A training of a quarter of the steps is one of its own, whose learning rate falls to its end, not
the first quarter of the whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from palpate.core import FeatureSet, Score
from palpate.metrics import tmmd
from palpate.metrics.means import mean_of
from palpate.metrics.probe import Probe, fit_probe
from palpate.report.study import Curve, Line
from palpate.studies.judging import MATERIAL, SIGMA
from palpate.studies.study_tables import READING

#: Shares of the preset's training steps that are trained as well.
SHARES = (0.25, 0.5)
#: Sampling steps.
SAMPLING = (2, 4, 10, 20, 50)

#: Method -> (number of steps, features of its images), in order of the number.
Points = Mapping[str, Sequence[tuple[int, FeatureSet]]]


def compute_curves(
    trained: Points, sampled: Points, real: FeatureSet, train: FeatureSet, split: str | None = None
) -> list[Curve]:
    """Curves of TMMD and, where there are materials, of their accuracy.

    Args:
        trained: features of images after trainings of several lengths.
        sampled: those of one model, with several numbers of sampling steps; of fewer samples.
        real: features of the real test images.
        train: real features of the train part, with materials, for the probe.
        split: digest of the split, kept in the scores.

    Raises:
        PalpateError: as TMMD and the probe.
    """
    probe = fit_probe(train) if real.labels and train.labels else None
    short = "Each training is one of its own, whose learning rate falls to its end; first seed."
    quick = "The trained model with other numbers of solver steps; first seed, some test samples."
    distance = partial(_distance, real, split=split)
    curves = list[Curve]()
    for what, points, text in (("training", trained, short), ("sampling", sampled, quick)):
        lines = [
            Line(name, [(n, distance(x, name)) for n, x in each]) for name, each in points.items()
        ]
        title, steps = f"Quality against {what} steps", f"{what} steps"
        curves.append(Curve(title, text, steps, "TMMD, lower is better", lines, log_x=True))
        if probe is not None:
            lines = list(_accuracies(probe, points, real, split))
            curves.append(
                Curve(f"Material against {what} steps", text, steps, MATERIAL, lines, log_x=True)
            )
    return curves


def _distance(real: FeatureSet, x: FeatureSet, name: str, split: str | None) -> Score:
    same = real.take(list(x.ids))
    return tmmd(x, same, preset=READING, sigma=SIGMA, subject=name, split=split, permutations=0)


def _accuracies(
    probe: Probe, points: Points, real: FeatureSet, split: str | None
) -> Iterator[Line]:
    """A line a method, and the real images of the same samples as a level one."""
    accuracy = partial(_accuracy, probe, split=split)
    for name, each in points.items():
        yield Line(name, [(n, accuracy(x, name)) for n, x in each])
    known = {n: x for each in points.values() for n, x in each}
    yield Line(
        "real images", [(n, accuracy(real.take(list(known[n].ids)), "real")) for n in sorted(known)]
    )


def _accuracy(probe: Probe, x: FeatureSet, name: str, split: str | None) -> Score:
    hits = np.array(probe.predict(x.features)) == np.array([str(v) for v in x.labels or ()])
    groups = list(x.groups or x.ids)
    how: dict[str, Any] = {"subject": name, "split": split, "encoder": x.encoder}
    return mean_of(MATERIAL, hits, groups, estimator="mean", **how).score
