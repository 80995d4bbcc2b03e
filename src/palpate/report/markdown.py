"""Results as Markdown: facts, scores, audits, settings and commands; the page has the images.

Scores have the rows of the terminal, as GitHub's pipe tables, padded so that they also read well in
a terminal. Audits are the terminal's text.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from palpate.core import Note, plain
from palpate.report.notes import HOW_TO_READ, sentence
from palpate.report.results import Results
from palpate.report.sentences import purpose, summary_lines
from palpate.report.study import Claim
from palpate.report.study_tables import Sheet, difference_sheet, sheet, tally
from palpate.report.tables import Table, facts_of, marks, score_tables
from palpate.report.terminal import NAMES, audit_text, score_rows, sheet_rows, sheet_words

_SPECIAL = str.maketrans({c: f"\\{c}" for c in "\\`*_[]|<>"})


def render_markdown(results: Results) -> str:
    """Return the results as Markdown text.

    Raises:
        PalpateError: if scores of different settings would share a column.
    """
    facts = list(results.facts) or summary_lines(results)
    lines = [f"# {esc(results.title)}", "", f"palpate: {esc(purpose(results))}", "", *_items(facts)]
    if results.notes:
        lines += ["## Read this first", "", *_items(map(sentence, results.notes))]
    tables = [line for table in score_tables(results.scores) for line in _scores(table)]
    studied = [line for table in map(sheet, results.tables) for line in _sheet(table)]
    sections = {
        "Claims": _claims(results.claims),
        "Tables": studied,
        "Scores": [HOW_TO_READ, "", *tables] if tables else [],
        "Leakage audit": [line for a in results.audits for line in _fenced(audit_text(a))],
        "Settings and digests": _tree(plain(results.settings)),
        "Commands": _fenced("\n".join(results.commands), "sh"),
    }
    for title, body in sections.items():
        lines += [f"## {title}", "", *body, ""] if body else []
    return "\n".join(lines).rstrip() + "\n"


def esc(text: str) -> str:
    """Return text on one line in which no character means anything to Markdown."""
    return " ".join(text.split()).translate(_SPECIAL)


def code(text: str) -> str:
    """Return text in backticks, which it may itself hold."""
    text = " ".join(text.split())
    fence = "`"
    while fence in text:
        fence += "`"
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}"


def pipe_table(rows: Sequence[Mapping[str, str]], words: Sequence[str] = NAMES) -> list[str]:
    """Return rows as a padded table without the columns that are empty.

    ``words`` are the columns of text; others are flush right.
    """
    names = [name for name in rows[0] if any(row[name] for row in rows)]
    heads = [esc(name) for name in names]
    cells = [[esc(row[name]) for name in names] for row in rows]
    widths = [max(3, *map(len, column)) for column in zip(heads, *cells, strict=True)]
    right = [name not in words for name in names]
    rule = ["-" * (w - r) + ":" * r for w, r in zip(widths, right, strict=True)]
    padded = [
        [c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True)]
        for row in (heads, *cells)
    ]
    return [f"| {' | '.join(row)} |" for row in (padded[0], rule, *padded[1:])] + [""]


def _items(lines: Iterable[str]) -> list[str]:
    return [*(f"- {esc(line)}" for line in lines), ""]


def _fenced(text: str, language: str = "text") -> list[str]:
    return [f"```{language}", text.replace("```", "` ` `"), "```"] if text else []


def _scores(table: Table) -> list[str]:
    grid = pipe_table(score_rows(table)) if table.columns else []
    marked = marks((cell for column in table.columns for cell in column.cells), "*")
    lines = _laid((table.title, table.question), grid, marked, facts_of(table), table.notes)
    return [*lines, *(_sheet(difference_sheet(table)) if table.differences else [])]


def _sheet(table: Sheet) -> list[str]:
    grid = pipe_table(sheet_rows(table), sheet_words(table)) if table.rows else []
    return _laid((table.title, table.text), grid, table.marks("*"), table.made, table.notes)


def _laid(
    head: tuple[str, str],
    grid: Sequence[str],
    marked: Sequence[str],
    made: Iterable[tuple[str, str]],
    notes: Sequence[Note],
) -> list[str]:
    title, text = map(esc, head)
    lines = [f"### {title}", "", *([text, ""] if text else []), *grid]
    lines += [line for mark in marked for line in (esc(mark), "")]
    lines += [f"- {esc(what)}: {esc(how)}" for what, how in made]
    lines += [f"- ({k}) {esc(sentence(note))}" for k, note in enumerate(notes, 1)]
    return [*lines, ""]


def _claims(claims: Sequence[Claim]) -> list[str]:
    rows = [
        {"claim": f"{c.claim} ({c.source})", "verdict": c.verdict, "why": c.why} for c in claims
    ]
    return [f"{tally(claims)}.", "", *pipe_table(rows, list(rows[0]))] if rows else []


def _tree(value: Mapping[str, Any], depth: int = 0) -> list[str]:
    lines: list[str] = []
    for key, inner in value.items():
        indent = "  " * depth
        if isinstance(inner, Mapping) and inner:
            lines += [f"{indent}- {esc(str(key))}:", *_tree(inner, depth + 1)]
        else:
            text = inner if isinstance(inner, str) else json.dumps(inner, ensure_ascii=False)
            lines.append(f"{indent}- {esc(str(key))}: {code(text) if text else '(empty)'}")
    return lines
