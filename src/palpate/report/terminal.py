"""Results and audits as text for a terminal: one row a score, so that names and notes have room."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import takewhile

from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from palpate.core import Note, Score
from palpate.report.notes import (
    COMMAND_LINE,
    PYTHON,
    Style,
    count,
    number,
    p_text,
    percent,
    sentence,
)
from palpate.report.results import Audit, Results
from palpate.report.sentences import (
    audit_line,
    cause_texts,
    chance_text,
    signal_notes,
    threshold_text,
)
from palpate.report.study import Claim
from palpate.report.study_tables import Entry, Sheet, difference_sheet, sheet, tally
from palpate.report.tables import BASELINES, Table, defined, marks, rankings, score_tables

#: Columns that are text; all others are numbers, flush right.
NAMES = ("metric", "subject", "a", "b", "notes", "best first")
#: Head of the rankings, shown instead of the differences of more than two generators.
RANKED = "Best first on the same samples: > decided, ~ not decided"


def print_result(result: Results | Audit, console: Console, style: Style = COMMAND_LINE) -> None:
    """Print a result as wide as the console; of a study its tables instead of every score."""
    if isinstance(result, Audit):
        console.print(audit_text(result, style), markup=False, soft_wrap=True)
        return
    if not result.tables:
        _print_scores(result.scores, console, style)
    for audit in result.audits:
        print_result(audit, console, style)
    for table in map(sheet, result.tables):
        _print_sheet(table, console, style)
    if result.tables and result.scores:
        console.print(f"The {len(result.scores):,} scores behind them: Results.to_frame()\n")
    _print_claims(result.claims, console)
    for note in result.notes:
        console.print(Text(sentence(note, style)), soft_wrap=True)


def _print_scores(scores: Sequence[Score], console: Console, style: Style) -> None:
    for table in score_tables(scores):
        console.print(Text(table.title, "bold"))
        _print_rows(score_rows(table), console)
        marked = marks((cell for column in table.columns for cell in column.cells), "*")
        _print_lines([*marked, *_notes(table.notes, style)], console)
        if ranked := rankings(table):
            console.print(Text(RANKED, "bold"))
            _print_rows([{"metric": m, "best first": order} for m, order in ranked], console)
        elif table.differences:
            _print_sheet(difference_sheet(table), console, style)
        console.print()


def _notes(notes: Sequence[Note], style: Style) -> list[str]:
    return [f"({k}) {sentence(note, style)}" for k, note in enumerate(notes, 1)]


def _print_lines(lines: Sequence[str], console: Console) -> None:
    for line in lines:
        console.print(Text(line), soft_wrap=True)


def as_text(result: Results | Audit, width: int = 140) -> str:
    """Return a result as text, in the wording of Python."""
    file = io.StringIO()
    print_result(result, Console(file=file, width=width, color_system=None), PYTHON)
    return "\n".join(line.rstrip() for line in file.getvalue().rstrip().splitlines())


def score_rows(table: Table) -> list[dict[str, str]]:
    """Return the scores of a table, a row each."""
    return [
        {
            "metric": f"{column.name} {column.arrow}",
            "subject": cell.score.a,
            "value": _number(cell.score.value, column.digits)
            + " *" * cell.best
            + " †" * cell.decided,
            "95 % interval": _pair(cell.score.interval, column.digits),
            "null": _pair(cell.score.null, column.digits),
            "p": p_text(cell.p_value),
            "floor": _number(cell.score.floor, column.digits, ""),
            **{name: _number(cell.baselines.get(name), column.digits, "") for name in BASELINES},
            "n": count(cell.score.n) if cell.score.n else "",
            "notes": " ".join(f"({k})" for k in cell.footnotes),
        }
        for column in table.columns
        for cell in column.cells
    ]


def sheet_rows(table: Sheet) -> list[dict[str, str]]:
    """Return the rows of a table of a study; best scores have a star, controls are called so."""
    return [
        {
            f"{head.label} {head.arrow}".strip(): _entry(cell)
            + (" (control)" if row.control and not k else "")
            for k, (head, cell) in enumerate(zip(table.heads, row.cells, strict=True))
        }
        for row in table.rows
    ]


def sheet_words(table: Sheet) -> list[str]:
    """Return the columns of a table that hold words."""
    return [head.label for head in table.heads if not head.scores]


def _entry(cell: Entry) -> str:
    if cell.score is None:
        return cell.value if isinstance(cell.value, str) else ""
    parts = [_number(cell.score.value, cell.digits)]
    parts += [_pair(cell.score.interval, cell.digits)] * defined(cell.score)
    marks = ["*"] * cell.best + ["†"] * cell.decided + [f"({k})" for k in cell.footnotes]
    return " ".join(filter(None, [*parts, *marks]))


def _print_sheet(table: Sheet, console: Console, style: Style) -> None:
    console.print(Text(table.title, "bold"), soft_wrap=True)
    words = sheet_words(table)
    _print_rows(sheet_rows(table), console, words)
    _print_lines([*table.marks("*"), *_notes(table.notes, style)], console)
    console.print()


def _print_claims(claims: Sequence[Claim], console: Console) -> None:
    if not claims:
        return
    console.print(Text(f"Claims: {tally(claims)}", "bold"))
    for claim in claims:
        console.print(Text(f"{claim.verdict}: {claim.claim} ({claim.source})"), soft_wrap=True)
        console.print(Text(f"  {claim.why}"), soft_wrap=True)
    console.print()


def _print_rows(
    rows: Sequence[dict[str, str]], console: Console, words: Sequence[str] = NAMES
) -> None:
    """Print rows as a table without empty columns, or as lists where that is too wide.

    ``words`` are the columns of text.
    """
    if not rows:
        return
    names = [name for name in rows[0] if any(row[name] for row in rows)]
    grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in names:
        grid.add_column(Text(name), justify="left" if name in words else "right", no_wrap=True)
    for row in rows:
        grid.add_row(*(Text(row[name]) for name in names))
    wide = console.measure(grid, options=console.options.update(width=10_000)).maximum
    if wide <= console.width:
        console.print(grid)
        return
    for row in rows:
        head = [row[name] for name in takewhile(words.__contains__, names[:3])]
        console.print(Text(", ".join(head), "bold"), soft_wrap=True)
        for name in names[len(head) :]:
            if row[name]:
                console.print(Text(f"  {name}: {row[name]}"), soft_wrap=True)


def _number(value: float | None, digits: int, none: str = "undefined") -> str:
    # An ASCII minus: not every terminal has the true one.
    return none if value is None else number(value, digits).replace("−", "-")


def _pair(pair: tuple[float, float] | None, digits: int) -> str:
    return "" if pair is None else f"[{_number(pair[0], digits)}, {_number(pair[1], digits)}]"


def audit_text(audit: Audit, style: Style = PYTHON) -> str:
    """Return the finding, a line for each signal, the notes and what leaking costs."""
    lines = [audit_line(audit)]
    if audit.groups_in_all:
        lines.append(
            f"  {audit.groups_shared} of {audit.groups_in_all} {audit.group} groups are shared"
        )
    if audit.gap_min is not None:
        gaps = f"{audit.gap_min} to {audit.gap_max} frames, median {audit.gap_median}"
        lines.append(f"  gap to the nearest train frame of the video: {gaps}")
    width = max((len(signal.kind) for signal in audit.signals), default=0)
    for signal in audit.signals:
        share = f"{count(signal.flagged)} of {count(signal.checked)} ({percent(signal.fraction)})"
        facts = [share, threshold_text(signal), *cause_texts(signal), chance_text(signal)]
        facts = facts if signal.checked else ["none could be checked"]
        lines.append(f"  {signal.kind:<{width}}  {', '.join(filter(None, facts))}")
    lines += [f"  {kinds}: {sentence(note, style)}" for kinds, note in signal_notes(audit)]
    lines += [sentence(note, style) for note in audit.notes]
    if audit.impact is not None:
        lines.append(audit.impact.headline)
        lines += [f"  {sentence(note, style)}" for note in audit.impact.notes]
    return "\n".join([*lines, *(audit_text(other, style) for other in audit.others)])
