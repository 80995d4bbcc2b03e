"""Scoring a folder of generated touches against the real test touches, with controls that keep the numbers honest.

Subjects, all scored by the same code on the same samples:

- ``generated``: the touches made from the test photos;
- ``background only``: the sensor's no-contact image in the place of every touch. Pairwise metrics reward it (paper,
  section 1); a metric of touch must not;
- ``real, same material``: for each test touch a real train touch of its material: what a generator that knows
  the material but not the place could reach.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from palpate.core import FeatureSet, PalpateError, Progress, Score, Split, quiet, rng_for
from palpate.data.images import load_images, read_image
from palpate.data.manifest import Manifest
from palpate.diffusion.generation import Generated
from palpate.encoders.embed import embed, embed_images
from palpate.encoders.encoder_set import EncoderSet
from palpate.evaluation.companions import (
    ON_GEL,
    Weights,
    picture_companions,
    split_off,
    standard_companions,
)
from palpate.evaluation.comparing import (
    BACKGROUND,
    REAL,
    SAME_MATERIAL,
    Asked,
    Outcome,
    against,
    compare_features,
    feature_companions,
)
from palpate.evaluation.touches import TOUCH, Wanted, files_digest, own_cache
from palpate.metrics.probe import fit_probe, material_accuracy


def score_generated(
    manifest: Manifest,
    split: Split,
    generated: Mapping[str, Generated],
    encoders: EncoderSet,
    *,
    group: str = "video",
    presets: Sequence[str] = ("grouped", "paper"),
    controls: bool = True,
    seed: int = 0,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> list[Score]:
    """Scores one or several generators on the test part of a split.

    Args:
        manifest: samples with real touches.
        split: its test part is scored, its train part feeds the material probe and a control.
        generated: name -> folder; each must hold exactly the ids of the test part.
        encoders: their tactile encoder gives the features.
        group: column whose values stay together in halves and intervals.
        presets: of the TMMD family (see :data:`palpate.metrics.PRESETS`).
        controls: score the controls as well.
        seed: of random halves and of the choice of control touches.
        cache: folder for embeddings.
        progress: told what is being done.

    Returns:
        For each subject and preset the four metrics, SSIM and PSNR, and the material accuracy of a probe trained on real touches.

    Raises:
        PalpateError: if id sets differ, images are unreadable, or there is no tactile encoder.
    """
    asked = Asked(presets=presets, seed=seed, split=split.digest)
    return compare_generated(
        manifest,
        split,
        generated,
        encoders,
        asked,
        group=group,
        controls=controls,
        companions=("ssim", "psnr"),
        cache=cache,
        progress=progress,
    ).scores


def compare_generated(
    manifest: Manifest,
    split: Split,
    generated: Mapping[str, Generated],
    encoders: EncoderSet,
    asked: Asked,
    *,
    group: str = "video",
    controls: bool = True,
    companions: Sequence[str] | None = None,
    weights: Weights | None = None,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> Outcome:
    """As :func:`score_generated`, with paired differences of the generators, and every option of the metrics.

    Args:
        manifest: samples with real touches.
        split: its test part is scored.
        generated: name -> folder; each must hold exactly the ids of the test part.
        encoders: their tactile encoder gives the features.
        asked: presets, bandwidths, seed; its split becomes this one.
        group: column whose values stay together in halves and intervals.
        controls: score the controls as well.
        companions: see :meth:`palpate.evaluation.touches.Wanted.of`.
        weights: of encoders that are not ours.
        cache: folder for embeddings.
        progress: told what is being done.

    Raises:
        PalpateError: as :func:`score_generated`, for a generator with a control's name, and for companions whose weights are missing.
    """
    asked, weights = replace(asked, split=split.digest), weights or Weights()
    test, train = manifest.part(split, "test"), manifest.part(split, "train")
    for name, folder in generated.items():
        require_same_ids(name, folder.ids, test.ids)
    if not generated:
        raise PalpateError("There must be generated touches to score", "none", "Pass --generated")
    if clash := sorted({BACKGROUND, SAME_MATERIAL, REAL} & set(generated)):
        raise PalpateError(
            "Generators must not bear the name of a control", repr(clash[0]), "Give it another name"
        )
    gel = not test.table["background"].null_count()
    wanted = Wanted.of(companions, weights, encoder=True, background=gel)
    size = read_image(next(iter(generated.values())).paths[0]).size[0]
    real = load_images(test.paths("tactile"), size, progress=progress)
    cache = None if cache is None else own_cache(cache, test, train)
    features = embed(
        test, encoders, "tactile", groups=group, cache=cache, keep_pixels=False, progress=progress
    )
    train_features = embed(
        train, encoders, "tactile", groups=group, cache=cache, keep_pixels=False, progress=progress
    )
    pictures = {
        name: load_images([folder.path(i) for i in test.ids], size, progress=progress)
        for name, folder in generated.items()
    }
    if controls:
        pictures |= _controls(test, train, size, asked.seed, progress)
    made = {
        name: replace(features, features=embed_images(v, encoders, "tactile", progress=progress))
        for name, v in pictures.items()
    }
    out, compared, groups = Outcome(), list(generated), features.groups
    for sets in split_off(made, compared):
        # What TMMD gives for real touches of other places: the train part's.
        out.add(compare_features(sets, features, asked, train=train_features, progress=progress))
    for sets in split_off(made, compared):
        out.add(
            feature_companions(
                wanted.features,
                sets,
                features,
                asked,
                what=TOUCH,
                default=wanted.default,
                progress=progress,
            )
        )
    out.add(
        standard_companions(
            wanted.standard,
            made,
            pictures,
            features,
            real,
            weights,
            asked,
            compared=compared,
            progress=progress,
        )
    )
    empty = (
        load_images(test.paths("background"), size, progress=progress)
        if gel and ON_GEL & set(wanted.pairs)
        else None
    )
    out.add(
        picture_companions(
            wanted.pairs,
            pictures,
            real,
            ids=test.ids,
            groups=groups,
            compared=compared,
            background=empty,
            weights=weights,
            split=split.digest,
            default=wanted.default,
            progress=progress,
        )
    )
    out.scores += _accuracies(train_features, features, made, split)
    noted = [
        replace(s, note=". ".join(filter(None, [s.note, *_doubts(s, split, generated, encoders)])))
        for s in out.scores
    ]
    return against(replace(out, scores=noted), files_digest(test.ids, test.paths("tactile")))


def _accuracies(
    train: FeatureSet, test: FeatureSet, made: Mapping[str, FeatureSet], split: Split
) -> list[Score]:
    """What a material probe fitted to real train touches reads from every subject, and from the real test touches."""
    if train.labels is None or len(set(train.labels) - {""}) < 2:
        return []
    probe = fit_probe(train)
    # The real touches of the same material are train touches, which the probe was fitted to.
    subjects = {name: one for name, one in made.items() if name != SAME_MATERIAL} | {REAL: test}
    return [
        material_accuracy(train, one, probe=probe, subject=name, split=split.digest)
        for name, one in subjects.items()
    ]


def _doubts(
    score: Score, split: Split, generated: Mapping[str, Generated], encoders: EncoderSet
) -> list[str]:
    """Reasons not to trust a score: an encoder or a generator that may have seen test samples (paper, section 5)."""
    found: list[str] = []
    trained = encoders.card.get("split")
    if score.encoder and trained != split.digest:
        said = "no record of its split" if trained is None else "trained on another split"
        found.append(
            f"The tactile encoder comes with {said}"
            if trained is None
            else f"The tactile encoder was {said}: it may have seen test touches"
        )
    if score.subject in generated:
        trained = generated[score.subject].settings.get("split")
        if trained != split.digest:
            found.append(
                "The generator was not trained on this split: it may have seen test samples"
            )
    return found


def require_same_ids(name: str, made: Sequence[str], wanted: Sequence[str]) -> None:
    """Refuses to score another set of ids than the test part: metrics of different samples are not comparable.

    Raises:
        PalpateError: with the number of missing and surplus ids.
    """
    missing, surplus = sorted(set(wanted) - set(made)), sorted(set(made) - set(wanted))
    if missing or surplus:
        first = f"first missing {missing[0]!r}" if missing else f"first surplus {surplus[0]!r}"
        raise PalpateError(
            f"The touches of {name!r} must be those of the test part, by id",
            f"{len(missing)} missing and {len(surplus)} surplus ids, {first}",
            "Generate for this manifest and split: palpate generate --manifest M --split S",
        )


def _controls(
    test: Manifest, train: Manifest, size: int, seed: int, progress: Progress
) -> dict[str, np.ndarray]:
    """The pictures of the control subjects that this data set allows."""
    out: dict[str, np.ndarray] = {}
    if not test.table["background"].null_count():
        out[BACKGROUND] = load_images(test.paths("background"), size, progress=progress)
    by_material: dict[str, list[str]] = {}
    for material, path in zip(train.column("material"), train.column("tactile"), strict=True):
        by_material.setdefault(material, []).append(path)
    if all(m in by_material for m in test.column("material")):
        pick = [
            by_material[m][int(rng_for(seed, "control", i).integers(len(by_material[m])))]
            for i, m in zip(test.ids, test.column("material"), strict=True)
        ]
        out[SAME_MATERIAL] = load_images([train.path(p) for p in pick], size, progress=progress)
    return out
