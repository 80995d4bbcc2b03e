"""The first screen of a page, from data: on what, three cards, samples; and the verdict table."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from markupsafe import Markup

from palpate.core import Score
from palpate.report import plots
from palpate.report.notes import number, percent, plural
from palpate.report.results import Audit, Results
from palpate.report.sentences import share_of
from palpate.report.tables import Cell, Column, Table, defined

#: Columns of the verdict table, the most telling first; others follow as they come.
TELLING = ("TMMD", "material accuracy", "D-TMMD", "CI-TMMD", "SSIM")
COLUMNS, CARDS, CARD_ROWS = 5, 3, 4
#: Subjects that are the data themselves: never the best of a column.
REAL = "real"
#: Width of the strip in a card, and of the one that explains strips, in pixels.
STRIP, READING = 296.0, 330.0
#: What a metric asks, for the title of its card.
QUESTIONS = {
    "TMMD": "Distance to real images, TMMD",
    "material accuracy": "Material read from the image",
}
#: Axis of shares.
UNIT = plots.Axis(-0.02, 1.02, (), 1, width=112)


@dataclass(frozen=True)
class CardRow:
    """One line of a card: what, a drawing (may be empty), the number as text."""

    label: str
    drawing: Markup
    text: str


@dataclass(frozen=True)
class Card:
    """One question, its numbers, and what to hold them against; ``strip`` is of the first."""

    title: str
    rows: Sequence[CardRow]
    foot: str
    strip: Markup | None = None


class VerdictCell(NamedTuple):
    """A number as text, whether it is the best of its column, and its interval as text."""

    text: str
    best: bool = False
    interval: str = ""


@dataclass(frozen=True)
class VerdictRow:
    """One method or control: a cell for each column."""

    subject: str
    cells: Sequence[VerdictCell]
    control: bool = False


def about(results: Results, date: str, version: str) -> list[str]:
    """Return on what the page is: data set, sizes, date, version."""
    facts = [str(results.settings["dataset"])] if results.settings.get("dataset") else []
    if audits := [a for a in results.audits if a.against == "train"]:
        last = audits[-1]
        videos = f" of {plural(last.groups_test, last.group)}" if last.group != "none" else ""
        facts.append(f"{plural(last.test_samples, 'test sample')}{videos}")
        facts.append(f"{plural(last.train_samples, 'train sample')}")
    elif results.scores:
        facts.append(plural(max(score.n for score in results.scores), "sample"))
    return [*facts, date, f"palpate {version}"]


def telling_columns(tables: Sequence[Table]) -> list[Column]:
    """Return at most five columns of different metrics; of several presets the first."""
    first: dict[str, Column] = {}
    for column in (c for table in tables for c in table.columns):
        if any(cell.defined for cell in column.cells):
            first.setdefault(column.metric, column)
    known = [first.pop(metric) for metric in TELLING if metric in first]
    return [*known, *first.values()][:COLUMNS]


def verdict(columns: Sequence[Column], controls: Collection[str] = ()) -> list[VerdictRow]:
    """Return methods and controls by ``columns``; last what real images score: the floor.

    ``controls`` are the subjects that a study names so: they come after the methods and are never
    the best.
    """
    subjects = list(dict.fromkeys(cell.score.subject for c in columns for cell in c.cells))
    subjects.sort(key=lambda subject: (subject == REAL, subject in controls))
    best = [_best(column, controls) for column in columns]
    rows = [
        VerdictRow(
            s, [_verdict_cell(c, s, b) for c, b in zip(columns, best, strict=True)], s in controls
        )
        for s in subjects
    ]
    floors = [next((c.score.floor for c in column.cells), None) for column in columns]
    texts = ["" if f is None else number(f, c.digits) for f, c in zip(floors, columns, strict=True)]
    if any(texts):
        known = rows.pop().cells if REAL in subjects else [VerdictCell("")] * len(columns)
        cells = [VerdictCell(t) if t else cell for t, cell in zip(texts, known, strict=True)]
        rows.append(VerdictRow("real images (floor)", cells))
    return rows


def _verdict_cell(column: Column, subject: str, best: Collection[str]) -> VerdictCell:
    cell = next((c for c in column.cells if c.score.subject == subject), None)
    if cell is None:
        return VerdictCell("")
    if not cell.defined:
        return VerdictCell("undefined")
    low_high = ", ".join(number(v, column.digits) for v in cell.score.interval or ())
    interval = f"[{low_high}]" if low_high else ""
    return VerdictCell(number(cell.score.value, column.digits), subject in best, interval)


def _best(column: Column, controls: Collection[str]) -> set[str]:
    """The subjects with the best value as it is written, no controls; none where one competes."""
    apart = {REAL, *controls}
    scores = [c.score for c in column.cells if c.defined and c.score.subject not in apart]
    if column.higher_is_better is None:
        scores = [s for s in scores if s.floor is not None]
    if len(scores) < 2:
        return set()
    distance: Callable[[Score], float] = lambda s: abs(float(s) - float(s.floor or 0))
    keys = {True: lambda s: -float(s), False: float, None: distance}
    values = {s.subject: round(keys[column.higher_is_better](s), column.digits) for s in scores}
    return {subject for subject, value in values.items() if value == min(values.values())}


def cards(results: Results, columns: Sequence[Column]) -> list[Card]:
    """Return at most three cards: the leak, then the most telling scores, or more of the leak."""
    audits = [audit for audit in results.audits if audit.test_samples]
    found = [_leak_card(audits)] if audits else []
    found += [_score_card(column) for column in columns]
    if audits and not columns:
        found += [_signals_card(audits[0])] if audits[0].signals else []
        found += _cost_cards(audits) or _gap_cards(audits[0])
    return found[:CARDS]


def _leak_card(audits: Sequence[Audit]) -> Card:
    rows = [
        CardRow(
            a.name if a.against == "train" else f"against {a.against}",
            plots.share_bar(a.leaked_fraction),
            share_of(a),
        )
        for a in audits[:CARD_ROWS]
    ]
    gaps = [a.gap_median for a in audits if a.gap_median is not None]
    near = f"; the nearest frame is a median of {number(gaps[0], 0)} away" if gaps else ""
    foot = f"Train has the same video, object or image{near}."
    return Card("Test samples that leak from train", rows, foot)


def _signals_card(audit: Audit) -> Card:
    signals = sorted((s for s in audit.signals if s.checked), key=lambda s: -s.fraction)
    rows = [
        CardRow(s.kind, plots.share_bar(s.fraction), percent(s.fraction))
        for s in signals[:CARD_ROWS]
    ]
    return Card(f"What gives {audit.name} away", rows, "Share of the test samples by signal.")


def _cost_cards(audits: Sequence[Audit]) -> list[Card]:
    found = [a.impact for a in audits if a.impact and a.impact.rows]
    if not found:
        return []
    row = found[0].rows[0]
    given, clean = (row.given, row.given_interval), (row.clean, row.clean_interval)
    pairs = (("given split", *given), ("leak-free", *clean))
    rows = [
        CardRow(label, plots.bar(UNIT, value, interval, mark=row.chance), percent(value))
        for label, value, interval in pairs
    ]
    title = f"Material accuracy, {row.classifier} on {row.features}"
    return [Card(title, rows, f"The dashed line is chance, {percent(row.chance)}.")]


def _gap_cards(audit: Audit) -> list[Card]:
    if audit.gap_median is None:
        return []
    gaps = (("least", audit.gap_min), ("median", audit.gap_median), ("most", audit.gap_max))
    rows = [CardRow(label, Markup(""), number(gap, 0)) for label, gap in gaps]
    return [Card("Frames to the nearest train frame", rows, "Of the same video.")]


def _score_card(column: Column) -> Card:
    cells = [cell for cell in column.cells if cell.defined]
    first = cells[0]
    share = "accuracy" in column.metric
    mark = first.baselines.get("chance") if share else first.score.floor
    shown = cells[:CARD_ROWS]
    shown[CARD_ROWS - 1 :] = [c for c in cells[CARD_ROWS - 1 :] if c.score.subject == REAL] or (
        shown[CARD_ROWS - 1 :]
    )
    rows = [_score_row(cell, column, mark) for cell in shown]
    title = f"{QUESTIONS.get(column.metric, column.metric)} {column.arrow}"
    if share:
        return Card(title, rows, f"Share right; dashed: chance, {percent(mark)}." if mark else "")
    axis = strip_axis(first.score, STRIP)
    drawing = plots.bar(axis, first.score.value, first.score.interval, first.score.null, mark)
    return Card(title, rows, _strip_facts(first.score, column), drawing + plots.axis_row(axis))


def strip_axis(score: Score, width: float) -> plots.Axis | None:
    """Return an axis of one score alone, with its interval, null and floor."""
    axis = plots.axis_of([score])
    if axis is None:
        return None
    ticks, digits = plots.ticks_of(axis.low, axis.high, 6)
    return replace(axis, ticks=ticks, digits=digits, width=width)


def _strip_facts(score: Score, column: Column) -> str:
    facts: list[str] = []
    if score.interval:
        low, high = (number(v, column.digits) for v in score.interval)
        facts.append(f"{100 * score.level:g} % interval [{low}, {high}]")
    if score.floor is not None:
        facts.append(f"dashed: real images {number(score.floor, column.digits)}")
    if score.null and score.value is not None:
        inside = score.value <= max(score.null)
        facts.append(
            "in the gray band: no difference from real is shown"
            if inside
            else "outside the gray band: it differs from real"
        )
    return "; ".join(facts) + "." if facts else ""


def _score_row(cell: Cell, column: Column, mark: float | None) -> CardRow:
    score = cell.score
    if "accuracy" not in column.metric:
        return CardRow(score.subject, Markup(""), number(score.value, column.digits))
    drawing = plots.bar(UNIT, score.value, score.interval, mark=mark)
    return CardRow(score.subject, drawing, percent(float(score)))


def annotated(tables: Sequence[Table]) -> tuple[Column, Score] | None:
    """Return the first score with interval, null and floor, to explain the drawings on; or None."""
    for column in (c for table in tables for c in table.columns):
        for score in (cell.score for cell in column.cells):
            if defined(score) and score.interval and score.null and score.floor is not None:
                return column, score
    return None
