"""What the page and the Markdown show of one audit: its signals, pairs, matrix and impact, put into words and drawings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from markupsafe import Markup

from palpate.report import plots
from palpate.report.notes import sentence
from palpate.report.pictures import Picture, Wanted
from palpate.report.results import MATRIX_ROWS, Audit, Impact, ImpactRow, LeakPair, Signal
from palpate.report.sentences import (
    HARMLESS,
    cause_notes,
    cause_texts,
    leak_line,
    line_text,
    meaning_of,
    there,
    threshold_text,
    where,
)
from palpate.report.text import count, number, percent, plural, score_text

#: Pairs of one signal that show at once, and that the page holds at all; the JSON beside the page names every one.
OPEN_PAIRS, MAX_PAIRS = 6, 24
PARTS = ("train", "val", "test")


@dataclass(frozen=True)
class PairRow:
    """A leak pair with its pictures."""

    item: LeakPair
    pictures: Sequence[Picture]


@dataclass(frozen=True)
class PairList:
    """The pairs of one signal (``kind``), or the nearest in time where ``kind`` is ''; ``flagged`` of its test samples leak."""

    kind: str
    pairs: Sequence[LeakPair]
    flagged: int | None = None

    @property
    def title(self) -> str:
        """``"time gap: 12 pairs"``."""
        none = ", none flagged" if self.flagged == 0 else ""
        return f"{self.kind or 'nearest in time'}: {plural(len(self.pairs), 'pair')}{none}"

    @property
    def drawn(self) -> bool:
        """Whether there is a place for pictures: always without a signal, else if any pair has one."""
        return not self.kind or any(
            (s.vision or s.tactile) for p in self.pairs for s in (p.test, p.train)
        )


@dataclass(frozen=True)
class PairView:
    """A list of pairs as the page shows it: at once, behind a fold, and how many there are in all.

    ``title`` heads the list; ``drawn`` is false where a signal's pairs have no pictures at all, so that places for them would be empty.
    """

    kind: str
    title: str
    drawn: bool
    shown: Sequence[PairRow]
    folded: Sequence[PairRow]
    total: int


@dataclass(frozen=True)
class SignalView:
    """A signal in words and as a drawing (``histogram`` is '' where nothing was calibrated)."""

    signal: Signal
    meaning: str
    share: str
    threshold: str
    false_positives: str
    causes: Sequence[str]
    notes: Sequence[str]
    histogram: Markup
    line: str
    bins: Sequence[tuple[str, str, str]]


@dataclass(frozen=True)
class MatrixRow:
    """A group: its name, its counts by part with the share of the group that lies there, and its leaking test samples."""

    group: str
    cells: Sequence[tuple[str, float]]
    leaking: int


@dataclass(frozen=True)
class MatrixView:
    """Groups by part; ``more`` counts the groups that are not in ``rows``."""

    parts: Sequence[str]
    rows: Sequence[MatrixRow]
    more: int


@dataclass(frozen=True)
class ImpactCell:
    """An accuracy or a difference, in per cent, as text and as a drawing."""

    value: str
    interval: str
    bar: Markup


@dataclass(frozen=True)
class ImpactView:
    """What the leak costs: one line for each kind of features and classifier, and the axes below the columns."""

    impact: Impact
    rows: Sequence[tuple[ImpactRow, ImpactCell, ImpactCell, ImpactCell, str]]
    axes: Sequence[Markup]


@dataclass(frozen=True)
class AuditView:
    """An audit with its drawings, its pairs and its tables.

    Attributes:
        audit: what is shown.
        other: what the test part was compared with, in a sentence (``train``, ``the pretraining data``).
        side: the same as the head of a column (``Train``, ``Pretraining``).
        share: leaking share of the test samples, by any signal if signals were looked for, else by shared groups.
        finding: the sentence below the share; '' where the page words it from the groups.
        histogram: of gaps; ``uneven`` says whether its bins differ in width.
        pairs: the lists of pairs, strongest evidence first.
        signals, matrix, impact: the parts, each empty or None where the audit has none.
    """

    audit: Audit
    other: str
    side: str
    share: float
    finding: str
    histogram: Markup
    uneven: bool
    pairs: Sequence[PairView]
    signals: Sequence[SignalView]
    matrix: MatrixView | None
    impact: ImpactView | None


def pair_lists(audit: Audit) -> list[PairList]:
    """The pairs of each signal that has some; the nearest in time come first unless a signal shows them already."""
    lists = [PairList(s.kind, list(s.worst), s.flagged) for s in audit.signals if s.worst]
    if audit.worst and not any(p.kind == "time gap" for p in lists):
        lists.insert(0, PairList("", list(audit.worst)))
    return lists


def pair_pictures(pair: LeakPair, side: str) -> list[Wanted]:
    """Photos above, touches below; test on the left."""
    sides = (("Test", pair.test), (side, pair.train))
    return [Wanted(s.vision, f"{name} photo: {where(s)}", f"{name} photo") for name, s in sides] + [
        Wanted(s.tactile, f"{name} touch: {where(s)}", f"{name} touch") for name, s in sides
    ]


def side_of(audit: Audit) -> str:
    """Head of the column of what the test part was compared with."""
    return audit.against[:1].upper() + audit.against[1:]


def signal_view(signal: Signal, audit: Audit) -> SignalView:
    """A signal in words and as a drawing."""
    bins = plots.bins_of(signal)
    rate = signal.false_positives
    line = line_text(signal)
    said = f"Two histograms of scores of {signal.kind}. {line}{_middles(bins)}" if bins else ""
    return SignalView(
        signal,
        meaning_of(signal, audit),
        percent(signal.fraction) if signal.checked else "–",
        threshold_text(signal),
        percent(rate) if rate is not None else "–",
        cause_texts(signal),
        [*cause_notes(signal), *map(sentence, signal.notes)],
        plots.score_histogram(signal, said, there(audit)),
        line if bins else "",
        _bin_rows(bins) if bins else [],
    )


def _middles(bins: plots.Bins) -> str:
    """Between which scores the middle half of each histogram lies, for the drawing in words."""
    said = ""
    for name, counts in (("unrelated samples", bins.unrelated), ("test samples", bins.matches)):
        if sum(counts):
            low, high = (_quantile(bins.edges, counts, share) for share in (0.25, 0.75))
            said += (
                f" The middle half of the {name} scores {score_text(low)} to {score_text(high)}."
            )
    return said


def _quantile(edges: Sequence[float], counts: Sequence[int], share: float) -> float:
    """The score below which ``share`` of the counts lie, linear inside each bin."""
    left = share * sum(counts)
    for n, (a, b) in zip(counts, pairwise(edges), strict=True):
        if n and left <= n:
            return a + (b - a) * left / n
        left -= n
    return edges[-1]


def _bin_rows(bins: plots.Bins) -> list[tuple[str, str, str]]:
    unrelated = list(bins.unrelated) or [None] * len(bins.matches)
    return [
        (f"{score_text(a)} to {score_text(b)}", count(m), count(n))
        for (a, b), m, n in zip(pairwise(bins.edges), unrelated, bins.matches, strict=True)
    ]


def matrix_view(audit: Audit) -> MatrixView | None:
    """The group-by-part matrix; a part that no group has is left out."""
    rows = list(audit.matrix)[:MATRIX_ROWS]
    if not rows:
        return None
    parts = [p for p in PARTS if p != "val" or any(r.get(p) for r in rows)]
    shown: list[MatrixRow] = []
    for row in rows:
        total = sum(int(row.get(p) or 0) for p in parts) or 1
        cells = [
            (count(int(row.get(p) or 0)), round(int(row.get(p) or 0) / total, 3)) for p in parts
        ]
        shown.append(
            MatrixRow(str(row.get("group") or "not given"), cells, int(row.get("leaking") or 0))
        )
    return MatrixView(parts, shown, max(0, audit.groups_in_all - len(rows)))


def interval_percent(interval: tuple[float, float] | None) -> str:
    """``"[65.0, 77.1]"``, in per cent; '' for None."""
    return (
        ""
        if interval is None
        else f"[{number(100 * interval[0], 1)}, {number(100 * interval[1], 1)}]"
    )


def _cell(
    value: float,
    interval: tuple[float, float] | None,
    axis: plots.Axis | None,
    chance: float | None,
) -> ImpactCell:
    bar = Markup("")
    if axis is not None:
        wide = None if interval is None else (100 * interval[0], 100 * interval[1])
        bar = plots.bar(axis, 100 * value, wide, floor=None if chance is None else 100 * chance)
    return ImpactCell(number(100 * value, 1), interval_percent(interval), bar)


def impact_view(impact: Impact | None) -> ImpactView | None:
    """What the leak costs: accuracies on one axis, costs on another."""
    if impact is None or not impact.rows:
        return None
    scores: list[float] = [0.0]
    costs: list[float] = [0.0]
    for r in impact.rows:
        scores += [r.given, r.clean, r.chance, *(r.given_interval or ()), *(r.clean_interval or ())]
        costs += [r.cost, *(r.cost_interval or ())]
    score_axis, cost_axis = (
        plots.axis_over([100 * v for v in values]) for values in (scores, costs)
    )
    rows = [
        (
            r,
            _cell(r.given, r.given_interval, score_axis, r.chance),
            _cell(r.clean, r.clean_interval, score_axis, r.chance),
            _cell(r.cost, r.cost_interval, cost_axis, 0.0),
            number(100 * r.chance, 1),
        )
        for r in impact.rows
    ]
    axes = [
        plots.axis_row(a) if a is not None else Markup("")
        for a in (score_axis, score_axis, cost_axis)
    ]
    return ImpactView(impact, rows, axes)


def audit_view(audit: Audit, pairs: Sequence[Sequence[PairRow]]) -> AuditView:
    """Everything that the page shows of one audit.

    Args:
        audit: the audit.
        pairs: for each of :func:`pair_lists`, the pairs for whose pictures there is room.
    """
    by_any = audit.leaking_samples / audit.test_samples if audit.test_samples else 0.0
    views = [
        PairView(
            found.kind,
            found.title,
            found.drawn,
            rows[:OPEN_PAIRS],
            rows[OPEN_PAIRS:],
            len(found.pairs),
        )
        for found, rows in zip(pair_lists(audit), pairs, strict=True)
    ]
    return AuditView(
        audit,
        other=there(audit),
        side=side_of(audit),
        share=by_any if audit.signals else audit.leaked_fraction,
        finding=leak_line(audit) if audit.signals and audit.test_samples else "",
        histogram=plots.gap_histogram(audit),
        uneven=plots.uneven(audit.gap_edges),
        pairs=[v for v in views if v.shown],
        signals=[signal_view(s, audit) for s in audit.signals],
        matrix=matrix_view(audit),
        impact=impact_view(audit.impact),
    )


def pair_facts(pair: LeakPair, kind: str) -> list[str]:
    """What is known of a pair, piece by piece: gap, score, kind (the signal that shows it, or '') and cause."""
    facts: list[str] = []
    if pair.gap is not None:
        facts.append(f"{count(pair.gap)} {'frame' if pair.gap == 1 else 'frames'} apart")
    elif (
        kind
        and None not in (pair.test.video, pair.train.video)
        and pair.test.video != pair.train.video
    ):
        facts.append("another video")
    else:
        facts.append("gap unknown")
    facts += [f"score {score_text(pair.score)}"] if pair.score is not None else []
    facts += [kind] if kind else []
    facts += [f"{pair.cause}{': no leak' if pair.cause in HARMLESS else ''}"] if pair.cause else []
    return facts


def signal_row(view: SignalView) -> Mapping[str, Any]:
    """A signal as one row of text for the Markdown table."""
    s = view.signal
    return {
        "signal": s.kind,
        "looked at": count(s.checked),
        "flagged": count(s.flagged),
        "share": view.share,
        "threshold": view.threshold,
        "false positives": view.false_positives,
        "alike because of": "; ".join(view.causes) or "–",
    }
