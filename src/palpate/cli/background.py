"""``palpate background``: the untouched gel for samples that have none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal


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


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Propose, and print how many were found."""
    from palpate.data import propose_backgrounds

    with terminal.progress() as progress:
        proposed = propose_backgrounds(options.source, options.output, progress=progress)
    terminal.print(str(proposed))
    return proposed.to_json()
