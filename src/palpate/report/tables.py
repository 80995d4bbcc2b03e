"""The table model of scores: what rows, columns, footnotes and best marks there are.

The terminal, Markdown, LaTeX and HTML write these tables; none decides anything on its own. A
column is what :func:`palpate.core.columns` makes, so scores of different settings raise instead of
sharing one. Scores of another family of metrics, another preset, another split, other features or
another reference are in tables of their own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from palpate.core import Measure, Note, Score, columns, plain, short
from palpate.core.score import ARROWS, BETTER
from palpate.report.labels import label_of, measured, subject_of
from palpate.report.notes import decimals, digits_of, number


@dataclass(frozen=True)
class Family:
    """Metrics that answer one question: by words that are part of their names (lower case)."""

    title: str
    question: str = ""
    parts: tuple[str, ...] = ()


#: The first family whose parts match takes a metric.
FAMILIES = (
    Family(
        "People",
        "Which images do people find closer to the real ones, ties as half a vote, and which "
        "materials do they recognize?",
        ("human ",),
    ),
    Family(
        "Agreement of metrics with people",
        "Kendall's tau-b: 1 orders images or methods as people do, 0 has nothing to do with it.",
        ("tau with people",),
    ),
    Family(
        "Tactile features",
        "Are generated and real images similar to a tactile encoder? I-, CI- and D-TMMD need no "
        "reference images.",
        ("tmmd",),
    ),
    Family(
        "Image distributions",
        "Are the sets of images similar to a general image encoder?",
        ("cmmd", "fid", "kid", "mmd", "precision", "recall ", "density", "coverage"),
    ),
    Family(
        "Image by image",
        "Does each generated image match its real image, pixel by pixel or patch by patch?",
        ("contact ", "ssim", "psnr", "lpips", "l1", "mse"),
    ),
    Family(
        "Captions",
        "Can they be used, and do they name what they should only describe? Those of a contact "
        "count once.",
        ("share of captions",),
    ),
    Family(
        "Material from captions",
        "How often is the material predicted from the text alone, on new videos? Text that only "
        "describes lies between the commonest material and 1.",
        ("from the text",),
    ),
    Family(
        "Recognition",
        "What can be read from the image, by a classifier trained on the train part?",
        ("acc", "probe", "@"),
    ),
    Family(
        "Retrieval",
        "Which text, photo or tactile image belongs to it? The share of samples for which a right "
        "one is among the k most similar, and the median of its rank.",
        ("top-", "median rank", "retriev"),
    ),
    Family("Other metrics"),
)
#: Column of a baseline -> its key in the details of a score.
BASELINES = {"no contact": "empty", "chance": "chance", "majority": "majority"}
BEST = "best of its column by value alone, controls aside"
DECIDED = (
    "better than every other one compared (metrics without reference: closer to the floor) by a "
    "paired difference whose interval excludes 0"
)
#: The ``a`` of scores of real images.
REAL = "real"
#: What the cells of a matrix are.
DIVERGENCE = (
    "Row against column; the diagonal compares two halves of one class. Stronger color: farther "
    "apart."
)
CONFUSION = (
    "Rows: the true class of test samples. Columns: what the classifier called them, as a share of "
    "the row."
)
#: What a preset of the TMMD family means, for the head of its table.
PRESETS = {
    "paper": "the paper's formula to the letter, random halves",
    "paper-tables": "the reading that fits the paper's printed tables",
    "cmmd": "as CMMD's published code",
    "grouped": "whole groups, or both images of a scene, kept together",
}


@dataclass(frozen=True)
class Cell:
    """A score in a table.

    Attributes:
        score: the score.
        footnotes: numbers, from 1, of its notes below the table.
        size: ``"n = 240"``; '' where the whole column shares it.
        best: the best of its column, by value (:func:`best_by_value`).
        decided: better than every other one by a paired difference that is decided.
        competes: whether it can be the best: where there are differences, whether it has one, else
            whether it is not of real images.
    """

    score: Score
    footnotes: Sequence[int]
    size: str = ""
    best: bool = False
    decided: bool = False
    competes: bool = True

    @property
    def defined(self) -> bool:
        """Whether the score has a finite value."""
        return defined(self.score)

    @property
    def p_value(self) -> float | None:
        """p-value of the permutation test."""
        return self.score.details.get("p_value")

    @property
    def baselines(self) -> dict[str, float]:
        """Name -> what it scores without a look at the sample: chance, the commonest class ..."""
        known = {name: self.score.details.get(key) for name, key in BASELINES.items()}
        return {
            name: value
            for name, value in known.items()
            if isinstance(value, int | float) and math.isfinite(value)
        }


@dataclass(frozen=True)
class Column:
    """One metric.

    Attributes:
        measure: what is measured.
        name: that in words; ``label`` lacks the features, which are in the table's title.
        higher_is_better: the direction.
        digits: decimals of all its numbers.
        size: sample sizes if all of its scores share them.
        made: (what, how) its scores were made, where that differs from the other columns.
        cells: its scores.
    """

    measure: Measure
    name: str
    label: str
    higher_is_better: bool | None
    digits: int
    size: str
    made: Sequence[tuple[str, str]]
    cells: Sequence[Cell]

    @property
    def arrow(self) -> str:
        """The better direction."""
        return ARROWS[self.higher_is_better]

    @property
    def better(self) -> str:
        """The better direction in words."""
        return BETTER[self.higher_is_better]


@dataclass(frozen=True)
class Difference:
    """A paired difference of two generators, a - b: one row below the scores.

    Attributes:
        score: the difference, of the generators ``score.a`` and ``score.b``.
        name: of what is measured.
        arrow: its better direction.
        confidence: that a is better, in [0, 1], or None.
        p: two-sided p-value, adjusted by Holm over the pairs, or None.
        digits: decimals of value and interval.
    """

    score: Score
    name: str
    arrow: str
    confidence: float | None
    p: float | None
    digits: int


@dataclass(frozen=True)
class Table:
    """Scores of one family: rows are subjects, columns metrics.

    Attributes:
        title: family, preset, features, split and reference, as far as they are needed.
        question: what the family answers; '' in its further tables.
        columns: the metrics.
        differences: paired differences of these scores.
        notes: the footnotes.
        made: (what, how) all columns were made.
    """

    title: str
    question: str
    columns: Sequence[Column]
    differences: Sequence[Difference]
    notes: Sequence[Note]
    made: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Heat:
    """A square matrix: D-TMMD's divergences, or confusions; ``shares`` lie in [0, 1]."""

    title: str
    meaning: str
    labels: Sequence[str]
    values: Sequence[Sequence[str]]
    shares: Sequence[Sequence[float]]


def defined(score: Score) -> bool:
    """Return whether a score has a value."""
    return score.value is not None


def family_of(score: Score) -> Family:
    """Return the family of a score's metric."""
    name = f"{score.metric.lower()} "
    return next((f for f in FAMILIES[:-1] if any(p in name for p in f.parts)), FAMILIES[-1])


def notes_of(score: Score) -> list[Note]:
    """Return what a reader must know of a score: its notes, and what follows from its fields."""
    notes = [*score.notes]
    if excluded := score.details.get("excluded"):
        notes.append(Note("excluded-classes", {"excluded": excluded}))
    if score.higher_is_better is None and score.details.get("gap") is not None:
        notes.append(Note("nearer-to-floor"))
    if "no contact" in Cell(score, ()).baselines:
        notes.append(Note("no-contact-baseline"))
    lacks_floor = score.floor is None and score.b is None
    if lacks_floor and defined(score) and score.metric in ("TMMD", "I-TMMD", "CI-TMMD", "D-TMMD"):
        code = "no-floor-of-tmmd" if score.metric == "TMMD" else "floor-unknown"
        notes += [] if any(note.code == "no-floor" for note in notes) else [Note(code)]
    return notes


class Footnotes:
    """Notes in order of first use; equal notes have one number."""

    def __init__(self) -> None:
        self.notes: list[Note] = []

    def numbers(self, notes: Iterable[Note]) -> list[int]:
        """Return the numbers, from 1, of some notes, in rising order."""
        notes = list(notes)
        self.notes += [n for k, n in enumerate(notes) if n not in self.notes and n not in notes[:k]]
        return sorted({self.notes.index(note) + 1 for note in notes})


def score_tables(scores: Sequence[Score]) -> list[Table]:
    """Return the tables of all scores: families in fixed order, metrics as they first appear.

    Raises:
        PalpateError: if two scores that share a column were not made with the same settings.
    """
    references = _references(scores)
    groups: dict[tuple[int, str, str, str, int], list[Score]] = {}
    for score, reference in zip(scores, references, strict=True):
        place = FAMILIES.index(family_of(score))
        preset = str(score.settings.get("preset", ""))
        split = "" if score.settings.get("axis") == "split" else score.split or ""
        key = (place, preset, split, score.features, reference)
        groups.setdefault(key, []).append(score)
    several = [len({key[k] for key in groups} - {""}) > 1 for k in (2, 4)]
    tables: list[Table] = []
    for key, members in sorted(groups.items(), key=lambda item: item[0][0]):
        place, preset, split, features, _ = key
        title = [FAMILIES[place].title + (f" of {features}" if features else "")]
        title += [f"{preset}: {PRESETS[preset]}" if preset in PRESETS else preset] if preset else []
        title += [f"split {short(split)}"] if split and several[0] else []
        known = dict.fromkeys(short(s.reference) for s in members if s.reference)
        title += [f"reference {' and '.join(known) or 'not recorded'}"] if several[1] else []
        question = FAMILIES[place].question
        if any(question == table.question for table in tables):
            question = ""
        tables.append(_table(", ".join(title), question, members))
    return tables


def _references(scores: Sequence[Score]) -> list[int]:
    """Return which reference each score was compared with: 0 for the first of its metric, 1 ...

    Different encoders make different features of the same images, so references are counted by
    metric. A score without one (I-, CI-, D-TMMD) goes with the last of its subject that has one,
    else with the first after it.
    """
    known: dict[tuple[Measure, str | None], list[str]] = {}
    index: list[int | None] = []
    for score in scores:
        if score.reference is None:
            index.append(None)
            continue
        metric = known.setdefault((score.measure, score.encoder), [])
        metric += [] if score.reference in metric else [score.reference]
        index.append(metric.index(score.reference))
    last: dict[tuple[str, str | None], int] = {}
    for score, k in reversed(list(zip(scores, index, strict=True))):
        if k is not None:
            last[score.a, score.b] = k
    result: list[int] = []
    for score, k in zip(scores, index, strict=True):
        if k is not None:
            last[score.a, score.b] = k
        result.append(last.get((score.a, score.b), 0))
    return result


def _table(title: str, question: str, scores: Sequence[Score]) -> Table:
    footnotes = Footnotes()
    differences = [s for s in scores if s.b is not None]
    members = [s for s in scores if s.b is None]
    heads: list[Column] = []
    for column in columns(members):
        sizes = [_size(score) for score in column]
        shared = sizes[0] if len(set(sizes)) == 1 else ""
        digits, winner = digits_of(column), best_of(column, differences)
        names = {name for d in differences for name in (d.a, d.b)}
        competes = [s.a in names if names else s.a != REAL for s in column]
        best = best_by_value(
            [s if c else None for s, c in zip(column, competes, strict=True)], digits
        )
        cells = [
            Cell(
                score,
                footnotes.numbers(notes_of(score)),
                "" if shared else size,
                k in best,
                score.a == winner,
                competes[k],
            )
            for k, (score, size) in enumerate(zip(column, sizes, strict=True))
        ]
        first = column[0]
        names = first.measure, measured(first), measured(replace(first, features=""))
        facts = first.higher_is_better, digits, shared, _made(column)
        heads.append(Column(*names, *facts, cells))
    columns(differences)
    rows = [_difference(score) for score in differences if defined(score)]
    shared = [fact for fact in heads[0].made if all(fact in h.made for h in heads)] if heads else []
    heads = [replace(h, made=[fact for fact in h.made if fact not in shared]) for h in heads]
    return Table(title, question, heads, rows, footnotes.notes, shared)


def _difference(score: Score) -> Difference:
    details = score.details
    return Difference(
        score,
        measured(score),
        ARROWS[score.higher_is_better],
        details.get("p_better"),
        details.get("p_adjusted"),
        digits_of([score]),
    )


def rankings(table: Table) -> list[tuple[str, str]]:
    """Return (metric, generators from best to worst) where three or more are compared.

    ``>`` separates neighbors whose paired difference is decided (Holm's p under 0.05), ``~``
    between the others. Metrics without a better direction have no row.
    """
    of_metric: dict[str, list[Difference]] = {}
    for d in table.differences:
        of_metric.setdefault(f"{d.name} {d.arrow}", []).append(d)
    if not of_metric or max(map(len, of_metric.values())) < 3:
        return []
    rows = [(m, _ranking(ds)) for m, ds in of_metric.items()]
    return [(metric, ranking) for metric, ranking in rows if ranking]


def _ranking(differences: Sequence[Difference]) -> str:
    wins = dict.fromkeys([name for d in differences for name in _pair(d.score)], 0)
    known = [d for d in differences if d.confidence is not None]
    for d in known:
        wins[_pair(d.score)[int((d.confidence or 0) <= 0.5)]] += 1
    apart = {frozenset(_pair(d.score)) for d in known if d.p is not None and d.p < 0.05}
    names = sorted(wins, key=lambda name: -wins[name])
    signs = [">" if frozenset(pair) in apart else "~" for pair in pairwise(names)]
    steps = (f" {sign} {name}" for sign, name in zip(signs, names[1:], strict=True))
    return names[0] + "".join(steps) if known else ""


def _pair(difference: Score) -> tuple[str, str]:
    return difference.a, difference.b or ""


def _size(score: Score) -> str:
    sizes = {"n": score.n or None, "m": score.m}
    return ", ".join(f"{name} = {value:,}" for name, value in sizes.items() if value is not None)


def best_of(column: Sequence[Score], differences: Sequence[Score]) -> str | None:
    """Return the subject that is better than every other by a decided paired difference, or None.

    Args:
        column: scores of one metric.
        differences: paired differences; subjects without one (controls) take no part.
    """
    wins: dict[str, bool] = {}
    for d in differences:
        if column and d.measure == column[0].measure:
            for name in _pair(d):
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


def _made(column: Sequence[Score]) -> list[tuple[str, str]]:
    """Return how the scores of one column were made, as (what, how)."""
    first = column[0]
    intervals = (
        ", ".join(filter(None, [f"{100 * s.level:g} %", s.interval_method]))
        for s in column
        if s.interval is not None
    )
    rows = [
        ("estimator", first.estimator),
        ("bandwidth σ", f"{first.bandwidth:g}" if first.bandwidth is not None else ""),
        ("scale", f"× {first.scale:g}" if first.scale != 1 else ""),
        ("interval", "; ".join(dict.fromkeys(intervals))),
        ("seed", ", ".join(dict.fromkeys(str(s.seed) for s in column if s.seed is not None))),
        *((str(k).replace("_", " "), str(plain(v))) for k, v in first.settings.items()),
        ("encoder", first.encoder or ""),
        ("reference", first.reference or ""),
        ("split", first.split or ""),
    ]
    return [(what, how) for what, how in rows if how]


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


def facts_of(table: Table) -> list[tuple[str, str]]:
    """Return (what, how) the scores were made: what all columns share, then what is of one."""
    sizes = [(f"{c.name}, size", c.size) for c in table.columns if c.size]
    single = [(f"{c.name}, {what}", how) for c in table.columns for what, how in c.made]
    return [*sizes, *table.made, *single]


def marks(cells: Iterable[Any], best: str) -> list[str]:
    """Return what the marks of cells mean, where there are any; ``best`` is how it is marked."""
    cells = list(cells)
    known = {f"{best} {BEST}": any(cell.best for cell in cells)}
    known[f"† {DECIDED}"] = any(cell.decided for cell in cells)
    return [text for text, shown in known.items() if shown]
