"""Tables, curves and claims of a study, laid out: what every front end writes of them.

The best of a column is marked by value alone, among the rows that are no controls; where a score
has no better direction, the one closest to its floor.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

from palpate.core import Note, Score
from palpate.core.score import ARROWS, BETTER
from palpate.report.notes import decimals
from palpate.report.results import Results
from palpate.report.study import Claim, Curve, StudyTable
from palpate.report.tables import Footnotes, defined

#: Verdict -> the mark before its word, for those who do not see colors.
MARKS = {"holds": "✓", "does not hold": "✗", "undecided": "?"}
#: What the marks of a table mean.
BEST_OF_COLUMN = "best of its column by value alone, controls aside"
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
    """

    value: Score | str | None
    digits: int = 0
    best: bool = False
    footnotes: Sequence[int] = ()

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
    """A table of a study as it is written.

    Attributes:
        title, text, folded: of the table.
        heads: one a column; labels differ.
        rows: as many entries each as there are heads.
        notes: the footnotes.
        made: (what, how) the scores were made.
    """

    title: str
    text: str
    folded: bool
    heads: Sequence[Head]
    rows: Sequence[Row]
    notes: Sequence[Note]
    made: Sequence[tuple[str, str]]

    @property
    def has_best(self) -> bool:
        """Whether any cell is marked."""
        return any(cell.best for row in self.rows for cell in row.cells)


def sheets(results: Results) -> list[Sheet]:
    """Return the tables of the study."""
    return [sheet(table) for table in results.tables]


def controls_of(results: Results) -> set[str]:
    """Return the subjects that a table of the study names as controls."""
    return {name for table in results.tables for name in table.controls}


def sheet(table: StudyTable) -> Sheet:
    """Return a table with its digits, directions, best marks and footnotes."""
    footnotes = Footnotes()
    width = len(table.columns)
    rows = [[*row, *[None] * width][:width] for row in table.rows]
    controls = [bool(row) and row[0] in table.controls for row in rows]
    columns = [[row[k] for row in rows] for k in range(width)]
    digits = [_digits(column) for column in columns]
    best = [
        _best(column, controls, places) if table.best else set()
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
        _head(label, column, table.best)
        for label, column in zip(_different(table.columns), columns, strict=True)
    ]
    made = _made([value for row in rows for value in row if isinstance(value, Score)])
    return Sheet(table.title, table.text, table.folded, heads, laid, footnotes.notes, made)


def curve_table(curve: Curve) -> StudyTable:
    """Return the numbers of a curve: a row for each x, a column for each line."""
    xs = sorted({x for line in curve.lines for x, _ in line.points})
    known = [dict(line.points) for line in curve.lines]
    rows = [[f"{x:g}", *(points.get(x) for points in known)] for x in xs]
    columns = [curve.x, *(line.label for line in curve.lines)]
    return StudyTable(curve.title, f"{curve.y}. {curve.text}".strip(), columns, rows)


def tally(claims: Sequence[Claim]) -> str:
    """Return how many claims have which verdict: ``4 hold, 1 does not hold, 2 undecided``."""
    counts = Counter(claim.verdict for claim in claims)
    words = {"holds": "hold", "does not hold": "do not hold"}
    return ", ".join(
        f"{counts[verdict]} {verdict if counts[verdict] == 1 else words.get(verdict, verdict)}"
        for verdict in MARKS
        if counts[verdict]
    )


def in_turns_by_source(claims: Sequence[Claim], most: int) -> tuple[list[Claim], list[Claim]]:
    """Return at most ``most`` claims, and the others, both in their order.

    Sources take turns: every one shows its first claim before any shows its second.
    """
    turns: Counter[str] = Counter()
    ranks: list[tuple[int, int]] = []
    for k, claim in enumerate(claims):
        ranks.append((turns[claim.source], k))
        turns[claim.source] += 1
    chosen = {k for _, k in sorted(ranks)[:most]}
    shown = [claim for k, claim in enumerate(claims) if k in chosen]
    return shown, [claim for k, claim in enumerate(claims) if k not in chosen]


def brief(text: str, most: int = 220) -> str:
    """Return the first clauses of a long reason; its evidence has all of it."""
    if len(text) <= most:
        return text
    ends = (text.rfind("; ", 0, most), text.rfind(" ", 0, most), most)
    return f"{text[: next(end for end in ends if end > 0)]} …"


def file_names(kind: str, titles: Sequence[str]) -> list[str]:
    """Return a name for each file: its kind and title in a short form, and a number if needed."""
    names: list[str] = []
    for title in titles:
        words = re.sub("[^a-z0-9]+", "-", title.lower()).strip("-")[:48].strip("-")
        name = words if words.startswith(f"{kind}-") else f"{kind}-{words}".strip("-")
        same = (f"{name}-{k}" for k in count(2))
        names.append(name if name not in names else next(n for n in same if n not in names))
    return names


def evidence_digits(claim: Claim) -> list[int]:
    """Return the decimals of each score of a claim's evidence: equal ones for equal metrics."""
    return _digits(claim.evidence)


def _different(labels: Sequence[str]) -> list[str]:
    """Labels of which none is another's; a repeated one is numbered."""
    seen: Counter[str] = Counter()
    result: list[str] = []
    for label in labels:
        seen[label] += 1
        result.append(label if seen[label] == 1 else f"{label} ({seen[label]})")
    return result


def _digits(column: Sequence[Score | str | None]) -> list[int]:
    """Decimals of each cell: equal ones for the scores of one metric in one column."""
    by_metric: dict[str, list[Score]] = {}
    for score in column:
        if isinstance(score, Score):
            by_metric.setdefault(score.metric, []).append(score)
    digits = {metric: _digits_of(scores) for metric, scores in by_metric.items()}
    return [digits[s.metric] if isinstance(s, Score) else 0 for s in column]


def _digits_of(scores: Sequence[Score]) -> int:
    """Decimals of the scores of one metric; none of ranks and counts."""
    values = [float(s) for s in scores if defined(s)]
    bounds = [v for s in scores for v in s.interval or ()]
    if not bounds and max(values, default=0) > 1 and all(v == round(v) for v in values):
        return 0
    return decimals([*values, *bounds])


def _head(label: str, column: Sequence[Score | str | None], best: bool) -> Head:
    scores = [value for value in column if isinstance(value, Score)]
    directions = {score.higher_is_better for score in scores}
    shown = best and len(directions) == 1 and not _ARROW.search(label)
    direction = scores[0].higher_is_better if shown else None
    words = (ARROWS[direction], BETTER[direction]) if shown else ("", "")
    return Head(label, *words, bool(scores) or not any(column))


def _best(
    column: Sequence[Score | str | None], controls: Sequence[bool], digits: Sequence[int]
) -> set[int]:
    """The rows with the best score as it is written; none where fewer than two compete."""
    competing = {
        k: value
        for k, (value, control) in enumerate(zip(column, controls, strict=True))
        if isinstance(value, Score) and not control and defined(value)
    }
    directions = {score.higher_is_better for score in competing.values()}
    floors = [score.floor for score in competing.values()]
    if len(competing) < 2 or len(directions) > 1 or (None in directions and None in floors):
        return set()
    keys: dict[bool | None, Callable[[Score], float]] = {
        True: lambda s: -float(s),
        False: float,
        None: lambda s: abs(float(s) - float(s.floor or 0)),
    }
    key = keys[next(iter(directions))]
    written = {k: round(key(score), digits[k]) for k, score in competing.items()}
    return {k for k, value in written.items() if value == min(written.values())}


def _made(scores: Sequence[Score]) -> list[tuple[str, str]]:
    """How the scores of a table were made, as (what, how)."""
    sizes = sorted({score.n for score in scores if score.n})
    methods = (f"{100 * s.level:g} %, {s.interval_method}" for s in scores if s.interval)
    facts = {
        "n": [" to ".join(dict.fromkeys(f"{n:,}" for n in (*sizes[:1], *sizes[-1:])))],
        "interval": [method.removesuffix(", ") for method in methods],
        "estimator": [score.estimator for score in scores],
        "seed": [str(score.seed) for score in scores if score.seed is not None],
        "stages": [str(score.details.get("stage", "")) for score in scores],
    }
    rows = {what: list(dict.fromkeys(filter(None, how))) for what, how in facts.items()}
    return [(what, _few(what, how)) for what, how in rows.items() if how]


def _few(what: str, words: Sequence[str], most: int = 12) -> str:
    more = [f"{len(words) - most} more"] * (len(words) > most)
    return ("; " if what == "interval" else ", ").join([*words[:most], *more])
