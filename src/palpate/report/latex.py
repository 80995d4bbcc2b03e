r"""Scores as LaTeX tables for a paper: ``booktabs``, one table a family of metrics, and one of paired differences.

Rows are subjects, columns are metrics with the arrow of the better direction; the interval stands below the value, and the p-value of a permutation test
below that. A value is bold only where its generator is better than every other one by a paired difference whose interval leaves out 0: a best of
overlapping values is nobody's. The caption says how the numbers were made; what a reader must know of single values (classes left out, intervals over
frames) has a letter below the table. Differences of many rows are a ``longtable``, since a float cannot break over pages. Text is escaped: no name
can be a command. Needs ``\usepackage{booktabs}`` and, where they are used, ``longtable`` and fonts for foreign letters: comments at the head say so.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping, Sequence

from palpate.core import Score, short
from palpate.report.remarks import NEARER, Footnotes, by_gap, few, reason, remarks
from palpate.report.results import Results
from palpate.report.sides import TAIL, sides
from palpate.report.tables import gel_of, parts, score_tables
from palpate.report.text import decimals, defined, setting_of

#: First line of the file: how the command knows a file of its own.
MARK = "% palpate: tables of scores"
#: From so many differences on a table may break over pages.
LONG = 40
#: By whether higher is better; None: closer to the floor is.
ARROWS = {True: r"$\uparrow$", False: r"$\downarrow$", None: r"$\rightarrow$"}
#: What the name of E has more than that of its metric.
_EXCESS = re.compile(r"(?<=-TMMD) E\b")
#: Each compiles with the fonts that LaTeX starts with (OT1), in T1 and in LuaLaTeX; ``\textquotedbl`` would not.
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
    "±": r"$\pm$",
    "·": r"$\cdot$",
    "²": "$^2$",
    "→": r"$\rightarrow$",
    "−": "$-$",
    "–": "--",
    "\u00a0": "~",
    "[": "{[}",
    "]": "{]}",
}
#: Letters and signs that pdfLaTeX has in T1 fonts only, and all that it does not have.
_T1 = re.compile("[«»ÐÞðþĄąĐđĘęĮįŊŋŲų‚„‹›]")
_FOREIGN = re.compile("[^\x00-\x7f\xa1-ſȘșȚț‐-‖‘-‚“-„†‡•…‰‹›€™]|[ĦħĸĿŀŉŦŧſ]")


def escape(text: str) -> str:
    """Plain text as LaTeX that prints it; control characters and line ends become spaces.

    The breaks of ligatures keep ``--seed`` of a command two hyphens. Accents are made one with their letters, since pdfLaTeX has no others.
    """
    plain = re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]", " ", unicodedata.normalize("NFC", text))
    return re.sub("-(?=-)", "-{}", "".join(_SPECIAL.get(c, c) for c in plain))


def number(value: float | None, digits: int) -> str:
    """A number in mathematics mode, with a true minus sign; dashes where there is none."""
    if value is None:
        return "--"
    text = f"{value:.{digits}f}"
    return f"${text if float(text) else text.lstrip('-')}$"


def latex_tables(results: Results) -> str:
    """Every table of the scores of ``results``.

    Raises:
        PalpateError: if two scores that would share a column were not made alike.
    """
    differences = [
        (s, side)
        for s, side in zip(results.scores, sides(results.scores).of, strict=True)
        if s.metric.endswith(TAIL)
    ]
    lines: list[str] = []
    for table in score_tables(results.scores):
        if table.columns[0].metric.endswith(TAIL):
            continue
        beside = [d for d, side in differences if side in table.sides]
        members = [
            cell.score for row in table.cells.values() for cells in row.values() for cell in cells
        ]
        for tag in dict.fromkeys(_tag(c.metric) for c in table.columns):
            metrics = [c.metric for c in table.columns if _tag(c.metric) == tag]
            lines += _scores(
                table.title,
                tag,
                metrics,
                [s for s in members if s.metric in metrics],
                beside,
                results,
            )
    for part in parts(results.scores):
        lines += _differences(part.title, part.scores, results) if part.differences else []
    needs = (
        r"{booktabs,longtable}; longtable needs text of one column"
        if r"\begin{longtable}" in "\n".join(lines)
        else "{booktabs}"
    )
    head = [
        MARK,
        *(f"% {_comment(c)}" for c in results.commands),
        rf"% Needs \usepackage{needs}.",
        *_fonts("".join(lines)),
        "",
    ]
    return "\n".join([*head, *lines]).rstrip() + "\n"


def _fonts(text: str) -> list[str]:
    """What the letters of a text need besides, as a comment."""
    if found := sorted(set(_FOREIGN.findall(text))):
        return [
            f"% pdfLaTeX does not have {few(found)}: needs LuaLaTeX or XeLaTeX, and a font that has them."
        ]
    found = sorted(set(_T1.findall(text)))
    return (
        [rf"% Needs \usepackage[T1]{{fontenc}} for {few(found)}, or LuaLaTeX or XeLaTeX."]
        if found
        else []
    )


def _comment(text: str) -> str:
    """One line, whatever it holds."""
    return re.sub(r"[\x00-\x1f\x7f\u2028\u2029]", " ", text)


def _scores(
    title: str,
    tag: str,
    metrics: Sequence[str],
    members: Sequence[Score],
    differences: Sequence[Score],
    results: Results,
) -> list[str]:
    """One table: the metrics of a family whose names end in the same ``tag``, which goes to the caption."""
    subjects = list(dict.fromkeys(s.subject for s in members))
    found: dict[tuple[str, str], Score] = {}
    for s in members:  # where seeds differ the first stands
        found.setdefault((s.subject, s.metric), s)
    digits = {
        m: decimals(
            [
                v
                for s in members
                if s.metric == m
                for v in (s.value, s.floor, *(s.interval or ()))
                if v is not None
            ]
        )
        for m in metrics
    }
    floors = {
        m: next((s.floor for s in members if s.metric == m and s.floor is not None), None)
        for m in metrics
    }
    better = {m: next(s.higher_is_better for s in members if s.metric == m) for m in metrics}
    best = {m: best_of([found[key] for key in found if key[1] == m], differences) for m in metrics}
    title += f", {tag[2:-1]}" if tag else ""
    gels = {
        m: next((gel for s in members if s.metric == m and (gel := gel_of(s)) is not None), None)
        for m in metrics
    }
    said = {key: [*filter(None, [reason(s)]), *remarks(s)] for key, s in found.items()}
    common = [
        text for text in next(iter(said.values())) if all(text in own for own in said.values())
    ]
    notes = Footnotes()
    marks = {
        key: notes.numbers(text for text in own if text not in common) for key, own in said.items()
    }
    rows = [
        _row(["", *(f"{escape(m.removesuffix(tag))} {ARROWS[better[m]]}" for m in metrics)]),
        r"\midrule",
    ]
    for subject in subjects:
        cells = [found.get((subject, m)) for m in metrics]
        values = [
            _value(s, digits[m], marks.get((subject, m), []), bold=best[m] == subject)
            for m, s in zip(metrics, cells, strict=True)
        ]
        rows.append(_row([escape(subject), *values]))
        if any(s is not None and s.interval for s in cells):
            rows.append(
                _row(["", *(_interval(s, digits[m]) for m, s in zip(metrics, cells, strict=True))])
            )
        if any(s is not None and s.details.get("p_value") is not None for s in cells):
            rows.append(_row(["", *map(_tested, cells)]))
    last = [
        _row([title, *(number(values[m], digits[m]) for m in metrics)])
        for title, values in (("floor (real touches)", floors), ("empty gel", gels))
        if any(v is not None for v in values.values())
    ]
    rows += [r"\midrule", *last] if last else []
    below = [
        *(f"{_raised([k])}~{escape(text)}" for k, text in enumerate(notes.texts, 1)),
        *map(escape, common),
    ]
    return _environment(
        title,
        f"l{'r' * len(metrics)}",
        rows,
        members,
        results,
        differences=bool(differences),
        below=below,
    )


def _tag(metric: str) -> str:
    """What a name ends in, if that is in brackets: ``" (touch)"`` of ``"FID (touch)"``; '' otherwise."""
    return metric[metric.rindex(" (") :] if metric.endswith(")") and " (" in metric else ""


def _row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _value(score: Score | None, digits: int, marks: Sequence[int], *, bold: bool) -> str:
    raised = _raised(marks) if marks else ""
    if score is None or not defined(score):
        return f"--{raised}"
    text = number(score.value, digits)
    return (rf"$\mathbf{{{text[1:-1]}}}$" if bold else text) + raised


def _interval(score: Score | None, digits: int) -> str:
    if score is None or score.interval is None:
        return ""
    low, high = (number(v, digits)[1:-1] for v in score.interval)
    return rf"{{\scriptsize $[{low}, {high}]$}}"


def _raised(marks: Sequence[int]) -> str:
    """Letters, since a raised number is an exponent; after z follow aa, bb."""
    return rf"\textsuperscript{{{','.join(chr(97 + (k - 1) % 26) * (1 + (k - 1) // 26) for k in marks)}}}"


def _tested(score: Score | None) -> str:
    p = None if score is None else score.details.get("p_value")
    return "" if p is None else rf"{{\scriptsize $p {'' if p < 0.001 else '= '}{_p(p)[1:-1]}$}}"


def best_of(column: Sequence[Score], differences: Sequence[Score]) -> str | None:
    """The subject that is better than every other generator by a paired difference that is decided; None where there is none.

    Args:
        column: scores of one metric, made alike.
        differences: paired differences of any metrics; subjects without one (controls, real touches) take no part. E without differences of
            its own goes by those of its metric, where they say the same.
    """
    alike = [
        d
        for d in differences
        if column and (d.reference, *setting_of(d)) == (column[0].reference, *setting_of(column[0]))
    ]
    own = [d for d in alike if d.metric == column[0].metric + TAIL]
    if not own and alike and _EXCESS.search(column[0].metric):
        own = [d for d in alike if d.metric == _EXCESS.sub("", column[0].metric) + TAIL]
        own = own if all(_same_verdict(d, column) for d in own) else []
    wins: dict[str, bool] = {}
    for d in own:
        for name in (d.details["a"], d.details["b"]):
            wins[name] = (
                wins.get(name, True)
                and bool(d.details.get("decided"))
                and d.details["better"] == name
            )
    return next((name for name, won in wins.items() if won), None)


def _same_verdict(difference: Score, column: Sequence[Score]) -> bool:
    """Whether a difference of I- or CI-TMMD is that of E times a number, so that E is decided as it is.

    Halves of whole groups make them E times a number that the sizes of groups give (:mod:`palpate.metrics.halves`); so do their jackknifes. Over
    classes that holds where the classes have one design. Then one number must turn E's difference, and its gap of distances to the floor, into theirs.
    """
    found = {s.subject: s for s in column}
    a, b = (found.get(difference.details[k]) for k in ("a", "b"))
    gap = difference.details.get("gap")
    if (
        a is None
        or b is None
        or a.value is None
        or b.value is None
        or a.floor is None
        or gap is None
        or not difference.value
    ):
        return False
    delta, own = a.value - b.value, abs(a.value - a.floor) - abs(b.value - a.floor)
    factor = difference.value / delta if delta else 0.0
    return factor > 0 and math.isclose(gap, factor * own, rel_tol=1e-6)


def _differences(title: str, differences: Sequence[Score], results: Results) -> list[str]:
    head = [
        _row(["metric", "$a$", "$b$", "$a - b$", "interval", "$a$ better", "Holm $p$"]),
        r"\midrule",
    ]
    rows: list[str] = []
    mark = _raised([1])
    for d in differences:
        digits = decimals([v for v in (d.value, *(d.interval or ())) if v is not None])
        sure, p = d.details.get("p_better"), d.details.get("p_adjusted")
        low, high = (number(v, digits)[1:-1] for v in d.interval) if d.interval else ("", "")
        rows.append(
            _row(
                [
                    f"{escape(d.metric.removesuffix(TAIL))} {ARROWS[d.higher_is_better]}",
                    escape(d.details["a"]),
                    escape(d.details["b"]),
                    number(d.value, digits),
                    f"$[{low}, {high}]$" if d.interval else "--",
                    ("--" if sure is None else _percent(sure)) + (mark if by_gap(d) else ""),
                    "--" if p is None else _p(p),
                ]
            )
        )
    below = [f"{mark}~{escape(NEARER)}"] if any(map(by_gap, differences)) else []
    if len(rows) < LONG:
        return _environment(
            title, "lllrrrr", [*head, *rows], differences, results, differences=False, below=below
        )
    return [
        r"\begin{longtable}{lllrrrr}",
        rf"{_caption(title, differences, results, differences=False)} \\",
        r"\toprule",
        *head,
        r"\endfirsthead",
        r"\toprule",
        *head,
        r"\endhead",
        r"\bottomrule",
        r"\endfoot",
        *rows,
        r"\end{longtable}",
        *_below(below),
        "",
    ]


def _percent(share: float) -> str:
    return (
        r"$> 99.9\,\%$"
        if share > 0.999
        else r"$< 0.1\,\%$"
        if share < 0.001
        else rf"${100 * share:.1f}\,\%$"
    )


def _p(p: float) -> str:
    return "$< 0.001$" if p < 0.001 else f"${p:.3f}$"


def _environment(
    title: str,
    columns: str,
    rows: Sequence[str],
    members: Sequence[Score],
    results: Results,
    *,
    differences: bool,
    below: Sequence[str] = (),
) -> list[str]:
    caption = _caption(title, members, results, differences=differences)
    return [
        r"\begin{table}",
        r"\centering",
        caption,
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        *rows,
        r"\bottomrule",
        r"\end{tabular}",
        *_below(below),
        r"\end{table}",
        "",
    ]


def _caption(title: str, members: Sequence[Score], results: Results, *, differences: bool) -> str:
    said = [
        escape(title),
        *_made(members, differences),
        *(rf"Command: \texttt{{{escape(c)}}}" for c in results.commands[:1]),
    ]
    return rf"\caption{{{'. '.join(said)}.}}"


def _below(texts: Sequence[str]) -> list[str]:
    """The sentences below a table."""
    said = ". ".join(t.rstrip(".") for t in texts)
    return [rf"\par\smallskip\parbox{{\linewidth}}{{\footnotesize {said}.}}"] if texts else []


def _made(members: Sequence[Score], differences: bool) -> list[str]:
    """How the numbers were made, in a few sentences: sizes, estimator, bandwidth, intervals, digests, seed, version."""
    one_scale = len({s.scale for s in members}) == 1
    each: Mapping[str, list[str]] = {
        "$n$": [f"{s.n:,}" for s in members if s.n],
        "$m$": [f"{s.m:,}" for s in members if s.m is not None],
        "estimator": [escape(s.estimator) for s in members if s.estimator],
        r"$\sigma$": [f"{s.bandwidth:.4g}" for s in members if s.bandwidth is not None],
        "values times": [f"{s.scale:g}" for s in members if s.scale != 1 and one_scale],
        "scaled:": [
            f"{escape(s.metric)} times {s.scale:g}"
            for s in members
            if s.scale != 1 and not one_scale
        ],
        "intervals": [
            f"{100 * s.level:g}\\,\\% ({escape(s.interval_method)})" for s in members if s.interval
        ],
        "encoder": [rf"\texttt{{{short(s.encoder)}}}" for s in members if s.encoder],
        "reference": [rf"\texttt{{{short(s.reference)}}}" for s in members if s.reference],
        "split": [rf"\texttt{{{short(s.split)}}}" for s in members if s.split],
        "$p$ by relabelings:": [
            f"{d['count']:,}"
            for s in members
            if isinstance(d := s.details.get("permutations"), Mapping)
        ],
        "seed": [str(s.seed) for s in members if s.seed is not None],
        "palpate": [escape(str(s.details["version"])) for s in members if s.details.get("version")],
    }
    facts = [
        f"{name} {', '.join(dict.fromkeys(values))}" for name, values in each.items() if values
    ]
    rule = (
        [
            "Bold: better than every other generator (for metrics without reference: closer to the floor) by a paired difference whose interval leaves out 0"
        ]
        if differences
        else []
    )
    return [*(["; ".join(facts)] if facts else []), *rule]
