"""``palpate export``: a manifest becomes a Hugging Face data set or a table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Write a manifest as a Hugging Face data set with images inside, or as a table of paths."""

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest file or the folder of an import."""
    output: OutPath
    """Folder to write; absent or empty."""
    to: Literal["hf", "csv", "jsonl", "parquet"]
    """The form: `hf` is datasets' save_to_disk."""
    split: Path | None = None
    """Split file: parts of the Hugging Face data set; a column `split` of a table, and lists in the
    form of the data set.
    """


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Export and print how to read the result again."""
    from palpate.data import export_dataset

    with terminal.progress() as progress:
        exported = export_dataset(
            options.manifest, options.output, to=options.to, split=options.split, progress=progress
        )
    terminal.print(str(exported))
    return exported.to_json()
