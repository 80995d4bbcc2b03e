"""Memorization of methods and controls under the leaking split and the leak-free one, as a table.

The scores are those of :mod:`palpate.evaluation.memorization`, of ``palpate score --train``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from palpate.core import Score
from palpate.evaluation.memorization import NEARNESS, SHARE
from palpate.report.study import StudyTable


def memorization_table(
    splits: Mapping[str, Sequence[Score]], controls: Sequence[str] = ()
) -> StudyTable:
    """One row for each method and split, one column for each score and space.

    Args:
        splits: name of a split -> scores of its methods and controls; others than those of
            memorization are left out.
        controls: subjects that are controls.
    """
    kept = {
        name: [s for s in scores if s.metric.startswith((SHARE, NEARNESS))]
        for name, scores in splits.items()
    }
    metrics = list(dict.fromkeys(s.metric for scores in kept.values() for s in scores))
    rows: list[list[Score | str | None]] = []
    for name, scores in kept.items():
        cells = {(s.subject, s.metric): s for s in scores}
        for subject in dict.fromkeys(s.subject for s in scores):
            rows.append([subject, name, *(cells.get((subject, metric)) for metric in metrics)])
    return StudyTable(
        "Memorization",
        "How near generated images lie to their nearest train image, against real test images: the "
        "share nearer than 5 % of these (0.05 is what real images score) and the probability that "
        "a generated image is nearer than a real one (0.5). Under a leaking split real images lie "
        "near train as well, which hides copies.",
        ["method", "split", *metrics],
        rows,
        controls=controls,
    )
