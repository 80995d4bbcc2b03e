"""A manifest for other tools: a Hugging Face data set with the images inside, or a table.

===========  =================================================================================
form         what is written
===========  =================================================================================
``hf``       ``datasets``' ``save_to_disk`` of a DatasetDict: the parts of the split (``train``,
             ``validation``, ``test``; ``unused`` for other samples), or ``all``; images byte for
             byte, all manifest columns. ``formats/huggingface.py`` reads it again.
``csv``      ``manifest.csv``: all columns that are not empty, and ``split``; paths stay relative
             to the manifest's root
``jsonl``    ``manifest.jsonl``: the same, one object per line, without nulls
``parquet``  ``samples.parquet``: the same with nulls
===========  =================================================================================

With a split, tables come with ``lists/``: the split in the form of the original data set.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import polars as pl

from palpate.core import MissingExtraError, Progress, Split, atomic_folder, quiet, write_text
from palpate.data.formats.huggingface_source import MARK, ROW
from palpate.data.importing import write_lists
from palpate.data.manifest import IMAGE_COLUMNS, Manifest, write_parquet

Form = Literal["hf", "csv", "jsonl", "parquet"]
#: What Hugging Face calls our parts.
HF_PARTS = {"train": "train", "val": "validation", "test": "test"}


@dataclass(frozen=True)
class Exported:
    """What an export wrote. Print it for how to read it again.

    Attributes:
        form: the form.
        output: the folder.
        manifest: the samples.
        split: the split that was written with them, if any.
        files: all files.
    """

    form: Form
    output: Path
    manifest: Manifest
    split: Split | None
    files: list[Path]

    def to_json(self) -> dict[str, Any]:
        """The facts as a JSON object."""
        return {
            "form": self.form,
            "samples": len(self.manifest),
            "digest": self.manifest.digest,
            "parts": None if self.split is None else self.split.counts(),
            "root": str(self.manifest.root),
            "files": [str(path) for path in self.files],
        }

    def __str__(self) -> str:
        way = f"datasets.load_from_disk({str(self.output)!r}) or palpate import "
        way += shlex.quote(str(self.output))
        if self.form != "hf":
            table = next(path for path in self.files if path.parent == self.output)
            way = f"palpate import {shlex.join([str(table), '--root', str(self.manifest.root)])}"
        count = f"{len(self.manifest)} samples in {len(self.files)} files"
        return f"Exported {self.output}: {count}\nRead it with: {way} -o DIR"


def export_dataset(
    manifest: Manifest | Path | str,
    output: Path | str,
    *,
    to: Form,
    split: Split | Path | str | None = None,
    progress: Progress = quiet,
) -> Exported:
    """Write a manifest in another form, whole or not at all.

    Args:
        manifest: the samples, or a manifest file or folder; for ``hf`` their images must exist.
        output: folder to write, absent or empty.
        to: the form.
        split: which part each sample belongs to; samples outside it are marked so.
        progress: progress callback.

    Raises:
        PalpateError: if ``output`` is not empty, or the split is of another manifest.
        ProblemsError: with every image that is missing.
        MissingExtraError: for ``hf``, if ``datasets`` is not installed.
    """
    manifest = manifest if isinstance(manifest, Manifest) else Manifest.load(Path(manifest))
    split = None if split is None else Split.load(split)
    if split is not None:
        manifest.take(list(split.parts))
    output = Path(output)
    with atomic_folder(output) as folder:
        if to == "hf":
            _save_to_disk(manifest.require_valid(), folder, split, progress)
        else:
            _write_table(manifest, folder, to, split)
            if split is not None:
                write_lists(manifest, split, folder / "lists")
        names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    return Exported(to, output, manifest, split, [output / name for name in names])


def _write_table(manifest: Manifest, folder: Path, to: Form, split: Split | None) -> None:
    table = manifest.filled()
    if split is not None:
        parts = [split.parts.get(i) for i in manifest.ids]
        table = table.with_columns(split=pl.Series(parts, dtype=pl.String))
    if to == "csv":
        write_text(folder / "manifest.csv", table.write_csv())
    elif to == "jsonl":
        rows = ({k: v for k, v in row.items() if v is not None} for row in table.to_dicts())
        lines = (json.dumps(row, ensure_ascii=False) + "\n" for row in rows)
        write_text(folder / "manifest.jsonl", "".join(lines))
    else:
        write_parquet(table, folder / "samples.parquet")


def _save_to_disk(
    manifest: Manifest, folder: Path, split: Split | None, progress: Progress
) -> None:
    """Write the DatasetDict; the library reads the image files itself, a batch at a time."""
    try:
        import datasets
    except ImportError:
        raise MissingExtraError("datasets", "hf", "Writing Hugging Face data sets") from None
    text = datasets.Value("string")
    columns = dict.fromkeys(manifest.table.columns, text) | {"frame": datasets.Value("int64")}
    columns |= {c: datasets.Image() for c in IMAGE_COLUMNS}
    columns |= {f"{c}_path": text for c in IMAGE_COLUMNS} | {ROW: datasets.Value("int64")}
    features = datasets.Features(columns)
    facts = dict(manifest.facts)
    about: dict[str, Any] = {"format": MARK, "digest": manifest.digest, "facts": facts}
    about |= {} if split is None else {"rule": dict(split.rule), "split": split.digest}
    info = datasets.DatasetInfo(
        description=json.dumps(about, ensure_ascii=False),
        citation=facts.get("citation", ""),
        license=facts.get("license", ""),
        homepage=facts.get("url", ""),
        features=features,
    )
    table = manifest.table.with_row_index(ROW).with_columns(pl.col(ROW).cast(pl.Int64))
    root = pl.lit(f"{manifest.root}/")
    files = ((root + pl.col(name)).alias(name) for name in IMAGE_COLUMNS)
    table = table.with_columns(pl.col(IMAGE_COLUMNS).name.suffix("_path"), *files)
    part_of = {} if split is None else {i: HF_PARTS[part] for i, part in split.parts.items()}
    parts = pl.Series([part_of.get(i, "all" if split is None else "unused") for i in manifest.ids])
    saved: Any = datasets.DatasetDict()
    for part in (*HF_PARTS.values(), "unused", "all"):
        rows = table.filter(parts == part).select(list(features))
        if rows.height:
            saved[part] = datasets.Dataset.from_dict(rows.to_dict(as_series=False), features, info)
    progress("writing images", 0, 1)
    hidden = datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    try:
        saved.save_to_disk(str(folder))
    finally:
        if not hidden:
            datasets.enable_progress_bars()
    progress("writing images", 1, 1)
