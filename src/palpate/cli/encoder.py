"""``palpate train encoder``: train the tactile encoder."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from palpate.cli.presets import EncoderPresetName, Training, preset_flags, print_plan, with_flags
from palpate.cli.terminal import Switch, Terminal, require_extra
from palpate.encoders.presets import PRESETS, EncoderPreset

_SKIP = ("name", "cost", "pretrained", "tactile_course.epochs", "targets")
#: Of the vision and text encoders that are trained first where none are given.
_CLIP = ("clip_course", "vision", "text", "dim", "vocabulary", "context")
_FLAGS = ("tactile_course", _SKIP + _CLIP)
_Preset = preset_flags("Preset", EncoderPreset, *_FLAGS)


@dataclass(frozen=True, kw_only=True)
class Options(Training):
    """Train the tactile encoder against frozen vision and text encoders (three-way InfoNCE)."""

    clip: str | None = None
    """Hub id or folder of a pretrained CLIP, or palpate/mini. Default: the preset's, or a small one
    that is trained first on the same train part."""
    preset: EncoderPresetName = "mini"
    """Size and course; `tvl-*` are TVL's and `paper` is the paper's, for GPUs."""
    epochs: float | None = None
    """Default: the preset's."""
    targets: Literal["diagonal", "identical-text", "soft-text"] | None = None
    """`diagonal` is the paper's loss; `identical-text` counts equal captions as positives;
    `soft-text` is TVL's. Default: the preset's."""
    dry_run: Switch = False
    """Print parameters, steps and time, and stop."""
    fields: _Preset = field(default_factory=_Preset)  # pyright: ignore[reportInvalidTypeForm]
    """Fields of the preset."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Train, and print the accuracy of a linear material probe on the test part."""
    require_extra("palpate train encoder")
    options.require_data()
    from palpate.encoders.contrastive import plan_encoder, train_encoder

    preset = with_flags(PRESETS[options.preset], options.fields, *_FLAGS)
    data, machine = (options.data, options.split), options.machine
    if options.dry_run:
        how: dict[str, Any] = {"epochs": options.epochs, "device": machine.device}
        plan = plan_encoder(*data, preset=preset, **how)
        return print_plan(terminal, f"Plan of {options.output}", plan)
    with terminal.progress() as progress:
        encoders = train_encoder(
            *data,
            preset=preset,
            clip=options.clip,
            output=options.output,
            epochs=options.epochs,
            targets=options.targets,
            seed=options.seed,
            device=machine.device,
            compute=machine.compute,
            progress=progress,
        )
    facts: dict[str, Any] = {
        "folder": str(options.output),
        "tactile": encoders.digest("tactile"),
        "clip": encoders.clip.name,
        "split": encoders.card["split"],
        "text_source": encoders.card["text_source"],
        "processes": encoders.card["processes"],
        "learning_rate": encoders.card["options"]["lr"],
    }
    if missing := encoders.card.get("without_photo"):
        facts["samples_without_photo"] = missing
    for row in encoders.card.get("scores", ()):
        facts["test_material_accuracy"] = row["value"]
        facts |= {"interval": row["interval"], "chance": row["chance"]}
    terminal.facts(f"Encoders {options.output}", facts)
    return facts
