"""What a split adds to its scores: controls, a material probe, doubts about what was trained.

- ``background only``: the no-contact image in place of every tactile image. Scores of pixels reward
  it (paper, section 1); a score of touch must not;
- ``real, same material``: for each test sample a real train image of its material, what a generator
  that knows the material but not the place could reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpate.core import FeatureSet, Note, Progress, Score, Split, rng_for
from palpate.evaluation.companions import Features
from palpate.evaluation.inputs import Inputs, Samples
from palpate.metrics.probe import fit_probe, material_accuracy

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

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


def encoder_notes(encoders: Any, manifest: Manifest | None, split: Split | None) -> list[Note]:
    """What readers must know of every score that an encoder made of these images.

    That it knows simulated images alone and these are real, or may be; and, with a split, that it
    may have seen test samples (paper, section 5).
    """
    card, notes = getattr(encoders, "card", None), list[Note]()
    if card is None:
        return notes
    simulated = manifest.synthetic if manifest is not None else None
    if card.get("synthetic") and not simulated:
        notes.append(Note("synthetic-encoder", {"real": simulated is False}))
    if split is not None and card.get("split") != split.digest:
        known = card.get("split") is not None
        notes.append(Note("encoder-of-other-split" if known else "encoder-without-split"))
    return notes


def with_warnings(
    scores: Sequence[Score], inputs: Inputs, encoders: Any, split: Split | None
) -> list[Score]:
    """The scores with :func:`encoder_notes`, and of a generator that may have seen test samples."""
    digest = encoders.digest("tactile") if encoders is not None else ""
    of_encoder = encoder_notes(encoders, inputs.reference.manifest, split)
    of_generator = {
        name: [Note("generator-of-other-split")]
        for name, s in inputs.generators.items()
        if split is not None
        and s.generator is not None
        and s.generator.get("split") != split.digest
    }
    return [
        replace(
            s,
            notes=[
                *s.notes,
                *(of_encoder if s.encoder == digest else []),
                *of_generator.get(s.subject, []),
            ],
        )
        for s in scores
    ]
