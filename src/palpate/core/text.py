"""Names and values as lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


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
