"""A small untrained pipeline whose vision encoder is a few lines of arithmetic."""

from __future__ import annotations

import torch

from palpate.diffusion.autoencoder_training import build_autoencoder
from palpate.diffusion.denoiser import ConditionPolicy, Denoiser, build_unet
from palpate.diffusion.latents import LatentStats
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import TINY


class StandInEncoders:
    """A vision encoder that embeds a photo's mean color and contrast: 6 numbers, normalized."""

    dim, device = 6, torch.device("cpu")

    class _Transform:
        resize = 16

        def fit(self, images):
            return images

        def crop(self, x):
            return x

        def normalize(self, x):
            return x - 0.5

    def preprocess(self, encoder):
        assert encoder == "vision"
        return self._Transform()

    def encode(self, encoder, pixels):
        values = torch.cat([pixels.mean((2, 3)), pixels.std((2, 3))], dim=1)
        return torch.nn.functional.normalize(values, dim=1)

    def digest(self, encoder):
        return f"stand-in {encoder}"


def make_pipeline(
    *, background: bool = False, policy: ConditionPolicy | None = None, width: int = 6
) -> TactilePipeline:
    """An untrained pipeline of 32 px touches."""
    torch.manual_seed(0)
    assert TINY.autoencoder is not None
    policy = policy or TINY.condition_for(width)
    unet = build_unet(TINY.unet, channels=3, size=8, width=width, background=background)
    # Make the condition matter in an untrained network.
    for name, p in unet.named_parameters():
        if "attn2" in name:
            p.data.mul_(4)
    stats = LatentStats((0.1, 0.0, -0.1), (0.5, 0.6, 0.7))
    return TactilePipeline(
        build_autoencoder(TINY.autoencoder).eval(),
        Denoiser(unet, policy).eval(),
        stats,
        TINY.schedule,
        TINY.sampler,
        32,
        encoders=StandInEncoders(),
        preset="tiny",
        training={"steps": 0, "split": None},
    )
