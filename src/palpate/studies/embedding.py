"""Features of generated images with what is known of their samples."""

from __future__ import annotations

from dataclasses import replace

from palpate.core import FeatureSet, Progress, quiet
from palpate.data.manifest import Manifest
from palpate.diffusion.generation import Generated
from palpate.encoders.embed import embed
from palpate.encoders.encoder_set import EncoderSet


def generated_manifest(generated: Generated, manifest: Manifest) -> Manifest:
    """The samples of a folder of generated images, with these as their tactile images.

    Materials, videos, sensors and no-contact images are those of the manifest's samples.

    Raises:
        PalpateError: if an id is not in the manifest.
    """
    import polars as pl

    part = manifest.take(generated.ids)
    paths = [str(generated.path(i).resolve()) for i in generated.ids]
    return replace(part, table=part.table.with_columns(pl.Series("tactile", paths)))


def embed_generated(
    generated: Generated, manifest: Manifest, encoders: EncoderSet, progress: Progress = quiet
) -> FeatureSet:
    """Tactile features (n, d) of generated images, with material and video of their samples."""
    part = generated_manifest(generated, manifest)
    return embed(part, encoders, "tactile", still=True, progress=progress)
