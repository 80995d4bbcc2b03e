"""What a study measures, stage by stage: what encoders know, and how good images are.

Bodies of nodes, as :mod:`palpate.studies.making`. Every score carries ``details["stage"]``, the
stage that it was made in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core import FeatureSet, Note, Progress, Score, Split, read_json, write_json
from palpate.data.images import load_images
from palpate.data.manifest import Manifest
from palpate.encoders.embed import embed, embed_images
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.evaluation.companions import Weights
from palpate.evaluation.probing import Plan, Probed, measure, plan_of
from palpate.evaluation.scoring import score
from palpate.metrics import tmmd
from palpate.metrics.means import Mean, mean_of
from palpate.metrics.probe import fit_probe
from palpate.studies.controls import FLOOR, HALVES, MEMORIZED, NEAREST, ONE, WRONG, nearest_rows
from palpate.studies.making import After, Facts, cache_of, control_folders, data_of
from palpate.studies.methods import OURS
from palpate.studies.study import SPLITS, Judged, Metric

#: Controls that are train images, which a probe of material was fitted to.
OF_TRAIN = (FLOOR, WRONG, NEAREST, ONE, MEMORIZED)
#: Readings of the TMMD family: ours, and the paper's.
READINGS = ("grouped", "paper")
SIGMA = 10.0
MATERIAL = "material accuracy"
#: Real test images, named by the probes that name the images of the nearest photos.
HALF_PROBES = "real, by half probes"


def probing_plan(manifest: Manifest, splits: Mapping[str, Split]) -> Plan:
    """What encoders are probed for: the paper's material accuracy and retrieval.

    A leaking split may hold a test image in train as well: that is what is measured.
    """
    plan = Plan(top=(1, 5), allow_seen=True, axis="split", trained=True)
    return plan_of(manifest, splits, plan)


def probe_encoders(
    place: Path, after: After, progress: Progress, *, split: str, encoders: str, device: str
) -> Facts:
    """What the encoder of a split knows of its test part (tables 1 and 2, left)."""
    manifest, parts = data_of(after, split)
    splits = {name: Split.load(after["split"] / f"{name}.json") for name in SPLITS}
    plan = probing_plan(manifest, splits)
    loaded = EncoderSet.load(after[encoders] / "encoders", device=device)
    cache = cache_of(place)
    probed = measure(manifest, parts, loaded, split, plan, cache=cache, progress=progress)
    stage = stage_of(place)
    write_json(place / "scores.json", [stamped(m.score, stage).to_json() for m in probed.means])
    arrays = {}
    for k, mean in enumerate(probed.means):
        arrays |= {
            f"values{k}": mean.values,
            f"weights{k}": mean.weights,
            f"groups{k}": mean.groups,
        }
    np.savez(place / "means.npz", **arrays)
    return {"scores": len(probed.means)}


def read_probed(folder: Path) -> Probed:
    """The means that :func:`probe_encoders` wrote."""
    scores = [Score.from_json(s) for s in read_json(folder / "scores.json", "scores")]
    with np.load(folder / "means.npz") as arrays:
        parts = [[arrays[f"{name}{k}"] for name in _MEAN] for k in range(len(scores))]
    return Probed([Mean(s, *part) for s, part in zip(scores, parts, strict=True)])


_MEAN = ("values", "weights", "groups")


def read_scores(folder: Path) -> list[Score]:
    """The scores that :func:`judge_images` wrote."""
    return [Score.from_json(s) for s in read_json(folder / "scores.json", "scores")]


@dataclass(frozen=True)
class Judging:
    """What is scored, by which encoder.

    Attributes:
        split: the images are of its test part.
        encoders: node of the judge.
        methods: name -> node of its images.
        controls: names.
        metrics: further ones.
        clip: frozen encoders, of whose photos some are the nearest.
        size: side of the images in pixels.
        seed: of the trainings.
        permutations: of the permutation test of TMMD.
        weights: of FID, CMMD and LPIPS as published, as far as they are given.
    """

    split: str
    encoders: str
    methods: Mapping[str, str]
    controls: Sequence[str]
    metrics: Sequence[Metric]
    clip: str
    size: int
    seed: int
    permutations: int
    weights: Weights


def judge_images(
    place: Path, after: After, progress: Progress, *, judging: Judging, device: str
) -> Facts:
    """Every score of the images of a split's test part, by one encoder."""
    name, methods, cache = judging.split, judging.methods, cache_of(place)
    manifest, split = data_of(after, name)
    judge = EncoderSet.load(after[judging.encoders] / "encoders", device=device)
    folders = {method: after[node] / "images" for method, node in methods.items()}
    folders |= control_folders(after, name, judging.controls)
    test = manifest.part(split, "test")
    gels = not test.table["background"].null_count()
    results = score(
        list(folders.values()),
        manifest,
        encoder=judge,
        split=split,
        train=manifest,
        names=list(folders),
        presets=READINGS,
        sigma=SIGMA,
        companions=("ssim", "psnr", *(("contact",) if gels else ()), *judging.weights.companions),
        **vars(judging.weights),
        controls=False,
        permutations=judging.permutations,
        allow_seen=True,  # of the encoder of another split, and by the leak that is measured
        cache=cache,
        progress=progress,
    )
    scores = [s for s in results if s.metric != MATERIAL or s.a not in OF_TRAIN]
    images = {n: load_images(image_files(f, test.ids), judging.size) for n, f in folders.items()}
    real = load_images(test.paths("tactile"), judging.size)
    features = embed(test, judge, "tactile", cache=cache, still=True)
    made = {n: replace(features, features=embed_images(x, judge)) for n, x in images.items()}
    scores = [s for s in scores if _compares(s, methods)]
    if NEAREST in made and features.labels is not None:
        train = manifest.part(split, "train")
        vision = EncoderSet(load_clip(judging.clip, device=device))
        rows = nearest_rows(train, test, vision, cache=cache)
        scores += _cross_fitted(
            embed(train, judge, cache=cache), made[NEAREST], features, rows, split
        )
    if OURS in made:
        scores += _halves(made[OURS], judging.permutations, split)
    for metric in judging.metrics:
        for subject, x in images.items():
            judged = Judged(subject, x, real, made[subject], features, judging.seed)
            one = metric(judged)
            details = {**one.details, "extra": True}  # a column of the tables
            scores.append(replace(one, a=subject, split=split.digest, details=details))
    write_json(place / "scores.json", [stamped(s, stage_of(place)).to_json() for s in scores])
    return {"scores": len(scores), "judge": judge.digest("tactile")}


def stage_of(place: Path) -> str:
    """The name of the stage that is built in a folder."""
    return place.name.removesuffix(".partial")


def stamped(score: Score, stage: str) -> Score:
    """The score with the name of the stage that it was made in."""
    return replace(score, details={**score.details, "stage": stage})


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
        from palpate.diffusion.generation import Generated

        generated = Generated.load(folder)
        return [generated.path(i) for i in ids]
    return Manifest.load(folder).take(ids).paths("tactile")


def _cross_fitted(
    train: FeatureSet, images: FeatureSet, real: FeatureSet, rows: Any, split: Split
) -> list[Score]:
    """Material accuracy of the images of nearest photos, which are rows of train.

    By probes that were not fitted to them: of two halves of the train videos, each names the images
    of the other. Such a probe knows less than that of the other subjects, so it names the real
    images of the same samples as well. Samples without material do not count; no score where a half
    holds fewer than two materials.
    """
    videos = np.array(train.groups or train.ids, dtype=str)
    names = np.unique(videos)
    half = np.isin(videos, names[::2])
    labels, truth = np.array(train.labels), np.array(images.labels)
    hits, known = np.zeros((2, len(rows))), truth != ""
    if min(len({*labels[side]} - {"", None}) for side in (half, ~half)) < 2:
        return []
    for side in (half, ~half):
        ids = [i for i, inside in zip(train.ids, side, strict=True) if inside]
        probe = fit_probe(train.take(ids))
        other = ~side[rows]
        for k, of in enumerate((images, real)):
            hits[k, other] = np.array(probe.predict(of.features[other])) == truth[other]
    chance = 1 / len({*(train.labels or ())} - {""})
    text = f"By probes of half the train videos: compare with {HALF_PROBES!r}"
    fields: dict[str, Any] = {
        "split": split.digest,
        "encoder": images.encoder,
        "details": {"chance": chance},
        "notes": [Note("text", {"text": text})],
        "estimator": "mean",
    }
    groups = [*np.array(images.groups or images.ids)[known]]
    return [
        mean_of(MATERIAL, of[known], groups, subject=name, **fields).score
        for name, of in zip((NEAREST, HALF_PROBES), hits, strict=True)
    ]


def _halves(features: FeatureSet, permutations: int, split: Split) -> list[Score]:
    """TMMD between the images of two halves of the test videos, of one generator."""
    groups = np.array(features.groups or features.ids, dtype=str)
    first = np.isin(groups, np.unique(groups)[::2])
    halves = [
        features.take([i for i, inside in zip(features.ids, side, strict=True) if inside])
        for side in (first, ~first)
    ]
    how: dict[str, Any] = {"subject": HALVES, "split": split.digest, "permutations": permutations}
    return [tmmd(*halves, preset=preset, sigma=SIGMA, **how) for preset in READINGS]
