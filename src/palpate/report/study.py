"""What a study adds to results: tables of scores and words, and claims with verdicts.

Every number in them is a :class:`~palpate.core.Score`; ``details["stage"]`` names the stage of the
run folder that it was made in, which ``palpate verify`` follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from palpate.core import Score

Verdict = Literal["holds", "does not hold", "undecided"]
#: Verdict -> the mark before its word, for those who do not see colors.
MARKS = {"holds": "✓", "does not hold": "✗", "undecided": "?"}


@dataclass(frozen=True)
class StudyTable:
    """A table of a study, e.g. one of the paper's.

    Attributes:
        title: its heading.
        text: what it shows and how to read it, in one or two sentences.
        columns: labels, the first of the row labels.
        rows: cells of each row, as many as ``columns``: words, scores, or None (nothing there).
        best: mark the best score of each column, by its direction, among the rows that are no
            controls.
        controls: labels (first cells) of the rows that are controls.
    """

    title: str
    text: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Score | str | None]]
    best: bool = False
    controls: Sequence[str] = ()


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, or of ours, with our evidence.

    Attributes:
        claim: what is claimed, in one sentence.
        source: where, e.g. ``"paper, table 1"``.
        verdict: what the evidence says.
        why: one sentence: the numbers that decide, or what is missing.
        evidence: the scores (or paired differences) that the verdict follows from.
        measured: whether what decides was measured at all; else it is undecided for want of data.
    """

    claim: str
    source: str
    verdict: Verdict
    why: str
    evidence: Sequence[Score] = ()
    measured: bool = True


def tally(claims: Sequence[Claim]) -> str:
    """Return how many claims have which verdict: ``4 hold, 1 undecided, 1 not measured``."""
    verdicts = [claim.verdict if claim.measured else "not measured" for claim in claims]
    counts = {verdict: verdicts.count(verdict) for verdict in (*MARKS, "not measured")}
    many = {"holds": "hold", "does not hold": "do not hold"}
    words = (
        f"{n} {verdict if n == 1 else many.get(verdict, verdict)}"
        for verdict, n in counts.items()
        if n
    )
    return ", ".join(words)


def brief(text: str, most: int = 220) -> str:
    """Return the first clauses of a long reason; its evidence has all of it."""
    if len(text) <= most:
        return text
    ends = (text.rfind("; ", 0, most), text.rfind(" ", 0, most), most)
    cut = text[: next(end for end in ends if end > 0)]
    return f"{cut.rpartition(' [')[0] if cut.count('[') > cut.count(']') else cut} …"
