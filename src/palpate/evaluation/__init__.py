"""What is measured on what: scores of generators, probes of encoders, the price of a leak."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name

if TYPE_CHECKING:
    from palpate.evaluation.auditing import audit
    from palpate.evaluation.probing import probe
    from palpate.evaluation.scoring import score

__all__ = ["audit", "probe", "score"]

_MODULES = {"audit": "auditing", "probe": "probing", "score": "scoring"}

__getattr__ = partial(import_name, __name__, _MODULES)
