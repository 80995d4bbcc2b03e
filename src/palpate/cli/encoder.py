"""``palpate encoder``: train the tactile encoder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal, require_extra, working_folder


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Train the tactile encoder against frozen vision and text encoders, on the train part of a split (three-way InfoNCE)."""

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest file or the folder of an import."""
    split: Path
    """Split file; only its train part is read."""
    output: OutPath
    """Folder for the encoders; must be new or empty."""
    clip: str | None = None
    """Hub id or folder of a pretrained CLIP, or palpate/mini. Default: the preset's, or, for presets without, a small one trained first on the same train part."""
    preset: Literal["mini", "tiny", "paper"] = "mini"
    """Size and course; `paper` is the paper's, for GPUs."""
    epochs: float | None = None
    """Instead of the preset's."""
    seed: int = 0
    """Of weights, order and augmentation."""
    device: str = "auto"
    """auto, cpu, cuda, mps."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Trains, embeds the parts, and tells how well a linear probe names the material."""
    require_extra("palpate encoder")
    from palpate.core import PalpateError, Split
    from palpate.data.manifest import Manifest
    from palpate.encoders.contrastive import train_clip, train_touch
    from palpate.encoders.embed import embed
    from palpate.encoders.encoder_set import load_clip
    from palpate.encoders.presets import preset
    from palpate.metrics.probe import material_accuracy

    if options.epochs is not None and not 0 < options.epochs < float("inf"):
        raise PalpateError(
            "--epochs must be a positive number",
            str(options.epochs),
            "Leave it out for the preset's length",
        )
    manifest, split, chosen = (
        Manifest.load(options.manifest),
        Split.load(options.split),
        preset(options.preset),
    )
    with working_folder(options.output, terminal) as work, terminal.progress() as progress:
        cache = work / "cache"
        name = options.clip or chosen.pretrained
        if name is None:
            clip = train_clip(
                manifest,
                split,
                chosen,
                work / "clip",
                seed=options.seed,
                cache=cache,
                device=options.device,
                progress=progress,
            )
        else:
            clip = load_clip(name, device=options.device)
        encoders = train_touch(
            manifest,
            split,
            clip,
            chosen,
            work / "tactile",
            epochs=options.epochs,
            seed=options.seed,
            cache=cache,
            device=options.device,
            progress=progress,
        )
        facts: dict[str, Any] = {
            "folder": str(options.output),
            "tactile": encoders.digest("tactile"),
            "clip": clip.name,
            "split": split.digest,
        }
        train, test = manifest.part(split, "train"), manifest.part(split, "test")
        if len(test) and len(set(train.column("material")) - {None}) > 1:
            features = [
                embed(part, encoders, "tactile", cache=cache, progress=progress)
                for part in (train, test)
            ]
            score = material_accuracy(*features, split=split.digest)
            facts |= {
                "test_material_accuracy": score.value,
                "interval": score.interval,
                "chance": score.details.get("chance"),
            }
        encoders.save(options.output)
    terminal.facts(f"EncoderSet {options.output}", facts)
    return facts
