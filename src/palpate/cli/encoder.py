"""``palpate train encoder``: train the tactile encoder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal, require_extra


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Train the tactile encoder against frozen vision and text encoders (three-way InfoNCE)."""

    data: Annotated[Path, tyro.conf.Positional]
    """Manifest file, the folder of an import, or a data set."""
    split: Path
    """Split file; only its train part is trained on."""
    output: OutPath
    """Folder for the encoders; must be new or empty."""
    clip: str | None = None
    """Hub id or folder of a pretrained CLIP, or palpate/mini. Default: the preset's, or a small one
    that is trained first on the same train part."""
    preset: Literal["mini", "tiny", "paper"] = "mini"
    """Size and course; `paper` is the paper's, for GPUs."""
    epochs: float | None = None
    """Default: the preset's."""
    targets: Literal["diagonal", "identical-text"] | None = None
    """`diagonal` is the paper's loss; `identical-text` counts equal captions as positives. Default:
    the preset's."""
    seed: int = 0
    """Of weights, order and augmentation."""
    device: str = "auto"
    """auto, cpu, cuda, mps."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Train, and print the accuracy of a linear material probe on the test part."""
    require_extra("palpate train encoder")
    from palpate.encoders.contrastive import train_encoder

    with terminal.progress() as progress:
        encoders = train_encoder(
            options.data,
            options.split,
            preset=options.preset,
            clip=options.clip,
            output=options.output,
            epochs=options.epochs,
            targets=options.targets,
            seed=options.seed,
            device=options.device,
            progress=progress,
        )
    facts: dict[str, Any] = {
        "folder": str(options.output),
        "tactile": encoders.digest("tactile"),
        "clip": encoders.clip.name,
        "split": encoders.card["split"],
        "processes": encoders.card["processes"],
    }
    for row in encoders.card.get("scores", ()):
        facts["test_material_accuracy"] = row["value"]
        facts |= {"interval": row["interval"], "chance": row["chance"]}
    terminal.facts(f"Encoders {options.output}", facts)
    return facts
