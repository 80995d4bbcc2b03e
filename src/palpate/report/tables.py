"""Tables of scores: one a metric family, rows = subjects, columns = metrics.

A column is what :func:`palpate.core.columns` makes, so scores of different settings raise instead of standing side by side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from palpate.core import Score, columns
from palpate.core.score import ARROWS, BETTER
from palpate.report.plots import Axis, axis_of
from palpate.report.remarks import Footnotes, by_gap, reason, remarks
from palpate.report.results import Results
from palpate.report.sides import TAIL, Sides, sides
from palpate.report.text import decimals, defined, interval_text, number, plain, setting_of

#: Family title, what it asks, and the pieces of a metric's name (lower case) that put it there; the first match wins.
FAMILIES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (
        "Touch features",
        "Are generated and real touches alike to a touch encoder? I-, CI- and D-TMMD need no reference images.",
        ("tmmd",),
    ),
    (
        "Image distributions",
        "Are the sets of images alike to a general image encoder?",
        ("cmmd", "fid", "kid", "mmd", "precision", "recall (", "density", "coverage"),
    ),
    (
        "Image by image",
        "Does each generated touch match its own real touch, pixel by pixel or patch by patch?",
        ("contact ", "ssim", "psnr", "lpips", "l1", "mse"),
    ),
    (
        "Recognition",
        "What can be read from the touch: its material, or the text and photo that belong to it?",
        ("acc", "top", "retriev", "probe", "@"),
    ),
)
OTHER = ("Other metrics", "")
#: Stands with the question where a table has contact scores.
GEL = "Gel: what the empty gel, without any touch, has in the place of a contact score; squared errors such as PSNR prefer it to a wrong touch."
#: The family of differences of two generators.
DIFFERENCES = (
    "Paired differences",
    "Which of two generators is better on the same samples? Values are a - b; where the interval leaves out 0 the difference is more than chance.",
)
#: Stands with that question where metrics without a direction have differences.
NEARER = "For metrics with → that tells a from b, not which is better: the nearer to the floor is, and confidence and p are of |a - floor| - |b - floor|."


@dataclass(frozen=True)
class Cell:
    """One score as text.

    Attributes:
        score: the score itself.
        value, interval, floor, null: numbers as text, '' where there is none.
        gel: what the empty gel scores, for contact scores.
        size: ``"n = 240"`` or ``"n = 240, m = 1,200"``; '' where the whole column shares it.
        footnotes: numbers of the notes below the table.
        why: why an undefined score is.
    """

    score: Score
    value: str
    interval: str
    floor: str
    null: str
    gel: str
    size: str
    footnotes: Sequence[int]
    why: str


@dataclass(frozen=True)
class Column:
    """One metric: its direction, its axis, the sample sizes if all of its scores share them, and how the scores were made."""

    metric: str
    higher_is_better: bool | None
    axis: Axis | None
    size: str
    made: Sequence[tuple[str, str]]

    @property
    def arrow(self) -> str:
        """The better direction."""
        return ARROWS[self.higher_is_better]

    @property
    def better(self) -> str:
        """The better direction in words."""
        return BETTER[self.higher_is_better]


@dataclass(frozen=True)
class Table:
    """One family. ``cells[subject][metric]`` lists the scores that stand there (several where seeds differ).

    ``shared`` is how all columns were made alike; a column's ``made`` is what is its own. ``sides`` are the real touches of these scores, as in
    :mod:`palpate.report.sides`.
    """

    title: str
    question: str
    columns: Sequence[Column]
    subjects: Sequence[str]
    cells: Mapping[str, Mapping[str, Sequence[Cell]]]
    shared: Sequence[tuple[str, str]]
    notes: Sequence[str]
    sides: frozenset[int]


@dataclass(frozen=True)
class Part:
    """Scores that stand in one table: its title, what of it names split and reference ('' where all share them), its question, and the sides."""

    title: str
    tail: str
    question: str
    scores: Sequence[Score]
    sides: frozenset[int]

    @property
    def differences(self) -> bool:
        """Whether these are paired differences."""
        return self.scores[0].metric.endswith(TAIL)


@dataclass(frozen=True)
class Heat:
    """A square matrix of divergences, e.g. D-TMMD's between classes. ``shares`` are the colors' strengths in [0, 1]."""

    title: str
    labels: Sequence[str]
    values: Sequence[Sequence[str]]
    shares: Sequence[Sequence[float]] = field(default_factory=list)


def family_of(metric: str) -> tuple[str, str]:
    """Title and question of the family that a metric belongs to."""
    name = metric.lower()
    if name.endswith(TAIL):
        return DIFFERENCES
    return next(
        (
            (title, question)
            for title, question, pieces in FAMILIES
            if any(p in f"{name} (" for p in pieces)
        ),
        OTHER,
    )


def _made(column: Sequence[Score]) -> list[tuple[str, str]]:
    """How the scores of one column were made, as (what, how): what all of them share, and the interval's method."""
    first = column[0]
    rows = [("estimator", first.estimator)]
    if first.bandwidth is not None:
        rows.append(("bandwidth σ", f"{first.bandwidth:g}"))
    if first.scale != 1:
        rows.append(("scale", f"× {first.scale:g}"))
    levels = [
        (f"{100 * s.level:g}\u00a0%", s.interval_method) for s in column if s.interval is not None
    ]
    methods = dict.fromkeys(f"{level}, {method}" if method else level for level, method in levels)
    rows.append(("interval", "; ".join(methods)))
    seeds = dict.fromkeys(str(s.seed) for s in column if s.seed is not None)
    rows.append(("seed", ", ".join(seeds)))
    rows += [
        (str(k).replace("_", " "), v if isinstance(v, str) else str(plain(v)))
        for k, v in first.settings.items()
    ]
    rows += [
        ("encoder", first.encoder or ""),
        ("reference", first.reference or ""),
        ("split", first.split or ""),
    ]
    return [(what, how) for what, how in rows if how]


def _size(score: Score) -> str:
    return ", ".join(
        f"{k} = {v:,}" for k, v in (("n", score.n or None), ("m", score.m)) if v is not None
    )


def gel_of(score: Score) -> float | None:
    """What the empty gel, without any touch, scores in the place of a contact score; None for other scores."""
    empty = score.details.get("empty")
    return (
        empty
        if isinstance(empty, int | float) and not isinstance(empty, bool) and math.isfinite(empty)
        else None
    )


def _cell(score: Score, digits: int, notes: Footnotes, size: str) -> Cell:
    gel = gel_of(score)
    return Cell(
        score,
        value=number(score.value, digits),
        interval=interval_text(score, digits),
        floor=number(score.floor, digits) if score.floor is not None else "",
        null=f"{number(score.null[0], digits)} to {number(score.null[1], digits)}"
        if score.null
        else "",
        gel=number(gel, digits) if gel is not None else "",
        size=size,
        footnotes=notes.numbers(remarks(score)),
        why="" if defined(score) else reason(score).removeprefix("Undefined: "),
    )


#: What a named reading of the TMMD family means, in a few words, for the head of its table.
READINGS = {
    "paper": "the paper's formula to the letter, random halves",
    "paper-tables": "the reading that fits the paper's printed tables",
    "cmmd": "as CMMD's published code",
    "grouped": "whole groups kept together",
}


def parts(scores: Sequence[Score]) -> list[Part]:
    """The scores of each table, families in fixed order.

    Scores of another preset or of another split, or compared with other real touches, stand in tables of their own. A score that was compared
    with none (I-, CI-, D-TMMD) stands with the others of its subject.
    """
    order = [title for title, _, _ in FAMILIES] + [OTHER[0], DIFFERENCES[0]]
    found: dict[tuple[int, str, str], list[int]] = {}
    for k, score in enumerate(scores):
        found.setdefault((order.index(family_of(score.metric)[0]), *setting_of(score)), []).append(
            k
        )
    several, at, out = len({split for _, _, split in found}) > 1, sides(scores), list[Part]()
    for (place, preset, split), members in sorted(found.items(), key=lambda item: item[0][0]):
        title, question = family_of(scores[members[0]].metric)
        if preset:
            title += f", {preset}: {READINGS[preset]}" if preset in READINGS else f", {preset}"
        cut = f", split {split[:8]}" if several and split else ""
        for side, some in _by_side(members, scores, at):
            first = not any(p.question == question for p in out)
            asked = question if first or place == len(FAMILIES) else ""
            out.append(
                Part(
                    title + cut + side,
                    cut + side,
                    asked,
                    [scores[k] for k in some],
                    frozenset(at.of[k] for k in some),
                )
            )
    return out


def _by_side(
    members: Sequence[int], scores: Sequence[Score], at: Sides
) -> list[tuple[str, list[int]]]:
    """The members by side, with what their title ends in, where those with a reference are of more than one; else all of them."""
    if len({at.of[k] for k in members if at.bound[k]}) < 2:
        return [("", list(members))]
    apart: dict[int, list[int]] = {}
    for k in members:
        apart.setdefault(at.of[k], []).append(k)
    digests = {
        side: dict.fromkeys(scores[k].reference or "" for k in some if at.bound[k])
        for side, some in apart.items()
    }
    said = {
        side: " and ".join(d[:8] or "not recorded" for d in digests[side] or at.references[side])
        for side in apart
    }
    return [(f", reference {said[side]}", some) for side, some in apart.items()]


def score_tables(scores: Sequence[Score]) -> list[Table]:
    """The tables of all scores, as :func:`parts`; metrics and subjects in the order of first appearance.

    Raises:
        PalpateError: if two scores that share a column were not made alike.
    """
    return [_table(part) for part in parts(scores)]


def _table(part: Part) -> Table:
    notes = Footnotes()
    cells: dict[str, dict[str, list[Cell]]] = {}
    heads: list[Column] = []
    for metric, column in columns(part.scores).items():
        near = [
            v
            for s in column
            for v in (s.value, s.floor, *(s.interval or ()))
            if v is not None and math.isfinite(v)
        ]
        common = _size(column[0]) if len({_size(s) for s in column}) == 1 else ""
        for score in column:
            cell = _cell(score, decimals(near), notes, "" if common else _size(score))
            cells.setdefault(score.subject, {}).setdefault(metric, []).append(cell)
        heads.append(
            Column(metric, column[0].higher_is_better, axis_of(column), common, _made(column))
        )
    subjects = list(dict.fromkeys(score.subject for score in part.scores))
    shared = [row for row in heads[0].made if len(heads) > 1 and all(row in h.made for h in heads)]
    heads = [replace(h, made=[row for row in h.made if row not in shared]) for h in heads]
    said = [
        NEARER if any(map(by_gap, part.scores)) else "",
        GEL if any(gel_of(s) is not None for s in part.scores) else "",
    ]
    question = " ".join(filter(None, [part.question, *said]))
    return Table(part.title, question, heads, subjects, cells, shared, notes.texts, part.sides)


def settings_of(results: Results) -> dict[str, Any]:
    """The settings of results, with the digests of the real touches that their scores were compared with."""
    by_subject: dict[str, list[str]] = {}
    for score in results.scores:
        if score.reference and not score.metric.endswith(TAIL):
            by_subject.setdefault(score.subject, []).append(score.reference)
    joined: dict[tuple[str, ...], list[str]] = {}
    for subject, digests in by_subject.items():
        joined.setdefault(tuple(dict.fromkeys(digests)), []).append(subject)
    shown = plain(results.settings)
    if joined:
        shown["real touches compared with"] = {
            ", ".join(subjects): digests[0] if len(digests) == 1 else list(digests)
            for digests, subjects in joined.items()
        }
    return shown


def _square(matrix: Any) -> list[list[float | None]] | None:
    """``matrix`` as rows of numbers (None = undefined), or None if it is not a square of them."""
    rows = plain(matrix)
    if (
        not isinstance(rows, list)
        or not rows
        or any(not isinstance(r, list) or len(r) != len(rows) for r in rows)
    ):
        return None
    if any(
        v is not None and (isinstance(v, bool) or not isinstance(v, int | float))
        for r in rows
        for v in r
    ):
        return None
    return rows


def heat_tables(scores: Sequence[Score]) -> list[Heat]:
    """One heat table for each score whose details hold a square ``matrix`` (``classes`` or ``labels`` name its rows, else they are numbered).

    Where the table that a score stands in is named by its reference or split, so is its matrix.
    """
    tables: list[Heat] = []
    tails = {id(score): part.tail for part in parts(scores) for score in part.scores}
    for score in scores:
        matrix = _square(score.details.get("matrix"))
        if matrix is None:
            continue
        names = plain(score.details.get("classes", score.details.get("labels")))
        labels = (
            [str(n) for n in names]
            if isinstance(names, list) and len(names) == len(matrix)
            else [f"{k + 1}" for k in range(len(matrix))]
        )
        seen = [abs(v) for row in matrix for v in row if v is not None]
        digits, top = min(3, decimals(seen)), max(seen, default=0.0) or 1.0
        tables.append(
            Heat(
                ", ".join(
                    filter(
                        None, [score.metric, score.subject, str(score.settings.get("preset", ""))]
                    )
                )
                + tails[id(score)],
                labels,
                [[number(v, digits) for v in row] for row in matrix],
                [[round(max(0.0, v or 0.0) / top, 3) for v in row] for row in matrix],
            )
        )
    return tables
