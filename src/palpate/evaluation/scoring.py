"""Scores of generated tactile images, or of their embeddings: one flow for all inputs.

Everything is read (:mod:`palpate.data.samples`) and aligned by id on a bench; each score is a
function of the bench (:mod:`palpate.evaluation.scorers`, :mod:`palpate.evaluation.controls`,
:mod:`palpate.evaluation.memorization`); then notes and results.

What a source lacks is completed from the keyword ``labels`` (which also replaces what a source
has), then, for a generator, from the reference, by id. What is known of a part of the ids only is
an error: scores of some of the samples would pass for scores of all.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import polars as pl

from palpate.core import Note, PalpateError, Progress, Score, Split, quiet, require, rng_for
from palpate.core.messages import require_joined, require_rows
from palpate.data.images import decoded_once
from palpate.data.recordings import resampled_by, source_of
from palpate.data.samples import (
    SUFFIX,
    Samples,
    judged,
    labeled,
    labeled_as,
    named_sources,
    one_image,
    read_labels,
    read_samples,
    with_full_ids,
    with_recordings,
)
from palpate.data.storage import alike
from palpate.evaluation.clusters import clustered, of_clusters
from palpate.evaluation.controls import control_samples, material_accuracies
from palpate.evaluation.memorization import memorized
from palpate.evaluation.names import Name
from palpate.evaluation.scorers import (
    HANDCRAFTED,
    PAIRS,
    REFERENCE,
    Bench,
    Weights,
    bandwidths,
    choose,
    companion,
    second_opinion,
    tmmd_family,
)
from palpate.metrics.inputs import require_same_ids
from palpate.metrics.intervals import without_interval
from palpate.metrics.mmd import Preset
from palpate.report.labels import verdict_of_two
from palpate.report.records import GalleryItem
from palpate.report.results import OBJECT, PATH, Call, Results
from palpate.report.tables import BACKGROUND, REAL, SAME_MATERIAL

#: Rows of the gallery.
GALLERY = 40


def score(  # noqa: PLR0913
    generated: Any,
    reference: Any,
    *,
    encoder: Any = None,
    check_ruler: bool = False,
    split: Split | str | Path | None = None,
    names: Sequence[str] | None = None,
    labels: Any = None,
    group: str = "auto",
    background: Any = None,
    train: Any = None,
    presets: Sequence[Preset] | None = None,
    sigma: float | str | Sequence[float | str] | None = None,
    normalize: Literal["check"] | bool = "check",
    companions: Sequence[Name] | None = None,
    controls: bool = True,
    inception: str | Path | None = None,
    clip: str | Path | None = None,
    dinov2: str | Path | None = None,
    lpips: tuple[str | Path, str | Path] | None = None,
    trust_torchscript: bool = False,
    permutations: int = 999,
    seed: int = 0,
    allow_seen: bool = False,
    as_is: bool = False,
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
        check_ruler: add TMMD by ``palpate/handcrafted``, which nobody trained: a second opinion on
            what the encoder sees.
        split: a split or its file: its test part is scored, its train part gives the floor of TMMD
            (train videos matched by material), a material probe and the controls.
        names: of the generators, in the tables.
        labels: materials, and possibly groups, by id: a CSV or Parquet file with the columns id,
            material, video; id -> material; or one material per row. ``"cluster:8"`` takes eight
            clusters of the reference's photos (without photos or encoder: of its features) for
            materials, by id; a note of CI- and D-TMMD says so.
        group: what stays together in halves, intervals and tests: ``object``, ``session``,
            ``video``, ``contact``, or ``frame`` where no two samples are of one recording. ``auto``
            takes, of samples that both sides have, the coarsest level of eight units or more (with
            a split from what it kept whole on), of other samples the coarsest that the two sides do
            not share. Where nothing is known, or units are fewer, there are no intervals and no p.
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
        companions: further scores (:mod:`palpate.evaluation.scorers`); an empty list is none.
            Default: all whose inputs are there.
        controls: whether a split scores its controls.
        inception: TorchScript file of Inception, for FID and KID as published. It is a program.
        clip: folder or hub id of a CLIP, for CMMD as published.
        dinov2: folder or hub id of a DINOv2, for FD-DINOv2 as published.
        lpips: the two files of LPIPS: AlexNet's weights and the heads.
        trust_torchscript: run the code in the file of Inception, with the rights of this process.
        permutations: relabelings of the permutation test of TMMD; 0 for none.
        seed: of random halves, permutations and the choice of control images.
        allow_seen: score with an encoder that was trained on some of the reference's images; every
            score says so.
        as_is: compare images as they are stored. Else, where sides differ (PNG, JPEG of one or
            another quality), they are compared after the same lossy storage
            (:mod:`palpate.data.storage`), and scores that this moves by more than half their
            interval have both values.
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
    clusters = _cluster_count(labels)
    sigmas = (sigma,) if isinstance(sigma, int | float | str) else tuple(sigma or ())
    reserved = (REFERENCE,) if split is None else (REFERENCE, BACKGROUND, SAME_MATERIAL, REAL)
    sources = named_sources(generated, names, reserved)
    real = read_samples(reference, REFERENCE)
    files = {"inception": inception, "clip": clip, "dinov2": dinov2, "lpips": lpips}
    images = not real.embedded
    of_images = {"encoder": encoder, "cache": cache, "background": background, **files}
    for name, value in of_images.items():
        usable = images or value is None
        require(usable, name, "must go with images", "embeddings", fix="Drop it")
    second = images and encoder is not None and str(encoder) != HANDCRAFTED
    must = f"must go with images and an encoder that is not {HANDCRAFTED}"
    fix = "Pass one, e.g. palpate/mini, or drop it"
    require(second or not check_ruler, "check_ruler", must, str(encoder), fix=fix)
    bench = Bench(
        generators={name: read_samples(source, name) for name, source in sources.items()},
        reference=real if background is None else replace(real, gel=one_image(background)),
        seen=None if train is None else read_samples(train, "train"),
        weights=Weights(
            inception=inception,
            clip=clip,
            dinov2=dinov2,
            lpips=lpips,
            trust_torchscript=trust_torchscript,
        ),
        presets=tuple(dict.fromkeys(presets or ())),
        sigmas=tuple(dict.fromkeys(sigmas)),
        normalize=normalize,
        permutations=permutations,
        seed=seed,
        split=split.digest if split else None,
        progress=progress,
    )
    bench = aligned(bench, None if clusters else labels, split, group)
    fix = "Pass an encoder, or request only companions that compare pixels, e.g. ssim"
    possible = not images or encoder is not None or bool(companions)
    require(possible, "encoder", "must be given for images", "none", "palpate/mini", fix=fix)
    chosen = _companions(bench, companions, encoder=encoder is not None)
    encoders, of_encoder = None, judged(bench.reference, allow_seen=allow_seen)
    if encoder is not None:
        from palpate.encoders.guard import load_encoders

        encoders = load_encoders(encoder, progress, alone=not clusters)
    temporary = tempfile.TemporaryDirectory() if cache is None else nullcontext(cache)
    with decoded_once(), temporary as folder:
        bench = replace(bench, encoders=encoders, cache=Path(folder), keep=cache is not None)
        bench, origin = clustered(bench, clusters) if clusters else (bench, "")
        embeds = encoders is not None or not images
        learns = embeds and images and bench.train is not None
        scorers: list[Callable[[Bench], list[Score]]] = [tmmd_family] * embeds
        scorers += [second_opinion] * check_ruler
        scorers += [partial(companion, name=n, default=companions is None) for n in chosen]
        scorers += [material_accuracies] * learns
        scorers += [memorized] * (bench.seen is not None)
        stored = bench if as_is or not images else _stored_alike(bench)
        otherwise = stored is not bench
        prepared = partial(_prepared, controls=controls and learns, chosen=chosen)
        bench = prepared(bench)
        if encoders is not None:
            from palpate.encoders.guard import guard

            shown: Any = bench.reference.manifest if real.rows is None else bench.reference.rows
            of_encoder = guard(
                encoders, "tactile", shown, split=split, allow_seen=allow_seen, progress=progress
            )
        stored = prepared(stored) if otherwise else bench
        scores = [s for scorer in scorers for s in scorer(stored)]
        if otherwise:
            scores = _with_both(scores, [s for scorer in scorers for s in scorer(bench)])
        scores = of_clusters(scores, clusters, origin) if clusters else scores
        scores = scores if bench.sure else [without_interval(s) for s in scores]
        settings = _settings(bench, scores)
    if images:
        digest = settings["digests"][REFERENCE]
        scores = [replace(s, reference=digest) if s.m else s for s in scores]
    settings |= {"split rule": dict(split.rule)} if split is not None else {}
    settings |= {"encoder": str(encoder)} if encoders is not None else {}
    scores = _with_warnings(scores, stored, of_encoder)
    pair = bench.generators if len(bench.generators) == 2 and bench.sure else ()
    return Results(
        title=f"Scores of {', '.join(bench.generators)}",
        scores=sorted(scores, key=lambda s: s.b is not None),
        gallery=_gallery(bench),
        settings=settings,
        notes=[*stored.notes, *(verdict_of_two(pair, scores) if pair else ())],
        calls=[_with_names(call, bench).with_digests(_digests_read(settings))],
    )


def _prepared(bench: Bench, controls: bool, chosen: Sequence[str]) -> Bench:
    """The bench with its controls, and decoded images where pixels are compared."""
    bench = replace(bench, controls=control_samples(bench)) if controls else bench
    if any(name in PAIRS for name in chosen):
        with suppress(PalpateError):  # the score that needs them says it
            bench.pictures  # noqa: B018 - guard and ruler read them, too
    return bench


def _stored_alike(bench: Bench) -> Bench:
    """The bench with all images after the same storage; the same where it is the same already."""
    real = [s for s in (bench.reference, bench.train, bench.seen) if s is not None]
    sides = {REFERENCE: real} | {name: [s] for name, s in bench.generators.items()}
    stored, forms = alike(sides, bench.cache / "stored", bench.seed)
    if not forms:
        return bench
    note = Note("stored-otherwise", {"forms": forms, "kept": True})
    reals = iter(stored.pop(REFERENCE))
    return replace(
        bench,
        reference=next(reals),
        train=bench.train and next(reals),
        seen=bench.seen and next(reals),
        generators={name: samples for name, (samples,) in stored.items()},
        notes=[*bench.notes, note],
    )


def _with_both(scores: Sequence[Score], plain: Sequence[Score]) -> list[Score]:
    """Scores with those of the images as they are stored, where half an interval lies between."""
    both: list[Score] = []
    for s, other in zip(scores, plain, strict=True):
        half = (s.interval[1] - s.interval[0]) / 2 if s.interval else 0.0
        moved = abs(float(s) - float(other)) > half
        note = Note("as-stored", {"value": float(other)})
        both.append(replace(s, notes=[*s.notes, note]) if moved else s)
    return both


def _cluster_count(labels: Any) -> int:
    """How many clusters stand in for labels: 8 for ``cluster:8``, 0 for anything else.

    Raises:
        PalpateError: if it is no number of at least 2.
    """
    word, _, count = str(labels).partition(":") if isinstance(labels, str | Path) else ("", "", "")
    if word != "cluster":
        return 0
    must = "must be a file, or cluster: and a number of at least 2"
    several = count.isdecimal() and int(count) >= 2
    require(several, "labels", must, f"{str(labels)!r}", "cluster:8")
    return int(count)


def aligned(bench: Bench, labels: Any, split: Split | None, group: str) -> Bench:
    """The samples with what is known of each, by id; with a split, of its test part.

    Arguments as of :func:`score`. Samples that all have ids of the reference are in its order.

    Raises:
        PalpateError: if images are mixed with embeddings, or ids, labels or groups are known for a
            part of the samples only.
    """
    real, seen = bench.reference, bench.seen
    sets = [real, *bench.generators.values(), *([] if seen is None else [seen])]
    _require_one_kind(sets)
    _require_one_encoder(sets)
    table = read_labels(labels)
    listed = [] if table is None else table["id"].to_list()
    real, full = labeled(real, table), [*real.ids, *listed]
    generators = {n: labeled(with_full_ids(s, full), table) for n, s in bench.generators.items()}
    if table is not None:
        every = [i for samples in (real, *generators.values()) for i in samples.ids]
        require_joined(every, listed, "The labels")
    if real.numbered:  # row k of a generator is not row k of the reference
        real = real.with_columns(pl.Series("id", [f"{REFERENCE} {i}" for i in real.ids]))
    generators = {name: labeled_as(samples, real) for name, samples in generators.items()}
    real, *named = with_recordings([real, *generators.values()])
    generators, train = dict(zip(generators, named, strict=True)), None
    if split is not None:
        everything, (real, train) = real, _parts(real, split)
        for name, samples in generators.items():
            generators[name] = _test_part(bench, name, samples, real, everything)
        if seen is not None and not {*seen.ids}.isdisjoint(split.parts):
            seen = seen.take([i for i in seen.ids if split.parts.get(i) == "train"])
    fix = "Check the split: is its test part empty?"
    require(len(real) > 0, None, "The reference must hold samples", "none", fix=fix)
    generators = {
        name: s.take(real.ids) if {*s.ids} == {*real.ids} else s for name, s in generators.items()
    }
    bench = replace(bench, generators=generators, reference=real, train=train, seen=seen)
    return _with_groups(bench, group, str(split.rule.get("group")) if split else "")


def _with_groups(bench: Bench, requested: str, kept: str) -> Bench:
    """The samples with what stays together, and what a reader must know of it.

    Raises:
        PalpateError: on a level that is not known for all.
    """
    real, sets = bench.reference, bench.generators.values()
    paired = all({*s.ids} <= {*real.ids} for s in sets)
    tables = [s.manifest.table for s in (real, *sets)]
    group, doubt, notes = resampled_by(tables, requested, kept, paired=paired)
    if group != "frame":
        source = source_of(real.manifest, group).replace(f"{SUFFIX}`", "`")
        notes.append(Note("groups", {"level": group, "source": source}))
    bench.notes.extend([*notes, *filter(None, [doubt])])
    return replace(
        bench,
        generators={name: replace(s, group=group) for name, s in bench.generators.items()},
        reference=replace(real, group=group),
        train=bench.train and replace(bench.train, group=group),
        seen=bench.seen and replace(bench.seen, group=group),
        permutations=bench.permutations if doubt is None else 0,
        sure=doubt is None,
    )


def _require_one_kind(sets: Sequence[Samples]) -> None:
    """Raise if images are mixed with embeddings."""
    kinds = ["embeddings" if s.embedded else "images" for s in sets]
    got = ", ".join(f"{s.source} ({kind})" for s, kind in zip(sets, kinds, strict=True))
    must = "Generated, reference and train must all be images, or all embeddings"
    fix = "Embed the images first, or pass them all"
    require(len({*kinds}) == 1, None, must, got, fix=fix)


def _require_one_encoder(sets: Sequence[Samples]) -> None:
    """Raise if folders of ``palpate embed`` are not of one tactile encoder, image by image."""
    fix = "Embed both with the same encoder, the generated ones next to their reference"
    for samples in sets:
        alike = samples.made.get("features") == sets[0].made.get("features")
        must = "Folders of embeddings must be of one encoder and kind of background"
        require(alike, None, must, f"others in {samples.source}", fix=fix)
        fits = {"tactile", None} & {samples.made.get("modality")}
        fits = fits and samples.made.get("frames") != "with earlier ones"
        must = f"{samples.source} must be of tactile images, each taken alone"
        require(bool(fits), None, must, "others", fix="Embed them so: palpate embed --still")


def _parts(real: Samples, split: Split) -> tuple[Samples, Samples | None]:
    """The test part of the reference, and its train part if it has all of it."""
    must = "must go with a reference that has ids"
    require(not real.numbered, "split", must, real.source, fix="Save it with ids")
    require_joined(real.ids, split.parts, "The split")
    real.take(split.ids("test"))  # raises for missing ids
    test, train = ([i for i in real.ids if split.parts.get(i) == p] for p in ("test", "train"))
    complete = train and len(train) == len(split.ids("train"))
    return real.take(test), real.take(train) if complete else None


def _test_part(
    bench: Bench, name: str, samples: Samples, real: Samples, everything: Samples
) -> Samples:
    """The samples of the test part; all of them if the reference has none of their ids."""
    ids, wanted = {*samples.ids}, {*real.ids}
    if samples.numbered or ids.isdisjoint(everything.ids):
        return samples
    must = f"{name!r} must have every sample of the split's test part"
    fix = "Generate these too, or pass the split it was generated for"
    require_rows(samples.ids, real.ids, must, fix)
    part = samples.take([i for i in samples.ids if i in wanted])
    if skipped := len(samples) - len(part):
        params = {"name": name, "skipped": skipped, "n": len(samples)}
        bench.notes.append(Note("outside-test-part", params))
    return part


def _companions(bench: Bench, requested: Sequence[str] | None, *, encoder: bool) -> list[str]:
    """What is compared next to the TMMD family.

    Raises:
        PalpateError: on a companion whose inputs are not there; if pairs are requested where some
            images have no reference.
    """
    real, generators, notes = bench.reference, bench.generators, bench.notes
    chosen = choose(
        requested,
        bench.weights,
        images=not real.embedded,
        encoder=encoder or real.embedded,
        background=real.has_background,
    )
    if len(generators) > 1 and len({frozenset(s.ids) for s in generators.values()}) > 1:
        notes.append(Note("no-differences"))
    elif len(generators) > 1 and all(s.numbered for s in generators.values()):
        notes.append(Note("row-pairs"))
    if not {*chosen} & {*PAIRS}:
        return chosen
    if real.numbered:  # pairs by position are taken on request alone
        by_row = all(s.numbered and len(s) == len(real) for s in generators.values())
        unpaired = [] if requested is not None and by_row else [*generators]
    else:
        unpaired = [name for name, s in generators.items() if s.ids != real.ids]
        for name in unpaired if requested is not None else ():
            require_same_ids(generators[name].ids, real.ids, (name, REFERENCE))
    if unpaired:
        notes.append(Note("no-pairs", {"names": unpaired}))
    return [n for n in chosen if n not in PAIRS] if len(unpaired) == len(generators) else chosen


def _with_names(call: Call, bench: Bench) -> Call:
    """The call with the names of the generators, whatever their folders come to be called."""
    generated = call.arguments["generated"]
    if isinstance(generated, Mapping) and not {PATH, OBJECT} & {*generated}:
        return call  # a mapping has names
    return replace(call, arguments={**call.arguments, "names": [*bench.generators]})


def _digests_read(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Of everything that was read: images, or embeddings; encoder and split."""
    files: Mapping[str, Any] = settings.get("embeddings", {})
    return {**settings["digests"], **{f"rows of {n}": f["digest"] for n, f in files.items()}}


def _settings(bench: Bench, scores: Sequence[Score]) -> dict[str, Any]:
    """Digests and options, for the page and for a later comparison."""
    real, generators = bench.reference, bench.generators
    digests: dict[str, Any] = {"split": bench.split} if bench.split else {}
    digests |= {"train": bench.seen.digest} if bench.seen is not None else {}
    options: dict[str, Any] = {"group": real.group, "seed": bench.seed}
    settings: dict[str, Any] = {"digests": digests, "options": options}
    if not real.embedded:
        digests[REFERENCE] = real.digest
        digests["generated"] = {name: s.digest for name, s in generators.items()}
        sources = {n: dict(s.settings) for n, s in generators.items() if s.settings is not None}
        settings |= {"generated": sources} if sources else {}
        if bench.encoders is None:  # scores of pixels have no kernel
            return settings
        digests["tactile encoder"] = bench.encoders.digest("tactile")
    else:
        compared = next((s.reference for s in scores if s.reference), None)
        digests |= {k: v for k, v in {"encoder": real.encoder, REFERENCE: compared}.items() if v}
        settings["embeddings"] = {
            name: {"file": s.source, "rows": len(s), "digest": s.digest}
            for name, s in {**generators, REFERENCE: real}.items()
        }
    columns = bandwidths(bench, grouped=False, rows=len(real))
    options["sigma"] = list(bench.sigmas) or [sigma for _, sigma in columns]
    options |= {"permutations": bench.permutations, "normalize": bench.normalize}
    return settings


def _gallery(bench: Bench) -> list[GalleryItem]:
    """Some of the samples that are files on both sides, chosen by seed alone."""
    real, drawn = bench.reference, next(iter(bench.generators.values()))
    if real.rows is not None or drawn.rows is not None:
        return []
    rows = {row["id"]: row for row in real.manifest.table.iter_rows(named=True)}
    files = dict(zip(drawn.ids, drawn.manifest.paths("tactile"), strict=True))
    shared = sorted({*rows} & {*files}, key=lambda i: rng_for(bench.seed, "gallery", i).random())
    items: list[GalleryItem] = []
    for i in shared[:GALLERY]:
        background = rows[i]["background"]
        gel = str(real.manifest.path(background).resolve()) if background else None
        items.append(GalleryItem(real.manifest.ref(rows[i]), str(files[i].resolve()), gel))
    return items


def _with_warnings(
    scores: Sequence[Score], bench: Bench, of_encoder: Sequence[Note]
) -> list[Score]:
    """The scores with notes on the encoder, and on generators that may have seen test samples."""
    compared = (bench.tactile, bench.free) if of_encoder else ()
    digests = [s.reference.encoder for s in compared]
    of_generator = {
        name: [Note("generator-of-other-split")]
        for name, s in bench.generators.items()
        if bench.split is not None
        and s.settings is not None
        and {s.settings.get("split"), *s.settings.get("earlier_splits", ())} != {bench.split}
    }
    return [
        replace(
            s,
            notes=[
                *s.notes,
                *(of_encoder if s.encoder in digests else []),
                *of_generator.get(s.a, []),
            ],
        )
        for s in scores
    ]
