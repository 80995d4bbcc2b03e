"""Floors: the score of real samples next to that of a generator, where the two are comparable.

Values of halves of whole groups depend on the sizes of the groups, biased values on the number of
samples, means over classes on the classes. A floor of other ones would say nothing, and is left
out with a note; that of the excess E depends on the classes alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from palpate.core import Note, Score
from palpate.metrics.intervals import Scored

#: Designs that differ by less have one floor: the change is far below the noise of any floor.
SAME_DESIGN = 0.01


def not_comparable(result: Scored, floor: Scored) -> str:
    """Why real samples like these give another value of this metric; '' if they do not.

    Values of halves of whole groups depend on the sizes of the groups, biased values on n, a mean
    over classes on the classes.

    Returns:
        ``"classes"``, ``"groups"``, ``"group-sizes"``, ``"sizes"`` or ``""``.
    """
    if result.score.details.get("classes") != floor.score.details.get("classes"):
        return "classes"
    by_group = result.score.settings.get("halves") == "group"
    if by_group and list(result.groups) != list(floor.groups):
        return "groups"
    same = result.design.shape == floor.design.shape
    if not same or not np.allclose(result.design, floor.design, rtol=SAME_DESIGN, atol=0):
        return "group-sizes" if by_group else "sizes"
    return ""


def with_floor(result: Scored, floor: Scored) -> Scored:
    """The score with that of real samples as its floor, where the two are comparable.

    E of CI-TMMD has as its floor that of the real samples of the generator's classes, E_ratio of
    D-TMMD none where the classes differ.
    """
    details, real = result.score.details, floor.score.details
    reason = not_comparable(result, floor)
    classes = details.get("classes")
    more: dict[str, Any] = {}
    if "E" in details:
        same = classes == real.get("classes")
        more["E_floor"] = real.get("E") if same else _mean_excess(floor.score, classes or [])
    if "E_ratio" in details:
        more["E_ratio_floor"] = real.get("E_ratio") if classes == real.get("classes") else None
    notes = list(result.score.notes)
    if reason and result.score.value is not None:
        notes.append(Note("no-floor", {"reason": reason}))
    value = None if reason else floor.score.value
    score = replace(result.score, floor=value, details={**details, **more}, notes=tuple(notes))
    return replace(result, score=score)


def _mean_excess(score: Score, classes: Sequence[str]) -> float | None:
    """The mean E of some classes, None unless all are known."""
    per_class = score.details.get("per_class", {})
    each = [per_class.get(name, {}).get("E") for name in classes]
    return sum(each) / len(each) if each and None not in each else None
