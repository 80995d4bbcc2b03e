"""Results and audits as text for a terminal."""

from __future__ import annotations

from rich.console import Console

from palpate.report.notes import sentence
from palpate.report.results import Audit, Results
from palpate.report.sentences import audit_line, cause_texts, threshold_text
from palpate.report.text import percent


def results_text(results: Results) -> str:
    """The scores, then the audits."""
    return "\n".join([*map(str, results.scores), *map(str, results.audits)])


def audit_text(audit: Audit) -> str:
    """The finding, a line for each signal, and the notes."""
    lines = [audit_line(audit)]
    if audit.groups_in_all:
        lines.append(f"  {audit.groups_shared} of {audit.groups_in_all} {audit.group} groups are shared")
    if audit.gap_min is not None:
        gaps = f"{audit.gap_min} to {audit.gap_max} frames, median {audit.gap_median}"
        lines.append(f"  gap to the nearest train frame of the video: {gaps}")
    width = max((len(signal.kind) for signal in audit.signals), default=0)
    for signal in audit.signals:
        share = f"{signal.flagged} of {signal.checked} ({percent(signal.fraction)})"
        facts = [share, threshold_text(signal), *cause_texts(signal)]
        lines.append(f"  {signal.kind:<{width}}  {', '.join(facts)}")
    lines += [f"  {signal.kind}: {sentence(n)}" for signal in audit.signals for n in signal.notes]
    lines += [sentence(note) for note in audit.notes]
    if audit.impact is not None:
        lines.append(audit.impact.headline)
    return "\n".join([*lines, *map(str, audit.others)])


def print_result(result: Results | Audit, console: Console) -> None:
    """Print a result as wide as the console."""
    console.print(str(result), markup=False, soft_wrap=True)
