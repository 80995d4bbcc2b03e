"""Further questions of a study as stages: what generation is for, what moves it, which ruler.

Bodies of nodes, as :mod:`palpate.studies.making`; each writes tables, curves and claims as
``results.json``, which the last stage takes over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core import FeatureSet, Progress, Score
from palpate.data.images import cached_images, load_images
from palpate.data.manifest import Manifest
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.embed import embed, embed_images
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import pick_device
from palpate.encoders.rows import evenly
from palpate.report.results import Results
from palpate.report.study import Claim, Curve, StudyTable
from palpate.sim.appearance import APPEARANCES, Appearance
from palpate.sim.options import WorldOptions
from palpate.sim.photos import with_photos
from palpate.studies.appearance import AGAIN, RECORDED, appearance_claims, appearance_table, moves
from palpate.studies.controls import CEILING, EMPTY, NEAREST, nearest_rows
from palpate.studies.embedding import embed_generated
from palpate.studies.evidence import over_seeds
from palpate.studies.forty import companions_on_forty
from palpate.studies.judging import image_files
from palpate.studies.lengths import SAMPLING, compute_curves
from palpate.studies.making import (
    After,
    Facts,
    cache_of,
    control_folders,
    data_of,
    setting_of,
    slug,
)
from palpate.studies.rulers import measure_rulers, ruler_claim, ruler_scores, ruler_tables
from palpate.studies.study import NOLEAK
from palpate.studies.utility import Draws, utility, utility_claims

#: Controls whose images train a classifier: a perfect generator, retrieval, and no touch at all.
USEFUL = (CEILING, NEAREST, EMPTY)
#: Samples whose photos are shown otherwise.
MOVED = 200


def measure_utility(
    place: Path,
    after: After,
    progress: Progress,
    *,
    runs: Mapping[str, Mapping[str, str]],
    controls: Sequence[str],
    draws: Draws,
    device: str,
) -> Facts:
    """What generated images are worth for a classifier and for retrieval of real touch.

    ``runs``: node of the judge -> method -> node of its images, made for photos; one a seed.
    ``controls``: their names.
    """
    manifest, split = data_of(after, NOLEAK)
    shown = control_folders(after, NOLEAK, controls)
    made = list[tuple[list[StudyTable], Curve]]()
    for encoders, images in runs.items():
        judge = EncoderSet.load(after[encoders] / "encoders", device=device)
        folders = {name: after[node] / "images" for name, node in images.items()} | shown
        how: Facts = {"controls": [*shown], "progress": progress}
        made.append(utility(manifest, split, judge, folders, draws, **how))
    tables = [table_over_seeds(same) for same in zip(*(t for t, _ in made), strict=True)]
    curve = curve_over_seeds([curve for _, curve in made])
    return _write(place, tables, [curve], utility_claims(tables[0]))


def move_images(
    place: Path,
    after: After,
    progress: Progress,
    *,
    generator: str,
    encoders: str,
    options: WorldOptions,
    seed: int,
    device: str,
) -> Facts:
    """Features of one training's images for the same contacts, photographed otherwise."""
    manifest, split = data_of(after, NOLEAK)
    test = manifest.part(split, "test")
    test = test.take([test.ids[k] for k in evenly(len(test), MOVED)])
    judge = EncoderSet.load(after[encoders] / "encoders", device=device)
    pipeline = TactilePipeline.from_pretrained(after[generator] / "model").to(pick_device(device))
    cache, gels = cache_of(place), None
    if pipeline.background or pipeline.gel is not None:
        given = setting_of(manifest, split, place, size=pipeline.size, progress=progress)
        gels = given.pixels(test, "background")
    of = embed(test, judge, "tactile", cache=cache, still=True)
    for name in (*APPEARANCES, AGAIN):
        shown = _photographed(test, options, name, place / "photos", progress)
        photos = pipeline.embed(cached_images(shown, "vision", pipeline.vision_size))
        noise = seed + 1000 if name == AGAIN else seed
        images = pipeline.sample(photos, test.ids, seed=noise, background=gels)
        FeatureSet(
            test.ids, embed_images(images, judge), of.labels, of.groups, judge.digest("tactile")
        ).save(place / f"{slug(name)}.npz")
    return {"samples": len(test)}


def retrieve_moved(
    place: Path,
    after: After,
    progress: Progress,
    *,
    encoders: str,
    options: WorldOptions,
    clip: str,
    device: str,
) -> Facts:
    """The same of the real images of the nearest train photos: the control that has no noise."""
    manifest, split = data_of(after, NOLEAK)
    train, test = (manifest.part(split, part) for part in ("train", "test"))
    test = test.take([test.ids[k] for k in evenly(len(test), MOVED)])
    judge = EncoderSet.load(after[encoders] / "encoders", device=device)
    vision, cache = EncoderSet(load_clip(clip, device=device)), cache_of(place)
    of = embed(test, judge, "tactile", cache=cache, still=True)
    known = embed(train, judge, "tactile", cache=cache, still=True).features
    for name in APPEARANCES:
        shown = _photographed(test, options, name, place / "photos", progress)
        rows = nearest_rows(train, shown, vision, cache=cache)
        replace(of, features=known[rows]).save(place / f"{slug(name)}.npz")
    return {"samples": len(test)}


def _photographed(
    test: Manifest, options: WorldOptions, name: str, folder: Path, progress: Progress
) -> Manifest:
    """The samples with photos of another appearance."""
    if name in (RECORDED, AGAIN):
        return test
    appearance: Appearance = next(a for a in APPEARANCES if a == name)
    return with_photos(test, options, appearance, folder / slug(name), progress=progress)


def measure_moves(
    place: Path,
    after: After,
    progress: Progress,
    *,
    moved: Mapping[str, Sequence[tuple[str, str]]],
    ours: str,
    other: str,
    device: str,
) -> Facts:
    """How far images and scores move when the photo alone changes.

    ``moved``: method -> (node of the features, node of the judge), one a seed.
    """
    manifest, split = data_of(after, NOLEAK)
    train, cache = manifest.part(split, "train"), cache_of(place)
    runs: dict[str, list[Any]] = {}
    for method, nodes in moved.items():
        for node, encoders in nodes:
            judge = EncoderSet.load(after[encoders] / "encoders", device=device)
            sets = {n: FeatureSet.load(after[node] / f"{slug(n)}.npz") for n in APPEARANCES}
            noise = after[node] / f"{slug(AGAIN)}.npz"
            again = FeatureSet.load(noise) if noise.is_file() else None
            ids = sets[RECORDED].ids
            real = embed(manifest.take(ids), judge, "tactile", cache=cache, still=True)
            probed = real.labels and method != NEAREST  # a probe has seen these very images
            known = embed(train, judge, "tactile", cache=cache) if probed else None
            how: dict[str, Any] = {"train": known, "subject": method, "split": split.digest}
            runs.setdefault(method, []).append(moves(sets, again, real, **how))
    table = replace(appearance_table(runs), controls=[n for n in runs if n == NEAREST])
    return _write(place, [table], claims=appearance_claims(runs, ours, other))


def compare_rulers(
    place: Path,
    after: After,
    progress: Progress,
    *,
    rulers: Mapping[str, str],
    images: Mapping[tuple[str, int], str],
    controls: Sequence[str],
    device: str,
) -> Facts:
    """Whether encoders of other training rank the generators alike.

    One trained under the leaking split has seen test images of the other: what that does to its
    ranking is the question.

    ``rulers``: name of an encoder -> its node, or the name of a shipped one; ``images``: (method,
    seed) -> node; ``controls``: their names. They are placed in the ranking of the generators, and
    have no part in the agreement.
    """
    manifest, split = data_of(after, NOLEAK)
    loaded = {
        name: EncoderSet.load(after[of] / "encoders" if of in after else of, device=device)
        for name, of in rulers.items()
    }
    folders = {generator: after[node] / "images" for generator, node in images.items()}
    shown = control_folders(after, NOLEAK, controls)
    folders |= {(name, 0): folder for name, folder in shown.items()}
    how: Facts = {"cache": cache_of(place), "progress": progress}
    ranked = measure_rulers(loaded, folders, manifest, split, **how)
    defined = [g for g in folders if all(of[g].value is not None for of in ranked.values())]
    ranked = {name: {g: of[g] for g in defined} for name, of in ranked.items()}
    agreement = ruler_scores({n: {g: of[g] for g in images if g in of} for n, of in ranked.items()})
    tables = ruler_tables(ranked, agreement, controls=[*shown])
    return _write(place, tables, claims=[ruler_claim(agreement)])


def sample_in_steps(
    place: Path,
    after: After,
    progress: Progress,
    *,
    generator: str,
    encoders: str,
    seed: int,
    device: str,
) -> Facts:
    """Features of one training's images, made with other numbers of sampling steps."""
    manifest, split = data_of(after, NOLEAK)
    test = manifest.part(split, "test")
    test = test.take([test.ids[k] for k in evenly(len(test), MOVED)])
    judge = EncoderSet.load(after[encoders] / "encoders", device=device)
    pipeline = TactilePipeline.from_pretrained(after[generator] / "model").to(pick_device(device))
    cache, gels = cache_of(place), None
    if pipeline.background or pipeline.gel is not None:
        given = setting_of(manifest, split, place, size=pipeline.size, progress=progress)
        gels = given.pixels(test, "background")
    photos = pipeline.embed(cached_images(test, "vision", pipeline.vision_size, cache))
    of = embed(test, judge, "tactile", cache=cache, still=True)
    for done, steps in enumerate(SAMPLING):
        progress("sampling steps", done, len(SAMPLING), str(steps))
        sampler = pipeline.sampler_with(steps=steps)
        images = pipeline.sample(photos, test.ids, seed=seed, sampler=sampler, background=gels)
        replace(of, features=embed_images(images, judge)).save(place / f"{steps}.npz")
    return {"samples": len(test)}


def measure_compute(
    place: Path,
    after: After,
    progress: Progress,
    *,
    encoders: str,
    trained: Mapping[str, Mapping[int, str]],
    sampled: Mapping[str, str],
    device: str,
) -> Facts:
    """Quality against training and sampling steps.

    ``trained``: method -> training steps -> node of the images; ``sampled``: method -> node of
    :func:`sample_in_steps`.
    """
    manifest, split = data_of(after, NOLEAK)
    train, test = (manifest.part(split, part) for part in ("train", "test"))
    judge, cache = EncoderSet.load(after[encoders] / "encoders", device=device), cache_of(place)
    of_images = lambda node: embed_generated(after[node] / "images", test, judge, progress)
    curves = compute_curves(
        {m: [(n, of_images(of[n])) for n in sorted(of)] for m, of in trained.items()},
        {
            m: [(n, FeatureSet.load(after[node] / f"{n}.npz")) for n in SAMPLING]
            for m, node in sampled.items()
        },
        embed(test, judge, "tactile", cache=cache, still=True),
        embed(train, judge, "tactile", cache=cache),
        split.digest,
    )
    return _write(place, [], curves)


def compare_on_forty(
    place: Path,
    after: After,
    progress: Progress,
    *,
    runs: Sequence[Mapping[str, str]],
    controls: Sequence[str],
    clip: str,
    size: int,
    device: str,
) -> Facts:
    """Companions on forty items, as in the paper.

    ``runs``: method -> node of its images, one a seed; ``controls``: their names.
    """
    manifest, split = data_of(after, NOLEAK)
    test = manifest.part(split, "test")
    real = load_images(test.paths("tactile"), size)
    groups = [str(v or i) for i, v in zip(test.ids, test.column("video"), strict=True)]
    vision = EncoderSet(load_clip(clip, device=device))
    shown = control_folders(after, NOLEAK, controls)
    tables: list[StudyTable] = []
    for images in runs:
        folders = {name: after[node] / "images" for name, node in images.items()} | shown
        made = {n: load_images(image_files(of, test.ids), size) for n, of in folders.items()}
        tables.append(companions_on_forty(made, real, test.ids, groups, vision, name=clip))
    table = replace(table_over_seeds(tables), controls=[*shown])
    if len(runs) > 1:
        text = f"{table.text} Scores are means over {len(runs)} seeds, the sentences of the first."
        table = replace(table, text=text)
    return _write(place, [table])


def table_over_seeds(tables: Sequence[StudyTable]) -> StudyTable:
    """One table of those of several seeds; words are those of the first."""
    rows = zip(*(table.rows for table in tables), strict=True)
    return replace(tables[0], rows=[[*map(_mean, zip(*same, strict=True))] for same in rows])


def curve_over_seeds(curves: Sequence[Curve]) -> Curve:
    """One curve of those of several seeds, over the same numbers."""
    lines = [
        replace(same[0], points=[(of[0][0], over_seeds([s for _, s in of])) for of in points])
        for same in zip(*(curve.lines for curve in curves), strict=True)
        for points in [zip(*(line.points for line in same), strict=True)]
    ]
    return replace(curves[0], lines=lines)


def _mean(cells: Sequence[Score | str | None]) -> Score | str | None:
    """A cell of several seeds; none where one of them has no score."""
    scores = [cell for cell in cells if isinstance(cell, Score)]
    if len(scores) < len(cells):
        return None if scores else cells[0]
    return over_seeds(scores)


def _write(
    place: Path,
    tables: Sequence[StudyTable],
    curves: Sequence[Curve] = (),
    claims: Sequence[Claim] = (),
) -> Facts:
    Results(title="", tables=tables, curves=curves, claims=claims).save(place / "results.json")
    return {"tables": len(tables), "curves": len(curves), "claims": len(claims)}
