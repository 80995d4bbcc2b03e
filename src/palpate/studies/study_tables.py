"""The paper's tables in our shape, from the scores of finished stages.

Rows are splits, methods and controls, columns are tasks and metrics. A cell is the mean over seeds
with its interval over videos and seeds. The paper's own numbers are words, not scores: nobody can
compute them again. They stand beside ours where the data are the paper's; elsewhere the text says
which way they point.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from palpate.core import Measure, Score
from palpate.preference.scoring import PREFERENCE, STRENGTH
from palpate.report.labels import measured
from palpate.report.records import StudyTable
from palpate.studies.evidence import over_seeds
from palpate.studies.names import (
    FLOOR,
    GVST,
    HALF_PROBES,
    HALVES,
    MATERIAL,
    NOLEAK,
    ORIG,
    OURS,
    SPLITS,
)

if TYPE_CHECKING:
    from palpate.studies.study import Study

#: Scores by (split of the images, split of the judge): means over seeds.
Judgments = Mapping[tuple[str, str], "Scores"]
Cell = Score | str | None
FAMILY = tuple(map(Measure, ("TMMD", "I-TMMD", "CI-TMMD", "D-TMMD")))
RETRIEVAL = tuple(
    Measure(f"top-{k}", f"{name} by tactile") for name in ("text", "vision") for k in (1, 5)
)
NAMED = Measure(MATERIAL)


def _printed(columns: Sequence[Measure], numbers: str) -> Mapping[Measure, str]:
    """Numbers as the paper prints them; a share ends in %."""
    return dict(zip(columns, numbers.replace("%", " %").split("  "), strict=True))


_SPLIT_1, _SPLIT_2 = (NAMED, *FAMILY), (*RETRIEVAL, *FAMILY[:2])
_PIXELS = (Measure("SSIM"), Measure("PSNR"))
_PHOTOS = (Measure("LPIPS"), Measure("FID", "Inception"), Measure("CMMD", "CLIP"))
_METHOD = (*_PIXELS, *_PHOTOS, *FAMILY)
#: What the paper prints: (table, row) -> column -> number. Table 4 of DIGIT is "HCT".
PAPER: Mapping[tuple[int | str, str], Mapping[Measure, str]] = {
    (1, ORIG): _printed(_SPLIT_1, "54.7%  0.33  0.04  0.21  0.06"),
    (1, NOLEAK): _printed(_SPLIT_1, "37.8%  1.37  0.15  1.43  0.44"),
    (2, ORIG): _printed(_SPLIT_2, "36.7%  70.3%  79.5%  95.7%  0.46  0.13"),
    (2, NOLEAK): _printed(_SPLIT_2, "4.1%  17.4%  7.9%  27.4%  2.12  0.39"),
    (3, OURS): _printed(_METHOD, "0.49  15.5  0.53  43.9  2.52  1.37  0.15  1.43  0.44"),
    (3, "GVST"): _printed(_METHOD, "0.49  15.4  0.51  43.6  2.49  1.98  0.77  2.97  0.92"),
    (3, "Ours w/ BG"): _printed(_METHOD, "0.54  16.0  0.43  46.9  2.44  2.39  1.24  5.33  1.40"),
    ("HCT", OURS): _printed(FAMILY[:2], "2.12  0.39"),
    ("HCT", "GVST"): _printed(FAMILY[:2], "2.67  0.61"),
}


@dataclass(frozen=True)
class Scores:
    """Scores by what they are of, in the order of their making.

    Tables show our reading of the TMMD family; the paper's is kept aside.
    """

    by_name: Mapping[Key, Score]

    @classmethod
    def of(cls, scores: Iterable[Score]) -> Scores:
        """The scores of one run."""
        paper = lambda score: score.settings.get("preset") == "paper"
        return cls({(s.measure, s.a, s.b, paper(s)): s for s in scores})

    @classmethod
    def over_seeds(cls, seeds: Sequence[Sequence[Score]], stage: str) -> Scores:
        """The means of what each seed scores; a score that a seed lacks is left out."""
        tables = [cls.of(scores).by_name for scores in seeds]
        merged: dict[Key, Score] = {}
        for key in tables[0]:
            if not all(key in table for table in tables):
                continue
            each = [table[key] for table in tables]
            floors = [s.floor for s in each if s.floor is not None]
            floor = sum(floors) / len(floors) if len(floors) == len(each) else None
            mean, stages = over_seeds(each), [s.details["stage"] for s in each]
            details = {**mean.details, "stage": stage, "of": stages}
            merged[key] = replace(mean, floor=floor, details=details)
        return cls(merged)

    def get(self, measure: Measure, subject: str) -> Score | None:
        """One score, or None."""
        return self.by_name.get((measure, subject, None, False))

    @property
    def differences(self) -> list[Score]:
        """All differences of two subjects, in our reading."""
        return [s for (_, _, b, paper), s in self.by_name.items() if b is not None and not paper]

    @property
    def of_one(self) -> list[Score]:
        """All scores of one subject each: without differences."""
        return [score for score in self.by_name.values() if score.b is None]


#: What is measured, of what, compared with what, and whether it is the paper's reading.
Key = tuple[Measure, str, str | None, bool]


def study_tables(
    study: Study,
    judged: Judgments,
    probed: Sequence[Score],
    *,
    methods: Sequence[str],
    controls: Sequence[str],
    extra: Sequence[Measure] = (),
    people: Sequence[Score] = (),
) -> list[StudyTable]:
    """The tables of a study.

    Args:
        study: which tables it makes, and whether the paper's numbers stand beside.
        judged: see :data:`Judgments`.
        probed: what the encoder of each split, the score's ``a``, scores on its test part.
        methods: compared on the split without leaks, in their order.
        controls: that were scored.
        extra: further metrics.
        people: scores of ``palpate preference score``, columns of table 3.
    """
    make = {1: _of_splits, 2: _of_splits, 3: _of_methods, 4: _of_methods}
    asked = [s for s in people if s.metric in (PREFERENCE, STRENGTH) and s.b is None]
    votes = {(s.measure, s.a): s for s in asked}
    subjects = [*controls, HALF_PROBES, HALVES]
    context = _Context(study, judged, Scores.of(probed), methods, subjects, extra, votes)
    return [make[number](context, number) for number in study.tables]


@dataclass(frozen=True)
class _Context:
    study: Study
    judged: Judgments
    probed: Scores
    methods: Sequence[str]
    controls: Sequence[str]
    extra: Sequence[Measure]
    people: Mapping[tuple[Measure, str], Score]

    def present(self, split: str, names: Iterable[str]) -> list[str]:
        """Those that are scored on a split."""
        scored = {score.a for score in self.judged[split, split].of_one}
        return [name for name in names if name in scored]


def _of_splits(context: _Context, number: int) -> StudyTable:
    """Tables 1 and 2: what the encoders know, and how far the images of each split are."""
    tasks = (NAMED,) if number == 1 else RETRIEVAL
    heads = [f"{measured(task)}, real images" for task in tasks]
    family = FAMILY if number == 1 else FAMILY[:2]
    rows: list[list[Cell]] = []
    controls: list[str] = []
    for split in SPLITS:
        crossed = [(e, (OURS, FLOOR)) for e in SPLITS if e != split]
        named = [*context.study.on_both, *context.controls]
        for judge, names in [(split, named), *crossed]:
            for name in context.present(split, names):
                label = f"{name}, {split}"
                knows = judge == split and name == OURS
                tasked = [context.probed.get(t, split) if knows else None for t in tasks]
                cells = [context.judged[split, judge].get(m, name) for m in family]
                if not any(cells):  # scored by other metrics alone
                    continue
                rows.append([label, judge, *tasked, *cells])
                if name in context.controls:
                    controls.append(label)
        if context.study.paper:
            printed = PAPER[number, split]
            rows.append([f"paper, {split}", split, *(printed.get(k) for k in (*tasks, *family))])
            controls.append(f"paper, {split}")
    text = (
        "Encoder and generator are trained once for each split; each encoder judges the images of "
        "both generators. The floor of TMMD is real train images of other videos, matched by "
        "material (none where a split leaks every video); of I-, CI- and D-TMMD it is the real "
        "test images themselves. The paper: without leaks every column is worse."
    )
    names = {1: "material and generation", 2: "retrieval and generation"}
    columns = ["images", "judged by encoder of", *heads, *map(measured, family)]
    title = f"Table {number}: {names[number]} by split"
    return StudyTable(title, text, columns, rows, controls=[*dict.fromkeys(controls)])


def _of_methods(context: _Context, number: int) -> StudyTable:
    """Tables 3 and 4: methods and controls on the split without leaks, by metric."""
    scores, methods = context.judged[NOLEAK, NOLEAK], context.methods
    make = {method.name: method.make for method in context.study.methods}
    metrics = [*FAMILY]
    if number == 3:
        photos = {measure.metric for measure in _PHOTOS}
        of_photos = dict.fromkeys(s.measure for s in scores.of_one if s.metric in photos)
        metrics = [*_PIXELS, *of_photos, *FAMILY, NAMED, *context.extra]
    else:  # prior art, and other people's
        methods = [m for m in methods if m == OURS or m.startswith(GVST) or m not in make]
    subjects = context.present(NOLEAK, [*methods, *context.controls])
    metrics = [m for m in metrics if any(scores.get(m, s) for s in subjects)]
    subjects = [s for s in subjects if any(scores.get(m, s) for m in metrics)]
    cells = {(m, s): scores.get(m, s) for m in metrics for s in subjects}
    if number == 3:
        cells |= context.people
        metrics += dict.fromkeys(m for m, s in context.people if s in subjects)
    rows: list[list[Cell]] = [[s, *(cells.get((m, s)) for m in metrics)] for s in subjects]
    controls = [s for s in subjects if s in context.controls]
    if context.study.paper:
        for name in ("GVST", OURS, *(("Ours w/ BG",) if number == 3 else ())):
            printed = PAPER["HCT" if 2 in context.study.tables else 3, name]
            rows.append([f"paper, {name}", *map(printed.get, metrics)])
            controls.append(f"paper, {name}")
    # Which are not trained as ours are.
    apart = [s for s in subjects if s not in controls and make.get(s, s) is not None]
    text = (
        f"All methods{' but ' * bool(apart)}{' and '.join(apart)} are trained from random "
        "weights for the same number of steps. Controls are no generators: a metric that ranks "
        "one of them first rewards something else than touch. "
    )
    text += {
        3: "The autoencoder of Ours, VQ and Ours w/ BG is not given the gel, as in the paper. The "
        "paper: TMMD and its relatives rank Ours before GVST before Ours w/ BG; "
        "SSIM, PSNR, LPIPS and CMMD prefer Ours w/ BG.",
        4: "The paper: Ours before GVST in every column.",
    }[number]
    title = {3: "Table 3: methods by metric", 4: "Table 4: against prior art"}[number]
    return StudyTable(
        title, text, ["images", *map(measured, metrics)], rows, best=True, controls=controls
    )
