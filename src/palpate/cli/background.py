"""``palpate background``: the untouched gel for samples that have none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from palpate.cli.terminal import Common, OutPath, Switch, Terminal
from palpate.core import PalpateError


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
    how: Annotated[
        tuple[str, ...], tyro.conf.arg(name="reference", metavar="auto|first|N|VIDEO=N")
    ] = ("auto",)
    """What shows the untouched gel of a video: the frame most like the others, the first, or frame
    N; several `VIDEO=N` name it for some videos alone."""
    replace_all: Annotated[Switch, tyro.conf.arg(name="replace")] = False
    """Replace the backgrounds that are there, too."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Propose, and print how many were found."""
    from palpate.data import propose_backgrounds

    with terminal.progress() as progress:
        proposed = propose_backgrounds(
            options.source,
            options.output,
            how=_references(options.how),
            replace_all=options.replace_all,
            progress=progress,
        )
    terminal.print(str(proposed))
    return proposed.to_json()


def _references(words: Sequence[str]) -> Any:
    """One reference for all videos, or those of some by name.

    Raises:
        PalpateError: on words that are neither.
    """
    value = lambda word: int(word) if word.isdecimal() else word
    named = {name: value(how) for name, mark, how in (w.rpartition("=") for w in words) if mark}
    if len(named) != len(words) and (named or len(words) != 1):
        must = "must be one reference, or one for each of some videos"
        raise PalpateError(must, " ".join(words), "", argument="how", example={"how": "cup_1=0"})
    return named or value(words[0])
