"""Parts of an audit that page and Markdown share: lists of pairs, group matrix, costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from palpate.report.labels import count, interval, number, plural, score_text
from palpate.report.records import ImpactRow, LeakPair
from palpate.report.results import Audit


class PairList(NamedTuple):
    """The pairs of one signal; where ``kind`` is '', those nearest in time or of a shared group."""

    kind: str
    title: str
    pairs: Sequence[LeakPair]
    has_images: bool


def pair_lists(audit: Audit) -> list[PairList]:
    """Return the pairs of each signal; first the nearest in time unless a signal has them."""
    timed = any(pair.gap is not None for pair in audit.worst)
    unnamed = "nearest in time" if timed else f"same {audit.group}"
    kinds = [(s.kind, s.worst, s.flagged) for s in audit.signals if s.worst]
    if audit.worst and not any(kind == "time gap" for kind, _, _ in kinds):
        kinds.insert(0, ("", audit.worst, 1))
    lists: list[PairList] = []
    for kind, pairs, flagged in kinds:
        title = f"{kind or unnamed}: {plural(len(pairs), 'pair')}"
        images = any(s.vision or s.tactile for p in pairs for s in (p.test, p.train))
        lists.append(PairList(kind, title + ("" if flagged else ", none flagged"), pairs, images))
    return lists


def with_contact(audit: Audit) -> bool:
    """Return whether any pair has tactile images alone, of which the contact is shown."""
    pairs = [pair for pair_list in pair_lists(audit) for pair in pair_list.pairs]
    return any((p.test.tactile or p.train.tactile) and not p.has_photos for p in pairs)


def pair_facts(pair: LeakPair, kind: str) -> list[str]:
    """Return what is known of a pair: gap, score, kind (the signal that flags it) and cause."""
    videos = {pair.test.video, pair.train.video}
    if pair.gap is not None:
        facts = [f"{plural(pair.gap, 'frame')} apart"]
    else:
        facts = ["another video" if len(videos) == 2 and None not in videos else "gap unknown"]
    facts += [f"score {score_text(pair.score)}"] if pair.score is not None else []
    facts += [kind] if kind else []
    facts += [f"{pair.cause}{': no leak' if pair.cause != 'content' else ''}"] if pair.cause else []
    return facts


def head_of(audit: Audit) -> str:
    """Return the head of the column of what the test part was compared with."""
    return audit.against.capitalize()


class GroupRow(NamedTuple):
    """A group: its counts by part, with the share of the group that is in each."""

    group: str
    cells: Sequence[tuple[str, float]]
    leaking: int


def matrix_parts(audit: Audit) -> list[str]:
    """Return the parts that some group has samples in."""
    return [
        p for p in ("train", "val", "test") if p != "val" or any(r["val"] for r in audit.matrix)
    ]


def matrix_rows(audit: Audit) -> list[GroupRow]:
    """Return the group-by-part matrix."""
    rows: list[GroupRow] = []
    for row in audit.matrix:
        counts = [int(row.get(part) or 0) for part in matrix_parts(audit)]
        cells = [(count(n), round(n / (sum(counts) or 1), 3)) for n in counts]
        rows.append(GroupRow(str(row["group"] or "not given"), cells, int(row["leaking"] or 0)))
    return rows


def impact_head(row: ImpactRow) -> list[str]:
    """Return the classifier, by what the leak-free splits were made, and a doubt."""
    doubt = ["trained on some of these images"] if row.seen else []
    return [row.classifier, f"by {row.group}", *doubt]


def impact_cells(row: ImpactRow) -> dict[str, tuple[str, str]]:
    """Return accuracy under both splits and cost, in percent, each with its interval, as text."""
    cells = {
        "Given split": (row.given, row.given_interval),
        "Leak-free": (row.clean, row.clean_interval),
        "Cost, points": (row.cost, row.cost_interval),
    }
    result: dict[str, tuple[str, str]] = {}
    for name, (value, pair) in cells.items():
        limits = [100 * limit for limit in pair or ()]
        result[name] = (number(100 * value, 1), interval(limits, 1))
    return result
