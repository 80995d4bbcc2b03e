"""Numbers of two runs side by side: scores and audits, field by field.

Numbers agree if ``|a - b| <= tolerance * max(|a|, |b|)``, or to the sixth decimal: scores near zero
are differences of sums over embeddings of 32 bits, whose last ones depend on processor and threads.
p-values and effect sizes, which divide two such differences, and what is said of near-duplicates
have a tolerance of their own. Words, counts and digests agree if they are equal. Times, and the
version and stage that a score was made in, are not compared.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from palpate.core import Score, plain, short
from palpate.report.results import Audit

_DIGEST = re.compile("[0-9a-f]{64}")
#: Relative, for sums whose order may change from run to run.
TOLERANCE = 1e-6
#: Absolute, where the relative one is not 0.
DECIMAL = 1e-6
Status = Literal["same", "differs", "cannot check", "untraced"]
STATUSES: tuple[Status, ...] = ("same", "differs", "cannot check", "untraced")
#: Entries of details that no later run repeats.
_PASSING = ("version", "stage", "seconds")
#: Fields of an audit that are no numbers, or are compared on their own.
_OF_AUDITS = ("name", "notes", "commands", "call", "others", "impact")
#: Keys of samples that are places on one machine.
_PLACES = ("vision", "tactile", "background", "generated", "others")
#: Keys of what holds no numbers of a measurement.
_BESIDES = ("notes", "settings")
#: The least tolerance of some numbers. Descriptors of near-duplicates have 16 and 32 bits: another
#: order of their sums moves a threshold by 3e-5, and the score of a pair, of four digits, by one of
#: them. p-values and effect sizes of untrained models, 1e-5 apart, are moved by 2e-3.
LEAST = {
    **dict.fromkeys(("threshold", "score"), 5e-4),
    **dict.fromkeys(("p_value", "p_better", "p_adjusted", "effect size"), 5e-3),
}


@dataclass(frozen=True)
class Check:
    """What became of one number, or of one input.

    Attributes:
        name: what a table calls it.
        status: ``same``; ``differs``; ``cannot check``: an input is missing, or was in memory
            alone; ``untraced``: the file does not say where it comes from.
        why: the values that differ, or what is missing; '' where they are the same.
        kind: ``number`` or ``input``.
    """

    name: str
    status: Status
    why: str = ""
    kind: Literal["number", "input"] = "number"


def score_name(score: Score) -> str:
    """What a table calls it: ``TMMD of ours (grouped)``."""
    preset = score.settings.get("preset")
    return f"{score.metric} of {score.subject}" + (f" ({preset})" if preset else "")


def score_difference(before: Score, after: Score, tolerance: float) -> str:
    """The first field in which two scores differ, with both values; '' where none does."""
    a, b = plain(before), plain(after)
    if before.metric.startswith("effect size"):
        tolerance = max(tolerance, LEAST["effect size"])
    names = [name for name in a if name != "details"]
    details = {**a["details"], **b["details"]}.keys() - {*_PASSING}
    pairs = [(name, a[name], b[name]) for name in names]
    pairs += [(name, a["details"].get(name), b["details"].get(name)) for name in details]
    return _first(
        _difference(x, y, max(tolerance, LEAST.get(name, 0.0)), name.replace("_", " "))
        for name, x, y in pairs
    )


def audit_numbers(audit: Audit, start: str = "") -> dict[str, Any]:
    """The numbers of an audit by name; each row of a table, and each signal, is one."""
    numbers: dict[str, Any] = {}
    for name, value in plain(audit).items():
        if name in _OF_AUDITS:
            continue
        label = f"{start}{name.replace('_', ' ')}"
        if name in ("signals", "materials", "matrix"):
            numbers |= {f"{label}: {_label(row)}": row for row in value}
        else:
            numbers[label] = value
    if audit.impact is not None:
        impact = plain(audit.impact)
        rows = {f"{r['features']}, {r['classifier']}": r for r in impact.pop("rows")}
        numbers |= {f"{start}impact: {name}": row for name, row in rows.items()}
        impact.pop("notes")
        numbers[f"{start}impact"] = impact
    for other in audit.others:
        numbers |= audit_numbers(other, f"{start}against {other.against}: ")
    return numbers


def number_difference(before: Any, after: Any, tolerance: float) -> str:
    """Where two numbers, or rows of numbers, differ, with both values; '' where they do not."""
    return _difference(before, after, tolerance, "")


def _label(row: Mapping[str, Any]) -> str:
    """What a row is of: its first words."""
    return next((str(v) for v in row.values() if isinstance(v, str)), "of no name")


def _difference(a: Any, b: Any, tolerance: float, name: str) -> str:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        if str(a.get("metric")).startswith("effect size"):
            tolerance = max(tolerance, LEAST["effect size"])
        keys = [key for key in dict.fromkeys([*a, *b]) if not _passes(key, a, b)]
        return _first(
            _difference(
                a.get(key), b.get(key), max(tolerance, LEAST.get(key, 0.0)), f"{name} {key}".strip()
            )
            for key in keys
        )
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        short = len(a) == 2 and all(isinstance(v, int | float) for v in (*a, *b))
        return _first(
            _difference(x, y, tolerance, name if short else f"{name} {k}")
            for k, (x, y) in enumerate(zip(a, b, strict=True), 1)
        )
    if _close(a, b, tolerance):
        return ""
    return f"{name} {_text(a)} in the file, {_text(b)} now".strip()


def _passes(key: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether an entry is no number of a measurement: a time, a note, the path of an image."""
    x, y = a.get(key), b.get(key)
    if isinstance(x, Mapping) and isinstance(y, Mapping):  # images that stand next to one
        path = x.keys() == y.keys() and all(isinstance(v, str | None) for v in x.values())
    else:
        path = all(isinstance(value, str | None) for value in (x, y))
    return key in (*_PASSING, *_BESIDES) or (key in _PLACES and path)


def _first(differences: Iterable[str]) -> str:
    return next(filter(None, differences), "")


def _close(a: Any, b: Any, tolerance: float) -> bool:
    numbers = [v for v in (a, b) if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(numbers) < 2 or all(isinstance(v, int) for v in numbers):
        return type(a) is type(b) and a == b
    return abs(a - b) <= max(tolerance * max(abs(a), abs(b)), DECIMAL * (tolerance > 0))


def _text(value: Any) -> str:
    """A value in a line: a float by the digits that tell it from others, a list by its length."""
    if isinstance(value, float):
        return f"{value:.8g}"
    if isinstance(value, Sequence | Mapping) and not isinstance(value, str):
        return f"{len(value)} entries"
    if isinstance(value, str) and _DIGEST.fullmatch(value):
        return short(value)
    return "nothing" if value is None else f"{value}"[:80]
