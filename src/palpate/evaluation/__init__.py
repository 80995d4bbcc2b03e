"""What is measured on what: scores of generators, probes of encoders, the price of a leak."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.evaluation.probing import probe
    from palpate.evaluation.scoring import score

__all__ = ["probe", "score"]


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name == "score":
        from palpate.evaluation.scoring import score

        return score
    if name == "probe":
        from palpate.evaluation.probing import probe

        return probe
    raise AttributeError(f"module 'palpate.evaluation' has no attribute {name!r}")
