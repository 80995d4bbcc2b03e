"""Run folders verified: the record of every stage, and what measures made again.

The files of each stage must have the digest that its record states, and its record must name the
digests of the stages it read. Stages that train are not made again. Those that measure (splits and
their audits, probes, scores, tables) are, in a temporary folder, from the stored data, images and
encoders; whatever one of them reads of another is what was made again.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, Score, plain, quiet, read_json, short
from palpate.core.files import reading_entry
from palpate.report.results import Results
from palpate.studies.comparing import (
    Check,
    audit_numbers,
    number_difference,
    score_difference,
    score_name,
)
from palpate.studies.graph import Node, in_order
from palpate.studies.stages import Run, Stage, stage_digest, stage_of, stage_outputs

#: The stage of a study that holds its results.
LAST = "results"
#: Options of a study that name places on one machine, or do not change a number.
OF_PLACE = ("root", "methods of others", "people", "device")


@dataclass(frozen=True)
class Remade:
    """What a run folder gives now.

    Attributes:
        results: of the measurements made again; else those that the folder holds; else None.
        reason: why they could not be made again; ''  where they were.
    """

    results: Results | None
    reason: str = ""


def is_run(results: Results) -> bool:
    """Whether results are of a run folder: their settings list its stages."""
    return isinstance(results.settings.get("stages"), Mapping)


def verify_run(
    file: Path, results: Results, tolerance: float, progress: Progress = quiet
) -> tuple[list[Check], list[Score]]:
    """Check the stages next to a results file and every number of it.

    Returns:
        The checks, and the scores that are none of the run's.
    """
    folder, checks = file.absolute().parent, list[Check]()
    records = {name: _record(folder / name) for name in results.settings["stages"]}
    for name, stated in results.settings["stages"].items():
        checks.append(_stage_check(name, folder, records, stated))
    with tempfile.TemporaryDirectory() as place:
        try:
            with reading_entry(file, "The settings"):
                again = _made_again(results, folder, Path(place), progress)
        except (PalpateError, OSError) as error:
            again = Remade(_stored(folder), " ".join(str(error).split()))
        for made in sorted(Path(place).glob("*/")):
            if made.name in records:
                checks.append(_again_check(made, folder / made.name, tolerance))
    more, others = _number_checks(results, again, tolerance)
    return [*checks, *_settings_checks(results, again), *more], others


def _record(folder: Path) -> dict[str, Any]:
    """The record of a stage; empty where there is none, or it is none."""
    try:
        record = read_json(folder / "stage.json", "stage record")
    except (PalpateError, OSError):
        return {}
    return record if isinstance(record, dict) else {}


def _stage_check(
    name: str, folder: Path, records: Mapping[str, Mapping[str, Any]], stated: Any
) -> Check:
    """Whether a stage holds the files of its record, and its record says what the results say."""
    label, record = f"stage {name}", records[name]
    if not record:
        return Check(label, "cannot check", f"no record at {folder / name}", "input")
    why = _record_differs(name, records) or _files_differ(folder / name, record)
    why = why or _stated_differs(stated, record)
    return Check(label, "differs" if why else "same", why, "input")


def _record_differs(name: str, records: Mapping[str, Mapping[str, Any]]) -> str:
    """Why the record of a stage is not that of what it read."""
    record = records[name]
    inputs = record.get("inputs")
    inputs = inputs if isinstance(inputs, Mapping) else {}
    if record.get("digest") != stage_digest(name, inputs, record.get("version", 1)):
        return "its record does not have the digest of what it says it read"
    after = inputs.get("after", inputs)  # the demo has them among its inputs
    earlier = after if isinstance(after, Mapping) else {}
    for other, digest in earlier.items():
        if records.get(other) and digest != records[other].get("digest"):
            return f"it read another {other} than the one that is there"
    read = record.get("read")
    for other, outputs in (read if isinstance(read, Mapping) else {}).items():
        if records.get(other) and outputs != records[other].get("outputs"):
            return f"it read other files of {other} than those that are there"
    return ""


def _files_differ(folder: Path, record: Mapping[str, Any]) -> str:
    before, now = str(record.get("outputs")), stage_outputs(folder)
    return "" if before == now else f"files SHA-256 {short(before)} in its record, {short(now)} now"


def _stated_differs(stated: Any, record: Mapping[str, Any]) -> str:
    """Why the results were made of another stage: of another digest, or with other facts."""
    if not isinstance(stated, Mapping):
        return ""
    facts = record.get("facts")
    known = record if "outputs" in stated else facts if isinstance(facts, Mapping) else {}
    return number_difference(stated, {key: known.get(key) for key in stated}, 0.0)


def _made_again(results: Results, folder: Path, place: Path, progress: Progress) -> Remade:
    """The results of the stages that measure, built below ``place``.

    Raises:
        PalpateError: if the study is not known here, or a stage cannot be made.
    """
    if "study" in results.settings:
        settings = _make_nodes(results.settings, folder, place, progress)
        made = Results.load(place / LAST / "results.json")
        return Remade(replace(made, settings={**made.settings, **settings}))
    return Remade(_demo_again(results, folder, place, progress))


def _make_nodes(
    settings: Mapping[str, Any], folder: Path, place: Path, progress: Progress
) -> dict[str, Any]:
    """Build what measures; returns the settings that such a run records."""
    from palpate.evaluation.companions import Weights
    from palpate.studies.making import slug
    from palpate.studies.reproduce import nodes_of, plan_of, settings_of
    from palpate.studies.study import NOLEAK, STUDIES

    name = str(settings["study"])
    if name not in STUDIES:
        must = f"The study must be one of {', '.join(STUDIES)}, to be made again"
        raise PalpateError(must, repr(name), "Verify it where it is defined")
    options = settings["options"]
    images = lambda method: folder / f"images-{slug(method)}-{NOLEAK}" / "images"
    plan = plan_of(  # what was given lies in the run folder, wherever it came from
        STUDIES[name],
        preset=settings["preset"],
        seeds=settings["seeds"],
        root=options["root"] and folder / "data",
        others={method: images(method) for method in options["methods of others"]},
        people=options["people"] and folder / LAST / "people.json",
        steps=_trained_steps(folder, settings["stages"]) or options["steps of a method"],
        vq=options["vq"],
        weights=Weights(**options.get("weights", {})),
    )
    nodes = nodes_of(plan)
    _measure(nodes, folder, place, progress)
    stages = {node.name: _stage(folder / node.name) for node in nodes}
    made = settings_of(plan, stages, options["jobs"])
    options = {name: options[name] for name in OF_PLACE}
    return {**made, "options": {**made["options"], **options}}


def _trained_steps(folder: Path, names: Iterable[str]) -> int | None:
    """Steps of the first method that was trained; those that settings state may have been edited.

    The shorter trainings, whose names depend on it, come after the methods.
    """
    facts = (_record(folder / name).get("facts", {}) for name in names)
    return next((f["steps"] for f in facts if "steps" in f), None)


def _measure(
    nodes: Sequence[Node], folder: Path, place: Path, progress: Progress
) -> dict[str, Mapping[str, Any]]:
    """Build the nodes that measure below ``place``; returns their facts by name.

    Raises:
        PalpateError: if a stage that one reads is not there.
    """
    again, facts = [node for node in in_order(nodes) if node.measures], dict[str, Any]()
    for done, node in enumerate(again):
        progress("measurements made again", done, len(again), node.name)
        after = {n: (place if n in facts else folder) / n for n in node.after}
        if missing := next((n for n, f in after.items() if not f.is_dir()), None):
            raise PalpateError(f"The stage {missing} must be there", "no such folder", "")
        (place / node.name).mkdir()
        facts[node.name] = dict(node.build(place / node.name, after, quiet) or {})
    progress("measurements made again", len(again), len(again))
    return facts


def _demo_again(results: Results, folder: Path, place: Path, progress: Progress) -> Results:
    from palpate.studies.demo import DemoOptions, demo_nodes, demo_of
    from palpate.studies.demo_page import results_of

    given = dict(results.settings["options"])
    given["data"] = given["data"] and Path(given["data"])
    options = DemoOptions(**given)
    nodes = demo_nodes(options)
    facts = _measure(nodes, folder, place, progress)
    stages = {node.name: _stage(folder / node.name) for node in nodes}
    for name, made in facts.items():
        stages[name] = replace(stages[name], folder=place / name, facts=made)
    return results_of(demo_of(options, stages), "")


def _stage(folder: Path) -> Stage:
    """A finished stage.

    Raises:
        PalpateError: if there is none.
    """
    if not (record := _record(folder)):
        raise PalpateError(f"The stage {folder.name} must be there", f"no record at {folder}", "")
    return stage_of(folder, record)


def compare_splits_again(*, work: Path, progress: Progress, **arguments: Any) -> Results:
    """What :func:`palpate.studies.split_study.compare_splits` gives with encoders of ``work``.

    Raises:
        PalpateError: if one is missing.
    """
    from palpate.studies.split_study import compare_splits

    with tempfile.TemporaryDirectory() as place:
        run = _Again(Path(place), source=Path(work))
        return compare_splits(work=work, run=run, progress=progress, **arguments)


@dataclass
class _Again(Run):
    """A run whose stages are those of another folder."""

    source: Path = field(kw_only=True)

    def stage(
        self,
        name: str,
        inputs: Mapping[str, Any],
        build: Callable[[Path], Mapping[str, Any] | None],
        *,
        version: int = 1,
        read: Mapping[str, str] | None = None,
    ) -> Stage:
        """The stage of the other folder.

        Raises:
            PalpateError: if there is no such stage.
        """
        self.stages[name] = _stage(self.source / name)
        return self.stages[name]


def _stored(folder: Path) -> Results | None:
    """What the last stage of a study holds."""
    try:
        return Results.load(folder / LAST / "results.json")
    except (PalpateError, OSError):
        return None


def _again_check(made: Path, stored: Path, tolerance: float) -> Check:
    """Whether a stage that was made again holds the numbers of the stored one."""
    label, names = f"stage {made.name}, made again", [p.name for p in made.glob("*.json")]
    for name in sorted(names):
        before, after = (
            read_json(f / name, "file") if (f / name).is_file() else None for f in (stored, made)
        )
        if why := number_difference(before, after, tolerance):
            return Check(label, "differs", f"{name}: {why}", "input")
    return Check(label, "same", kind="input")


def _settings_checks(results: Results, again: Remade) -> Iterator[Check]:
    """What the run records of itself besides its stages: options, digests, versions, machine."""
    before: dict[str, Any] = dict(results.settings)
    after: dict[str, Any] = plain(again.results.settings) if again.results else {}
    for key in before | ({} if again.reason else after):
        pair = before.get(key), after.get(key)
        if key == "stages":  # each is a check of its own
            pair = sorted(pair[0] or ()), sorted(pair[1] or ())
        why = again.reason or number_difference(*pair, 0.0)
        status = "cannot check" if again.reason else "differs" if why else "same"
        yield Check(f"settings: {key}", status, why, "input")


def _number_checks(
    results: Results, again: Remade, tolerance: float
) -> tuple[list[Check], list[Score]]:
    """Every number of the results against the same place of those made again."""
    before = numbers_by_place(results)
    after = {} if again.results is None else numbers_by_place(again.results)
    stages, checks, others = results.settings["stages"], list[Check](), list[Score]()
    for name, value in before.items():
        if name not in after:
            if again.results is None:
                checks.append(Check(name, "cannot check", again.reason))
            elif isinstance(value, Score):
                others.append(value)
            else:
                checks.append(Check(name, "untraced", "no stage of the run makes it"))
            continue
        checks.append(_number_check(name, value, after[name], tolerance))
        stage = value.details.get("stage") if isinstance(value, Score) else None
        if "study" in results.settings and isinstance(value, Score) and stage not in stages:
            checks[-1] = Check(name, "untraced", f"its stage, {stage!r}, is none of the run")
        elif again.reason and checks[-1].status == "same":
            checks[-1] = Check(name, "cannot check", f"as its stage wrote it; {again.reason}")
    gone = [name for name in after if name not in before]
    return checks + [Check(name, "differs", "not in the file") for name in gone], others


def _number_check(name: str, before: Any, after: Any, tolerance: float) -> Check:
    if isinstance(before, Score) and isinstance(after, Score):
        why = score_difference(before, after, tolerance)
    else:
        why = number_difference(plain(before), plain(after), tolerance)
    return Check(name, "differs" if why else "same", why)


def numbers_by_place(results: Results) -> dict[str, Any]:
    """Every score, and everything else that a page shows, by where it stands."""
    places: dict[str, Any] = {}
    seen: Counter[str] = Counter()
    parts = _of_scores(results), _of_claims(results), _of_audits(results), _of_page(results)
    for name, value in chain(*parts):
        seen[name] += 1
        places[name if seen[name] == 1 else f"{name} ({seen[name]})"] = value
    return places


def _of_scores(results: Results) -> Iterator[tuple[str, Any]]:
    for score in results.scores:
        yield score_name(score), score
    for table in results.tables:
        for row in table.rows:
            for column, cell in zip(table.columns, row, strict=False):
                if isinstance(cell, Score):
                    yield f"{table.title}: {_label(row)}, {column}", cell
        rows = [["a score" if isinstance(cell, Score) else cell for cell in r] for r in table.rows]
        yield f"{table.title}: words", vars(table) | {"rows": rows}
    for curve in results.curves:
        lines = {line.label: [x for x, _ in line.points] for line in curve.lines}
        yield f"{curve.title}: words", vars(curve) | {"lines": lines}
        for line in curve.lines:
            yield from ((f"{curve.title}: {line.label} at {x:g}", s) for x, s in line.points)


def _of_claims(results: Results) -> Iterator[tuple[str, Any]]:
    for claim in results.claims:
        yield f"{claim.claim}: source", claim.source
        yield f"{claim.claim}: verdict", claim.verdict
        yield f"{claim.claim}: why", claim.why
        yield from ((f"{claim.claim}: {score_name(score)}", score) for score in claim.evidence)


def _of_audits(results: Results) -> Iterator[tuple[str, Any]]:
    for fact in results.facts:
        yield f"fact {fact.partition(':')[0]}", fact
    for audit in results.audits:
        yield from audit_numbers(audit, f"audit {audit.name}: ").items()


def _of_page(results: Results) -> Iterator[tuple[str, Any]]:
    yield "title", results.title
    yield "notes", results.notes
    for item in results.gallery:
        sample = item.sample
        paths = (sample.vision, sample.tactile, item.generated, item.background)
        shown = [sample.video, sample.frame, sample.material]
        yield f"gallery, {sample.id}", [*shown, *(path and Path(path).resolve() for path in paths)]


def _label(row: Sequence[Any]) -> str:
    return str(row[0]) if row and isinstance(row[0], str) else "row"
