"""What a split adds to its scores: controls and a material probe.

- ``background only``: the no-contact image in place of every tactile image. Scores of pixels reward
  it (paper, section 1); a score of touch must not;
- ``real, same material``: for each test sample a real train image of its material, what a generator
  that knows the material but not the place could reach. Drawn image by image, it has no videos.

The floor of TMMD has them (:func:`matched_rows`): whole train videos in the place of test videos.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING

from palpate.core import FeatureSet, Score, rng_for
from palpate.data.images import load_images
from palpate.data.samples import Samples
from palpate.metrics.probe import fit_probe, material_accuracy
from palpate.report.tables import BACKGROUND, REAL, SAME_MATERIAL

if TYPE_CHECKING:
    from palpate.evaluation.scorers import Bench

#: Materials and videos of n rows, '' where unknown.
Columns = tuple[Collection[str], Collection[str]]


def matched_rows(train: Columns, test: Columns, seed: int) -> list[int] | None:
    """For each test row a row of train: *one* other video of the material stands for a test video.

    Under the names of the test videos these rows have as many frames of every material and video
    as the test part, so a statistic that leaves out pairs of one video leaves out the same ones.
    Rows drawn one by one would have no videos. Train videos that are in the test part as well stand
    for none: they would be compared with themselves.

    Args:
        train: materials and videos; a row without video is a video of its own.
        test: the same.
        seed: of the choice. No video is chosen twice for one material while there are others.

    Returns:
        A row for each test row; None where train has no other video of a material.
    """
    sources, wanted = (_by_video(*part) for part in ((*train, "train"), (*test, "test")))
    tested, rows = {video for videos in wanted.values() for video in videos}, [0] * len(test[0])
    for material, videos in wanted.items():
        key = lambda video, m=material: float(rng_for(seed, "matched", m, video).random())
        stand_ins = sorted({*sources.get(material, {})} - tested, key=key)
        if not stand_ins:
            return None
        for video, other in zip(sorted(videos), cycle(stand_ins), strict=False):
            at, frames = videos[video], sources[material][other]
            for k, row in enumerate(at):
                rows[row] = frames[k * len(frames) // len(at)]
    return rows


def _by_video(
    materials: Collection[str], videos: Collection[str], part: str
) -> dict[str, dict[str, list[int]]]:
    """Material -> video -> rows."""
    rows: dict[str, dict[str, list[int]]] = {}
    for row, (material, video) in enumerate(zip(materials, videos, strict=True)):
        rows.setdefault(material, {}).setdefault(video or f"{part} {row}", []).append(row)
    return rows


def matched_features(train: FeatureSet, test: FeatureSet, seed: int) -> FeatureSet | None:
    """Features of :func:`matched_rows` of train under ids, materials and videos of the test part.

    Materials count where both parts have them.
    """
    labeled = train.labels is not None and test.labels is not None

    def columns(part: FeatureSet) -> Columns:
        unknown = [""] * len(part.ids)
        return (part.labels if labeled and part.labels else unknown), part.groups or unknown

    rows = matched_rows(columns(train), columns(test), seed)
    if rows is None:
        return None
    return replace(test, features=train.features[rows], encoder=train.encoder)


def control_samples(bench: Bench) -> dict[str, Samples]:
    """The controls that the reference allows, as large as the generated images."""
    real, train = bench.reference, bench.train
    if train is None or real.rows is not None:
        return {}
    controls: dict[str, Samples] = {}
    if real.has_background:
        gels = bench.pixels(real, "background")
        controls[BACKGROUND] = replace(real, source=BACKGROUND, rows=gels)
    if real.labels and {*real.labels} <= {*(train.labels or ())}:
        paths = train.manifest.paths("tactile")
        chosen = [paths[row] for row in rows_of_material(bench)]
        images = load_images(chosen, bench.size, progress=bench.progress)
        controls[SAME_MATERIAL] = replace(real, source=SAME_MATERIAL, rows=images)
    return controls


def rows_of_material(bench: Bench) -> list[int]:
    """For each row of the reference a row of train of its material."""
    assert bench.train is not None
    rows_of: dict[str, list[int]] = {}
    for row, material in enumerate(bench.train.labels or ()):
        rows_of.setdefault(material, []).append(row)
    named = zip(bench.reference.ids, bench.reference.labels or (), strict=True)
    some = ((rows_of[material], rng_for(bench.seed, "control", i)) for i, material in named)
    return [rows[int(rng.integers(len(rows)))] for rows, rng in some]


def material_accuracies(bench: Bench) -> list[Score]:
    """Accuracy of a probe fitted to the train part, on every subject and on the test part."""
    train, sets = bench.train_features, bench.tactile
    if train is None or train.labels is None or len({*train.labels} - {""}) < 2:
        return []
    probe = fit_probe(train)
    # The images of the same material are train images, which the probe was fitted to.
    controls = {n: s for n, s in sets.controls.items() if n != SAME_MATERIAL}
    return [
        material_accuracy(train, s, probe=probe, subject=name, split=bench.split)
        for name, s in {**sets.generators, **controls, REAL: sets.reference}.items()
        if s.labels is not None and any(s.labels)
    ]
