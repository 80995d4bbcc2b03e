"""The same results as Markdown: facts, tables, settings and commands; paths stand in for pictures.

Tables are GitHub's pipe tables, padded so that they also read well in a terminal.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from palpate.core import SampleRef
from palpate.report.audits import (
    interval_percent,
    matrix_view,
    pair_facts,
    pair_lists,
    signal_row,
    signal_view,
)
from palpate.report.notes import sentence
from palpate.report.page import in_turns, material_of
from palpate.report.results import Audit, Impact, LeakPair, Results
from palpate.report.sentences import leak_line, purpose, summary_lines, there, where
from palpate.report.tables import Cell, Heat, Table, heat_tables, score_tables, settings_of
from palpate.report.text import HINTS, HOW_TO_READ, count, number, percent, plain, plural

#: Rows of pictures listed in the Markdown; the JSON holds all.
LISTED = 40
_SPECIAL = str.maketrans({c: f"\\{c}" for c in "\\`*_[]|<>"})


def esc(text: str) -> str:
    """Text on one line in which no character means anything to Markdown."""
    return " ".join(text.split()).translate(_SPECIAL)


def code(text: str) -> str:
    """Text in backticks that may itself hold backticks; a pipe is escaped for tables."""
    text = " ".join(text.split())
    fence = "`"
    while fence in text:
        fence += "`"
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}".replace("|", "\\|")


def pipe_table(head: Sequence[str], rows: Iterable[Sequence[str]], right: bool = True) -> list[str]:
    """A padded pipe table; the first column is flush left, the others flush right unless ``right`` is false."""
    body = [list(head), *(list(r) for r in rows)]
    widths = [max(3, *(len(r[k]) for r in body)) for k in range(len(head))]
    pad = lambda text, k: text.rjust(widths[k]) if right and k else text.ljust(widths[k])  # noqa: E731
    lines = ["| " + " | ".join(pad(t, k) for k, t in enumerate(r)) + " |" for r in body]
    rule = ["-" * (w - 1) + ":" if right and k else "-" * w for k, w in enumerate(widths)]
    return [lines[0], "| " + " | ".join(rule) + " |", *lines[1:], ""]


def _hint(section: str) -> list[str]:
    said, command = HINTS[section]
    return [f"{said} See {code(command)}.", ""]


def _picture(path: str | None) -> str:
    return code(path) if path else "–"


def _cell(cell: Cell) -> str:
    marks = "".join(f"({k})" for k in cell.footnotes)
    if cell.why:
        return f"undefined: {esc(cell.why)} {marks}".rstrip()
    parts = [f"**{cell.value}**", cell.interval]
    parts += [f"floor {cell.floor}"] if cell.floor else []
    parts += [f"gel {cell.gel}"] if cell.gel else []
    parts += [f"null {cell.null}"] if cell.null else []
    return " ".join(p for p in (*parts, cell.size, marks) if p)


def _scores(table: Table) -> list[str]:
    head = [
        "",
        *(f"{esc(c.metric)} {c.arrow}{', ' + c.size if c.size else ''}" for c in table.columns),
    ]
    rows = [
        [
            esc(s),
            *(
                "; ".join(_cell(c) for c in table.cells[s].get(col.metric, ())) or "–"
                for col in table.columns
            ),
        ]
        for s in table.subjects
    ]
    lines = [
        f"### {table.title}",
        "",
        *([table.question, ""] if table.question else []),
        *pipe_table(head, rows),
    ]
    made = [("All of these", table.shared), *((c.metric, c.made) for c in table.columns)]
    lines += [
        f"- {esc(title)}: " + "; ".join(f"{esc(k)} {esc(v)}" for k, v in rows)
        for title, rows in made
        if rows
    ]
    lines += [f"- ({k}) {esc(note)}" for k, note in enumerate(table.notes, 1)]
    return [*lines, ""]


def _heat(heat: Heat) -> list[str]:
    rows = [[esc(label), *values] for label, values in zip(heat.labels, heat.values, strict=True)]
    return [f"### Matrix: {esc(heat.title)}", "", *pipe_table(["", *map(esc, heat.labels)], rows)]


def _sample(sample: SampleRef) -> str:
    return f"{esc(where(sample))}: {_picture(sample.vision)}, {_picture(sample.tactile)}"


def _pair(pair: LeakPair, kind: str, other: str) -> str:
    """A pair on one line; as the JSON says, where no signal is named."""
    facts = pair_facts(pair, kind)
    if not kind:
        facts[0] = f"gap {count(pair.gap)} frames" if pair.gap is not None else "gap unknown"
    return (
        f"- {'; '.join(map(esc, facts))}; test {_sample(pair.test)}; {other} {_sample(pair.train)}"
    )


def _signals(audit: Audit) -> list[str]:
    """The signals as a table, what each means, and how the lines were set."""
    views = [signal_view(s, audit) for s in audit.signals]
    rows = [[esc(str(v)) for v in signal_row(view).values()] for view in views]
    lines = ["#### What was looked for", "", *pipe_table(list(signal_row(views[0])), rows)]
    for view in views:
        said = [s for s in (view.meaning, view.line, *view.notes) if s]
        lines += [f"- {esc(view.signal.kind)}: {esc(' '.join(said))}"] if said else []
    lines.append("")
    for view in views:
        if view.bins:
            head = [f"{esc(view.signal.kind)}: score", "unrelated samples", "test samples"]
            lines += pipe_table(head, view.bins)
    return lines


def _impact(impact: Impact) -> list[str]:
    """What the leak costs."""
    text = lambda value, interval: f"{number(100 * value, 1)} {interval_percent(interval)}".rstrip()  # noqa: E731
    rows = [
        [
            esc(f"{r.features}, {r.classifier}"),
            text(r.given, r.given_interval),
            text(r.clean, r.clean_interval),
            text(r.cost, r.cost_interval),
            text(r.chance, None),
        ]
        for r in impact.rows
    ]
    head = ["accuracy of material, %", "given split", "leak-free", "cost, points", "chance"]
    lines = ["#### What the leak costs", "", esc(impact.headline), "", *pipe_table(head, rows)]
    lines += [
        f"- 95 % intervals by leaving out whole groups ({esc(impact.group)})",
        *(f"- {esc(sentence(note))}" for note in impact.notes),
    ]
    lines += (
        [f"- leak-free splits: {', '.join(map(code, impact.clean_splits))}"]
        if impact.clean_splits
        else []
    )
    return [*lines, *_tree(plain(impact.settings)), ""]


def _matrix(audit: Audit) -> list[str]:
    """The group-by-part matrix."""
    view = matrix_view(audit)
    if view is None:
        return []
    heads = {"train": esc(audit.against)}
    head = [esc(audit.group), *(heads.get(p, p) for p in view.parts), "leaking"]
    rows = [[esc(r.group), *(text for text, _ in r.cells), count(r.leaking)] for r in view.rows]
    more = [f"And {plural(view.more, 'more group')}.", ""] if view.more else []
    return ["#### Groups by part", "", *pipe_table(head, rows), *more]


def _finding(audit: Audit) -> list[str]:
    """Heading, counts and notes."""
    group, other = esc(audit.group), esc(audit.against)
    rows = [["samples", count(audit.train_samples), count(audit.test_samples)]]
    rows += (
        [[f"groups ({group})", count(audit.groups_train), count(audit.groups_test)]]
        if audit.group != "none"
        else []
    )
    against = "" if audit.against == "train" else f"Test against {there(audit)}: "
    share = (
        audit.leaking_samples / audit.test_samples
        if audit.signals and audit.test_samples
        else audit.leaked_fraction
    )
    lines = [
        f"### {esc(against + audit.name)}: {esc(percent(share))} leaked",
        "",
        *pipe_table(["", other, "test"], rows),
    ]
    lines += [f"- {esc(leak_line(audit))}"] if audit.signals and audit.test_samples else []
    if audit.group != "none":
        lines += [
            f"- test samples in shared groups: {count(audit.test_samples_in_shared_groups)}",
            f"- shared groups: {count(audit.groups_shared)}",
        ]
    lines.append(f"- identical samples in both parts: {count(audit.identical_samples)}")
    if audit.split:
        lines.append(f"- split: {code(audit.split)}")
    if audit.gap_median is not None:
        lines.append(
            f"- frames to the nearest {other} frame: least {count(audit.gap_min)}, median {number(audit.gap_median, 0)}, most {count(audit.gap_max)}"
        )
    return [*lines, *(f"- {esc(sentence(note))}" for note in audit.notes), ""]


def _audit(audit: Audit) -> list[str]:
    lines = _finding(audit)
    if audit.gap_counts:
        bins = zip(audit.gap_edges, audit.gap_edges[1:], audit.gap_counts, strict=False)
        lines += pipe_table(
            ["gap (frames)", "test samples"],
            [[f"{count(a)} to {count(b)}", count(n)] for a, b, n in bins],
        )
    lines += _signals(audit) if audit.signals else []
    lines += _impact(audit.impact) if audit.impact is not None and audit.impact.rows else []
    for found in pair_lists(audit):
        lines += [f"Worst pairs by {esc(found.title)}" if found.kind else "Nearest pairs:", ""]
        lines += [*(_pair(p, found.kind, esc(audit.against)) for p in found.pairs[:LISTED]), ""]
    lines += _matrix(audit)
    if audit.materials:
        keys = ("material", "train", "test", "groups_train", "groups_test")
        cells = [
            [esc(str(m.get("material") or "–")), *(count(m.get(k)) for k in keys[1:])]
            for m in audit.materials
        ]
        parts = (esc(audit.against), "test")
        lines += pipe_table(
            ["material", *parts, *(f"{esc(audit.group)}s in {part}" for part in parts)], cells
        )
    return [
        *lines,
        *(["What to do next:", "", *_commands(audit.commands)] if audit.commands else []),
    ]


def _commands(commands: Sequence[str]) -> list[str]:
    return ["```sh", *(c.replace("```", "` ` `") for c in commands), "```", ""]


def _tree(value: Any, depth: int = 0) -> list[str]:
    lines: list[str] = []
    for key, inner in value.items():
        indent = "  " * depth
        if isinstance(inner, Mapping) and inner:
            lines += [f"{indent}- {esc(str(key))}:", *_tree(inner, depth + 1)]
        else:
            text = inner if isinstance(inner, str) else json.dumps(inner, ensure_ascii=False)
            lines.append(f"{indent}- {esc(str(key))}: {code(text) if text else '(empty)'}")
    return lines


def render_markdown(results: Results) -> str:
    """The results as Markdown text.

    Raises:
        PalpateError: if scores may not stand in one table.
    """
    facts = list(results.facts) or summary_lines(results)
    lines = [
        f"# {esc(results.title)}",
        "",
        esc(purpose(results)),
        "",
        *(f"- {esc(f)}" for f in facts),
        "",
    ]
    if results.notes:
        lines += ["## Read this first", "", *(f"- {esc(sentence(n))}" for n in results.notes), ""]
    lines += ["## Gallery", ""]
    items = in_turns(results.gallery)[:LISTED]
    if items:
        rows = [
            [
                esc(material_of(i.sample)),
                esc(where(i.sample)),
                _picture(i.sample.vision),
                _picture(i.sample.tactile),
                _picture(i.generated),
            ]
            for i in sorted(items, key=lambda i: material_of(i.sample).casefold())
        ]
        lines += pipe_table(
            ["material", "sample", "photo", "real touch", "generated touch"], rows, right=False
        )
        lines += [f"{count(len(items))} of {count(len(results.gallery))} rows.", ""]
    else:
        lines += _hint("gallery")
    lines += ["## Scores", ""]
    if results.scores:
        lines += [" ".join(HOW_TO_READ), ""]
        for table in score_tables(results.scores):
            lines += _scores(table)
        for heat in heat_tables(results.scores):
            lines += _heat(heat)
    else:
        lines += _hint("scores")
    lines += ["## Leakage audit", ""]
    for audit in results.audits:
        lines += _audit(audit)
    lines += [] if results.audits else _hint("audits")
    lines += [
        "## Settings and digests",
        "",
        *(_tree(settings_of(results)) or _hint("settings")),
        "",
    ]
    lines += ["## Commands", ""]
    if results.commands:
        lines += _commands(results.commands)
    else:
        lines += _hint("commands")
    return "\n".join(lines).rstrip() + "\n"
