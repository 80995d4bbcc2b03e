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

METRICS: dict[str, Sentence] = {}
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
