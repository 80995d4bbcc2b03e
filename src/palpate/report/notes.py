"""Notes in words: a code and its parameters become a sentence of Python or of the command line.

The texts are in :mod:`palpate.report.note_texts`. A template is filled with the note's parameters:
``{count:vote}`` is ``2 votes``, ``{files:few}`` the first of a list, ``{few:one text|another}`` one
of two texts, ``{reason:undefined}`` the words of
:data:`~palpate.report.note_texts.WORDS`, and ``{arg:sigma=multi}`` ``sigma='multi'`` in Python and
``--sigma multi`` on the command line. Where a template cannot do, the text is a function of
parameters and style.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from string import Formatter
from typing import Any

from palpate.core import Note, few
from palpate.report.labels import percent, plural
from palpate.report.note_texts import SENTENCES, WORDS, Style

PYTHON, COMMAND_LINE = Style(), Style(command_line=True)


def sentence(note: Note, style: Style = PYTHON) -> str:
    """Return a note in words, without a full stop at the end."""
    template = SENTENCES.get(note.code)
    params = {"arg": style, "n": "", "labeled": True, "taken": "contact", **note.params}
    try:
        if callable(template):
            return template(note.params, style)
        if template is not None:
            return _Template(params).vformat(template, (), params)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        pass
    # A note of another version of palpate, or from a file that was edited.
    return ", ".join([note.code, *(f"{k} {v}" for k, v in note.params.items())])


class _Template(Formatter):
    """Fills templates with ``params``, as the head of this module says."""

    def __init__(self, params: Mapping[str, Any]) -> None:
        self.params = params

    def format_field(self, value: Any, format_spec: str) -> str:
        if "|" in format_spec:
            yes, no = format_spec.split("|")
            return yes if value else no
        if format_spec in WORDS:
            return self.vformat(WORDS[format_spec][value], (), self.params)
        if format_spec == "percent":
            return percent(value or 0.0)
        if isinstance(value, list | tuple):
            return few(value) if format_spec == "few" else ", ".join(map(str, value))
        if isinstance(value, Mapping):
            return ", ".join(f"{key} {item}" for key, item in value.items())
        if isinstance(value, int) and re.fullmatch("[a-z ]{2,}", format_spec):
            return plural(value, format_spec)
        return super().format_field(value, format_spec)
