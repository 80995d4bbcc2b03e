"""``palpate background``: the untouched gel for samples that have none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Switch, Terminal


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Propose a background for each sample: the gel before its contact, else of its video.

    Needs tactile images as files; videos are imported first. Contacts are those of the manifest,
    or are found in the images.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """Manifest file, folder of an import, or a data set with its images as files."""
    output: OutPath
    """Folder for the new manifest.parquet; the images stay where they are."""
    how: Annotated[Literal["found", "first"], tyro.conf.arg(name="reference")] = "found"
    """What shows the untouched gel of a video: the frame most like the others, or the first."""
    replace_all: Annotated[Switch, tyro.conf.arg(name="replace")] = False
    """Replace the backgrounds that are there, too."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Propose, and print how many were found."""
    from palpate.data import propose_backgrounds

    with terminal.progress() as progress:
        proposed = propose_backgrounds(
            options.source,
            options.output,
            how=options.how,
            replace_all=options.replace_all,
            progress=progress,
        )
    terminal.print(str(proposed))
    return proposed.to_json()
