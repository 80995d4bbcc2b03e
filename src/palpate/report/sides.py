"""Which real touches each score was compared with, so that scores of different references stand in tables of their own.

A *side* is a set of real touches: one digest of features an encoder, since an Inception network and a tactile encoder make different features of
the same pictures. Results of several files follow each other, so a new side begins where an encoder's reference becomes another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from palpate.core import Score

#: What a metric's name ends in where a score is the difference of two generators.
TAIL = " difference"


@dataclass(frozen=True)
class Sides:
    """Where scores stand.

    Attributes:
        of: the number of each score's side.
        bound: whether each score was compared with a reference at all.
        references: the digests of each side; '' where a score that must have one does not name it.
    """

    of: Sequence[int]
    bound: Sequence[bool]
    references: Sequence[Sequence[str]]


def sides(scores: Sequence[Score]) -> Sides:
    """The sides of scores in the order in which they were made.

    A score without reference (I-, CI-, D-TMMD, SSIM) goes with the scores of its subject: the last one before it, else the first one
    after it, that has a reference.
    """
    named = {s.metric.removesuffix(TAIL) for s in scores if s.reference}
    bound = [s.metric.removesuffix(TAIL) in named for s in scores]
    known: list[dict[str, str]] = []
    found: list[int | None] = []
    current = 0
    for score, fixed in zip(scores, bound, strict=True):
        if not fixed:
            found.append(None)
            continue
        encoder, reference = score.encoder or "", score.reference or ""
        same = [k for k, side in enumerate(known) if side.get(encoder) == reference]
        if same:
            current = current if current in same else same[0]
        elif not known or encoder in known[current]:
            known.append({})
            current = len(known) - 1
        known[current][encoder] = reference
        found.append(current)
    return Sides(
        _with_free(scores, found), bound, [list(dict.fromkeys(side.values())) for side in known]
    )


def _with_free(scores: Sequence[Score], found: Sequence[int | None]) -> list[int]:
    """Sides of all scores: those without one go with their subject, else with what stands before them."""
    first: dict[str, int] = {}
    for score, side in zip(scores, found, strict=True):
        if side is not None:
            first.setdefault(score.subject, side)
    last = dict(first)
    out: list[int] = []
    for score, side in zip(scores, found, strict=True):
        if side is not None:
            last[score.subject] = side
        out.append(last.get(score.subject, out[-1] if out else 0))
    return out
