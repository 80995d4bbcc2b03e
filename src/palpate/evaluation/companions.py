"""Companions: the scores reported next to the TMMD family.

=============  =========  ================================================================
name           needs      score
=============  =========  ================================================================
``fid``        features   Frechet distance, of Inception's features if its weights are given
``kid``        features   MMD^2 with the kernel (x.y / d + 1)^3, as ``fid``
``prdc``       features   precision, recall, density and coverage of nearest neighbors
``cmmd``       features   biased MMD^2, of CLIP's features if a CLIP is given
``ssim``       pairs      structural similarity
``psnr``       pairs      peak signal-to-noise ratio
``ms-ssim``    pairs      structural similarity at several scales
``contact``    pairs      residual, SSIM and IoU of the contact; needs backgrounds
``lpips``      pairs      LPIPS; needs weights
=============  =========  ================================================================

"Pairs" are a generated and a real image of one id.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, Note, PalpateError, Progress, Score
from palpate.metrics import PerImage, Polynomial, compare_fid, compare_tmmd, per_image
from palpate.metrics.contact import contact_per_image
from palpate.metrics.distributions import prdc_rows
from palpate.metrics.paired import mean_differences

Images = NDArray[np.uint8]
Name = Literal["fid", "kid", "prdc", "cmmd", "ssim", "psnr", "ms-ssim", "contact", "lpips"]
#: With more rows the companions that form all pairs must be requested by name.
MANY = 50_000
#: The CLIP of published CMMD (arXiv 2401.09603).
CMMD_CLIP = "openai/clip-vit-large-patch14-336"


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights that palpate does not ship: Inception (TorchScript), a CLIP, LPIPS (two files)."""

    inception: Path | str | None = None
    clip: Path | str | None = None
    lpips: tuple[str | Path, str | Path] | None = None

    @property
    def companions(self) -> list[Name]:
        """What is computed as published with these weights, but for KID."""
        files: dict[Name, object] = {"fid": self.inception, "cmmd": self.clip, "lpips": self.lpips}
        return [name for name, weights in files.items() if weights is not None]

    def for_features(self, name: str) -> tuple[Literal["inception", "clip"], Path | str | None]:
        """The standard encoder of a companion on features, and its weights."""
        return ("clip", self.clip) if name == "cmmd" else ("inception", self.inception)


@dataclass
class Outcome:
    """Scores of all subjects, differences between generators, and what was skipped."""

    scores: list[Score] = field(default_factory=list)
    differences: list[Score] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)

    def add(self, other: Outcome) -> None:
        """Append another outcome."""
        self.scores += other.scores
        self.differences += other.differences
        self.notes += other.notes


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the metrics of one call have in common.

    Attributes:
        seed: of random halves, permutations and the choice of control images.
        split: digest of the split, or None.
        permutations, normalize: of the TMMD family and the companion ``cmmd``.
    """

    seed: int
    split: str | None
    permutations: int
    normalize: Literal["check"] | bool

    @property
    def common(self) -> dict[str, Any]:
        """What every metric of features takes."""
        return {"seed": self.seed, "split": self.split}

    @property
    def family(self) -> dict[str, Any]:
        """What the TMMD family takes."""
        return {**self.common, "permutations": self.permutations, "normalize": self.normalize}


@dataclass(frozen=True)
class Features:
    """Features of generators and controls, and of the reference they are compared with.

    Attributes:
        generators: name -> features; differences are made between these.
        controls: the same for controls.
        reference: real features.
        paired: whether the generators' rows stand for the same samples.
        name: where the features come from: ``tactile``, ``embeddings``, ``Inception``, ``CLIP``.
        settings: what the metrics have in common.
    """

    generators: Mapping[str, FeatureSet]
    controls: Mapping[str, FeatureSet]
    reference: FeatureSet
    paired: bool
    name: str
    settings: Settings

    def batches(self) -> Iterator[dict[str, FeatureSet]]:
        """Sets to compare in one call: paired generators together, every other set alone."""
        if self.paired:
            yield dict(self.generators)
        else:
            yield from ({name: s} for name, s in self.generators.items())
        yield from ({name: s} for name, s in self.controls.items())

    @property
    def rows(self) -> int:
        """Rows of the largest set."""
        return max(len(s.ids) for s in (self.reference, *self.generators.values()))


@dataclass(frozen=True)
class Pairs:
    """Images of generators and controls, each paired with the reference's by position.

    Attributes:
        images: subject -> (n, h, w, 3).
        generators: names of the subjects between which differences are made.
        reference: (n, h, w, 3).
        background: no-contact images of the reference, or None.
        ids, groups: of the reference's samples.
        split: digest of the split, or None.
        weights: for LPIPS.
        progress: called with what is done.
    """

    images: Mapping[str, Images]
    generators: Sequence[str]
    reference: Images
    background: Images | None
    ids: Sequence[str]
    groups: Sequence[str] | None
    split: str | None
    weights: Weights
    progress: Progress

    @property
    def common(self) -> dict[str, Any]:
        """What every metric of pairs takes."""
        return {"ids": self.ids, "groups": self.groups, "split": self.split}


@dataclass(frozen=True)
class Chosen:
    """Companions: on the encoder's features, on those of standard encoders, on pairs of images."""

    default: bool
    features: Sequence[str]
    standard: Sequence[str]
    pairs: Sequence[str]


def choose(
    requested: Sequence[str] | None,
    weights: Weights,
    *,
    images: bool,
    encoder: bool,
    background: bool,
) -> Chosen:
    """Sort the requested companions by what they need; None means all whose inputs are there.

    ``images``, ``encoder`` and ``background`` say whether there are images (else embeddings),
    features of an encoder, and backgrounds of the reference.

    Raises:
        PalpateError: for an unknown name, or a companion whose inputs are not there.
    """
    has = {name: weights.for_features(name)[1] is not None for name in FEATURES if name != "prdc"}
    able = {name: encoder or has.get(name, False) for name in FEATURES}
    able |= dict.fromkeys(PAIRS, images)
    able |= {"contact": images and background, "lpips": images and weights.lpips is not None}
    names = list(dict.fromkeys(requested or ()))
    if requested is None:
        names = [name for name in able if able[name] and (name != "cmmd" or has[name])]
    if lacking := next((name for name in names if not able.get(name)), None):
        raise _lacking(lacking, weights, images=images)
    standard = [n for n in names if has.get(n)]
    features = [n for n in names if n in FEATURES and n not in standard]
    return Chosen(requested is None, features, standard, [n for n in names if n in PAIRS])


def _lacking(name: str, weights: Weights, *, images: bool) -> PalpateError:
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
    fix = "Pass an encoder"
    if name != "prdc":
        from palpate.encoders.inception import FIX

        kind = weights.for_features(name)[0]
        where = {"inception": FIX, "clip": f"Fetch one with: hf download {CMMD_CLIP}"}
        fix = f"{fix}, or weights of {kind}. {where[kind]}"
    must = "must need no features of images without an encoder"
    return refusal(must, name, fix, example={"encoder": "palpate/mini"})


def score_features(names: Sequence[str], features: Features, default: bool) -> Outcome:
    """Compute companions, among :data:`FEATURES`, on given features.

    By ``default`` nobody requested them: one that raises, or forms too many pairs, becomes a note.
    """
    outcome = Outcome()
    for name in (n for n in FEATURES if n in names):
        if default and name != "fid" and features.rows > MANY:
            outcome.notes.append(Note("too-many-rows", {"name": name, "rows": MANY}))
            continue
        _attempt(outcome, name, lambda name=name: FEATURES[name](features), default)
    return outcome


def score_pairs(names: Sequence[str], pairs: Pairs, *, default: bool) -> Outcome:
    """Compute companions on pairs of images; arguments as :func:`score_features`."""
    outcome, chosen = Outcome(), [n for n in PAIRS if n in names]
    for done, name in enumerate(chosen):
        pairs.progress("comparing images", done, len(chosen))
        _attempt(outcome, name, lambda name=name: PAIRS[name](pairs), default)
    pairs.progress("comparing images", len(chosen), len(chosen))
    return outcome


def _attempt(outcome: Outcome, name: str, run: Callable[[], Outcome], default: bool) -> None:
    try:
        outcome.add(run())
    except PalpateError as error:
        if not default:
            raise
        params = {"name": name, "must": error.must, "got": error.got}
        outcome.notes.append(Note("companion-skipped", params))


def _compared(
    compare: Callable[..., Any], features: Features, metric: str, **options: Any
) -> Outcome:
    """Scores and differences of ``compare``, which say what they are of."""
    outcome = Outcome()
    for sets in features.batches():
        result = compare(sets, features.reference, **features.settings.common, **options)
        outcome.scores += _named(result.scores, metric, features)
        outcome.differences += _named(result.differences, metric, features)
    return outcome


def _fid(features: Features) -> Outcome:
    return _compared(compare_fid, features, "FID")


def _cmmd(features: Features) -> Outcome:
    settings = features.settings
    return _compared(
        compare_tmmd,
        features,
        "CMMD",
        preset="cmmd",
        permutations=settings.permutations,
        normalize=settings.normalize,
    )


def _kid(features: Features) -> Outcome:
    outcome = _compared(
        compare_tmmd,
        features,
        "KID",
        kernel=Polynomial(),
        preset="paper",
        normalize=False,
        permutations=0,
    )
    for scores in (outcome.scores, outcome.differences):
        noted = [Note("kid-interval")] if scores is outcome.scores else []
        for k, s in enumerate(scores):
            settings = {key: value for key, value in s.settings.items() if key != "preset"}
            scores[k] = replace(s, settings=settings, notes=[*noted, *s.notes])
    return outcome


def _prdc(features: Features) -> Outcome:
    outcome = Outcome()
    for sets in features.batches():
        first = next(iter(sets.values()))
        split = features.settings.split
        results = {
            name: prdc_rows(s.take(list(first.ids)), features.reference, subject=name, split=split)
            for name, s in sets.items()
        }
        # Precision and density average over generated rows, recall and coverage over real ones.
        groups = (first.groups, features.reference.groups) * 2
        for k, metric_groups in enumerate(groups):
            scores = {name: s[k] for name, (s, _) in results.items()}
            if len(sets) > 1:
                values = {name: rows[s[k].metric] for name, (s, rows) in results.items()}
                one = next(iter(scores.values()))
                units = metric_groups if one.settings["grouped"] else None
                between = mean_differences(scores, values, units)
                outcome.differences += _named(between, one.metric, features)
            for s in scores.values():
                outcome.scores += _named([s], s.metric, features)
    return outcome


def _named(scores: Sequence[Score], metric: str, features: Features) -> list[Score]:
    """Scores of a metric that say where the features come from."""
    return [replace(s, metric=metric, features=features.name) for s in scores]


def _mean_of_pairs(pairs: Pairs, metric: Literal["SSIM", "PSNR", "MS-SSIM"]) -> Outcome:
    images = pairs.images.items()
    return _scored(pairs, {name: per_image(metric, x, pairs.reference) for name, x in images})


def _scored(pairs: Pairs, each: Mapping[str, PerImage]) -> Outcome:
    """Scores of one metric, with differences between the generators."""
    scores = {name: e.score(subject=name, **pairs.common) for name, e in each.items()}
    outcome = Outcome([*scores.values()])
    if len(pairs.generators) > 1:
        compared = {name: scores[name] for name in pairs.generators}
        values = {name: each[name].values for name in pairs.generators}
        outcome.differences += mean_differences(compared, values, pairs.groups)
    return outcome


def _contact(pairs: Pairs) -> Outcome:
    each = contact_per_image(pairs.images, pairs.reference, pairs.background, pairs.ids)
    outcome = Outcome()
    for of_metric in zip(*each.values(), strict=True):
        outcome.add(_scored(pairs, dict(zip(each, of_metric, strict=True))))
    return outcome


def _lpips(pairs: Pairs) -> Outcome:
    from palpate.encoders.perceptual import load_lpips, lpips_per_image

    assert pairs.weights.lpips is not None  # `choose` requires it
    network, real = load_lpips(*map(Path, pairs.weights.lpips)), pairs.reference
    size = [int(v) for v in real.shape[1:3]]
    return _scored(
        pairs,
        {
            name: PerImage(
                "LPIPS",
                lpips_per_image(x, real, network, progress=pairs.progress),
                settings={"network": "alex", "version": "0.1", "size": size},
                higher_is_better=False,
                encoder=network.digest,
            )
            for name, x in pairs.images.items()
        },
    )


FEATURES: Mapping[str, Callable[[Features], Outcome]] = {
    "fid": _fid,
    "kid": _kid,
    "prdc": _prdc,
    "cmmd": _cmmd,
}
PAIRS: Mapping[str, Callable[[Pairs], Outcome]] = {
    "ssim": partial(_mean_of_pairs, metric="SSIM"),
    "psnr": partial(_mean_of_pairs, metric="PSNR"),
    "ms-ssim": partial(_mean_of_pairs, metric="MS-SSIM"),
    "contact": _contact,
    "lpips": _lpips,
}
