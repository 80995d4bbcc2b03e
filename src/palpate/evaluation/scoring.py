"""Scores of generated tactile images, or of their embeddings: one flow for all inputs.

read (:mod:`palpate.evaluation.inputs`), embed, the TMMD family for every preset and bandwidth, companions
(:mod:`palpate.evaluation.companions`), controls, differences between generators, notes, results.

A split scores its test part. Its train part gives the floor of TMMD, a material probe, and the controls:

- ``background only``: the no-contact image in place of every tactile image. Scores of pixels reward it
  (paper, section 1); a score of touch must not;
- ``real, same material``: for each test sample a real train image of its material, what a generator that
  knows the material but not the place could reach.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpate import __version__
from palpate.core import FeatureSet, Note, PalpateError, Progress, Score, Split, quiet, rng_for
from palpate.evaluation.companions import (
    Features,
    Name,
    Outcome,
    Pairs,
    Weights,
    choose,
    score_features,
    score_pairs,
)
from palpate.evaluation.inputs import REFERENCE, Inputs, Samples, Source, read_inputs
from palpate.metrics import PRESETS, compare, distance, paired_by_id, tmmd
from palpate.report.results import GalleryItem, Results

Preset = Literal["grouped", "paper", "paper-tables", "cmmd"]
#: Bandwidth of the paper; the name of a metric says any other one where several are requested.
SIGMA = 10.0
#: Rows of the tables that are not generators.
BACKGROUND, SAME_MATERIAL, REAL = "background only", "real, same material", "real"
#: Metrics that look at one set alone.
REFERENCE_FREE = ("I-TMMD", "CI-TMMD", "D-TMMD", "material accuracy")
#: Rows of the gallery.
GALLERY = 40
#: Error of streamed moments at scale 1000 from which a note reports it.
BOUND = 1e-4


@dataclass(frozen=True, kw_only=True)
class Family:
    """How the TMMD family is computed: presets (None: by whether groups are known), bandwidths, options."""

    presets: Sequence[str] | None
    sigmas: Sequence[float | str]
    estimator: str | None
    backend: str
    permutations: int
    normalize: Literal["check"] | bool
    seed: int
    split: str | None

    def presets_for(self, *, grouped: bool) -> Sequence[str]:
        """The requested presets, or those that fit."""
        fits = grouped and self.estimator in (None, "grouped")
        return self.presets or (("grouped", "paper") if fits else ("paper",))

    def label(self, preset: str) -> str:
        """A preset as tables name it: with the estimator if that is not its usual one."""
        usual = self.estimator in (None, PRESETS[preset].estimator)
        return preset if usual else f"{preset}, {self.estimator}"

    def named(self, score: Score, preset: str, sigma: float | str) -> Score:
        """A score with its preset, and an unusual bandwidth of several in the metric's name."""
        score = replace(score, settings={**score.settings, "preset": self.label(preset)})
        if len(self.sigmas) < 2 or sigma == SIGMA:
            return score
        tag = f"(σ {sigma})" if isinstance(sigma, str) else f"(σ = {sigma:g})"
        base = score.metric.removesuffix(" difference")
        return replace(score, metric=f"{base} {tag}" + score.metric[len(base) :])


def score(  # noqa: PLR0913
    generated: Source,
    reference: Source,
    *,
    encoder: Any = None,
    split: Split | str | Path | None = None,
    names: Sequence[str] | None = None,
    labels: Source = None,
    groups: Source = None,
    group: str = "auto",
    presets: Sequence[Preset] | None = None,
    sigma: float | str | Sequence[float | str] = SIGMA,
    estimator: Literal["unbiased", "biased", "grouped"] | None = None,
    backend: Literal["auto", "blocked", "moments"] = "auto",
    normalize: Literal["check"] | bool = "check",
    companions: Sequence[Name] | None = None,
    controls: bool = True,
    inception: str | Path | None = None,
    clip: str | Path | None = None,
    lpips: tuple[str | Path, str | Path] | None = None,
    permutations: int = 999,
    seed: int = 0,
    cache: str | Path | None = None,
    progress: Progress = quiet,
) -> Results:
    """Score one or several generators against real tactile images.

    Args:
        generated: what to score: a folder of images or of ``palpate generate``, a manifest, a file of
            embeddings, an array or tensor of images or features, a list of images, a frame; for several
            generators a list of these, or name -> one of these.
        reference: the real samples, of the same kind. Ids (relative file names) pair samples.
        encoder: name or folder of a set of encoders, or an ``EncoderSet``; its tactile encoder gives the
            features of images. Embeddings need none.
        split: a split or its file: its test part is scored, its train part gives the floor of TMMD, a
            material probe and the controls.
        names: of the generators, in the tables.
        labels: materials, and possibly groups, by id: a CSV or Parquet file or a frame with the columns
            id, material, video; id -> material; or one material per row.
        groups: the same for groups.
        group: the column whose values stay together in halves and intervals; ``auto`` takes what the split
            kept whole, else the video.
        presets: readings of the TMMD family (:data:`palpate.metrics.PRESETS`). Default: ``grouped`` and
            ``paper`` where groups are known, else ``paper``.
        sigma: bandwidth or bandwidths: numbers, ``"median"``, ``"multi"``.
        estimator: instead of the presets' own.
        backend: of kernel sums.
        normalize: for embeddings that are not of unit length: raise, divide by the norm, or keep them.
        companions: further scores (:mod:`palpate.evaluation.companions`); an empty list is none.
            Default: all whose inputs are there.
        controls: whether a split scores its controls.
        inception: TorchScript file of Inception, for FID and KID as published.
        clip: folder or hub id of a CLIP, for CMMD as published.
        lpips: the two files of LPIPS: AlexNet's weights and the heads.
        permutations: relabelings of the permutation test of TMMD; 0 for none.
        seed: of random halves, permutations and the choice of control images.
        cache: folder for embeddings and decoded images, which an interrupted run finds again.
        progress: called with what is done.

    Returns:
        A table of scores: the TMMD family, companions, and paired differences between generators.

    Raises:
        PalpateError: if arguments contradict each other, or inputs cannot be read, aligned or compared.

    Example:
        >>> import numpy as np
        >>> x = np.random.default_rng(0).normal(size=(2, 40, 8))
        >>> results = score(x[0], x[1], normalize=True, companions=[])
        >>> results["TMMD", "generated"].n
        40
    """
    split = split if isinstance(split, Split | None) else Split.load(Path(split))
    weights = Weights(
        inception=inception, clip=clip, lpips=lpips and (Path(lpips[0]), Path(lpips[1]))
    )
    family = Family(
        presets=tuple(dict.fromkeys(presets)) if presets else None,
        sigmas=_sigmas(sigma),
        estimator=estimator,
        backend=backend,
        permutations=permutations,
        normalize=normalize,
        seed=seed,
        split=split.digest if split else None,
    )
    _check(family, weights, companions)
    inputs = read_inputs(
        generated,
        reference,
        names=names,
        labels=labels,
        groups=groups,
        group=group,
        split=split,
        reserved=(REFERENCE,) if split is None else (REFERENCE, BACKGROUND, SAME_MATERIAL, REAL),
    )
    given = {
        "encoder": encoder,
        "inception": inception,
        "clip": clip,
        "lpips": lpips,
        "cache": cache,
    }
    encoders = None
    if inputs.reference.features is not None:
        _require_unused(given)
        if any(s.streamed for s in (inputs.reference, *inputs.generators.values())):
            outcome = _streamed(inputs, family, companions, progress)
            return _results(inputs, family, outcome, None, seed)
    else:
        _check_images(encoder, companions, normalize)
        encoders = load_encoders(encoder, progress)
    with tempfile.TemporaryDirectory() if cache is None else nullcontext(cache) as folder:
        run = _Run(inputs, family, encoders, weights, Path(folder), cache is not None, progress)
        outcome = run.score(companions, controls=controls)
    if split is not None:
        outcome.scores = [_with_doubts(s, inputs, encoders, split) for s in outcome.scores]
    return _results(inputs, family, outcome, encoders, seed, encoder=encoder, split=split)


def _sigmas(sigma: float | str | Sequence[float | str]) -> tuple[float | str, ...]:
    values = [sigma] if isinstance(sigma, int | float | str) else list(sigma)
    for value in values:
        known = value in ("median", "multi") if isinstance(value, str) else 1e-100 < value < 1e100
        if not known:
            must = "must be numbers from 1e-100 to 1e100, 'median' or 'multi'"
            raise PalpateError(must, repr(value), "Choose a bandwidth", argument="sigma", example={"sigma": 10})  # fmt: skip
    if not values:
        raise PalpateError("must name at least one bandwidth", "none", "Pass one", argument="sigma", example={"sigma": 10})  # fmt: skip
    return tuple(dict.fromkeys(values))


def _check(family: Family, weights: Weights, companions: Sequence[str] | None) -> None:
    """Raise for options that contradict each other, before anything is read."""
    if family.estimator not in (None, "grouped") and "grouped" in (family.presets or ()):
        got, fix = f"{family.estimator!r} with the preset grouped", "Drop one of the two"
        raise PalpateError("must be grouped for the preset grouped", got, fix, argument="estimator")
    if family.permutations < 0:
        got = str(family.permutations)
        raise PalpateError("must not be negative", got, "0 makes none", argument="permutations")
    for name, kinds in (("inception", ("fid", "kid")), ("clip", ("cmmd",)), ("lpips", ("lpips",))):
        if (
            getattr(weights, name) is not None
            and companions is not None
            and not {*kinds} & {*companions}
        ):
            got, fix = f"weights with the companions {', '.join(companions) or 'none'}", f"Request {kinds[0]}, or drop it"  # fmt: skip
            raise PalpateError("must have a companion that uses it", got, fix, argument=name)


def _require_unused(given: Mapping[str, Any]) -> None:
    for name, value in given.items():
        if value is not None:
            raise PalpateError("must go with images", "embeddings", "Drop it", argument=name)


def _check_images(encoder: Any, companions: Sequence[str] | None, normalize: object) -> None:
    if normalize != "check":
        got = f"{normalize} with images, whose features have unit length"
        raise PalpateError("must go with embeddings", got, "Drop it", argument="normalize")
    if encoder is None and not companions:
        fix = "Pass an encoder, or request companions of pixels"
        example = {"encoder": "palpate/mini", "companions": ["ssim", "psnr"]}
        raise PalpateError(
            "must be given for images", "none", fix, argument="encoder", example=example
        )


def load_encoders(encoder: Any, progress: Progress) -> Any:
    """An ``EncoderSet``, loaded where it is a name or a folder."""
    if encoder is None or not isinstance(encoder, str | Path):
        return encoder
    progress(f"loading {encoder}", 0, 1)
    from palpate.encoders.encoder_set import EncoderSet

    return EncoderSet.load(str(encoder))


@dataclass(frozen=True)
class _Run:
    """One call of :func:`score` on rows that fit in memory."""

    inputs: Inputs
    family: Family
    encoders: Any
    weights: Weights
    cache: Path
    keep: bool
    progress: Progress

    def score(self, companions: Sequence[str] | None, *, controls: bool) -> Outcome:
        """Everything that is scored."""
        real, made = self.inputs.reference, self.inputs.generators
        images = real.features is None
        encoder = self.encoders is not None or not images
        chosen = choose(
            companions, self.weights, images=images, encoder=encoder, gel=real.has_background
        )
        pairs = self._pairable(chosen.default) if chosen.pairs else False
        controls = controls and encoder and images and self.inputs.train is not None
        size = self._size() if images and (chosen.standard or pairs or controls) else 0
        extra = self._controls(size) if controls else {}
        reference = self._features(real)
        train = self._features(self.inputs.train) if self.inputs.train and encoder else None
        features = Features(
            {name: self._features(s) for name, s in made.items()},
            {name: self._features(s) for name, s in extra.items()},
            reference,
            self._paired(),
            "tactile" if images else "embeddings",
            {"seed": self.family.seed, "split": self.family.split},
            {k: getattr(self.family, k) for k in ("backend", "permutations", "normalize")},
        )
        outcome = Outcome(notes=[*self.inputs.notes, *self._pairing_notes()])
        if encoder:
            outcome.add(score_family(features, self.family, train=train, progress=self.progress))
            outcome.add(
                score_features(
                    chosen.features, features, default=chosen.default, progress=self.progress
                )
            )
        if chosen.standard or pairs:
            outcome.add(self._score_pixels(chosen, features, {**made, **extra}, size, pairs=pairs))
        if chosen.pairs and not pairs:
            outcome.notes.append(Note("no-pairs"))
        if images and train is not None:
            outcome.scores += _material_accuracies(train, features)
        if images:
            digest = real.digest
            outcome.scores = _compared_with(outcome.scores, digest)
            outcome.differences = _compared_with(outcome.differences, digest)
        return outcome

    def _features(self, samples: Samples) -> FeatureSet:
        """Features of images by the tactile encoder; without one, zeros that carry ids, labels and groups."""
        if samples.features is not None:
            return samples.feature_set(samples.features, samples.encoder)
        if self.encoders is None:
            return samples.feature_set(np.zeros((len(samples), 1), np.float32), None)
        from palpate.encoders.embed import embed, embed_images

        digest = self.encoders.digest("tactile")
        if samples.manifest is None:
            x = embed_images(samples.images, self.encoders, "tactile", progress=self.progress)
            return samples.feature_set(x, digest)
        folder = samples.folder(self.cache) if self.keep else None
        x = embed(
            samples.manifest,
            self.encoders,
            "tactile",
            cache=folder,
            keep_pixels=False,
            progress=self.progress,
        )
        return samples.feature_set(x.features, digest)

    def _paired(self) -> bool:
        """Whether the generators' rows stand for the same samples: by id, or by number."""
        made = self.inputs.generators.values()
        return not all(s.numbered for s in made) or len({len(s) for s in made}) == 1

    def _pairing_notes(self) -> list[Note]:
        made = self.inputs.generators.values()
        if len(made) < 2 or not all(s.numbered for s in made):
            return []
        return [Note("row-pairs" if self._paired() else "no-differences")]

    def _pairable(self, default: bool) -> bool:
        """Whether every generated image has its reference; some without one are a mistake."""
        real, made = self.inputs.reference, self.inputs.generators
        if real.numbered:  # pairs by position are taken on request alone
            return not default and all(s.numbered and len(s) == len(real) for s in made.values())
        if default and not any({*s.ids} & {*real.ids} for s in made.values()):
            return False
        for name, samples in made.items():
            try:
                paired_by_id(samples.ids, real.ids)
            except PalpateError as error:
                fix = "Score the same samples on both sides, or request companions without pairs"
                example = {"companions": ["fid", "kid", "prdc"]}
                raise PalpateError(
                    f"{name}: {error.must}", error.got, fix, example=example
                ) from None
        return True

    def _size(self) -> int:
        """The side of the generated images, the same for all generators."""
        sizes = {name: samples.side for name, samples in self.inputs.generators.items()}
        if len(set(sizes.values())) > 1:
            got = ", ".join(f"{name} {size}" for name, size in sizes.items())
            fix = "Resize them, or request companions without pixels"
            example = {"companions": ["fid", "kid", "prdc"]}
            raise PalpateError("Generators must have images of one size for scores of pixels", got, fix, example=example)  # fmt: skip
        return next(iter(sizes.values()))

    def _controls(self, size: int) -> dict[str, Samples]:
        """The controls of a split that the reference allows, at the generators' size."""
        real, train = self.inputs.reference, self.inputs.train
        if train is None or real.manifest is None or train.manifest is None:
            return {}
        controls: dict[str, Samples] = {}
        base = replace(real, manifest=None)
        if real.has_background:
            gel = real.pixels(size, self.cache, self.progress, "background")
            controls[BACKGROUND] = replace(base, source=BACKGROUND, images=gel)
        of_material: dict[str, list[str]] = {}
        for i, material in zip(train.ids, train.labels or (), strict=False):
            of_material.setdefault(material, []).append(i)
        if real.labels and all(material in of_material for material in real.labels):
            choices = [
                of_material[m][int(rng_for(self.family.seed, "control", i).integers(len(of_material[m])))]
                for i, m in zip(real.ids, real.labels, strict=True)
            ]  # fmt: skip
            from palpate.data.images import load_images

            path = dict(zip(train.ids, train.manifest.paths("tactile"), strict=True))
            images = load_images([path[i] for i in choices], size, progress=self.progress)
            controls[SAME_MATERIAL] = replace(base, source=SAME_MATERIAL, images=images)
        return controls

    def _score_pixels(
        self,
        chosen: Any,
        features: Features,
        subjects: Mapping[str, Samples],
        size: int,
        *,
        pairs: bool,
    ) -> Outcome:
        """Companions of standard encoders and of pairs of images, all at the generators' size."""
        real, made, outcome = self.inputs.reference, self.inputs.generators, Outcome()
        if pairs and not real.numbered:
            subjects = {name: samples.take(real.ids) for name, samples in subjects.items()}
        images = {n: s.pixels(size, self.cache, self.progress) for n, s in subjects.items()}
        reference = real.pixels(size, self.cache, self.progress)
        if real.side != size:
            outcome.notes.append(Note("resized", {"size": size, "side": real.side}))
        for kind in dict.fromkeys(self.weights.for_features(name) for name in chosen.standard):
            names = [n for n in chosen.standard if self.weights.for_features(n) == kind]
            other = self._standard(kind, features, subjects, images, reference)
            outcome.add(score_features(names, other, default=False, progress=self.progress))
        if pairs:
            gel = None
            if real.has_background and {"contact", "lpips"} & {*chosen.pairs}:
                gel = real.pixels(size, self.cache, self.progress, "background")
            groups = None if real.groups is None or "" in real.groups else real.groups
            common = {"ids": real.ids, "groups": groups, "split": self.family.split}
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
        from palpate.encoders.standard import load_standard

        name, source = kind
        encoder = load_standard(str(source), kind=name)
        embedded = {
            n: s.feature_set(encoder.embed(images[n], progress=self.progress), encoder.digest)
            for n, s in subjects.items()
        }
        real = encoder.embed(reference, progress=self.progress)
        return replace(
            features,
            generators={n: embedded[n] for n in features.generators},
            controls={n: embedded[n] for n in features.controls},
            reference=self.inputs.reference.feature_set(real, encoder.digest),
            name={"inception": "Inception", "clip": "CLIP"}[name],
        )


def score_family(
    features: Features, family: Family, *, train: FeatureSet | None, progress: Progress = quiet
) -> Outcome:
    """TMMD, I-, CI- and D-TMMD of every set, for every preset and bandwidth, with paired differences.

    Args:
        features: of generators, controls and reference.
        family: presets, bandwidths, options.
        train: further real features, whose TMMD to the reference is the floor of TMMD.
        progress: called with how many columns are done.
    """
    sets = {**features.generators, **features.controls}
    grouped = [s.groups is not None for s in (features.reference, *sets.values())]
    floor = features.reference if len(set(grouped)) == 1 else None
    columns = [(p, s) for p in family.presets_for(grouped=all(grouped)) for s in family.sigmas]
    outcome = Outcome()
    for done, (preset, sigma) in enumerate(columns):
        options: dict[str, Any] = {
            **features.family,
            **features.common,
            "preset": preset,
            "sigma": sigma,
            **({"estimator": family.estimator} if family.estimator else {}),
        }
        least = None
        if train is not None:
            least = tmmd(train, features.reference, **{**options, "permutations": 0}).value
        for some in features.batches():
            result = compare(some, features.reference, floor=floor, **options)
            excess = result.excess
            assert excess is not None
            scores = [replace(s, floor=least) if s.metric == "TMMD" else s for s in result.scores]
            for scored, found in ((outcome.scores, _interleaved(scores, excess.scores)), (outcome.differences, _interleaved(result.differences, excess.differences))):  # fmt: skip
                scored += [family.named(s, preset, sigma) for s in found]
        progress("TMMD family", done + 1, len(columns))
    return outcome


def _interleaved(scores: Sequence[Score], excess: Sequence[Score]) -> Iterator[Score]:
    """Every score followed by its excess E."""
    excess_of = {(e.metric.replace(" E", "", 1), e.subject): e for e in excess}
    for s in scores:
        yield s
        if (s.metric, s.subject) in excess_of:
            yield excess_of[s.metric, s.subject]


def _material_accuracies(train: FeatureSet, features: Features) -> list[Score]:
    """What a material probe that was fitted to the train part reads from every subject and from the test part."""
    if train.labels is None or len({*train.labels} - {""}) < 2:
        return []
    from palpate.metrics.probe import fit_probe, material_accuracy

    probe = fit_probe(train)
    # The images of the same material are train images, which the probe was fitted to.
    controls = {n: s for n, s in features.controls.items() if n != SAME_MATERIAL}
    subjects = {**features.generators, **controls, REAL: features.reference}
    return [
        material_accuracy(train, s, probe=probe, subject=name, split=features.common["split"])
        for name, s in subjects.items()
        if s.labels is not None and any(s.labels)
    ]


def _compared_with(scores: Sequence[Score], reference: str) -> list[Score]:
    """Scores with the digest of the real images, where they compare with them."""
    return [
        s if s.metric.startswith(REFERENCE_FREE) else replace(s, reference=reference)
        for s in scores
    ]


def _with_doubts(score: Score, inputs: Inputs, encoders: Any, split: Split) -> Score:
    """A score with a note for an encoder or a generator that may have seen test samples (paper, section 5)."""
    notes = list(score.notes)
    card = getattr(encoders, "card", None)
    if score.encoder and card is not None and card.get("split") != split.digest:
        known = card.get("split") is not None
        notes.append(Note("encoder-of-other-split" if known else "encoder-without-split"))
    samples = inputs.generators.get(score.subject)
    settings = samples.generator if samples is not None else None
    if settings is not None and settings.get("split") != split.digest:
        notes.append(Note("generator-of-other-split"))
    return replace(score, notes=notes)


def _streamed(
    inputs: Inputs, family: Family, companions: Sequence[str] | None, progress: Progress
) -> Outcome:
    """TMMD of arrays that are too long to hold: rows are read once, and only moments are kept."""
    if inputs.train is not None or companions:
        argument = "companions" if companions else "split"
        must = "must go with rows that fit in memory"
        raise PalpateError(must, "so many rows without groups, which are streamed for TMMD alone", "Pass groups, or drop it", argument=argument)  # fmt: skip
    if "grouped" in (*family.presets_for(grouped=False), family.estimator):
        fix, example = "Pass groups, or another preset", {"presets": ["paper"]}
        must = "The grouped estimator must know the group of every row"
        raise PalpateError(must, "rows without", fix, example=example)
    if "multi" in family.sigmas and family.backend != "blocked":
        fix, example = "Choose another bandwidth, or the blocked back end, and wait", {"backend": "blocked"}  # fmt: skip
        raise PalpateError("must need no pairs for streamed rows", "'multi'", fix, argument="sigma", example=example)  # fmt: skip
    if family.normalize is True:
        got = "True for rows that are streamed, and never copied"
        raise PalpateError("must not change the rows", got, "Normalize them when saving them", argument="normalize")  # fmt: skip
    outcome, reference = Outcome(notes=[*inputs.notes, Note("streamed")]), inputs.reference
    columns = [(p, s) for p in family.presets_for(grouped=False) for s in family.sigmas]
    todo = [(name, s, p, sigma) for name, s in inputs.generators.items() for p, sigma in columns]
    for done, (name, samples, preset, sigma) in enumerate(todo):
        progress("streaming", done, len(todo))
        options: dict[str, Any] = {
            "sigma": sigma,
            "estimator": family.estimator or PRESETS[preset].estimator,
            "normalize": family.normalize,
            "backend": "moments" if family.backend == "auto" else family.backend,
            "names": (f"The features of {name!r}", "The reference features"),
        }
        d = distance(samples.features, reference.features, **options)
        if d.bound > BOUND and family.backend == "auto":
            fix, example = "Choose a larger one, or the blocked back end, and wait", {"backend": "blocked"}  # fmt: skip
            got = f"an error of up to {d.bound:.2g} at {sigma}"
            raise PalpateError("must be wide against streamed rows", got, fix, argument="sigma", example=example)  # fmt: skip
        notes = [Note("no-interval-streamed")]
        if d.bound > BOUND:
            notes.append(Note("within-bound", {"bound": d.bound}))
        tmmd_score = Score(
            "TMMD",
            name,
            d.value,
            estimator=d.estimator,
            bandwidth=d.bandwidth,
            scale=d.scale,
            n=d.m,
            m=d.n,
            split=family.split,
            settings={**d.kernel, "preset": preset, "normalize": family.normalize},
            details={"backend": d.backend, "bound": d.bound, "version": __version__},
            notes=notes,
        )
        outcome.scores.append(family.named(tmmd_score, preset, sigma))
    progress("streaming", len(todo), len(todo))
    outcome.scores = _compared_with(outcome.scores, reference.digest)
    return outcome


def _results(
    inputs: Inputs,
    family: Family,
    outcome: Outcome,
    encoders: Any,
    seed: int,
    *,
    encoder: Any = None,
    split: Split | None = None,
) -> Results:
    """The table with its notes, settings and gallery."""
    real, made = inputs.reference, inputs.generators
    digests: dict[str, Any] = {"split": split.digest} if split else {}
    options: dict[str, Any] = {
        "group": inputs.group,
        "sigma": list(family.sigmas),
        "backend": family.backend,
        "permutations": family.permutations,
        "normalize": family.normalize,
        "seed": seed,
    }
    settings: dict[str, Any] = {"digests": digests, "options": options}
    if split:
        settings["split rule"] = dict(split.rule)
    if real.features is None:
        if encoders is None:  # scores of pixels have no kernel
            options = {k: v for k, v in options.items() if k in ("group", "seed")}
        else:
            digests["tactile encoder"] = encoders.digest("tactile")
        digests |= {REFERENCE: real.digest, "generated": {n: s.digest for n, s in made.items()}}
        generators = {n: dict(s.generator) for n, s in made.items() if s.generator is not None}
        settings |= {"encoder": str(encoder), "options": options} | ({"generated": generators} if generators else {})  # fmt: skip
    else:
        compared = next((s.reference for s in outcome.scores if s.reference), None)
        known = {"encoder": real.encoder, REFERENCE: compared}
        digests |= {k: v for k, v in known.items() if v}
        settings["embeddings"] = {
            n: {"file": s.source, "rows": len(s), "digest": s.digest}
            for n, s in {**made, REFERENCE: real}.items()
        }
    return Results(
        title=f"Scores of {', '.join(made)}",
        scores=[*outcome.scores, *map(_with_verdict, outcome.differences)],
        gallery=_gallery(real, next(iter(made.values())), seed),
        settings=settings,
        notes=[*outcome.notes, *_copies(outcome), *_below_floor(outcome)],
    )


def _with_verdict(difference: Score) -> Score:
    """A difference with a note on which generator is ahead, and how sure that is."""
    d = difference.details
    if d.get("p_better") is None or d.get("better") is None:
        return difference
    ahead = d["p_better"] if d["better"] == d["a"] else 1 - d["p_better"]
    params = {"better": d["better"], "confidence": ahead, "p_adjusted": d.get("p_adjusted")}
    return replace(difference, notes=[Note("ahead", params), *difference.notes])


def _copies(outcome: Outcome) -> list[Note]:
    copies: dict[str, Note] = {}
    for s in outcome.scores:
        if count := s.details.get("copies"):
            params = {"subject": s.subject, "copies": count, "n": s.n}
            copies.setdefault(s.subject, Note("copies", params))
    return [*copies.values()]


def _below_floor(outcome: Outcome) -> list[Note]:
    """Generators that vary less than real images do, which no metric without reference rewards."""
    return [
        Note("below-floor", {"metric": s.metric, "subject": s.subject})
        for s in outcome.scores
        if s.metric.startswith(("I-TMMD E", "CI-TMMD E"))
        and s.floor
        and s.interval
        and s.interval[1] < s.floor
    ]


def _gallery(real: Samples, made: Samples, seed: int) -> list[GalleryItem]:
    """Some of the samples that both have as files, chosen by seed alone."""
    if real.manifest is None or made.manifest is None:
        return []
    manifest = real.manifest
    rows = {row["id"]: row for row in manifest.table.iter_rows(named=True)}
    files = dict(zip(made.ids, made.manifest.paths("tactile"), strict=True))
    shared = sorted({*rows} & {*files}, key=lambda i: rng_for(seed, "gallery", i).random())
    return [
        GalleryItem(
            manifest.ref(rows[i]),
            str(files[i].resolve()),
            str(manifest.path(rows[i]["background"]).resolve()) if rows[i]["background"] else None,
        )
        for i in shared[:GALLERY]
    ]
