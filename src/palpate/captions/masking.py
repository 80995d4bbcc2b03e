"""Captions without names of materials: a new version, with the digest of the old one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl

from palpate.captions.captioning import RECORD, Captions
from palpate.captions.reading import SCHEMA, read_captions
from palpate.captions.vocabulary import Vocabulary
from palpate.core import PalpateError, short, write_json
from palpate.data.texts import (
    TABLE,
    TEXTS_FORMAT,
    image_digests,
    read_texts,
    texts_digest,
    write_texts,
)


def mask_captions(
    captions: Any, output: str | Path, *, data: Any = None, **options: Any
) -> Captions:
    """Write captions without the names of materials.

    Adjectives that name a material are removed; in a phrase the name is replaced by ``material``. A
    caption of nothing but names becomes empty.

    Args:
        captions: as in :func:`palpate.captions.check_captions`.
        output: a folder without captions.
        data: the samples; their materials count as names too.
        options: options of a table without ``data``.

    Raises:
        PalpateError: if there are no captions, or the output holds some.
    """
    output = Path(output)
    if (output / TABLE).exists():
        must, got = "must be a folder without captions", str(output)
        raise PalpateError(must, got, "Choose another folder", argument="mask")
    manifest, old = read_captions(captions, data, **options)
    vocabulary = Vocabulary(sorted(set(manifest.column("material")) - {None}))
    masked = {text: vocabulary.masked(text) for text in set(old["text"]) - {None}}
    rows: list[dict[str, Any]] = []
    for row in old.iter_rows(named=True):
        text = masked.get(row["text"])
        words = [word for word in row["adjectives"] if not vocabulary.naming(word)]
        flags = [*row["flags"], *["masked"] * (text != row["text"])]
        rows.append({"id": row["id"], "text": text or None, "adjectives": words, "flags": flags})
    table = pl.DataFrame(rows, schema=SCHEMA)
    counts = {
        "samples": len(table),
        "masked": sum("masked" in row["flags"] for row in rows),
        "emptied": old["text"].count() - table["text"].count(),
    }
    source, digest = manifest.facts.get("text_source", "texts"), texts_digest(table)
    record = {
        "format": TEXTS_FORMAT,
        "digest": digest,
        "masked_from": {"source": source, "digest": texts_digest(old)},
        "counts": counts,
    }
    source = f"{source}, without names of materials {short(digest)}"
    folder = isinstance(captions, str | Path) and (Path(captions) / TABLE).is_file()
    images = read_texts(Path(captions)).images if folder else image_digests(manifest)
    write_texts(table, output / TABLE, source, images)
    write_json(output / RECORD, record)
    return Captions(table, record, output / TABLE)
