"""Photos of a world's samples under another appearance, as files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
from PIL import Image

from palpate.core import Progress, quiet, require_rows
from palpate.data.manifest import Manifest
from palpate.sim.appearance import Appearance
from palpate.sim.options import WorldOptions
from palpate.sim.plan import contact_row
from palpate.sim.world import World


def with_photos(
    manifest: Manifest,
    options: WorldOptions,
    appearance: Appearance,
    output: Path,
    *,
    progress: Progress = quiet,
) -> Manifest:
    """Write the photos of a world's samples under another appearance; tactile images stay.

    Args:
        manifest: samples of the world, or some of them.
        options: of the world.
        appearance: one of :data:`palpate.sim.appearance.APPEARANCES`.
        output: folder for the photos, ``<id>.jpg`` in the quality of the world's.
        progress: called with the number of photos.

    Returns:
        The manifest with these photos.

    Raises:
        PalpateError: if a sample is not of this world, or the appearance is unknown.
    """
    world = World(options, appearance=appearance)
    must, fix = "Every sample must be of the world", "Pass the options that the world was made with"
    rows, plans = require_rows(world.ids, manifest.ids, must, fix), world.plans
    paths: list[str] = []
    for done, (k, name) in enumerate(zip(rows, manifest.ids, strict=True), 1):
        row = contact_row(options, plans, k)
        path = (output / f"{name}.jpg").resolve()
        path.parent.mkdir(parents=True, exist_ok=True)
        photo = world.video(row.video).vision(row.frame)
        Image.fromarray(np.asarray(photo)).save(path, "JPEG", quality=95, subsampling=0)
        paths.append(str(path))
        progress(f"photos, {appearance}", done, len(rows))
    return replace(manifest, table=manifest.table.with_columns(pl.Series("vision", paths)))
