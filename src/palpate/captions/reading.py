"""Captions to check: what ``palpate caption`` wrote, or any samples that have texts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, require
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.data.texts import TABLE, joined, read_texts

#: Columns of a table of captions.
LIST = pl.List(pl.String)
SCHEMA = {"id": pl.String(), "text": pl.String(), "adjectives": LIST, "flags": LIST}


def read_captions(
    captions: Any, data: Any = None, **options: Any
) -> tuple[Manifest, dict[str, list[str]]]:
    """The samples with their captions as texts, and the flags by id where they were kept.

    Arguments are those of :func:`palpate.captions.check_captions`.

    Raises:
        PalpateError: if there are none, or they are of other samples.
    """
    if isinstance(captions, str | Path):
        captions = Path(captions)
        captions = captions / TABLE if (captions / TABLE).is_file() else captions
    if data is None:
        manifest = load(captions, images=False, **options)
    elif isinstance(captions, Path):
        manifest = joined(load(data), read_texts(captions), captions, keep=False)
    else:
        must = "must be a folder or a table next to samples"
        raise PalpateError(must, type(captions).__name__, "", argument="captions")
    must, fix = "must hold captions", "Map the column text, or caption the samples first"
    texts, got = manifest.table["text"].count(), f"{captions} without any text"
    require(texts > 0, "captions", must, got, fix=fix)
    if isinstance(captions, Path) and captions.suffix == ".parquet":
        table = pl.read_parquet(captions, glob=False)
        if table.schema == pl.Schema(SCHEMA):
            return manifest, dict(table.select("id", "flags").iter_rows())
    return manifest, {}
