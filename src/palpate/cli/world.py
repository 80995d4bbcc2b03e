"""``palpate world``: the procedural world as a data set on disk."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal
from palpate.core import PalpateError

if TYPE_CHECKING:
    from palpate.sim import WorldOptions

Count: TypeAlias = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
Number: TypeAlias = Annotated[float | None, tyro.conf.arg(metavar="X", help_behavior_hint="")]
Range: TypeAlias = Annotated[
    tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH", help_behavior_hint="")
]
Several: TypeAlias = Annotated[
    tuple[float, ...] | None, tyro.conf.arg(metavar="X ...", help_behavior_hint="")
]


@dataclass(frozen=True, kw_only=True)
class Amounts:
    """How much there is of what, and how it is worded and cut; the preset's unless given."""

    materials: Annotated[
        tuple[str, ...] | None, tyro.conf.arg(metavar="NAME ...", help_behavior_hint="")
    ] = None
    """Names of materials (Wood "Synthetic Fabric"), or how many."""
    objects_per_material: Count = None
    """Objects of each material."""
    balance: Annotated[
        Literal["uniform", "touch-and-go"] | None,
        tyro.conf.arg(metavar="uniform|touch-and-go", help_behavior_hint=""),
    ] = None
    """Equal classes, or classes as unequal as those of Touch and Go, of the same number of objects in all."""
    videos_per_object: Count = None
    """Videos of each object."""
    two_videos: Number = None
    """Share of the objects that have one video more."""
    touches_per_video: Count = None
    """Contacts in a video."""
    frames_per_touch: Count = None
    """Frames in contact in each touch."""
    free_frames: Count = None
    """Frames without contact before each touch, 5 or more."""
    free_written: Annotated[
        Literal["all", "background"] | None,
        tyro.conf.arg(metavar="all|background", help_behavior_hint=""),
    ] = None
    """Write all frames without contact, or of each touch the one that shows the background."""
    objects_per_video: Count = None
    """A mixed video touches 2 to this many objects."""
    mixed: Number = None
    """Share of the videos that touch several objects."""
    sensors: Count = None
    """Gel units; each video uses one."""
    named: Number = None
    """Share of the captions that name the thing; the others say only how it feels."""
    test: Number = None
    """Share of the contact frames in the test list."""
    tile: Count = None
    """Pixels a side of an object's 64 mm of surface: 256 fits 64 px images, 512 fits 128 px."""


@dataclass(frozen=True, kw_only=True)
class Physics:
    """The objects, the gel and how it is pressed; lengths in mm."""

    curved: Number = None
    """Share of the objects that are curved."""
    radius_mm: Range = None
    """Range of their radius."""
    pad_mm: Number = None
    """Side of the gel pad."""
    gel_mm: Number = None
    """Depth to which the gel can be indented."""
    relax_mm: Several = None
    """Blurs that relax the free membrane, the contact re-imposed after each."""
    optical_mm: Number = None
    """Blur of the sensor's optics."""
    dome_mm: Range = None
    """Range of the radius of a unit's domed gel."""
    markers: Count = None
    """Rows of markers a side on a gelsight pad; 0 for none."""
    dirt: Number = None
    """Factor on uneven coating, specks and scratches of the gel."""
    vignette: Range = None
    """Range of the darkening at half the pad's side."""
    sensor_noise: Range = None
    """Range of a unit's image noise (deviation, of 1)."""
    load_mm: Range = None
    """Range of the peak load of a touch, as mean indentation."""
    revisit_mm: Number = None
    """Deviation of the places that a video touches around its first."""
    jump: Number = None
    """Share of the touches that go far away instead."""
    slide_mm: Several = None
    """Deviations, one drawn a touch, of how far the sensor slides in contact."""
    tilt: Number = None
    """Deviation of the pad's slope."""
    shear: Number = None
    """Deviation of the drag in mm per mm of depth."""


@dataclass(frozen=True, kw_only=True)
class Photos:
    """The camera, and everything in the photos that has nothing to do with touch."""

    hard: Number = None
    """0 to 1, a factor on all of it: stains, hand, edges, shadows, light."""
    view_mm: Range = None
    """Range of the width of the photo, at most 45.25."""
    elevation_deg: Range = None
    """Range of the sun's height in degrees."""
    hand: Number = None
    """Share of the videos with a hand and the sensor in view, at hard 0.5."""
    shadow: Number = None
    """Share with a cast shadow, at hard 0.5."""
    edge: Number = None
    """Share with the edge of the object in view, at hard 0.5."""
    stains: Number = None
    """Factor on the number of stains and stickers."""
    sway: Number = None
    """Factor on the slow drift of the camera."""
    blur_px: Several = None
    """Deviations, one drawn a video, of the blur in pixels at 128 px."""


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Write the procedural world, a synthetic data set, in the true layout of Touch and Go or HCT, or as arrays.

    What is not given is taken from the preset. A run that was stopped goes on when it is started again.
    """

    output: OutPath
    """Folder to write."""
    preset: Annotated[
        Literal["tiny", "demo", "pretrain", "small", "full"] | None,
        tyro.conf.arg(metavar="tiny|demo|pretrain|small|full", help_behavior_hint=""),
    ] = None
    """What to start from: small unless given, about 8,000 contact frames at 64 px; full has 36,000 at 128 px."""
    options: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Start from the options of another world instead: its world.json."""
    seed: Count = None
    """Worlds of different seeds share no object. 900000 to 900099 are kept for the shipped models."""
    size: Count = None
    """Side of the images in pixels, 16 to 256."""
    look: Annotated[
        Literal["gelsight", "digit"] | None,
        tyro.conf.arg(metavar="gelsight|digit", help_behavior_hint=""),
    ] = None
    """Sensor family: with or without markers. The layout hct takes digit unless told."""
    leak: Annotated[
        Literal["frame", "contact", "none"] | None,
        tyro.conf.arg(metavar="frame|contact|none", help_behavior_hint=""),
    ] = None
    """How its own train and test lists are cut: random frames, random whole touches, or by video; leak.csv tells what that leaks."""
    layout: Annotated[
        Literal["frames", "videos", "hct", "raw"] | None,
        tyro.conf.arg(metavar="frames|videos|hct|raw", help_behavior_hint=""),
    ] = None
    """Touch and Go as extracted frames or as raw video.mp4 and gelsight.mp4, HCT, or uint8 arrays (vision.npy, tactile.npy, background.npy)."""
    workers: int = 2
    """Processes; the bytes do not depend on it."""
    sheet: Annotated[Path | None, tyro.conf.arg(metavar="PNG", help_behavior_hint="")] = None
    """Also draw a contact sheet of all materials into this file."""
    amounts: tyro.conf.OmitArgPrefixes[Amounts] = field(default_factory=Amounts)
    physics: tyro.conf.OmitArgPrefixes[Physics] = field(default_factory=Physics)
    photos: tyro.conf.OmitArgPrefixes[Photos] = field(default_factory=Photos)


_OWN = ("seed", "size", "look", "leak", "layout")


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Writes the world and prints what it holds."""
    from palpate.sim import render_contact_sheet, write_world
    from palpate.sim.presets import SEEN, seen_by_mini
    from palpate.sim.sheet import require_sheet_path

    world = world_options(options)
    if options.sheet:
        require_sheet_path(options.sheet, options.output)
    if seen_by_mini(world):
        terminal.say(f"Seed {world.seed}: {SEEN}")
    with terminal.progress() as progress:
        record = write_world(options.output, world, workers=options.workers, progress=progress)
        if options.sheet:
            render_contact_sheet(world, options.sheet)
    facts = {
        "folder": str(record.folder),
        "digest": record.digest,
        **record.counts,
        "leak": record.leak,
    }
    facts |= {"seen_by_shipped_models": SEEN} if seen_by_mini(world) else {}
    shown = {k: v for k, v in facts.items() if k != "leak"} | {
        f"leak: {k}": v for k, v in record.leak.items()
    }
    terminal.facts(f"World {options.output} (synthetic)", shown)
    return facts


def world_options(options: Options) -> WorldOptions:
    """The world that the options name.

    Raises:
        PalpateError: if an option is out of range, or both a preset and a file of options are given.
    """
    from palpate.sim import DEFAULT, PRESETS, load_options

    if options.preset is not None and options.options is not None:
        raise PalpateError(
            "Either --preset or --options must be given", "both", "Leave one of them out"
        )
    base = (
        load_options(options.options)
        if options.options is not None
        else PRESETS[options.preset or DEFAULT]
    )
    given = {name: getattr(options, name) for name in _OWN}
    for group in (options.amounts, options.physics, options.photos):
        given |= {f.name: getattr(group, f.name) for f in fields(group)}
    changes = {name: value for name, value in given.items() if value is not None}
    if (names := changes.get("materials")) and len(names) == 1 and names[0].lstrip("-").isdecimal():
        changes["materials"] = int(names[0])
    if changes.get("layout") == "videos":  # a video cannot leave frames out
        changes.setdefault("free_written", "all")
    if changes.get("layout") == "hct":
        changes.setdefault("look", "digit")
    return replace(base, **changes)
