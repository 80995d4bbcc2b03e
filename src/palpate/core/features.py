"""Features of samples: the arrays that scores and audits are computed from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.files import atomic_path
from palpate.core.messages import PalpateError, few, require_rows

Array = NDArray[np.float64]
Index = NDArray[np.intp]
#: Rows that are checked and hashed at a time: a memory-mapped array is never copied whole.
BLOCK = 8192


def to_numpy(values: Any) -> np.ndarray:
    """Return an array, or a tensor on any device, as a NumPy array; bfloat16 becomes float32.

    Raises:
        TypeError, ValueError: if the values are no array.
    """
    if hasattr(values, "detach"):
        values = values.detach().cpu()
        if str(values.dtype).endswith("bfloat16"):
            values = values.float()
    return np.asarray(values)


def is_missing(name: Any) -> bool:
    """Return whether a label or group is none: None, an empty string, NaN, pandas' NA or NaT."""
    return (
        name is None
        or type(name).__name__ in ("NAType", "NaTType")
        or name == ""
        or bool(name != name)
    )


@dataclass(frozen=True)
class FeatureSet:
    """Features of samples, in one order.

    Attributes:
        ids: n sample ids.
        features: array (n, d) or tensor, which is copied to the host; encoders give L2-normalized
            float32 rows.
        labels: n materials, or None.
        groups: n groups (videos, contacts), or None.
        encoder: digest of the encoder that made them.

    Raises:
        PalpateError: on unequal lengths, a wrong shape, or values that are not finite.
    """

    ids: Sequence[str]
    features: np.ndarray
    labels: Sequence[str] | None = None
    groups: Sequence[str] | None = None
    encoder: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.features, np.ndarray):  # a tensor, or a list of rows
            try:
                object.__setattr__(self, "features", to_numpy(self.features))
            except (TypeError, ValueError, RuntimeError) as error:
                must, got = "Features must turn into an array (n, d)", str(error).splitlines()[0]
                raise PalpateError(must, got, "Pass rows of one width") from None
        if self.features.dtype.kind not in "fiub":
            got = f"dtype {self.features.dtype}"
            raise PalpateError("Features must be numbers", got, "Pass one row of numbers per id")
        n, shape = len(self.ids), self.features.shape
        if len(shape) != 2 or shape[0] != n:
            must = f"Features must have shape ({n}, d), one row per id"
            raise PalpateError(must, f"shape {shape}", "Pass one row per id")
        for name in ("labels", "groups"):
            column = getattr(self, name)
            if column is not None and len(column) != n:
                must, got = f"must have one entry per row ({n})", f"{len(column)}"
                raise PalpateError(must, got, "Pass them in the order of the ids", argument=name)
        finite = [np.isfinite(self.features[k : k + BLOCK]).all(axis=1) for k in range(0, n, BLOCK)]
        bad = np.flatnonzero(~np.concatenate(finite)) if finite else ()
        if len(bad):
            names = list(self.ids)  # a pandas column may have another index
            rows = few(f"{k}: {names[k]!r}" for k in bad)
            got = f"NaN or infinity in {len(bad)} row{'s' * (len(bad) != 1)} ({rows})"
            fix = "Check what those rows were made from"
            raise PalpateError("Features must be finite", got, fix)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of ids and features as float32, independent of the order of rows."""
        rows: list[tuple[str, bytes]] = []
        for k in range(0, len(self.features), BLOCK):
            with np.errstate(over="ignore"):
                block = np.ascontiguousarray(self.features[k : k + BLOCK], dtype="<f4")
            block = block + np.float32(0)  # -0 becomes 0, which it equals
            hashes = (hashlib.blake2b(row.tobytes(), digest_size=16).digest() for row in block)
            rows += zip(map(str, self.ids[k : k + BLOCK]), hashes, strict=True)
        state = hashlib.sha256(str(self.features.shape[1]).encode())
        for name, row in sorted(rows):
            state.update(json.dumps(name).encode() + row)
        return state.hexdigest()

    def take(self, ids: Sequence[str]) -> FeatureSet:
        """Return the rows of ``ids``, in that order.

        Raises:
            PalpateError: if an id is missing.
        """
        must, fix = "Every requested id must have features", "Embed those samples as well"
        rows = require_rows(self.ids, ids, must, fix)
        labels, groups = (
            None if column is None else [column[k] for k in rows]
            for column in (self.labels, self.groups)
        )
        return FeatureSet(list(ids), self.features[rows], labels, groups, self.encoder)

    def save(self, path: Path) -> None:
        """Write an ``.npz`` of plain arrays (no pickles), atomically."""
        text = lambda column: np.array(["" if is_missing(c) else c for c in column], dtype=str)
        names = [name for name in ("labels", "groups") if getattr(self, name) is not None]
        with atomic_path(Path(path)) as part, open(part, "wb") as file:
            np.savez(
                file,
                allow_pickle=False,
                ids=np.array(list(self.ids), dtype=str),
                features=self.features,
                **{name: text(getattr(self, name)) for name in names},
                **({"encoder": np.array(self.encoder)} if self.encoder else {}),
            )

    @classmethod
    def load(cls, path: Path) -> FeatureSet:
        """Read what :meth:`save` wrote; never a pickle."""
        with np.load(path, allow_pickle=False) as data:
            labels, groups = (data[k].tolist() if k in data else None for k in ("labels", "groups"))
            encoder = str(data["encoder"]) if "encoder" in data else None
            return cls(data["ids"].tolist(), data["features"], labels, groups, encoder)
