"""What a split adds to its scores: controls and a material probe.

- ``background only``: the no-contact image in place of every tactile image. Scores of pixels reward
  it (paper, section 1); a score of touch must not;
- ``real, same material``: for each test sample a real train image of its material, what a generator
  that knows the material but not the place could reach.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from palpate.core import FeatureSet, Progress, Score, rng_for
from palpate.evaluation.companions import Features
from palpate.evaluation.inputs import Inputs, Samples
from palpate.metrics.probe import fit_probe, material_accuracy

#: Rows of the tables that are not generators.
BACKGROUND, SAME_MATERIAL, REAL = "background only", "real, same material", "real"


def control_samples(
    inputs: Inputs, size: int, seed: int, cache: Path, progress: Progress
) -> dict[str, Samples]:
    """The controls that the reference allows, as large as the generated images (``size``)."""
    real, train = inputs.reference, inputs.train
    if train is None or real.manifest is None or train.manifest is None:
        return {}
    controls: dict[str, Samples] = {}
    base = replace(real, manifest=None)
    if real.has_background:
        gel = real.pixels(size, cache, progress, "background")
        controls[BACKGROUND] = replace(base, source=BACKGROUND, images=gel)
    rows_of: dict[str, list[int]] = {}
    for row, material in enumerate(train.labels or ()):
        rows_of.setdefault(material, []).append(row)
    if real.labels and all(material in rows_of for material in real.labels):
        from palpate.data.images import load_images

        paths, chosen = train.manifest.paths("tactile"), list[Path]()
        for i, material in zip(real.ids, real.labels, strict=True):
            rows = rows_of[material]
            chosen.append(paths[rows[int(rng_for(seed, "control", i).integers(len(rows)))]])
        images = load_images(chosen, size, progress=progress)
        controls[SAME_MATERIAL] = replace(base, source=SAME_MATERIAL, images=images)
    return controls


def material_accuracies(train: FeatureSet, features: Features) -> list[Score]:
    """Accuracy of a probe fitted to the train part, on every subject and on the test part."""
    if train.labels is None or len({*train.labels} - {""}) < 2:
        return []
    probe = fit_probe(train)
    # The images of the same material are train images, which the probe was fitted to.
    controls = {n: s for n, s in features.controls.items() if n != SAME_MATERIAL}
    subjects = {**features.generators, **controls, REAL: features.reference}
    return [
        material_accuracy(train, s, probe=probe, subject=name, split=features.common["split"])
        for name, s in subjects.items()
        if s.labels is not None and any(s.labels)
    ]
