"""Leakage: does a split leak, where, and a split that does not.

``audit``, ``split`` and ``verify`` are imported on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.leakage.auditing import audit
    from palpate.leakage.splitting import split
    from palpate.leakage.verifying import verify

__all__ = ["audit", "split", "verify"]

_MODULES = {"audit": "auditing", "split": "splitting", "verify": "verifying"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'palpate.leakage' has no attribute {name!r}")
    return getattr(importlib.import_module(f"palpate.leakage.{_MODULES[name]}"), name)
