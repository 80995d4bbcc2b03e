"""The first screen of a page, from data: on what, three cards; and the columns that say most."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from markupsafe import Markup

from palpate.core import Measure, Score
from palpate.report import plots
from palpate.report.findings import share_of
from palpate.report.labels import interval, number, p_text, percent, plural
from palpate.report.notes import sentence
from palpate.report.results import Audit, Results
from palpate.report.tables import REAL, Column, Family, baselines, best_by_value, defined

#: Columns of the verdict table, the most telling first; others follow as they come.
TELLING = tuple(
    map(Measure, ("TMMD", "material accuracy", "marker motion", "D-TMMD", "CI-TMMD", "SSIM"))
)
COLUMNS, CARDS, CARD_ROWS = 5, 3, 4
#: Metrics whose null is that generated and real images do not differ.
DISTANCES = ("TMMD", "FID", "CMMD", "KID", "FD", "MIND")
#: Width of the strip in a card, and of the one that explains strips, in pixels.
STRIP, READING = 296.0, 330.0
#: What a metric asks, for the title of its card.
QUESTIONS = {
    TELLING[0]: "Distance to real images, TMMD",
    TELLING[1]: "Material read from the image",
    TELLING[2]: "How far markers move, % of the width",
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


def telling_columns(families: Sequence[Family]) -> list[Column]:
    """Return at most five columns of different metrics, each of the first family that has it.

    So a column of another preset never stands in for one that is undefined.
    """
    first: dict[Measure, Column] = {}
    for column in (c for family in families for c in family.columns):
        first.setdefault(column.measure, column)
    telling = [first.pop(measure) for measure in TELLING if measure in first]
    return [*telling, *(c for c in first.values() if any(map(defined, c.scores)))][:COLUMNS]


def cards(
    results: Results, columns: Sequence[Column], controls: Collection[str] = ()
) -> list[Card]:
    """Return at most three cards: the leak, then the most telling scores."""
    audits = [audit for audit in results.audits if audit.test_samples]
    cards = [_leak_card(audits)] if audits else []
    subjects: list[str] = []
    for column in columns:
        if scores := [score for score in column.scores if defined(score)]:
            compared = _compared(column, scores, controls, subjects)
            subjects = subjects or [score.a for score in compared]
            cards.append(_score_card(column, compared, len(scores), controls))
    return cards[:CARDS]


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
        whose = f" of {name}" if len(audits) > 1 else ""
        frames = "" if gap is None else f"{gap:g} frame{'s' * (gap != 1)} away"
        near = f"; median{whose}: {frames}" if frames else ""
        foot = f"Train has the same video, object or image{near}."
    return Card("Test samples that leak from train", rows, foot)


def _score_card(
    column: Column, scores: Sequence[Score], defined_scores: int, controls: Collection[str]
) -> Card:
    first, share = scores[0], "accuracy" in column.measure.metric
    mark = baselines(first).get("chance") if share else first.floor
    axis = plots.axis_of(scores, 6, STRIP)
    small = UNIT if share or axis is None else replace(axis, ticks=(), width=UNIT.width)
    rows: list[CardRow] = []
    for score in scores:
        label = f"{score.a} (control)" if score.a in controls else score.a
        label += "*" * any(note.code == "text" for note in score.notes)
        drawing = plots.bar(small, score.value, score.interval, mark=mark)
        text = percent(float(score)) if share else number(score.value, column.digits)
        rows.append(CardRow(label, drawing, text))
    left = f" {len(scores)} of {defined_scores} rows." * (defined_scores > len(scores))
    remarks = [n for score in scores for n in score.notes if n.code == "text"]
    left += f" * {sentence(remarks[0]).partition(':')[0]}." if remarks else ""
    title = f"{QUESTIONS.get(column.measure, column.name)} {column.arrow}"
    if share:
        chance = f"Share named right by a probe; dashed: chance, {percent(mark)}." if mark else ""
        real = next((s for s in scores if s.a == REAL), None)
        if mark and real and real.interval and real.interval[0] <= mark:
            chance = f"The probe does not tell real images from chance, {percent(mark)} (dashed)."
        return Card(title, rows, f"{chance}{left}".strip())
    if axis is None:
        return Card(title, rows, left.strip())
    drawing = plots.bar(axis, first.value, first.interval, first.null, mark)
    rows[0] = replace(rows[0], drawing=Markup(""))
    foot = f"{_strip_facts(first, column)}{left}".strip()
    return Card(title, rows, foot, drawing + plots.axis_row(axis))


def _compared(
    column: Column, scores: Sequence[Score], controls: Collection[str], before: Sequence[str]
) -> list[Score]:
    """The first method, the best other one, the nearest photo, real images; then as they come.

    Cards that follow hold the subjects of the first, and the real images in the place of the last
    method.
    """
    same = [score for name in before for score in scores if score.a == name]
    real = [score for score in scores if score.a == REAL]
    apart = [score for score in same or scores if score.a in controls]
    methods = [score for score in same or scores if score.a not in {*controls, REAL}]
    if same:
        room = CARD_ROWS - len(real)
        methods = methods[: max(1, room - len(apart))]
        return [*methods, *apart[: room - len(methods)], *real]
    rivals = methods[1:]
    best = best_by_value(rivals, column.digits) or {0}
    front = [*methods[:1], *(rivals[k] for k in sorted(best)[:1] if rivals)]
    photo = [score for score in apart if "nearest photo" in score.a] or apart
    back = [*photo[:1], *real[:1]]
    more = {id(score): score for score in (*rivals, *scores)}
    more = [score for k, score in more.items() if k not in map(id, (*front, *back))]
    return [*front, *more[: CARD_ROWS - len(front) - len(back)], *back]


def _strip_facts(score: Score, column: Column) -> str:
    facts: list[str] = []
    if score.interval:
        limits = interval(score.interval, column.digits)
        facts.append(f"{score.a}: {100 * score.level:g} % interval {limits}")
    if score.floor is not None:
        facts.append(f"dashed: real images {column.text(score.floor)}")
    return "; ".join(filter(None, [*facts, _against_real(score)])) + "." * bool(facts)


def _against_real(score: Score) -> str:
    """What is shown of generated against real images.

    Equality of the two is what the null of a distance to real images means, and its p-value
    decides; a metric without a better direction has the floor to compare with.
    """
    p = score.details.get("p_value")
    if score.metric in DISTANCES and p is not None:
        verdict = "differs from real" if p < 0.05 else "not shown to differ from real"
        return f"p {'' if p < 0.001 else '= '}{p_text(p)}: {verdict}"
    if score.higher_is_better is not None or score.floor is None or not score.interval:
        return ""
    low, high = score.interval
    if low <= score.floor <= high:
        return "the interval holds the floor"
    varied = high < score.floor and score.metric in ("I-TMMD", "CI-TMMD")
    lack = ": images vary less than real ones" if varied else ""
    return f"the interval is {'below' if high < score.floor else 'above'} the floor{lack}"


def annotated(families: Sequence[Family]) -> tuple[Column, Score] | None:
    """Return the first score with interval, null and floor, to explain the drawings on; or None."""
    for column in (c for family in families for c in family.columns):
        for score in column.scores:
            if defined(score) and score.interval and score.null and score.floor is not None:
                return column, score
    return None
