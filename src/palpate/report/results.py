"""What the verbs return: plain data that pages, tables and JSON files are written from.

:class:`Results` holds scores and audits, :class:`Audit` the leaks of one split. Both can show
themselves: ``print(results)``, ``results.to_html("page.html")``, ``results.to_latex()``,
``results.to_frame()``.
"""

from __future__ import annotations

import html
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, overload

from palpate.core.errors import PalpateError
from palpate.core.files import plain, read_record, reading_entry, write_json
from palpate.core.notes import Note, SampleRef
from palpate.core.records import from_plain
from palpate.core.score import Score
from palpate.report.calls import Call
from palpate.report.labels import label_of, subject_of
from palpate.report.study import Claim, StudyTable

if TYPE_CHECKING:
    import polars as pl

RESULTS_FORMAT, AUDIT_FORMAT = "palpate-results/1", "palpate-audit/1"
#: The verdict where a leak could not show.
CANNOT_TELL = "cannot tell"
#: Keys of their JSON that are no fields.
COMMAND_KEYS = ("format", "skipped", "failed")
#: Rows of the group-by-part matrix that an audit keeps.
MATRIX_ROWS = 60
#: Why two images are similar. Only ``content`` is a leak.
CAUSES = ("content", "nothing touched")


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
        verdict: of near-duplicates: ``leaks``, ``none``, or ``cannot tell`` (``worst`` is then a
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


class Shown:
    """What audits and results share: they print themselves, and are JSON of a format."""

    form: ClassVar[str]

    def __str__(self) -> str:
        """The tables, findings, notes and claims, as in the terminal."""
        return _writer("terminal").as_text(self)

    def _repr_html_(self) -> str:
        """For notebooks: the same as :meth:`__str__`."""
        return f'<pre style="line-height: 1.3">{html.escape(str(self))}</pre>'

    def to_json(self) -> dict[str, Any]:
        """A JSON object with its ``format``."""
        return {"format": self.form, **plain(self)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`; keys that a command adds are ignored."""
        return from_plain(cls, {k: v for k, v in data.items() if k not in COMMAND_KEYS})

    @classmethod
    def _read(cls, path: Path, role: str) -> Self:
        data = read_record(path, f"{role} file", form=cls.form)
        with reading_entry(path, f"The {role}"):
            return cls.from_json(data)


@dataclass(frozen=True)
class Audit(Shown):
    """The leaks of one split. Counts are samples; gaps are frames; fractions lie in [0, 1].

    Attributes:
        name: ``"Orig"``, ``"NoLeak"`` or a file name.
        group: the column that must not be shared (``video``, ``contact``, ``object`` ...).
        leaked_fraction: ``leaking_samples`` / ``test_samples``; 0 without test samples.
        gap_min, gap_median, gap_max: distance to the nearest train frame of the same video, over
            test samples that have one; else None.
        gap_edges, gap_counts: histogram of those distances; ``len(edges) == len(counts) + 1``.
        identical_samples: test samples whose id, or whose video and frame, are in train as well.
        worst: pairs with the smallest gaps, at most one a group first.
        materials: rows ``{"material", "train", "test", "groups_train", "groups_test"}``.
        notes: what a reader must know (fallbacks, exclusions).
        against: what the test part was compared with: ``train``, or ``pretraining`` where a third
            list was given.
        signals: every kind of leak that was checked, strongest evidence first.
        leaking_samples: test samples that any signal flags.
        matrix: rows ``{"group", "train", "val", "test", "leaking"}`` (counts of samples), shared
            groups with most test samples first; at most ``MATRIX_ROWS`` of ``groups_in_all``.
        shared: column (video, session, object) that both parts know -> (test groups that are in
            train, test groups): whether the test part asks for new videos, or for new objects.
        verdict: ``leaks``, ``none``, or ``cannot tell``.
        reason: why a leak might not show: nothing was touched (``untouched``), images are similar
            (``similar``), none are known to be unrelated (``chance``), there are none and equal
            names mean nothing (``names``), or ids alone are known (``ids``).
        impact: what the leak does to scores, if requested.
        commands: command lines that say what to do next.
        others: audits of the same test part against other data (an encoder's pretraining list).
        call: what made it, for ``palpate verify``.
        table: a polars frame with every signal of every test sample; not in the JSON.
    """

    form: ClassVar[str] = AUDIT_FORMAT
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
    notes: Sequence[Note] = ()
    split: str | None = None
    against: str = "train"
    signals: Sequence[Signal] = ()
    leaking_samples: int = 0
    matrix: Sequence[Mapping[str, Any]] = ()
    groups_in_all: int = 0
    shared: Mapping[str, Sequence[int]] = field(default_factory=dict)
    verdict: str = ""
    reason: str = ""
    impact: Impact | None = None
    commands: Sequence[str] = ()
    others: Sequence[Audit] = ()
    call: Call | None = None
    table: Any = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.test_samples:
            share = self.leaking_samples / self.test_samples
            object.__setattr__(self, "leaked_fraction", round(share, 5) or share)

    def to_html(self, path: str | Path) -> None:
        """Write a self-contained page, with images of the strongest pairs."""
        self.to_results().to_html(path)

    def to_results(self) -> Results:
        """This audit, with :attr:`others`, as the results of a page."""
        return Results(title=f"Audit of {self.name}", audits=[self, *self.others])

    def to_frame(self) -> pl.DataFrame:
        """Every signal of every test sample, one row each.

        Raises:
            PalpateError: if the audit was read from a file, which holds no table.
        """
        if self.table is None:
            raise PalpateError(
                "The table of an audit must be of an audit that has just run",
                "an audit read from a file",
                "Run the audit again",
            )
        return self.table

    def save(self, path: str | Path) -> None:
        """Write the audit as JSON, atomically; paths of inputs become relative to its folder."""
        change = _from_folder(Path(path).parent, Path())
        call = self.call and self.call.with_paths(change)
        write_json(Path(path), replace(self, call=call).to_json())

    @classmethod
    def load(cls, path: str | Path) -> Audit:
        """Read an audit file.

        Raises:
            PalpateError: if it is missing, or no audit.
        """
        audit = cls._read(Path(path), "audit")
        call = audit.call and audit.call.with_paths(_below(Path(path).parent))
        return replace(audit, call=call)


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
class Results(Shown):
    """Scores, audits and images of a run: a table of scores that can also be drawn as a page.

    Iterates over its scores; ``results["TMMD"]`` lists those of a column, by its printed name (as
    ``"FID (Inception)"``), ``results["TMMD", "ours"]`` is that of generator ``ours`` (of several
    presets the first; ``results["TMMD", "ours", "paper"]`` names one).

    Attributes:
        title: heading of the page.
        facts: the headline facts, one sentence each.
        audits, scores, gallery: what the page shows.
        settings: nested JSON of settings, digests, seeds, versions and times.
        notes: what a reader must see first (synthetic data, fallbacks, skipped inputs).
        commands: command lines that reproduce the run or say what to do next.
        strips: what an encoder retrieved for some queries.
        tables, claims: of a study.
        calls: what made the scores, for ``palpate verify``; audits have their own.
    """

    form: ClassVar[str] = RESULTS_FORMAT
    title: str
    facts: Sequence[str] = ()
    audits: Sequence[Audit] = ()
    scores: Sequence[Score] = ()
    gallery: Sequence[GalleryItem] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[Note] = ()
    commands: Sequence[str] = ()
    strips: Sequence[Strip] = ()
    tables: Sequence[StudyTable] = ()
    claims: Sequence[Claim] = ()
    calls: Sequence[Call] = ()

    def __iter__(self) -> Iterator[Score]:
        return iter(self.scores)

    def __len__(self) -> int:
        """The number of scores."""
        return len(self.scores)

    def __bool__(self) -> bool:
        return True

    @overload
    def __getitem__(self, key: str) -> list[Score]: ...
    @overload
    def __getitem__(self, key: tuple[str, ...]) -> Score: ...
    @overload
    def __getitem__(self, key: int) -> Score: ...
    def __getitem__(self, key: int | str | tuple[str, ...]) -> list[Score] | Score:
        """The scores of a column, the score of (column, row) or of (column, row, preset).

        A number is a place in ``scores``.

        Raises:
            KeyError: if there is none; lists what there is.
        """
        if isinstance(key, int):
            return self.scores[key]
        names = (key,) if isinstance(key, str) else key
        matches = [score for score in self.scores if _key(score)[: len(names)] == names]
        if not matches:
            listed = dict.fromkeys(", ".join(_key(s)[: len(names)]) for s in self.scores)
            raise KeyError(
                f"no score of {', '.join(names)}; there is {'; '.join(listed) or 'none'}"
            )
        return matches if isinstance(key, str) else matches[0]

    @property
    def controls(self) -> set[str]:
        """The subjects that a table of the study names as controls."""
        return {name for table in self.tables for name in table.controls}

    def to_html(self, path: str | Path) -> None:
        """Write a self-contained page and, next to it, the same as ``.json`` and ``.md``.

        Raises:
            PalpateError: if ``path`` does not end in ``.html``, or scores of different settings
                would share a column.
        """
        _writer("page").write_report(self, Path(path), base=Path())

    def to_markdown(self) -> str:
        """Everything as Markdown, with paths in place of images."""
        return _writer("markdown").render_markdown(self)

    def to_latex(self) -> str:
        """Scores, tables of a study and claims as LaTeX tables (booktabs)."""
        return _writer("latex").latex_tables(self)

    def save_figures(self, folder: str | Path) -> list[Path]:
        """Write the figures of a paper: strips of scores as SVG, images as PNG; all are white.

        Returns:
            The files.

        Raises:
            PalpateError: if scores of different settings would share a column.
        """
        return _writer("figures").save_figures(self, Path(folder), base=Path())

    def to_frame(self) -> pl.DataFrame:
        """A polars frame, one row a score, with its interval, null and settings."""
        import polars as pl

        from palpate.report.notes import sentence

        names = "metric features kernel kind a b value level interval_method floor"
        names += " estimator bandwidth scale n m seed"
        names += " higher_is_better encoder reference split"
        rows: list[dict[str, Any]] = []
        for score in self.scores:
            row = {name: getattr(score, name) for name in names.split()}
            for name in ("interval", "null"):
                low, high = getattr(score, name) or (None, None)
                row |= {f"{name}_low": low, f"{name}_high": high}
            preset = score.settings.get("preset")
            notes = "; ".join(map(sentence, score.notes))  # flat, so that the frame fits a CSV
            rows.append(row | {"preset": preset, "notes": notes})
        return pl.DataFrame(rows, infer_schema_length=None)

    def relative_to(self, folder: Path, base: Path) -> Results:
        """The results with paths relative to ``folder`` instead of ``base``.

        So they stay right when a run folder is moved as a whole.
        """
        change = _from_folder(folder, base)
        return self.with_paths(change).with_call_paths(change)

    def with_paths(self, change: Callable[[str], str | None]) -> Results:
        """The results with ``change`` applied to the path of every image; None removes it."""
        return _with_paths(self, change)

    def with_call_paths(self, change: Callable[[str], str]) -> Results:
        """The results with ``change`` applied to the path of every input of their calls."""
        audits = [replace(a, call=a.call and a.call.with_paths(change)) for a in self.audits]
        return replace(self, audits=audits, calls=[c.with_paths(change) for c in self.calls])

    def save(self, path: str | Path) -> None:
        """Write the results as JSON, atomically; paths become relative to its folder."""
        folder = Path(path).parent
        write_json(Path(path), self.relative_to(folder, base=Path()).to_json())

    @classmethod
    def load(cls, path: str | Path) -> Results:
        """Read a results file.

        Raises:
            PalpateError: if it is missing, or holds no results.
        """
        results, change = cls._read(Path(path), "results"), _below(Path(path).parent)
        return results.with_paths(change).with_call_paths(change)


def _from_folder(folder: Path, base: Path) -> Callable[[str], str]:
    """Paths from ``base`` as paths from ``folder``."""
    start, end = base.resolve(), folder.resolve()
    return lambda name: Path(os.path.relpath(start / name, end)).as_posix()


def _below(folder: Path) -> Callable[[str], str]:
    """Paths from ``folder`` as paths from the working directory."""
    return lambda name: os.path.normpath(folder / name)


#: Fields of a sample, and of a row of the gallery, that are paths of images.
_PATHS: dict[type, tuple[str, ...]] = {
    SampleRef: ("vision", "tactile", "background"),
    GalleryItem: ("generated", "background"),
}


def _with_paths(value: Any, change: Callable[[str], str | None]) -> Any:
    """A result, or a part of one, with ``change`` applied to the path of every image in it."""
    if isinstance(value, list | tuple):
        return [_with_paths(item, change) for item in value]
    if not isinstance(
        value, (SampleRef, LeakPair, Signal, Audit, GalleryItem, Match, Strip, Results)
    ):
        return value
    paths, names = _PATHS.get(type(value), ()), [field.name for field in fields(value)]
    of_image = lambda path: None if path is None else change(path)
    inside = lambda part: _with_paths(part, change)
    return replace(
        value, **{n: (of_image if n in paths else inside)(getattr(value, n)) for n in names}
    )


def _writer(name: str) -> Any:
    """Load a writer when it is used: writers import the results, and some are heavy."""
    return import_module(f"palpate.report.{name}")


def _key(score: Score) -> tuple[str, str, str]:
    return label_of(score), subject_of(score), str(score.settings.get("preset", ""))
