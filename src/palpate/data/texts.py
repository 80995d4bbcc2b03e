"""Texts for the samples of a manifest, from a table: the captions that ``palpate caption`` writes,
or any table with the columns ``id`` and ``text``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import ceil
from pathlib import Path

import polars as pl

from palpate.core import PalpateError, Problem, ProblemsError, digest_lines, require, short
from palpate.core.messages import require_joined
from palpate.data.images import file_digest
from palpate.data.imported import Imported, splits_of
from palpate.data.manifest import Manifest, parquet_metadata, write_parquet
from palpate.data.tables import open_table

TEXTS_FORMAT = "palpate-captions/1"
#: The table in the folder that ``palpate caption`` writes.
TABLE = "captions.parquet"
#: So many images, spread over the samples, tell whether texts were made for them.
WITNESSES = 64


@dataclass(frozen=True)
class Texts:
    """Texts by sample id."""

    by_id: dict[str, str]  # id -> text, only where there is one
    ids: frozenset[str]  # all ids of the table
    source: str  # where they come from, with a digest: kept in manifests and in models
    #: :func:`image_digests` of the samples that they were made for.
    images: Mapping[str, str] = field(default_factory=dict)


def texts_digest(table: pl.DataFrame) -> str:
    """SHA-256 of ids and texts, independent of the order of rows."""
    pairs = table.select("id", pl.col("text").fill_null("")).sort("id").iter_rows()
    return digest_lines(f"{name}\t{text}" for name, text in pairs)


def image_digests(manifest: Manifest, ids: Iterable[str] | None = None) -> dict[str, str]:
    """SHA-256 of the photo, or else the tactile image, by id; without files that cannot be read.

    Args:
        manifest: the samples.
        ids: of which of them; by default at most ``WITNESSES``, spread evenly.
    """
    table = manifest.table.select("id", image=pl.coalesce("vision", "tactile")).drop_nulls()
    if ids is None:
        table = table.gather_every(max(1, ceil(len(table) / WITNESSES)))
    else:
        table = table.filter(pl.col("id").is_in(list(ids)))
    digests = ((name, file_digest(manifest.path(image))) for name, image in table.iter_rows())
    return {name: digest for name, digest in digests if digest is not None}


def write_texts(table: pl.DataFrame, path: Path, source: str, images: Mapping[str, str]) -> None:
    """Write a table of texts, with where they come from and digests of the samples' images."""
    facts = {"format": TEXTS_FORMAT, "digest": texts_digest(table), "source": source}
    facts["images"] = json.dumps(images)
    write_parquet(table, path, {f"palpate.{name}": value for name, value in facts.items()})


def read_texts(path: Path) -> Texts:
    """Read a table of texts, or the folder that holds it.

    Raises:
        PalpateError: if it is missing, or lacks the columns ``id`` and ``text``.
        ProblemsError: with every bad row.
    """
    path = Path(path)
    path = path / TABLE if path.is_dir() else path
    table = open_table(path)
    if missing := [name for name in ("id", "text") if name not in table.names]:
        must = "A table of texts must have the columns id and text"
        raise PalpateError(must, f"{path} without {missing[0]}", "Rename the columns")
    rows = table.read(["id", "text"])
    again = rows.filter(pl.col("id").is_duplicated() | pl.col("id").is_null())
    for line, name in again.select("palpate_line", "id").iter_rows():
        text = "the id is empty" if name is None else f"the id {name!r} is there twice"
        table.problems.append(Problem(f"{path}:{line}", "bad-id", text))
    if table.problems:
        raise ProblemsError(table.problems, "Correct the table of texts")
    pairs = dict(rows.select("id", "text").iter_rows())
    texts = {name: text for name, text in pairs.items() if text is not None}
    metadata = parquet_metadata(path) if path.suffix.lower() == ".parquet" else {}
    source = metadata.get("palpate.source") or f"{path.name}, captions {short(texts_digest(rows))}"
    images = json.loads(metadata.get("palpate.images", "{}"))
    return Texts(texts, frozenset(pairs), source, images)


def joined(manifest: Manifest, texts: Texts, where: Path, *, keep: bool = True) -> Manifest:
    """The same samples with texts by id; with ``keep`` samples without one keep theirs.

    Raises:
        PalpateError: if the table ``where`` has none of the samples, or was made for others of
            their names.
    """
    ids, must, fix = manifest.ids, "The texts must be of these samples", "Use those made for them"
    require_joined(ids, texts.ids, f"The texts in {where}")
    for name, digest in image_digests(manifest, texts.images).items():
        got = f"{where}, made for another image of {name!r}"
        by_id = f"{fix}; a table of only id and text joins by id alone"
        require(digest == texts.images[name], None, must, got, fix=by_id)
    old = manifest.column("text") if keep else [None] * len(ids)
    new = [texts.by_id.get(name, text) for name, text in zip(ids, old, strict=True)]
    table = manifest.table.with_columns(text=pl.Series(new, dtype=pl.String))
    return replace(manifest, table=table, facts={**manifest.facts, "text_source": texts.source})


def with_texts(imported: Imported, texts: Texts, where: Path) -> Imported:
    """An import with texts from a table; samples without one there keep theirs."""
    manifest = joined(imported.manifest, texts, where)
    suspicious = list(imported.suspicious)
    if absent := [name for name in manifest.ids if name not in texts.by_id]:
        text = f"{len(absent)} of {len(manifest)} samples have no text there, first {absent[0]!r}"
        suspicious.append(Problem(str(where), "no-text", text))
    if unknown := sorted(texts.ids.difference(manifest.ids)):
        text = f"{len(unknown)} of {len(texts.ids)} ids are of no sample, first {unknown[0]!r}"
        suspicious.append(Problem(str(where), "no-sample", text))
    splits = {name: replace(s, manifest=manifest.digest) for name, s in imported.splits.items()}
    return replace(imported, manifest=manifest, splits=splits, suspicious=suspicious)


def reimported(source: Path) -> Imported:
    """An import that is there already, with its splits."""
    folder = source if source.is_dir() else source.parent
    return Imported(Manifest.load(source), splits=splits_of(folder))
