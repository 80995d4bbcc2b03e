"""A manifest for other tools: as a Hugging Face data set with the images inside, or as a table beside them.

===========  ==========================================================================================================
form         what is written
===========  ==========================================================================================================
``hf``       ``datasets``' ``save_to_disk`` of a DatasetDict: the parts of the split (``train``, ``validation``, ``test``; ``unused`` for
             the rest), or ``all``; images byte for byte, all manifest columns. ``formats/huggingface.py`` tells how it comes back.
``csv``      ``manifest.csv``: all columns that are not empty, and ``split``; paths stay relative to the manifest's root
``jsonl``    ``manifest.jsonl``: the same, an object a line, without nulls
``parquet``  ``samples.parquet``: the same with nulls
===========  ==========================================================================================================

With a split, tables come with ``lists/``: the split in the form of the data set that the manifest came from.
"""

from __future__ import annotations

import json
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import polars as pl

from palpate.core import MissingExtraError, Progress, Split, atomic_folder, quiet, write_text
from palpate.data.formats.huggingface_source import MARK, ROW
from palpate.data.importing import write_lists
from palpate.data.manifest import IMAGE_COLUMNS, SCHEMA, Manifest, write_parquet

Form = Literal["hf", "csv", "jsonl", "parquet"]
#: What Hugging Face calls our parts.
THEIRS = {"train": "train", "val": "validation", "test": "test"}


def export_dataset(
    manifest: Manifest,
    out: Path,
    *,
    to: Form,
    split: Split | None = None,
    progress: Progress = quiet,
) -> list[Path]:
    """Writes a manifest in another form, whole or not at all.

    Args:
        manifest: the samples; for ``hf`` their images must be there.
        out: folder to write, absent or empty.
        to: the form.
        split: which part each sample belongs to; samples outside it are marked so.
        progress: told what is being done.

    Returns:
        The files written.

    Raises:
        PalpateError: if ``out`` holds something, or the split is of another manifest.
        ProblemsError: with every image that is missing.
        MissingExtraError: for ``hf``, if ``datasets`` is not installed.
    """
    if split is not None:
        manifest.take(list(split.parts))
    with atomic_folder(Path(out)) as folder:
        if to == "hf":
            _save_to_disk(manifest.require_valid(), folder, split, progress)
        else:
            _write_table(manifest, folder, to, split)
            if split is not None:
                write_lists(manifest, split, folder / "lists")
        names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    return [Path(out) / name for name in names]


def _write_table(manifest: Manifest, folder: Path, to: Form, split: Split | None) -> None:
    table = manifest.table.select(
        name for name in SCHEMA if manifest.table[name].null_count() < len(manifest)
    )
    if split is not None:
        table = table.with_columns(
            split=pl.Series([split.parts.get(i) for i in manifest.ids], dtype=pl.String)
        )
    if to == "csv":
        write_text(folder / "manifest.csv", table.write_csv())
    elif to == "jsonl":
        lines = (
            json.dumps({k: v for k, v in row.items() if v is not None}, ensure_ascii=False)
            for row in table.iter_rows(named=True)
        )
        write_text(folder / "manifest.jsonl", "".join(f"{line}\n" for line in lines))
    else:
        write_parquet(table, folder / "samples.parquet")


def _save_to_disk(
    manifest: Manifest, folder: Path, split: Split | None, progress: Progress
) -> None:
    """Writes the DatasetDict; the library reads the image files itself, a batch at a time."""
    try:
        import datasets
    except ImportError:
        raise MissingExtraError("datasets", "hf", "Writing Hugging Face data sets") from None
    features: dict[str, Any] = {}
    for name, kind in SCHEMA.items():
        features[name] = (
            datasets.Image()
            if name in IMAGE_COLUMNS
            else datasets.Value("int64" if kind is pl.Int64 else "string")
        )
        if name in IMAGE_COLUMNS:
            features[f"{name}_path"] = datasets.Value("string")
    features[ROW] = datasets.Value("int64")
    about: dict[str, Any] = {
        "format": MARK,
        "digest": manifest.digest,
        "facts": dict(manifest.facts),
    }
    about |= {} if split is None else {"rule": dict(split.rule), "split": split.digest}
    facts = manifest.facts
    info = datasets.DatasetInfo(
        description=json.dumps(about, ensure_ascii=False),
        citation=facts.get("citation", ""),
        license=facts.get("license", ""),
        homepage=facts.get("url", ""),
        features=datasets.Features(features),
    )
    table = manifest.table.with_row_index(ROW).with_columns(pl.col(ROW).cast(pl.Int64))
    part_of = {} if split is None else split.parts
    parts = pl.Series(
        [
            THEIRS[part_of[i]] if i in part_of else "all" if split is None else "unused"
            for i in manifest.ids
        ],
        dtype=pl.String,
    )
    saved: Any = datasets.DatasetDict()
    for part in (*THEIRS.values(), "unused", "all"):
        rows = table.filter(parts == part)
        if not rows.height:
            continue
        columns: dict[str, list[Any]] = {}
        for name in features:
            source = name.removesuffix("_path")
            values = rows[source].to_list()
            columns[name] = (
                [v if v is None else str(manifest.root / v) for v in values]
                if name in IMAGE_COLUMNS
                else values
            )
        saved[part] = datasets.Dataset.from_dict(
            columns, features=datasets.Features(features), info=info
        )
    progress("writing images", 0, 1)
    with _silent(datasets):
        saved.save_to_disk(str(folder))
    progress("writing images", 1, 1)


@contextmanager
def _silent(datasets: Any) -> Generator[None]:
    """The library's progress bars off, and as they were afterwards."""
    hidden = datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    try:
        yield
    finally:
        if not hidden:
            datasets.enable_progress_bars()
