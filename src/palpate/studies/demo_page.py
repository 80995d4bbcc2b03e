"""From a finished run of the demo to the results of a page: facts, gallery, notes, commands."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from palpate.core import Measure, Note, Score, rng_for
from palpate.data.manifest import Manifest
from palpate.diffusion.generation import Generated
from palpate.evaluation.controls import BACKGROUND
from palpate.report.families import families
from palpate.report.numbers import number, percent
from palpate.report.results import GalleryItem, Results
from palpate.studies.demo import NEAREST, DemoRun
from palpate.studies.methods import SHIPPED

#: Rows of the gallery; further ones would be collapsed.
GALLERY = 40
#: Rows per contact, whose frames are nearly equal.
PER_CONTACT = 2


def results_of(run: DemoRun, command: str) -> Results:
    """The results of a run; ``command`` is the command line that reproduces it."""
    return Results(
        title="From photo to tactile image",
        facts=[_leak_fact(run), _distance_fact(run), _material_fact(run)],
        audits=run.audits,
        scores=run.scores,
        gallery=gallery(run.manifest, run.generated, run.options.seed),
        settings=run.settings(),
        notes=_notes(run),
        commands=[command, *_next_steps(run)],
    )


def _leak_fact(run: DemoRun) -> str:
    audits = {(a.split == run.split.digest, a.group): a for a in run.audits}
    noleak = audits[True, str(run.split.rule["group"])]
    by_video = audits.get((True, "video"), noleak)
    original = next((a for (ours, _), a in audits.items() if not ours), None)
    fact = f"NoLeak (whole {noleak.group}s kept together) leaks {percent(noleak.leaked_fraction)}"
    if original is not None:
        gap = ""
        if original.gap_median is not None:
            gap = f", a median of {original.gap_median:g} frames from the nearest train frame"
        share = (
            f"{percent(original.leaked_fraction)} of the test samples of the data set's own split"
        )
        return f"Leak: {share} share a video with train{gap}; {fact}."
    if by_video is not noleak:
        share = f"{percent(by_video.leaked_fraction)} of its test samples share a video with train"
        return f"Leak: {fact} by {noleak.group}, but {share}: there are too few videos."
    return f"Leak: {fact}."


def _score(run: DemoRun, metric: str, subject: str, preset: str | None = None) -> Score | None:
    for s in run.scores:
        same = (s.measure, s.a, s.b) == (Measure(metric), subject, None)
        if same and s.settings.get("preset") == preset:
            return s
    return None


def _with_interval(run: DemoRun, score: Score | None) -> str:
    """The score and its interval, rounded as in the tables."""
    if score is None or score.value is None:
        return "undefined"
    columns = (column for family in families(run.scores) for column in family.columns)
    digits = next(c.digits for c in columns if any(s is score for s in c.scores))
    low_high = ", ".join(number(v, digits) for v in score.interval or ())
    return number(score.value, digits) + (f" [{low_high}]" if low_high else "")


def _distance_fact(run: DemoRun) -> str:
    given = run.stages["generator"].facts["background"]
    source = "photos and no-contact images" if given else "photos alone"
    background = _score(run, "TMMD", BACKGROUND, "grouped")
    versus = (
        f", the no-contact image {_with_interval(run, background)}"
        if background is not None
        else ""
    )
    value = _with_interval(run, _score(run, "TMMD", "generated", "grouped"))
    start = f"Distance: {len(run.generated.ids)} tactile images generated from {source}"
    return f"{start} have TMMD (grouped) {value} to the real ones{versus} (lower is better)."


def _material_fact(run: DemoRun) -> str:
    generated, real, nearest, background = (
        _score(run, "material accuracy", name)
        for name in ("generated", "real", NEAREST, BACKGROUND)
    )
    if generated is None or real is None:
        materials = run.manifest.table["material"].drop_nulls().n_unique()
        return f"Material: {materials} materials, too few for a probe."
    more = f", {percent(float(nearest))} of those of the nearest photo" if nearest else ""
    more += f", {percent(float(background))} of the no-contact image" if background else ""
    more += f"; chance is {percent(generated.details['chance'])}"
    start = "Material: a probe fitted to real train images is right on"
    shares = f"{percent(float(real))} of the real test images"
    shares += f", {percent(float(generated))} of the generated ones"
    return f"{start} {shares}{more}."


def gallery(manifest: Manifest, generated: Generated, seed: int) -> list[GalleryItem]:
    """Test samples in turn from every material, one per contact first; chosen by seed alone."""
    rows = {row["id"]: row for row in manifest.take(generated.ids).table.iter_rows(named=True)}
    order = sorted(rows, key=lambda i: rng_for(seed, "gallery", i).random())
    # Rank: n-th sample of its contact, n-th such sample of its material, material.
    counts: Counter[tuple[str | int | None, ...]] = Counter()
    rank: dict[str, tuple[int, int, str]] = {}
    for i in order:
        material, contact = rows[i]["material"], (rows[i]["video"], rows[i]["contact"])
        counts[contact] += 1
        counts[material, counts[contact]] += 1
        rank[i] = (counts[contact], counts[material, counts[contact]], str(material))
    order = [i for i in sorted(order, key=lambda i: rank[i]) if rank[i][0] <= PER_CONTACT]
    items: list[GalleryItem] = []
    for i in order[:GALLERY]:
        background = rows[i]["background"]
        path = str(manifest.path(background).resolve()) if background else None
        items.append(GalleryItem(manifest.ref(rows[i]), str(generated.path(i).resolve()), path))
    return items


def _notes(run: DemoRun) -> list[Note]:
    notes = [Note("synthetic-data")] if run.manifest.facts.get("synthetic") else []
    notes.append(Note("models-shipped", {"name": SHIPPED}))
    notes += run.split.notes
    if run.manifest.table["text"].null_count():
        notes.append(Note("template-texts"))
    background = _score(run, "material accuracy", BACKGROUND)
    if background is not None and float(background) > 2 * background.details["chance"]:
        notes.append(Note("background-predicts-material", {"share": background.value}))
    return notes


def _next_steps(run: DemoRun) -> list[str]:
    folder = Path(run.stages["data"].folder).parent
    data, split = folder / "data", folder / "split" / "noleak.json"
    model, encoders = folder / "generator" / "model", folder / "encoders" / "encoders"
    return [
        f"palpate audit {data} --split {split} --worst 50",
        f"palpate generate YOUR_PHOTOS/ --model {model} -o YOUR_IMAGES/",
        f"palpate score --generated YOUR_IMAGES/ --reference {data} --split {split} "
        f"--encoder {encoders} -o scores.json",
    ]
