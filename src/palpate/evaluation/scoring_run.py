"""One call of :func:`palpate.evaluation.score`: features, their scores, clusters for labels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from palpate.core import FeatureSet, Note, PalpateError, Progress, Score, require, rng_for
from palpate.evaluation.companions import (
    Chosen,
    Features,
    Outcome,
    Pairs,
    Settings,
    Weights,
    score_features,
    score_pairs,
)
from palpate.evaluation.controls import control_samples, material_accuracies
from palpate.evaluation.family import Family, score_family
from palpate.evaluation.inputs import Inputs, from_reference
from palpate.evaluation.memorization import FEATURES, PIXELS, contact_rows, memorization
from palpate.evaluation.samples import Samples

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest
    from palpate.encoders.encoder_set import EncoderSet


@dataclass(frozen=True, kw_only=True)
class ScoringRun:
    """One call of :func:`palpate.evaluation.score`.

    Attributes:
        inputs: what is scored, against what.
        family: presets and bandwidths.
        settings: what the metrics have in common.
        encoders: whose tactile encoder gives the features of images, or None.
        weights: those that palpate does not ship.
        cache: folder for embeddings and decoded images.
        keep: whether the folder outlives the call.
        progress: called with what is done.
        seen: what the generators were trained on, if that is known.
    """

    inputs: Inputs
    family: Family
    settings: Settings
    encoders: EncoderSet | None
    weights: Weights
    cache: Path
    keep: bool
    progress: Progress
    seen: Samples | None = None

    def score(self, chosen: Chosen, *, pairs: bool, controls: bool) -> Outcome:
        """Everything that is scored."""
        real, generators = self.inputs.reference, self.inputs.generators
        images = real.features is None
        encoder = self.encoders is not None or not images
        controls = controls and encoder and images and self.inputs.train is not None
        extra: dict[str, Samples] = {}
        if controls:
            size, seed = self._size(), self.settings.seed
            extra = control_samples(self.inputs, size, seed, self.cache, self.progress)
        numbered = all(s.numbered for s in generators.values())
        paired = not numbered or len({len(s) for s in generators.values()}) == 1  # by id, or by row
        reference = self._features(real)
        train = self._features(self.inputs.train) if self.inputs.train and encoder else None
        features = Features(
            {name: self._features(s) for name, s in generators.items()},
            {name: self._features(s) for name, s in extra.items()},
            reference,
            paired,
            "tactile" if images else "embeddings",
            self.settings,
        )
        outcome = Outcome(notes=list(self.inputs.notes))
        if numbered and len(generators) > 1:
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

    def clustered(self, count: int) -> tuple[ScoringRun, str]:
        """The same samples with clusters of the reference for labels, and what was clustered.

        Photos say more of a material than touch does, and no generator is judged by its own.

        Raises:
            PalpateError: with too few samples, or generators of other ids.
        """
        from scipy.cluster.vq import kmeans2

        real = self.inputs.reference
        manifest = real.manifest
        photos = manifest is not None and not manifest.table["vision"].null_count()
        if self.encoders is not None and manifest is not None and photos:
            from palpate.encoders.embed import embed

            features = embed(manifest, self.encoders, "vision", progress=self.progress)
            origin = "photos"
        elif self.encoders is not None or real.features is not None:
            features, origin = self._features(real), "the reference's features"
        else:
            fix, example = "Pass an encoder", {"encoder": "palpate/mini"}
            must, got = "must be a file where there are no features", "clusters"
            raise PalpateError(must, got, fix, argument="labels", example=example)
        rows = np.asarray(features.features, np.float64)
        distinct = np.unique(rows, axis=0)
        must, got = "must leave four samples a cluster", f"{count} of {len(distinct)}"
        enough = len(distinct) >= 4 * count
        require(enough, "labels", must, f"{got} different samples", fix="Choose fewer")
        rng = rng_for(self.settings.seed, "clusters")
        first = distinct[rng.choice(len(distinct), count, replace=False)]
        number = kmeans2(rows, first, iter=100, minit="matrix")[1]
        real = replace(real, labels=[f"cluster {k + 1}" for k in number])
        generators = {
            name: from_reference(replace(s, labels=None), real)
            for name, s in self.inputs.generators.items()
        }
        must = "must be a file where generated and real images share no ids"
        for samples in generators.values():
            require(samples.labels is not None, "labels", must, f"clusters for {samples.source}")
        train = self.inputs.train and replace(self.inputs.train, labels=None)
        inputs = replace(self.inputs, generators=generators, reference=real, train=train)
        return replace(self, inputs=inputs), origin

    def _memorization(self, train: Samples) -> list[Score]:
        """How near each generator's images lie to its train images, in every space there is."""
        real, generators = self.inputs.reference, self.inputs.generators
        split, scores = self.settings.split, list[Score]()
        if self.encoders is not None or real.features is not None:
            test, base = self._features(real), self._features(train)
            for name, samples in generators.items():
                x = self._features(samples)
                scores += memorization(x, test, base, space=FEATURES, subject=name, split=split)
        if real.features is not None:
            return scores
        train = replace(train, background=train.background or real.background)
        paired = all({*samples.ids} <= {*real.ids} for samples in generators.values())
        gels = real.has_background and train.has_background and paired
        seen = train.pixels(self._size(), self.cache, self.progress)
        mean = None if gels else np.mean(seen, axis=0, dtype=np.float64)
        settings = {"ground": "no-contact images" if gels else "mean train image"}
        base = self._contact_rows(train, train, mean)
        test = self._contact_rows(real, real, mean)
        for name, samples in generators.items():
            scores += memorization(
                self._contact_rows(samples, real, mean),
                test,
                base,
                space=PIXELS,
                subject=name,
                split=split,
                settings=settings,
            )
        return scores

    def _contact_rows(self, samples: Samples, real: Samples, mean: Any) -> FeatureSet:
        """Pixels without what is there before contact: no-contact images of ``real``, or a mean."""
        size = self._size()
        images = samples.pixels(size, self.cache, self.progress)
        if mean is None:
            partners = real if samples is real else real.take(samples.ids)
            mean = partners.pixels(size, self.cache, self.progress, "background")
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
        x = embed(
            self._in_context(samples),
            self.encoders,
            cache=folder,
            still=True,
            progress=self.progress,
        )
        return samples.feature_set(x.features, digest)

    def _in_context(self, samples: Samples) -> Manifest:
        """The images with what is known of the reference's sample of the same id: its sensor, and
        its no-contact image.
        """
        import polars as pl

        real, manifest = self.inputs.reference.manifest, samples.manifest
        assert manifest is not None
        assert self.encoders is not None
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
        real, generators, outcome = self.inputs.reference, self.inputs.generators, Outcome()
        subjects, size = {**generators, **controls}, self._size()
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
            context = Pairs(
                images,
                [*generators],
                reference,
                gel,
                real.ids,
                groups,
                self.settings.split,
                self.weights,
                self.progress,
            )
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
            digest = clip.digest("vision")
            embed = partial(embed_images, encoders=clip, modality="vision", progress=self.progress)
        embedded = {n: s.feature_set(embed(images[n]), digest) for n, s in subjects.items()}
        return replace(
            features,
            generators={n: embedded[n] for n in features.generators},
            controls={n: embedded[n] for n in features.controls},
            reference=self.inputs.reference.feature_set(embed(reference), digest),
            name={"inception": "Inception", "clip": "CLIP"}[name],
        )
