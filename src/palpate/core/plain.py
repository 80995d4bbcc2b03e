"""Values as JSON can hold them, and arrays as NumPy can."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import PurePath
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
