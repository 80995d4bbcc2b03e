"""``palpate train generator``: train a generator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from palpate.cli.terminal import Switch, Terminal, option_group
from palpate.cli.training import Training
from palpate.core import PalpateError, require


@option_group
class Options(Training):
    """Train a generator of tactile images: latent diffusion, conditioned on text or photo."""

    clip: str | None = None
    """Frozen encoders of text and photo, whose embeddings condition the generator: folder of
    `palpate train encoder` or of a CLIP, hub id, or palpate/mini. `--set condition.source=resnet`
    needs none."""
    autoencoder: str | None = None
    """Pretrained autoencoder: folder or hub id of a diffusers VQModel, a .ckpt of vq-f4 of latent
    diffusion, or palpate/mini. Default: a small one, trained first on the train part."""
    start: str | None = None
    """Generator of palpate to go on from: its folder, or palpate/mini. It brings its encoders and
    autoencoder, unless others are given; of the preset only the training loop (`loop.`) counts.
    Default: random weights."""
    background: Switch = False
    """The denoiser also sees the no-contact image of each sample."""
    judge: str = "palpate/mini"
    """Encoders whose tactile encoder measures what the autoencoder loses: how far its
    reconstructions of real images outside of train are from them, by TMMD and by material; or
    none."""
    epochs: int | None = None
    """Passes over the train part. Default: the preset's length."""
    steps: int | None = None
    """Optimizer steps, in place of epochs. Default: the preset's length."""
    dry_run: Switch = False
    """Train nothing; print parameters, steps and the expected time."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Train the autoencoder, if none is given, then the denoiser, and save the pipeline."""
    preset = options.chosen("train generator")
    for setting in (text for texts in options.settings for text in texts):
        if options.start and not setting.startswith("loop."):
            must = f"{setting} must be left out with a generator to go on from, which keeps its own"
            got = f"--start {options.start}"
            raise PalpateError(must, got, "Leave one out", argument="set")
    if options.epochs is not None:
        require(options.epochs >= 1, "epochs", "must be at least 1", options.epochs)
        require(options.steps is None, "epochs", "must be left out beside steps", options.epochs)
        preset = replace(preset, epochs=options.epochs)
    from palpate.diffusion.training import plan_generator, train_generator

    if options.dry_run:
        plan = plan_generator(
            options.data,
            options.split,
            options.clip,
            preset=preset.with_steps(options.steps),
            autoencoder=options.autoencoder,
            start=options.start,
            background=options.background,
            device=options.machine.device,
        )
        return options.print_plan(terminal, plan)
    pipeline = options.trained(
        terminal,
        train_generator,
        **options.keywords("settings", "epochs", "dry_run", preset=preset),
    )
    record, loop = pipeline.training, pipeline.training["loop"]
    options.note_split(terminal, record["split_rule"])
    facts = {
        "folder": str(options.output),
        "digest": pipeline.digest,
        "parameters": record["parameters"],
        **{name: loop[name] for name in ("steps", "batch")},
        "learning_rate": loop["lr"],
        **{name: record[name] for name in ("processes", "text_source", "source", "background")},
    }
    facts |= {f"ceiling_{name}": value for name, value in (record["ceiling"] or {}).items()}
    return terminal.facts(f"Generator {options.output}", facts)
