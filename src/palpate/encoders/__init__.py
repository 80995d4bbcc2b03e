"""The encoders (vision, text, tactile): loading, contrastive training, embedding with a cache.

Names are imported on first use; importing this package does not load torch.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name

if TYPE_CHECKING:
    from palpate.encoders.contrastive import train_encoder
    from palpate.encoders.encoder import Encoder
    from palpate.encoders.encoder_set import EncoderSet

__all__ = ["Encoder", "EncoderSet", "train_encoder"]
_MODULES = {"Encoder": "encoder", "EncoderSet": "encoder_set", "train_encoder": "contrastive"}

__getattr__ = partial(import_name, __name__, _MODULES)
