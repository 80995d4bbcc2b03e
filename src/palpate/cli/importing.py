"""``palpate import``: a data set on disk becomes a manifest."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal
from palpate.core import PalpateError

#: All that an import writes.
IMPORT_FILES = {"manifest.parquet", "splits", "images"}


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Turn a data set on disk into a manifest: Touch and Go in any layout, or a table or folder of pairs."""

    source: Annotated[Path, tyro.conf.Positional]
    """Root of the data set, or a table (CSV, TSV, Parquet, JSON lines)."""
    output: OutPath
    """Folder for manifest.parquet, the data set's own splits and decoded frames."""
    format: str = "auto"
    """Name of the format; `auto` recognises it."""
    map: tuple[str, ...] = ()
    """Columns of a table by their meaning, e.g. `--map vision=rgb_path tactile=gel_path`."""
    root: Path | None = None
    """Where the paths of a table start (default: the folder of the table)."""
    size: int | None = None
    """Shorter side of frames that are decoded from videos (default: as they are)."""
    max_per_touch: int | None = None
    """Keep at most this many evenly spaced frames of each touch."""
    check: Literal["decode", "header", "none"] = "decode"
    """How images are checked: `decode` finds truncated files, `header` is quicker."""
    skip_bad: bool = False
    """Leave out bad rows and files and list them, instead of refusing."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Imports and prints what was found."""
    from palpate.data.importing import import_dataset

    pairs = [item.split("=", 1) for item in options.map]
    if wrong := [item for item, pair in zip(options.map, pairs, strict=True) if len(pair) != 2]:
        raise PalpateError("--map takes COLUMN=NAME", repr(wrong[0]), "E.g. --map vision=rgb_path tactile=gel_path")
    strange = {p.name for p in options.output.iterdir()} - IMPORT_FILES if options.output.is_dir() else set[str]()
    if strange:
        raise PalpateError(
            f"{options.output} must be new, empty, or an earlier import", f"a folder with {sorted(strange)[0]}", "Choose another -o"
        )
    with terminal.progress() as progress:
        done = import_dataset(
            options.source, options.output, format=options.format, columns=dict(pairs) or None, root=options.root, size=options.size,
            max_per_touch=options.max_per_touch, check=options.check, skip_bad=options.skip_bad, progress=progress,
        )  # fmt: skip
    manifest = done.manifest
    for path in (options.output / "splits").glob("*.json"):  # of an earlier import of something else
        if path.stem not in done.splits:
            path.unlink()
    facts = {
        "manifest": str(options.output / "manifest.parquet"), "digest": manifest.digest, "samples": len(manifest),
        **{many: manifest.table[one].drop_nulls().n_unique() for one, many in (("video", "videos"), ("touch", "touches"), ("material", "materials"))},
        "with_background": len(manifest) - manifest.table["background"].null_count(),
        "with_text": len(manifest) - manifest.table["text"].null_count(),
        "inconclusive": done.inconclusive, "skipped": len(done.skipped), "splits": {name: split.counts() for name, split in done.splits.items()},
    }  # fmt: skip
    terminal.facts(f"Imported {options.source}", facts)
    terminal.skipped(done.skipped)
    return facts | {"skipped": [asdict(p) for p in done.skipped], "facts": dict(manifest.facts)}
