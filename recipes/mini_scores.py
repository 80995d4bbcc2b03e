"""What the shipped models can do, measured on worlds that they have not seen; the rows of their
cards.

Intervals are leave-one-video-out jackknives. No caption names a material, so a class is asked for
in the zero-shot rows by captions of its contacts in the world that the encoders were trained on:
:data:`PROMPTS` different ones, evenly over that world. The probe's train side is every fourth
sample of that world, its test side the new world.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import FeatureSet, Measure, Progress, Score, Split, digest_json
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import AnyAutoencoder, BackgroundAutoencoder
from palpate.diffusion.ceiling import measure_reconstruction
from palpate.diffusion.gels import gels_of
from palpate.diffusion.generation import generate
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.embed import embed, embed_images, embed_texts, texts_of
from palpate.encoders.encoder_set import EncoderSet
from palpate.evaluation.scoring import score
from palpate.metrics import tmmd
from palpate.metrics.means import mean_of
from palpate.metrics.probe import material_accuracy
from palpate.metrics.retrieval import retrieval, standardized
from palpate.report.labels import measured

#: Touches generated for the generator's scores, evenly over the new world.
GENERATED = 400
#: Samples that retrieval chooses among.
POOL = 100
#: Of the train side, for the probe.
EVERY = 4
#: Captions of the train side that stand for a material.
PROMPTS = 200

Rows = list[dict[str, Any]]


def prefixed(manifest: Manifest, prefix: str) -> Manifest:
    """The samples under other names, to be joined with those of another world."""
    names = (pl.col(n) for n in ("id", "video", "contact", "object"))
    table = manifest.table.with_columns((prefix + name).name.keep() for name in names)
    return replace(manifest, table=table)


def score_all(
    encoders: EncoderSet,
    autoencoder: AnyAutoencoder,
    pipeline: TactilePipeline,
    worlds: Mapping[str, Manifest],
    cache: Path,
    progress: Progress,
) -> dict[str, Rows]:
    """Rows of scores by model: ``encoders``, ``autoencoder``, ``generator``.

    ``worlds`` are ``gelsight``, ``new gelsight``, ``new digit``, ``new gel``, ``new pad`` and
    ``new look``.
    """
    both = worlds["gelsight"], worlds["new gelsight"]
    return {
        "encoders": score_encoders(encoders, worlds, cache, progress),
        "autoencoder": score_autoencoder(autoencoder, worlds, cache, progress),
        "generator": score_generator(pipeline, encoders, *both, cache, progress),
    }


def prompts(manifest: Manifest) -> dict[str, list[str]]:
    """Material -> up to PROMPTS different captions of it, evenly over the manifest."""
    captions: dict[str, dict[str, None]] = {}
    for material, text in manifest.table.select("material", "text").iter_rows():
        captions.setdefault(material, {})[text] = None
    return {
        material: list(texts)[:: math.ceil(len(texts) / PROMPTS)]
        for material, texts in captions.items()
    }


def zero_shot_accuracy(
    images: FeatureSet, prompts: Mapping[str, Sequence[str]], encoders: EncoderSet
) -> Score:
    """Accuracy of naming the class of images by text alone (Radford et al. 2021, 3.1).

    The embeddings t of a class's texts, each of length 1, make its prototype
    ``p_c = mean(t) / ||mean(t)||``; the image embedding v gets the class with the largest v.p_c.

    Args:
        images: embeddings of one encoder (n, d) with labels and groups.
        prompts: class -> at least one text; every label must be a class.
        encoders: whose text encoder embeds the prompts.
    """
    classes = sorted(prompts)
    embedded = (embed_texts(prompts[c], encoders).astype(np.float64) for c in classes)
    means = np.stack([rows.mean(axis=0) for rows in embedded])
    prototypes = means / np.linalg.norm(means, axis=1, keepdims=True)
    chosen = (images.features.astype(np.float64) @ prototypes.T).argmax(axis=1)
    labels = images.labels or ()
    hit = np.array([classes[k] == label for k, label in zip(chosen, labels, strict=True)], float)
    units = list(images.groups if images.groups is not None else images.ids)
    details = {"chance": 1 / len(classes)}
    name = "zero-shot accuracy"
    return mean_of(name, hit, units, subject="real", encoder=images.encoder, details=details).score


def score_encoders(
    encoders: EncoderSet, worlds: Mapping[str, Manifest], cache: Path, progress: Progress
) -> Rows:
    """Zero-shot and probe accuracy and retrieval in the new world, and probes on other gels."""
    old, new = worlds["gelsight"], worlds["new gelsight"]
    words = prompts(old)
    train = old.take(old.ids[::EVERY])
    sides = {
        t: [embed(part, encoders, t, cache=cache, progress=progress) for part in (train, new)]
        for t in ("vision", "tactile")
    }
    vision = sides["vision"][1]
    numbers = embed(new, encoders, "tactile", raw=True, cache=cache, progress=progress)
    tactile = replace(numbers, features=encoders.shared(numbers.features))
    text = embed(new, encoders, "text", cache=cache, progress=progress)
    captions = embed_texts(texts_of(new)[0], encoders)
    scores = [
        ("zero-shot material, vision", zero_shot_accuracy(vision, words, encoders)),
        ("zero-shot material, tactile", zero_shot_accuracy(tactile, words, encoders)),
        ("linear probe of material, vision", material_accuracy(*sides["vision"])),
        ("linear probe of material, tactile", material_accuracy(*sides["tactile"])),
    ]
    pairs = (
        ("photo to text", vision, text, captions),  # equal captions count as right
        ("text to photo", text, vision, captions),
        ("photo to tactile", vision, tactile, None),
    )
    for name, queries, keys, texts in pairs:
        result, _ = retrieval(queries, keys, top=(1, 5), pool=POOL, texts=texts)
        scores += [
            (f"{name}, top-{k} of {POOL}", mean.score)
            for k, mean in zip((1, 5), result.top, strict=True)
        ]
    rows = [_row(name, score, len(new)) for name, score in scores]
    return [*rows, *_score_gels(encoders, worlds, cache, progress)]


def _score_gels(
    encoders: EncoderSet, worlds: Mapping[str, Manifest], cache: Path, progress: Progress
) -> Rows:
    """Probe accuracy within worlds of other gels, from one half of the objects to the other."""
    rows: Rows = []
    for name, short in (("pad of 14 mm", "gel"), ("pad of 26 mm", "pad"), ("DIGIT", "look")):
        world = worlds[f"new {short}"]
        features = embed(world, encoders, "tactile", cache=cache, progress=progress)
        chosen = {o for k, o in enumerate(sorted({*world.column("object")})) if k % 2}
        objects = zip(world.ids, world.column("object"), strict=True)
        halves: dict[bool, list[str]] = {True: [], False: []}
        for i, o in objects:
            halves[o in chosen].append(i)
        accuracy = material_accuracy(*(features.take(half) for half in halves.values()))
        row = f"linear probe of material, tactile, {name}"
        rows.append(_row(row, accuracy, len(halves[False])))
    return rows


def score_autoencoder(
    autoencoder: AnyAutoencoder, worlds: Mapping[str, Manifest], cache: Path, progress: Progress
) -> Rows:
    """Reconstruction of tactile images of new videos on gels that training has not seen."""
    rows: Rows = []
    for look, name in (("gelsight", "new gelsight"), ("digit", "new digit")):
        images = cached_images(worlds[name], "tactile", 64, cache, progress)
        result = measure_reconstruction(autoencoder, images, gels_of(worlds[name], 64, cache))
        rows += [
            {"score": f"{what}, {look}", "value": value, "n": result.n}
            for what, value in (("PSNR [dB]", result.psnr), ("SSIM", result.ssim))
        ]
    return rows


def score_generator(
    pipeline: TactilePipeline,
    encoders: EncoderSet,
    old: Manifest,
    new: Manifest,
    cache: Path,
    progress: Progress,
) -> Rows:
    """TMMD, material accuracy and the pairwise metrics of images for photos of the new world, with
    controls.
    """
    step = max(1, len(new) // GENERATED)
    test, train = new.take(new.ids[::step]), old.take(old.ids[::EVERY])
    joined = Manifest.join(prefixed(train, "train/"), test)
    split = Split.from_ids(
        train=[f"train/{i}" for i in train.ids],
        test=test.ids,
        rule={"name": "old and new world"},
        manifest=joined.digest,
    )
    generated = generate(
        joined.part(split, "test"),
        model=pipeline,
        output=cache / f"generated-{digest_json([pipeline.digest, pipeline.sampler])[:12]}",
        seed=0,
        progress=progress,
    )
    scores = score(
        generated.folder,
        joined,
        encoder=encoders,
        split=split,
        names=["generated"],
        presets=("grouped",),
        companions=("ssim", "psnr"),
        cache=cache,
        progress=progress,
    )
    kept = tuple(map(Measure, ("TMMD", "material accuracy", "SSIM", "PSNR")))
    rows = [
        _row(f"{measured(s)}, {s.a}", s, s.n)
        for s in scores
        if s.measure in kept and s.b is None and s.value is not None
    ]
    known, real = (
        embed(part, encoders, "tactile", raw=True, cache=cache) for part in (train, test)
    )
    gels, ids = gels_of(test, pipeline.size, cache), test.ids
    texts = embed(test, encoders, "text", cache=cache).features
    others = {
        "reconstructed": _reconstructed(pipeline, test, gels, cache),
        "generated from captions": pipeline.sample(
            None, ids, seed=0, texts=texts, background=gels if pipeline.background else None
        ),
    }
    numbers = [
        embed_images(images, encoders, gels=gels, raw=True, progress=progress)
        for images in others.values()
    ]
    # As `score` does it.
    sets, _ = standardized([known.features, real.features, *numbers], real.features)
    known, real = replace(known, features=sets[0]), replace(real, features=sets[1])
    for subject, features in zip(others, sets[2:], strict=True):
        made = FeatureSet(ids, features, real.labels, real.groups, real.encoder)
        rows += [
            _row(f"TMMD, {subject}", tmmd(made, real, preset="grouped"), len(ids)),
            _row(f"material accuracy, {subject}", material_accuracy(known, made), len(ids)),
        ]
    return rows


def _reconstructed(
    pipeline: TactilePipeline, test: Manifest, gels: NDArray[np.uint8], cache: Path
) -> NDArray[np.uint8]:
    """Real images through the autoencoder: what the generator could reach at best."""
    images = np.asarray(cached_images(test, "tactile", pipeline.size, cache))
    code = pipeline.autoencoder
    if isinstance(code, BackgroundAutoencoder):
        return code.decode(code.encode(images, gels), gels)
    return code.decode(code.encode(images))


def _row(name: str, score: Score, n: int) -> dict[str, Any]:
    row: dict[str, Any] = {"score": name, "value": score.value, "n": n}
    if score.interval is not None:
        row["interval"] = list(score.interval)
    if "chance" in score.details:
        row["chance"] = score.details["chance"]
    return row
