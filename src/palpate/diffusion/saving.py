"""The folder of a saved pipeline.

::

    model_index.json  the parts and their classes, as diffusers writes them
    unet/          the denoiser, diffusers' format, and condition.safetensors (means, memory, maps,
                   touches)
    autoencoder/   the autoencoder, diffusers' format, and its palpate.json
    encoders/      the vision (and text) encoder whose embeddings the denoiser knows
    scheduler/     scheduler_config.json, diffusers' format: for programs that read only the parts
    gel.png        the stock gel without contact, of a generator that is given one
    range.json     what its training saw (``training_range``), to say what is unlike it
    palpate.json   preset, condition policy, schedule, sampler, latent statistics, what strength,
                   force and depth of contacts mean, record, digest
    README.md      the card for people

A pipeline trained on the encoders and autoencoder of a shipped model may refer to them instead of
carrying copies: ``"shared"`` in ``palpate.json`` names the model. Their digests are recorded in
either case and checked on loading.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from palpate._version import __version__
from palpate.core import atomic_folder, save_image, write_json
from palpate.training.cards import write_model_cards

if TYPE_CHECKING:
    from palpate.diffusion.pipeline import TactilePipeline

FORMAT = "palpate-pipeline/1"
KEYS = (
    *("digest", "preset", "size", "condition", "schedule", "sampler", "latents"),
    *("autoencoder", "encoders", "training"),
)


def write_pipeline(
    pipeline: TactilePipeline, folder: Path, *, half: bool, shared: str | None
) -> None:
    """Write a pipeline as :meth:`TactilePipeline.save` says."""
    with atomic_folder(folder) as part:
        pipeline.denoiser.save(part / "unet", half=half)
        if pipeline.gel is not None:
            save_image(part / "gel.png", pipeline.gel)
        if pipeline.seen is not None:
            pipeline.seen.save(part)
        if shared is None:
            pipeline.autoencoder.save(part / "autoencoder", half=half)
            if pipeline.encoders is not None:
                pipeline.encoders.save(part / "encoders", half=half)
        pipeline.scheduler.save_pretrained(part / "scheduler")
        index = json.loads(pipeline.to_json_string())
        absent = {} if shared is None else {"autoencoder": [None, None]}
        write_json(part / "model_index.json", index | absent)
        encoders = pipeline.encoders
        about = {
            "format": FORMAT,
            "digest": pipeline.digest,
            "preset": pipeline.preset,
            "size": pipeline.size,
            "background": pipeline.background,
            "condition": asdict(pipeline.denoiser.policy),
            "schedule": asdict(pipeline.schedule),
            "sampler": asdict(pipeline.sampler),
            "latents": asdict(pipeline.stats) | {"factor": pipeline.autoencoder.factor},
            "contact": asdict(pipeline.contact) if pipeline.contact else None,
            "autoencoder": pipeline.autoencoder.digest,
            "encoders": encoders.digest("vision") if encoders else None,
            "training": dict(pipeline.training),
            "palpate": __version__,
            **({} if shared is None else {"shared": shared}),
        }
        write_json(part / "palpate.json", about)
        write_model_cards(part)
