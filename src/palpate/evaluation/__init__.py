"""What is measured on what: scores of generators, probes of encoders, the price of a leak."""

from __future__ import annotations

from typing import TYPE_CHECKING

from palpate._lazy import lazy_names

if TYPE_CHECKING:
    from palpate.evaluation.probing import probe
    from palpate.evaluation.scoring import score

__all__ = ["probe", "score"]

__getattr__ = lazy_names(__name__, {"probe": "probing", "score": "scoring"})
