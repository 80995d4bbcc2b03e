"""Small helpers of the pipeline's stages: what a data set is named by, what it must not be, and how sets are mixed."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core import PalpateError, Progress, Split, digest_lines, read_json
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import Autoencoder
from palpate.diffusion.autoencoder_training import measure_reconstruction


def require_unseen(source: Path) -> None:
    """The shipped models were trained on worlds of reserved seeds; what they have seen cannot judge them.

    Raises:
        PalpateError: if ``source`` is such a world, by its ``world.json``.
    """
    mark = source / "world.json"
    if mark.is_file() and read_json(mark, "world record").get("seen_by_shipped_models"):
        fix = "Write a world of another --seed, or pass --from-scratch"
        raise PalpateError("The shipped models must not have been trained on the data that they are judged on", f"{source}", fix)


def reconstruction(
    manifest: Manifest, split: Split, autoencoder: Autoencoder, size: int, cache: Path, progress: Progress
) -> dict[str, Any]:
    """How well an autoencoder gives the test touches back (``size`` pixels a side): no generator that uses it can do better."""
    return asdict(measure_reconstruction(autoencoder, cached_images(manifest.part(split, "test"), "tactile", size, cache, progress)))


def fresh(folder: Path) -> Path:
    """The folder, without what a call that was killed between saving and finishing its stage left in it."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def repeats(others: int, mine: int, share: float) -> int:
    """How often ``mine`` (already there once among ``others``) must be added to be ``share`` of the whole; at most 8 times."""
    rest = max(0, others - mine)
    return int(np.clip(np.ceil(share / (1 - share) * rest / max(1, mine)) - 1, 0, 8))


def stamp_of(source: Path) -> str:
    """Names, sizes and modification times of the files below ``source``: changes when the data set does."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    return digest_lines(f"{p.relative_to(source)} {(s := p.stat()).st_size} {s.st_mtime_ns}" for p in files)
