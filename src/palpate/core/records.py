"""Dataclasses read from JSON: every value is checked against the annotated type of its field.

Types may be ``str``, ``bool``, ``int``, ``float``, ``Literal``, ``Any``, dataclasses, and of these
``Sequence``, ``Mapping``, ``tuple`` of a fixed length, and unions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")
#: Numbers from here on are refused: JSON has them of any size, NumPy and polars of 64 bits.
LARGEST = 2**63


def from_plain(cls: type[T], data: Any) -> T:
    """Build a dataclass from parsed JSON: the inverse of :func:`palpate.core.plain`.

    Nested dataclasses are built as well, by their own ``from_json`` where they have one.

    Raises:
        ValueError: on a missing, unknown or wrong field. Its text names the field and says what is
            there, so that an error can go on with it after "Got".
    """
    hints = _hints(cls)
    if not isinstance(data, Mapping):
        raise ValueError(f"a {cls.__name__} that is no object")
    if unknown := sorted(set(data) - set(hints)):
        raise ValueError(f"unknown field {unknown[0]}")
    try:
        return cls(**{name: _typed(hints[name], value, name) for name, value in data.items()})
    except TypeError as error:  # a field is missing
        raise ValueError(str(error)) from None


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _typed(hint: Any, value: Any, name: str) -> Any:
    """Convert the value of the field ``name`` to the type ``hint``.

    Raises:
        ValueError: if it has another type.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, UnionType):
        if value is None and type(None) in inner:
            return None
        *first, last = (kind for kind in inner if kind is not type(None))
        for kind in first:
            with suppress(ValueError):
                return _typed(kind, value, name)
        return _typed(last, value, name)  # if this type does not fit either, its error is raised
    if dataclasses.is_dataclass(hint):
        try:
            kind: Any = hint
            return kind.from_json(value) if hasattr(kind, "from_json") else from_plain(kind, value)
        except (AttributeError, TypeError):
            raise ValueError(f"{name} that holds no object") from None
    if origin is tuple and isinstance(value, list | tuple) and len(value) == len(inner):
        return tuple(_typed(kind, item, name) for kind, item in zip(inner, value, strict=True))
    if origin is Sequence and isinstance(value, list | tuple):
        return [_typed(inner[0], item, name) for item in value]
    if origin is Mapping and isinstance(value, Mapping):
        return {key: _typed(inner[1], item, name) for key, item in value.items()}
    if _has_type(hint, value):
        return value
    raise ValueError(f"{name} of type {type(value).__name__}")


def _has_type(hint: Any, value: Any) -> bool:
    """Whether ``value`` has the scalar type ``hint``; an int is a float, a bool is no number."""
    if hint in (int, float):
        kinds = int if hint is int else int | float
        return isinstance(value, kinds) and not isinstance(value, bool) and abs(value) < LARGEST
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    return hint in (str, bool) and isinstance(value, hint)
