"""``palpate embed``: the embeddings of a data set, by slices."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from palpate.cli.terminal import Common, OutPath, PathArgument, Switch, Terminal, option_group


@option_group
class Options(Common):
    """Embed a data set into a folder that `palpate score` and `palpate probe` take in place of
    images. Without a slice it is all made by one process; slices are made by any number of them, in
    any order, and a finished one is not made again.
    """

    data: PathArgument
    """Image files, as `palpate score` takes them: a manifest, the folder of an import, of images or
    of palpate generate."""
    encoder: str
    """Folder of `palpate train encoder`, hub id, palpate/mini or palpate/handcrafted."""
    output: OutPath
    """Folder of the parts."""
    modality: Literal["tactile", "vision", "text"] = "tactile"
    """Whose encoder."""
    reference: Path | None = None
    """Of generated images: the real samples they will be compared with, whose no-contact images
    they take."""
    still: Switch = False
    """Take each image alone, as scores do, also for encoders that look at an earlier frame."""
    slice: str | None = None
    """Make slice i/n alone, whole recordings."""
    batch: int = 128
    """Images at a time."""


def run(options: Options, terminal: Terminal) -> Any:
    """Embed, and print what was made."""
    from palpate.encoders.embedded import embed_dataset

    return terminal.run(embed_dataset, **options.keywords())
