"""The first screen of a page, from data: on what, three cards; and the columns that say most."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from markupsafe import Markup

from palpate.core import Measure, Score
from palpate.report import plots
from palpate.report.notes import number, p_text, percent, plural, sentence
from palpate.report.results import Audit, Results
from palpate.report.sentences import share_of
from palpate.report.tables import REAL, Cell, Column, Table, best_by_value, defined

#: Columns of the verdict table, the most telling first; others follow as they come.
TELLING = tuple(map(Measure, ("TMMD", "material accuracy", "D-TMMD", "CI-TMMD", "SSIM")))
COLUMNS, CARDS, CARD_ROWS = 5, 3, 4
#: Metrics whose null is that generated and real images are alike.
DISTANCES = ("TMMD", "FID", "CMMD", "KID")
#: Width of the strip in a card, and of the one that explains strips, in pixels.
STRIP, READING = 296.0, 330.0
#: What a metric asks, for the title of its card.
QUESTIONS = {
    TELLING[0]: "Distance to real images, TMMD",
    TELLING[1]: "Material read from the image",
}
#: Axis of shares.
UNIT = plots.Axis(-0.02, 1.02, (), 1, width=92)


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


def about(results: Results, date: str, version: str) -> list[str]:
    """Return on what the page is: data set, sizes, when and by what its numbers were made.

    ``date`` and ``version`` are of the page, for results that do not record theirs.
    """
    settings = results.settings
    stages = settings.get("stages")
    dates = [s.get("date") for s in stages.values()] if isinstance(stages, Mapping) else []
    date = max((str(d) for d in dates if d), default=date)
    versions = settings.get("versions")
    version = versions.get("palpate", version) if isinstance(versions, Mapping) else version
    facts = [str(settings["dataset"])] if settings.get("dataset") else []
    if facts and any(note.code == "synthetic-data" for note in results.notes):
        facts[0] += ", all simulated"
    if audits := [a for a in results.audits if a.against == "train"]:
        last = audits[-1]
        videos = f" of {plural(last.groups_test, last.group)}" if last.group != "none" else ""
        facts.append(f"{plural(last.test_samples, 'test sample')}{videos}")
        facts.append(f"{plural(last.train_samples, 'train sample')}")
    elif results.scores:
        facts.append(plural(max(score.n for score in results.scores), "sample"))
    seeds = settings.get("seeds")
    if results.claims and isinstance(seeds, Sequence):
        facts.append(plural(len(seeds), "seed"))
    return [*facts, date, f"palpate {version}"]


def caution(results: Results) -> str:
    """Return what to know before any number: that a run is too small to decide anything; or ''."""
    if results.settings.get("preset") != "smoke":
        return ""
    return "Preset smoke trains for seconds, to show that everything runs; it can decide nothing."


def telling_columns(tables: Sequence[Table]) -> list[Column]:
    """Return at most five columns of different metrics, each of the first table that has it.

    So a column of another preset never stands in for one that is undefined.
    """
    first: dict[Measure, Column] = {}
    for column in (c for table in tables for c in table.columns):
        first.setdefault(column.measure, column)
    known = [first.pop(measure) for measure in TELLING if measure in first]
    others = [c for c in first.values() if any(cell.defined for cell in c.cells)]
    return [*known, *others][:COLUMNS]


def cards(
    results: Results, columns: Sequence[Column], controls: Collection[str] = ()
) -> list[Card]:
    """Return at most three cards: the leak, then the most telling scores."""
    audits = [audit for audit in results.audits if audit.test_samples]
    made = [_leak_card(audits)] if audits else []
    subjects: list[str] = []
    for column in columns:
        if cells := [cell for cell in column.cells if cell.defined]:
            shown = _compared(column, cells, controls, subjects)
            subjects = subjects or [cell.score.a for cell in shown]
            made.append(_score_card(column, shown, len(cells), controls))
    return made[:CARDS]


def _leak_card(audits: Sequence[Audit]) -> Card:
    rows = [
        CardRow(
            a.name if a.against == "train" else f"against {a.against}",
            plots.share_bar(a.leaked_fraction),
            share_of(a),
        )
        for a in audits[:CARD_ROWS]
    ]
    foot = ""
    if any(a.leaked_fraction for a in audits):
        gaps = {a.name: a.gap_median for a in audits if a.leaked_fraction}
        name, gap = next(((n, g) for n, g in gaps.items() if g is not None), ("", None))
        of = f" of {name}" if len(audits) > 1 else ""
        frames = "" if gap is None else f"{gap:g} frame{'s' * (gap != 1)} away"
        near = f"; median{of}: {frames}" if frames else ""
        foot = f"Train has the same video, object or image{near}."
    return Card("Test samples that leak from train", rows, foot)


def _score_card(
    column: Column, shown: Sequence[Cell], known: int, controls: Collection[str]
) -> Card:
    first = shown[0]
    share = "accuracy" in column.measure.metric
    mark = first.baselines.get("chance") if share else first.score.floor
    axis = strip_axis([cell.score for cell in shown], STRIP)
    small = UNIT if share or axis is None else replace(axis, ticks=(), width=UNIT.width)
    rows = [_score_row(cell, column, small, mark, controls) for cell in shown]
    left = f" {len(shown)} of {known} rows." if known > len(shown) else ""
    told = [n for cell in shown for n in cell.score.notes if n.code == "text"]
    left += f" * {sentence(told[0]).partition(':')[0]}." if told else ""
    title = f"{QUESTIONS.get(column.measure, column.name)} {column.arrow}"
    if share:
        chance = f"Share named right by a probe; dashed: chance, {percent(mark)}." if mark else ""
        real = next((c.score for c in shown if c.score.a == REAL), None)
        if mark and real and real.interval and real.interval[0] <= mark:
            chance = f"The probe does not tell real images from chance, {percent(mark)} (dashed)."
        return Card(title, rows, f"{chance}{left}".strip())
    if axis is None:
        return Card(title, rows, left.strip())
    drawing = plots.bar(axis, first.score.value, first.score.interval, first.score.null, mark)
    rows[0] = replace(rows[0], drawing=Markup(""))
    foot = f"{_strip_facts(first.score, column)}{left}".strip()
    return Card(title, rows, foot, drawing + plots.axis_row(axis))


def _compared(
    column: Column, cells: Sequence[Cell], controls: Collection[str], before: Sequence[str]
) -> list[Cell]:
    """The first method, the best other one, the nearest photo, real images; then as they come.

    Cards that follow hold the subjects of the first, and the real images in the place of the last
    method.
    """
    real = [c for c in cells if c.score.a == REAL]
    if same := [c for name in before for c in cells if c.score.a == name]:
        apart = [c for c in same if c.score.a in controls]
        methods = [c for c in same if c.score.a not in {*controls, REAL}]
        room = CARD_ROWS - len(real)
        methods = methods[: max(1, room - len(apart))]
        return [*methods, *apart[: room - len(methods)], *real]
    methods = [c for c in cells if c.score.a != REAL and c.score.a not in controls]
    others = methods[1:]
    best = best_by_value([c.score for c in others], column.digits) or {0}
    apart = [c for c in cells if c.score.a in controls]
    photo = [c for c in apart if "nearest photo" in c.score.a] or apart
    chosen = [*methods[:1], *(others[k] for k in sorted(best)[:1] if others), *photo[:1], *real[:1]]
    more = [c for c in (*others, *cells) if all(c is not other for other in chosen)]
    room = CARD_ROWS - len(chosen)
    place = len(chosen) - len(photo[:1]) - len(real[:1])
    unique = list({id(c): c for c in more}.values())[:room]
    return [*chosen[:place], *unique, *chosen[place:]]


def strip_axis(scores: Sequence[Score], width: float) -> plots.Axis | None:
    """Return an axis of scores, with their intervals, nulls and floors; None without any."""
    axis = plots.axis_of(scores)
    if axis is None:
        return None
    ticks, digits = plots.ticks_of(axis.low, axis.high, 6)
    return replace(axis, ticks=ticks, digits=digits, width=width)


def _strip_facts(score: Score, column: Column) -> str:
    facts: list[str] = []
    if score.interval:
        low, high = (number(v, column.digits) for v in score.interval)
        facts.append(f"{score.a}: {100 * score.level:g} % interval [{low}, {high}]")
    if score.floor is not None:
        facts.append(f"dashed: real images {number(score.floor, column.digits)}")
    return "; ".join(filter(None, [*facts, _against_real(score)])) + "." * bool(facts)


def _against_real(score: Score) -> str:
    """What is shown of generated against real images.

    Equality of the two is what the null of a distance to real images means, and its p-value
    decides; a metric without a better direction has the floor to compare with.
    """
    p = score.details.get("p_value")
    if score.metric in DISTANCES and p is not None:
        shown = "differs from real" if p < 0.05 else "not shown to differ from real"
        return f"p {'' if p < 0.001 else '= '}{p_text(p)}: {shown}"
    if score.higher_is_better is not None or score.floor is None or not score.interval:
        return ""
    low, high = score.interval
    if low <= score.floor <= high:
        return "the interval holds the floor"
    varied = high < score.floor and score.metric in ("I-TMMD", "CI-TMMD")
    lack = ": images vary less than real ones" if varied else ""
    return f"the interval is {'below' if high < score.floor else 'above'} the floor{lack}"


def _score_row(
    cell: Cell,
    column: Column,
    axis: plots.Axis | None,
    mark: float | None,
    controls: Collection[str],
) -> CardRow:
    score = cell.score
    label = f"{score.a} (control)" if score.a in controls else score.a
    label += "*" * any(note.code == "text" for note in score.notes)
    drawing = plots.bar(axis, score.value, score.interval, mark=mark)
    share = "accuracy" in column.measure.metric
    text = percent(float(score)) if share else number(score.value, column.digits)
    return CardRow(label, drawing, text)


def annotated(tables: Sequence[Table]) -> tuple[Column, Score] | None:
    """Return the first score with interval, null and floor, to explain the drawings on; or None."""
    for column in (c for table in tables for c in table.columns):
        for score in (cell.score for cell in column.cells):
            if defined(score) and score.interval and score.null and score.floor is not None:
                return column, score
    return None
