"""``palpate world``: the procedural world as a data set on disk."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal
from palpate.core import PalpateError
from palpate.sim import (
    DEFAULT,
    PRESETS,
    SEEN_WARNING,
    WorldOptions,
    load_options,
    seen_by_mini,
    write_world,
)
from palpate.sim.options import option_groups

#: Kinds of options that are neither a number nor a choice -> type, and how the help shows them.
_TYPES: dict[str, Any] = {
    "span": tuple[float, float],
    "series": tuple[float, ...],
    "materials": tuple[str, ...],
}
_METAVARS = {"span": "LOW HIGH", "series": "X ...", "materials": "NAME ..."}


def _group(name: str) -> Any:
    """Return the class of a group of options, each None unless given."""
    fields: list[tuple[str, Any, Any]] = []
    for option in option_groups()[name]:
        limits = option.metadata
        kind, text = limits["kind"], f"{limits['help'][0].upper()}{limits['help'][1:]}."
        metavar = _METAVARS.get(kind) or "|".join(limits.get("choices", ("X",)))
        number = int if isinstance(limits["low"], int) else float
        of = Literal[limits["choices"]] if kind == "choice" else _TYPES.get(kind, number)
        value = getattr(PRESETS[DEFAULT], option.name)
        value = " ".join(map(str, value)) if isinstance(value, tuple) else value
        default = f"(default: the preset's; {DEFAULT}: {value})"
        argument = tyro.conf.arg(help=text, metavar=metavar, help_behavior_hint=default)
        fields.append((option.name, Annotated[of | None, argument], field(default=None)))
    return make_dataclass(name.title(), fields, frozen=True, kw_only=True)


_World = _group("world")
_Amounts = _group("amounts")
_Physics = _group("physics")
_Photos = _group("photos")


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Write the procedural world, a synthetic data set, in the layout of Touch and Go or HCT.

    What is not given is taken from the preset. A run that was stopped continues when started again.
    """

    output: OutPath
    """Folder to write."""
    preset: Literal["tiny", "demo", "pretrain", "small", "full"] | None = None
    """What to start from; small (the default) has 8,000 contact frames at 64 px, full 36,000 at
    128 px."""
    options: Path | None = None
    """Start from the options of another world (its file world.json) instead of a preset."""
    workers: int = 2
    """Processes; the files do not depend on it."""
    world: _World = field(default_factory=_World)  # pyright: ignore[reportInvalidTypeForm]
    """What is simulated, and the train and test lists."""
    amounts: _Amounts = field(default_factory=_Amounts)  # pyright: ignore[reportInvalidTypeForm]
    """How many objects, videos, contacts and frames there are."""
    physics: _Physics = field(default_factory=_Physics)  # pyright: ignore[reportInvalidTypeForm]
    """The objects, the gel, and how it is pressed; lengths are in mm."""
    photos: _Photos = field(default_factory=_Photos)  # pyright: ignore[reportInvalidTypeForm]
    """The camera, and what in the photos has nothing to do with touch."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Write the world and print what it holds."""
    world = world_options(options)
    if seen_by_mini(world):
        terminal.print_line(f"Seed {world.seed}: {SEEN_WARNING}")
    with terminal.progress() as progress:
        record = write_world(options.output, world, workers=options.workers, progress=progress)
    facts = {"folder": str(record.folder), "digest": record.digest, **record.counts}
    facts |= {"seen_by_shipped_models": SEEN_WARNING} if seen_by_mini(world) else {}
    leak = {f"leak: {k}": v for k, v in record.leak.items()}
    terminal.facts(f"World {options.output} (synthetic)", facts | leak)
    return facts | {"leak": record.leak}


def world_options(options: Options) -> WorldOptions:
    """Return the world that the options name.

    Raises:
        PalpateError: if an option is out of range, or both a preset and a file are given.
    """
    if options.preset is not None and options.options is not None:
        must = "must not go with a file of options"
        raise PalpateError(must, options.preset, "Remove one of the two", argument="preset")
    base = load_options(options.options) if options.options else PRESETS[options.preset or DEFAULT]
    groups = (options.world, options.amounts, options.physics, options.photos)
    given = {k: v for group in groups for k, v in vars(group).items() if v is not None}
    if (names := given.get("materials")) and len(names) == 1 and names[0].lstrip("-").isdecimal():
        given["materials"] = int(names[0])
    if given.get("layout") == "videos":  # a video holds every frame
        given.setdefault("free_written", "all")
    if given.get("layout") == "hct":
        given.setdefault("look", "digit")
    return dataclasses.replace(base, **given)
