r"""LaTeX tables (``booktabs``): of a study, of its claims, and of scores, one a family of metrics
and one of its differences.

A caption says what is shown; how it was made and how to read it is in comments above the table.
Below a value are its interval, p-value and null band. Bold is the best of a column by value, a
dagger what paired differences decide. Notes have letters below the table. Text is escaped: no name
can be a command. Letters that pdfLaTeX lacks need LuaLaTeX.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate, zip_longest

from palpate.core import short
from palpate.report.labels import file_names, number
from palpate.report.notes import sentence
from palpate.report.records import Claim
from palpate.report.results import Results
from palpate.report.study import of_study, tally
from palpate.report.tables import Cell, Table, defined, families, grids

#: First line of the file: how the command recognizes its own file.
MARK = "% palpate: tables of scores"
#: Most words of a caption.
WORDS = 40
ARROWS = {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "→": r"$\rightarrow$"}
_SPECIAL = {
    **{character: f"\\{character}" for character in "{}$&#%_"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\char34{}",
    "`": r"\`{}",
    "σ": r"$\sigma$",
    "†": r"\textdagger{}",
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
    studied = [of_study(table) for table in results.tables]
    scored = [table for f in families(results.scores, results.controls) for table in grids(f)]
    tables = [*studied, *scored]
    names = file_names("tab", [table.title for table in tables])
    parts = list(map(_table, tables, names))
    parts.insert(len(studied), _claims(results.claims))
    needs = r"% Needs \usepackage{booktabs} and \usepackage{graphicx}."
    head = [MARK, *_comments(results.commands), needs]
    return "\n".join([*head, "", *(line for lines in parts for line in lines)]).rstrip() + "\n"


def _comments(texts: Iterable[str]) -> list[str]:
    controls = re.compile("[\x00-\x1f\x7f\u2028\u2029]")
    return [f"% {controls.sub(' ', text)}" for text in texts if text]


def _caption(table: Table) -> list[str]:
    """Title, marks and as many sentences of the text as :data:`WORDS` leave room for."""
    marks = {
        "Bold: best value": any(cell.best for cell in table.cells),
        "†: better than every other one by paired intervals": any(c.decided for c in table.cells),
        "Italics: controls": any(row.control for row in table.rows),
    }
    caption = [table.title, *(mark for mark, shown in marks.items() if shown)]
    left = WORDS - len(" ".join(caption).split())
    sentences = re.split(r"(?<=[.?]) ", table.text)
    lengths = accumulate(len(each.split()) for each in sentences)
    fitting = [each for each, n in zip(sentences, lengths, strict=True) if 0 < n <= left]
    return [table.title, *fitting, *caption[1:]]


def _table(table: Table, name: str) -> list[str]:
    """Controls in italics between rules, what is below a value in lines of their own; above it, in
    comments, how it was made and how to read it.
    """
    if not table.rows:
        return []
    heads = [f"{escape(h.label)} {ARROWS[h.arrow] if h.arrow else ''}".strip() for h in table.heads]
    rows = [_row(heads), r"\midrule"]
    for row in table.rows:
        rows += [r"\midrule"] * row.rule
        rows.append(_row([_cell(c, table.footnotes(c), row.control) for c in row.cells]))
        below = zip_longest(*(_lines_below(cell) for cell in row.cells), fillvalue="")
        rows += [_row(line) for line in below]
    about = (f"{name}: {_short(fact)}" for name, fact in table.facts.items())
    comments = _comments([table.text, *about, *table.marks("Bold:")])
    columns = "".join("r" if h.scores else "l" for h in table.heads)
    notes = (f"{_raised([k])}~{escape(sentence(note))}" for k, note in enumerate(table.notes, 1))
    footnotes = ". ".join(note.rstrip(".") for note in notes)
    below = rf"\par\smallskip\parbox{{\linewidth}}{{\footnotesize {footnotes}.}}"
    return comments + _float(_caption(table), columns, rows, [below] * bool(footnotes), name)


def _cell(cell: Cell, footnotes: Sequence[int], control: bool) -> str:
    if cell.score is None:
        words = escape(cell.value) if isinstance(cell.value, str) else "--"
        return rf"\textit{{{words}}}" if control and cell.value else words
    marks = _raised(footnotes) if footnotes else ""
    if not defined(cell.score):
        return "--" + marks
    text = _math(number(cell.score.value, cell.digits))
    dagger = r"$^\dagger$" * cell.decided
    return (rf"$\mathbf{{{text}}}$" if cell.best else f"${text}$") + dagger + marks


def _lines_below(cell: Cell) -> list[str]:
    if cell.score is None or not defined(cell.score):
        return []
    pair = ", ".join(_math(number(v, cell.digits)) for v in cell.score.interval or ())
    lines = [*([f"$[{pair}]$"] if pair else []), *map(escape, cell.below)]
    return [rf"{{\scriptsize {line}}}" for line in lines]


def _claims(claims: Sequence[Claim]) -> list[str]:
    if not claims:
        return []
    narrow: Callable[[str], str] = lambda text: rf"{{\raggedright {escape(text)}\par}}"
    rows = [_row(["Claim", "Verdict", "Why"]), r"\midrule"]
    rows += [
        _row([narrow(f"{c.claim} ({c.source})"), escape(c.verdict), narrow(c.why)]) for c in claims
    ]
    columns = r"p{0.38\linewidth}lp{0.4\linewidth}"
    return _float([f"Claims: {tally(claims)}"], columns, rows, [], "tab-claims")


def _float(
    caption: Sequence[str], columns: str, rows: Sequence[str], below: Sequence[str], name: str
) -> list[str]:
    """A table no wider than the text, with a label to refer to."""
    sentences = " ".join(s if s[-1:] in "?." else f"{s}." for s in map(escape, caption))
    head = [r"\begin{table}", r"\centering", rf"\caption{{{sentences}}}"]
    head += [rf"\label{{tab:{name.removeprefix('tab-')}}}"]
    fit = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
    head += [fit, rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
    return [*head, *rows, r"\bottomrule", r"\end{tabular}}", *below, r"\end{table}", ""]


def _short(text: str) -> str:
    """Cut a digest to its short name."""
    return short(text) if re.fullmatch(r"[0-9a-f]{32,128}", text) else text


def _math(text: str) -> str:
    return text.replace("−", "-").replace(",", "{,}")


def _row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _raised(numbers: Sequence[int]) -> str:
    """Letters, since a raised number is an exponent; after z follow aa, bb."""
    letters = (chr(97 + (k - 1) % 26) * (1 + (k - 1) // 26) for k in numbers)
    return rf"\textsuperscript{{{','.join(letters)}}}"
