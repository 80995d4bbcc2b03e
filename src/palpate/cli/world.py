"""``palpate world``: the procedural world as a data set on disk."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Write the procedural world, a synthetic data set, in the true layout of Touch and Go."""

    output: OutPath
    """Folder to write."""
    preset: Literal["tiny", "demo", "pretrain", "small"] = "demo"
    """What to start from; the options below change it."""
    seed: int | None = None
    """Worlds of different seeds share no object."""
    size: int | None = None
    """Side of the images in pixels."""
    look: Literal["gelsight", "digit"] | None = None
    """Sensor family: with or without markers."""
    leak: Literal["frame", "touch", "none"] | None = None
    """How its own train.txt and test.txt are cut: random frames, random whole touches, or by video."""
    layout: Literal["frames", "videos"] | None = None
    """Extracted frames, or raw video.mp4 and gelsight.mp4."""
    objects_per_material: int | None = None
    """Objects of each material."""
    hard: float | None = None
    """0 to 1: how much in the photos has nothing to do with touch."""
    workers: int = 2
    """Processes; the bytes do not depend on it."""
    sheet: Annotated[Path | None, tyro.conf.arg(help="Also draw a contact sheet of all materials into this PNG.")] = None


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Writes the world and prints what it holds."""
    from palpate.sim import PRESETS, render_contact_sheet, write_world

    names = ("seed", "size", "look", "leak", "layout", "objects_per_material", "hard")
    changes: dict[str, Any] = {name: value for name in names if (value := getattr(options, name)) is not None}
    if changes.get("layout") == "videos":  # a video cannot leave frames out
        changes["free_written"] = "all"
    world = replace(PRESETS[options.preset], **changes)
    with terminal.progress() as progress:
        record = write_world(options.output, world, workers=options.workers, progress=progress)
        if options.sheet:
            render_contact_sheet(world, options.sheet)
    facts = {"folder": str(record.folder), "digest": record.digest, **record.counts, "leak": record.leak}
    terminal.facts(f"World {options.output} (synthetic)", facts)
    return facts
