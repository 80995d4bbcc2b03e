r"""LaTeX tables (``booktabs``): of a study, of its claims, and of scores, one a family of metrics
and one of its differences.

The interval is below the value, the p-value of a permutation test below that. Bold is better than
every other generator by a paired difference whose interval excludes 0. Notes have letters below the
table. Text is escaped: no name can be a command. Letters that pdfLaTeX lacks need LuaLaTeX.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence

from palpate.core import Note, short
from palpate.report.notes import sentence
from palpate.report.results import Results
from palpate.report.study import Claim
from palpate.report.study_tables import BEST_OF_COLUMN, Entry, Sheet, sheets, tally
from palpate.report.tables import BASELINES, BEST, Cell, Column, Table, defined, score_tables
from palpate.report.terminal import NAMES, difference_rows

#: First line of the file: how the command recognizes its own file.
MARK = "% palpate: tables of scores"
ARROWS = {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "→": r"$\rightarrow$"}
_SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\char34{}",
    "`": r"\`{}",
    "σ": r"$\sigma$",
    "×": r"$\times$",
    **ARROWS,
    "−": "$-$",
    "–": "--",
    "\u00a0": "~",
    "[": "{[}",
    "]": "{]}",
}


def escape(text: str) -> str:
    """Return plain text as LaTeX that prints it; control characters become spaces.

    ``--seed`` stays two hyphens, and accents are joined with their letters.
    """
    plain = re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]", " ", unicodedata.normalize("NFC", text))
    return re.sub("-(?=-)", "-{}", "".join(_SPECIAL.get(c, c) for c in plain))


def latex_tables(results: Results) -> str:
    """Return every table of a study, its claims, and the tables of the scores of ``results``.

    Raises:
        PalpateError: if two scores that share a column were not made with the same settings.
    """
    lines = [line for table in sheets(results) for line in _sheet(table)]
    lines += _claims(results.claims)
    for table in score_tables(results.scores):
        caption = [table.title, *_facts(table)]
        caption += [f"Command: {results.commands[0]}"] if results.commands else []
        lines += _scores(table, caption) if table.columns else []
        lines += _differences(table, caption) if table.differences else []
    commands = (re.sub(r"[\x00-\x1f\x7f\u2028\u2029]", " ", c) for c in results.commands)
    head = [MARK, *(f"% {c}" for c in commands), r"% Needs \usepackage{booktabs}."]
    return "\n".join([*head, "", *lines]).rstrip() + "\n"


def _sheet(table: Sheet) -> list[str]:
    """A table of a study: controls in italics between rules, the interval below the value."""
    if not table.rows:
        return []
    heads = (f"{escape(h.label)} {ARROWS[h.arrow] if h.arrow else ''}".strip() for h in table.heads)
    rows = [_row(list(heads)), r"\midrule"]
    for row in table.rows:
        rows += [r"\midrule"] * row.rule
        rows.append(_row([_entry(cell, row.control) for cell in row.cells]))
        below = [_small_interval(cell) for cell in row.cells]
        rows += [_row(below)] if any(below) else []
    caption = [table.title, *([table.text] if table.text else [])]
    caption += [f"Bold: {BEST_OF_COLUMN}"] * table.has_best
    caption += ["Italics: controls"] * any(row.control for row in table.rows)
    notes = _footnotes(range(1, len(table.notes) + 1), table.notes)
    return _float(caption, "".join("r" if h.scores else "l" for h in table.heads), rows, notes)


def _entry(cell: Entry, control: bool) -> str:
    if cell.score is None:
        words = escape(cell.value) if isinstance(cell.value, str) else "--"
        return rf"\textit{{{words}}}" if control and cell.value else words
    marks = _raised(cell.footnotes) if cell.footnotes else ""
    if not defined(cell.score):
        return "--" + marks
    text = f"{cell.score.value:z.{cell.digits}f}"
    return (rf"$\mathbf{{{text}}}$" if cell.best else f"${text}$") + marks


def _small_interval(cell: Entry) -> str:
    known = cell.score is not None and defined(cell.score)
    text = _pair(cell.score.interval, cell.digits) if cell.score and known else ""
    return rf"{{\scriptsize {text}}}" if text else ""


def _claims(claims: Sequence[Claim]) -> list[str]:
    if not claims:
        return []
    narrow: Callable[[str], str] = lambda text: rf"{{\raggedright {escape(text)}\par}}"
    rows = [_row(["Claim", "Verdict", "Why"]), r"\midrule"]
    rows += [
        _row([narrow(f"{c.claim} ({c.source})"), escape(c.verdict), narrow(c.why)]) for c in claims
    ]
    columns = r"p{0.38\linewidth}lp{0.4\linewidth}"
    return _float([f"Claims: {tally(claims)}"], columns, rows, [])


def _scores(table: Table, caption: Sequence[str]) -> list[str]:
    heads = (f"{escape(c.label)} {ARROWS[c.arrow]}" for c in table.columns)
    rows = [_row(["", *heads]), r"\midrule"]
    for subject in table.subjects:
        # Where seeds differ the first is shown.
        cells = [(c, next(iter(table.cells(subject, c)), None)) for c in table.columns]
        rows.append(_row([escape(subject), *(_value(c, cell) for c, cell in cells)]))
        for line in (_interval, _p_value):
            texts = [line(c, cell) if cell else "" for c, cell in cells]
            rows += [_row(["", *texts])] if any(texts) else []
    last = [
        *_baseline("floor (real images)", table, lambda cell: cell.score.floor),
        *(
            row
            for name in BASELINES
            for row in _baseline(
                {"no contact": "no-contact image"}.get(name, name),
                table,
                lambda cell, name=name: cell.baselines.get(name),
            )
        ),
    ]
    rows += [r"\midrule", *last] if last else []
    if table.differences:
        caption = [*caption, f"Bold: {BEST}"]
    below = _below(table, (cell for column in table.columns for cell in column.cells))
    return _float(caption, "l" + "r" * len(table.columns), rows, below)


def _differences(table: Table, caption: Sequence[str]) -> list[str]:
    rows = difference_rows(table)
    names = [name for name in rows[0] if name != "notes" and any(row[name] for row in rows)]
    lines = [_row(["$a - b$" if name == "a - b" else escape(name) for name in names]), r"\midrule"]
    for row, d in zip(rows, table.differences, strict=True):
        cells = [escape(row[n]) if n in NAMES or "%" in row[n] else _math(row[n]) for n in names]
        lines.append(_row([*cells[:-1], cells[-1] + _marks(d.cell)]))
    columns = "".join("l" if name in NAMES else "r" for name in names)
    cells = (d.cell for d in table.differences)
    caption = [f"Paired differences: {caption[0]}", *caption[1:]]
    return _float(caption, columns, lines, _below(table, cells))


def _float(
    caption: Sequence[str], columns: str, rows: Sequence[str], below: Sequence[str]
) -> list[str]:
    sentences = ". ".join(escape(s).rstrip(".") for s in caption)
    head = [r"\begin{table}", r"\centering", rf"\caption{{{sentences}.}}"]
    head += [rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
    return [*head, *rows, r"\bottomrule", r"\end{tabular}", *below, r"\end{table}", ""]


def _facts(table: Table) -> list[str]:
    """How the numbers were made, in a sentence: what all columns share, then what is of one."""
    single = [(f"{c.metric} {what}", how) for c in table.columns for what, how in c.made]
    sizes = [(c.metric, c.size) for c in table.columns if c.size]
    facts = [*sizes, *table.made, *single]
    return ["; ".join(f"{what} {_short(how)}" for what, how in facts)] if facts else []


def _short(text: str) -> str:
    """Cut a digest to its short name."""
    return short(text) if re.fullmatch(r"[0-9a-f]{32,128}", text) else text


def _below(table: Table, cells: Iterable[Cell]) -> list[str]:
    """The footnotes of some cells."""
    return _footnotes({k for cell in cells for k in cell.footnotes}, table.notes)


def _footnotes(numbers: Iterable[int], notes: Sequence[Note]) -> list[str]:
    texts = (f"{_raised([k])}~{escape(sentence(notes[k - 1]))}" for k in sorted(numbers))
    text = ". ".join(note.rstrip(".") for note in texts)
    return [rf"\par\smallskip\parbox{{\linewidth}}{{\footnotesize {text}.}}"] if text else []


def _baseline(title: str, table: Table, value_of: Callable[[Cell], float | None]) -> list[str]:
    """A row with the first known value of each column; none where no column has one."""
    values = [
        next((v for cell in c.cells if (v := value_of(cell)) is not None), None)
        for c in table.columns
    ]
    texts = [
        "--" if v is None else f"${v:z.{c.digits}f}$"
        for v, c in zip(values, table.columns, strict=True)
    ]
    return [_row([title, *texts])] if any(v is not None for v in values) else []


def _row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _value(column: Column, cell: Cell | None) -> str:
    if cell is None or not cell.defined:
        return "--" + (_marks(cell) if cell else "")
    text = f"{cell.score.value:z.{column.digits}f}"
    return (rf"$\mathbf{{{text}}}$" if cell.best else f"${text}$") + _marks(cell)


def _interval(column: Column, cell: Cell) -> str:
    text = _pair(cell.score.interval, column.digits)
    return rf"{{\scriptsize {text}}}" if text else ""


def _p_value(column: Column, cell: Cell) -> str:
    return "" if cell.p_value is None else rf"{{\scriptsize $p {_p(cell.p_value)}$}}"


def _pair(pair: tuple[float, float] | None, digits: int) -> str:
    return "" if pair is None else f"$[{pair[0]:z.{digits}f}, {pair[1]:z.{digits}f}]$"


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"= {p:.3g}"


def _math(text: str) -> str:
    return f"${text}$" if text else "--"


def _marks(cell: Cell) -> str:
    return _raised(cell.footnotes) if cell.footnotes else ""


def _raised(numbers: Sequence[int]) -> str:
    """Letters, since a raised number is an exponent; after z follow aa, bb."""
    letters = (chr(97 + (k - 1) % 26) * (1 + (k - 1) // 26) for k in numbers)
    return rf"\textsuperscript{{{','.join(letters)}}}"
