"""``palpate train generator``: train a generator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from palpate.cli.presets import Training, fields_given, preset_flags, print_plan, with_flags
from palpate.cli.terminal import Switch, Terminal, require_extra
from palpate.core import PalpateError
from palpate.diffusion.options import Sources
from palpate.diffusion.presets import PRESETS, DiffusionPreset

_SKIP = ("name", "loop.steps", "loop.seed", "condition.width", "condition.source")
_FLAGS = ("loop", _SKIP)
_Preset = preset_flags("Preset", DiffusionPreset, *_FLAGS)


@dataclass(frozen=True, kw_only=True)
class Options(Training):
    """Train a generator of tactile images: conditioned on text, later driven by photos."""

    clip: str | None = None
    """Encoders that condition the generator: folder of `palpate train encoder` or of a CLIP, hub
    id, or palpate/mini. `--source resnet` needs none."""
    autoencoder: str | None = None
    """Pretrained autoencoder: folder or hub id of a diffusers VQModel, a .ckpt of latent diffusion
    (vq-f4), or palpate/mini. Default: a small one, trained first on the train part."""
    unet: str | None = None
    """Trained U-Net of diffusers to go on from: folder or hub id of it or of its generator.
    Default: random weights."""
    start: str | None = None
    """Generator of palpate to go on from: its folder, or palpate/mini. Its encoders and autoencoder
    stand for those that are not given, and the preset gives the training loop alone. Default:
    random weights."""
    preset: Literal["mini", "tiny", "small", "paper"] = "mini"
    """Geometry, schedule and length: `small` for one small GPU, `paper` is the paper's."""
    source: Sources | None = None
    """What training conditions on: `resnet` is GVST, the baseline without text and encoders;
    `vision` is it with the encoder's photo. Default: the preset's."""
    background: Switch = False
    """The variant that also sees the no-contact image."""
    judge: str = "palpate/mini"
    """Encoders whose tactile encoder judges, by TMMD and by material, what of images outside of
    train survives the autoencoder; or none."""
    steps: int | None = None
    """Optimizer steps. Default: the preset's."""
    dry_run: Switch = False
    """Print parameters, steps and time, and stop."""
    fields: _Preset = field(default_factory=_Preset)  # pyright: ignore[reportInvalidTypeForm]
    """Fields of the preset; `--autoencoder-...` are of the autoencoder that is trained first."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Train the autoencoder, if none is given, then the denoiser, and save the pipeline."""
    require_extra("palpate train generator")
    for each in fields_given(DiffusionPreset, options.fields, *_FLAGS) if options.start else ():
        if each.path.split(".")[0] not in ("loop", "epochs"):
            must = "must be left out with a generator to go on from, which keeps its own"
            got = f"--start {options.start}"
            raise PalpateError(must, got, "Leave one out", argument=each.flag)
    preset = with_flags(PRESETS[options.preset], options.fields, *_FLAGS)
    options.require_data()
    from palpate.diffusion.training import plan_generator, train_generator

    data, machine = (options.data, options.split), options.machine
    if options.dry_run:
        how: dict[str, Any] = {"autoencoder": options.autoencoder, "unet": options.unet}
        how |= {"start": options.start, "source": options.source, "device": machine.device}
        how |= {"background": options.background, "steps": options.steps}
        plan = plan_generator(*data, options.clip, preset=preset, **how)
        return print_plan(terminal, f"Plan of {options.output}", plan)
    with terminal.progress() as progress:
        pipeline = train_generator(
            *data,
            options.clip,
            preset=preset,
            autoencoder=options.autoencoder,
            unet=options.unet,
            start=options.start,
            output=options.output,
            source=options.source,
            background=options.background,
            judge=options.judge,
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
        "processes": record["processes"],
        "text_source": record["text_source"],
        "source": record["source"],
        "background": record["background"],
    }
    facts |= {f"ceiling_{name}": value for name, value in (record["ceiling"] or {}).items()}
    terminal.facts(f"Generator {options.output}", facts)
    return facts
