"""Clusters in place of materials, for CI- and D-TMMD of samples whose materials are not known.

K-means of the reference's photos: they say more of a material than touch does, and no generator is
judged by its own images. Without photos or encoder, of the reference's features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from palpate.core import Note, Score, require, rng_for
from palpate.data.samples import Samples, labeled_as

if TYPE_CHECKING:
    from palpate.evaluation.scorers import Bench


def clustered(bench: Bench, count: int) -> tuple[Bench, str]:
    """The same samples with clusters of the reference for materials, and what was clustered.

    Raises:
        PalpateError: with too few samples, or generators of other ids.
    """
    from scipy.cluster.vq import kmeans2

    real, encoders = bench.reference, bench.encoders
    photos = real.rows is None and not real.manifest.table["vision"].null_count()
    must, fix = "must be a file where there are no features", "Pass an encoder"
    require(encoders is not None or real.embedded, "labels", must, "clusters", fix=fix)
    photos = photos and encoders is not None and "vision" in encoders.modalities
    if encoders is not None and photos:
        from palpate.encoders.embed import embed

        features = embed(real.manifest, encoders, "vision", progress=bench.progress)
    else:
        features = bench.features(real)
    rows = np.asarray(features.features, np.float64)
    distinct = np.unique(rows, axis=0)
    must, got = "must leave four samples a cluster", f"{count} of {len(distinct)}"
    enough = len(distinct) >= 4 * count
    require(enough, "labels", must, f"{got} different samples", fix="Choose fewer")
    rng = rng_for(bench.seed, "clusters")
    first = distinct[rng.choice(len(distinct), count, replace=False)]
    number = kmeans2(rows, first, iter=100, minit="matrix")[1]
    real = real.with_columns(pl.Series("material", [f"cluster {k + 1}" for k in number]))
    generators = {name: labeled_as(_bare(s), real) for name, s in bench.generators.items()}
    must = "must be a file where generated and real images share no ids"
    for samples in generators.values():
        require(samples.labels is not None, "labels", must, f"clusters for {samples.source}")
    train = bench.train and _bare(bench.train)
    bench = replace(bench, generators=generators, reference=real, train=train)
    return bench, "photos" if photos else "the reference's features"


def _bare(samples: Samples) -> Samples:
    return samples.with_columns(pl.lit(None, pl.String).alias("material"))


def of_clusters(scores: Sequence[Score], count: int, origin: str) -> list[Score]:
    """Scores that looked at classes, and their differences, say that these are clusters."""
    of_classes = {s.measure for s in scores if "classes" in s.details}
    note = Note("pseudo-labels", {"clusters": count, "of": origin})
    return [
        replace(
            s,
            settings={**s.settings, "labels": f"cluster:{count} of {origin}"},
            notes=[*s.notes, note],
        )
        if s.measure in of_classes
        else s
        for s in scores
    ]
