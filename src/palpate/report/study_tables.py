"""Tables, laid out: what every front end writes of the scores and tables of results.

A :class:`Sheet` comes from a table of a study (:func:`sheet`), from scores (:func:`lay`,
:func:`score_sheets`). The best of a column is marked by value alone, among the rows
that are no controls; a dagger marks the one that paired differences decide for.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from palpate.core import Measure, Note, Score
from palpate.core.score import ARROWS, BETTER
from palpate.report.notes import confidence, digits_of, number, p_text
from palpate.report.results import Results
from palpate.report.study import Claim, StudyTable
from palpate.report.tables import (
    BASELINES,
    REAL,
    Cell,
    Column,
    Footnotes,
    Table,
    best_by_value,
    facts_of,
    marks,
    notes_of,
)

#: Verdict -> the mark before its word, for those who do not see colors.
MARKS = {"holds": "✓", "does not hold": "✗", "undecided": "?"}
_DEGREES = re.compile(r"[\d.]+(?= df)")
_ARROW = re.compile("[↑↓→]")


@dataclass(frozen=True)
class Head:
    """One column: label and better direction ('' where none is shown); whether it holds scores.

    One that is empty is among the scores.
    """

    label: str
    arrow: str
    better: str
    scores: bool


@dataclass(frozen=True)
class Entry:
    """One cell: words, a score with its decimals, or nothing.

    Attributes:
        value: as in the table.
        digits: decimals of value and interval.
        best: the best of its column.
        footnotes: numbers, from 1, of its notes below the table.
        decided: paired differences decide for it.
        below: lines under the interval: p-value, null band, size.
    """

    value: Score | str | None
    digits: int = 0
    best: bool = False
    footnotes: Sequence[int] = ()
    decided: bool = False
    below: Sequence[str] = ()

    @property
    def score(self) -> Score | None:
        """The score, if it is one."""
        return self.value if isinstance(self.value, Score) else None


@dataclass(frozen=True)
class Row:
    """One row; ``rule`` is whether methods end and controls begin above it, or the other way."""

    cells: Sequence[Entry]
    control: bool
    rule: bool


@dataclass(frozen=True)
class Sheet:
    """A table as it is written.

    Attributes:
        title, text: of the table.
        heads: one a column.
        rows: as many entries each as there are heads.
        notes: the footnotes.
        made: (what, how) the scores were made.
        strips: whether a page draws each score on the axis of its column.
    """

    title: str
    text: str
    heads: Sequence[Head]
    rows: Sequence[Row]
    notes: Sequence[Note]
    made: Sequence[tuple[str, str]] = ()
    strips: bool = False

    def column(self, k: int) -> list[Score]:
        """The scores of a column."""
        return [score for row in self.rows if (score := row.cells[k].score) is not None]

    def marks(self, best: str) -> list[str]:
        """What the marks mean, where there are any; ``best`` is how the best is marked."""
        return marks((cell for row in self.rows for cell in row.cells), best)


def sheets(results: Results) -> list[Sheet]:
    """Return the tables of the study."""
    return [sheet(table) for table in results.tables]


def controls_of(results: Results) -> set[str]:
    """Return the subjects that a table of the study names as controls."""
    return {name for table in results.tables for name in table.controls}


def scores_of_methods(results: Results) -> list[Score]:
    """Return the scores of methods: without controls, and of several presets the first.

    Results of real images alone, as a probe's, are returned whole.
    """
    controls = {REAL, *controls_of(results)}
    first: dict[Any, Score] = {}
    for score in results.scores:
        if score.a not in controls:
            first.setdefault((score.measure, score.a, score.b), score)
    return [*first.values()] or [*results.scores]


def sheet(table: StudyTable) -> Sheet:
    """Return a table with its digits, directions, best marks and footnotes."""
    footnotes = Footnotes()
    width = len(table.columns)
    rows = [[*row, *[None] * width][:width] for row in table.rows]
    controls = [bool(row) and row[0] in table.controls for row in rows]
    columns = [[row[k] for row in rows] for k in range(width)]
    digits = [_digits(column) for column in columns]
    best = [
        _best(column, controls, places) if table.best else set[int]()
        for column, places in zip(columns, digits, strict=True)
    ]
    laid: list[Row] = []
    for r, (row, control) in enumerate(zip(rows, controls, strict=True)):
        cells = [
            Entry(value, digits[k][r], r in best[k], footnotes.numbers(value.notes))
            if isinstance(value, Score)
            else Entry(value)
            for k, value in enumerate(row)
        ]
        laid.append(Row(cells, control, r > 0 and control != controls[r - 1]))
    heads = [
        _head(label, column, table.best or bool(table.controls))
        for label, column in zip(table.columns, columns, strict=True)
    ]
    made = _made([value for row in rows for value in row if isinstance(value, Score)])
    return Sheet(table.title, table.text, heads, laid, footnotes.notes, made)


def lay(columns: Sequence[Column], controls: Collection[str] = ()) -> Sheet:
    """Return columns of scores as a table with a row a subject; the last is of real images.

    The best of a column is marked among those that compete and are no ``controls``.
    """
    footnotes = Footnotes()
    subjects = list(dict.fromkeys(c.score.a for column in columns for c in column.cells))
    subjects.sort(key=lambda subject: (subject == REAL, subject in controls))
    best: set[int] = set()
    for column in columns:
        free = (c.competes and c.score.a not in controls for c in column.cells)
        scores = [c.score if f else None for c, f in zip(column.cells, free, strict=True)]
        best |= {id(column.cells[k]) for k in best_by_value(scores, column.digits)}
    rows: list[Row] = []
    for subject in subjects:
        cells = [[c for c in column.cells if c.score.a == subject] for column in columns]
        control = subject in controls
        for k in range(max(map(len, cells))):  # several where seeds differ
            entries = [Entry(subject)]
            for column, several in zip(columns, cells, strict=True):
                cell = several[k] if k < len(several) else None
                entries.append(
                    _entry(cell, column, footnotes, cell is not None and id(cell) in best)
                )
            rows.append(Row(entries, control, bool(rows) and control != rows[-1].control))
    heads = [Head("", "", "", False)]
    heads += [Head(c.name, c.arrow, c.better, True) for c in columns]
    floors = [
        ""
        if (floor := next((c.score.floor for c in column.cells), None)) is None
        else number(floor, column.digits)
        for column in columns
    ]
    if any(floors):
        known = rows.pop().cells[1:] if REAL in subjects else [Entry(None)] * len(columns)
        cells = [
            Entry(text) if entry.score is None and text else entry
            for text, entry in zip(floors, known, strict=True)
        ]
        rule = bool(rows) and rows[-1].control
        rows.append(Row([Entry("real images (floor)"), *cells], REAL in controls, rule))
    return Sheet("The verdict", "", heads, rows, footnotes.notes)


def _entry(cell: Cell | None, column: Column, footnotes: Footnotes, best: bool) -> Entry:
    if cell is None:
        return Entry(None)
    numbers = footnotes.numbers(notes_of(cell.score))
    return Entry(cell.score, column.digits, best, numbers, cell.decided)


def score_sheets(table: Table) -> list[Sheet]:
    """Return the scores of one family with all that is known of them, and their differences."""
    laid = lay(table.columns)
    below = {id(c.score): _below(c, column) for column in table.columns for c in column.cells}
    rows = [
        replace(row, cells=[replace(e, below=below.get(id(e.score), ())) for e in row.cells])
        for row in laid.rows
    ]
    for name in BASELINES:
        known = [
            next((v for c in column.cells if (v := c.baselines.get(name)) is not None), None)
            for column in table.columns
        ]
        texts = [
            None if v is None else number(v, column.digits)
            for v, column in zip(known, table.columns, strict=True)
        ]
        if any(texts):
            rows.append(Row([Entry(name), *map(Entry, texts)], False, False))
    heads = [
        laid.heads[0],
        *(
            replace(head, label=column.label)
            for head, column in zip(laid.heads[1:], table.columns, strict=True)
        ),
    ]
    words = {"title": table.title, "text": table.question, "made": facts_of(table)}
    found = replace(laid, **words, heads=heads, rows=rows, strips=True)
    return [found] * bool(table.columns) + [difference_sheet(table)] * bool(table.differences)


def _below(cell: Cell, column: Column) -> list[str]:
    p, null = p_text(cell.p_value), cell.score.null or ()
    lines = [f"p {p}" if p.startswith("<") else f"p = {p}"] if p else []
    lines += [f"null {' to '.join(number(v, column.digits) for v in null)}"] if null else []
    return lines + [cell.size] * bool(cell.size)


def difference_sheet(table: Table) -> Sheet:
    """Return the paired differences of a family, a row each."""
    footnotes = Footnotes()
    labels = ("metric", "a", "b", "a - b", "a better", "Holm p")
    heads = [Head(label, "", "", k > 2) for k, label in enumerate(labels)]
    rows: list[Row] = []
    for d in table.differences:
        words = ["" if d.confidence is None else confidence(d.confidence), p_text(d.p)]
        score = Entry(d.score, d.digits, footnotes=footnotes.numbers(notes_of(d.score)))
        names = map(Entry, (f"{d.name} {d.arrow}", d.score.a, d.score.b))
        rows.append(Row([*names, score, *map(Entry, words)], False, False))
    text = "a - b; where the interval excludes 0 the difference is more than chance."
    title = f"Paired differences: {table.title}"
    return Sheet(title, text, heads, rows, footnotes.notes)


def tally(claims: Sequence[Claim]) -> str:
    """Return how many claims have which verdict: ``4 hold, 1 undecided, 1 not measured``."""
    groups = by_verdict(claims).items()
    return ", ".join(f"{len(same)} {verdict_word(verdict, len(same))}" for verdict, same in groups)


def by_verdict(claims: Sequence[Claim]) -> dict[str, list[Claim]]:
    """Return the claims of each verdict that any has; what was not measured is the last."""
    groups: dict[str, list[Claim]] = {verdict: [] for verdict in (*MARKS, "not measured")}
    for claim in claims:
        groups[claim.verdict if claim.measured else "not measured"].append(claim)
    return {verdict: same for verdict, same in groups.items() if same}


def verdict_word(verdict: str, n: int) -> str:
    """Return the verdict of ``n`` claims: ``hold`` for ``holds``."""
    words = {"holds": "hold", "does not hold": "do not hold"}
    return verdict if n == 1 else words.get(verdict, verdict)


def brief(text: str, most: int = 220) -> str:
    """Return the first clauses of a long reason; its evidence has all of it."""
    if len(text) <= most:
        return text
    ends = (text.rfind("; ", 0, most), text.rfind(" ", 0, most), most)
    cut = text[: next(end for end in ends if end > 0)]
    return f"{cut.rpartition(' [')[0] if cut.count('[') > cut.count(']') else cut} …"


def file_names(kind: str, titles: Sequence[str]) -> list[str]:
    """Return a name for each file: its kind and title in a short form, and a number if needed."""
    names: list[str] = []
    for title in titles:
        words = re.sub("[^a-z0-9]+", "-", title.lower()).strip("-")[:48].strip("-")
        name = words if words.startswith(f"{kind}-") else f"{kind}-{words}".strip("-")
        same = (f"{name}-{k}" for k in count(2))
        names.append(name if name not in names else next(n for n in same if n not in names))
    return names


def _digits(column: Sequence[Score | str | None]) -> list[int]:
    """Decimals of each cell: equal ones for the scores of one metric in one column."""
    alike: dict[tuple[Measure, str], list[Score]] = {}
    for score in column:
        if isinstance(score, Score):
            alike.setdefault((score.measure, score.kind), []).append(score)
    digits = {key: digits_of(scores) for key, scores in alike.items()}
    return [digits[s.measure, s.kind] if isinstance(s, Score) else 0 for s in column]


def _head(label: str, column: Sequence[Score | str | None], compared: bool) -> Head:
    scores = [value for value in column if isinstance(value, Score)]
    directions = {score.higher_is_better for score in scores}
    shown = compared and len(directions) == 1 and not _ARROW.search(label)
    shown = shown and (None not in directions or any(s.floor is not None for s in scores))
    direction = scores[0].higher_is_better if shown else None
    words = (ARROWS[direction], BETTER[direction]) if shown else ("", "")
    return Head(label, *words, bool(scores) or not any(column))


def _best(
    column: Sequence[Score | str | None], controls: Sequence[bool], digits: Sequence[int]
) -> set[int]:
    competing = [
        value if isinstance(value, Score) and not control else None
        for value, control in zip(column, controls, strict=True)
    ]
    return best_by_value(competing, max(digits))


def _made(scores: Sequence[Score]) -> list[tuple[str, str]]:
    """How the scores of a table were made, as (what, how)."""
    sizes = sorted({score.n for score in scores if score.n})
    known = [s for s in scores if s.interval]
    methods = _joined(f"{100 * s.level:g} %, {s.interval_method}" for s in known)
    facts = {
        "n": [" to ".join(dict.fromkeys(f"{n:,}" for n in (*sizes[:1], *sizes[-1:])))],
        "interval": [method.removesuffix(", ") for method in methods],
        "estimator": [score.estimator for score in scores],
        "seed": [str(score.seed) for score in scores if score.seed is not None],
        "stages": [str(score.details.get("stage", "")) for score in scores],
    }
    rows = {what: list(dict.fromkeys(filter(None, how))) for what, how in facts.items()}
    return [(what, _few(what, how)) for what, how in rows.items() if how]


def _joined(methods: Iterable[str]) -> list[str]:
    """Methods that differ in their degrees of freedom alone as one, with the range of these."""
    degrees: dict[str, list[str]] = {}
    for method in methods:
        degrees.setdefault(_DEGREES.sub("{}", method), []).extend(_DEGREES.findall(method))
    return [
        method.replace("{}", "-".join(dict.fromkeys((min(n, key=float), max(n, key=float)))))
        if n
        else method
        for method, n in degrees.items()
    ]


def _few(what: str, words: Sequence[str], most: int = 12) -> str:
    more = [f"{len(words) - most} more"] * (len(words) > most)
    return ("; " if what == "interval" else ", ").join([*words[:most], *more])
