"""``palpate train``: train a generator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal, require_extra, working_folder
from palpate.core import PalpateError


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Train a generator of tactile images on the train part of a split: conditioned on text, later driven by photos."""

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest file or the folder of an import."""
    split: Path
    """Split file; only its train part is read."""
    encoders: str
    """Folder of `palpate encoder`, a hub id, or palpate/mini, which ships with palpate."""
    output: OutPath
    """Folder for the pipeline; must be new or empty."""
    autoencoder: str | None = None
    """Hub id or folder of a pretrained VQ model (diffusers VQModel), or palpate/mini. Default: a small one, trained first on the train part."""
    preset: Literal["mini", "tiny", "paper"] = "mini"
    """Geometry, schedule and length; `paper` is the paper's, for GPUs."""
    source: Literal["text", "vision", "mixed"] | None = None
    """What training conditions on; `vision` is the baseline without text (GVST). Default: the preset's."""
    background: bool = False
    """The variant that also sees the no-contact image."""
    steps: int | None = None
    """Optimizer steps instead of the preset's."""
    seed: int = 0
    """Of weights, order, noise and condition dropout."""
    device: str = "auto"
    """auto, cpu, cuda, mps."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Trains the autoencoder, if none is given, then the denoiser, and saves the pipeline."""
    require_extra("palpate train")
    from palpate.core import Split
    from palpate.data.images import cached_images, image_stamp
    from palpate.data.manifest import Manifest
    from palpate.diffusion.autoencoder import Autoencoder
    from palpate.diffusion.autoencoder_training import train_autoencoder
    from palpate.diffusion.presets import preset_named
    from palpate.diffusion.recipe import train_pipeline
    from palpate.encoders.encoder_set import EncoderSet, pick_device

    if options.steps is not None and options.steps < 1:
        raise PalpateError(
            "--steps must be at least 1", str(options.steps), "Leave it out for the preset's length"
        )
    manifest, split, chosen = (
        Manifest.load(options.manifest),
        Split.load(options.split),
        preset_named(options.preset),
    )
    encoders = EncoderSet.load(options.encoders)
    with working_folder(options.output, terminal) as work, terminal.progress() as progress:
        if options.autoencoder:
            autoencoder = Autoencoder.load(options.autoencoder)
        elif chosen.autoencoder is None:
            raise PalpateError(
                f"The preset {chosen.name} needs a trained autoencoder",
                "none",
                "Pass --autoencoder HUB_ID_OR_FOLDER",
            )
        else:
            train, test = manifest.part(split, "train"), manifest.part(split, "val", "test")
            images = cached_images(train, "tactile", chosen.size, work / "cache", progress)
            held_out = (
                cached_images(test, "tactile", chosen.size, work / "cache", progress)
                if len(test)
                else None
            )
            autoencoder = train_autoencoder(
                images,
                chosen.autoencoder,
                work / "autoencoder",
                held_out=held_out,
                seed=options.seed,
                key=image_stamp(train, "tactile"),
                device=pick_device(options.device),
                progress=progress,
            )
        pipeline = train_pipeline(
            manifest,
            split,
            encoders,
            autoencoder,
            chosen,
            work,
            seed=options.seed,
            steps=options.steps,
            source=options.source,
            background=options.background,
            cache=work / "cache",
            device=options.device,
            progress=progress,
        )
        pipeline.save(options.output)
    loop = pipeline.training["loop"]
    facts = {
        "folder": str(options.output),
        "digest": pipeline.digest,
        "parameters": pipeline.training["parameters"],
        "steps": loop["steps"],
        "batch": loop["batch"],
        "effective_learning_rate": loop["lr"],
        "source": pipeline.training["source"],
        "background": options.background,
    }
    terminal.facts(f"Generator {options.output}", facts)
    return facts
