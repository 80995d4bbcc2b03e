"""Tables of scores: which metrics answer one question, and the table model that all are written by.

Scores of different settings raise instead of sharing a column; those of another family, preset,
split or reference, or on other features, are in tables of their own. A :class:`Table` is laid out
with a row a score (:func:`listing`), a row a subject (:func:`grid`) or a row a paired difference
(:func:`of_differences`); the terminal, Markdown, LaTeX and HTML write it and decide nothing. The
best of a column is marked by value alone, among the rows that are no controls; a dagger marks the
one that paired differences decide for.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import zip_longest
from typing import Any, NamedTuple

from palpate.core import Measure, Note, Score, plain, require_comparable, short
from palpate.core.score import BETTER
from palpate.report.labels import (
    confidence,
    count,
    digits_of,
    interval,
    measured,
    number,
    p_text,
    with_interval,
)

#: Arrow for ``Score.higher_is_better``.
ARROWS: Mapping[bool | None, str] = {True: "↑", False: "↓", None: "→"}
#: Title, question, and words that are part of the names of metrics (lower case): the first family
#: whose words match takes a metric.
FAMILIES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (
        "People",
        "Which images do people find closer to the real ones, ties as half a vote, and which "
        "materials do they recognize?",
        ("human ",),
    ),
    (
        "Agreement of metrics with people",
        "Kendall's tau-b: 1 orders images or methods as people do, 0 has nothing to do with it.",
        ("tau with people",),
    ),
    (
        "Power",
        "How often does TMMD tell two classes apart (p <= .05), by the number of recordings?",
        ("power of ",),
    ),
    (
        "Tactile features",
        "Are generated and real images similar to a tactile encoder? I-, CI- and D-TMMD need no "
        "reference images.",
        ("tmmd",),
    ),
    (
        "Image distributions",
        "Are the sets of images similar to a general image encoder?",
        (
            "cmmd",
            "fd",
            "fid",
            "kid",
            "mind",
            "vendi",
            "mmd",
            "precision",
            "recall ",
            "density",
            "coverage",
        ),
    ),
    (
        "Image by image",
        "Does each generated image match its real image, pixel by pixel or patch by patch?",
        ("contact ", "ssim", "psnr", "lpips", "l1", "mse"),
    ),
    (
        "Marker motion",
        "Do the markers of the gel move as far as on real images, in % of the width?",
        ("marker ",),
    ),
    (
        "Captions",
        "Can they be used, and do they name what they should only describe? Those of a contact "
        "count once.",
        ("share of captions",),
    ),
    (
        "Material from captions",
        "How often is the material predicted from the text alone, on new videos? Text that only "
        "describes lies between the commonest material and 1.",
        ("from the text",),
    ),
    (
        "Recognition",
        "What can be read from the image, by a classifier trained on the train part?",
        ("acc", "probe", "@"),
    ),
    (
        "Retrieval",
        "Which text, photo or tactile image belongs to it? The share of samples for which a right "
        "one is among the k most similar, and the median of its rank.",
        ("top-", "median rank", "retriev"),
    ),
    ("Other metrics", "", ("",)),
)
#: Name of a baseline -> its key in the details of a score.
BASELINES = {"no contact": "empty", "chance": "chance", "majority": "majority"}
#: The ``a`` of scores of real images, and of the controls of every table
#: (:mod:`palpate.evaluation.controls`).
REAL = "real"
BACKGROUND, SAME_MATERIAL = "background only", "real, same material"
CONTROLS = (BACKGROUND, SAME_MATERIAL)
#: Row of a table that has floors.
FLOOR = "real images (floor)"
#: What a preset of the TMMD family means, for the head of its table.
PRESETS = {
    "paper": "the paper's formula to the letter, random halves",
    "paper-tables": "the reading that fits the paper's printed tables",
    "cmmd": "as CMMD's published code",
    "grouped": "whole groups, or both images of a scene, kept together",
}


BEST = "best of its column by value alone, controls aside"
DECIDED = (
    "better than every other one compared (metrics without reference: closer to the floor) by a "
    "paired difference whose interval excludes 0"
)


class Head(NamedTuple):
    """One column: label and better direction ('' where none is shown); whether it holds numbers."""

    label: str
    arrow: str = ""
    scores: bool = False

    @property
    def better(self) -> str:
        """The direction in words."""
        return next((BETTER[k] for k, arrow in ARROWS.items() if arrow == self.arrow), "")

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
        notes: what a reader must know of it.
        below: lines under the interval: p-value, null band, size.
        share: how strongly it is shaded, in [0, 1].
    """

    value: Score | str | None = None
    digits: int = 0
    best: bool = False
    decided: bool = False
    notes: Sequence[Note] = ()
    below: Sequence[str] = ()
    share: float = 0.0

    @property
    def score(self) -> Score | None:
        """The score, if it is one."""
        return self.value if isinstance(self.value, Score) else None


class Row(NamedTuple):
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
        facts: how the scores were made, by what.
        strips: whether a page draws each score on the axis of its column.
    """

    title: str
    text: str
    heads: Sequence[Head]
    rows: Sequence[Row]
    facts: Mapping[str, str] = field(default_factory=dict)
    strips: bool = False

    @cached_property
    def cells(self) -> list[Cell]:
        """All cells, row by row."""
        return [cell for row in self.rows for cell in row.cells]

    @cached_property
    def notes(self) -> list[Note]:
        """The footnotes, each once, in the order of the cells."""
        notes = [note for cell in self.cells for note in cell.notes]
        return [note for k, note in enumerate(notes) if note not in notes[:k]]

    def footnotes(self, cell: Cell) -> list[int]:
        """The numbers, from 1, of a cell's notes."""
        return sorted({self.notes.index(note) + 1 for note in cell.notes})

    def column(self, k: int) -> list[Score]:
        """The scores of a column."""
        return [score for row in self.rows if (score := row.cells[k].score) is not None]

    def marks(self, best: str) -> list[str]:
        """What the marks mean, where there are any; ``best`` is how the best is marked."""
        marks = [f"{best} {BEST}"] * any(cell.best for cell in self.cells)
        return marks + [f"† {DECIDED}"] * any(cell.decided for cell in self.cells)

    def text_of(self, cell: Cell) -> str:
        """A cell as plain text: ``1.37 [1.01, 1.75] * (1)``."""
        words = cell.value if isinstance(cell.value, str) else ""
        if cell.score is not None:
            words = with_interval(cell.score, cell.digits)
        marks = ["*"] * cell.best + ["†"] * cell.decided
        return " ".join(filter(None, [words, *marks, *map("({})".format, self.footnotes(cell))]))

    def plain(self) -> tuple[list[Head], list[list[str]]]:
        """Heads and rows of plain text without the columns that are empty; controls say so.

        Numbers have an ASCII minus, as not every terminal has the true one.
        """
        rows = [[self.text_of(cell) for cell in row.cells] for row in self.rows]
        for texts, row in zip(rows, self.rows, strict=True):
            texts[0] += " (control)" * row.control
        kept = [k for k in range(len(self.heads)) if any(row[k] for row in rows)]
        ascii_minus = {k: str.maketrans("−", "-") if self.heads[k].scores else {} for k in kept}
        texts = [[row[k].translate(ascii_minus[k]) for k in kept] for row in rows]
        return [self.heads[k] for k in kept], texts


@dataclass(frozen=True)
class Column:
    """The scores of one measure.

    Attributes:
        scores: of each generator, control ...
        compared: the generators of which there are differences; without any, all that is not of
            real images competes.
        winner: what is better than every other one by a decided paired difference, or None.
        controls: subjects that are never the best.
    """

    scores: Sequence[Score]
    compared: Collection[str] = ()
    winner: str | None = None
    controls: Collection[str] = CONTROLS

    @property
    def measure(self) -> Measure:
        """What is measured."""
        return self.scores[0].measure

    @property
    def name(self) -> str:
        """That in words."""
        return measured(self.scores[0])

    @property
    def label(self) -> str:
        """That without the features, which the title of its table has."""
        return measured(replace(self.scores[0], features=""))

    @property
    def arrow(self) -> str:
        """The better direction."""
        return ARROWS[self.scores[0].higher_is_better]

    @cached_property
    def digits(self) -> int:
        """Decimals of all its numbers."""
        return digits_of(self.scores)

    @property
    def size(self) -> str:
        """The sample sizes, if all of its scores share them."""
        sizes = {size_of(score) for score in self.scores}
        return sizes.pop() if len(sizes) == 1 else ""

    def text(self, value: float | None) -> str:
        """Return a floor, a limit ...: with the decimals of the scores, or of its first digit."""
        if value is None:
            return ""
        first = -math.floor(math.log10(abs(value))) if value else 0  # decimals of its first digit
        return number(value, max(self.digits, min(first, 8)))

    @cached_property
    def cells(self) -> list[Cell]:
        """A cell a score; the best by value is marked among those that compete."""
        competing = [
            s if s.a not in {REAL, *self.controls} and s.a in (self.compared or [s.a]) else None
            for s in self.scores
        ]
        best = best_by_value(competing, self.digits)
        return [
            Cell(s, self.digits, k in best, s.a == self.winner, notes_of(s), self.below(s))
            for k, s in enumerate(self.scores)
        ]

    def below(self, score: Score) -> list[str]:
        """Return p-value, null band and size of a score, in lines."""
        p, null = p_text(score.details.get("p_value")), map(self.text, score.null or ())
        size = "" if self.size else size_of(score)
        lines = [
            f"p {p}" if p.startswith("<") else f"p = {p}" * bool(p),
            f"null {' to '.join(null)}" * bool(score.null),
            size,
        ]
        return [line for line in lines if line]

    @property
    def facts(self) -> dict[str, str]:
        """How its scores were made, by what."""
        first = self.scores[0]
        seeds = (str(s.seed) for s in self.scores if s.seed is not None)
        facts = {
            "estimator": first.estimator,
            "bandwidth σ": "" if first.bandwidth is None else f"{first.bandwidth:g}",
            "scale": f"× {first.scale:g}" if first.scale != 1 else "",
            "interval": "; ".join(dict.fromkeys(filter(None, map(interval_text, self.scores)))),
            "seed": ", ".join(dict.fromkeys(seeds)),
            **{str(k).replace("_", " "): str(plain(v)) for k, v in first.settings.items()},
            **{name: getattr(first, name) or "" for name in ("encoder", "reference", "split")},
        }
        return {name: text for name, text in facts.items() if text}


@dataclass(frozen=True)
class Family:
    """Scores that share a table: its title, the question, the columns, paired differences."""

    title: str
    question: str
    columns: Sequence[Column]
    differences: Sequence[Score]

    @property
    def facts(self) -> dict[str, str]:
        """How the scores were made: what all columns share, then what is of one."""
        each = {column.name: column.facts for column in self.columns}
        facts = {f"{c.name}, size": c.size for c in self.columns if c.size}
        alike = [fact for own in each.values() for fact in own.items()]
        shared = [fact for fact in alike if alike.count(fact) == len(each)]
        facts |= dict(shared)
        for name, own in each.items():
            facts |= {f"{name}, {f}": text for f, text in own.items() if (f, text) not in shared}
        return facts


def defined(score: Score) -> bool:
    """Return whether a score has a value."""
    return score.value is not None


def size_of(score: Score) -> str:
    """Return ``"n = 240, m = 240"``."""
    sizes = {"n": score.n or None, "m": score.m}
    return ", ".join(f"{name} = {value:,}" for name, value in sizes.items() if value is not None)


def interval_text(score: Score) -> str:
    """Return what the interval of a score is: ``"95 %, jackknife, t, 9 df"``; '' without one."""
    if score.interval is None:
        return ""
    return ", ".join(filter(None, [f"{100 * score.level:g} %", score.interval_method]))


def baselines(score: Score) -> dict[str, float]:
    """Return what is scored without a look at the sample: chance, the commonest class ..."""
    values = {name: score.details.get(key) for name, key in BASELINES.items()}
    return {n: v for n, v in values.items() if isinstance(v, int | float) and math.isfinite(v)}


def family_of(score: Score) -> tuple[int, str]:
    """Return the place and the title of the family of a score's metric."""
    name = f"{score.metric.lower()} "
    return next(
        (k, title)
        for k, (title, _, words) in enumerate(FAMILIES)
        if any(word in name for word in words)
    )


def notes_of(score: Score) -> list[Note]:
    """Return what a reader must know of a score: its notes, and what follows from its fields."""
    notes = [*score.notes]
    if excluded := score.details.get("excluded"):
        notes.append(Note("excluded-classes", {"excluded": excluded}))
    if score.higher_is_better is None and score.details.get("gap") is not None:
        notes.append(Note("nearer-to-floor"))
    if "no contact" in baselines(score):
        notes.append(Note("no-contact-baseline"))
    lacks_floor = score.floor is None and score.b is None and defined(score)
    if lacks_floor and score.metric in ("TMMD", "I-TMMD", "CI-TMMD", "D-TMMD"):
        code = "no-floor-of-tmmd" if score.metric == "TMMD" else "floor-unknown"
        notes += [] if any(note.code == "no-floor" for note in notes) else [Note(code)]
    return notes


def families(scores: Sequence[Score], controls: Collection[str] = ()) -> list[Family]:
    """Return all scores by family, in fixed order, metrics as they first appear.

    Args:
        scores: of one or several runs.
        controls: subjects that are controls, next to those that are everywhere.

    Raises:
        PalpateError: if two scores that share a column were not made with the same settings.
    """
    groups: dict[tuple[int, str, str, str, int], list[Score]] = {}
    for score, reference in zip(scores, _references(scores), strict=True):
        preset = str(score.settings.get("preset", ""))
        split = "" if score.settings.get("axis") == "split" else score.split or ""
        key = (family_of(score)[0], preset, split, score.features, reference)
        groups.setdefault(key, []).append(score)
    splits, references = (len({key[k] for key in groups} - {""}) > 1 for k in (2, 4))
    result: list[Family] = []
    for key, members in sorted(groups.items(), key=lambda item: item[0][0]):
        number, preset, split, features, _ = key
        title, question, _ = FAMILIES[number]
        parts = [title + (f" of {features}" if features else "")]
        parts += [f"{preset}: {PRESETS[preset]}" if preset in PRESETS else preset] * bool(preset)
        parts += [f"split {short(split)}"] if split and splits else []
        digests = dict.fromkeys(short(s.reference) for s in members if s.reference)
        parts += [f"reference {' and '.join(digests) or 'not recorded'}"] if references else []
        first = all(question != family.question for family in result)
        differences = [s for s in members if s.b is not None]
        columns(differences)
        compared = dict.fromkeys(name for d in differences for name in (d.a, d.b or ""))
        heads = [
            Column(c, compared, best_of(c[0].measure, differences), {*CONTROLS, *controls})
            for c in columns(s for s in members if s.b is None)
        ]
        differences = [d for d in differences if defined(d)]
        result.append(Family(", ".join(parts), question if first else "", heads, differences))
    return result


def _references(scores: Sequence[Score]) -> list[int]:
    """Return which reference each score was compared with: 0 for the first of its metric, 1 ...

    Different encoders make different features of the same images, so references are counted by
    measure. A score without one (I-, CI-, D-TMMD) goes with the last of its subject that has one,
    else with the first after it.
    """
    digests: dict[tuple[Measure, str | None], dict[str, int]] = {}
    rows: list[tuple[tuple[str, str | None], int | None]] = []
    for s in scores:
        listed = digests.setdefault((s.measure, s.encoder), {})
        k = None if s.reference is None else listed.setdefault(s.reference, len(listed))
        rows.append(((s.a, s.b), k))
    last = {subject: k for subject, k in reversed(rows) if k is not None}
    result: list[int] = []
    for subject, k in rows:
        if k is not None:
            last[subject] = k
        result.append(last.get(subject, 0))
    return result


def columns(scores: Iterable[Score]) -> list[list[Score]]:
    """Return the scores of each measure and kind, in order of first appearance.

    Raises:
        PalpateError: if two scores of one column were not made with the same settings.
    """
    table: dict[tuple[Any, ...], list[Score]] = {}
    for score in scores:
        key = (score.measure, score.settings.get("pool"), score.kind, score.b is None)
        table.setdefault(key, []).append(score)
    for column in table.values():
        require_comparable(column)
    return [*table.values()]


def best_of(measure: Measure, differences: Sequence[Score]) -> str | None:
    """Return what is better than every other one by a decided paired difference, or None.

    Subjects without a difference (controls) take no part.
    """
    wins: dict[str, bool] = {}
    for d in (d for d in differences if d.measure == measure):
        for name in (d.a, d.b or ""):
            won = bool(d.details.get("decided")) and d.details.get("better") == name
            wins[name] = wins.get(name, True) and won
    return next((name for name, won in wins.items() if won), None)


def best_by_value(column: Sequence[Score | None], digits: int) -> set[int]:
    """Return the places of the best scores, by the direction of the metric.

    They are compared as written with ``digits``, or with those of the narrowest interval if these
    are more. None where fewer than two compete. A score does not compete that is None, undefined,
    or a ratio whose denominators are not known (``unstable-denominators``); without a direction,
    also one without a floor.
    """
    competing = {
        k: score
        for k, score in enumerate(column)
        if score is not None
        and defined(score)
        and not (score.higher_is_better is None and score.floor is None)
        and all(note.code != "unstable-denominators" for note in score.notes)
    }
    directions = {score.higher_is_better for score in competing.values()}
    if len(competing) < 2 or len(directions) > 1:
        return set()
    digits = max(digits, digits_of(competing.values(), finest=True))
    worth: dict[int, float] = {}
    for k, score in competing.items():
        written = round(float(score), digits)
        distance = abs(written - round(score.floor or 0.0, digits))
        worth[k] = {True: -written, False: written, None: distance}[score.higher_is_better]
    least = min(worth.values()) + 0.5 * 10**-digits
    return {k for k, value in worth.items() if value < least}


def grid(columns: Sequence[Column], *, full: bool = False) -> Table:
    """Return columns of scores with a row a subject; the last is of real images.

    ``full`` adds what is known of each score, rows of baselines, and strips.
    """
    controls = {name for column in columns for name in column.controls}
    rows: list[Row] = []
    subjects = dict.fromkeys(score.a for column in columns for score in column.scores)
    for subject in sorted(subjects, key=lambda name: (name == REAL, name in controls)):
        control = subject in controls
        own = ([c for c in column.cells if c.score and c.score.a == subject] for column in columns)
        for cells in zip_longest(*own, fillvalue=Cell()):  # several where seeds differ
            rule = bool(rows) and control != rows[-1].control
            cells = [c if full else replace(c, below=()) for c in cells]
            rows.append(Row([Cell(subject), *cells], control, rule))
    floors = [column.text(column.scores[0].floor) for column in columns]
    if any(floors):
        real = rows.pop().cells[1:] if REAL in subjects else [Cell()] * len(columns)
        cells = [
            Cell(text) if text and cell.score is None else cell
            for text, cell in zip(floors, real, strict=True)
        ]
        rows.append(Row([Cell(FLOOR), *cells], rule=bool(rows) and rows[-1].control))
    guesses = [dict(b for s in c.scores[::-1] for b in baselines(s).items()) for c in columns]
    for name in BASELINES if full else ():
        texts = [c.text(values.get(name)) for c, values in zip(columns, guesses, strict=True)]
        rows += [Row([Cell(name), *map(Cell, texts)])] * any(texts)
    heads = (Head(c.label if full else c.name, c.arrow, True) for c in columns)
    return Table("The verdict", "", [Head(""), *heads], rows, strips=full)


def grids(family: Family) -> list[Table]:
    """Return the scores of one family with all that is known of them, and their differences."""
    tables: list[Table] = []
    if family.columns:
        table = grid(family.columns, full=True)
        tables.append(replace(table, title=family.title, text=family.question, facts=family.facts))
    return tables + [of_differences(family)] * bool(family.differences)


def listing(family: Family) -> Table:
    """Return the scores of one family, a row each, so that names and notes have room."""
    rows: list[Row] = []
    for column in family.columns:
        for score, cell in zip(column.scores, column.cells, strict=True):
            text = number(score.value, column.digits) if defined(score) else "undefined"
            null = f"[{', '.join(map(column.text, score.null))}]" if score.null else ""
            limits = interval(score.interval, column.digits), null
            further = map(column.text, (score.floor, *map(baselines(score).get, BASELINES)))
            p, size = p_text(score.details.get("p_value")), count(score.n) if score.n else ""
            names = map(Cell, (f"{column.name} {column.arrow}", score.a))
            value = Cell(text, best=cell.best, decided=cell.decided)
            words = map(Cell, (*limits, p, *further, size))
            rows.append(Row([*names, value, *words, Cell(notes=cell.notes)]))
    numbers = ("value", "95 % interval", "null", "p", "floor", *BASELINES, "n")
    heads = [Head("metric"), Head("subject"), *(Head(n, scores=True) for n in numbers)]
    return Table(family.title, family.question, [*heads, Head("notes")], rows, family.facts)


def of_differences(family: Family) -> Table:
    """Return the paired differences of a family, a row each."""
    rows: list[Row] = []
    for d in family.differences:
        better, p = d.details.get("p_better"), d.details.get("p_adjusted")
        names = map(Cell, (with_arrow(d), d.a, d.b))
        words = map(Cell, ("" if better is None else confidence(better), p_text(p)))
        rows.append(Row([*names, Cell(d, digits_of([d]), notes=notes_of(d)), *words]))
    labels = ("metric", "a", "b", "a - b", "a better", "Holm p")
    heads = [Head(label, scores=k > 2) for k, label in enumerate(labels)]
    text = "a - b; where the interval excludes 0 the difference is more than chance."
    return Table(f"Paired differences: {family.title}", text, heads, rows)


def with_arrow(difference: Score) -> str:
    """Return what a difference is of, with the better direction."""
    return f"{measured(difference)} {ARROWS[difference.higher_is_better]}"
