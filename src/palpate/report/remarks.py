"""What a reader must know of a score beyond its numbers, sentence by sentence, so that tables can number the sentences and say each one once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from palpate.core import Score
from palpate.report.notes import EXCLUDED, sentence
from palpate.report.text import defined

#: Said of every interval over frames, in the words that the metrics use.
INDEPENDENT = "The interval takes samples as independent; frames of one video are not: give groups"
#: Said of differences of metrics without a direction, whose verdict is not that of the interval beside it.
NEARER = "Which is nearer to the floor: confidence and p are of |a - floor| - |b - floor|"
#: Names in a sentence; the others are counted.
NAMES = 5
#: How classes of samples without a label are called in ``details["excluded"]``.
_UNLABELED = "(no label)"


def few(names: Sequence[str]) -> str:
    """``"a, b, c, d, e and 3 more"``."""
    return ", ".join(names[:NAMES]) + (
        f" and {len(names) - NAMES} more" if len(names) > NAMES else ""
    )


def sentences(score: Score) -> list[str]:
    """The note of a score, cut into its sentences; a long list of unstable classes is cut short."""
    note, unstable = score.note, score.details.get("unstable")
    if isinstance(unstable, Sequence) and not isinstance(unstable, str) and len(unstable) > NAMES:
        names = [str(name) for name in unstable]
        note = note.replace(", ".join(names), few(names))
    return [text for text in note.split(". ") if text] + [sentence(n) for n in score.notes]


def reason(score: Score) -> str:
    """Why a score is undefined; '' for a score with a value."""
    if defined(score):
        return ""
    said = sentences(score)
    return next(
        (text for text in said if text.startswith("Undefined")),
        next(iter(said), "Undefined: no reason recorded"),
    )


def remarks(score: Score) -> list[str]:
    """Sentences on how a score was made, without the reason of an undefined one: its note, the classes left out, intervals over frames."""
    said = [text for text in sentences(score) if text != reason(score)]
    said += filter(None, [left_out(score)])
    if "as independent" in score.interval_method and INDEPENDENT not in said:
        said.append(INDEPENDENT)
    said += [NEARER] if by_gap(score) else []
    return said if defined(score) else [text for text in said if text != INDEPENDENT]


def by_gap(score: Score) -> bool:
    """Whether a score is a difference that is decided by the distances of both to the floor."""
    return score.higher_is_better is None and score.details.get("gap") is not None


def left_out(score: Score) -> str:
    """``"Left out: v0c (all samples are of one group)"``: the classes that do not count, by reason; '' where all do."""
    excluded: Any = score.details.get("excluded")
    if (
        not isinstance(excluded, Mapping)
        or not excluded
        or (not defined(score) and set(excluded) == {_UNLABELED})
    ):
        return ""
    reasons: dict[str, list[str]] = {}
    for name, why in excluded.items():
        reasons.setdefault("" if name == _UNLABELED else EXCLUDED.get(why, str(why)), []).append(
            "samples without a label" if name == _UNLABELED else str(name)
        )
    room, parts = NAMES, list[str]()
    for why, names in reasons.items():
        shown, room = names[:room], room - len(names[:room])
        parts += [", ".join(shown) + (f" ({why})" if why else "")] if shown else []
    more = len(excluded) - NAMES
    return f"Left out: {'; '.join(parts)}" + (f"; and {more} more" if more > 0 else "")


def no_floor(score: Score) -> str:
    """Why a score of the TMMD family has no floor; '' where it has one or its note says why, and for metrics that never do."""
    name = score.metric.split(" (")[0]
    if (
        score.floor is not None
        or not defined(score)
        or any(text.startswith("No floor") for text in sentences(score))
    ):
        return ""
    if name == "TMMD":
        return "No floor: that of TMMD is made of further real touches, the train part of a split"
    return (
        "No floor: no such value of real touches is known"
        if name.removesuffix(" E") in ("I-TMMD", "CI-TMMD", "D-TMMD")
        else ""
    )


class Footnotes:
    """Sentences in the order of first use; the same sentence has one number."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def numbers(self, said: Iterable[str]) -> list[int]:
        """The numbers, from 1, of some sentences, in rising order."""
        wanted = dict.fromkeys(said)
        self.texts += [text for text in wanted if text not in self.texts]
        return sorted(self.texts.index(text) + 1 for text in wanted)
