"""``palpate background``: the untouched gel for samples that have none."""

from __future__ import annotations

from typing import Any

from palpate.cli.terminal import Common, OutPath, PathArgument, Terminal, option_group


@option_group
class Options(Common):
    """Propose a background for each sample: the gel before its contact, else of its video.

    Needs tactile images as files; videos are imported first. Contacts are those of the manifest,
    or are found in the images.
    """

    source: PathArgument
    """Manifest file, folder of an import, or a data set with its images as files."""
    output: OutPath
    """Folder for the new manifest.parquet; the images stay where they are."""


def run(options: Options, terminal: Terminal) -> Any:
    """Propose, and print how many were found."""
    from palpate.data import propose_backgrounds

    return terminal.run(propose_backgrounds, options.source, options.output)
