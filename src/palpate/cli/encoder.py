"""``palpate train encoder``: train the tactile encoder."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Annotated, Any

import tyro

from palpate.cli.terminal import Switch, Terminal, option_group
from palpate.cli.training import EncoderMachine, Training
from palpate.core import require


@option_group
class Options(Training):
    """Train a tactile encoder against frozen vision and text encoders, or by touches alone."""

    alone: Annotated[Switch, tyro.conf.arg(name="self")] = False
    """Learn from your touches alone, without photos, texts and labels (the preset self): the
    shipped encoder goes on, or that of `--clip`; held-out recordings choose the length."""
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
    if options.alone:
        must, fix = "must be left out beside --self, which is a preset", "Leave one out"
        require(options.preset in ("mini", "self"), "preset", must, options.preset, fix=fix)
        options = replace(options, preset="self")
    preset = options.chosen("train encoder")
    from palpate.encoders.contrastive import plan_encoder, train_encoder

    if options.dry_run:
        plan = plan_encoder(
            options.data,
            options.split,
            preset=preset,
            epochs=options.epochs,
            device=options.machine.device,
        )
        return options.print_plan(terminal, plan)
    encoders = options.trained(
        terminal, train_encoder, **options.keywords("settings", "dry_run", "alone", preset=preset)
    )
    card = encoders.card
    options.note_split(terminal, card["split_rule"])
    facts: dict[str, Any] = {
        "folder": str(options.output),
        "tactile": encoders.digest("tactile"),
        "clip": encoders.name,
        **{name: card[name] for name in ("split", "text_source", "processes")},
        "learning_rate": card["options"]["lr"],
    }
    if missing := card.get("without_photo"):
        facts["samples_without_photo"] = missing
    for row in card.get("scores", ()):
        facts["test_material_accuracy"] = row["value"]
        facts |= {name: row[name] for name in ("interval", "chance")}
    return terminal.facts(f"Encoders {options.output}", facts)
