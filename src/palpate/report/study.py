"""A study's tables as they are written, and its claims in a word."""

from __future__ import annotations

import re
from collections.abc import Sequence

from palpate.core import Measure, Score
from palpate.report.labels import digits_of
from palpate.report.records import Claim, StudyTable
from palpate.report.tables import ARROWS, Cell, Head, Row, Table, best_by_value, interval_text

#: Verdict -> the mark before its word, for those who do not see colors.
MARKS = {"holds": "✓", "does not hold": "✗", "undecided": "?"}
#: Stages, seeds ... that are named.
FEW = 12
_DEGREES = re.compile(r"[\d.]+(?= df)")


def of_study(table: StudyTable) -> Table:
    """Return a table of a study with its digits, directions, best marks and footnotes."""
    width = len(table.columns)
    rows = [[*row, *[None] * width][:width] for row in table.rows]  # rows may be short
    controls = [row[0] in table.controls for row in rows]
    free = [table.best and not control for control in controls]
    columns = [_cells([row[k] for row in rows], free) for k in range(width)]
    laid = [
        Row([cells[k] for cells in columns], control, k > 0 and control != controls[k - 1])
        for k, control in enumerate(controls)
    ]
    compared = table.best or bool(table.controls)
    heads = [_head(*pair, compared) for pair in zip(table.columns, columns, strict=True)]
    return Table(table.title, table.text, heads, laid, _facts(rows))


def _cells(values: Sequence[Score | str | None], free: Sequence[bool]) -> list[Cell]:
    """Cells of a column: one number of decimals for the scores of one measure; the best is free."""
    alike: dict[tuple[Measure, str], list[Score]] = {}
    for score in values:
        if isinstance(score, Score):
            alike.setdefault((score.measure, score.kind), []).append(score)
    digits = {key: digits_of(scores) for key, scores in alike.items()}
    competing = [
        v if isinstance(v, Score) and f else None for v, f in zip(values, free, strict=True)
    ]
    best = best_by_value(competing, max(digits.values(), default=0))
    return [
        Cell(v, digits[v.measure, v.kind], k in best, notes=v.notes)
        if isinstance(v, Score)
        else Cell(v)
        for k, v in enumerate(values)
    ]


def _head(label: str, cells: Sequence[Cell], compared: bool) -> Head:
    """A column's head; one that is empty is among the numbers."""
    scores = [cell.score for cell in cells if cell.score]
    directions = {score.higher_is_better for score in scores}
    directed = compared and len(directions) == 1 and not re.search("[↑↓→]", label)
    if not directed or (None in directions and all(s.floor is None for s in scores)):
        return Head(label, scores=bool(scores) or not any(cell.value for cell in cells))
    return Head(label, ARROWS[scores[0].higher_is_better], True)


def _facts(rows: Sequence[Sequence[Score | str | None]]) -> dict[str, str]:
    """How the scores of a study's table were made, by what."""
    scores = [value for row in rows for value in row if isinstance(value, Score)]
    sizes = sorted({score.n for score in scores if score.n})
    degrees: dict[str, list[str]] = {}  # methods that differ in these alone are one
    for method in filter(None, map(interval_text, scores)):
        degrees.setdefault(_DEGREES.sub("{}", method), []).extend(_DEGREES.findall(method))
    spans = {
        m: "-".join(dict.fromkeys(sorted(n, key=float)[:: len(n) - 1 or 1]))
        for m, n in degrees.items()
    }
    facts = {
        "n": [" to ".join(dict.fromkeys(f"{n:,}" for n in (*sizes[:1], *sizes[-1:])))],
        "interval": [method.replace("{}", span) for method, span in spans.items()],
        "estimator": [score.estimator for score in scores],
        "seed": [str(score.seed) for score in scores if score.seed is not None],
        "stages": [str(score.details.get("stage", "")) for score in scores],
    }
    lines: dict[str, str] = {}
    for name, texts in facts.items():
        words = list(dict.fromkeys(filter(None, texts)))
        words[FEW:] = [f"{len(words) - FEW} more"] * (len(words) > FEW)
        lines |= {name: ("; " if name == "interval" else ", ").join(words)} if words else {}
    return lines


def tally(claims: Sequence[Claim]) -> str:
    """Return how many claims have which verdict: ``4 hold, 1 undecided, 1 not measured``."""
    verdicts = [claim.verdict if claim.measured else "not measured" for claim in claims]
    counts = {verdict: verdicts.count(verdict) for verdict in (*MARKS, "not measured")}
    many = {"holds": "hold", "does not hold": "do not hold"}
    words = (
        f"{n} {verdict if n == 1 else many.get(verdict, verdict)}"
        for verdict, n in counts.items()
        if n
    )
    return ", ".join(words)


def brief(text: str, most: int = 220) -> str:
    """Return the first clauses of a long reason; its evidence has all of it."""
    if len(text) <= most:
        return text
    ends = (text.rfind("; ", 0, most), text.rfind(" ", 0, most), most)
    cut = text[: next(end for end in ends if end > 0)]
    return f"{cut.rpartition(' [')[0] if cut.count('[') > cut.count(']') else cut} …"
