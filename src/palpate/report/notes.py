"""The sentence of every note code: one table a room, in the wording of Python or of the command line.

A template is filled with the note's parameters. ``{arg:backend=blocked}`` in it becomes
``backend='blocked'`` for Python users and ``--backend blocked`` on the command line. Where one
template cannot do (plurals, optional parts), the entry is a function of the parameters and the style.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from palpate.core import Note


@dataclass(frozen=True)
class Style:
    """How arguments are written in a sentence: as Python keywords or as options."""

    command_line: bool = False

    def __format__(self, spec: str) -> str:
        """``name`` or ``name=value`` in this style."""
        name, equals, value = spec.partition("=")
        if self.command_line:
            return f"--{name.replace('_', '-')}" + (
                f" {value}" if value not in ("", "True") else ""
            )
        return (
            f"{name}={value if value in ('True', 'False', 'None') else repr(value)}"
            if equals
            else name
        )


PYTHON, COMMAND_LINE = Style(), Style(command_line=True)
Sentence = str | Callable[[Mapping[str, Any], Style], str]


def _fewer_scales(p: Mapping[str, Any], _: Style) -> str:
    why = f"five need {p['least']} pixels a side" if p["auto"] else "as requested"
    return (
        f"{p['scales']} of the 5 scales ({why}), weights divided by their sum: not comparable with "
        "MS-SSIM of 5"
    )


def _fid_biased(p: Mapping[str, Any], _: Style) -> str:
    if p["extrapolated"]:
        return (
            "Biased upwards at this size; its details have the extrapolation to infinitely many "
            "samples (infinity)"
        )
    return "Biased upwards, the more the fewer samples: compare at equal sizes only"


METRICS: dict[str, Sentence] = {
    "copied-rows": (
        "{count} of {n} generated rows equal a real row bit for bit: a copy is not a generator"
    ),
    "identical-pairs": ("{count} of {n} pairs are identical (infinite), excluded from the mean"),
    "all-identical": "Undefined: all {n} pairs are identical, so the value is infinite",
    "no-pair-has-a-value": "Undefined: no pair has a value",
    "no-interval-over-images": (
        "No interval: one image or one group, or no variation between them"
    ),
    "no-interval-over-groups": "No interval: one group, or no variation between them",
    "no-interval-few-units": "No interval: too few groups or samples to leave some out",
    "fewer-scales": _fewer_scales,
    "no-contact": "{count} of {n} real images show no contact, excluded from the mean",
    "empty-balls": "{count} of {n} {of} rows occur more than k times: their balls hold nothing",
    "fid-mostly-bias": (
        "Not meaningful: {n} samples do not span the {d} dimensions, so the value is mostly bias"
    ),
    "fid-biased": _fid_biased,
    "fid-difference-biased": "Of FID at this size, whose biases need not be equal",
    "kid-interval": (
        "The spread over random subsets that others print with KID is no interval; this one is"
    ),
}
LEAKAGE: dict[str, Sentence] = {}
EVALUATION: dict[str, Sentence] = {}
OTHER: dict[str, Sentence] = {"text": "{text}"}
SENTENCES: dict[str, Sentence] = METRICS | LEAKAGE | EVALUATION | OTHER


def sentence(note: Note | str, style: Style = PYTHON) -> str:
    """A note in words, without a full stop at the end.

    Raises:
        KeyError: for a code without a sentence, or a parameter that its template lacks.
    """
    if isinstance(note, str):  # until every room makes notes
        return note
    template = SENTENCES[note.code]
    if callable(template):
        return template(note.params, style)
    return template.format(arg=style, **note.params)
