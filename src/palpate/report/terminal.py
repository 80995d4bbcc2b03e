"""Results and audits as plain text, for the terminal and for ``print`` in Python.

Every score has a row of its own, so that its name, interval and notes have room.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import pairwise, takewhile

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
    """Print a result as wide as the console.

    The result of a study is printed as its tables; they stand for the single scores.

    Args:
        result: scores and audits, or one audit.
        console: where to print.
        style: whether notes name options of the command line or arguments of Python.
    """
    if isinstance(result, Audit):
        console.print(audit_text(result, style), markup=False, soft_wrap=True)
        return
    if not result.tables:
        for family in families(result.scores, result.controls):
            _print_table(listing(family), console, style)
            if ranked := rankings(family):
                _print_table(ranked, console, style)
            elif family.differences:
                _print_table(of_differences(family), console, style)
            console.print()
    for audit in result.audits:
        print_result(audit, console, style)
    for table in result.tables:
        _print_table(of_study(table), console, style)
        console.print()
    if result.tables and result.scores:
        console.print(f"The {len(result.scores):,} scores behind them: Results.to_frame()\n")
    _print_claims(result.claims, console)
    _print_lines([sentence(note, style) for note in result.notes], console)


def as_text(result: Results | Audit, width: int = 140) -> str:
    """Return a result as text for ``print``; ``width`` in characters."""
    file = io.StringIO()
    # In a notebook, rich would show it there at once and leave nothing to return.
    console = Console(file=file, width=width, color_system=None, force_jupyter=False)
    print_result(result, console, PYTHON)
    text = "\n".join(line.rstrip() for line in file.getvalue().rstrip().splitlines())
    return text or getattr(result, "title", "") or "No scores"


def _print_lines(lines: Sequence[str], console: Console) -> None:
    for line in lines:
        console.print(Text(line), soft_wrap=True)


def _print_table(table: Table, console: Console, style: Style) -> None:
    console.print(Text(table.title, "bold"), soft_wrap=True)
    _print_rows(*table.plain(), console)
    notes = [f"({k}) {sentence(note, style)}" for k, note in enumerate(table.notes, 1)]
    _print_lines([*table.marks("*"), *notes], console)


def _print_rows(heads: Sequence[Head], rows: Sequence[Sequence[str]], console: Console) -> None:
    """Print rows as a table; where that is too wide, each as a list of ``head: text`` lines."""
    if not rows:
        return
    grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for head in heads:
        grid.add_column(Text(str(head)), justify="right" if head.scores else "left", no_wrap=True)
    for row in rows:
        grid.add_row(*map(Text, row))
    unlimited = console.options.update(width=10_000)
    if console.measure(grid, options=unlimited).maximum <= console.width:
        console.print(grid)
        return
    # The columns before the first score, three at most, name the row: they head its list.
    first_score = len([*takewhile(lambda head: not head.scores, heads[:3])])
    for row in rows:
        console.print(Text(", ".join(row[:first_score]), "bold"), soft_wrap=True)
        pairs = zip(heads[first_score:], row[first_score:], strict=True)
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
    """Return an audit as lines of text.

    They are the verdict, the shared groups and the time gap, a line for each signal of leaking, the
    notes, how much leaking changes the scores, and the same of further audits.
    """
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
        facts = ["none could be checked"]
        if signal.checked:
            number = f"{count(signal.flagged)} of {count(signal.checked)}"
            share = f"{number} ({percent(signal.fraction)})"
            facts = [share, threshold_text(signal), *cause_texts(signal), chance_text(signal)]
        lines.append(f"  {signal.kind:<{width}}  {', '.join(filter(None, facts))}")
    lines += [f"  {kinds}: {sentence(note, style)}" for kinds, note in signal_notes(audit)]
    lines += [sentence(note, style) for note in audit.notes]
    if audit.impact is not None:
        lines.append(audit.impact.headline)
        lines += [f"  {sentence(note, style)}" for note in audit.impact.notes]
    return "\n".join([*lines, *(audit_text(other, style) for other in audit.others)])


def rankings(family: Family) -> Table | None:
    """Return the generators of each metric from best to worst where three or more are compared.

    ``>`` separates neighbors whose paired difference is decided (Holm-adjusted p under 0.05), ``~``
    the others. A metric of which neither low nor high is better has no row.
    """
    by_metric: dict[str, list[Score]] = {}
    for difference in family.differences:
        by_metric.setdefault(with_arrow(difference), []).append(difference)
    if max(map(len, by_metric.values()), default=0) < 3:  # three generators make three pairs
        return None
    orders = [(metric, _ranking(pairs)) for metric, pairs in by_metric.items()]
    rows = [Row([Cell(metric), Cell(order)]) for metric, order in orders if order]
    return Table(RANKED, "", [Head("metric"), Head("best first")], rows) if rows else None


def _ranking(differences: Sequence[Score]) -> str:
    """Order generators by the number of paired comparisons that each wins: ``"b ~ c > a"``.

    Args:
        differences: of one metric, a pair of generators each. ``details`` hold ``p_better``, the
            confidence in [0, 1] that ``a`` is better than ``b``, and ``p_adjusted``.

    Returns:
        The order; empty where no difference says which one is better.
    """
    wins: dict[str, int] = {}
    decided: set[frozenset[str]] = set()
    for difference in differences:
        a, b = difference.a, difference.b or ""
        wins.setdefault(a, 0)
        wins.setdefault(b, 0)
        better, p = difference.details.get("p_better"), difference.details.get("p_adjusted")
        if better is None:
            continue
        wins[a if better > 0.5 else b] += 1
        if p is not None and p < 0.05:
            decided.add(frozenset((a, b)))
    if not any(wins.values()):
        return ""
    names = sorted(wins, key=lambda name: -wins[name])
    order = names[0]
    for pair in pairwise(names):
        order += f" {'>' if frozenset(pair) in decided else '~'} {pair[1]}"
    return order
