"""``palpate export``: a manifest becomes a Hugging Face data set or a table."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Write a manifest as a Hugging Face data set with its images inside, or as a table whose paths start at the manifest's root."""

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest file or the folder of an import."""
    output: OutPath
    """Folder to write; absent or empty."""
    to: Literal["hf", "csv", "jsonl", "parquet"]
    """The form: `hf` is datasets' save_to_disk."""
    split: Path | None = None
    """Split file: parts of the Hugging Face data set; a column `split` of a table, and lists in the data set's own form."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Exports and prints what was written and how to read it again."""
    from palpate.core import Split
    from palpate.data.exporting import export_dataset
    from palpate.data.manifest import Manifest

    manifest = Manifest.load(options.manifest)
    split = None if options.split is None else Split.load(options.split)
    with terminal.progress() as progress:
        files = export_dataset(
            manifest, options.output, to=options.to, split=split, progress=progress
        )
    facts = {
        "form": options.to,
        "samples": len(manifest),
        "digest": manifest.digest,
        "parts": None if split is None else split.counts(),
        "files": len(files),
        "root": str(manifest.root),
    }
    terminal.facts(f"Exported {options.output}", facts)
    if options.to == "hf":
        terminal.print(
            f"Read it with datasets.load_from_disk({str(options.output)!r}), or again with: palpate import {_quoted(options.output)} -o DIR"
        )
    else:
        table = next(f for f in files if f.parent == options.output)
        terminal.print(
            f"Read it again with: palpate import {_quoted(table)} --root {_quoted(manifest.root)} -o DIR"
        )
    return facts | {"files": [str(f) for f in files]}


def _quoted(path: Path) -> str:
    """A path as one word of a command line."""
    return shlex.quote(str(path))
