"""``palpate presets``: complete configurations of trainings and worlds, and their fields."""

from __future__ import annotations

from typing import Annotated, Any

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table

from palpate.cli.terminal import Common, Terminal, option_group
from palpate.cli.training import PRESETS as TRAININGS
from palpate.cli.world import WORLDS
from palpate.core import require_choice
from palpate.sim.presets import COSTS

PRESETS = {**TRAININGS, "world": WORLDS}


@option_group
class Options(Common):
    """List the presets of trainings, with what they take and reach, and of worlds; or the fields of
    one, which `--set field=value` changes.
    """

    name: Annotated[str | None, tyro.conf.Positional] = None
    """A preset, e.g. mini."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Print a table for each verb that has the preset."""
    if options.name is not None:
        names = (name for table in PRESETS.values() for name in table.presets)
        require_choice("name", options.name, dict.fromkeys(names))
    answer: dict[str, Any] = {}
    for verb, table in PRESETS.items():
        if options.name is None:
            rows = [
                {"preset": name, "cost": getattr(preset, "cost", COSTS.get(name, ""))}
                | ({"score": preset.score} if hasattr(preset, "score") else {})
                for name, preset in table.presets.items()
            ]
        elif options.name in table.presets:
            rows = [
                {"field": field.path, "type": field.type_text, "default": field.text}
                | {"unit": field.unit, "meaning": field.meaning}
                for field in table.fields(options.name).values()
            ]
        else:
            continue
        answer[verb] = rows
        columns = Table(*rows[0], title=f"palpate {verb}", title_justify="left", box=SIMPLE_HEAD)
        for row in rows:
            columns.add_row(*row.values())
        terminal.out.print(columns, markup=False)
    return answer
