"""What results hold besides numbers: notes, and references to samples.

A note is what a reader must know about a number, as a code with parameters. Rooms make notes;
:mod:`palpate.report.notes` has the sentence of each code. No program parses a sentence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Note:
    """One thing that a reader must know.

    Attributes:
        code: stable and lower-case, words joined by hyphens (``"copied-rows"``).
        params: what the sentence is filled with; plain JSON values.
    """

    code: str
    params: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SampleRef:
    """A sample. Image paths are absolute or relative to the results file; None = no image."""

    id: str
    video: str | None = None
    frame: int | None = None
    material: str | None = None
    vision: str | None = None
    tactile: str | None = None
    background: str | None = None
