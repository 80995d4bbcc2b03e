"""``palpate import``: a data set on disk becomes a manifest.

The options that name a source are shared with ``palpate validate``, those of lists, tables and
folders also with ``palpate audit`` and ``palpate split``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, PathArgument, Switch, Terminal, option_group
from palpate.core import require

Maps = Annotated[
    tuple[tuple[str, ...], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(name="map", metavar="COLUMN=EXPRESSION ..."),
]


@option_group
class Reading:
    """How lists, tables and folders are read."""

    vision: str | None = None
    """Where the photos are, as a template of paths: `"{object}/press_{contact}/photo/{frame}.jpg"`;
    videos or stacks of frames (.npy) likewise: `"{object}_{video}.mov"`. Fields are columns and
    join the sides; `{frame:d}` takes digits, `{video:**}` folders of any depth, `*` and `**` what
    does not matter. Without a template the layout is recognized."""
    tactile: str | None = None
    """Where the tactile images are, likewise."""
    columns: Maps = ()
    """Manifest columns as columns of yours, or as polars SQL over them (for a folder of images over
    the fields and `path`), e.g. `--map vision=rgb tactile="replace(rgb, '_rgb', '_tac')"
    and "video=substr(rgb, 1, 15)"`."""
    root: Path | None = None
    """Folder that paths are relative to (default: the folder of the table)."""
    side: Annotated[Literal["vision", "tactile"] | None, tyro.conf.arg(name="as")] = None
    """What the images of a folder show, if all show one thing."""
    names: str | None = None
    """Columns of a table without a header line, separated by commas."""

    def keywords(self) -> dict[str, Any]:
        """As the argument of what reads samples."""
        options = vars(self) | {"columns": columns_of(self.columns)}
        return {"reading": {name: value for name, value in options.items() if value}}

    def arguments(self) -> list[str]:
        """As they were written on the command line."""
        words = [word for group in self.columns for word in ("--map", *group)]
        for name in ("vision", "tactile", "side", "root", "names"):
            if (value := getattr(self, name)) is not None:
                words += [f"--{'as' if name == 'side' else name}", str(value)]
        return words


@option_group
class TableOptions(Reading):
    """Folders of images, tables, interval lists, Hugging Face data sets."""

    classes: Path | None = None
    """Table of classes (`Name: id` or `id,name` per line) for materials that are numbers; -1 is
    inconclusive and skipped."""
    background: str | None = None
    """Where the tactile images without contact are, as a template."""
    every: int | None = None
    """Take every N-th frame of an interval; of videos without a list: of whole videos, instead of
    the frames in contact.
    """
    sensor: str | None = None
    """Name of the tactile sensor, for videos."""
    pairing: Literal["time", "number"] | None = None
    """Whether frames of a photo and a tactile video belong together by their time stamps, where
    these show other rates or gaps (default), or by number."""
    config: str | None = None
    """Configuration of a Hugging Face data set."""
    revision: str | None = None
    """Branch, tag or commit of a data set on the hub."""

    def keywords(self) -> dict[str, Any]:
        """As arguments of an import, each by its name."""
        return vars(self) | {"columns": columns_of(self.columns) or None}


@option_group
class FormatOptions:
    """Options of single formats."""

    labels: tuple[Path, ...] = ()
    """Frame lists (Touch and Go; default: label.txt, else train.txt and test.txt)."""
    swap: Literal["report", "fix"] | None = None
    """Report or fix trajectories whose vision and tactile folders are swapped (HCT)."""
    size: int | None = None
    """Shorter side of frames that are extracted from videos (default: as they are)."""
    max_per_contact: int | None = None
    """Keep at most this many evenly spaced frames of each contact (Touch and Go, your own
    videos).
    """


@option_group
class SourceOptions(Common):
    """What names a source and how to read it."""

    format: str = "auto"
    """Name of the format; `auto` recognizes it. `palpate validate --list` shows all formats and
    their options.
    """
    check: Literal["decode", "header", "none"] = "decode"
    """How images are checked: `decode` detects truncated files, `header` is quicker."""
    table: TableOptions = TableOptions()
    formats: FormatOptions = FormatOptions()


@option_group
class Options(SourceOptions):
    """Turn a data set on disk into a manifest.

    Reads any known data set, a folder of images or videos, a table, an interval list, or a Hugging
    Face data set. Eight layouts with their commands: docs/your-data.md.
    """

    source: PathArgument
    """Root of the data set, a table (CSV, TSV, JSON lines, JSON, Parquet), or with `--format hf` a
    name on the hub.
    """
    output: OutPath
    """Folder for manifest.parquet, the data set's own splits and extracted frames."""
    skip_bad: Switch = False
    """Skip and list bad rows and files, instead of an error."""
    overwrite: Switch = False
    """Replace the manifest of an earlier import."""
    text: Path | None = None
    """Join texts by id: the folder of palpate caption, or a table with the columns id and text. The
    source may then also be an import."""


def run(options: Options, terminal: Terminal) -> Any:
    """Import and print what was imported."""
    from palpate.data import import_dataset

    return terminal.run(import_dataset, **options.keywords())


def columns_of(items: Sequence[Sequence[str]]) -> dict[str, str]:
    """``COLUMN=EXPRESSION`` items as a dictionary.

    Raises:
        PalpateError: on an item of another form, or a column named twice.
    """
    columns: dict[str, str] = {}
    for item in (item for group in items for item in group):
        name, _, expression = (part.strip() for part in item.partition("="))
        must, fix = "must name each column once, as COLUMN=EXPRESSION", "E.g. vision=rgb_path"
        once = bool(name and expression) and name not in columns
        require(once, "columns", must, repr(item), fix=fix)
        columns[name] = expression
    return columns
