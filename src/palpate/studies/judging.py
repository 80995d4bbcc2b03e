"""What a study measures, stage by stage: what encoders know, and how good images are.

Calls of nodes, as :mod:`palpate.studies.making`. Every score carries ``details["stage"]``, the
stage that it was made in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, Note, Score, Split
from palpate.data.images import load_images
from palpate.data.manifest import Manifest
from palpate.diffusion.generated import Generated
from palpate.encoders.embed import embed, embed_images
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.evaluation.probing import measure
from palpate.evaluation.scorers import Weights
from palpate.evaluation.scoring import score
from palpate.metrics import tmmd
from palpate.metrics.means import mean_of
from palpate.metrics.probe import fit_probe
from palpate.studies.controls import nearest_rows
from palpate.studies.files import (
    control_folders,
    data_of,
    probing_plan,
    splits_of,
    with_stage,
    write_probed,
    write_scores,
)
from palpate.studies.graph import Work
from palpate.studies.methods import Judged
from palpate.studies.names import (
    FLOOR,
    HALF_PROBES,
    HALVES,
    MATERIAL,
    MEMORIZED,
    NEAREST,
    ONE,
    OURS,
    WRONG,
)
from palpate.studies.stages import Facts
from palpate.studies.utility import picked

if TYPE_CHECKING:
    from palpate.studies.study import Preset, Study

#: Controls that are train images, which a probe of material was fitted to.
OF_TRAIN = (FLOOR, WRONG, NEAREST, ONE, MEMORIZED)
#: Readings of the TMMD family: ours, and the paper's.
READINGS = ("grouped", "paper")
SIGMA = 10.0


def probe_encoders(work: Work, *, split: str, encoders: str) -> Facts:
    """What the encoder of a split knows of its test part (tables 1 and 2, left)."""
    manifest, splits = splits_of(work)
    plan = probing_plan(manifest, splits)
    loaded = EncoderSet.load(work.after[encoders] / "encoders", device=work.device)
    probed = measure(
        manifest, splits[split], loaded, split, plan, cache=work.cache, progress=work.progress
    )
    write_probed(work, probed)
    return {"scores": len(probed.means)}


def judge_images(
    work: Work,
    *,
    study: Study,
    preset: Preset,
    split: str,
    encoders: str,
    methods: Mapping[str, str],
    seed: int,
    weights: Weights,
) -> Facts:
    """Every score of the images of a split's test part, by one encoder.

    Args:
        work: on the data, splits, images and encoders.
        study: its controls and further metrics.
        preset: size of the images, permutations of the test of TMMD, and frozen encoders.
        split: the images are of its test part.
        encoders: node of the judge.
        methods: name -> node of its images.
        seed: of the trainings.
        weights: of FID, CMMD and LPIPS as published, as far as they are given.
    """
    manifest, parts = data_of(work, split)
    judge = EncoderSet.load(work.after[encoders] / "encoders", device=work.device)
    folders = {method: work.after[node] / "images" for method, node in methods.items()}
    folders |= control_folders(work, split, [*study.controls])
    test, size = manifest.part(parts, "test"), preset.diffusion.size
    gels = not test.table["background"].null_count()
    results = score(
        list(folders.values()),
        manifest,
        encoder=judge,
        split=parts,
        train=manifest,
        names=list(folders),
        presets=READINGS,
        sigma=SIGMA,
        companions=("ssim", "psnr", *(("contact",) if gels else ()), *weights.companions),
        **vars(weights),
        controls=False,
        permutations=preset.permutations,
        allow_seen=True,  # of the encoder of another split, and by the leak that is measured
        cache=work.cache,
        progress=work.progress,
    )
    scores = [s for s in results if s.metric != MATERIAL or s.a not in OF_TRAIN]
    images = {n: load_images(image_files(f, test.ids), size) for n, f in folders.items()}
    real = load_images(test.paths("tactile"), size)
    features = embed(test, judge, "tactile", cache=work.cache, still=True)
    empty = {n: _gels_of(f, test, size) if gels else None for n, f in folders.items()}
    embedded = {
        n: replace(features, features=embed_images(x, judge, gels=empty[n]))
        for n, x in images.items()
    }
    scores = [s for s in scores if _compares(s, methods)]
    if NEAREST in embedded and features.labels is not None:
        train = manifest.part(parts, "train")
        vision = load_clip(preset.clip, device=work.device)
        rows = nearest_rows(train, test, vision, work)
        on_train = embed(train, judge, cache=work.cache)
        scores += _cross_fitted(on_train, embedded[NEAREST], features, rows, parts)
    if OURS in embedded:
        scores += _halves(embedded[OURS], preset.permutations, parts)
    for metric in study.metrics:
        for subject, x in images.items():
            one = metric(Judged(subject, x, real, embedded[subject], features, seed))
            details = {**one.details, "extra": True}  # a column of the tables
            scores.append(replace(one, a=subject, split=parts.digest, details=details))
    write_scores(work.folder, [with_stage(s, work.stage) for s in scores])
    return {"scores": len(scores), "judge": judge.digest("tactile")}


def _compares(score: Score, methods: Mapping[str, str]) -> bool:
    """Whether a score is of one subject, or the difference of a method from another subject.

    Differences between two controls say nothing of a method, those of E what those of I and CI say.
    """
    if score.b is None:
        return True
    return score.kind != "excess" and (score.a in methods or score.b in methods)


def image_files(folder: Path, ids: Sequence[str]) -> list[Path]:
    """The files of images of either kind of folder, in the order of ``ids``."""
    if (folder / "index.json").is_file():
        generated = Generated.load(folder)
        return [generated.path(i) for i in ids]
    return Manifest.load(folder).take(ids).paths("tactile")


def _gels_of(folder: Path, test: Manifest, size: int) -> NDArray[np.uint8]:
    """The no-contact images (n, size, size, 3) of a folder's own, else of the samples."""
    if not (folder / "index.json").is_file():
        own = Manifest.load(folder).take(test.ids)
        test = test if own.table["background"].null_count() else own
    return load_images(test.paths("background"), size)


def _cross_fitted(
    train: FeatureSet, images: FeatureSet, real: FeatureSet, rows: Any, split: Split
) -> list[Score]:
    """Material accuracy of the images of nearest photos, which are rows of train.

    By probes that were not fitted to them: of two halves of the train videos, each names the images
    of the other. Such a probe knows less than that of the other subjects, so it names the real
    images of the same samples as well. Samples without material do not count; no score where a half
    holds fewer than two materials.
    """
    half = _half(train)
    labels, truth = np.array(train.labels), np.array(images.labels)
    hits, labeled = np.zeros((2, len(rows))), truth != ""
    if min(len({*labels[side]} - {"", None}) for side in (half, ~half)) < 2:
        return []
    for side in (half, ~half):
        probe = fit_probe(picked(train, np.flatnonzero(side)))
        other = ~side[rows]
        for k, features in enumerate((images.features, real.features)):
            hits[k, other] = np.array(probe.predict(features[other])) == truth[other]
    text = f"By probes of half the train videos: compare with {HALF_PROBES!r}"
    groups = [*np.array(images.groups or images.ids)[labeled]]
    return [
        mean_of(
            MATERIAL,
            hit[labeled],
            groups,
            subject=name,
            split=split.digest,
            encoder=images.encoder,
            details={"chance": 1 / len({*(train.labels or ())} - {""})},
            notes=[Note("text", {"text": text})],
            estimator="mean",
        ).score
        for name, hit in zip((NEAREST, HALF_PROBES), hits, strict=True)
    ]


def _halves(features: FeatureSet, permutations: int, split: Split) -> list[Score]:
    """TMMD between the images of two halves of the test videos, of one generator."""
    half = _half(features)
    sides = (picked(features, np.flatnonzero(side)) for side in (half, ~half))
    measure = partial(tmmd, *sides, sigma=SIGMA)
    measure = partial(measure, subject=HALVES, split=split.digest, permutations=permutations)
    return [measure(preset=preset) for preset in READINGS]


def _half(features: FeatureSet) -> NDArray[np.bool_]:
    """Which rows are of every other video."""
    videos = np.array(features.groups or features.ids, dtype=str)
    return np.isin(videos, np.unique(videos)[::2])
