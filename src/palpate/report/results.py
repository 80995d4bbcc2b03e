"""Results: what the stages find, as plain data that the report draws and that JSON can hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.core.files import read_json, write_json
from palpate.core.samples import SampleRef
from palpate.core.score import Score

#: Rows of the group-by-part matrix that an audit keeps.
MATRIX_ROWS = 60


@dataclass(frozen=True)
class LeakPair:
    """A test sample beside the train sample that it leaks from.

    Attributes:
        gap: distance in frames, if both lie in one video; else None.
        score: strength of the signal in [0, 1]; None where only the gap is known.
        cause: for pictures that look alike, why (one of ``CAUSES``).
    """

    test: SampleRef
    train: SampleRef
    gap: int | None
    score: float | None = None
    cause: str = ""


#: Why two pictures look alike. Only ``content`` is a leak.
CAUSES = ("content", "nothing touched", "sensor drift")


@dataclass(frozen=True)
class Signal:
    """One kind of leak, over all test samples: what was looked at, and what was found.

    Attributes:
        kind: ``identical sample``, ``identical bytes``, ``shared video`` (or ``object``, ``session`` ...), ``time gap``,
            ``near-duplicate vision`` or ``near-duplicate touch``.
        checked: test samples that could be looked at (a null or unreadable one cannot).
        flagged: test samples that leak by this signal.
        threshold: the score from which a sample is flagged.
        false_positives: the rate at which unrelated samples would be flagged, which the threshold was calibrated to; None where
            the signal is exact.
        edges, unrelated, found: histograms of scores over the same bins, of unrelated pairs and of test samples against train
            (counts; ``len(edges) == len(found) + 1``); empty where nothing was calibrated.
        causes: test samples at or over the threshold by cause (``CAUSES``); empty where the signal has one cause.
        worst: the strongest pairs.
        notes: sentences for people.
        counts: whether flagged samples count as leaking; a shared group that the audit was not asked about is told but not counted.
    """

    kind: str
    checked: int
    flagged: int
    threshold: float
    false_positives: float | None = None
    edges: Sequence[float] = ()
    unrelated: Sequence[int] = ()
    found: Sequence[int] = ()
    causes: Mapping[str, int] = field(default_factory=dict)
    worst: Sequence[LeakPair] = ()
    notes: Sequence[str] = ()
    counts: bool = True

    @property
    def fraction(self) -> float:
        """Flagged share of the samples that could be looked at; 0 if there are none."""
        return self.flagged / self.checked if self.checked else 0.0


@dataclass(frozen=True)
class ImpactRow:
    """What leaking costs, for one kind of feature and one classifier: material accuracy, in [0, 1].

    Attributes:
        features: e.g. ``touch pixels`` or an encoder's name.
        classifier: ``1-NN`` or ``linear probe``.
        given, clean: accuracy on the test part of the given split and of the leak-free one.
        cost: ``given - clean``.
        given_interval, clean_interval, cost_interval: 95 % by leaving out whole groups; None with fewer than two.
        chance: 1 / materials.
    """

    features: str
    classifier: str
    given: float
    clean: float
    cost: float
    given_interval: tuple[float, float] | None
    clean_interval: tuple[float, float] | None
    cost_interval: tuple[float, float] | None
    chance: float


@dataclass(frozen=True)
class Impact:
    """What a split's leak does to scores: the same classifiers under the given split and under leak-free ones.

    Attributes:
        rows: one for each kind of features and classifier.
        headline: one sentence with the number that a user can put in a paper.
        group: the column kept whole by the leak-free splits and left out for the intervals.
        clean_splits: digests of the leak-free splits that ``clean`` averages over.
        settings: seeds, sizes, penalties and digests of features.
        notes: sentences for people.
    """

    rows: Sequence[ImpactRow]
    headline: str
    group: str
    clean_splits: Sequence[str]
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Impact:
        """The inverse of ``dataclasses.asdict``."""
        rows = [_impact_row(row) for row in data["rows"]]
        splits, settings, notes = (
            data["clean_splits"],
            data.get("settings", {}),
            data.get("notes", ()),
        )
        return cls(rows, data["headline"], data["group"], splits, settings, notes)


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
        against: what the test part was compared with: ``train``, or ``pretraining`` where a third list was given.
        signals: every kind of leak that was looked for, strongest evidence first.
        leaking_samples: test samples that any signal flags.
        matrix: rows ``{"group", "train", "val", "test", "leaking"}`` (counts of samples), shared groups with most test samples first; at
            most ``MATRIX_ROWS``, ``groups_in_all`` tells how many there are.
        impact: what the leak does to scores, if it was asked for.
        commands: command lines that say what to do next.
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
    against: str = "train"
    signals: Sequence[Signal] = ()
    leaking_samples: int = 0
    matrix: Sequence[Mapping[str, Any]] = ()
    groups_in_all: int = 0
    impact: Impact | None = None
    commands: Sequence[str] = ()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Audit:
        """The inverse of ``dataclasses.asdict``."""
        signals = [_signal(s) for s in data.get("signals", ())]
        impact = Impact.from_json(data["impact"]) if data.get("impact") else None
        fields: dict[str, Any] = {
            **data,
            "worst": _pairs(data.get("worst", ())),
            "signals": signals or (),
            "impact": impact,
        }
        for name in ("matrix", "commands"):  # an empty list reads as the default does
            fields[name] = fields.get(name) or ()
        return cls(**fields)


def _impact_row(data: Mapping[str, Any]) -> ImpactRow:
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
    return ImpactRow(**fields)


def _signal(data: Mapping[str, Any]) -> Signal:
    fields: dict[str, Any] = {**data, "worst": _pairs(data.get("worst", ()))}
    return Signal(**fields)


def _pairs(rows: Sequence[Mapping[str, Any]]) -> list[LeakPair]:
    return [
        LeakPair(
            SampleRef(**r["test"]),
            SampleRef(**r["train"]),
            r["gap"],
            r.get("score"),
            r.get("cause", ""),
        )
        for r in rows
    ]


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
        data["gallery"] = [
            GalleryItem(SampleRef(**g["sample"]), g["generated"], g.get("background"))
            for g in data.get("gallery", ())
        ]
        return cls(**data)

    def save(self, path: Path) -> None:
        """Writes the results as JSON, atomically."""
        write_json(path, self.to_json())

    @classmethod
    def load(cls, path: Path) -> Results:
        """Reads a results file; raises :class:`~palpate.core.errors.PalpateError` if it is missing or not JSON."""
        return cls.from_json(read_json(path, "results file"))
