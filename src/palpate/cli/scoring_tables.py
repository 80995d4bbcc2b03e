"""The tables of ``palpate score`` in the terminal: one of scores, one of paired differences, and below them what a reader must know, each sentence once.

Where a table is wider than the terminal, the metrics become headings; where it still is, so do the names, and the columns that can be spared are left
out and named. Where even that is too wide, each number has a line of its own: none is ever cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from rich.cells import cell_len
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from palpate.cli.terminal import Terminal
from palpate.core import Score
from palpate.core.score import ARROWS
from palpate.report.notes import COMMAND_LINE, confidence, sentence
from palpate.report.remarks import INDEPENDENT, Footnotes, no_floor, reason, remarks
from palpate.report.results import Results
from palpate.report.sides import TAIL
from palpate.report.tables import gel_of

GEL = "gel: what the empty gel scores on the same touches, without any contact; squared errors (PSNR) prefer it to a wrong touch"


@dataclass(frozen=True)
class Grid:
    """A table before it is drawn.

    Attributes:
        heads: names of the columns of ``rows``.
        left: how many of them are names, flush left; the others are numbers.
        spare: columns that a narrow terminal does without.
        rows: (metric, preset, cells) of each row, as plain text.
    """

    heads: Sequence[str]
    left: int
    spare: frozenset[str]
    rows: Sequence[tuple[str, str, Sequence[str]]]


def show(results: Results, terminal: Terminal, said: Sequence[str] = ()) -> None:
    """Prints both tables, and what a reader must know but for what was ``said`` already."""
    scores = [s for s in results.scores if not s.metric.endswith(TAIL)]
    differences = [s for s in results.scores if s.metric.endswith(TAIL) and s.value is not None]
    known = {_column(s) for s in scores if s.value is not None}
    listed = [s for s in scores if _column(s) in known]
    notes, told = Footnotes(), {sentence(n, COMMAND_LINE) for n in results.notes}
    if known:
        _draw(_scores(listed, notes, told), terminal)
    if differences:
        terminal.out.print()
        terminal.out.print("Differences on the same samples, a - b", style="bold")
        frames = {_column(s) for s in listed if INDEPENDENT in remarks(s)}
        _draw(_differences(differences, notes, frames), terminal)
    if notes.texts:
        below = Table.grid(padding=(0, 2, 0, 0))
        below.add_column(justify="right")
        below.add_column(overflow="fold")
        for k, text in enumerate(notes.texts, 1):
            below.add_row(str(k), escape(text))
        terminal.out.print()
        terminal.out.print(below)
    if any(gel_of(s) is not None for s in listed):
        terminal.print(GEL)
    why: dict[str, list[str]] = {}
    for s in scores:
        if s.value is None:
            text = ". ".join([reason(s), *(t for t in remarks(s) if t not in notes.texts)])
            preset = _column(s)[1]
            name = f"{s.metric} ({preset})" if preset else s.metric
            why.setdefault(text, []).append(
                name if _column(s) not in known else f"{name} of {s.subject}"
            )
    for text, metrics in why.items():
        terminal.print(f"{', '.join(dict.fromkeys(metrics))}: {text}")
    for remark in (r for r in (sentence(n, COMMAND_LINE) for n in results.notes) if r not in said):
        terminal.print(remark)  # part of the result: -q leaves it


def _column(score: Score) -> tuple[str, str]:
    return score.metric, str(score.settings.get("preset", ""))


def _scores(scores: Sequence[Score], notes: Footnotes, told: set[str]) -> Grid:
    """The scores, one metric below the other: what is to be compared stands together."""
    order = list(dict.fromkeys(map(_column, scores)))
    rows: list[tuple[str, str, Sequence[str]]] = []
    for s in sorted(scores, key=lambda s: order.index(_column(s))):
        # A remark of the results says of whom, and is printed anyhow.
        known = [t for t in (*remarks(s), no_floor(s)) if t and f"{s.subject}: {t}" not in told]
        gel = gel_of(s)
        floor = (
            f"gel {_number(gel)}"
            if gel is not None
            else "-"
            if s.floor is None
            else _number(s.floor)
        )
        cells = [
            s.subject,
            _number(s.value),
            _interval(s.interval),
            _interval(s.null),
            _p(s.details.get("p_value")),
            floor,
            str(s.n),
            _marks(notes, known),
        ]
        rows.append((f"{s.metric} {ARROWS[s.higher_is_better]}", _column(s)[1], cells))
    return Grid(
        ("subject", "value", "95 % interval", "null", "p", "floor", "n", "note"),
        1,
        frozenset({"null", "n"}),
        rows,
    )


def _differences(scores: Sequence[Score], notes: Footnotes, frames: set[tuple[str, str]]) -> Grid:
    """The differences, one metric below the other; ``frames`` are the columns whose intervals take samples as independent."""
    order = list(dict.fromkeys(map(_column, scores)))
    rows: list[tuple[str, str, Sequence[str]]] = []
    for s in sorted(scores, key=lambda s: order.index(_column(s))):
        metric, d = s.metric.removesuffix(TAIL), s.details
        ahead = [sentence(n, COMMAND_LINE) for n in s.notes if n.code == "ahead"]
        known = [t for t in remarks(s) if t not in ahead]
        known += (
            [INDEPENDENT]
            if s.interval and (metric, _column(s)[1]) in frames and INDEPENDENT not in known
            else []
        )
        sure = d.get("p_better")
        cells = [
            d["a"],
            d["b"],
            _number(s.value),
            _interval(s.interval),
            "-" if sure is None else confidence(sure),
            _p(d.get("p_adjusted")),
            _marks(notes, known),
        ]
        rows.append((f"{metric} {ARROWS[s.higher_is_better]}", _column(s)[1], cells))
    heads = ("a", "b", "a - b", "95 % interval", "confidence that a is better", "Holm p", "note")
    return Grid(heads, 2, frozenset({"Holm p"}), rows)


def _draw(grid: Grid, terminal: Terminal) -> None:
    """Prints a grid as one table; in sections by metric where the terminal is too narrow for that."""
    noted = any(cells[-1] for _, _, cells in grid.rows)
    keep = [k for k, head in enumerate(grid.heads) if head != "note" or noted]
    wide = Table("metric", "preset", box=None, pad_edge=False)
    for k in keep:
        number = k >= grid.left and grid.heads[k] != "note"
        wide.add_column(
            grid.heads[k], justify="right" if number else "left", no_wrap=k >= grid.left
        )
    for metric, preset, cells in grid.rows:
        wide.add_row(escape(metric), preset, *(escape(cells[k]) for k in keep))
    room = terminal.out.width
    if (
        terminal.out.measure(wide, options=terminal.out.options.update(width=10_000)).maximum
        <= room
    ):
        terminal.out.print(wide)
        return
    above = [k for k in keep if k >= grid.left]  # the names stand above the numbers
    needed = [k for k in keep if grid.heads[k] not in grid.spare]
    # Two names go before any number, one after those that can be spared.
    layouts = (keep, above if grid.left > 1 else needed, [k for k in above if k in needed])
    shown = next((some for some in layouts if _fits(grid, some, room)), above)
    _sections(grid, shown, terminal)
    if spared := [grid.heads[k] for k in above if k not in shown]:
        are = "They are" if len(spared) > 1 else "It is"
        terminal.print(
            f"Left out in this width: {' and '.join(spared)}. {are} in the results of -o, and in a wider window."
        )


def _widths(grid: Grid, keep: Sequence[int]) -> list[int]:
    """The widest cell of each of the columns ``keep``."""
    return [
        max(cell_len(_short(grid.heads[k])), *(cell_len(cells[k]) for _, _, cells in grid.rows))
        for k in keep
    ]


def _short(head: str) -> str:
    return head.replace("confidence that a is better", "a better")


def _fits(grid: Grid, keep: Sequence[int], room: int) -> bool:
    return sum(_widths(grid, keep)) + 2 * (len(keep) - 1) <= room


def _sections(grid: Grid, keep: Sequence[int], terminal: Terminal) -> None:
    """The columns ``keep`` of a grid, each metric below a line of its own, and so the names that are not among them; as lists where that is too wide."""
    fits, widths, heads = (
        _fits(grid, keep, terminal.out.width),
        _widths(grid, keep),
        [_short(head) for head in grid.heads],
    )

    def line(cells: Sequence[str], style: str = "") -> None:
        # Not a row of a rich table: that cuts the numbers of a column that it makes narrower.
        padded: list[str] = []
        for k, width in zip(keep, widths, strict=True):
            space = " " * (width - cell_len(cells[k]))
            padded.append(
                cells[k] + space if k < grid.left or grid.heads[k] == "note" else space + cells[k]
            )
        terminal.out.print(Text("  ".join(padded).rstrip(), style), soft_wrap=True)

    if fits:
        line(heads, "bold")
    for (metric, preset), rows in groupby(grid.rows, key=lambda row: row[:2]):
        terminal.out.print(Text(", ".join(filter(None, [metric, preset])), "bold"))
        for *_, cells in rows:
            if keep[0] >= grid.left:
                terminal.out.print(Text(" - ".join(cells[: grid.left])))
            if fits:
                line(cells)
            else:
                _list([(heads[k], cells[k]) for k in keep if cells[k]], terminal)


def _list(cells: Sequence[tuple[str, str]], terminal: Terminal) -> None:
    """Numbers beside their heads, or below them where that is too wide."""
    for head, cell in cells:
        beside = f"  {head}: {cell}"
        for text in (
            [beside] if cell_len(beside) <= terminal.out.width else [f"  {head}:", f"  {cell}"]
        ):
            terminal.out.print(Text(text))


def _marks(notes: Footnotes, said: Sequence[str]) -> str:
    return " ".join(map(str, notes.numbers(said)))


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.4g}"


def _interval(pair: tuple[float, float] | None) -> str:
    return "-" if pair is None else f"[{pair[0]:.4g}, {pair[1]:.4g}]"


def _p(p: float | None) -> str:
    return "-" if p is None else "< 1e-15" if p < 1e-15 else f"{p:.3g}"
