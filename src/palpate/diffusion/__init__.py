"""Tactile images by latent diffusion: the networks, the saved pipeline, training, generating.

Names are imported on first use; importing this package does not load torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.diffusion.generation import Generated, generate
    from palpate.diffusion.pipeline import TactilePipeline
    from palpate.diffusion.training import train_generator

__all__ = ["Generated", "TactilePipeline", "generate", "train_generator"]
_MODULES = {
    "Generated": "generation",
    "TactilePipeline": "pipeline",
    "generate": "generation",
    "train_generator": "training",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
