"""Results and audits as text for a terminal: one row a score, so that names and notes have room."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import pairwise

from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from palpate.core import Score
from palpate.report.findings import (
    audit_line,
    cause_texts,
    chance_text,
    question_lines,
    signal_notes,
    threshold_text,
)
from palpate.report.labels import count, percent
from palpate.report.note_texts import Style
from palpate.report.notes import COMMAND_LINE, PYTHON, sentence
from palpate.report.records import Claim
from palpate.report.results import Audit, Results
from palpate.report.study import of_study, tally
from palpate.report.tables import (
    Cell,
    Family,
    Head,
    Row,
    Table,
    families,
    listing,
    of_differences,
    with_arrow,
)

#: Title of the rankings, which replace the differences of more than two generators.
RANKED = "Best first on the same samples: > decided, ~ not decided"


def print_result(result: Results | Audit, console: Console, style: Style = COMMAND_LINE) -> None:
    """Print a result as wide as the console; of a study its tables instead of every score."""
    if isinstance(result, Audit):
        console.print(audit_text(result, style), markup=False, soft_wrap=True)
        return
    for family in () if result.tables else families(result.scores, result.controls):
        _print_table(listing(family), console, style)
        if ranked := rankings(family):
            _print_table(ranked, console, style)
        elif family.differences:
            _print_table(of_differences(family), console, style)
        console.print()
    for audit in result.audits:
        print_result(audit, console, style)
    for table in map(of_study, result.tables):
        _print_table(table, console, style)
        console.print()
    if result.tables and result.scores:
        console.print(f"The {len(result.scores):,} scores behind them: Results.to_frame()\n")
    _print_claims(result.claims, console)
    _print_lines([sentence(note, style) for note in result.notes], console)


def as_text(result: Results | Audit, width: int = 140) -> str:
    """Return a result as text, in the wording of Python."""
    file = io.StringIO()
    print_result(result, Console(file=file, width=width, color_system=None), PYTHON)
    return "\n".join(line.rstrip() for line in file.getvalue().rstrip().splitlines())


def _print_lines(lines: Sequence[str], console: Console) -> None:
    for line in lines:
        console.print(Text(line), soft_wrap=True)


def _print_table(table: Table, console: Console, style: Style) -> None:
    console.print(Text(table.title, "bold"), soft_wrap=True)
    _print_rows(*table.plain(), console)
    notes = [f"({k}) {sentence(note, style)}" for k, note in enumerate(table.notes, 1)]
    _print_lines([*table.marks("*"), *notes], console)


def _print_rows(heads: Sequence[Head], rows: Sequence[Sequence[str]], console: Console) -> None:
    """Print rows as a table, or as lists where that is too wide."""
    if not rows:
        return
    grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for head in heads:
        grid.add_column(Text(str(head)), justify="right" if head.scores else "left", no_wrap=True)
    for row in rows:
        grid.add_row(*map(Text, row))
    wide = console.measure(grid, options=console.options.update(width=10_000)).maximum
    if wide <= console.width:
        console.print(grid)
        return
    names = next((k for k, head in enumerate(heads[:3]) if head.scores), min(3, len(heads)))
    for row in rows:
        console.print(Text(", ".join(row[:names]), "bold"), soft_wrap=True)
        pairs = zip(heads[names:], row[names:], strict=True)
        _print_lines([f"  {head}: {text}" for head, text in pairs if text], console)


def _print_claims(claims: Sequence[Claim], console: Console) -> None:
    if not claims:
        return
    console.print(Text(f"Claims: {tally(claims)}", "bold"))
    for claim in claims:
        head = f"{claim.verdict}: {claim.claim} ({claim.source})"
        _print_lines([head, f"  {claim.why}"], console)
    console.print()


def audit_text(audit: Audit, style: Style = PYTHON) -> str:
    """Return the finding, a line for each signal, the notes and what leaking costs."""
    lines = [audit_line(audit), *(f"  {line}" for line in question_lines(audit))]
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


def rankings(family: Family) -> Table | None:
    """Return the generators of each metric from best to worst where three or more are compared.

    ``>`` separates neighbors whose paired difference is decided (Holm's p under 0.05), ``~``
    between the others. Metrics without a better direction have no row.
    """
    by_metric: dict[str, list[Score]] = {}
    for d in family.differences:
        by_metric.setdefault(with_arrow(d), []).append(d)
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
