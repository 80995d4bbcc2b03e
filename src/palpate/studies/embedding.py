"""Features of generated images with what is known of their samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from palpate.core import FeatureSet, Progress, quiet
from palpate.data.manifest import Manifest
from palpate.encoders.embed import embed
from palpate.encoders.encoder_set import EncoderSet
from palpate.evaluation.inputs import read


def embed_generated(
    images: Path, manifest: Manifest, encoders: EncoderSet, progress: Progress = quiet
) -> FeatureSet:
    """Tactile features (n, d) of generated images.

    Materials, videos, sensors and no-contact images are those of the manifest's samples.

    Args:
        images: a folder of ``palpate generate``, or one with a manifest.
        manifest: samples of the same ids, and perhaps others.
        encoders: with a tactile one.
        progress: progress callback.

    Raises:
        PalpateError: if the folder is none of images, or an id is not in the manifest.
    """
    import polars as pl

    made = read(str(images), "generated").manifest
    assert made is not None  # a folder holds images
    paths = [str(path.resolve()) for path in made.paths("tactile")]
    part = manifest.take(made.ids)
    part = replace(part, table=part.table.with_columns(pl.Series("tactile", paths)))
    return embed(part, encoders, "tactile", still=True, progress=progress)
