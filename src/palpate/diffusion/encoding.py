"""Latents and patches of a data set, encoded once into memory maps that training reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress, atomic_path, digest_json, quiet, read_json, short, write_json
from palpate.data.images import image_stamp
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import AnyAutoencoder
from palpate.encoders.embed import exact
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.preprocess import prepared_images, to_unit

CACHE_FORMAT = "palpate-latents/1"


def encode_latents(
    autoencoder: AnyAutoencoder,
    images: NDArray[np.uint8],
    background: NDArray[np.uint8] | None,
    *,
    ids: Sequence[str],
    folder: Path,
    key: str = "",
    batch: int = 32,
    progress: Progress = quiet,
) -> NDArray[np.float32]:
    """Latents of all images, before quantization, as a read-only memory map; encoded once.

    Args:
        autoencoder: frozen; its digest is part of the cache's key.
        images: (n, h, w, 3) bytes, in the order of ``ids``; an array or a memory map.
        background: of the same gels, for an autoencoder that is given them.
        ids: sample ids.
        folder: holds ``latents.npy`` and ``latents.json``, the ids in order and a key.
        key: digest of what the images are (manifest, column, size).
        batch: images at once.
        progress: called after each batch.

    Returns:
        float32 (n, c, h / f, w / f).
    """

    def code(rows: slice) -> NDArray[np.float32]:
        gels = () if background is None else (background[rows],)
        return autoencoder.encode(images[rows], *gels, batch=batch).numpy()

    about = {"key": digest_json([key, autoencoder.digest]), "ids": list(ids)}
    how: dict[str, Any] = {"batch": batch, "progress": progress, "what": "encoding tactile images"}
    return _mapped(folder / "latents", about, code, **how)


def encode_patches(
    part: Manifest, encoders: EncoderSet, count: int, *, folder: Path, progress: Progress = quiet
) -> NDArray[np.float16]:
    """States of the photos' patches (see ``ClipEncoders.patches``), as a read-only memory map.

    Returns:
        float16 (n, count, width).
    """
    preprocess = encoders.preprocess("vision")
    images = prepared_images(part, "vision", preprocess, folder)

    def code(rows: slice) -> NDArray[np.float16]:
        with exact():
            pixels = preprocess(to_unit(images[rows], encoders.device))
            return encoders.clip.patches(pixels, count).half().cpu().numpy()

    key = [encoders.digest("vision"), image_stamp(part, "vision"), count]
    about = {"key": digest_json(key), "ids": part.ids}
    file = folder / f"vision-states-{short(digest_json(about))}"
    return _mapped(file, about, code, progress=progress, what="encoding vision")


def _mapped(
    file: Path,
    about: Mapping[str, Any],
    code: Callable[[slice], NDArray[Any]],
    *,
    batch: int = 32,
    progress: Progress,
    what: str,
) -> NDArray[Any]:
    """What ``code`` gives for all rows, as a memory map; computed once, while ``about`` is so."""
    data, note, n = file.with_suffix(".npy"), file.with_suffix(".json"), len(about["ids"])
    about = {"format": CACHE_FORMAT, **about}
    if not (data.is_file() and note.is_file() and read_json(note, "latent cache") == about):
        note.unlink(missing_ok=True)
        with atomic_path(data) as part:
            first = code(slice(0, min(batch, n)))
            shape = (n, *first.shape[1:])
            store = np.lib.format.open_memmap(part, mode="w+", dtype=first.dtype, shape=shape)
            for start in range(0, n, batch):
                rows = slice(start, min(start + batch, n))
                store[rows] = code(rows) if start else first
                progress(what, rows.stop, n)
            store.flush()
        write_json(note, about)
    return np.load(data, mmap_mode="r", allow_pickle=False)
