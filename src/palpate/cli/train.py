"""``palpate train generator``: train a generator."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.presets import Machine, preset_flags, print_plan, with_flags
from palpate.cli.terminal import Common, OutPath, Switch, Terminal, require_extra
from palpate.diffusion.presets import PRESETS, DiffusionPreset

_SKIP = ("name", "loop.steps", "loop.seed", "condition.width", "condition.source")
_FLAGS = ("loop", _SKIP)
_Preset = preset_flags("Preset", DiffusionPreset, *_FLAGS)


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Train a generator of tactile images: conditioned on text, later driven by photos."""

    data: Annotated[Path, tyro.conf.Positional]
    """Manifest file, the folder of an import, or a data set."""
    clip: str
    """Encoders that condition the generator: folder of `palpate train encoder` or of a CLIP, hub
    id, or palpate/mini."""
    output: OutPath
    """Folder for the pipeline; must be new or empty."""
    autoencoder: str | None = None
    """Hub id or folder of a pretrained VQ model (diffusers VQModel), or palpate/mini. Default: a
    small one, trained first on the train part."""
    split: Path | None = None
    """Split file; only its train part is trained on. Default: the one that lies with the data, in
    `splits/`."""
    preset: Literal["mini", "tiny", "paper"] = "mini"
    """Geometry, schedule and length; `paper` is the paper's, for GPUs."""
    source: Literal["text", "vision", "mixed"] | None = None
    """What training conditions on; `vision` is the baseline without text (GVST). Default: the
    preset's."""
    background: Switch = False
    """The variant that also sees the no-contact image."""
    steps: int | None = None
    """Optimizer steps. Default: the preset's."""
    seed: int = 0
    """Of weights, order, noise and condition dropout."""
    dry_run: Switch = False
    """Print parameters, memory, operations and time, and stop."""
    machine: Machine = field(default_factory=Machine)
    """How to run it on the machine at hand."""
    fields: _Preset = field(default_factory=_Preset)  # pyright: ignore[reportInvalidTypeForm]
    """Fields of the preset; `--autoencoder-...` are of the autoencoder that is trained first."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Train the autoencoder, if none is given, then the denoiser, and save the pipeline."""
    require_extra("palpate train generator")
    from palpate.diffusion.training import plan_generator, train_generator

    preset = with_flags(PRESETS[options.preset], options.fields, *_FLAGS)
    data, machine = (options.data, options.split), options.machine
    if options.dry_run:
        how: dict[str, Any] = {"background": options.background, "device": machine.device}
        plan = plan_generator(*data, preset=preset, steps=options.steps, **how)
        return print_plan(terminal, f"Plan of {options.output}", plan)
    with terminal.progress() as progress:
        pipeline = train_generator(
            *data,
            options.clip,
            preset=preset,
            autoencoder=options.autoencoder,
            output=options.output,
            source=options.source,
            background=options.background,
            steps=options.steps,
            seed=options.seed,
            device=machine.device,
            compute=machine.compute,
            progress=progress,
        )
    record = pipeline.training
    facts = {
        "folder": str(options.output),
        "digest": pipeline.digest,
        "parameters": record["parameters"],
        "steps": record["loop"]["steps"],
        "batch": record["loop"]["batch"],
        "learning_rate": record["loop"]["lr"],
        "learning_rate_if_the_batch_is_each_of_two_gpus": 2 * record["loop"]["lr"],
        "processes": record["processes"],
        "text_source": record["text_source"],
        "source": record["source"],
        "background": record["background"],
    }
    terminal.facts(f"Generator {options.output}", facts)
    return facts
