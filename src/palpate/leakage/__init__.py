"""Leakage: does a split leak, where, and a split that does not.

``audit`` and ``split`` are imported on first use.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name

if TYPE_CHECKING:
    from palpate.leakage.auditing import audit
    from palpate.leakage.splitting import split

__all__ = ["audit", "split"]

_MODULES = {"audit": "auditing", "split": "splitting"}

__getattr__ = partial(import_name, __name__, _MODULES)
