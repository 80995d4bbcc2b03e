"""Scores of generated tactile images, or of their embeddings: one flow for all inputs.

Read and align (:mod:`palpate.evaluation.inputs`), embed and score
(:mod:`palpate.evaluation.scoring_run`): the TMMD family (:mod:`palpate.evaluation.family`),
companions (:mod:`palpate.evaluation.companions`) and controls of a split
(:mod:`palpate.evaluation.controls`); then notes and results.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from palpate.core import Note, PalpateError, Progress, Score, Split, quiet, require, rng_for
from palpate.evaluation.companions import Chosen, Name, Outcome, Settings, Weights, choose
from palpate.evaluation.controls import BACKGROUND, REAL, SAME_MATERIAL
from palpate.evaluation.family import Family
from palpate.evaluation.guard import guard, load_encoders
from palpate.evaluation.inputs import REFERENCE, Inputs, read_inputs
from palpate.evaluation.samples import Samples
from palpate.evaluation.scoring_run import ScoringRun
from palpate.evaluation.sources import Source, read
from palpate.metrics import require_same_ids
from palpate.report.records import GalleryItem
from palpate.report.results import OBJECT, PATH, Call, Results

Preset = Literal["grouped", "paper", "paper-tables", "cmmd"]


def score(  # noqa: PLR0913
    generated: Source,
    reference: Source,
    *,
    encoder: Any = None,
    split: Split | str | Path | None = None,
    names: Sequence[str] | None = None,
    labels: Source = None,
    group: str = "auto",
    background: Source = None,
    train: Source = None,
    presets: Sequence[Preset] | None = None,
    sigma: float | str | Sequence[float | str] | None = None,
    normalize: Literal["check"] | bool = "check",
    companions: Sequence[Name] | None = None,
    controls: bool = True,
    inception: str | Path | None = None,
    clip: str | Path | None = None,
    lpips: tuple[str | Path, str | Path] | None = None,
    permutations: int = 999,
    seed: int = 0,
    allow_seen: bool = False,
    cache: str | Path | None = None,
    progress: Progress = quiet,
) -> Results:
    """Score one or several generators against real tactile images.

    Args:
        generated: what to score: a folder of images or of ``palpate generate``, a manifest, a file
            of embeddings, an array or tensor of images or features, a list of images; for several
            generators a list of these, or name -> one of these.
        reference: the real samples, of the same kind. Ids (relative file names) pair samples.
        encoder: name or folder of a set of encoders, or an ``EncoderSet``; its tactile encoder
            gives the features of images. Embeddings need none.
        split: a split or its file: its test part is scored, its train part gives the floor of TMMD
            (train videos matched by material), a material probe and the controls.
        names: of the generators, in the tables.
        labels: materials, and possibly groups, by id: a CSV or Parquet file with the columns id,
            material, video; id -> material; or one material per row. ``"cluster:8"`` takes eight
            clusters of the reference's photos (without photos or encoder: of its features) for
            materials, by id; a note of CI- and D-TMMD says so.
        group: the column whose values stay together in halves and intervals; ``auto`` takes what
            the split kept whole, else the video.
        background: one image (or its file) of the sensor without contact, for all real images: what
            contact scores need where the reference is no manifest with backgrounds.
        train: what the generator was trained on, of the same kind as the reference: adds how near
            generated images lie to it (:mod:`palpate.evaluation.memorization`). Of a manifest that
            the split knows, its train part.
        presets: readings of the TMMD family (:data:`palpate.metrics.PRESETS`). Default: ``grouped``
            and ``paper`` where groups are known; else ``paper``, but ``grouped`` for TMMD of sets
            that share ids, whose pairs of one scene are dependent.
        sigma: bandwidth or bandwidths: numbers, ``"median"``, ``"multi"``. Default: 10, which is
            comparable, and for TMMD also ``multi``, which sees more than the mean (up to 50,000
            rows).
        normalize: for embeddings that are not of unit length: raise, divide by the norm, or keep
            them.
        companions: further scores (:mod:`palpate.evaluation.companions`); an empty list is none.
            Default: all whose inputs are there.
        controls: whether a split scores its controls.
        inception: TorchScript file of Inception, for FID and KID as published.
        clip: folder or hub id of a CLIP, for CMMD as published.
        lpips: the two files of LPIPS: AlexNet's weights and the heads.
        permutations: relabelings of the permutation test of TMMD; 0 for none.
        seed: of random halves, permutations and the choice of control images.
        allow_seen: score with an encoder that was trained on some of the reference's images; every
            score says so.
        cache: folder for embeddings and decoded images, which an interrupted run finds again.
        progress: called with what is done.

    Returns:
        A table of scores: the TMMD family, companions, and paired differences between generators.

    Raises:
        PalpateError: if arguments contradict each other, inputs cannot be read, aligned or
            compared, or the encoder was trained on the reference's images.

    Example:
        >>> import numpy as np
        >>> x = np.random.default_rng(0).normal(size=(2, 40, 8))
        >>> results = score(x[0], x[1], normalize=True, companions=[])
        >>> results["TMMD", "generated"].n
        40
    """
    call = Call.of("score", score, locals())
    split = None if split is None else Split.load(split)
    labels, clusters = _clusters(labels)
    sigmas = (sigma,) if isinstance(sigma, int | float | str) else tuple(sigma or ())
    family = Family(
        presets=tuple(dict.fromkeys(presets or ())), sigmas=tuple(dict.fromkeys(sigmas))
    )
    common = Settings(
        seed=seed,
        split=split.digest if split else None,
        permutations=permutations,
        normalize=normalize,
    )
    inputs = read_inputs(
        generated,
        reference,
        names=names,
        labels=labels,
        group=group,
        background=background,
        split=split,
        reserved=(REFERENCE,) if split is None else (REFERENCE, BACKGROUND, SAME_MATERIAL, REAL),
    )
    seen = None if train is None else _train_samples(train, inputs, split)
    weights = Weights(inception=inception, clip=clip, lpips=lpips)
    images = inputs.reference.features is None
    fix = "Pass an encoder, or request only companions that compare pixels, e.g. ssim"
    possible = not images or encoder is not None or bool(companions)
    require(possible, "encoder", "must be given for images", "none", "palpate/mini", fix=fix)
    for name, value in {"encoder": encoder, "cache": cache, **vars(weights)}.items():
        require(images or not value, name, "must go with images", "embeddings", fix="Drop it")
    chosen, pairs = _companions(inputs, companions, weights, encoder)
    encoders = load_encoders(encoder, progress) if images else None
    of_encoder: list[Note] = []
    if encoders is not None:
        judged: Any = inputs.reference.manifest or inputs.reference.images
        of_encoder = guard(
            encoders, "tactile", judged, split=split, allow_seen=allow_seen, progress=progress
        )
    digest = encoders.digest("tactile") if encoders is not None else ""
    with tempfile.TemporaryDirectory() if cache is None else nullcontext(cache) as folder:
        run = ScoringRun(
            inputs=inputs,
            family=family,
            settings=common,
            encoders=encoders,
            weights=weights,
            cache=Path(folder),
            keep=cache is not None,
            progress=progress,
            seen=seen,
        )
        run, origin = run.clustered(clusters) if clusters else (run, "")
        outcome = run.score(chosen, pairs=pairs, controls=controls)
        outcome = _with_clusters(outcome, clusters, origin) if clusters else outcome
    outcome.scores = with_warnings(outcome.scores, inputs, split, digest, of_encoder)
    settings = _settings(replace(run, inputs=inputs), outcome)
    settings |= {"split rule": dict(split.rule)} if split is not None else {}
    settings |= {"encoder": str(encoder)} if encoders is not None else {}
    return Results(
        title=f"Scores of {', '.join(inputs.generators)}",
        scores=[*outcome.scores, *outcome.differences],
        gallery=_gallery(inputs, seed),
        settings=settings,
        notes=outcome.notes,
        calls=[_named(call, inputs).with_digests(_digests_read(settings))],
    )


def _train_samples(source: Source, inputs: Inputs, split: Split | None) -> Samples:
    """What the generators were trained on.

    Raises:
        PalpateError: if it is of another kind than the reference, or cannot be read.
    """
    train, real = read(source, "train"), inputs.reference
    alike = (train.features is None) == (real.features is None)
    must, fix = "must be of the kind of the reference", "Pass images with images"
    got = "embeddings" if real.features is None else "images"
    require(alike, "train", must, got, fix=fix)
    if split is not None and not {*train.ids}.isdisjoint(split.parts):
        train = train.take([i for i in train.ids if split.parts.get(i) == "train"])
    return train


def _named(call: Call, inputs: Inputs) -> Call:
    """The call with the names of the generators, whatever their folders come to be called."""
    generated = call.arguments["generated"]
    if isinstance(generated, Mapping) and not {PATH, OBJECT} & {*generated}:
        return call  # a mapping has names
    return replace(call, arguments={**call.arguments, "names": [*inputs.generators]})


def _digests_read(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Of everything that was read: images, or files of embeddings; encoder and split."""
    files: Mapping[str, Any] = settings.get("embeddings", {})
    return {**settings["digests"], **{f"rows of {n}": f["digest"] for n, f in files.items()}}


def _clusters(labels: Source) -> tuple[Source, int]:
    """Labels, and how many clusters stand in for them: ``cluster:8`` -> (None, 8)."""
    word, _, count = str(labels).partition(":") if isinstance(labels, str | Path) else ("", "", "")
    if word != "cluster":
        return labels, 0
    must = "must be a file, or cluster: and a number of at least 2"
    several = count.isdecimal() and int(count) >= 2
    require(several, "labels", must, f"{str(labels)!r}", "cluster:8")
    return None, int(count)


def _with_clusters(outcome: Outcome, clusters: int, origin: str) -> Outcome:
    """Scores that looked at classes, and their differences, say that these are clusters."""
    of_classes = {s.measure for s in outcome.scores if "classes" in s.details}
    for scores in (outcome.scores, outcome.differences):
        scores[:] = [
            replace(
                s,
                settings={**s.settings, "labels": f"cluster:{clusters} of {origin}"},
                notes=[*s.notes, Note("pseudo-labels", {"clusters": clusters, "of": origin})],
            )
            if s.measure in of_classes
            else s
            for s in scores
        ]
    return outcome


def _companions(
    inputs: Inputs, requested: Sequence[str] | None, weights: Weights, encoder: Any
) -> tuple[Chosen, bool]:
    """What is compared next to the TMMD family, and whether every image has its reference.

    Raises:
        PalpateError: on a companion whose inputs are not there; where some images have no
            reference, which is a mistake.
    """
    real, generators = inputs.reference, inputs.generators
    images = real.features is None
    chosen = choose(
        requested,
        weights,
        images=images,
        encoder=encoder is not None or not images,
        background=real.has_background,
    )
    if not chosen.pairs:
        return chosen, False
    if real.numbered:  # pairs by position are taken on request alone
        by_row = all(s.numbered and len(s) == len(real) for s in generators.values())
        return chosen, not chosen.default and by_row
    if chosen.default and not any({*s.ids} & {*real.ids} for s in generators.values()):
        return chosen, False
    for name, samples in generators.items():
        try:
            require_same_ids(samples.ids, real.ids)
        except PalpateError as error:
            fix = "Score the same samples on both sides, or request companions without pairs"
            example = {"companions": ["fid", "kid", "prdc"]}
            raise PalpateError(f"{name}: {error.must}", error.got, fix, example=example) from None
    return chosen, True


def _settings(run: ScoringRun, outcome: Outcome) -> dict[str, Any]:
    """Digests and options, for the page and for a later comparison."""
    real, generators, common = run.inputs.reference, run.inputs.generators, run.settings
    digests: dict[str, Any] = {"split": common.split} if common.split else {}
    digests |= {"train": run.seen.digest} if run.seen is not None else {}
    options: dict[str, Any] = {"group": run.inputs.group, "seed": common.seed}
    settings: dict[str, Any] = {"digests": digests, "options": options}
    if real.features is None:
        digests[REFERENCE] = real.digest
        digests["generated"] = {name: s.digest for name, s in generators.items()}
        sources = {n: dict(s.generator) for n, s in generators.items() if s.generator is not None}
        settings |= {"generated": sources} if sources else {}
        if run.encoders is None:  # scores of pixels have no kernel
            return settings
        digests["tactile encoder"] = run.encoders.digest("tactile")
    else:
        compared = next((s.reference for s in outcome.scores if s.reference), None)
        digests |= {k: v for k, v in {"encoder": real.encoder, REFERENCE: compared}.items() if v}
        settings["embeddings"] = {
            name: {"file": s.source, "rows": len(s), "digest": s.digest}
            for name, s in {**generators, REFERENCE: real}.items()
        }
    columns = run.family.columns(grouped=False, rows=len(real))
    options["sigma"] = list(run.family.sigmas) or [sigma for _, sigma in columns]
    options |= {"permutations": common.permutations, "normalize": common.normalize}
    return settings


#: Rows of the gallery.
GALLERY = 40


def _gallery(inputs: Inputs, seed: int) -> list[GalleryItem]:
    """Some of the samples that are files on both sides, chosen by seed alone."""
    real, drawn = inputs.reference.manifest, next(iter(inputs.generators.values())).manifest
    if real is None or drawn is None:
        return []
    rows = {row["id"]: row for row in real.table.iter_rows(named=True)}
    files = dict(zip(drawn.ids, drawn.paths("tactile"), strict=True))
    shared = sorted({*rows} & {*files}, key=lambda i: rng_for(seed, "gallery", i).random())
    items: list[GalleryItem] = []
    for i in shared[:GALLERY]:
        background = rows[i]["background"]
        gel = str(real.path(background).resolve()) if background else None
        items.append(GalleryItem(real.ref(rows[i]), str(files[i].resolve()), gel))
    return items


def with_warnings(
    scores: Sequence[Score],
    inputs: Inputs,
    split: Split | None,
    digest: str,
    of_encoder: Sequence[Note],
) -> list[Score]:
    """The scores with notes on the encoder, and on generators that may have seen test samples."""
    of_generator = {
        name: [Note("generator-of-other-split")]
        for name, s in inputs.generators.items()
        if split is not None
        and s.generator is not None
        and {s.generator.get("split"), *s.generator.get("earlier_splits", ())} != {split.digest}
    }
    return [
        replace(
            s,
            notes=[
                *s.notes,
                *(of_encoder if s.encoder == digest else []),
                *of_generator.get(s.a, []),
            ],
        )
        for s in scores
    ]
