"""Tactile images by latent diffusion: the networks, the saved pipeline, training, generating.

Names are imported on first use; importing this package does not load torch.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name

if TYPE_CHECKING:
    from palpate.diffusion.autoencoder_training import train_autoencoder
    from palpate.diffusion.generated import Generated
    from palpate.diffusion.generation import generate
    from palpate.diffusion.pipeline import TactilePipeline
    from palpate.diffusion.training import train_generator

__all__ = ["Generated", "TactilePipeline", "generate", "train_autoencoder", "train_generator"]
#: Public name -> the module that it is imported from.
_MODULES = {
    "Generated": "generated",
    "TactilePipeline": "pipeline",
    "generate": "generation",
    "train_autoencoder": "autoencoder_training",
    "train_generator": "training",
}

__getattr__ = partial(import_name, __name__, _MODULES)
