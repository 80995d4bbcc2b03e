"""Embeddings from files, as they come out of anybody's code, and the labels and groups that belong to them. No torch, no pickles.

=================  ============================================================================================================
file               what it must hold
=================  ============================================================================================================
``.npy``           a float array (n, d); mapped, not read
``.npz``           arrays ``features`` (n, d) and, optionally, ``ids``, ``labels``, ``groups`` (n text) and ``encoder`` (text): what
                   :meth:`palpate.core.FeatureSet.save` writes
``.safetensors``   tensor ``features`` (n, d), F64, F32, F16 or BF16; optionally, in the metadata, ``ids``, ``labels`` and ``groups`` as
                   JSON lists of text, ``encoder`` as text; mapped, not read (BF16 is widened to float32)
``.parquet``       columns ``id``, ``features`` (list or array of floats) or ``f0`` .. ``f<d-1>``; optionally ``material`` or ``label``,
                   ``video`` or ``group``; the file's metadata may hold ``encoder``
=================  ============================================================================================================

Rows of a file without ids are numbered. A columns file (CSV or Parquet: ``id``, ``material``, ``video``) gives labels and groups by id; to
a file without ids it gives the ids as well, if it has as many rows.
"""

from __future__ import annotations

import json
import math
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError

SUFFIXES = (".npy", ".npz", ".safetensors", ".parquet")
KINDS = f"a folder of images, a manifest, a folder of palpate generate, or embeddings ({', '.join(SUFFIXES)}); pickles are never loaded"
#: Names of a column, the first that is there wins.
LABELS, GROUPS = ("material", "label"), ("video", "group")
#: Types of safetensors that are features; BF16 has no NumPy type and is widened.
SAFE_TYPES = {
    "F64": np.dtype("<f8"),
    "F32": np.dtype("<f4"),
    "F16": np.dtype("<f2"),
    "BF16": np.dtype("<u2"),
}
#: A header of safetensors is smaller, says its specification.
LONGEST_HEADER = 100_000_000
#: Beyond so many rows an array without labels and groups is streamed: TMMD alone, nothing is held. All four metrics would form all pairs.
STREAMED = 50_000


@dataclass(frozen=True)
class Embeddings:
    """Features of one file.

    Attributes:
        path: the file.
        features: (n, d) float array, possibly mapped.
        ids: n names, or None where the file has none.
        labels, groups: n names each, or None.
        encoder: digest, or None.
        column: of the columns file that gave the groups; None for groups of the file itself.
    """

    path: Path
    features: NDArray[Any]
    ids: Sequence[str] | None = None
    labels: Sequence[str] | None = None
    groups: Sequence[str] | None = None
    encoder: str | None = None
    column: str | None = None

    @property
    def streamed(self) -> bool:
        """Whether the rows are so many, and so bare, that they must not be held in memory."""
        return self.labels is None and self.groups is None and len(self.features) > STREAMED

    def feature_set(self, prefix: str = "") -> FeatureSet:
        """As a set; rows without ids are called ``<prefix><number>``. Half precision is widened, with a warning.

        Raises:
            PalpateError: on NaN or infinity (the rows are named).
        """
        x, ids = (
            self.features,
            list(self.ids)
            if self.ids is not None
            else [f"{prefix}{k}" for k in range(len(self.features))],
        )
        if x.dtype.itemsize < 4:  # once, here: every metric would do so again, and say so
            _say_widened(self.path, "float16")
            x = x.astype(np.float32)
        try:
            return FeatureSet(ids, x, self.labels, self.groups, self.encoder)
        except PalpateError as error:
            raise PalpateError(f"{self.path}: {error.must}", error.got, error.fix) from None


@dataclass(frozen=True)
class Columns:
    """Labels and groups by id, from a columns file.

    Attributes:
        path: the file.
        ids: in the order of its rows.
        labels, groups: one an id, or None where there is no such column.
        group: name of the column of groups, or None.
        asked: whether it was asked for by name: it then goes before the groups that a file of embeddings has itself.
        names: all columns of the file.
    """

    path: Path
    ids: Sequence[str]
    labels: Sequence[str] | None = None
    groups: Sequence[str] | None = None
    group: str | None = None
    asked: bool = False
    names: Sequence[str] = ()

    def of(self, ids: Sequence[str]) -> tuple[list[str] | None, list[str] | None]:
        """Labels and groups of ``ids``, in that order.

        Raises:
            PalpateError: if an id is not in the file; the first is named.
        """
        row = {name: k for k, name in enumerate(self.ids)}
        if missing := [i for i in ids if i not in row]:
            got = f"{len(missing)} of {len(ids)} that are not, first {missing[0]!r}"
            raise PalpateError(
                f"Every id must stand in {self.path}", got, "Add these rows, or leave the file out"
            )
        at = [row[i] for i in ids]
        pick = lambda column: None if column is None else [column[k] for k in at]  # noqa: E731
        return pick(self.labels), pick(self.groups)


def known_to(what: str, ids: Sequence[str], known: Collection[str], lost: str) -> bool:
    """Whether the reference knows a generator's ids, so that what it knows of them may be taken from it.

    Args:
        what: the generator, for the error.
        ids: its ids.
        known: those of the reference.
        lost: what would be taken, for the error.

    Raises:
        PalpateError: if it knows some of them alone: all would lose what it knows.
    """
    strange = [i for i in ids if i not in known]
    if strange and len(strange) < len(ids):
        got = f"{len(strange)} of {len(ids)} without, first {strange[0]!r}"
        fix = "Leave these out, give them ids of the reference, or pass --labels and --groups that hold every id"
        raise PalpateError(
            f"{what} must have ids of the reference alone, which gives {lost} by id", got, fix
        )
    return not strange


def is_embeddings(path: Path) -> bool:
    """Whether a path is a file of embeddings; False for pictures of touches.

    Raises:
        PalpateError: if there is nothing, or something of no known kind.
    """
    if path.is_dir():
        return False
    if not path.exists():
        raise PalpateError("What is scored must exist", f"nothing at {path}", f"Pass {KINDS}")
    if path.suffix.lower() not in SUFFIXES:
        raise PalpateError(
            f"{path} must be {KINDS}", path.suffix or "a file without a suffix", "Pass one of these"
        )
    return not (path.suffix.lower() == ".parquet" and _is_manifest(path))


def _is_manifest(path: Path) -> bool:
    import polars as pl

    try:
        with open(path, "rb") as file:
            return "palpate.format" in pl.read_parquet_metadata(file)
    except (
        Exception,
        pl.exceptions.PanicException,
    ):  # no Parquet file at all: told when it is read
        return False


def read_embeddings(path: Path, columns: Columns | None = None) -> Embeddings:
    """The features of one file; see the head of this module.

    Args:
        path: the file.
        columns: labels and groups that the file lacks.

    Raises:
        PalpateError: if the file is missing, of another kind, unreadable, empty, or not as its kind must be; if ids are double, or not in
            ``columns``.
    """
    path = Path(path)
    if not path.is_file():
        raise PalpateError("A file of embeddings must exist", f"no file {path}", "Check the path")
    reader = {
        ".npy": _read_npy,
        ".npz": _read_npz,
        ".safetensors": _read_safetensors,
        ".parquet": _read_parquet,
    }.get(path.suffix.lower())
    if reader is None:
        got = f"{path.suffix or 'a file without a suffix'}: {path.name}"
        raise PalpateError(
            f"Embeddings must be one of {', '.join(SUFFIXES)}; pickles are never loaded",
            got,
            "Save them as one of these",
        )
    found = reader(path)
    _check(found)
    return found if columns is None else _completed(found, columns)


def read_columns(path: Path, group: str = "video", *, asked: bool = False) -> Columns:
    """A columns file: CSV with a heading, or Parquet.

    Args:
        path: the file.
        group: name of the column of groups that is looked for first.
        asked: whether it was asked for by name: no other column is then taken in its place.

    Raises:
        PalpateError: if the file is missing or unreadable, has no ``id``, double or empty ids, neither labels nor groups, or no names in these.
    """
    import polars as pl

    path, fix = Path(path), "Write a CSV or Parquet file with the columns id, material, video"
    if not path.is_file():
        raise PalpateError("The file of labels and groups must exist", f"no file {path}", fix)
    try:
        # Without inference: 007 stays a name.
        table = (
            pl.read_parquet(path, glob=False)
            if path.suffix == ".parquet"
            else pl.read_csv(path, infer_schema=False, glob=False)
        )
    except (Exception, pl.exceptions.PanicException) as error:  # polars raises several kinds
        raise PalpateError(
            f"{path} must be a CSV or Parquet file", _first_line(error), fix
        ) from None
    names = [
        _first(table.columns, options)
        for options in (LABELS, (group,) if asked else (group, *GROUPS))
    ]
    if "id" not in table.columns or not any(names):
        raise PalpateError(
            f"{path} must have a column id, and material or {group}",
            f"columns {', '.join(table.columns)}",
            fix,
        )
    labels, groups = (_texts(path, table[name]) if name else None for name in names)
    found = Columns(path, _texts(path, table["id"]), labels, groups, names[1], asked, table.columns)
    _require_ids(path, found.ids)
    return found


def read_together(
    paths: Mapping[str, Path], columns: Columns | None = None
) -> dict[str, Embeddings]:
    """Files that are compared, as :func:`read_embeddings`; groups are all their own, or, where a file has none, all of ``columns``."""
    found = {name: read_embeddings(path) for name, path in paths.items()}
    if columns is None:
        return found
    columns = replace(
        columns, asked=columns.asked or any(one.groups is None for one in found.values())
    )
    return {name: _completed(one, columns) for name, one in found.items()}


def _completed(found: Embeddings, columns: Columns) -> Embeddings:
    ids = found.ids
    if ids is None:
        if len(columns.ids) != len(found.features):
            got = f"{len(found.features)} and {len(columns.ids)}"
            fix = "Give each file of embeddings its ids (.npz, .safetensors, .parquet), or one file of labels that fits all"
            raise PalpateError(
                f"{found.path}, which has no ids, must have as many rows as {columns.path}",
                got,
                fix,
            )
        ids = columns.ids
    labels, groups = columns.of(ids)
    found = replace(found, ids=ids, labels=found.labels or labels)
    if groups is None or (found.groups is not None and not columns.asked):
        return found
    return replace(found, groups=groups, column=columns.group)


def _check(found: Embeddings) -> None:
    x, path = found.features, found.path
    if x.dtype.kind != "f":
        raise PalpateError(
            f"The features in {path} must be floating-point",
            f"dtype {x.dtype}",
            "Save the encoder's float output",
        )
    if x.ndim != 2 or x.shape[1] == 0:
        raise PalpateError(
            f"The features in {path} must have shape (n, d)",
            f"shape {x.shape}",
            "Save one row a sample",
        )
    if not len(x):
        raise _without_rows(path)
    for name in ("ids", "labels", "groups"):
        column = getattr(found, name)
        if column is not None and len(column) != len(x):
            raise PalpateError(
                f"{name} in {path} must have one entry a row ({len(x)})",
                str(len(column)),
                "Write it again",
            )
    if found.ids is not None:
        _require_ids(path, found.ids)


def _require_ids(path: Path, ids: Sequence[str]) -> None:
    if "" in ids:
        raise PalpateError(
            f"Every row of {path} must have an id",
            f"none in row {list(ids).index('') + 1}",
            "Fill the ids",
        )
    if len(set(ids)) < len(ids):
        double = [i for i, n in Counter(ids).items() if n > 1]
        raise PalpateError(
            f"Every id in {path} must stand once",
            f"{len(double)} that do not, first {double[0]!r}",
            "Keep one row an id",
        )


def _without_rows(path: Path) -> PalpateError:
    return PalpateError(f"{path} must hold at least one row", "none", "Check what wrote it")


def _say_widened(path: Path, kind: str) -> None:
    warnings.warn(
        f"The features in {path}: {kind} features were widened to float32; their rounding stays",
        stacklevel=3,
    )


def _unreadable(path: Path, kind: str, error: BaseException) -> PalpateError:
    return PalpateError(
        f"{path} must be a whole {kind} without pickles", _first_line(error), "Write it again"
    )


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _read_npy(path: Path) -> Embeddings:
    try:
        return Embeddings(path, np.load(path, mmap_mode="r", allow_pickle=False))
    except Exception as error:  # of its header, which is parsed as Python
        raise _unreadable(path, ".npy file", error) from None


def _read_npz(path: Path) -> Embeddings:
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {
                name: data[name]
                for name in ("features", "ids", "labels", "groups", "encoder")
                if name in data
            }
    except Exception as error:  # NumPy, zipfile and zlib raise many kinds
        raise _unreadable(path, ".npz file", error) from None
    if "features" not in arrays:
        raise PalpateError(
            f"{path} must hold an array 'features'",
            "none of that name",
            "Save it with palpate.core.FeatureSet.save",
        )
    column = lambda name: [str(v) for v in arrays[name].reshape(-1)] if name in arrays else None  # noqa: E731
    encoder = (
        str(arrays["encoder"].reshape(-1)[0])
        if "encoder" in arrays and arrays["encoder"].size
        else None
    )
    return Embeddings(
        path, arrays["features"], column("ids"), column("labels"), column("groups"), encoder
    )


def _read_safetensors(path: Path) -> Embeddings:
    """The format is a length (8 bytes, little endian), a JSON header of that length, and the bytes of the tensors."""
    size = path.stat().st_size
    try:
        with open(path, "rb") as file:
            length = int.from_bytes(file.read(8), "little")
            if not 2 <= length <= min(LONGEST_HEADER, size - 8):
                raise ValueError(f"a header of {length} bytes in a file of {size}")
            header = json.loads(file.read(length))
        entry, about = header["features"], header.get("__metadata__", {})
        kind, shape, (start, end) = entry["dtype"], tuple(entry["shape"]), entry["data_offsets"]
        if not (isinstance(about, dict) and all(isinstance(v, str) for v in about.values())):
            raise ValueError("__metadata__ that is no map of text to text")
        if not all(type(v) is int for v in (*shape, start, end)):
            raise ValueError(
                f"features of shape {list(shape)} in bytes {start} to {end}, which must be whole numbers"
            )
        if kind not in SAFE_TYPES:
            raise PalpateError(
                f"The features in {path} must be one of {', '.join(SAFE_TYPES)}",
                str(kind),
                "Save them as F32",
            )
        dtype = SAFE_TYPES[kind]
        if shape[:1] == (0,):
            raise _without_rows(path)
        if (
            min(shape, default=0) < 1
            or end - start != math.prod(shape) * dtype.itemsize
            or not 0 <= start <= end <= size - 8 - length
        ):
            raise ValueError(f"features of shape {shape} in bytes {start} to {end}")
        array: NDArray[Any] = np.memmap(
            path, dtype=dtype, mode="r", offset=8 + length + start, shape=shape
        )
        columns = {
            name: json.loads(about[name]) if name in about else None
            for name in ("ids", "labels", "groups")
        }
        bad = [
            n
            for n, c in columns.items()
            if c is not None and not (isinstance(c, list) and all(isinstance(v, str) for v in c))
        ]
        if bad:
            raise ValueError(f"metadata {bad[0]!r}, which must be a JSON list of text")
    except KeyError as error:
        raise PalpateError(
            f"{path} must hold a tensor 'features'", f"no {error}", "Save it under that name"
        ) from None
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise _unreadable(path, ".safetensors file", error) from None
    if kind == "BF16":
        _say_widened(path, "bfloat16")
        array = (array.astype(np.uint32) << 16).view(np.float32)
    return Embeddings(
        path, array, columns["ids"], columns["labels"], columns["groups"], about.get("encoder")
    )


def _read_parquet(path: Path) -> Embeddings:
    import polars as pl

    try:
        with open(path, "rb") as file:
            about = pl.read_parquet_metadata(file)
        table = pl.read_parquet(path, glob=False)  # a path may hold brackets
    except (Exception, pl.exceptions.PanicException) as error:  # polars raises several kinds
        raise _unreadable(path, "Parquet file", error) from None
    if "id" not in table.columns:
        raise PalpateError(
            f"{path} must have a column id",
            f"columns {', '.join(table.columns[:8])}",
            "Add it: what pairs the samples",
        )
    if not len(table):
        raise _without_rows(path)
    labels, groups = (
        _texts(path, table[n]) if (n := _first(table.columns, options)) else None
        for options in (LABELS, GROUPS)
    )
    return Embeddings(
        path,
        _parquet_features(path, table),
        _texts(path, table["id"]),
        labels,
        groups,
        about.get("encoder"),
    )


def _parquet_features(path: Path, table: Any) -> NDArray[Any]:
    """The column ``features`` as (n, d), or f0, f1, ... side by side."""
    import polars as pl

    if "features" not in table.columns:
        names = sorted(
            (n for n in table.columns if n[:1] == "f" and n[1:].isdigit()), key=lambda n: int(n[1:])
        )
        if not names or names != [f"f{k}" for k in range(len(names))]:
            got = f"columns {', '.join(table.columns[:8])}"
            raise PalpateError(
                f"{path} must have a column features, or f0, f1, ... without a gap",
                got,
                "Rename the columns",
            )
        if (null := next((n for n in names if table[n].null_count()), None)) is not None:
            raise PalpateError(
                f"Every row of {path} must have features",
                f"nothing in column {null}",
                "Fill it, or drop the row",
            )
        return table.select(names).to_numpy()
    column = table["features"]
    if not isinstance(column.dtype, pl.List | pl.Array):
        raise PalpateError(
            f"The column features in {path} must be lists of floats",
            str(column.dtype),
            "Write one list a row",
        )
    lists = column.cast(pl.List(column.dtype.inner))
    lengths = lists.list.len().fill_null(0)
    if (bare := lengths == 0).any():
        got = f"none for {table['id'][bare.arg_true()[0]]!r}"
        raise PalpateError(
            f"Every row of {path} must have features",
            got,
            "Embed these samples, or drop their rows",
        )
    if (bad := lengths != lengths[0]).any():
        at = bad.arg_true()[0]
        got = f"{lengths[at]} numbers for {table['id'][at]!r}"
        raise PalpateError(
            f"All features in {path} must have one width ({lengths[0]})",
            got,
            "Embed all with the same encoder",
        )
    return lists.explode().to_numpy().reshape(len(table), -1)


def _first(columns: Sequence[str], options: Sequence[str]) -> str | None:
    return next((name for name in options if name in columns), None)


def _texts(path: Path, column: Any) -> list[str]:
    import polars as pl

    try:
        return column.cast(pl.String).fill_null("").to_list()
    except pl.exceptions.PolarsError:
        must = f"The column {column.name} in {path} must be text, or numbers"
        raise PalpateError(must, str(column.dtype), "Write one name a row") from None
