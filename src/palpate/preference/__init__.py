"""Blinded preference studies: which generator's images do people find closer to the real ones?

``make`` writes the page and the secret plan, ``serve`` collects votes over a network, ``score``
turns votes into preferences with intervals. All are imported on first use; none loads torch.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name

if TYPE_CHECKING:
    from palpate.preference.making import make
    from palpate.preference.plan import Plan
    from palpate.preference.scoring import score
    from palpate.preference.server import serve

__all__ = ["Plan", "make", "score", "serve"]

_MODULES = {"Plan": "plan", "make": "making", "score": "scoring", "serve": "server"}

__getattr__ = partial(import_name, __name__, _MODULES)
