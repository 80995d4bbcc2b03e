"""What the verbs return: plain data that pages, tables and JSON files are written from.

:class:`Results` holds scores and audits, :class:`Audit` the leaks of one split. Both can show
themselves: ``print(results)``, ``results.to_html("page.html")``, ``results.to_latex()``,
``results.to_frame()``. Each has the :class:`Call` that made it, so that ``palpate verify`` can make
it again: in JSON, an argument that is a path is ``{"$path": path, "$digest": SHA-256}``, of a
file, of the table of a manifest, or of the weights of an encoder. Folders of images have no digest
there; ``Call.digests`` has those of the images that were read. An argument that was in memory alone
(an array, a frame) is ``{"$object": type}``: nobody can read it again.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, ClassVar, Self, Unpack, overload

from palpate.core.files import (
    digest_file,
    digest_folder,
    is_there,
    plain,
    read_record,
    reading_entry,
    write_json,
)
from palpate.core.hub import PushOptions, at_revision, fetched_file, push, write_card
from palpate.core.messages import Note, PalpateError, SampleRef
from palpate.core.records import from_plain
from palpate.core.score import Score
from palpate.core.shown import Shown
from palpate.report.labels import label_of, subject_of
from palpate.report.records import (
    LEAKS,
    NO_LEAK,
    VERDICTS,
    Claim,
    GalleryItem,
    Impact,
    LeakPair,
    Question,
    Signal,
    Strip,
    StudyTable,
)

if TYPE_CHECKING:
    import polars as pl

RESULTS_FORMAT, AUDIT_FORMAT = "palpate-results/1", "palpate-audit/1"
#: The name of a file of results on the hub.
HUB_FILE = "results.json"
#: Keys of their JSON that are no fields.
COMMAND_KEYS = ("format", "skipped", "failed")
#: Rows of the group-by-part matrix that an audit keeps.
MATRIX_ROWS = 60
#: Keys of a recorded argument.
PATH, DIGEST, ROWS, OBJECT = "$path", "$digest", "$rows", "$object"
#: Arguments that are names of files and folders, if there is something of that name.
FILES = (
    *("generated", "reference", "encoder", "split", "labels", "groups", "background", "inception"),
    *(
        "clip",
        "lpips",
        "data",
        "captions",
        "train",
        "train_or_data",
        "test",
        "pretrain",
        "root",
        "classes",
    ),
    *("study", "votes", "metrics", "splits"),
)
#: Arguments that change no number, or that nobody may say for the user.
SILENT = ("progress", "cache", "threads", "trust_torchscript")
#: What is read of a manifest's folder, next to images.
TABLE = "manifest.parquet"


@dataclass(frozen=True)
class Call:
    """A call of a public function.

    Attributes:
        verb: the verb of the command line that makes the same call: ``score``, ``probe`` ...
        arguments: those that are not the defaults, as JSON; see the head of this module.
        digests: SHA-256 of what was read, by role, e.g. ``generated ours``, ``tactile encoder``.
    """

    verb: str
    arguments: Mapping[str, Any]
    digests: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, verb: str, function: Callable[..., Any], arguments: Mapping[str, Any]) -> Call:
        """The call of ``function`` with the ``arguments``; their files are digested."""
        defaults = {n: p.default for n, p in inspect.signature(function).parameters.items()}
        recorded = {
            name: _recorded(value, name)
            for name, value in arguments.items()
            if name not in SILENT and not _is(value, defaults.get(name, inspect.Parameter.empty))
        }
        return cls(verb, recorded)

    def with_digests(self, digests: Mapping[str, Any]) -> Call:
        """The call with digests, nested ones by both names: ``{"generated": {"ours": ...}}``."""
        flat: dict[str, str] = {}
        for name, value in digests.items():
            if isinstance(value, Mapping):
                flat |= {f"{name} {key}": str(each) for key, each in value.items()}
            elif value is not None:
                flat[name] = str(value)
        return replace(self, digests=flat)


def _is(value: Any, default: Any) -> bool:
    """Whether an argument is the default; arrays and frames have no truth."""
    simple = (str, int, float, bool, tuple, list)
    plain = isinstance(value, simple) and isinstance(default, simple)
    return value is default or (plain and value == default)


def _recorded(value: Any, name: str) -> Any:
    if isinstance(value, Mapping | list | tuple) and name in ("labels", "groups"):
        return {OBJECT: type(value).__name__}  # one for each sample
    if isinstance(value, Mapping):
        # Of a mapping name -> path the argument's role; of options those of the option.
        return {str(k): _recorded(v, name if name in FILES else str(k)) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_recorded(item, name) for item in value]
    if isinstance(value, PurePath) or (
        isinstance(value, str) and name in FILES and value and is_there(Path(value))
    ):
        return _recorded_path(Path(value), name)
    if value is None or isinstance(value, str | bool | int | float):
        return value
    root = getattr(value, "root", None)  # of a manifest: its folder, if that still says the same
    if isinstance(root, Path) and hasattr(value, "table") and (root / TABLE).is_file():
        return {**_recorded_path(root, name), ROWS: value.digest}
    return {OBJECT: type(value).__name__}


def _recorded_path(path: Path, name: str) -> dict[str, Any]:
    record: dict[str, Any] = {PATH: str(path)}
    if (digest := digest_of(path, name)) is not None:
        record[DIGEST] = digest
    return record


def digest_of(path: Path, name: str) -> str | None:
    """SHA-256 of the file, manifest or encoder that the argument ``name`` is; None of others.

    Images that are scored have digests of their own, of those that were read.
    """
    if path.is_file():
        return None if name in ("generated", "reference") else digest_file(path)
    if (path / TABLE).is_file():
        return digest_file(path / TABLE)
    weights = name in ("encoder", "clip") and path.is_dir()
    return digest_folder(path, "**/*.safetensors") if weights else None


class Document(Shown):
    """What audits and results share: they print themselves, and are JSON of a format."""

    form: ClassVar[str]
    role: ClassVar[str]
    #: Whether the paths of its images start from the folder of its file.
    own_images: ClassVar[bool] = False

    def __str__(self) -> str:
        """The tables, findings, notes and claims, as in the terminal."""
        return _writer("terminal").as_text(self)

    def to_json(self) -> dict[str, Any]:
        """A JSON object with its ``format``."""
        return {"format": self.form, **plain(self)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`; keys that a command adds are ignored."""
        return from_plain(cls, {k: v for k, v in data.items() if k not in COMMAND_KEYS})

    def with_paths(
        self, images: Callable[[str], str | None], inputs: Callable[[str], str] = str
    ) -> Self:
        """The same with other paths.

        Args:
            images: path of an image -> its new one; None removes it.
            inputs: path of an input of a call -> its new one.
        """
        return self.from_json(_with_paths(self.to_json(), images, inputs))

    def moved(self, change: Callable[[str], str]) -> Self:
        """The same with ``change`` applied to the paths that start from the folder of its file."""
        return self.with_paths(change if self.own_images else str, change)

    def save(self, path: str | Path) -> None:
        """Write it as JSON, atomically; paths become relative to its folder."""
        change = _from_folder(Path(path).parent, Path())
        images = change if self.own_images else str
        write_json(Path(path), _with_paths(self.to_json(), images, change))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read it from a file, with paths from the working directory.

        Raises:
            PalpateError: if the file is missing, or holds something else.
        """
        data = read_record(Path(path), f"{cls.role} file", form=cls.form)
        with reading_entry(Path(path), f"The {cls.role}"):
            loaded = cls.from_json(data)
        return loaded.moved(lambda name: os.path.normpath(Path(path).parent / name))


@dataclass(frozen=True)
class Audit(Document):
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
        questions: what was asked, each with its verdict.
        verdict: the worst of theirs.
        largest_group: the share of all samples that are in one group; 0 where none is known, 1
            where some samples lack theirs: no split then keeps groups whole.
        impact: what the leak does to scores, if requested.
        commands: command lines that say what to do next.
        others: audits of the same test part against other data (an encoder's pretraining list).
        call: what made it, for ``palpate verify``.
        table: a polars frame with every signal of every test sample; not in the JSON.
    """

    form: ClassVar[str] = AUDIT_FORMAT
    role: ClassVar[str] = "audit"
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
    questions: Sequence[Question] = ()
    largest_group: float = 0.0
    verdict: str = ""
    impact: Impact | None = None
    commands: Sequence[str] = ()
    others: Sequence[Audit] = ()
    call: Call | None = None
    table: Any = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.test_samples:
            share = self.leaking_samples / self.test_samples
            object.__setattr__(self, "leaked_fraction", round(share, 5) or share)
        asked = {question.verdict for question in self.questions}
        flagged = LEAKS if self.leaking_samples else NO_LEAK
        worst = next((verdict for verdict in VERDICTS if verdict in asked), flagged)
        object.__setattr__(self, "verdict", worst)

    @property
    def open(self) -> bool:
        """Whether a question was asked that could not be told for all samples."""
        return any(question.verdict and question.reason for question in self.questions)

    @property
    def at_least(self) -> bool:
        """Whether more samples may share a recording than are known: no share is then said."""
        return any(q.verdict and q.reason for q in self.questions[:1])

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


@dataclass(frozen=True)
class Results(Document):
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
    role: ClassVar[str] = "results"
    own_images: ClassVar[bool] = True
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

    def push_to_hub(self, repo_id: str, **options: Unpack[PushOptions]) -> str:
        """Put it on the hub as a data set with its card; return the address.

        Images stay here, and of the paths of inputs the names alone are written.

        Args:
            repo_id: ``owner/name``; made if it is not there; :meth:`load` takes it.
            options: ``private``, ``revision`` (a branch), ``token``.

        Raises:
            PalpateError: if the hub is out of reach or rejects it.
        """
        bare = self.with_paths(lambda _: None, lambda name: Path(name).name)

        def write(folder: Path) -> None:
            write_json(folder / HUB_FILE, bare.to_json())
            write_card(folder, self.title or repo_id, bare.to_markdown(), ["results"])

        return push(write, repo_id, kind="dataset", **options)

    @classmethod
    def load(cls, path: str | Path, revision: str | None = None) -> Self:
        """Read results from a file, or those of an audit, with paths from the working directory.

        Args:
            path: the file, or a hub id.
            revision: branch, tag or commit of a hub id; ``owner/name@revision`` is the same.

        Raises:
            PalpateError: if the file is missing, or holds something else.
        """
        path = fetched_file(
            at_revision(path, revision), HUB_FILE, "results", "Make some with: palpate score"
        )
        data = read_record(Path(path), "results file", form=(RESULTS_FORMAT, AUDIT_FORMAT))
        if data["format"] == RESULTS_FORMAT:
            return super().load(path)
        audit = Audit.load(path)
        results = cls(title="", audits=[audit, *audit.others])
        return results.with_paths(lambda name: os.path.normpath(Path(path).parent / name))

    def relative_to(self, folder: Path, base: Path) -> Results:
        """The results with paths relative to ``folder`` instead of ``base``.

        So they stay right when a run folder is moved as a whole.
        """
        return self.moved(_from_folder(folder, base))


def _from_folder(folder: Path, base: Path) -> Callable[[str], str]:
    """Paths from ``base`` as paths from ``folder``."""
    start, end = base.resolve(), folder.resolve()
    return lambda name: Path(os.path.relpath(start / name, end)).as_posix()


#: Fields of a record, and those that are paths of images.
_IMAGES = (
    ({field.name for field in fields(SampleRef)}, ("vision", "tactile", "background")),
    ({field.name for field in fields(GalleryItem)}, ("generated", "background")),
)


def _with_paths(
    value: Any, images: Callable[[str], str | None], inputs: Callable[[str], str]
) -> Any:
    """JSON with other paths of images and of inputs of calls."""
    if isinstance(value, list):
        return [_with_paths(item, images, inputs) for item in value]
    if not isinstance(value, dict):
        return value
    changes = dict.fromkeys(
        (n for keys, names in _IMAGES if keys == value.keys() for n in names), images
    )
    changes[PATH] = inputs
    inside = lambda item: _with_paths(item, images, inputs)
    return {
        key: changes[key](item) if key in changes and isinstance(item, str) else inside(item)
        for key, item in value.items()
    }


def _writer(name: str) -> Any:
    """Load a writer when it is used: writers import the results, and some are heavy."""
    return import_module(f"palpate.report.{name}")


def _key(score: Score) -> tuple[str, str, str]:
    return label_of(score), subject_of(score), str(score.settings.get("preset", ""))
