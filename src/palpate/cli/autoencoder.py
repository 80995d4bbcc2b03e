"""``palpate train autoencoder``: train or fine-tune the autoencoder of a generator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from palpate.cli.terminal import Terminal, require_extra
from palpate.cli.training import PRESETS, Training


@dataclass(frozen=True, kw_only=True)
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
    require_extra("palpate train autoencoder")
    preset = PRESETS["train autoencoder"].preset(options.preset, options.settings)
    options.require_data()
    from palpate.diffusion.autoencoder_training import train_autoencoder

    with terminal.progress() as progress:
        model = train_autoencoder(
            preset=preset, progress=progress, **options.keywords("preset", "settings")
        )
    facts: dict[str, Any] = {"folder": str(options.output), "digest": model.digest}
    facts |= {"images": model.card["images"], "split": model.card["split"]}
    facts |= {f"ceiling_{name}": value for name, value in model.card.get("ceiling", {}).items()}
    terminal.facts(f"Autoencoder {options.output}", facts)
    return facts
