"""A part of a data set, encoded once into memory maps that training reads: latents of its tactile
images, and what conditions on its photos and texts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from palpate.core import Progress, cached, digest_json, quiet, short
from palpate.data.images import cached_images, image_stamp, mapped
from palpate.data.manifest import CONTACT, Manifest
from palpate.diffusion.autoencoder import AnyAutoencoder, BackgroundAutoencoder
from palpate.diffusion.contact import marks_of
from palpate.diffusion.denoiser import inputs_of
from palpate.diffusion.denoiser_training import Rows
from palpate.diffusion.gels import gels_of, has_gels
from palpate.diffusion.options import ConditionPolicy
from palpate.encoders.embed import embed, exact
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import digest_tensors, to_unit
from palpate.metrics.conditions import contact_conditions
from palpate.training.run import TrainingRun

CACHE_FORMAT = "palpate-latents/1"


def encode_part(
    part: Manifest,
    policy: ConditionPolicy,
    size: int,
    run: TrainingRun,
    *,
    encoders: EncoderSet | None,
    autoencoder: AnyAutoencoder,
    columns: Sequence[str],
    background: bool,
    like: NDArray[np.uint8] | None = None,
) -> Rows:
    """Encode a part, or find it in the cache.

    Args:
        part: samples.
        policy: says what conditions.
        size: side of the tactile images [px].
        run: its cache, else its folder, holds the memory maps.
        encoders: of photos and texts, where the policy needs them.
        autoencoder: of the tactile images.
        columns: of the images: ``tactile``, and ``background`` where the gels are used.
        background: whether the denoiser sees the gels, the variant w/ BG.
        like: gels of the train part, of which the first is the stock gel.
    """
    cache, progress = run.cache, run.progress
    folder, own = cache or run.folder, isinstance(autoencoder, BackgroundAutoencoder)
    gels: Any = None
    if own:
        gels = gels_of(part, size, cache, progress, like)
    elif "background" in columns:
        gels = cached_images(part, "background", size, cache, progress)
    images = cached_images(part, "tactile", size, cache, progress)
    stamps = [image_stamp(part, column) for column in columns]
    if own and gels is not None:  # the stock gel is that of train
        stamps.append(digest_tensors({"gel": torch.from_numpy(np.array(gels[0]))}))
    key = digest_json([part.digest, *stamps, size])
    conditions: dict[str, NDArray[Any]] = {}
    if encoders is not None:
        for s in policy.modalities:
            conditions[s] = embed(part, encoders, s, cache=cache, progress=progress).features
        if "patches" in inputs_of(policy):
            conditions["patches"] = encode_patches(
                part, encoders, policy.patches, folder=folder, progress=progress
            )
    if "photos" in inputs_of(policy):
        conditions["photos"] = cached_images(part, "vision", policy.photo_size, cache, progress)

    def code(pixels: NDArray[np.uint8], ground: NDArray[np.uint8] | None, name: str) -> Any:
        file = folder / f"{name}-{short(digest_json([CACHE_FORMAT, key, autoencoder.digest]))}.npy"
        return encode_latents(autoencoder, pixels, ground, file=file, progress=progress)

    latents, seen = code(images, gels if own else None, "latents"), None
    if background:
        assert gels is not None
        if isinstance(autoencoder, BackgroundAutoencoder):
            seen = lambda rows, _: autoencoder.gel(gels[rows])
        else:
            coded = code(gels, None, "gel-latents")
            seen = lambda rows, stats: stats.normalize(torch.as_tensor(coded[rows]))
    rows = Rows(latents, conditions, seen, part.ids, gels=gels)
    if not policy.contact:
        return rows
    assert isinstance(autoencoder, BackgroundAutoencoder)
    assert gels is not None
    contacts = _contacts(part, images, gels, folder / f"contacts-{short(key)}.npy", progress)
    key = digest_json([CACHE_FORMAT, key, autoencoder.digest, contacts[:, 4:6].tolist()])
    marks = _mapped(
        folder / f"marks-{short(key)}.npy",
        len(part),
        lambda of: marks_of(autoencoder, gels[of], contacts[of, 4:6]).half().numpy(),
        progress=progress,
        task="moving markers",
    )
    return replace(rows, contacts=contacts, marks=marks)


def _contacts(
    part: Manifest,
    images: NDArray[np.uint8],
    gels: NDArray[np.uint8],
    file: Path,
    progress: Progress,
) -> NDArray[np.float64]:
    """(n, 8) what the manifest says of the contacts, else what the images show."""
    said = np.full((len(part), len(CONTACT)), np.nan)
    for k, name in enumerate(CONTACT):
        if name in part.table.columns:
            said[:, k] = part.table[name].fill_null(np.nan).to_numpy()
    if not has_gels(part):
        return said
    shown = _mapped(
        file,
        len(part),
        lambda of: contact_conditions(images[of], gels[of]),
        progress=progress,
        task="measuring contacts",
    )
    shown = np.hstack([shown, np.full((len(part), 2), np.nan)])  # force and depth are not shown
    return np.where(np.isfinite(said), said, shown)


def encode_latents(
    autoencoder: AnyAutoencoder,
    images: NDArray[np.uint8],
    background: NDArray[np.uint8] | None,
    *,
    file: Path,
    batch: int = 32,
    progress: Progress = quiet,
) -> NDArray[np.float32]:
    """Latents of all images, before quantization, as a read-only memory map; encoded once.

    Args:
        autoencoder: frozen.
        images: (n, h, w, 3) bytes, an array or a memory map.
        background: of the same gels, for an autoencoder that is given them.
        file: ``.npy`` whose name says of which images, and of which autoencoder.
        batch: images at once.
        progress: called after each batch.

    Returns:
        float32 (n, c, h / f, w / f).
    """

    def code(rows: slice) -> NDArray[np.float32]:
        gels = None if background is None else background[rows]
        return autoencoder.encode(images[rows], gels, batch=batch).numpy()

    task = "encoding tactile images"
    return _mapped(file, len(images), code, batch=batch, progress=progress, task=task)


def encode_patches(
    part: Manifest, encoders: EncoderSet, count: int, *, folder: Path, progress: Progress = quiet
) -> NDArray[np.float16]:
    """States of the photos' patches (see ``EncoderSet.patches``), as a read-only memory map.

    Returns:
        float16 (n, count, width).
    """
    preprocess = encoders.preprocess("vision")
    images = cached_images(part, "vision", preprocess, folder)

    def code(rows: slice) -> NDArray[np.float16]:
        with exact():
            pixels = preprocess(to_unit(images[rows], encoders.device))
            return encoders.patches(pixels, count).half().cpu().numpy()

    key = [CACHE_FORMAT, encoders.digest("vision"), image_stamp(part, "vision"), count, part.ids]
    file = folder / f"vision-states-{short(digest_json(key))}.npy"
    return _mapped(file, len(part), code, progress=progress, task="encoding vision")


def _mapped(
    file: Path,
    n: int,
    code: Callable[[slice], NDArray[Any]],
    *,
    batch: int = 32,
    progress: Progress,
    task: str,
) -> NDArray[Any]:
    """What ``code`` gives for ``n`` rows, as a memory map; computed once."""

    def fill(part: Path) -> None:
        first = code(slice(0, min(batch, n)))
        shape = (n, *first.shape[1:])
        store = np.lib.format.open_memmap(part, mode="w+", dtype=first.dtype, shape=shape)
        for start in range(0, n, batch):
            rows = slice(start, min(start + batch, n))
            store[rows] = code(rows) if start else first
            progress(task, rows.stop, n)
        store.flush()

    return cached(file, fill, mapped, progress)
