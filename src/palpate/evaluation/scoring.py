"""Scores of generated tactile images, or of their embeddings: one flow for all inputs.

Read and align (:mod:`palpate.evaluation.inputs`), embed, the TMMD family (TMMD, I-, CI- and D-TMMD:
distances of feature sets, of halves, within and between classes), companions
(:mod:`palpate.evaluation.companions`), controls of a split (:mod:`palpate.evaluation.controls`),
notes, results. Scores of one metric with another bandwidth say so as their ``kernel``, so that no
two of them share a column.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from palpate.core import FeatureSet, Note, PalpateError, Progress, Score, Split, quiet, rng_for
from palpate.evaluation.companions import (
    MANY,
    Chosen,
    Features,
    Name,
    Outcome,
    Pairs,
    Weights,
    choose,
    score_features,
    score_pairs,
)
from palpate.evaluation.controls import (
    BACKGROUND,
    REAL,
    SAME_MATERIAL,
    control_samples,
    matched_features,
    material_accuracies,
)
from palpate.evaluation.guard import guard, load_encoders
from palpate.evaluation.inputs import REFERENCE, Inputs, from_reference, read_inputs
from palpate.evaluation.memorization import FEATURES, PIXELS, contact_rows, memorization
from palpate.evaluation.samples import Samples
from palpate.evaluation.sources import Source, read
from palpate.metrics import compare, compare_tmmd, require_same_ids, tmmd
from palpate.report.calls import OBJECT, PATH, Call
from palpate.report.labels import measured
from palpate.report.results import GalleryItem, Results

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

#: Bandwidth of the paper; scores name any other one as their kernel where several are requested.
SIGMA = 10.0


@dataclass(frozen=True, kw_only=True)
class Family:
    """How the TMMD family is computed.

    Attributes:
        presets: empty for those that fit the groups.
        sigmas: bandwidths; empty for the default.
        options: permutations, normalize; the companion ``cmmd`` takes them as well.
        common: seed and digest of the split, for all metrics.
    """

    presets: Sequence[str]
    sigmas: Sequence[float | str]
    options: Mapping[str, Any]
    common: Mapping[str, Any]

    def columns(self, *, grouped: bool, rows: int) -> list[tuple[str | None, float | str]]:
        """(preset, bandwidth) of each column; None is the preset that fits the ids of a metric.

        Of bandwidths that nobody requested, ``multi`` is for TMMD alone, of the first preset.
        """
        presets: Sequence[str | None] = self.presets or (
            ("grouped", "paper") if grouped else (None,)
        )
        columns: list[tuple[str | None, float | str]]
        columns = [(p, s) for p in presets for s in self.sigmas or (SIGMA,)]
        return columns + [(presets[0], "multi")] * (not self.sigmas and rows <= MANY)

    def named(self, score: Score, sigma: float | str) -> Score:
        """A score that names an unusual bandwidth."""
        if len(self.sigmas) == 1 or sigma == SIGMA:
            return score
        return replace(score, kernel=f"σ {sigma}" if isinstance(sigma, str) else f"σ = {sigma:g}")


def score_family(
    features: Features, family: Family, *, train: FeatureSet | None, progress: Progress = quiet
) -> Outcome:
    """TMMD, I-, CI- and D-TMMD of every set by preset and bandwidth, with paired differences.

    The floor of TMMD is that of features of ``train``, whole videos in the place of the reference's
    (:func:`palpate.evaluation.controls.matched_rows`): the pairs of one video that are left out on
    one side are then left out on the other. The floor of the others is of the reference itself.
    """
    sets = {**features.generators, **features.controls}
    grouped = [s.groups is not None for s in (features.reference, *sets.values())]
    floor = features.reference if len(set(grouped)) == 1 else None
    columns = family.columns(grouped=all(grouped), rows=features.rows)
    further = train and matched_features(train, features.reference, family.common["seed"])
    outcome = Outcome()
    if not family.sigmas and features.rows > MANY:
        outcome.notes.append(Note("wide-sigma-alone", {"rows": MANY}))
    for done, (preset, sigma) in enumerate(columns):
        options: dict[str, Any] = {
            **features.family,
            **features.common,
            "preset": preset,
            "sigma": sigma,
        }
        least = None
        if further is not None:
            fast: dict[str, Any] = {**options, "permutations": 0}
            least = tmmd(further, features.reference, **fast).value
        for some in features.batches():
            if sigma in (family.sigmas or (SIGMA,)):
                result = compare(some, features.reference, floor=floor, **options)
            else:
                result = compare_tmmd(some, features.reference, **options)
            scores = [replace(s, floor=least) if s.metric == "TMMD" else s for s in result.scores]
            outcome.differences += [family.named(s, sigma) for s in result.differences]
            for s in scores:
                outcome.scores.append(named := family.named(s, sigma))
                if s.kind == "excess" and s.floor and s.interval and s.interval[1] < s.floor:
                    params = {"metric": measured(named), "subject": s.a}
                    outcome.notes.append(Note("below-floor", params))
        progress("TMMD family", done + 1, len(columns))
    return outcome


Preset = Literal["grouped", "paper", "paper-tables", "cmmd"]
#: Rows of the gallery.
GALLERY = 40


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
        presets=tuple(dict.fromkeys(presets or ())),
        sigmas=tuple(dict.fromkeys(sigmas)),
        options={"permutations": permutations, "normalize": normalize},
        common={"seed": seed, "split": split.digest if split else None},
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
    if images:
        if encoder is None and not companions:
            fix = "Pass an encoder, or request only companions that compare pixels, e.g. ssim"
            example = {"encoder": "palpate/mini"}
            got, must = "none", "must be given for images"
            raise PalpateError(must, got, fix, argument="encoder", example=example)
    elif used := [n for n, v in {"encoder": encoder, "cache": cache, **vars(weights)}.items() if v]:
        raise PalpateError("must go with images", "embeddings", "Drop it", argument=used[0])
    chosen, pairs = _companions(inputs, companions, weights, encoder)
    encoders = load_encoders(encoder, progress) if images else None
    of_encoder: list[Note] = []
    if encoders is not None:
        judged: Any = inputs.reference.manifest or inputs.reference.images
        how: dict[str, Any] = {"split": split, "allow_seen": allow_seen, "progress": progress}
        of_encoder = guard(encoders, "tactile", judged, **how)
    digest = encoders.digest("tactile") if encoders is not None else ""
    with tempfile.TemporaryDirectory() if cache is None else nullcontext(cache) as folder:
        run = _Run(
            inputs, family, encoders, weights, Path(folder), cache is not None, progress, seen
        )
        run, of = run.clustered(clusters) if clusters else (run, "")
        outcome = run.score(chosen, pairs=pairs, controls=controls)
        outcome = _with_clusters(outcome, clusters, of) if clusters else outcome
    outcome.scores = with_warnings(outcome.scores, inputs, split, digest, of_encoder)
    settings = _settings(inputs, family, outcome, encoders, seen)
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
    if (train.features is None) != (real.features is None):
        must, fix = "must be of the kind of the reference", "Pass images with images"
        got = "embeddings" if real.features is None else "images"
        raise PalpateError(must, got, fix, argument="train")
    if split is not None and not {*train.ids}.isdisjoint(split.parts):
        train = train.take([i for i in train.ids if split.parts.get(i) == "train"])
    return train


def _named(call: Call, inputs: Inputs) -> Call:
    """The call with the names of the generators, whatever their folders come to be called."""
    made = call.arguments["generated"]
    if isinstance(made, Mapping) and not {PATH, OBJECT} & {*made}:
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
    if not count.isdecimal() or int(count) < 2:
        must = "must be a file, or cluster: and a number of at least 2"
        example = {"labels": "cluster:8"}
        raise PalpateError(must, repr(str(labels)), "", argument="labels", example=example)
    return None, int(count)


def _with_clusters(outcome: Outcome, clusters: int, of: str) -> Outcome:
    """Scores that looked at classes, and their differences, say that these are clusters."""
    of_classes = {s.measure for s in outcome.scores if "classes" in s.details}
    for scores in (outcome.scores, outcome.differences):
        scores[:] = [
            replace(
                s,
                settings={**s.settings, "labels": f"cluster:{clusters} of {of}"},
                notes=[*s.notes, Note("pseudo-labels", {"clusters": clusters, "of": of})],
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
    real, made = inputs.reference, inputs.generators
    images, background = real.features is None, real.has_background
    able = {"images": images, "encoder": encoder is not None or not images}
    chosen = choose(requested, weights, **able, background=background)
    if not chosen.pairs:
        return chosen, False
    if real.numbered:  # pairs by position are taken on request alone
        by_row = all(s.numbered and len(s) == len(real) for s in made.values())
        return chosen, not chosen.default and by_row
    if chosen.default and not any({*s.ids} & {*real.ids} for s in made.values()):
        return chosen, False
    for name, samples in made.items():
        try:
            require_same_ids(samples.ids, real.ids)
        except PalpateError as error:
            fix = "Score the same samples on both sides, or request companions without pairs"
            example = {"companions": ["fid", "kid", "prdc"]}
            raise PalpateError(f"{name}: {error.must}", error.got, fix, example=example) from None
    return chosen, True


@dataclass(frozen=True)
class _Run:
    """One call of :func:`score`."""

    inputs: Inputs
    family: Family
    encoders: Any
    weights: Weights
    cache: Path
    keep: bool
    progress: Progress
    seen: Samples | None = None

    def score(self, chosen: Chosen, *, pairs: bool, controls: bool) -> Outcome:
        """Everything that is scored."""
        real, made = self.inputs.reference, self.inputs.generators
        images = real.features is None
        encoder = self.encoders is not None or not images
        controls = controls and encoder and images and self.inputs.train is not None
        extra: dict[str, Samples] = {}
        if controls:
            size, seed = self._size(), self.family.common["seed"]
            extra = control_samples(self.inputs, size, seed, self.cache, self.progress)
        numbered = all(s.numbered for s in made.values())
        paired = not numbered or len({len(s) for s in made.values()}) == 1  # by id, or by row
        reference = self._features(real)
        train = self._features(self.inputs.train) if self.inputs.train and encoder else None
        features = Features(
            {name: self._features(s) for name, s in made.items()},
            {name: self._features(s) for name, s in extra.items()},
            reference,
            paired,
            "tactile" if images else "embeddings",
            self.family.common,
            self.family.options,
        )
        outcome = Outcome(notes=list(self.inputs.notes))
        if numbered and len(made) > 1:
            outcome.notes.append(Note("row-pairs" if paired else "no-differences"))
        if encoder:
            outcome.add(score_family(features, self.family, train=train, progress=self.progress))
            outcome.add(score_features(chosen.features, features, chosen.default))
        if chosen.standard or pairs:
            outcome.add(self._score_pixels(chosen, features, extra, pairs=pairs))
        if chosen.pairs and not pairs:
            outcome.notes.append(Note("no-pairs"))
        if images and train is not None:
            outcome.scores += material_accuracies(train, features)
        if self.seen is not None:
            outcome.scores += self._memorization(self.seen)
        if images:
            digest = real.digest
            for scores in (outcome.scores, outcome.differences):
                scores[:] = [replace(s, reference=digest) if s.m else s for s in scores]
        return outcome

    def clustered(self, count: int) -> tuple[_Run, str]:
        """The same samples with clusters of the reference for labels, and what was clustered.

        Photos say more of a material than touch does, and no generator is judged by its own.

        Raises:
            PalpateError: with too few samples, or generators of other ids.
        """
        from scipy.cluster.vq import kmeans2

        real, seed = self.inputs.reference, self.family.common["seed"]
        manifest = real.manifest
        photos = manifest is not None and not manifest.table["vision"].null_count()
        if self.encoders is not None and manifest is not None and photos:
            from palpate.encoders.embed import embed

            options: dict[str, Any] = {"progress": self.progress}
            x, of = embed(manifest, self.encoders, "vision", **options).features, "photos"
        elif self.encoders is not None or real.features is not None:
            x, of = self._features(real).features, "the reference's features"
        else:
            fix, example = "Pass an encoder", {"encoder": "palpate/mini"}
            must, got = "must be a file where there are no features", "clusters"
            raise PalpateError(must, got, fix, argument="labels", example=example)
        rows = np.asarray(x, np.float64)
        distinct = np.unique(rows, axis=0)
        if len(distinct) < 4 * count:
            got = f"{count} of {len(distinct)} different samples"
            must = "must leave four samples a cluster"
            raise PalpateError(must, got, "Choose fewer", argument="labels")
        first = distinct[rng_for(seed, "clusters").choice(len(distinct), count, replace=False)]
        number = kmeans2(rows, first, iter=100, minit="matrix")[1]
        real = replace(real, labels=[f"cluster {k + 1}" for k in number])
        made = {
            name: from_reference(replace(s, labels=None), real)
            for name, s in self.inputs.generators.items()
        }
        if other := next((s for s in made.values() if s.labels is None), None):
            must = "must be a file where generated and real images share no ids"
            raise PalpateError(must, f"clusters for {other.source}", "", argument="labels")
        train = self.inputs.train and replace(self.inputs.train, labels=None)
        inputs = replace(self.inputs, generators=made, reference=real, train=train)
        return replace(self, inputs=inputs), of

    def _memorization(self, train: Samples) -> list[Score]:
        """How near each generator's images lie to its train images, in every space there is."""
        real, made = self.inputs.reference, self.inputs.generators
        split, scores = self.family.common["split"], list[Score]()
        if self.encoders is not None or real.features is not None:
            test, base = self._features(real), self._features(train)
            for name, samples in made.items():
                x = self._features(samples)
                scores += memorization(x, test, base, space=FEATURES, subject=name, split=split)
        if real.features is not None:
            return scores
        train = replace(train, background=train.background or real.background)
        paired = all({*samples.ids} <= {*real.ids} for samples in made.values())
        gels = real.has_background and train.has_background and paired
        seen = train.pixels(self._size(), self.cache, self.progress)
        mean = None if gels else np.mean(seen, axis=0, dtype=np.float64)
        settings = {"ground": "no-contact images" if gels else "mean train image"}
        base = self._contact_rows(train, train, mean)
        test = self._contact_rows(real, real, mean)
        for name, samples in made.items():
            x = self._contact_rows(samples, real, mean)
            how: dict[str, Any] = {"subject": name, "split": split, "settings": settings}
            scores += memorization(x, test, base, space=PIXELS, **how)
        return scores

    def _contact_rows(self, samples: Samples, real: Samples, mean: Any) -> FeatureSet:
        """Pixels without what is there before contact: no-contact images of ``real``, or a mean."""
        size = self._size()
        images = samples.pixels(size, self.cache, self.progress)
        if mean is None:
            known = real if samples is real else real.take(samples.ids)
            mean = known.pixels(size, self.cache, self.progress, "background")
        return samples.feature_set(contact_rows(images, mean), None)

    def _features(self, samples: Samples) -> FeatureSet:
        """Features by the tactile encoder; without one, zeros that carry ids, labels and groups."""
        if samples.features is not None:
            return samples.feature_set(samples.features, samples.encoder)
        if self.encoders is None:
            return samples.feature_set(np.zeros((len(samples), 1), np.float32), None)
        from palpate.encoders.embed import embed, embed_images

        digest = self.encoders.digest("tactile")
        if samples.images is not None:
            x = embed_images(samples.images, self.encoders, "tactile", progress=self.progress)
            return samples.feature_set(x, digest)
        folder = samples.folder(self.cache) if self.keep else None
        # Generated images have no earlier frame, so none is taken for real ones.
        options: dict[str, Any] = {"still": True, "progress": self.progress}
        x = embed(self._in_context(samples), self.encoders, "tactile", cache=folder, **options)
        return samples.feature_set(x.features, digest)

    def _in_context(self, samples: Samples) -> Manifest:
        """The images with what is known of the reference's sample of the same id: its sensor, and
        its no-contact image.
        """
        import polars as pl

        real, manifest = self.inputs.reference.manifest, samples.manifest
        assert manifest is not None
        needy = self.encoders.preprocess("tactile").subtract or self.encoders.origin("tactile")
        if real is None or not needy or "sensor" in manifest.filled().columns:
            return manifest
        gels = [gel and str(real.path(gel).resolve()) for gel in real.column("background")]
        context = real.table.select("id", "sensor", pl.Series("background", gels, pl.String))
        table = manifest.table.drop("sensor", "background").join(context, "id", "left")
        return replace(manifest, table=table.select(manifest.table.columns))

    def _size(self) -> int:
        """The side of the generated images, the same for all generators."""
        sizes = {name: samples.side for name, samples in self.inputs.generators.items()}
        if len(set(sizes.values())) > 1:
            got = ", ".join(f"{name} {size}" for name, size in sizes.items())
            fix = "Resize them, or request companions without pixels"
            example = {"companions": ["fid", "kid", "prdc"]}
            must = "Generators must have images of one size for scores of pixels"
            raise PalpateError(must, got, fix, example=example)
        return next(iter(sizes.values()))

    def _score_pixels(
        self, chosen: Chosen, features: Features, controls: Mapping[str, Samples], *, pairs: bool
    ) -> Outcome:
        """Companions of standard encoders and of pairs of images, all at the generators' size."""
        real, made, outcome = self.inputs.reference, self.inputs.generators, Outcome()
        subjects, size = {**made, **controls}, self._size()
        if pairs and not real.numbered:
            subjects = {name: samples.take(real.ids) for name, samples in subjects.items()}
        images = {n: s.pixels(size, self.cache, self.progress) for n, s in subjects.items()}
        reference = real.pixels(size, self.cache, self.progress)
        if real.side != size:
            outcome.notes.append(Note("resized", {"size": size, "side": real.side}))
        for kind in dict.fromkeys(self.weights.for_features(name) for name in chosen.standard):
            names = [n for n in chosen.standard if self.weights.for_features(n) == kind]
            other = self._standard(kind, features, subjects, images, reference)
            outcome.add(score_features(names, other, False))
        if pairs:
            gel = None
            if "contact" in chosen.pairs:
                gel = real.pixels(size, self.cache, self.progress, "background")
            groups = None if real.groups is None or "" in real.groups else real.groups
            common = {"ids": real.ids, "groups": groups, "split": self.family.common["split"]}
            context = Pairs(images, [*made], reference, gel, common, self.weights, self.progress)
            outcome.add(score_pairs(chosen.pairs, context, default=chosen.default))
        return outcome

    def _standard(
        self,
        kind: tuple[Literal["inception", "clip"], Path | str | None],
        features: Features,
        subjects: Mapping[str, Samples],
        images: Mapping[str, Any],
        reference: Any,
    ) -> Features:
        """The same sets with features of Inception or CLIP."""
        name, source = kind
        if name == "inception":
            from palpate.encoders.inception import load_inception

            inception = load_inception(str(source))
            embed, digest = partial(inception.embed, progress=self.progress), inception.digest
        else:
            from palpate.encoders.embed import embed_images
            from palpate.encoders.encoder_set import load_clip

            clip = load_clip(str(source))
            options: dict[str, Any] = {"modality": "vision", "progress": self.progress}
            embed, digest = partial(embed_images, encoders=clip, **options), clip.digest("vision")
        embedded = {n: s.feature_set(embed(images[n]), digest) for n, s in subjects.items()}
        return replace(
            features,
            generators={n: embedded[n] for n in features.generators},
            controls={n: embedded[n] for n in features.controls},
            reference=self.inputs.reference.feature_set(embed(reference), digest),
            name={"inception": "Inception", "clip": "CLIP"}[name],
        )


def _settings(
    inputs: Inputs, family: Family, outcome: Outcome, encoders: Any, train: Samples | None
) -> dict[str, Any]:
    """Digests and options, for the page and for a later comparison."""
    real, made = inputs.reference, inputs.generators
    split = family.common["split"]
    digests: dict[str, Any] = {"split": split} if split else {}
    digests |= {"train": train.digest} if train is not None else {}
    options: dict[str, Any] = {"group": inputs.group, "seed": family.common["seed"]}
    settings: dict[str, Any] = {"digests": digests, "options": options}
    if real.features is None:
        digests |= {REFERENCE: real.digest, "generated": {n: s.digest for n, s in made.items()}}
        generators = {n: dict(s.generator) for n, s in made.items() if s.generator is not None}
        settings |= {"generated": generators} if generators else {}
        if encoders is None:  # scores of pixels have no kernel
            return settings
        digests["tactile encoder"] = encoders.digest("tactile")
    else:
        compared = next((s.reference for s in outcome.scores if s.reference), None)
        digests |= {k: v for k, v in {"encoder": real.encoder, REFERENCE: compared}.items() if v}
        settings["embeddings"] = {
            name: {"file": s.source, "rows": len(s), "digest": s.digest}
            for name, s in {**made, REFERENCE: real}.items()
        }
    sigmas = list(family.sigmas) or [s for _, s in family.columns(grouped=False, rows=len(real))]
    options |= {"sigma": sigmas, **family.options}
    return settings


def _gallery(inputs: Inputs, seed: int) -> list[GalleryItem]:
    """Some of the samples that are files on both sides, chosen by seed alone."""
    real, made = inputs.reference.manifest, next(iter(inputs.generators.values())).manifest
    if real is None or made is None:
        return []
    rows = {row["id"]: row for row in real.table.iter_rows(named=True)}
    files = dict(zip(made.ids, made.paths("tactile"), strict=True))
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
