"""``palpate train autoencoder``: train or fine-tune the autoencoder of a generator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from palpate.cli.presets import Training, preset_flags, with_flags
from palpate.cli.terminal import Terminal, require_extra
from palpate.diffusion.presets import PRESETS, DiffusionPreset

_SKIP = ("name", "latent_scale", "epochs", "unet", "condition", "loop", "schedule", "sampler")
_FLAGS = ("autoencoder", _SKIP)
_Preset = preset_flags("Preset", DiffusionPreset, *_FLAGS)


@dataclass(frozen=True, kw_only=True)
class Options(Training):
    """Train the autoencoder of tactile images that a generator works in, and print its ceiling."""

    preset: Literal["mini", "small", "tiny"] = "mini"
    """`mini` and `small` (128 pixels) code the difference to the gel without contact (column
    background); `tiny` is a VQ model."""
    start: str | None = None
    """Fine-tune this one: a folder, a hub id, or palpate/mini. Default: random weights."""
    judge: str = "palpate/mini"
    """Encoders whose tactile encoder judges, by TMMD and by material, what survives of images
    outside of train: a folder, a public tactile encoder, palpate/mini, or none."""
    fields: _Preset = field(default_factory=_Preset)  # pyright: ignore[reportInvalidTypeForm]
    """Fields of the preset."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Train, and print how well images outside of train are reconstructed."""
    require_extra("palpate train autoencoder")
    options.require_data()
    from palpate.diffusion.autoencoders import train_autoencoder

    machine = options.machine
    with terminal.progress() as progress:
        model = train_autoencoder(
            options.data,
            options.split,
            preset=with_flags(PRESETS[options.preset], options.fields, *_FLAGS),
            start=options.start,
            judge=options.judge,
            output=options.output,
            seed=options.seed,
            device=machine.device,
            compute=machine.compute,
            progress=progress,
        )
    facts: dict[str, Any] = {"folder": str(options.output), "digest": model.digest}
    facts |= {"images": model.card["images"], "split": model.card["split"]}
    facts |= {f"ceiling_{name}": value for name, value in model.card.get("ceiling", {}).items()}
    terminal.facts(f"Autoencoder {options.output}", facts)
    return facts
