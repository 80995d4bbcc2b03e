"""Embeddings from files, as other people's code writes them. No torch, no pickles.

========  ========================================================================================
file      content
========  ========================================================================================
``.npy``  a float array (n, d); memory-mapped
``.npz``  arrays ``features`` (n, d) and, optionally, ``ids``, ``labels``, ``groups`` (n strings)
          and ``encoder`` (a string): what ``FeatureSet.save`` writes
========  ========================================================================================
"""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError, require

if TYPE_CHECKING:
    import polars as pl

SUFFIXES = (".npy", ".npz")
#: Bytes that an array of an archive may unpack to, and times its packed size on top: floats hardly
#: shrink, so more is a decompression bomb.
UNPACKED, MOST_TIMES = 1 << 28, 20
#: Names of the columns of labels and groups; the first that is there is used.
LABELS, GROUPS = ("material", "label"), ("video", "group")


@dataclass(frozen=True)
class Embeddings:
    """Features (n, d), possibly memory-mapped, with n ids, labels and groups where known."""

    features: NDArray[Any]
    ids: list[str] | None = None
    labels: list[str] | None = None
    groups: list[str] | None = None
    encoder: str | None = None


def read_embeddings(path: Path) -> Embeddings:
    """Read one file of embeddings; half precision is widened to float32.

    Raises:
        PalpateError: if the file is unreadable or empty, its features are not floats (n, d), its
            columns have other lengths, or an id occurs twice.
    """
    reader = _read_npz if path.suffix.lower() == ".npz" else _read_npy
    try:
        embeddings = reader(path)
    except KeyError as error:
        must, fix = f"{path} must hold features under the name 'features'", "Save them so"
        raise PalpateError(must, f"no {error}", fix) from None
    except Exception as error:  # a damaged file raises many kinds in NumPy, zipfile and zlib
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        must = f"{path} must be a whole {path.suffix} file without pickles"
        raise PalpateError(must, reason, "Write it again") from None
    return checked(embeddings, str(path))


def checked(embeddings: Embeddings, source: str) -> Embeddings:
    """Embeddings with floats of at least 32 bits, lists of one length, and distinct ids.

    Raises:
        PalpateError: naming ``source``.
    """
    x = embeddings.features
    floats = x.dtype.kind == "f" and x.ndim == 2 and 0 not in x.shape
    must = f"The features in {source} must be floats of shape (n, d), n and d at least 1"
    fix = "Save one row of the encoder's output per sample"
    require(floats, None, must, f"{x.dtype} of shape {x.shape}", fix=fix)
    for name in ("ids", "labels", "groups"):
        if (column := getattr(embeddings, name)) is not None:
            must = f"{name} in {source} must have one entry per row ({len(x)})"
            require(len(column) == len(x), None, must, len(column), fix="Write it again")
    require_ids(embeddings.ids or [], source)
    if x.dtype.itemsize < 4:
        return replace(embeddings, features=x.astype(np.float32))
    return embeddings


def require_ids(ids: Sequence[str], source: str) -> None:
    """Raise if an id is empty or occurs twice."""
    row = next((k for k, name in enumerate(ids, 1) if not name), 0)
    must = f"Every row of {source} must have an id"
    require(row == 0, None, must, f"none in row {row}", fix="Fill the ids")
    repeated = [i for i, n in Counter(ids).items() if n > 1]
    got = f"{len(repeated)} that occur more than once, first {''.join(repeated[:1])!r}"
    must = f"Every id in {source} must occur once"
    require(not repeated, None, must, got, fix="Keep one row per id")


def _read_npy(path: Path) -> Embeddings:
    x = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(x, np.ndarray):
        raise ValueError("an archive of arrays, which is named .npz")
    return Embeddings(x)


def _read_npz(path: Path) -> Embeddings:
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.file_size > UNPACKED + MOST_TIMES * entry.compress_size:
                size, packed = entry.file_size / 1e9, entry.compress_size / 1e6
                raise ValueError(f"{entry.filename} unpacks to {size:.1f} GB from {packed:.1f} MB")
    with np.load(path, allow_pickle=False) as data:
        arrays = {name: data[name] for name in data if name in Embeddings.__annotations__}
    encoder = arrays["encoder"].reshape(-1) if "encoder" in arrays else np.zeros(0)
    ids, labels, groups = (
        [str(v) for v in arrays[name].reshape(-1)] if name in arrays else None
        for name in ("ids", "labels", "groups")
    )
    name = str(encoder[0]) if encoder.size else None
    return Embeddings(arrays["features"], ids, labels, groups, name)


def first_of(columns: Sequence[str], names: Sequence[str]) -> str | None:
    """The first of ``names`` that is among ``columns``."""
    return next((name for name in names if name in columns), None)


def text_column(table: pl.DataFrame, name: str, source: str) -> list[str]:
    """A column as strings, '' for null.

    Raises:
        PalpateError: if it holds neither text nor numbers.
    """
    import polars as pl

    try:
        return table[name].cast(pl.String).fill_null("").to_list()
    except pl.exceptions.PolarsError:
        must = f"The column {name} in {source} must be text, or numbers"
        raise PalpateError(must, str(table[name].dtype), "Write one name per row") from None
