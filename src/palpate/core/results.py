"""Results: what the stages find, as plain data that the report draws and that JSON can hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.core.files import read_json, write_json
from palpate.core.score import Score


@dataclass(frozen=True)
class SampleRef:
    """A sample as the report needs it. Paths are absolute or relative to the results file; None = no picture."""

    id: str
    video: str | None = None
    frame: int | None = None
    material: str | None = None
    vision: str | None = None
    tactile: str | None = None


@dataclass(frozen=True)
class LeakPair:
    """A test sample beside the train sample that is nearest to it in the same group. ``gap`` is in frames."""

    test: SampleRef
    train: SampleRef
    gap: int | None


@dataclass(frozen=True)
class Audit:
    """What the audit of one split found. Counts are samples; gaps are frames; fractions lie in [0, 1].

    Attributes:
        name: ``"Orig"``, ``"NoLeak"`` or a file name.
        group: the column that must not be shared (``video``, ``touch``, ``object`` ...).
        leaked_fraction: test samples in shared groups / test samples.
        gap_min, gap_median, gap_max: distance to the nearest train frame of the same video, over test samples that have one; else None.
        gap_edges, gap_counts: histogram of those distances; ``len(edges) == len(counts) + 1``.
        identical_samples: test samples whose id, or whose video and frame, are in train as well.
        worst: pairs with the smallest gaps, at most one a group first.
        materials: rows ``{"material", "train", "test", "groups_train", "groups_test"}``.
        notes: sentences for people (fallbacks, exclusions).
    """

    name: str
    group: str
    train_samples: int
    test_samples: int
    groups_train: int
    groups_test: int
    groups_shared: int
    test_samples_in_shared_groups: int
    leaked_fraction: float
    identical_samples: int
    gap_min: int | None = None
    gap_median: float | None = None
    gap_max: int | None = None
    gap_edges: Sequence[int] = ()
    gap_counts: Sequence[int] = ()
    worst: Sequence[LeakPair] = ()
    materials: Sequence[Mapping[str, Any]] = ()
    notes: Sequence[str] = ()
    split: str | None = None

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Audit:
        """The inverse of ``dataclasses.asdict``."""
        worst = [LeakPair(SampleRef(**w["test"]), SampleRef(**w["train"]), w["gap"]) for w in data.get("worst", ())]
        fields: dict[str, Any] = {**data, "worst": worst}
        return cls(**fields)


@dataclass(frozen=True)
class GalleryItem:
    """One row of the gallery: the photo, the real touch, the generated touch."""

    sample: SampleRef
    generated: str
    background: str | None = None


@dataclass(frozen=True)
class Results:
    """Everything a page shows.

    Attributes:
        title: heading of the page.
        facts: the headline facts, one sentence each.
        audits, scores, gallery: see there.
        settings: nested JSON of settings, digests, seeds, versions and times; the page prints it whole.
        notes: warnings that a reader must see (synthetic data, fallbacks, skipped inputs).
        commands: command lines that reproduce the run or say what to do next.
    """

    title: str
    facts: Sequence[str] = ()
    audits: Sequence[Audit] = ()
    scores: Sequence[Score] = ()
    gallery: Sequence[GalleryItem] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    commands: Sequence[str] = ()

    def to_json(self) -> dict[str, Any]:
        """A JSON object with ``format: palpate-results/1``."""
        data = dataclasses.asdict(self)
        data["scores"] = [s.to_json() for s in self.scores]
        return {"format": "palpate-results/1", **data}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Results:
        """The inverse of :meth:`to_json`."""
        data = {k: v for k, v in data.items() if k != "format"}
        data["audits"] = [Audit.from_json(a) for a in data.get("audits", ())]
        data["scores"] = [Score.from_json(s) for s in data.get("scores", ())]
        data["gallery"] = [GalleryItem(SampleRef(**g["sample"]), g["generated"], g.get("background")) for g in data.get("gallery", ())]
        return cls(**data)

    def save(self, path: Path) -> None:
        """Writes the results as JSON, atomically."""
        write_json(path, self.to_json())

    @classmethod
    def load(cls, path: Path) -> Results:
        """Reads a results file; raises :class:`~palpate.core.errors.PalpateError` if it is missing or not JSON."""
        return cls.from_json(read_json(path, "results file"))
