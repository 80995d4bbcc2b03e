"""The last stage of a study: scores of all stages -> means over seeds, tables, samples."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpate.core import Note, Score
from palpate.diffusion.generated import Generated
from palpate.evaluation.probing import results_of
from palpate.report.labels import measured, percent
from palpate.report.results import Audit, Results
from palpate.studies.claims import effect_table, paper_claims
from palpate.studies.evidence import difference_between, in_words
from palpate.studies.files import (
    gallery,
    probing_plan,
    read_audits,
    read_probed,
    read_scores,
    splits_of,
    with_stage,
)
from palpate.studies.graph import Work
from palpate.studies.names import (
    BACKGROUND,
    FLOOR,
    GVST,
    NEAREST,
    NOLEAK,
    ORIG,
    OURS,
    SPLITS,
    VQ,
    images_node,
    scores_node,
)
from palpate.studies.stages import Facts
from palpate.studies.study_tables import FAMILY, NAMED, RETRIEVAL, Scores, study_tables

if TYPE_CHECKING:
    from palpate.studies.study import Study


def collect(
    work: Work, *, study: Study, methods: Sequence[str], seeds: Sequence[int], people: Path | None
) -> Facts:
    """Write ``results.json``: everything but the record of the run.

    ``people``: results of a human study, columns of table 3 and evidence of claims.
    """
    after, stage, audits = work.after, work.stage, read_audits(work)
    manifest, splits = splits_of(work)
    runs_of: dict[tuple[str, str], list[list[Score]]] = {
        pair: [read_scores(after[scores_node(*pair, seed)]) for seed in seeds]
        for pair in product(SPLITS, SPLITS)
    }
    judged = {pair: Scores.over_seeds(scores, stage) for pair, scores in runs_of.items()}
    runs = {s: [read_probed(after[f"probe-{s}-{seed}"]) for seed in seeds] for s in SPLITS}
    plan = probing_plan(manifest, splits)
    probed = results_of(study.title, runs, plan, manifest, splits)
    own = judged[NOLEAK, NOLEAK]
    extra = list(dict.fromkeys(s.measure for s in own.of_one if s.details.get("extra")))
    votes = [] if people is None else [*Results.load(people).scores]
    tables = [
        *study_tables(
            study,
            judged,
            probed.scores,
            methods=methods,
            controls=list(study.controls),
            extra=extra,
            people=votes,
        ),
        effect_table([d for d in own.differences if _compares(d, methods)]),
    ]
    answers = [Results.load(after[n] / "results.json") for n in ("utility",) if n in after]
    tables += [table for answer in answers for table in answer.tables]
    tasks = {**_tasks_of_encoders(probed.scores), **_tasks_of_generators(runs_of)}
    pairs = [*((OURS, m) for m in methods if m.startswith(GVST)), (VQ, BACKGROUND)]
    claims = paper_claims(own.differences, tasks=tasks, people=votes, pairs=pairs)
    claims += [claim for answer in answers for claim in answer.claims]
    images = after[images_node(study.on_both[0], NOLEAK, seeds[0])] / "images"
    notes = [*probed.notes, *([Note("synthetic-data")] if manifest.facts.get("synthetic") else [])]
    results = Results(
        title=study.title,
        facts=[_leak(audits), *_distance(own), *_material(own), *probed.facts[:1]],
        audits=audits,
        scores=own.of_one,
        gallery=[
            replace(item, method=study.on_both[0])
            for item in gallery(manifest, Generated.load(images), 0)
        ],
        settings={
            "split rule": {name: dict(s.rule) for name, s in splits.items()},
            "methods": {method.name: method.text for method in study.methods},
        },
        notes=notes,
        tables=[replace(t, rows=_staged_rows(t.rows, stage)) for t in tables],
        claims=[replace(c, evidence=[with_stage(s, stage) for s in c.evidence]) for c in claims],
    )
    results.save(work.folder / "results.json")
    if people is not None:  # ``palpate verify`` reads it again
        shutil.copyfile(people, work.folder / "people.json")
    return {"tables": len(tables), "claims": len(claims), "scores": len(results.scores)}


def _compares(difference: Score, methods: Sequence[str]) -> bool:
    """Whether a difference is of the paper's two comparisons or of the best method."""
    pair = {difference.a, difference.b}
    return pair == {VQ, BACKGROUND} or (OURS in pair and pair <= {*methods, NEAREST})


def _tasks_of_encoders(scores: Sequence[Score]) -> dict[str, Score]:
    """Task -> what it loses from the data set's own split to ours, as the encoders measure it."""
    differences = {s.measure: s for s in scores if s.b is not None}
    tasks = (NAMED, *RETRIEVAL)
    return {measured(task): differences[task] for task in tasks if task in differences}


def _tasks_of_generators(
    seeds: Mapping[tuple[str, str], Sequence[Sequence[Score]]],
) -> dict[str, Score]:
    """The same of generated images, each split judged by its encoder."""
    tasks: dict[str, Score] = {}
    for measure in FAMILY:
        each = [
            [s for run in seeds[split, split] if (s := Scores.of(run).get(measure, OURS))]
            for split in SPLITS
        ]
        if all(each):
            tasks[f"generation, {measured(measure)}"] = difference_between(*each, names=SPLITS)
    return tasks


def _staged_rows(rows: Sequence[Sequence[Any]], stage: str) -> list[list[Any]]:
    return [[with_stage(c, stage) if isinstance(c, Score) else c for c in row] for row in rows]


def _leak(audits: Sequence[Audit]) -> str:
    shares = {audit.name: percent(audit.leaked_fraction) for audit in audits}
    return (
        f"Leak: {shares[ORIG]} of the test samples of the data set's own split leak from train, "
        f"{shares[NOLEAK]} of those of NoLeak."
    )


def _distance(scores: Scores) -> list[str]:
    ours, floor, near = (scores.get(FAMILY[0], name) for name in (OURS, FLOOR, NEAREST))
    if ours is None:
        return []
    more = f", real images of other videos {in_words(floor)}" if floor else ""
    more += f", the real image of the nearest photo {in_words(near)}" if near else ""
    return [f"Distance: on new videos the images of {OURS} have TMMD {in_words(ours)}{more}."]


def _material(scores: Scores) -> list[str]:
    ours, real = scores.get(NAMED, OURS), scores.get(NAMED, "real")
    if ours is None or real is None:
        return []
    chance = percent(ours.details["chance"])
    return [
        f"Material: a probe of real train images names {percent(float(ours))} of the images of "
        f"{OURS} and {percent(float(real))} of the real ones; chance is {chance}."
    ]
