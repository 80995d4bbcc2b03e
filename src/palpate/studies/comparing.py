"""Numbers of two runs side by side: scores and audits, field by field.

Numbers agree if ``|a - b| <= tolerance * max(|a|, |b|, scale / 1e6)``: relative, but for values
near zero, which are differences of sums of the size of the scale; thresholds and scores of
near-duplicates have a tolerance of their own. Words, counts and digests agree if they are equal.
Times, and the version and stage that a score was made in, are not compared.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from palpate.core import Score, plain, short
from palpate.report.results import Audit

_DIGEST = re.compile("[0-9a-f]{64}")
#: Relative, for sums whose order may change from run to run.
TOLERANCE = 1e-6
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
#: The least tolerance of near-duplicates, whose descriptors have 16 and 32 bits: two threads in the
#: place of one move a threshold by 3e-5, and the score of a pair, of four digits, by one of them.
NEAR, NEAR_TOLERANCE = ("threshold", "score"), 5e-4


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
    a, b, scale = plain(before), plain(after), abs(before.scale)
    fields = ((name.replace("_", " "), a[name], b[name]) for name in a if name != "details")
    details = {**a["details"], **b["details"]}.keys() - {*_PASSING}
    parts = ((n.replace("_", " "), a["details"].get(n), b["details"].get(n)) for n in details)
    return _first(fields, tolerance, scale) or _first(parts, tolerance, scale)


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
    return _difference(before, after, tolerance, 1.0, "")


def _label(row: Mapping[str, Any]) -> str:
    """What a row is of: its first words."""
    return next((str(v) for v in row.values() if isinstance(v, str)), "of no name")


def _difference(a: Any, b: Any, tolerance: float, scale: float, name: str) -> str:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        keys = [key for key in dict.fromkeys([*a, *b]) if not _passes(key, a, b)]
        differences = (
            _difference(
                a.get(key),
                b.get(key),
                max(tolerance, NEAR_TOLERANCE) if key in NEAR else tolerance,
                scale,
                f"{name} {key}".strip(),
            )
            for key in keys
        )
        return next(filter(None, differences), "")
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        short = len(a) == 2 and all(isinstance(v, int | float) for v in (*a, *b))
        pairs = ((name if short else f"{name} {k + 1}", *v) for k, v in enumerate(zip(a, b)))  # noqa: B905 - of one length
        return _first(pairs, tolerance, scale)
    if _close(a, b, tolerance, scale):
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


def _first(pairs: Iterator[tuple[str, Any, Any]], tolerance: float, scale: float) -> str:
    differences = (_difference(a, b, tolerance, scale, name) for name, a, b in pairs)
    return next(filter(None, differences), "")


def _close(a: Any, b: Any, tolerance: float, scale: float) -> bool:
    numbers = [v for v in (a, b) if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(numbers) < 2 or all(isinstance(v, int) for v in numbers):
        return type(a) is type(b) and a == b
    return abs(a - b) <= tolerance * max(abs(a), abs(b), scale / 1e6)


def _text(value: Any) -> str:
    """A value in a line: a float by the digits that tell it from others, a list by its length."""
    if isinstance(value, float):
        return f"{value:.8g}"
    if isinstance(value, Sequence | Mapping) and not isinstance(value, str):
        return f"{len(value)} entries"
    if isinstance(value, str) and _DIGEST.fullmatch(value):
        return short(value)
    return "nothing" if value is None else f"{value}"[:80]
