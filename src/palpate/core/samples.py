"""How results refer to a sample: its names and the paths of its images."""

from __future__ import annotations

from dataclasses import dataclass


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
