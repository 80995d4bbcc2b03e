"""Ruler features of all that is scored in one call: one kind of background, one standardization.

A ruler's numbers are centered and divided by the reference's mean and deviation, then
L2-normalized; for scores without a reference (I-, CI- and D-TMMD) by those in the encoder, so that
they are the same next to any reference with the same backgrounds. Digest of encoder, kind and
standardization together name the features, so that scores of different ones share no column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from palpate.core import FeatureSet, Note, digest_file, digest_json, save_image
from palpate.data.manifest import Manifest
from palpate.data.residuals import MEDIANS, Kind, with_gels
from palpate.data.samples import Samples
from palpate.evaluation.controls import rows_of_material
from palpate.metrics.retrieval import standardized, unit_rows
from palpate.report.tables import SAME_MATERIAL

if TYPE_CHECKING:
    from palpate.evaluation.scorers import Bench


@dataclass(frozen=True)
class Ruled:
    """A set with its features by a ruler, standardized by the reference and by the encoder."""

    samples: Samples
    compared: FeatureSet
    alone: FeatureSet


def ruler_features(bench: Bench) -> list[Ruled]:
    """Every set of the bench with its features."""
    # A control of real train images takes their features: its ids, but not its gels, are others'.
    drawn = [s for s in bench.controls.values() if s.source == SAME_MATERIAL]
    some = (bench.reference, *bench.subjects.values(), bench.train, bench.seen)
    sets = [s for s in some if s is not None and s not in drawn]
    real = bench.reference
    if real.rows is not None and real.ruled:
        arrays = [s.rows for s in sets if s.rows is not None]
        kind, encoder, first = real.made["background"], real.made["encoder"], real.encoder
        gels: list[str] = real.made["gels"]
    else:
        kind, embedded, gels = _embedded(bench, sets)
        arrays, encoder = [e.features for e in embedded], _digest(bench)
        first = embedded[0].encoder
    bench.notes.append(Note("background-kind", {"kind": kind}))
    rows = [x.astype(np.float64) for x in arrays]
    for samples in drawn:
        train = next(k for k, s in enumerate(sets) if s is bench.train)
        sets.append(samples)
        rows.append(rows[train][rows_of_material(bench)])
    compared, scales = standardized(rows, rows[0])
    digests = digest_json([encoder, kind, scales]), digest_json([first, gels])
    return [
        Ruled(s, s.feature_set(x, digests[0]), s.feature_set(unit_rows(y), digests[1]))
        for s, x, y in zip(sets, compared, rows, strict=True)
    ]


def _digest(bench: Bench) -> str:
    assert bench.encoders is not None  # whose ruler it is
    return bench.encoders.digest("tactile")


def _embedded(bench: Bench, sets: Sequence[Samples]) -> tuple[Kind, list[FeatureSet], list[str]]:
    """The kind of background, raw features of images, and digests of the reference's own gels."""
    from palpate.encoders.embed import embed

    encoders = bench.encoders
    assert encoders is not None  # whose ruler it is
    folder = bench.cache / "rulers"
    real, *others = (_of_files(s, folder) for s in sets)
    also = [k for k, s in enumerate(sets[1:]) if s is bench.train or s is bench.seen]
    kind, parts = with_gels(real, others, folder, real=also)
    caches = [s.folder(folder) if bench.keep else None for s in sets]
    embedded = [
        embed(p, encoders, cache=cache, still=True, raw=True, progress=bench.progress)
        for p, cache in zip(parts, caches, strict=True)
    ]
    # Medians are the reference's own, and one gel for all is stated: others give other features.
    own = kind in MEDIANS or bench.reference.gel is not None
    gels = sorted({*parts[0].column("background")}) if own else []
    return kind, embedded, [digest_file(Path(gel)) for gel in gels]


def _of_files(samples: Samples, folder: Path) -> Manifest:
    """A manifest of image files, with the one background of all if there is one."""
    manifest, columns = samples.manifest, list[pl.Series]()
    if samples.rows is not None:
        place = samples.folder(folder)
        files = [_saved(row, place / f"{k}.png") for k, row in enumerate(samples.rows)]
        columns.append(pl.Series("tactile", files, pl.String))
    if samples.gel is not None:
        gel = _saved(samples.gel, samples.folder(folder) / "background.png")
        columns.append(pl.Series("background", [gel] * len(samples), pl.String))
    return replace(manifest, table=manifest.table.with_columns(columns))


def _saved(image: np.ndarray, file: Path) -> str:
    save_image(file, image)
    return str(file.resolve())
