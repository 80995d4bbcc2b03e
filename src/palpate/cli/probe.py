"""``palpate probe``: what do the embeddings of an encoder know?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import (
    Common,
    OptionalOutPath,
    Switch,
    Terminal,
    guard_output,
    require_extra,
)


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Score what an encoder's embeddings know: the material, by a linear probe fitted to the train
    part, and the image of the other modality, by retrieval; on the test part of a split.
    """

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest file or the folder of an import."""
    split: Path
    """Split file."""
    encoder: str
    """Folder of `palpate train encoder`, a hub id, or palpate/mini."""
    modality: Literal["tactile", "vision"] = "tactile"
    """Whose encoder."""
    group: Literal["auto", "video", "contact", "object"] = "auto"
    """What stays together in cross-validation and intervals; `auto` takes what the split kept
    whole, else the video."""
    balanced: Switch = False
    """Average the accuracy over materials instead of samples."""
    allow_seen: Switch = False
    """Probe an encoder that was trained on some of the test images; every score says so."""
    output: OptionalOutPath = None
    """Write the scores as JSON, for `palpate report`."""
    cache: Path | None = None
    """Folder for embeddings, which an interrupted run finds again."""
    seed: int = 0
    """Of the folds of the cross-validation."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Probe, print the scores, write JSON."""
    require_extra("palpate probe")
    if options.output:
        guard_output(options.output, [options.manifest, options.split])
    from palpate.evaluation.probing import probe

    names = ("encoder", "modality", "group", "balanced", "allow_seen", "cache", "seed")
    arguments = {name: getattr(options, name) for name in names}
    with terminal.progress() as progress:
        results = probe(options.manifest, options.split, progress=progress, **arguments)
    results = replace(results, commands=[terminal.command])
    terminal.show(results)
    if options.output:
        results.save(options.output)
    return results.to_json()
