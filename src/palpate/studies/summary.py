"""From the outcome of a run to the results that a page shows: facts, gallery, notes, commands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from palpate.core import Note, Score, rng_for
from palpate.data.manifest import Manifest
from palpate.diffusion.generation import Generated
from palpate.encoders.models import is_shipped
from palpate.evaluation.controls import BACKGROUND
from palpate.report.results import Audit, GalleryItem, Results
from palpate.studies.pipeline import PipelineOutcome

#: Rows of the gallery; more would be folded away anyway.
GALLERY = 40
#: Rows a touch: its frames look alike.
PER_TOUCH = 2


def summarize(outcome: PipelineOutcome, command: str) -> Results:
    """The results of a run.

    Args:
        outcome: a finished run.
        command: the command line that reproduces it.
    """
    facts = outcome.stages
    name = str(facts["data"].facts["dataset"])
    return Results(
        title=f"From photo to touch on {name}",
        facts=headline(outcome),
        audits=outcome.audits,
        scores=outcome.scores,
        gallery=gallery(outcome.manifest, outcome.generated, outcome.options.seed),
        settings=outcome.settings(),
        notes=_notes(outcome),
        commands=[command, *_next_steps(outcome)],
    )


def headline(outcome: PipelineOutcome) -> list[str]:
    """Three sentences: the leak, the distance to real touches, what the touches still tell."""
    source = "photos and no-contact images" if outcome.options.background else "photos alone"
    distance = _distance_fact(outcome.scores, len(outcome.generated.ids), source)
    return [_leak_fact(outcome.audits), distance, _material_fact(outcome.scores, outcome.manifest)]


def _leak_fact(audits: Sequence[Audit]) -> str:
    ours = next(a for a in audits if a.name.startswith("NoLeak"))
    clean = f"NoLeak (whole {ours.group}{'s' if ours.group != 'contact' else 'es'} kept together) leaks {ours.leaked_fraction:.1%}"
    own = next((a for a in audits if not a.name.startswith("NoLeak")), None)
    seen = next((a for a in audits if a.name.endswith("seen by video")), None)
    if own is not None:
        gap = (
            f", a median of {own.gap_median:g} frames from the nearest train frame"
            if own.gap_median is not None
            else ""
        )
        return f"Leak: {own.leaked_fraction:.1%} of the test samples of the data set's own split share a video with train{gap}; {clean}."
    if seen is not None:
        return f"Leak: {clean} by {ours.group}, but {seen.leaked_fraction:.1%} of its test samples share a video with train: there are too few videos."
    return f"Leak: {clean}."


def _find(
    scores: Sequence[Score], metric: str, subject: str, preset: str | None = None
) -> Score | None:
    hits = (s for s in scores if s.metric == metric and s.subject == subject)
    return next((s for s in hits if preset is None or s.settings.get("preset") == preset), None)


def _with_interval(score: Score | None, digits: int) -> str:
    if score is None or score.value is None:
        return "undefined"
    around = (
        f" [{score.interval[0]:.{digits}f}, {score.interval[1]:.{digits}f}]"
        if score.interval
        else ""
    )
    return f"{score.value:.{digits}f}{around}"


def _distance_fact(scores: Sequence[Score], n: int, source: str) -> str:
    made, blank = (
        _find(scores, "TMMD", subject, "grouped") for subject in ("generated", BACKGROUND)
    )
    versus = f", the empty gel {_with_interval(blank, 2)}" if blank is not None else ""
    return f"Distance: {n} touches generated from {source} have TMMD (grouped) {_with_interval(made, 2)} to the real ones{versus} (lower is better)."


def _material_fact(scores: Sequence[Score], manifest: Manifest) -> str:
    made, real, blank = (
        _find(scores, "material accuracy", subject) for subject in ("generated", "real", BACKGROUND)
    )
    if made is None or real is None:
        return f"Material: {manifest.table['material'].drop_nulls().n_unique()} materials, too few for a probe."
    chance = made.details.get("chance")
    value = lambda s: "undefined" if s.value is None else f"{s.value:.1%}"  # noqa: E731
    beside = f", of the empty gel {value(blank)}" if blank is not None else ""
    beside += f"; chance is {chance:.1%}" if isinstance(chance, float) else ""
    return f"Material: a probe fitted to real train touches is right on {value(real)} of the real test touches and {value(made)} of the generated ones{beside}."


def gallery(manifest: Manifest, generated: Generated, seed: int) -> list[GalleryItem]:
    """Test samples in turn from every material, one a touch first; chosen by seed alone, not by how well they came out."""
    rows = {row["id"]: row for row in manifest.take(generated.ids).table.iter_rows(named=True)}
    order = sorted(rows, key=lambda i: rng_for(seed, "gallery", i).random())
    met: Counter[tuple[str | int | None, ...]] = Counter()
    rank: dict[str, tuple[int, int, str]] = {}
    for i in order:
        material, touch = rows[i]["material"], (rows[i]["video"], rows[i]["contact"])
        met[touch] += 1
        met[material, met[touch]] += 1
        rank[i] = (met[touch], met[material, met[touch]], str(material))
    chosen = [i for i in sorted(order, key=lambda i: rank[i]) if rank[i][0] <= PER_TOUCH][:GALLERY]
    full = lambda path: str(manifest.path(path).resolve()) if path else None  # noqa: E731
    return [
        GalleryItem(
            manifest.ref(rows[i]), str(generated.path(i).resolve()), full(rows[i]["background"])
        )
        for i in chosen
    ]


def _notes(outcome: PipelineOutcome) -> list[Note]:
    notes = [Note("synthetic-data")] if outcome.manifest.facts.get("synthetic") else []
    notes += [*_model_notes(outcome), *outcome.split.notes]
    if outcome.manifest.table["text"].null_count():
        notes.append(Note("template-texts"))
    blank = _find(outcome.scores, "material accuracy", BACKGROUND)
    chance = float(blank.details.get("chance") or 1) if blank is not None else 1.0
    if blank is not None and blank.value is not None and blank.value > 2 * chance:
        notes.append(Note("gel-names-material", {"share": blank.value}))
    if skipped := outcome.stages["data"].facts.get("skipped"):
        notes.append(Note("files-skipped", {"problems": skipped}))
    return notes


def _model_notes(outcome: PipelineOutcome) -> list[Note]:
    """Which of the models are small stand-ins, and what they have seen."""
    roles = {"clip": "the frozen vision and text encoders", "autoencoder": "the frozen autoencoder"}
    trained = [what for role, what in roles.items() if outcome.models[role] is None]
    by_name: dict[str, list[str]] = {}
    for role, what in roles.items():
        if (name := outcome.models[role]) and is_shipped(name):
            by_name.setdefault(name, []).append(what)
            if role == "clip":
                by_name[name].append("the starting weights of the tactile encoder")
    notes = [Note("models-of-this-run", {"models": trained})] if trained else []
    return notes + [Note("models-shipped", {"name": n, "models": m}) for n, m in by_name.items()]


def _next_steps(outcome: PipelineOutcome) -> list[str]:
    run = Path(outcome.stages["data"].folder).parent
    return [
        f"palpate audit {run / 'data'} --split {run / 'split' / 'noleak.json'} --worst 50",
        f"palpate generate YOUR_PHOTOS/ --model {run / 'generator' / 'model'} -o YOUR_IMAGES/",
        f"palpate score --generated YOUR_IMAGES/ --reference {run / 'data'} --split {run / 'split' / 'noleak.json'} --encoder {run / 'encoders' / 'encoders'} -o scores.json",
    ]
