"""What results hold: pairs and signals of an audit, its cost, images, and what a study adds.

Every number of a study is a :class:`~palpate.core.Score`; ``details["stage"]`` names the stage of
the run folder that it was made in, which ``palpate verify`` follows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from palpate.core import NO_LEAK, Note, SampleRef, Score

#: Why two images are similar. Only ``content`` is a leak.
CAUSES = ("content", "nothing touched")
#: The verdicts on a question and on a split, from worst to best.
LEAKS, CANNOT_TELL = "leaks", "cannot tell"
VERDICTS = (LEAKS, CANNOT_TELL, NO_LEAK)
Verdict = Literal["holds", "does not hold", "undecided"]


@dataclass(frozen=True)
class LeakPair:
    """A test sample and the train sample that it leaks from.

    Attributes:
        gap: distance in frames, if both lie in one video; else None.
        score: strength of the signal in [0, 1]; None where only the gap is known.
        cause: why two images are similar (one of ``CAUSES``).
    """

    test: SampleRef
    train: SampleRef
    gap: int | None
    score: float | None = None
    cause: str = ""

    @property
    def has_photos(self) -> bool:
        """Whether either sample has a photo."""
        return bool(self.test.vision or self.train.vision)


@dataclass(frozen=True)
class Signal:
    """One kind of leak, over all test samples.

    Attributes:
        kind: ``identical sample``, ``identical bytes``, ``shared video`` (or ``object`` ...),
            ``time gap``, ``near-duplicate vision`` or ``near-duplicate tactile``.
        checked: test samples that could be checked (a null or unreadable one cannot).
        flagged: test samples that leak by this signal.
        threshold: the score from which a sample is flagged.
        false_positives: the rate at which unrelated samples are flagged, which the threshold was
            calibrated to; None where the signal is exact.
        edges, unrelated, matches: histograms of scores over the same bins, of unrelated pairs and
            of test samples against train (counts; ``len(edges) == len(matches) + 1``); empty where
            nothing was calibrated.
        causes: test samples at or over the threshold by cause (``CAUSES``); empty where the signal
            has one cause.
        worst: the strongest pairs.
        notes: what a reader must know.
        counts: whether flagged samples count as leaking; a shared group other than the audit's is
            reported but not counted, nor are as many near-duplicates as chance explains.
        verdict: of near-duplicates, one of ``VERDICTS`` (with ``cannot tell``, ``worst`` is a
            ranking); '' where the signal is exact.
        expected: samples that chance alone flags at ``false_positives``; None if not known.
        measured: the rate at which train images of other videos are flagged by thresholds from
            the other half of the videos; None if not known.
    """

    kind: str
    checked: int
    flagged: int
    threshold: float
    false_positives: float | None = None
    edges: Sequence[float] = ()
    unrelated: Sequence[int] = ()
    matches: Sequence[int] = ()
    causes: Mapping[str, int] = field(default_factory=dict)
    worst: Sequence[LeakPair] = ()
    notes: Sequence[Note] = ()
    counts: bool = True
    verdict: str = ""
    expected: float | None = None
    measured: float | None = None

    @property
    def fraction(self) -> float:
        """Flagged share of the samples that could be checked; 0 if there are none."""
        return self.flagged / self.checked if self.checked else 0.0


@dataclass(frozen=True)
class Question:
    """One question of an audit, and its answer.

    Attributes:
        name: ``shared recordings``, ``near in time`` or ``near-duplicates``.
        verdict: one of ``VERDICTS``; '' where it was not asked.
        leaking: test samples that a signal of it flags.
        checked: test samples that could be judged, of ``of``.
        reason: why it was not asked, or cannot be told for too many samples: then there may be more
            leaks than ``leaking``; '' else.
    """

    name: str
    verdict: str
    leaking: int = 0
    checked: int = 0
    of: int = 0
    reason: str = ""


@dataclass(frozen=True)
class ImpactRow:
    """What leaking costs, for one kind of feature and one classifier: material accuracy, in [0, 1].

    Attributes:
        features: e.g. ``tactile pixels`` or an encoder's name.
        classifier: ``1-NN`` or ``linear probe``.
        given, clean: accuracy on the test part of the given split and of the leak-free one.
        cost: ``given - clean``.
        given_interval, clean_interval, cost_interval: 95 %, leaving out whole groups; None with
            fewer than two.
        chance: 1 / materials.
        group: the column that the leak-free splits keep whole.
        seen: whether the encoder of the features was trained on some of the samples.
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
    group: str
    seen: bool = False


@dataclass(frozen=True)
class Impact:
    """What a leak does to scores: the same classifiers under the given and leak-free splits.

    Attributes:
        rows: one for each kind of features and classifier.
        headline: one sentence with the number to put in a paper.
        group: the column kept whole by the leak-free splits and left out for the intervals.
        clean_splits: digests of the leak-free splits that ``clean`` averages over.
        settings: seeds, sizes, penalties and digests of features.
        notes: what a reader must know.
    """

    rows: Sequence[ImpactRow]
    headline: str
    group: str
    clean_splits: Sequence[str]
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[Note] = ()


@dataclass(frozen=True)
class GalleryItem:
    """One row of the gallery: the photo, the real tactile image, the generated one.

    Attributes:
        sample: photo and real image.
        generated: path of the generated image.
        background: that of the image without contact.
        method: what generated it.
    """

    sample: SampleRef
    generated: str | None
    background: str | None = None
    method: str = ""


@dataclass(frozen=True)
class Match:
    """A key that retrieval put high: its sample, or its text; ``similarity`` is the cosine."""

    sample: SampleRef
    similarity: float
    right: bool
    text: str = ""


@dataclass(frozen=True)
class Strip:
    """One query and what an encoder finds most similar to it.

    Attributes:
        query: the sample; ``query_text`` its text, where that is the query.
        queries, keys: the modalities: ``tactile``, ``vision`` or ``text``.
        matches: the most similar keys, best first.
        rank: of the query's own key, from 1; as many as are equal to it share one.
        subject: which encoder, or split, this is of.
    """

    query: SampleRef
    queries: str
    keys: str
    matches: Sequence[Match]
    rank: int
    subject: str = ""
    query_text: str = ""


@dataclass(frozen=True)
class StudyTable:
    """A table of a study, e.g. one of the paper's.

    Attributes:
        title: its heading.
        text: what it shows and how to read it, in one or two sentences.
        columns: labels, the first of the row labels.
        rows: cells of each row, as many as ``columns``: words, scores, or None (nothing there).
        best: mark the best score of each column, by its direction, among the rows that are no
            controls.
        controls: labels (first cells) of the rows that are controls.
    """

    title: str
    text: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Score | str | None]]
    best: bool = False
    controls: Sequence[str] = ()


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, or of ours, with our evidence.

    Attributes:
        claim: what is claimed, in one sentence.
        source: where, e.g. ``"paper, table 1"``.
        verdict: what the evidence says.
        why: one sentence: the numbers that decide, or what is missing.
        evidence: the scores (or paired differences) that the verdict follows from.
        measured: whether what decides was measured at all; else it is undecided for want of data.
    """

    claim: str
    source: str
    verdict: Verdict
    why: str
    evidence: Sequence[Score] = ()
    measured: bool = True
