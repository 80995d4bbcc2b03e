"""Embeddings from files and tables, as other people's code writes them. No torch, no pickles.

================  ================================================================================
file              content
================  ================================================================================
``.npy``          a float array (n, d); memory-mapped
``.npz``          arrays ``features`` (n, d) and, optionally, ``ids``, ``labels``, ``groups`` (n
                  strings) and ``encoder`` (a string): what ``FeatureSet.save`` writes
``.safetensors``  tensor ``features`` (n, d) of F64, F32, F16 or BF16; optionally, in the metadata,
                  ``ids``, ``labels`` and ``groups`` as JSON lists, ``encoder`` as text;
                  memory-mapped
``.parquet``      columns ``id`` and ``features`` (a list per row); optionally ``material`` or
                  ``label``, ``video`` or ``group``; ``encoder`` in the metadata
================  ================================================================================
"""

from __future__ import annotations

import json
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError

if TYPE_CHECKING:
    import polars as pl

SUFFIXES = (".npy", ".npz", ".safetensors", ".parquet")
#: Bytes that an array of an archive may unpack to, and times its packed size on top: floats hardly
#: shrink, so more is a decompression bomb.
UNPACKED, MOST_TIMES = 1 << 28, 20
#: Names of the columns of labels and groups; the first that is there is used.
LABELS, GROUPS = ("material", "label"), ("video", "group")
#: Types of safetensors that are read; BF16 has no NumPy type and is widened.
SAFE_TYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "<u2"}


@dataclass(frozen=True)
class Embeddings:
    """Features (n, d), possibly memory-mapped, with n ids, labels and groups where known.

    ``widened`` names the half-precision type that the features were converted from, if any.
    """

    features: NDArray[Any]
    ids: list[str] | None = None
    labels: list[str] | None = None
    groups: list[str] | None = None
    encoder: str | None = None
    widened: str = ""


def read_embeddings(path: Path) -> Embeddings:
    """Read one file of embeddings; half precision is widened to float32.

    Raises:
        PalpateError: if the file is unreadable or empty, its features are not floats (n, d), its
            columns have other lengths, or an id occurs twice.
    """
    reader = _READERS[path.suffix.lower()]
    try:
        embeddings = reader(path)
    except PalpateError:
        raise
    except KeyError as error:
        raise PalpateError(
            f"{path} must hold features under the name 'features'",
            f"no {error}",
            "Save them under that name",
        ) from None
    except Exception as error:  # a damaged file raises many kinds in NumPy, zipfile, zlib and json
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
    if x.dtype.kind != "f" or x.ndim != 2 or 0 in x.shape:
        raise PalpateError(
            f"The features in {source} must be floats of shape (n, d), n and d at least 1",
            f"{x.dtype} of shape {x.shape}",
            "Save one row of the encoder's output per sample",
        )
    for name in ("ids", "labels", "groups"):
        column = getattr(embeddings, name)
        if column is not None and len(column) != len(x):
            must = f"{name} in {source} must have one entry per row ({len(x)})"
            raise PalpateError(must, str(len(column)), "Write it again")
    require_ids(embeddings.ids or [], source)
    if x.dtype.itemsize < 4:
        return replace(embeddings, features=x.astype(np.float32), widened=str(x.dtype))
    return embeddings


def require_ids(ids: Sequence[str], source: str) -> None:
    """Raise if an id is empty or occurs twice."""
    if "" in ids:
        got = f"none in row {list(ids).index('') + 1}"
        raise PalpateError(f"Every row of {source} must have an id", got, "Fill the ids")
    if repeated := [i for i, n in Counter(ids).items() if n > 1]:
        got = f"{len(repeated)} that occur more than once, first {repeated[0]!r}"
        raise PalpateError(f"Every id in {source} must occur once", got, "Keep one row per id")


def _read_npy(path: Path) -> Embeddings:
    x = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(x, np.ndarray):
        raise ValueError("an archive of arrays, which is named .npz")
    return Embeddings(x)


def _read_npz(path: Path) -> Embeddings:
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.file_size > UNPACKED + MOST_TIMES * entry.compress_size:
                size, of = entry.file_size / 1e9, entry.compress_size / 1e6
                raise ValueError(f"{entry.filename} unpacks to {size:.1f} GB from {of:.1f} MB")
    with np.load(path, allow_pickle=False) as data:
        arrays = {name: data[name] for name in data if name in Embeddings.__annotations__}
    encoder = arrays["encoder"].reshape(-1) if "encoder" in arrays else np.zeros(0)
    ids, labels, groups = (
        [str(v) for v in arrays[name].reshape(-1)] if name in arrays else None
        for name in ("ids", "labels", "groups")
    )
    name = str(encoder[0]) if encoder.size else None
    return Embeddings(arrays["features"], ids, labels, groups, name)


def _read_safetensors(path: Path) -> Embeddings:
    """Read a length (8 bytes, little endian), a JSON header of that length, and bytes."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if not 2 <= length <= size - 8:
            raise ValueError(f"a header of {length} bytes in a file of {size}")
        header = json.loads(file.read(length))
    entry, metadata = header["features"], header.get("__metadata__", {})
    kind, shape, (start, end) = entry["dtype"], tuple(entry["shape"]), entry["data_offsets"]
    if kind not in SAFE_TYPES:
        raise ValueError(f"features of {kind}, which must be one of {', '.join(SAFE_TYPES)}")
    dtype = np.dtype(SAFE_TYPES[kind])
    bytes_needed = int(np.prod(shape)) * dtype.itemsize
    if min(shape) < 1 or end - start != bytes_needed or not 0 <= start <= end <= size - 8 - length:
        raise ValueError(f"features of shape {shape} in bytes {start} to {end}")
    x: NDArray[Any] = np.memmap(path, dtype, "r", 8 + length + start, shape)
    if kind == "BF16":
        x = (x.astype(np.uint32) << 16).view(np.float32)
    ids, labels, groups = (
        [str(v) for v in _json_list(metadata[name])] if name in metadata else None
        for name in ("ids", "labels", "groups")
    )
    encoder = metadata.get("encoder")
    widened = "bfloat16" if kind == "BF16" else ""
    return Embeddings(x, ids, labels, groups, encoder and str(encoder), widened)


def _json_list(text: str) -> list[Any]:
    value = json.loads(text)
    if not isinstance(value, list):
        raise ValueError(f"ids, labels and groups must be JSON lists, got {text[:40]}")
    return value


def _read_parquet(path: Path) -> Embeddings:
    metadata, table = read_parquet(path)
    return embeddings_of_table(table, str(path), metadata.get("encoder"))


def read_parquet(path: Path) -> tuple[Mapping[str, str], pl.DataFrame]:
    """Metadata and rows of a Parquet file.

    Raises:
        ValueError: if it is damaged.
    """
    import polars as pl

    from palpate.data.manifest import reading_parquet

    with open(path, "rb") as file, reading_parquet():
        return pl.read_parquet_metadata(file), pl.read_parquet(path, glob=False)


def embeddings_of_table(table: pl.DataFrame, source: str, encoder: str | None = None) -> Embeddings:
    """The rows of a table with the columns of a ``.parquet`` file of embeddings.

    Raises:
        PalpateError: if a column is missing, or a row has no features or features of another width.
    """
    for name, fix in (
        ("id", "Add it: ids pair the samples"),
        ("features", "A list of floats a row"),
    ):
        if name not in table.columns:
            got = f"columns {', '.join(table.columns[:8])}"
            raise PalpateError(f"{source} must have a column {name}", got, fix)
    labels, groups = (
        text_column(table, name, source) if (name := first_of(table.columns, names)) else None
        for names in (LABELS, GROUPS)
    )
    ids = text_column(table, "id", source)
    return Embeddings(_table_features(table, source), ids, labels, groups, encoder)


def _table_features(table: pl.DataFrame, source: str) -> NDArray[Any]:
    """The column ``features`` as (n, d)."""
    import polars as pl

    column = table["features"]
    if not isinstance(column.dtype, pl.List | pl.Array):
        must = f"The column features in {source} must be lists of floats"
        raise PalpateError(must, str(column.dtype), "Write one list per row")
    if not len(column):
        raise PalpateError(f"{source} must hold at least one row", "none", "Check what wrote it")
    lists = column.cast(pl.List(column.dtype.inner))
    lengths = lists.list.drop_nulls().list.len().fill_null(0)
    width = int(lengths.max() or 0)  # type: ignore[arg-type]
    if (bad := lengths != max(width, 1)).any():
        row = bad.arg_true()[0]
        got = f"{lengths[row]} for {table['id'][row]!r}"
        must = f"Every row of {source} must have features of one width ({width})"
        raise PalpateError(must, got, "Embed these samples again, or drop their rows")
    return lists.explode().to_numpy().reshape(len(table), -1)


def as_polars(frame: Any) -> pl.DataFrame:
    """A polars or pandas frame as polars."""
    import polars as pl

    if isinstance(frame, pl.DataFrame):
        return frame
    return pl.DataFrame({str(name): frame[name].tolist() for name in frame.columns}, strict=False)


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


_READERS: Mapping[str, Callable[[Path], Embeddings]] = {
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".safetensors": _read_safetensors,
    ".parquet": _read_parquet,
}
