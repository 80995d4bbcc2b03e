"""``palpate train autoencoder``: train or fine-tune the autoencoder of a generator."""

from __future__ import annotations

from typing import Any

from palpate.cli.terminal import Terminal, option_group
from palpate.cli.training import Training


@option_group
class Options(Training):
    """Train the autoencoder of tactile images that a generator works in, and print its ceiling.

    `mini` and `small` (128 pixels) code the difference to the gel without contact (column
    background); `tiny` is a VQ model.
    """

    start: str | None = None
    """Fine-tune this one: a folder, a hub id, or palpate/mini. Default: random weights."""
    judge: str = "palpate/mini"
    """Encoders whose tactile encoder judges, by TMMD and by material, what survives of images
    outside of train: a folder, a public tactile encoder, palpate/mini, or none."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Train, and print how well images outside of train are reconstructed."""
    preset = options.chosen("train autoencoder")
    from palpate.diffusion.autoencoder_training import train_autoencoder

    model = options.trained(
        terminal, train_autoencoder, **options.keywords("settings", preset=preset)
    )
    options.note_split(terminal, model.card["split_rule"])
    facts: dict[str, Any] = {"folder": str(options.output), "digest": model.digest}
    facts |= {name: model.card[name] for name in ("images", "split")}
    facts |= {f"ceiling_{name}": value for name, value in model.card.get("ceiling", {}).items()}
    return terminal.facts(f"Autoencoder {options.output}", facts)
