"""``palpate train encoder``: train the tactile encoder."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from palpate.cli.terminal import Switch, Terminal, require_extra
from palpate.cli.training import PRESETS, EncoderMachine, Training, print_plan


@dataclass(frozen=True, kw_only=True)
class Options(Training):
    """Train the tactile encoder against frozen vision and text encoders (three-way InfoNCE)."""

    clip: str | None = None
    """Hub id or folder of a pretrained CLIP, or palpate/mini. Default: the preset's, or a small one
    that is trained first on the same train part."""
    epochs: float | None = None
    """Passes over the train part. Default: the preset's."""
    machine: EncoderMachine = field(default_factory=EncoderMachine)
    """How to run it on the machine at hand."""
    dry_run: Switch = False
    """Print parameters, steps and time, and stop."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Train, and print the accuracy of a linear material probe on the test part."""
    require_extra("palpate train encoder")
    preset = PRESETS["train encoder"].preset(options.preset, options.settings)
    options.require_data()
    from palpate.encoders.contrastive import plan_encoder, train_encoder

    if options.dry_run:
        plan = plan_encoder(
            options.data,
            options.split,
            preset=preset,
            epochs=options.epochs,
            device=options.machine.device,
        )
        return print_plan(terminal, f"Plan of {options.output}", plan)
    with terminal.progress() as progress:
        encoders = train_encoder(
            preset=preset, progress=progress, **options.keywords("preset", "settings", "dry_run")
        )
    facts: dict[str, Any] = {
        "folder": str(options.output),
        "tactile": encoders.digest("tactile"),
        "clip": encoders.name,
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
