"""Latents, encoded once: a memory-mapped cache of what the frozen autoencoder gives before quantization.

A cache is ``latents.npy`` (float32, (n, c, h, w)) with ``latents.json`` beside it, which holds the ids in order
and a key; it is used again only if both are the same. The statistics by which latents are normalized,

    z' = (z - mean_c) / std_c      (``scale="std"``)        z' = z      (``scale="one"``, the paper's preset)

are those of the training part; mean and standard deviation are recorded in either case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from palpate.core import (
    PalpateError,
    Progress,
    atomic_path,
    digest_json,
    quiet,
    read_json,
    write_json,
)
from palpate.diffusion.autoencoder import Autoencoder

FORMAT = "palpate-latents/1"


class ImageRows(Protocol):
    """Anything whose slices are bytes (k, h, w, 3): an array, a memory map, a reader of files."""

    def __getitem__(self, rows: slice, /) -> np.ndarray: ...


@dataclass(frozen=True)
class LatentStats:
    """Mean and standard deviation of each latent channel on the training part, and whether they are applied.

    Attributes:
        mean, std: one number a channel.
        scale: ``std`` applies them, ``one`` only records them.
    """

    mean: tuple[float, ...]
    std: tuple[float, ...]
    scale: Literal["std", "one"] = "std"

    @classmethod
    def of(cls, latents: Tensor | np.ndarray, scale: Literal["std", "one"] = "std") -> LatentStats:
        """The statistics of latents (n, c, h, w), summed in double precision."""
        total, square, count = 0.0, 0.0, 0
        for k in range(0, len(latents), 256):
            part = np.asarray(latents[k : k + 256], dtype=np.float64)
            total = total + part.sum(axis=(0, 2, 3))
            square = square + (part**2).sum(axis=(0, 2, 3))
            count += part.shape[0] * part.shape[2] * part.shape[3]
        if not count:
            raise PalpateError(
                "Latent statistics need at least one image",
                "none",
                "Check the split: is its train part empty?",
            )
        mean = np.asarray(total) / count
        std = np.sqrt(np.maximum(np.asarray(square) / count - mean**2, 1e-12))
        return cls(tuple(float(v) for v in mean), tuple(float(v) for v in std), scale)

    def normalize(self, latents: Tensor) -> Tensor:
        """Latents of the autoencoder -> what the denoiser sees."""
        return (
            latents
            if self.scale == "one"
            else (latents - _column(self.mean, latents)) / _column(self.std, latents)
        )

    def restore(self, latents: Tensor) -> Tensor:
        """The inverse of :meth:`normalize`."""
        return (
            latents
            if self.scale == "one"
            else latents * _column(self.std, latents) + _column(self.mean, latents)
        )


def _column(values: tuple[float, ...], like: Tensor) -> Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device).reshape(1, -1, 1, 1)


def encode_latents(
    autoencoder: Autoencoder,
    images: ImageRows,
    ids: Sequence[str],
    folder: Path,
    *,
    key: str = "",
    batch: int = 32,
    progress: Progress = quiet,
) -> np.ndarray:
    """Latents of all images as a read-only memory map; encoded only if the cache holds something else.

    Args:
        autoencoder: frozen; its digest is part of the cache's key.
        images: rows of bytes (n, h, w, 3), in the order of ``ids``.
        ids: sample ids.
        folder: where ``latents.npy`` lies or will lie.
        key: digest of what the images are (manifest, column, size).
        batch: images at once.
        progress: called after each batch.

    Returns:
        float32 (n, c, h / f, w / f).
    """
    data, note = folder / "latents.npy", folder / "latents.json"
    about = {"format": FORMAT, "key": digest_json([key, autoencoder.digest]), "ids": list(ids)}
    if data.is_file() and note.is_file() and read_json(note, "latent cache") == about:
        return np.load(data, mmap_mode="r", allow_pickle=False)
    folder.mkdir(parents=True, exist_ok=True)
    note.unlink(missing_ok=True)
    with atomic_path(data) as part:
        store = None
        for start in range(0, len(ids), batch):
            z = autoencoder.encode(images[start : min(start + batch, len(ids))], batch).numpy()
            if store is None:
                store = np.lib.format.open_memmap(
                    part, mode="w+", dtype=np.float32, shape=(len(ids), *z.shape[1:])
                )
            store[start : start + len(z)] = z
            progress("encoding touches", start + len(z), len(ids))
        if store is None:
            raise PalpateError("There must be images to encode", "none", "Check the split")
        store.flush()
    write_json(note, about)
    return np.load(data, mmap_mode="r", allow_pickle=False)
