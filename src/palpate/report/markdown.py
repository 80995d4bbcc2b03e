"""Results as Markdown: facts, scores, audits, settings and commands; the page has the images.

Scores have the rows of the terminal, as GitHub's pipe tables, padded so that they also read well in
a terminal. Audits are the terminal's text.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from palpate.core import plain
from palpate.report.findings import purpose, summary_lines
from palpate.report.note_texts import HOW_TO_READ
from palpate.report.notes import sentence
from palpate.report.records import Claim
from palpate.report.results import Results
from palpate.report.study import of_study, tally
from palpate.report.tables import Family, Head, Table, families, listing, of_differences
from palpate.report.terminal import audit_text

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
    tables = [
        line for family in families(results.scores, results.controls) for line in _scores(family)
    ]
    studied = [line for table in map(of_study, results.tables) for line in _table(table)]
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


def pipe_table(heads: Sequence[Head], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as a padded table; numbers are flush right."""
    cells = [[esc(str(head)) for head in heads], *([*map(esc, row)] for row in rows)]
    widths = [max(3, *map(len, column)) for column in zip(*cells, strict=True)]
    rule = ["-" * (w - h.scores) + ":" * h.scores for w, h in zip(widths, heads, strict=True)]
    padded = [
        [c.rjust(w) if h.scores else c.ljust(w) for c, w, h in zip(row, widths, heads, strict=True)]
        for row in cells
    ]
    return [f"| {' | '.join(row)} |" for row in (padded[0], rule, *padded[1:])] + [""]


def _items(lines: Iterable[str]) -> list[str]:
    return [*(f"- {esc(line)}" for line in lines), ""]


def _fenced(text: str, language: str = "text") -> list[str]:
    return [f"```{language}", text.replace("```", "` ` `"), "```"] if text else []


def _scores(family: Family) -> list[str]:
    differences = [of_differences(family)] if family.differences else []
    return [line for table in (listing(family), *differences) for line in _table(table)]


def _table(table: Table) -> list[str]:
    grid = pipe_table(*table.plain()) if table.rows else []
    lines = [f"### {esc(table.title)}", "", *([esc(table.text), ""] if table.text else []), *grid]
    lines += [line for mark in table.marks("*") for line in (esc(mark), "")]
    lines += [f"- {esc(name)}: {esc(text)}" for name, text in table.facts.items()]
    lines += [f"- ({k}) {esc(sentence(note))}" for k, note in enumerate(table.notes, 1)]
    return [*lines, ""]


def _claims(claims: Sequence[Claim]) -> list[str]:
    rows = [[f"{c.claim} ({c.source})", c.verdict, c.why] for c in claims]
    heads = [Head(name) for name in ("claim", "verdict", "why")]
    return [f"{tally(claims)}.", "", *pipe_table(heads, rows)] if rows else []


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
