"""Notes: what a reader must know about a number, as a code with parameters.

Rooms make notes; :mod:`palpate.report.notes` has the sentence of each code. No program parses a
sentence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from palpate.core.records import from_plain


@dataclass(frozen=True)
class Note:
    """One thing that a reader must know.

    Attributes:
        code: stable and lower-case, words joined by hyphens (``"copied-rows"``).
        params: what the sentence is filled with; plain JSON values.
    """

    code: str
    params: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the note as a JSON object."""
        return {"code": self.code, "params": dict(self.params)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any] | str) -> Note:
        """Return the inverse of :meth:`to_json`; a string, as format 1 had it, becomes ``text``."""
        if isinstance(data, str):
            return cls("text", {"text": data})
        return from_plain(cls, data)
