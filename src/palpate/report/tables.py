"""The one table model: heads, rows of cells, footnotes and best marks, ready to be written.

The terminal, Markdown, LaTeX and HTML write a :class:`Table` and decide nothing. Tables come from a
study (:func:`of_study`) and from families of scores: a row a score (:func:`listing`), a row a
subject (:func:`grid`), a row a paired difference (:func:`of_differences`). The best of a column is
marked by value alone, among the rows that are no controls; a dagger marks the one that paired
differences decide for.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import count, pairwise, zip_longest
from typing import Any

from palpate.core import Measure, Note, Score, plain, short
from palpate.core.score import BETTER
from palpate.report.families import (
    ARROWS,
    BASELINES,
    REAL,
    Column,
    Family,
    baselines,
    best_by_value,
    defined,
    interval_text,
    notes_of,
    size_of,
)
from palpate.report.labels import label_of, measured, subject_of
from palpate.report.numbers import (
    confidence,
    decimals,
    digits_of,
    interval,
    number,
    p_text,
    with_interval,
)
from palpate.report.numbers import count as count_text
from palpate.report.study import StudyTable

BEST = "best of its column by value alone, controls aside"
DECIDED = (
    "better than every other one compared (metrics without reference: closer to the floor) by a "
    "paired difference whose interval excludes 0"
)
#: What the cells of a matrix are.
DIVERGENCE = (
    "Row against column; the diagonal compares two halves of one class. Stronger color: farther "
    "apart."
)
CONFUSION = (
    "Rows: the true class of test samples. Columns: what the classifier called them, as a share of "
    "the row."
)
#: Title of the rankings, which replace the differences of more than two generators.
RANKED = "Best first on the same samples: > decided, ~ not decided"
#: Stages, seeds ... that are named.
FEW = 12
_DEGREES = re.compile(r"[\d.]+(?= df)")


@dataclass(frozen=True)
class Head:
    """One column: label and better direction ('' where none is shown); whether it holds numbers."""

    label: str
    arrow: str = ""
    better: str = ""
    scores: bool = False

    def __str__(self) -> str:
        return f"{self.label} {self.arrow}".strip()


@dataclass(frozen=True)
class Cell:
    """Words, a score with its decimals, or nothing.

    Attributes:
        value: as in the table.
        digits: decimals of value and interval.
        best: the best of its column.
        decided: paired differences decide for it.
        footnotes: numbers, from 1, of its notes below the table.
        below: lines under the interval: p-value, null band, size.
    """

    value: Score | str | None
    digits: int = 0
    best: bool = False
    decided: bool = False
    footnotes: Sequence[int] = ()
    below: Sequence[str] = ()

    @property
    def score(self) -> Score | None:
        """The score, if it is one."""
        return self.value if isinstance(self.value, Score) else None

    def text(self) -> str:
        """The cell as plain text: ``1.37 [1.01, 1.75] * (1)``."""
        words = [self.value if isinstance(self.value, str) else ""]
        if self.score is not None:
            words = [with_interval(self.score, self.digits)]
        marks = ["*"] * self.best + ["†"] * self.decided + [f"({k})" for k in self.footnotes]
        return " ".join(filter(None, [*words, *marks]))


@dataclass(frozen=True)
class Row:
    """One row; ``rule`` is whether methods end and controls begin above it, or the other way."""

    cells: Sequence[Cell]
    control: bool = False
    rule: bool = False


@dataclass(frozen=True)
class Table:
    """A table as it is written.

    Attributes:
        title, text: its heading, and how to read it.
        heads: one a column.
        rows: as many cells each as there are heads.
        notes: the footnotes.
        facts: how the scores were made, by what.
        strips: whether a page draws each score on the axis of its column.
    """

    title: str
    text: str
    heads: Sequence[Head]
    rows: Sequence[Row]
    notes: Sequence[Note] = ()
    facts: Sequence[tuple[str, str]] = ()
    strips: bool = False

    def column(self, k: int) -> list[Score]:
        """The scores of a column."""
        return [score for row in self.rows if (score := row.cells[k].score) is not None]

    def marks(self, best: str) -> list[str]:
        """What the marks mean, where there are any; ``best`` is how the best is marked."""
        cells = [cell for row in self.rows for cell in row.cells]
        marks = [f"{best} {BEST}"] * any(cell.best for cell in cells)
        return marks + [f"† {DECIDED}"] * any(cell.decided for cell in cells)

    def plain(self) -> tuple[list[Head], list[list[str]]]:
        """Heads and rows of plain text without the columns that are empty; controls say so.

        Numbers have an ASCII minus, as not every terminal has the true one.
        """
        rows = [[cell.text() for cell in row.cells] for row in self.rows]
        for cells, row in zip(rows, self.rows, strict=True):
            cells[0] += " (control)" * row.control
        kept = [k for k in range(len(self.heads)) if any(row[k] for row in rows)]
        ascii_minus = {k: str.maketrans("−", "-") if self.heads[k].scores else {} for k in kept}
        texts = [[row[k].translate(ascii_minus[k]) for k in kept] for row in rows]
        return [self.heads[k] for k in kept], texts


class Footnotes:
    """Notes in order of first use; equal notes have one number."""

    def __init__(self) -> None:
        self.notes: list[Note] = []

    def numbers(self, notes: Iterable[Note]) -> list[int]:
        """Return the numbers, from 1, of some notes, in rising order."""
        notes = list(notes)
        self.notes += [n for k, n in enumerate(notes) if n not in self.notes and n not in notes[:k]]
        return sorted({self.notes.index(note) + 1 for note in notes})


def of_study(table: StudyTable) -> Table:
    """Return a table of a study with its digits, directions, best marks and footnotes."""
    footnotes, width = Footnotes(), len(table.columns)
    rows = [[*row, *[None] * width][:width] for row in table.rows]
    controls = [bool(row) and row[0] in table.controls for row in rows]
    scores = [[v if isinstance(v, Score) else None for v in row] for row in rows]
    columns = [[row[k] for row in scores] for k in range(width)]
    digits = [_digits(column) for column in columns]
    best = [
        best_by_value(
            [None if control else s for s, control in zip(column, controls, strict=True)],
            max(places, default=0),
        )
        if table.best
        else set[int]()
        for column, places in zip(columns, digits, strict=True)
    ]
    written: list[Row] = []
    for r, (row, control) in enumerate(zip(rows, controls, strict=True)):
        cells = [
            Cell(v, digits[k][r], r in best[k], footnotes=footnotes.numbers(v.notes))
            if isinstance(v, Score)
            else Cell(v)
            for k, v in enumerate(row)
        ]
        written.append(Row(cells, control, r > 0 and control != controls[r - 1]))
    compared = table.best or bool(table.controls)
    heads = [
        _head(label, [s for s in column if s], compared, empty=not any(row[k] for row in rows))
        for k, (label, column) in enumerate(zip(table.columns, columns, strict=True))
    ]
    facts = _facts([s for row in scores for s in row if s])
    return Table(table.title, table.text, heads, written, footnotes.notes, facts)


def _digits(column: Sequence[Score | None]) -> list[int]:
    """Decimals of each cell: equal ones for the scores of one measure in one column."""
    alike: dict[tuple[Measure, str], list[Score]] = {}
    for score in filter(None, column):
        alike.setdefault((score.measure, score.kind), []).append(score)
    digits = {key: digits_of(scores) for key, scores in alike.items()}
    return [digits[s.measure, s.kind] if s else 0 for s in column]


def _head(label: str, scores: Sequence[Score], compared: bool, *, empty: bool) -> Head:
    """A column's head; one that is empty is among the numbers."""
    directions = {score.higher_is_better for score in scores}
    directed = compared and len(directions) == 1 and not re.search("[↑↓→]", label)
    if not directed or (None in directions and all(s.floor is None for s in scores)):
        return Head(label, scores=bool(scores) or empty)
    return Head(label, ARROWS[scores[0].higher_is_better], BETTER[scores[0].higher_is_better], True)


def _facts(scores: Sequence[Score]) -> list[tuple[str, str]]:
    """How the scores of a study's table were made, by what."""
    sizes = sorted({score.n for score in scores if score.n})
    degrees: dict[str, list[str]] = {}  # methods that differ in these alone are one
    for method in (interval_text(s) for s in scores if s.interval):
        degrees.setdefault(_DEGREES.sub("{}", method), []).extend(_DEGREES.findall(method))
    facts = {
        "n": [" to ".join(dict.fromkeys(f"{n:,}" for n in (*sizes[:1], *sizes[-1:])))],
        "interval": [
            method.replace("{}", "-".join(dict.fromkeys((min(n, key=float), max(n, key=float)))))
            if n
            else method
            for method, n in degrees.items()
        ],
        "estimator": [score.estimator for score in scores],
        "seed": [str(score.seed) for score in scores if score.seed is not None],
        "stages": [str(score.details.get("stage", "")) for score in scores],
    }
    rows: list[tuple[str, str]] = []
    for name, texts in facts.items():
        words = list(dict.fromkeys(filter(None, texts)))
        words[FEW:] = [f"{len(words) - FEW} more"] * (len(words) > FEW)
        rows += [(name, ("; " if name == "interval" else ", ").join(words))] * bool(words)
    return rows


def grid(columns: Sequence[Column], controls: Collection[str] = (), *, full: bool = False) -> Table:
    """Return columns of scores with a row a subject; the last is of real images.

    The best of a column is marked among those that compete and are no ``controls``. ``full`` adds
    what is known of each score, rows of baselines, and strips.
    """
    footnotes, rows = Footnotes(), list[Row]()
    best = [column.best(controls) for column in columns]
    subjects = dict.fromkeys(score.a for column in columns for score in column.scores)
    for subject in sorted(subjects, key=lambda name: (name == REAL, name in controls)):
        places = [[k for k, s in enumerate(c.scores) if s.a == subject] for c in columns]
        control = subject in controls
        for several in zip_longest(*places):  # where seeds differ
            cells = [
                Cell(None) if k is None else _cell(column, k, k in of_column, footnotes, full)
                for column, k, of_column in zip(columns, several, best, strict=True)
            ]
            rule = bool(rows) and control != rows[-1].control
            rows.append(Row([Cell(subject), *cells], control, rule))
    floors = [_text(column, column.scores[0].floor) for column in columns]
    if any(floors):
        real = rows.pop().cells[1:] if REAL in subjects else [Cell(None)] * len(columns)
        cells = [
            Cell(text) if cell.score is None and text else cell
            for text, cell in zip(floors, real, strict=True)
        ]
        rule = bool(rows) and rows[-1].control
        rows.append(Row([Cell("real images (floor)"), *cells], REAL in controls, rule))
    for name in BASELINES if full else ():
        values = (
            [v for s in c.scores if (v := baselines(s).get(name)) is not None] for c in columns
        )
        texts = [_text(c, next(iter(v), None)) for c, v in zip(columns, values, strict=True)]
        if any(texts):
            rows.append(Row([Cell(name), *map(Cell, texts)]))
    heads = [
        Head(""),
        *(Head(c.label if full else c.name, c.arrow, c.better, True) for c in columns),
    ]
    return Table("The verdict", "", heads, rows, footnotes.notes, strips=full)


def _text(column: Column, value: float | None) -> str | None:
    return None if value is None else number(value, column.digits)


def _cell(column: Column, k: int, best: bool, footnotes: Footnotes, full: bool) -> Cell:
    score, below = column.scores[k], list[str]()
    if full:
        p, null = p_text(score.details.get("p_value")), score.null or ()
        below += [f"p {p}" if p.startswith("<") else f"p = {p}"] * bool(p)
        below += [f"null {' to '.join(number(v, column.digits) for v in null)}"] * bool(null)
        below += [size_of(score)] * (not column.size and bool(size_of(score)))
    numbers = footnotes.numbers(notes_of(score))
    return Cell(score, column.digits, best, score.a == column.winner, numbers, below)


def grids(family: Family) -> list[Table]:
    """Return the scores of one family with all that is known of them, and their differences."""
    tables: list[Table] = []
    if family.columns:
        table = replace(grid(family.columns, full=True), title=family.title, text=family.question)
        tables.append(replace(table, facts=family.facts))
    return tables + [of_differences(family)] * bool(family.differences)


def listing(family: Family) -> Table:
    """Return the scores of one family, a row each, so that names and notes have room."""
    footnotes, rows = Footnotes(), list[Row]()
    for column in family.columns:
        best, digits = column.best(), column.digits
        for k, score in enumerate(column.scores):
            text = number(score.value, digits) if defined(score) else "undefined"
            value = Cell(text, best=k in best, decided=score.a == column.winner)
            limits = [interval(pair, digits) for pair in (score.interval, score.null)]
            further = (score.floor, *map(baselines(score).get, BASELINES))
            words = ["" if v is None else number(v, digits) for v in further]
            words = [*limits, p_text(score.details.get("p_value")), *words]
            names = f"{column.name} {column.arrow}", score.a
            size = count_text(score.n) if score.n else ""
            notes = Cell(None, footnotes=footnotes.numbers(notes_of(score)))
            rows.append(Row([*map(Cell, names), value, *map(Cell, (*words, size)), notes]))
    numbers = ("value", "95 % interval", "null", "p", "floor", *BASELINES, "n")
    heads = [Head("metric"), Head("subject"), *(Head(n, scores=True) for n in numbers)]
    heads.append(Head("notes"))
    title, text = family.title, family.question
    return Table(title, text, heads, rows, footnotes.notes, family.facts)


def of_differences(family: Family) -> Table:
    """Return the paired differences of a family, a row each."""
    footnotes, rows = Footnotes(), list[Row]()
    for d in family.differences:
        better, p = d.details.get("p_better"), d.details.get("p_adjusted")
        words = ["" if better is None else confidence(better), p_text(p)]
        names = _with_arrow(d), d.a, d.b
        cell = Cell(d, digits_of([d]), footnotes=footnotes.numbers(notes_of(d)))
        rows.append(Row([*map(Cell, names), cell, *map(Cell, words)]))
    labels = ("metric", "a", "b", "a - b", "a better", "Holm p")
    heads = [Head(label, scores=k > 2) for k, label in enumerate(labels)]
    text = "a - b; where the interval excludes 0 the difference is more than chance."
    return Table(f"Paired differences: {family.title}", text, heads, rows, footnotes.notes)


def _with_arrow(difference: Score) -> str:
    return f"{measured(difference)} {ARROWS[difference.higher_is_better]}"


def rankings(family: Family) -> Table | None:
    """Return the generators of each metric from best to worst where three or more are compared.

    ``>`` separates neighbors whose paired difference is decided (Holm's p under 0.05), ``~``
    between the others. Metrics without a better direction have no row.
    """
    by_metric: dict[str, list[Score]] = {}
    for d in family.differences:
        by_metric.setdefault(_with_arrow(d), []).append(d)
    if max(map(len, by_metric.values()), default=0) < 3:
        return None
    orders = [(metric, _ranking(each)) for metric, each in by_metric.items()]
    rows = [Row([Cell(metric), Cell(order)]) for metric, order in orders if order]
    return Table(RANKED, "", [Head("metric"), Head("best first")], rows) if rows else None


def _ranking(differences: Sequence[Score]) -> str:
    wins = dict.fromkeys([name for d in differences for name in (d.a, d.b or "")], 0)
    apart: set[frozenset[str]] = set()
    for d in differences:
        better, p = d.details.get("p_better"), d.details.get("p_adjusted")
        if better is not None:
            wins[d.a if better > 0.5 else d.b or ""] += 1
            apart |= {frozenset((d.a, d.b or ""))} if p is not None and p < 0.05 else set()
    names = sorted(wins, key=lambda name: -wins[name])
    signs = [">" if frozenset(pair) in apart else "~" for pair in pairwise(names)]
    steps = (f" {sign} {name}" for sign, name in zip(signs, names[1:], strict=True))
    return names[0] + "".join(steps) if any(wins.values()) else ""


@dataclass(frozen=True)
class Heat:
    """A square matrix: D-TMMD's divergences, or confusions; ``shares`` lie in [0, 1]."""

    title: str
    meaning: str
    labels: Sequence[str]
    values: Sequence[Sequence[str]]
    shares: Sequence[Sequence[float]]


def heat_tables(scores: Sequence[Score]) -> list[Heat]:
    """Return one heat table for each score whose details hold a square ``matrix`` of numbers.

    ``details["classes"]`` names its rows, else they are numbered.
    """
    tables: list[Heat] = []
    for score in scores:
        matrix: Any = plain(score.details.get("matrix"))
        if not isinstance(matrix, list) or not all(
            isinstance(row, list) and len(row) == len(matrix) for row in matrix
        ):
            continue
        names: Sequence[Any] = score.details.get("classes") or range(1, len(matrix) + 1)
        values = [abs(v) for row in matrix for v in row if v is not None]
        digits, top = min(3, decimals(values)), max(values, default=0.0) or 1.0
        parts = [label_of(score), subject_of(score), str(score.settings.get("preset", ""))]
        title = ", ".join(filter(None, parts))
        if any(title == table.title for table in tables) and score.reference:
            title += f", reference {short(score.reference)}"
        tables.append(
            Heat(
                title,
                CONFUSION if "accuracy" in score.metric else DIVERGENCE,
                [str(name) for name in names],
                [[number(v, digits) for v in row] for row in matrix],
                [[round(max(0.0, v or 0.0) / top, 3) for v in row] for row in matrix],
            )
        )
    return tables


def file_names(kind: str, titles: Sequence[str]) -> list[str]:
    """Return a name for each file: its kind and title in a short form, and a number if needed."""
    names: list[str] = []
    for title in titles:
        words = re.sub("[^a-z0-9]+", "-", title.lower()).strip("-")[:48].strip("-")
        name = words if words.startswith(f"{kind}-") else f"{kind}-{words}".strip("-")
        same = (f"{name}-{k}" for k in count(2))
        names.append(name if name not in names else next(n for n in same if n not in names))
    return names
