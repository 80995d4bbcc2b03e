"""Values as JSON and as text, digests and seeds: SHA-256 over canonical forms.

Equal content has one name, and a random draw depends on (seed, purpose, sample), never on order.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePath
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Return ``value`` with only the types of JSON: dataclasses, paths and arrays are converted.

    NaN and infinity, which JSON has not, become null. Fields of dataclasses that are not compared
    are skipped.

    Raises:
        TypeError: for any other type.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = (field.name for field in dataclasses.fields(value) if field.compare)
        return {name: plain(getattr(value, name)) for name in fields}
    if isinstance(value, PurePath):
        return value.as_posix()
    raise TypeError(f"cannot put a {type(value).__name__} into JSON")


def fact_lines(rows: Mapping[str, Any]) -> list[str]:
    """Return one line per name, the values below each other; ``-`` for none."""
    width = max(map(len, rows), default=0)
    return [f"{name:<{width}}  {_as_text(value) or '-'}" for name, value in rows.items()]


def _as_text(value: Any) -> str:
    """Return a value as a person writes it: ``train 16, test 4`` for a mapping."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_as_text(cell)}" for name, cell in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_as_text, value))
    return "" if value is None else str(value)


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


def canonical_json(value: Any) -> str:
    """Return ``value`` as JSON with sorted keys and no spaces; dataclasses and paths are accepted.

    Raises:
        ValueError: for NaN or infinity, which JSON cannot hold.
    """
    return json.dumps(
        value,
        sort_keys=True,
        separators=(",", ":"),
        default=plain,
        allow_nan=False,
        ensure_ascii=False,
    )


def digest_json(value: Any) -> str:
    """Return the SHA-256 (64 hex digits) of the canonical JSON of ``value``."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def digest_lines(lines: Iterable[str]) -> str:
    """Return the SHA-256 of the lines, each ended by a newline, in the order given."""
    state = hashlib.sha256()
    for line in lines:
        state.update(f"{line}\n".encode())
    return state.hexdigest()


def digest_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_folder(folder: Path, pattern: str = "**/*", *, without: str = "") -> str:
    """Return the SHA-256 over names and bytes of the files in ``folder`` that match ``pattern``.

    ``without``: name of a file of the folder that is left out.
    """
    files = sorted(p for p in folder.glob(pattern) if p.is_file() and p != folder / without)
    return digest_lines(f"{p.relative_to(folder).as_posix()} {digest_file(p)}" for p in files)


def short(digest: str) -> str:
    """Return the first 12 digits: enough for people and folder names."""
    return digest[:12]


def seed_for(seed: int, *names: str | int) -> int:
    """Return a 63-bit seed that depends on ``seed`` and ``names`` alone, on every machine."""
    text = "\x1f".join([str(int(seed)), *map(str, names)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """Return a NumPy generator for (seed, names), e.g. ``rng_for(0, "noise", sample_id)``."""
    return np.random.default_rng(seed_for(seed, *names))
