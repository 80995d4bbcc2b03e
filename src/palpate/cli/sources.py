"""How ``palpate audit`` and ``palpate split`` read lists, tables and folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.importing import Maps, columns_of


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How lists, tables and folders are read."""

    columns: Maps = ()
    """Manifest columns as columns of yours, or as polars SQL over them, as in `palpate import`:
    `--map tactile=tactile_fp text=label`."""
    vision: str | None = None
    """Template of the paths of photos, in a folder or in a list whose images are not at hand:
    `"{object}/press_{contact}/photo/{frame}.jpg"`."""
    tactile: str | None = None
    """Template of the paths of tactile images, likewise."""
    side: Annotated[Literal["vision", "tactile"] | None, tyro.conf.arg(name="as")] = None
    """What the images of a folder show, if all show one thing."""
    root: Path | None = None
    """Folder that the paths of tables are relative to (default: the folder of the table)."""
    classes: Path | None = None
    """Table of classes (`Name: id` or `id,name` per line) for materials that are numbers."""
    names: str | None = None
    """Columns of a table without a header line, separated by commas."""

    def options(self) -> dict[str, Any]:
        """As keywords."""
        given = vars(self) | {"columns": columns_of(self.columns)}
        return {name: value for name, value in given.items() if value}

    def arguments(self) -> list[str]:
        """As they were written on the command line."""
        words = [word for group in self.columns for word in ("--map", *group)]
        for name in ("vision", "tactile", "side", "root", "classes", "names"):
            if (value := getattr(self, name)) is not None:
                words += [f"--{'as' if name == 'side' else name}", str(value)]
        return words
