"""The encoders (vision, text, tactile): loading, contrastive training, embedding with a cache.

Names are imported on first use; importing this package does not load torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.encoders.contrastive import train_encoder
    from palpate.encoders.encoder import Encoder
    from palpate.encoders.encoder_set import EncoderSet

__all__ = ["Encoder", "EncoderSet", "train_encoder"]
_MODULES = {"Encoder": "encoder", "EncoderSet": "encoder_set", "train_encoder": "contrastive"}


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
