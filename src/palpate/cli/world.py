"""``palpate world``: the procedural world as a data set on disk."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal
from palpate.sim import DEFAULT, PRESETS, SEEN_WARNING, WorldOptions, seen_by_mini, write_world


def _fields() -> list[tuple[str, Any, Any]]:
    """Return the options of a world, each None unless given."""
    fields: list[tuple[str, Any, Any]] = []
    for option in dataclasses.fields(WorldOptions):
        limits = option.metadata
        text = f"{limits['help'][0].upper()}{limits['help'][1:]}."
        if "choices" in limits:
            of, metavar = Literal[limits["choices"]], "|".join(limits["choices"])
        elif "low" in limits:
            of, metavar = type(limits["low"]), "X"
        else:
            of, metavar = tuple[str, ...], "NAME ..."
        value = getattr(PRESETS[DEFAULT], option.name)
        value = " ".join(map(str, value)) if isinstance(value, tuple) else value
        default = f"(default: the preset's; {DEFAULT}: {value})"
        argument = tyro.conf.arg(help=text, metavar=metavar, help_behavior_hint=default)
        fields.append((option.name, Annotated[of | None, argument], field(default=None)))
    return fields


_World = make_dataclass("World", _fields(), frozen=True, kw_only=True)


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Write the procedural world, a synthetic data set, in the layout of Touch and Go.

    What is not given is taken from the preset. A run that was stopped continues when started again.
    """

    output: OutPath
    """Folder to write."""
    preset: Literal["tiny", "demo", "pretrain", "small", "full"] = DEFAULT
    """What to start from; small has 8,000 contact frames at 64 px, full 36,000 at
    128 px."""
    workers: int = 2
    """Processes; the files do not depend on it."""
    world: _World = field(default_factory=_World)  # pyright: ignore[reportInvalidTypeForm]
    """What is simulated, and the train and test lists."""


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
        PalpateError: if an option is out of range.
    """
    given = {k: v for k, v in vars(options.world).items() if v is not None}
    if (names := given.get("materials")) and len(names) == 1 and names[0].lstrip("-").isdecimal():
        given["materials"] = int(names[0])
    return dataclasses.replace(PRESETS[options.preset], **given)
