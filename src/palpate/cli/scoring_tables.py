"""The tables of ``palpate score`` in the terminal: one of scores, one of paired differences."""

from __future__ import annotations

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from palpate.cli.terminal import Terminal
from palpate.core import Results, Score
from palpate.core.score import ARROWS
from palpate.protocol.comparing import percent

TAIL = " difference"


def show(results: Results, terminal: Terminal, said: Sequence[str] = ()) -> None:
    """Prints both tables, and what a reader must know but for what was ``said`` already."""
    scores = [s for s in results.scores if not s.metric.endswith(TAIL)]
    differences = [s for s in results.scores if s.metric.endswith(TAIL) and s.value is not None]
    known = {_column(s) for s in scores if s.value is not None}
    if known:
        terminal.out.print(_scores([s for s in scores if _column(s) in known]))
    if differences:
        terminal.out.print()
        terminal.out.print("Differences on the same samples, a - b", style="bold")
        terminal.out.print(_differences(differences))
    why: dict[str, list[str]] = {}
    for s in scores:
        if s.value is None:
            why.setdefault(s.note, []).append(s.metric if _column(s) not in known else f"{s.metric} of {s.subject}")
    for note, metrics in why.items():
        terminal.print(f"{', '.join(dict.fromkeys(metrics))}: {note}")
    for remark in (r for r in results.notes if r not in said):
        terminal.print(remark)  # part of the result: -q leaves it


def _column(score: Score) -> tuple[str, str]:
    return score.metric, str(score.settings.get("preset", ""))


def _scores(scores: Sequence[Score]) -> Table:
    table = Table("metric", "preset", "subject", box=None, pad_edge=False)
    for name in ("value", "95 % interval", "null", "p", "floor", "n"):
        table.add_column(name, justify="right", no_wrap=True)
    # One metric below the other: what is to be compared stands together.
    order = list(dict.fromkeys(map(_column, scores)))
    for s in sorted(scores, key=lambda s: order.index(_column(s))):
        p = s.details.get("p_value")
        table.add_row(
            f"{escape(s.metric)} {ARROWS[s.higher_is_better]}", s.settings.get("preset", ""), escape(s.subject), _number(s.value),
            _interval(s.interval), _interval(s.null), _p(p), "-" if s.floor is None else _number(s.floor), str(s.n),
        )  # fmt: skip
    return table


def _differences(scores: Sequence[Score]) -> Table:
    table = Table("metric", "preset", "a", "b", box=None, pad_edge=False)
    for name in ("a - b", "95 % interval", "confidence that a is better", "Holm p"):
        table.add_column(name, justify="right", no_wrap=True)
    for s in scores:
        d = s.details
        sure, p = d.get("p_better"), d.get("p_adjusted")
        table.add_row(
            f"{escape(s.metric.removesuffix(TAIL))} {ARROWS[s.higher_is_better]}", s.settings.get("preset", ""), escape(d["a"]),
            escape(d["b"]), _number(s.value), _interval(s.interval), "-" if sure is None else percent(sure), _p(p),
        )  # fmt: skip
    return table


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.4g}"


def _interval(pair: tuple[float, float] | None) -> str:
    return "-" if pair is None else f"\\[{pair[0]:.4g}, {pair[1]:.4g}]"


def _p(p: float | None) -> str:
    return "-" if p is None else "< 1e-15" if p < 1e-15 else f"{p:.3g}"
