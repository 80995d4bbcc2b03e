"""Results as Markdown: facts, tables, settings and commands; paths in place of images.

Tables are GitHub's pipe tables, padded so that they also read well in a terminal.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from palpate.core import SampleRef, plain
from palpate.report.audits import (
    impact_cells,
    impact_head,
    matrix_parts,
    matrix_rows,
    pair_facts,
    pair_lists,
)
from palpate.report.notes import (
    HINTS,
    HOW_TO_READ,
    confidence,
    count,
    number,
    percent,
    plural,
    sentence,
    where,
)
from palpate.report.results import Audit, Impact, LeakPair, Results, Strip
from palpate.report.sentences import (
    cause_notes,
    cause_texts,
    chance_text,
    data_of,
    leak_line,
    meaning_of,
    purpose,
    share_of,
    summary_lines,
    threshold_line,
    threshold_text,
)
from palpate.report.tables import (
    Cell,
    Column,
    Heat,
    Table,
    heat_tables,
    score_tables,
    settings_of,
    table_facts,
)

#: Rows of images and pairs that are listed; the JSON has all.
LISTED = 40
_SPECIAL = str.maketrans({c: f"\\{c}" for c in "\\`*_[]|<>"})


def render_markdown(results: Results) -> str:
    """Return the results as Markdown text.

    Raises:
        PalpateError: if scores of different settings would share a column.
    """
    facts = list(results.facts) or summary_lines(results)
    lines = [f"# {esc(results.title)}", "", esc(purpose(results)), "", *_items(facts)]
    if results.notes:
        lines += ["## Read this first", "", *_items(map(sentence, results.notes))]
    scores = [HOW_TO_READ, ""]
    for table in score_tables(results.scores):
        scores += _scores(table)
    for heat in heat_tables(results.scores):
        scores += _heat(heat)
    scores += _strips(results.strips)
    sections = {
        "gallery": ("Gallery", _gallery(results)),
        "scores": ("Scores", scores if results.scores else []),
        "audits": ("Leakage audit", [line for a in results.audits for line in _audit(a)]),
        "settings": ("Settings and digests", [*_tree(settings_of(results)), ""]),
        "commands": ("Commands", _commands(results.commands)),
    }
    for name, (title, body) in sections.items():
        hint, command = HINTS[name]
        empty = [f"{hint} See {code(command)}.", ""]
        lines += [f"## {title}", "", *(body if any(body) else empty)]
    return "\n".join(lines).rstrip() + "\n"


def esc(text: str) -> str:
    """Return text on one line in which no character means anything to Markdown."""
    return " ".join(text.split()).translate(_SPECIAL)


def code(text: str) -> str:
    """Return text in backticks, which it may itself hold; a pipe is escaped for tables."""
    text = " ".join(text.split())
    fence = "`"
    while fence in text:
        fence += "`"
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}".replace("|", "\\|")


def pipe_table(head: Sequence[str], rows: Iterable[Sequence[str]], right: bool = True) -> list[str]:
    """Return a padded table; columns after the first are flush right unless ``right`` is false."""
    body = [list(head), *map(list, rows)]
    widths = [max(3, *map(len, column)) for column in zip(*body, strict=True)]
    flush = [right and k > 0 for k in range(len(head))]
    rule = ["-" * (w - 1) + ":" if r else "-" * w for w, r in zip(widths, flush, strict=True)]
    padded = [
        [c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, flush, strict=True)]
        for row in body
    ]
    return [f"| {' | '.join(row)} |" for row in (padded[0], rule, *padded[1:])] + [""]


def _items(lines: Iterable[str]) -> list[str]:
    return [*(f"- {esc(line)}" for line in lines), ""]


def _commands(commands: Sequence[str]) -> list[str]:
    fenced = [command.replace("```", "` ` `") for command in commands]
    return ["```sh", *fenced, "```", ""] if commands else []


def _gallery(results: Results) -> list[str]:
    from palpate.report.page import in_turns, material_of

    items = in_turns(results.gallery)[:LISTED]
    rows = [
        [
            esc(material_of(item.sample)),
            esc(where(item.sample)),
            _path(item.sample.vision),
            _path(item.sample.tactile),
            _path(item.generated),
        ]
        for item in sorted(items, key=lambda item: material_of(item.sample).casefold())
    ]
    if not rows:
        return []
    total = f"{count(len(items))} of {count(len(results.gallery))} rows."
    return [
        *pipe_table(["material", "sample", "photo", "real", "generated"], rows, False),
        total,
        "",
    ]


def _path(path: str | None) -> str:
    return code(path) if path else "–"


def _scores(table: Table) -> list[str]:
    lines = [f"### {table.title}", "", *([table.question, ""] if table.question else [])]
    if table.columns:
        heads = (f"{c.metric} {c.arrow}{', ' + c.size if c.size else ''}" for c in table.columns)
        rows = [
            [
                esc(subject),
                *(
                    "; ".join(_cell(x, c) for x in table.cells(subject, c)) or "–"
                    for c in table.columns
                ),
            ]
            for subject in table.subjects
        ]
        lines += pipe_table(["", *map(esc, heads)], rows)
    if table.differences:
        lines += ["Paired differences, a − b:", ""]
        head = ["metric", "a", "b", "a − b", "a better", "Holm p", "notes"]
        lines += pipe_table(
            head,
            [
                [
                    esc(f"{d.metric} {d.arrow}"),
                    esc(d.a),
                    esc(d.b),
                    f"{number(d.cell.score.value, d.digits)} {_pair(d.cell, d.digits)}".strip(),
                    esc("–" if d.confidence is None else confidence(d.confidence)),
                    "–" if d.p is None else f"{d.p:.3g}",
                    _marks(d.cell),
                ]
                for d in table.differences
            ],
        )
    for title, made in table_facts(table):
        facts = "; ".join(f"{esc(what)} {esc(how)}" for what, how in made.items())
        lines.append(f"- {esc(title)}: {facts}")
    lines += [f"- ({k}) {esc(sentence(note))}" for k, note in enumerate(table.notes, 1)]
    return [*lines, ""]


def _cell(cell: Cell, column: Column) -> str:
    value = number(cell.score.value, column.digits)
    known = {"floor": cell.score.floor, **cell.baselines}
    parts = [
        f"**{value}**" if cell.defined else "undefined",
        _pair(cell, column.digits),
        *(f"{k} {number(v, column.digits)}" for k, v in known.items() if v is not None),
        _range("null {} to {}", cell.score.null, column.digits),
        cell.size,
        _marks(cell),
    ]
    return " ".join(filter(None, parts))


def _pair(cell: Cell, digits: int) -> str:
    return _range("[{}, {}]", cell.score.interval, digits)


def _range(text: str, pair: tuple[float, float] | None, digits: int) -> str:
    return text.format(*(number(v, digits) for v in pair)) if pair else ""


def _marks(cell: Cell) -> str:
    return "".join(f"({k})" for k in cell.footnotes)


def _heat(heat: Heat) -> list[str]:
    rows = [[esc(label), *values] for label, values in zip(heat.labels, heat.values, strict=True)]
    table = pipe_table(["", *map(esc, heat.labels)], rows)
    return [f"### Matrix: {esc(heat.title)}", "", esc(heat.meaning), "", *table]


def _strips(strips: Sequence[Strip]) -> list[str]:
    rows = [
        [
            esc(f"{strip.keys} by {strip.queries}, {strip.subject}"),
            esc(strip.query_text or where(strip.query)),
            count(strip.rank),
            *(
                ("**right** " if match.right else "") + esc(match.text or where(match.sample))
                for match in strip.matches
            ),
        ]
        for strip in strips[:LISTED]
    ]
    if not rows:
        return []
    places = [str(k + 1) for k in range(max(len(strip.matches) for strip in strips[:LISTED]))]
    padded = [row + [""] * (3 + len(places) - len(row)) for row in rows]
    head = ["", "query", "rank of its own", *places]
    return ["### What was retrieved", "", *pipe_table(head, padded, right=False)]


def _audit(audit: Audit) -> list[str]:
    lines = _finding(audit)
    lines += _signals(audit) if audit.signals else []
    lines += _impact(audit.impact) if audit.impact is not None and audit.impact.rows else []
    for kind, title, pairs, _ in pair_lists(audit):
        lines += [f"Worst pairs, {esc(title)}", ""]
        lines += [*(_pair_line(p, kind, esc(audit.against)) for p in pairs[:LISTED]), ""]
    if audit.matrix:
        heads = [esc(audit.group), *matrix_parts(audit), "leaking"]
        heads = [esc(audit.against) if head == "train" else head for head in heads]
        rows = [
            [esc(r.group), *(text for text, _ in r.cells), count(r.leaking)]
            for r in matrix_rows(audit)
        ]
        lines += ["#### Groups by part", "", *pipe_table(heads, rows)]
        if (more := audit.groups_in_all - len(rows)) > 0:
            lines += [f"And {plural(more, 'more group')}.", ""]
    if audit.commands:
        lines += ["What to do next:", "", *_commands(audit.commands)]
    return lines


def _finding(audit: Audit) -> list[str]:
    """Heading, counts and notes."""
    against = "" if audit.against == "train" else f"Test against {data_of(audit)}: "
    rows = [["samples", count(audit.train_samples), count(audit.test_samples)]]
    facts: list[str] = []
    if audit.signals and audit.test_samples:
        facts.append(leak_line(audit))
    if audit.group != "none":
        groups = count(audit.groups_train), count(audit.groups_test)
        rows.append([f"groups ({esc(audit.group)})", *groups])
        facts.append(f"test samples in shared groups: {count(audit.test_samples_in_shared_groups)}")
        facts.append(f"shared groups: {count(audit.groups_shared)}")
    facts.append(f"identical samples in both parts: {count(audit.identical_samples)}")
    if audit.gap_median is not None:
        facts.append(
            f"frames to the nearest {audit.against} frame: least {count(audit.gap_min)}, median "
            f"{number(audit.gap_median, 0)}, most {count(audit.gap_max)}"
        )
    facts += [f"split: {audit.split}"] if audit.split else []
    return [
        f"### {esc(against + audit.name)}: {esc(share_of(audit))} leaked",
        "",
        *pipe_table(["", esc(audit.against), "test"], rows),
        *_items([*facts, *map(sentence, audit.notes)]),
    ]


def _signals(audit: Audit) -> list[str]:
    """The signals as a table, what each means, and how the thresholds were set."""
    head = ["signal", "checked", "flagged", "share", "threshold", "false positives", "causes"]
    rows: list[list[str]] = []
    lines: list[str] = []
    for s in audit.signals:
        rate = "–" if s.false_positives is None else percent(s.false_positives)
        share = percent(s.fraction) if s.checked else "–"
        causes = "; ".join(filter(None, [*cause_texts(s), chance_text(s)])) or "–"
        cells = [s.kind, count(s.checked), count(s.flagged), share, threshold_text(s), rate, causes]
        rows.append([esc(cell) for cell in cells])
        about = [meaning_of(s, audit)]
        about += [threshold_line(s)] if s.false_positives is not None else []
        about += [*cause_notes(s), *map(sentence, s.notes)]
        lines.append(f"{s.kind}: {' '.join(filter(None, about))}")
    return ["#### What was checked", "", *pipe_table(head, rows), *_items(lines)]


def _impact(impact: Impact) -> list[str]:
    """What leaking costs."""
    cells = [impact_cells(row) for row in impact.rows]
    head = ["accuracy of material, %", *(name.lower() for name in cells[0]), "chance"]
    rows = [
        [
            esc(", ".join(impact_head(r))),
            *(f"{value} {interval}".rstrip() for _, _, value, interval in row.values()),
            number(100 * r.chance, 1),
        ]
        for r, row in zip(impact.rows, cells, strict=True)
    ]
    notes = [f"95 % intervals, leaving out whole groups ({impact.group})"]
    notes += map(sentence, impact.notes)
    splits = ", ".join(map(code, impact.clean_splits))
    settings = [
        *([f"- leak-free splits: {splits}"] if splits else []),
        *_tree(plain(impact.settings)),
    ]
    title = ["#### What the leak costs", "", esc(impact.headline), ""]
    return [*title, *pipe_table(head, rows), *_items(notes)[:-1], *settings, ""]


def _pair_line(pair: LeakPair, kind: str, data: str) -> str:
    facts = "; ".join(map(esc, pair_facts(pair, kind)))
    return f"- {facts}; test {_sample(pair.test)}; {data} {_sample(pair.train)}"


def _sample(sample: SampleRef) -> str:
    return f"{esc(where(sample))}: {_path(sample.vision)}, {_path(sample.tactile)}"


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
