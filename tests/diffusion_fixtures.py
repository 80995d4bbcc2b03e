"""A small untrained pipeline whose vision encoder is a few lines of arithmetic."""

from __future__ import annotations

import numpy as np
import torch

from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.autoencoder_training import build_autoencoder
from palpate.diffusion.denoiser import Denoiser, build_unet
from palpate.diffusion.options import ConditionPolicy
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import TINY


class StandInEncoders:
    """A vision encoder that embeds a photo's mean color and contrast: 6 numbers, normalized."""

    dim, device = 6, torch.device("cpu")

    class _Preprocess:
        resize = 16

        def fit(self, images):
            return images

        def __call__(self, x):
            return x - 0.5

    def preprocess(self, modality):
        assert modality == "vision"
        return self._Preprocess()

    def encode(self, modality, pixels):
        values = torch.cat([pixels.mean((2, 3)), pixels.std((2, 3))], dim=1)
        return torch.nn.functional.normalize(values, dim=1)

    def digest(self, modality):
        return f"stand-in {modality}"

    def to(self, device):
        return self


def make_pipeline(
    *, background: bool = False, policy: ConditionPolicy | None = None, width: int = 6
) -> TactilePipeline:
    """An untrained pipeline of 32 px tactile images."""
    torch.manual_seed(0)
    assert TINY.autoencoder is not None
    policy = policy or TINY.condition_for(width)
    unet = build_unet(TINY.unet, policy, channels=3, size=8, background=3 if background else 0)
    # Make the condition matter in an untrained network.
    for name, p in unet.named_parameters():
        if "attn2" in name:
            p.data.mul_(4)
    return TactilePipeline(
        build_autoencoder(TINY.autoencoder).eval(),
        Denoiser(unet, policy).eval(),
        LatentStats((0.1, 0.0, -0.1), (0.5, 0.6, 0.7)),
        TINY.schedule,
        TINY.sampler,
        32,
        encoders=StandInEncoders(),
        preset="tiny",
        training={"steps": 0, "split": None},
    )


def photos(n: int, size: int = 16) -> np.ndarray:
    """Random images (n, size, size, 3)."""
    return np.random.default_rng(0).integers(0, 256, (n, size, size, 3), dtype=np.uint8)


def arrays(images) -> np.ndarray:
    """The images of a pipeline's output as one array."""
    return np.stack([np.asarray(image) for image in images.images])
