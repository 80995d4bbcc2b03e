"""Small helpers of the pipeline's stages: what a data set is named by, what it must not be, and how sets are mixed."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core import PalpateError, Progress, Split, digest_lines, read_json
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import Autoencoder
from palpate.diffusion.autoencoder_training import measure_reconstruction
from palpate.sim.presets import MINI_SEEDS


def require_unseen(source: Path, facts: Mapping[str, str] | None = None) -> None:
    """The shipped models were trained on worlds of reserved seeds; what they have seen cannot judge them.

    Args:
        source: what was named, or where its images lie: a world, or any file or folder of one. The nearest ``world.json`` there or
            above tells.
        facts: of the manifest that was made of it; they name the world's seed where the world's own files are out of sight.

    Raises:
        PalpateError: if it is, or belongs to, such a world.
    """
    place = Path(source).resolve()
    mark = next(
        (m for folder in (place, *place.parents) if (m := folder / "world.json").is_file()), None
    )
    record = read_json(mark, "world record") if mark is not None else {}
    seen = isinstance(record, dict) and bool(record.get("seen_by_shipped_models"))
    seed = (facts or {}).get("world_seed", "")
    if seen or (seed.isdecimal() and int(seed) in MINI_SEEDS):
        fix = "Write a world of another --seed, or pass --from-scratch"
        raise PalpateError(
            "The shipped models must not have been trained on the data that they are judged on",
            f"{source}",
            fix,
        )


def reconstruction(
    manifest: Manifest,
    split: Split,
    autoencoder: Autoencoder,
    size: int,
    cache: Path,
    progress: Progress,
) -> dict[str, Any]:
    """How well an autoencoder gives the test touches back (``size`` pixels a side): no generator that uses it can do better."""
    return asdict(
        measure_reconstruction(
            autoencoder,
            cached_images(manifest.part(split, "test"), "tactile", size, cache, progress),
        )
    )


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
    return digest_lines(
        f"{p.relative_to(source)} {(s := p.stat()).st_size} {s.st_mtime_ns}" for p in files
    )
