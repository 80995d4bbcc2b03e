"""The scores of one call: each is a function of the bench, which holds what is scored, on what.

The TMMD family (TMMD, I-, CI- and D-TMMD) comes by preset and bandwidth. Its companions:

=============  =========  ================================================================
name           needs      score
=============  =========  ================================================================
``fid``        features   Frechet distance, of Inception's features if its weights are given
``kid``        features   MMD^2 with the kernel (x.y / d + 1)^3, as ``fid``
``fd-dinov2``  images     as ``fid``, of a DINOv2's class tokens; needs weights
``mind``       features   sliced Wasserstein distance, as ``fid``
``vendi``      features   effective number of different samples
``prdc``       features   precision, recall, density and coverage of nearest neighbors
``cmmd``       features   biased MMD^2, of CLIP's features if a CLIP is given
``ssim``       pairs      structural similarity
``psnr``       pairs      peak signal-to-noise ratio
``ms-ssim``    pairs      structural similarity at several scales
``contact``    pairs      residual, SSIM and IoU of the contact, and the motion of the markers of
                          gels that have some; needs backgrounds
``lpips``      pairs      LPIPS; needs weights
=============  =========  ================================================================

``mind``, ``vendi`` and what needs weights are computed where they are requested, or weights given.
"Pairs" are a generated and a real image of one id.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import FeatureSet, Note, PalpateError, Progress, Score, require
from palpate.data.samples import Samples
from palpate.evaluation.controls import matched_features
from palpate.evaluation.names import Name
from palpate.metrics.contact import contact_per_image
from palpate.metrics.distributions import compare_fid, prdc_rows
from palpate.metrics.images import PerImage, per_image, scale_means
from palpate.metrics.kernels import Polynomial
from palpate.metrics.mmd import Preset
from palpate.metrics.motion import marker_per_image
from palpate.metrics.paired import Comparison, compare, compare_tmmd, mean_differences
from palpate.metrics.sets import compare_mind, compare_vendi
from palpate.metrics.tactile import tmmd
from palpate.report.labels import measured

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest
    from palpate.encoders.encoder_set import EncoderSet
    from palpate.evaluation.ruling import Ruled

Images = NDArray[np.uint8]
#: Metrics of features that nobody gets who does not request them, or give their weights.
REQUESTED = ("cmmd", "fd-dinov2", "mind", "vendi")
#: With more rows, what forms all pairs must be requested by name.
MANY = 50_000
#: Bandwidth of the paper; scores name any other one as their kernel where several are requested.
SIGMA = 10.0
#: The CLIP of published CMMD (arXiv 2401.09603).
CMMD_CLIP = "openai/clip-vit-large-patch14-336"
#: The DINOv2 of published FD-DINOv2 (arXiv 2306.04675).
FIX_DINOV2 = "Pass dinov2, a folder or hub id. Fetch one with: hf download facebook/dinov2-large"
#: The ruler of a second opinion (:mod:`palpate.encoders.rulers`).
HANDCRAFTED = "palpate/handcrafted"
#: Name of the reference in tables and errors.
REFERENCE = "reference"


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights that palpate does not ship: Inception (TorchScript), a CLIP, a DINOv2, LPIPS (two
    files).

    Raises:
        PalpateError: if the code of Inception's file is not trusted.
    """

    inception: Path | str | None = None
    clip: Path | str | None = None
    dinov2: Path | str | None = None
    lpips: tuple[str | Path, str | Path] | None = None
    trust_torchscript: bool = False

    def __post_init__(self) -> None:
        if self.inception is not None:  # said here, not after an hour of other scores
            from palpate.encoders.inception import require_trusted

            require_trusted(self.inception, self.trust_torchscript)

    @property
    def companions(self) -> list[Name]:
        """What is computed as published with these weights, but for KID."""
        files: dict[Name, object] = {
            "fid": self.inception,
            "cmmd": self.clip,
            "fd-dinov2": self.dinov2,
            "lpips": self.lpips,
        }
        return [name for name, weights in files.items() if weights is not None]

    def of(self, companion: str) -> Path | str | None:
        """Those of the standard encoder of a companion on features."""
        files = {**dict.fromkeys(("fid", "kid", "mind"), self.inception), "cmmd": self.clip}
        return {**files, "fd-dinov2": self.dinov2}.get(companion)


@dataclass(frozen=True)
class Sets:
    """Features by one encoder.

    Attributes:
        name: where they come from: ``tactile``, ``embeddings``, ``Inception``, ``CLIP``.
        generators: name -> features; differences are made between these.
        controls: the same for controls.
        reference: real features.
    """

    name: str
    generators: Mapping[str, FeatureSet]
    controls: Mapping[str, FeatureSet]
    reference: FeatureSet

    def batches(self) -> list[dict[str, FeatureSet]]:
        """Sets to compare in one call: generators of the same samples, every other set alone."""
        generators, alone = dict(self.generators), dict(self.controls)
        if len({frozenset(s.ids) for s in generators.values()}) > 1:
            generators, alone = {}, {**generators, **alone}
        return [generators] * bool(generators) + [{name: s} for name, s in alone.items()]


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What is scored in one call, on what, and how.

    Attributes:
        generators: name -> samples; differences are made between these.
        controls: the same for controls of a split.
        reference: the real samples; of a split, its test part.
        train: the train part of the reference, if there is a split and the reference has all of it.
        seen: what the generators were trained on, if that is known.
        encoders: whose tactile encoder gives the features of images, or None.
        weights: those that palpate does not ship.
        presets: of the TMMD family; empty for those that fit the groups.
        sigmas: bandwidths; empty for the default.
        normalize, permutations: of the TMMD family and ``cmmd``.
        seed: of random halves, permutations and the choice of control images.
        split: digest of the split, or None.
        cache: folder for embeddings and decoded images.
        keep: whether the folder outlives the call.
        sure: whether it is known what belongs together, so that intervals and p-values are right.
        progress: called with what is done.
        notes: what was assumed or skipped; scores add to them.
    """

    generators: Mapping[str, Samples]
    reference: Samples
    controls: Mapping[str, Samples] = field(default_factory=dict[str, Samples])
    train: Samples | None = None
    seen: Samples | None = None
    encoders: EncoderSet | None = None
    weights: Weights = field(default_factory=Weights)
    presets: Sequence[Preset] = ()
    sigmas: Sequence[float | str] = ()
    normalize: Literal["check"] | bool = "check"
    permutations: int = 999
    seed: int = 0
    split: str | None = None
    cache: Path = Path()
    keep: bool = False
    sure: bool = True
    progress: Progress
    notes: list[Note] = field(default_factory=list[Note])

    @property
    def common(self) -> dict[str, Any]:
        """What every metric of features takes."""
        return {"seed": self.seed, "split": self.split}

    def of_family(self, preset: Preset | None, sigma: float | str) -> dict[str, Any]:
        """What the TMMD family takes in one column."""
        column = {"preset": preset, "sigma": sigma, "normalize": self.normalize}
        return {**self.common, **column}

    @property
    def subjects(self) -> dict[str, Samples]:
        """Generators and controls."""
        return {**self.generators, **self.controls}

    def features(self, samples: Samples) -> FeatureSet:
        """Features by the tactile encoder, or those that the samples are."""
        if self.by_ruler:
            return next(r.compared for r in self.ruled if r.samples is samples)
        if samples.rows is not None and samples.embedded:
            return samples.feature_set(samples.rows, samples.encoder)
        from palpate.encoders.embed import embed, embed_images

        encoders, progress = self.encoders, self.progress
        assert encoders is not None  # `score` requires one for what compares features
        digest = encoders.digest("tactile")
        if samples.rows is not None:
            x = embed_images(samples.rows, encoders, "tactile", progress=progress)
            return samples.feature_set(x, digest)
        folder = samples.folder(self.cache) if self.keep else None
        # Generated images have no earlier frame, so none is taken for real ones.
        manifest = self._in_context(samples.manifest, encoders)
        x = embed(manifest, encoders, cache=folder, still=True, progress=progress)
        return samples.feature_set(x.features, digest)

    @property
    def by_ruler(self) -> bool:
        """Whether the features are a ruler's."""
        residual = self.encoders and self.encoders.preprocess("tactile").residual
        return bool(residual or self.reference.ruled)

    @cached_property
    def ruled(self) -> list[Ruled]:
        """Features of everything by a ruler."""
        from palpate.evaluation.ruling import ruler_features

        return ruler_features(self)

    def _in_context(self, manifest: Manifest, encoders: EncoderSet) -> Manifest:
        """Image files with the sensor and the no-contact image of the reference's sample of the
        same id.
        """
        real = self.reference
        needy = encoders.preprocess("tactile").subtract or encoders.origin("tactile")
        if not needy or real.rows is not None or "sensor" in manifest.filled().columns:
            return manifest
        gels = [
            gel and str(real.manifest.path(gel).resolve())
            for gel in real.manifest.column("background")
        ]
        background = pl.Series("background", gels, pl.String)
        context = real.manifest.table.select("id", "sensor", background)
        table = manifest.table.drop("sensor", "background").join(context, "id", "left")
        return replace(manifest, table=table.select(manifest.table.columns))

    @cached_property
    def tactile(self) -> Sets:
        """Features of everything by the tactile encoder."""
        name = "tactile" if self.reference.made or not self.reference.embedded else "embeddings"
        sets = {n: self.features(s) for n, s in self.subjects.items()}
        return self._sets(name, sets, self.features(self.reference))

    @cached_property
    def free(self) -> Sets:
        """Features for scores without a reference: those of a ruler do not depend on it."""
        if not self.by_ruler:
            return self.tactile
        alone = {id(r.samples): r.alone for r in self.ruled}
        sets = {n: alone[id(s)] for n, s in self.subjects.items()}
        return self._sets(self.tactile.name, sets, alone[id(self.reference)])

    def _sets(self, name: str, sets: Mapping[str, FeatureSet], reference: FeatureSet) -> Sets:
        generators, controls = (
            {n: sets[n] for n in part} for part in (self.generators, self.controls)
        )
        return Sets(name, generators, controls, reference)

    @cached_property
    def train_features(self) -> FeatureSet | None:
        """Features of the train part."""
        return None if self.train is None else self.features(self.train)

    @cached_property
    def inception(self) -> Sets:
        """Features of everything by Inception."""
        from palpate.encoders.inception import load_inception

        weights = self.weights
        network = load_inception(
            str(weights.inception), trust_torchscript=weights.trust_torchscript
        )
        return self._standard("Inception", network.digest, network.embed)

    @cached_property
    def clip(self) -> Sets:
        """Features of everything by the vision encoder of a CLIP."""
        from palpate.encoders.embed import embed_images
        from palpate.encoders.encoder_set import load_clip

        clip = load_clip(str(self.weights.clip))
        embed = partial(embed_images, encoders=clip, modality="vision")
        return self._standard("CLIP", clip.digest("vision"), embed)

    @cached_property
    def dinov2(self) -> Sets:
        """Class tokens of everything by a DINOv2, of whatever length."""
        from palpate.encoders.embed import embed_images
        from palpate.encoders.encoder_set import family_of, load_clip

        source = str(self.weights.dinov2)
        dino = load_clip(source)
        family = family_of(dino.clip)
        must = f"{source} must be a DINOv2 of transformers"
        require(family.startswith("dinov2"), None, must, family, fix=FIX_DINOV2)
        embed = partial(embed_images, encoders=dino, modality="vision", raw=True)
        return self._standard("DINOv2", dino.digest("vision"), embed)

    def _standard(self, name: str, digest: str, embed: Callable[..., NDArray[Any]]) -> Sets:
        sets = {
            n: s.feature_set(embed(self.pictures[n], progress=self.progress), digest)
            for n, s in {**self.subjects, REFERENCE: self.reference}.items()
        }
        return self._sets(name, sets, sets.pop(REFERENCE))

    def sets_for(self, companion: str) -> Sets:
        """The features that a companion compares."""
        if self.weights.of(companion) is None:
            return self.tactile
        others = {"cmmd": "clip", "fd-dinov2": "dinov2"}
        return getattr(self, others.get(companion, "inception"))

    @cached_property
    def size(self) -> int:
        """The side of the generated images.

        Raises:
            PalpateError: if it is not the same for all generators.
        """
        sizes = {name: samples.side for name, samples in self.generators.items()}
        if len(set(sizes.values())) > 1:
            got = ", ".join(f"{name} {size}" for name, size in sizes.items())
            fix = "Resize them, or request companions without pixels"
            example = {"companions": ["fid", "kid", "prdc"]}
            must = "Generators must have images of one size for scores of pixels"
            raise PalpateError(must, got, fix, example=example)
        return next(iter(sizes.values()))

    def pixels(self, samples: Samples, column: str = "tactile") -> Images:
        """Images of samples at the generators' size."""
        return samples.pixels(self.size, self.cache, self.progress, column)

    @cached_property
    def pictures(self) -> dict[str, Images]:
        """Images of all subjects, and of the reference, at the generators' size."""
        size, side = self.size, self.reference.side
        self.notes.extend([Note("resized", {"size": size, "side": side})] * (side != size))
        return {n: self.pixels(s) for n, s in {**self.subjects, REFERENCE: self.reference}.items()}

    @cached_property
    def pairs(self) -> dict[str, Images]:
        """Images of the subjects that have the samples of the reference, in its order."""
        real = self.reference
        subjects = self.subjects.items()
        return {
            n: self.pictures[n]
            for n, s in subjects
            if s.ids == real.ids or (s.numbered and real.numbered)
        }

    @cached_property
    def means(self) -> dict[str, NDArray[Any]]:
        """What SSIM and MS-SSIM of :attr:`pairs` are made of."""
        real = self.pictures[REFERENCE]
        return {name: scale_means(x, real) for name, x in self.pairs.items()}

    @property
    def of_pairs(self) -> dict[str, Any]:
        """What every metric of pairs takes."""
        groups = self.reference.groups
        groups = None if groups is None or "" in groups else groups
        return {"ids": self.reference.ids, "groups": groups, "split": self.split}


def choose(
    requested: Sequence[str] | None,
    weights: Weights,
    *,
    images: bool,
    encoder: bool,
    background: bool,
) -> list[str]:
    """The companions that are computed; None requests all whose inputs are there.

    ``images``, ``encoder`` and ``background`` say whether there are images (else embeddings),
    features of an encoder, and backgrounds of the reference.

    Raises:
        PalpateError: for an unknown name, or a companion whose inputs are not there.
    """
    able = {name: encoder or weights.of(name) is not None for name in FEATURES}
    able |= dict.fromkeys(PAIRS, images) | {"fd-dinov2": images and weights.dinov2 is not None}
    able |= {"contact": images and background, "lpips": images and weights.lpips is not None}
    if requested is None:
        return [n for n in able if able[n] and (n not in REQUESTED or n in weights.companions)]
    if lacking := next((name for name in requested if not able.get(name)), None):
        raise _lacking(lacking, images=images)
    return [name for name in able if name in requested]


def _lacking(name: str, *, images: bool) -> PalpateError:
    """Why a companion cannot be computed."""
    refusal = partial(PalpateError, argument="companions")
    if name not in (*FEATURES, *PAIRS):
        must = f"must be among {', '.join((*FEATURES, *PAIRS))}"
        return refusal(must, repr(name), "Check the spelling")
    if name in PAIRS and not images:
        must = "must need no images for embeddings"
        return refusal(must, name, "Score folders of images, or drop it")
    if name == "contact":
        must = "must need no background images where the reference has none"
        fix = "Pass one no-contact image for all, a reference with a column background, or drop it"
        return refusal(must, name, fix, example={"background": "gel.png"})
    if name == "lpips":
        from palpate.encoders.perceptual import FIX

        return PalpateError("must hold the two files of LPIPS", "none", FIX, argument="lpips")
    if name == "fd-dinov2":
        must = "must hold a DINOv2, and images to embed"
        return PalpateError(must, "none" if images else "embeddings", FIX_DINOV2, argument="dinov2")
    fix = "Pass an encoder"
    if name == "cmmd":
        fix += f", or weights of clip. Fetch one with: hf download {CMMD_CLIP}"
    elif name != "prdc":
        from palpate.encoders.inception import FIX

        fix += f", or weights of inception. {FIX}"
    must = "must need no features of images without an encoder"
    return refusal(must, name, fix, example={"encoder": "palpate/mini"})


def tmmd_family(bench: Bench) -> list[Score]:
    """TMMD, I-, CI- and D-TMMD of every set by preset and bandwidth, with paired differences.

    The floor of TMMD is that of features of the train part, whole videos in the place of the
    reference's (:func:`palpate.evaluation.controls.matched_rows`): the pairs of one video that are
    left out on one side are then left out on the other. The floor of the others is of the reference
    itself.
    """
    sets, train, scores = bench.tactile, bench.train_features, list[Score]()
    reference, every = sets.reference, {**sets.generators, **sets.controls}
    grouped = [s.groups is not None for s in (reference, *every.values())]
    free = bench.free
    floor = free.reference if len(set(grouped)) == 1 else None
    further = train and matched_features(train, reference, bench.seed)
    rows = _most_rows(sets)
    if not bench.sigmas and rows > MANY:
        bench.notes.append(Note("wide-sigma-alone", {"rows": MANY}))
    columns = bandwidths(bench, grouped=all(grouped), rows=rows)
    for done, (preset, sigma) in enumerate(columns):
        all_four = sigma in (bench.sigmas or (SIGMA,))
        shared = bench.of_family(preset, sigma)
        two = free is not sets  # of features
        compared = partial(compare, floor=floor) if all_four and not two else compare_tmmd
        least = None
        if further is not None:
            least = tmmd(further, reference, permutations=0, **shared).value
        for some, alone in zip(sets.batches(), free.batches(), strict=True):
            result = compared(some, reference, permutations=bench.permutations, **shared)
            if two and all_four:
                result = _joined(result, compare(alone, free.reference, floor=floor, **shared))
            of_family = [
                replace(s, floor=least) if s.metric == "TMMD" else s for s in result.scores
            ]
            for s in (_with_kernel(bench, s, sigma) for s in (*of_family, *result.differences)):
                scores.append(s)
                interval = s.interval if bench.sure and s.kind == "excess" else None
                if interval and s.floor and interval[1] < s.floor:
                    params = {"metric": measured(s), "subject": s.a}
                    bench.notes.append(Note("below-floor", params))
        bench.progress("TMMD family", done + 1, len(columns))
    return scores


def _joined(with_reference: Comparison, without: Comparison) -> Comparison:
    """TMMD of the first, the others of the second."""
    parts = zip(vars(with_reference).values(), vars(without).values(), strict=True)
    return Comparison(*([*a, *(s for s in b if s.metric != "TMMD")] for a, b in parts))


def second_opinion(bench: Bench) -> list[Score]:
    """TMMD by the ruler that is not trained, next to that of the bench's encoder."""
    from palpate.encoders.encoder_set import EncoderSet

    other = replace(bench, encoders=EncoderSet.load(HANDCRAFTED), notes=[])
    compared = partial(compare_tmmd, permutations=bench.permutations)
    return _compared(bench, replace(other.tactile, name="handcrafted"), "TMMD", compared)


def bandwidths(
    bench: Bench, *, grouped: bool, rows: int
) -> list[tuple[Preset | None, float | str]]:
    """(preset, bandwidth) of each column; None is the preset that fits the ids of a metric.

    Of bandwidths that nobody requested, ``multi`` is for TMMD alone, of the first preset.
    """
    fitting: Sequence[Preset | None] = ("grouped", "paper") if grouped else (None,)
    presets = bench.presets or fitting
    columns: list[tuple[Preset | None, float | str]] = [
        (p, s) for p in presets for s in bench.sigmas or (SIGMA,)
    ]
    if not bench.sigmas and rows <= MANY:
        columns.append((presets[0], "multi"))
    return columns


def _with_kernel(bench: Bench, score: Score, sigma: float | str) -> Score:
    """A score that names an unusual bandwidth, so that no two of them share a column."""
    if len(bench.sigmas) == 1 or sigma == SIGMA:
        return score
    return replace(score, kernel=f"σ {sigma}" if isinstance(sigma, str) else f"σ = {sigma:g}")


def _most_rows(sets: Sets) -> int:
    return max(len(s.ids) for s in (sets.reference, *sets.generators.values()))


def companion(bench: Bench, name: str, *, default: bool) -> list[Score]:
    """One companion; by ``default`` nobody requested it, and one that raises, or forms too many
    pairs, becomes a note.
    """
    default = default and bench.weights.of(name) is None
    if name in PAIRS:
        run = partial(PAIRS[name], bench, bench.pairs)
    else:
        sets = bench.sets_for(name)
        if default and name != "fid" and _most_rows(sets) > MANY:
            bench.notes.append(Note("too-many-rows", {"name": name, "rows": MANY}))
            return []
        run = partial(FEATURES[name], bench, sets)
    try:
        return run()
    except PalpateError as error:
        if not default:
            raise
        params = {"name": name, "must": error.must, "got": error.got}
        bench.notes.append(Note("companion-skipped", params))
        return []


def _compared(
    bench: Bench, sets: Sets, metric: str, compared: Callable[..., Comparison]
) -> list[Score]:
    """Scores of a metric and differences of every batch, named by where the features come from."""
    results = [compared(some, sets.reference, **bench.common) for some in sets.batches()]
    return [_named(s, metric, sets) for r in results for s in (*r.scores, *r.differences)]


def _cmmd(bench: Bench, sets: Sets) -> list[Score]:
    cmmd = partial(
        compare_tmmd, preset="cmmd", permutations=bench.permutations, normalize=bench.normalize
    )
    return _compared(bench, sets, "CMMD", cmmd)


def _kid(bench: Bench, sets: Sets) -> list[Score]:
    kid = partial(
        compare_tmmd, kernel=Polynomial(), preset="paper", normalize=False, permutations=0
    )
    return [
        replace(
            s,
            settings={key: value for key, value in s.settings.items() if key != "preset"},
            notes=[*[Note("kid-interval")] * (s.b is None), *s.notes],
        )
        for s in _compared(bench, sets, "KID", kid)
    ]


def _prdc(bench: Bench, sets: Sets) -> list[Score]:
    result: list[Score] = []
    for some in sets.batches():
        first = next(iter(some.values()))
        rows = {
            name: prdc_rows(
                s.take(list(first.ids)), sets.reference, subject=name, split=bench.split
            )
            for name, s in some.items()
        }
        # Precision and density average over generated rows, recall and coverage over real ones.
        groups = (first.groups, sets.reference.groups) * 2
        for k, metric_groups in enumerate(groups):
            scores = {name: s[k] for name, (s, _) in rows.items()}
            one = next(iter(scores.values()))
            values = {name: each[one.metric] for name, (_, each) in rows.items()}
            units = metric_groups if one.settings["grouped"] else None
            every = [*scores.values(), *mean_differences(scores, values, units)]
            result += [_named(s, one.metric, sets) for s in every]
    return result


def _named(score: Score, metric: str, sets: Sets) -> Score:
    """A score of a metric that says where the features come from."""
    return replace(score, metric=metric, features=sets.name)


def _mean_of_pairs(
    bench: Bench, pairs: Mapping[str, Images], metric: Literal["SSIM", "PSNR", "MS-SSIM"]
) -> list[Score]:
    real = bench.pictures[REFERENCE]
    means = {} if metric == "PSNR" else bench.means
    each = {name: per_image(metric, x, real, means.get(name)) for name, x in pairs.items()}
    return _scored(bench, each)


def _scored(bench: Bench, each: Mapping[str, PerImage]) -> list[Score]:
    """Scores of one metric, with differences between the generators."""
    fields = bench.of_pairs
    scores = {name: e.score(subject=name, **fields) for name, e in each.items()}
    compared = {name: s for name, s in scores.items() if name in bench.generators}
    values = {name: each[name].values for name in compared}
    return [*scores.values(), *mean_differences(compared, values, fields["groups"])]


def _contact(bench: Bench, pairs: Mapping[str, Images]) -> list[Score]:
    gel, real = bench.pixels(bench.reference, "background"), bench.pictures[REFERENCE]
    each = contact_per_image(pairs, real, gel, bench.reference.ids)
    of_markers = marker_per_image(pairs, real, gel)
    of_metrics = [*zip(*each.values(), strict=True), *zip(*of_markers.values(), strict=True)]
    return [s for one in of_metrics for s in _scored(bench, dict(zip(each, one, strict=True)))]


def _lpips(bench: Bench, pairs: Mapping[str, Images]) -> list[Score]:
    from palpate.encoders.perceptual import load_lpips, lpips_per_image

    assert bench.weights.lpips is not None  # `choose` requires it
    network, real = load_lpips(*map(Path, bench.weights.lpips)), bench.pictures[REFERENCE]
    each = {
        name: PerImage(
            "LPIPS",
            lpips_per_image(x, real, network, progress=bench.progress),
            settings={"network": "alex", "version": "0.1", "size": [bench.size] * 2},
            higher_is_better=False,
            encoder=network.digest,
        )
        for name, x in pairs.items()
    }
    return _scored(bench, each)


FEATURES: Mapping[str, Callable[[Bench, Sets], list[Score]]] = {
    "fid": partial(_compared, metric="FID", compared=compare_fid),
    "kid": _kid,
    "prdc": _prdc,
    "cmmd": _cmmd,
    "fd-dinov2": partial(_compared, metric="FD", compared=compare_fid),
    "mind": partial(_compared, metric="MIND", compared=compare_mind),
    "vendi": partial(_compared, metric="Vendi", compared=compare_vendi),
}
PAIRS: Mapping[str, Callable[[Bench, Mapping[str, Images]], list[Score]]] = {
    "ssim": partial(_mean_of_pairs, metric="SSIM"),
    "psnr": partial(_mean_of_pairs, metric="PSNR"),
    "ms-ssim": partial(_mean_of_pairs, metric="MS-SSIM"),
    "contact": _contact,
    "lpips": _lpips,
}
