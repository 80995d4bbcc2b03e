"""From a manifest, a split and encoders to a saved-able pipeline: encode once, then train the denoiser (paper section 2).

Only the train part of the split is read. Touches go through the frozen autoencoder and texts and photos through
the frozen encoders once, into caches keyed by digest; the training loop reads those.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import numpy as np

from palpate import __version__
from palpate.core import PalpateError, Progress, Split, digest_json, quiet
from palpate.data.images import cached_images, image_stamp
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import Autoencoder
from palpate.diffusion.denoiser import Source
from palpate.diffusion.latents import LatentStats, encode_latents
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import DiffusionPreset
from palpate.diffusion.training import train_denoiser
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import EncoderSet, pick_device


def train_pipeline(
    manifest: Manifest,
    split: Split,
    encoders: EncoderSet,
    autoencoder: Autoencoder,
    preset: DiffusionPreset,
    folder: Path,
    *,
    seed: int = 0,
    steps: int | None = None,
    source: Literal["text", "vision", "mixed"] | None = None,
    background: bool = False,
    start: TactilePipeline | None = None,
    cache: Path | None = None,
    device: str = "auto",
    progress: Progress = quiet,
) -> TactilePipeline:
    """Trains a generator on the train part of a split; run again to resume.

    Args:
        manifest: samples with touch and photo, and a text or a material.
        split: its digest goes into the pipeline.
        encoders: their text embeddings condition the training, their vision embeddings the sampling.
        autoencoder: frozen.
        preset: geometry, schedule, length, sampler.
        folder: for checkpoints and latents; nothing in it belongs to the pipeline.
        seed: of weights, order, noise and condition dropout.
        steps: instead of the preset's length.
        source: instead of the preset's; ``vision`` is the baseline without text (GVST).
        background: the variant w/ BG, which sees the latent of the no-contact image.
        start: go on from this pipeline's denoiser instead of random weights; it must use the same autoencoder, vision encoder and
            schedule, gives its latent statistics, and its record goes into the new one, so that what it saw stays declared.
        cache: folder for decoded pixels and embeddings.
        device: see :func:`palpate.encoders.encoder_set.pick_device`.
        progress: told what is being done.

    Raises:
        PalpateError: if the train part is empty, a sample lacks what is needed, or ``start`` does not fit.
    """
    train = manifest.part(split, "train")
    if not len(train):
        raise PalpateError(
            "The train part of the split must hold samples of this manifest",
            "none",
            "Make a split with: palpate split",
        )
    place = pick_device(device)
    encoders.to(device)
    autoencoder.to(place)
    _, text_source = texts_of(train)
    conditions: dict[Source, np.ndarray] = {
        "text": embed(train, encoders, "text", cache=cache, progress=progress).features,
        "vision": embed(train, encoders, "vision", cache=cache, progress=progress).features,
    }
    latents = _latents(train, "tactile", autoencoder, preset, folder, cache, progress)
    grounds = (
        _latents(train, "background", autoencoder, preset, folder, cache, progress)
        if background
        else None
    )
    if start is not None:
        _require_same(start, encoders, autoencoder, preset)
    stats = LatentStats.of(latents, preset.latent_scale) if start is None else start.stats
    policy = preset.condition_for(encoders.dim)
    policy = policy if source is None else replace(policy, source=source)
    loop = preset.loop_for(len(train), seed=seed)
    loop = loop if steps is None else replace(loop, steps=steps)
    denoiser = train_denoiser(
        latents,
        conditions,
        stats=stats,
        unet=preset.unet,
        policy=policy,
        schedule=preset.schedule,
        loop=loop,
        folder=folder / "denoiser",
        background=grounds,
        start=start.denoiser if start else None,
        device=place,
        progress=progress,
    )
    record = {
        "manifest": manifest.digest,
        "split": split.digest,
        "split_rule": dict(split.rule),
        "train_samples": len(train),
        "text_source": text_source,
        "autoencoder": autoencoder.digest,
        "vision": encoders.digest("vision"),
        "text": encoders.digest("text"),
        "source": policy.source,
        "background": background,
        "loop": asdict(loop),
        "unet": asdict(preset.unet),
        "seed": seed,
        "palpate": __version__,
        "parameters": sum(p.numel() for p in denoiser.unet.parameters()),
        "synthetic": bool(manifest.facts.get("synthetic")),
        "materials": sorted({str(m) for m in train.column("material") if m}),
        "start": start.digest if start else None,
        "start_record": dict(start.training) if start else None,
    }
    # The pipeline carries the frozen pair alone: the tactile encoder scores, it does not generate.
    return TactilePipeline(
        autoencoder,
        denoiser,
        stats,
        preset.schedule,
        preset.sampler,
        preset.size,
        EncoderSet(encoders.clip),
        preset.name,
        record,
    )


def _require_same(
    start: TactilePipeline, encoders: EncoderSet, autoencoder: Autoencoder, preset: DiffusionPreset
) -> None:
    """A denoiser goes on only in the space that it knows."""
    vision = start.encoders.digest("vision") if start.encoders else None
    pairs = {
        "autoencoder": (start.autoencoder.digest, autoencoder.digest),
        "vision encoder": (vision, encoders.digest("vision")),
        "schedule": (start.schedule, preset.schedule),
    }
    if other := [name for name, (theirs, ours) in pairs.items() if theirs != ours]:
        got = f"another {', another '.join(other)}"
        raise PalpateError(
            "The pipeline to start from must share autoencoder, vision encoder and schedule",
            got,
            "Leave it out",
        )


def _latents(
    train: Manifest,
    column: str,
    autoencoder: Autoencoder,
    preset: DiffusionPreset,
    folder: Path,
    cache: Path | None,
    progress: Progress,
) -> np.ndarray:
    """Latents of one image column, (n, c, h, w), from the cache in ``folder`` if it fits."""
    images = cached_images(train, column, preset.size, cache, progress)
    key = digest_json([train.digest, image_stamp(train, column), preset.size])
    return encode_latents(
        autoencoder, images, train.ids, folder / f"latents-{column}", key=key, progress=progress
    )
