"""``palpate world``: the procedural world as a data set on disk."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

from palpate.cli.settings import PresetTable, Settings
from palpate.cli.terminal import Common, OutPath, Terminal, option_group, option_name
from palpate.sim.options import WorldOptions
from palpate.sim.presets import DEFAULT, MINI_SEEDS, PRESETS, SEEN_WARNING
from palpate.sim.scans import scan_notes
from palpate.sim.writer import write_world

#: Fields of a preset that are options of their own.
FIELDS = (
    *("seed", "size", "look", "materials", "objects_per_material", "videos_per_object"),
    *("leak", "layout", "scale", "surfaces"),
)
WORLDS = PresetTable(PRESETS, {name: option_name("world", name) for name in FIELDS})


@option_group
class Options(Common):
    """Write the procedural world, a synthetic data set, in the layout of Touch and Go.

    What is not given is taken from the preset. A run that was stopped continues when started again.
    """

    output: OutPath
    """Folder to write."""
    preset: Literal["tiny", "demo", "pretrain", "small", "full"] = DEFAULT
    """What to start from; small has 8,000 contact frames at 64 px, full 36,000 at 128 px."""
    settings: Settings = ()
    """Further fields of the preset, as `contacts_per_video=6`; `palpate presets NAME` lists all."""
    seed: int | None = None
    """Worlds of different seeds share no object, video, text."""
    size: int | None = None
    """Side of the images in pixels, 16 to 256 (default: 64; of full 128)."""
    look: Literal["gelsight", "digit"] | None = None
    """Sensor: a GelSight with markers (default), or a darker DIGIT without."""
    materials: tuple[str, ...] | None = None
    """Names, or how many of the 20, evenly spaced (default: all; of tiny 4)."""
    objects_per_material: int | None = None
    """Objects of each material that have videos (default: 20; of tiny 2, demo 5, full 60)."""
    videos_per_object: int | None = None
    """Videos of each object (default: 1; of small and full 2 for a quarter of them)."""
    leak: Literal["contact", "frame", "none"] | None = None
    """What test may share with train: videos (contact, default), contacts (frame), or neither."""
    layout: Literal["frames", "videos"] | None = None
    """Touch and Go as JPEG frames (default) or as H.264 videos."""
    scale: Literal["near", "real"] | None = None
    """Photos of 30 to 45 mm (near, default), or of 150 to 400 mm of ground with joints of true
    size, where relief and load belong to the material."""
    surfaces: Path | None = None
    """Folder of photo-scanned surfaces (surfaces.csv) as further looks, in scale real."""
    workers: int = 2
    """Processes; the files do not depend on it."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Write the world and print what it holds."""
    world = world_options(options)
    seen = {"seen_by_shipped_models": SEEN_WARNING} if world.seed in MINI_SEEDS else {}
    if seen:
        terminal.print_line(f"Seed {world.seed}: {SEEN_WARNING}")
    for text in scan_notes(world.scans):
        terminal.print_line(text)
    record = terminal.run(write_world, options.output, world, workers=options.workers)
    facts = {"folder": str(record.folder), "digest": record.digest, **record.counts, **seen}
    leak = {f"leak: {k}": v for k, v in record.leak.items()}
    terminal.facts(f"World {options.output} (synthetic)", facts | leak)
    return facts | {"leak": record.leak}


def world_options(options: Options) -> WorldOptions:
    """Return the world that the options name.

    Raises:
        PalpateError: if an option is out of range.
    """
    materials: Any = options.materials
    if materials and len(materials) == 1 and materials[0].lstrip("-").isdecimal():
        materials = int(materials[0])
    values = {name: getattr(options, name) for name in FIELDS} | {"materials": materials}
    if options.surfaces is not None:
        values |= {"surfaces": str(options.surfaces), "scale": options.scale or "real"}
    preset = WORLDS.preset(options.preset, options.settings)
    return dataclasses.replace(preset, **{k: v for k, v in values.items() if v is not None})
