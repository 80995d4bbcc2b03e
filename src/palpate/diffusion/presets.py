"""Presets: complete configurations of autoencoder, denoiser, training and sampling.

==============  ====================  ============================  ================================
setting         ``tiny``              ``mini``                      ``paper``
==============  ====================  ============================  ================================
for             tests, seconds        two CPU cores, minutes        GPUs; paper sections 2 and 9
image, latents  32 px, 3 x 8 x 8      64 px, 4 x 16 x 16            256 px, 3 x 64 x 64
autoencoder     patch 4, width 16     patch 2, 32-64, 8,192 codes   latent diffusion ``vq-f4``
latent scale    std                   std                           one (recorded, not applied)
U-Net           16-32                 64-96, modulated, 2.6 M       192 x (1, 2, 3, 5), 406.3 M
schedule        T = 1000, beta linear in its square root, 0.0015 -> 0.0195, in all three
prediction      eps                   v                             eps (Eq. 1)
condition       one token, dropout 0.1, null zeros, in all three
source          text                  text or photo, half each      text
gap, noise      none, 0               mean-shift, 0.3               none, 0
optimizer       AdamW 1e-3, EMA 0.99  AdamW 1e-3, cosine, EMA 0.99  AdamW 6.4e-5, EMA 0.9999
length          20 steps of 8         800 steps of 8                30 epochs of batch 32
sampler         DPM-Solver++ 4        DPM-Solver++ 8                DDIM 200, eta 0
guidance        2                     4                             7.5
==============  ====================  ============================  ================================

``mini`` is the geometry of the models that ship (docs/concepts/mini.md, with their scores and with
what did not work): what is trained with it can go on from them. ``source="text"`` is the paper's
training.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from palpate.core import require, require_choice
from palpate.diffusion.options import (
    AutoencoderOptions,
    ConditionPolicy,
    SamplerOptions,
    Schedule,
    UNetOptions,
)
from palpate.training.options import LoopOptions


@dataclass(frozen=True)
class DiffusionPreset:
    """Everything that defines a generator except its data and encoders.

    Attributes:
        name: recorded in the pipeline.
        size: side of the tactile images in pixels.
        autoencoder: how to train one, or None if a trained one is given (``paper``: a ``vq-f4``
            folder).
        latent_scale: see :class:`~palpate.diffusion.autoencoder.LatentStats`.
        unet, schedule, sampler: see there.
        condition: the policy; its width is replaced by that of the encoders at hand.
        loop: training; ``steps`` is ignored if ``epochs`` is given.
        epochs: passes over the training part, or None.
    """

    name: str
    size: int
    autoencoder: AutoencoderOptions | None
    latent_scale: Literal["std", "one"]
    unet: UNetOptions
    condition: ConditionPolicy
    loop: LoopOptions
    epochs: int | None = None
    schedule: Schedule = field(default_factory=Schedule)
    sampler: SamplerOptions = field(default_factory=SamplerOptions)

    def __post_init__(self) -> None:
        """Raise ``PalpateError`` if the dropout is no probability below 1."""
        dropout = self.condition.dropout
        require(0 <= dropout < 1, "dropout", "must lie in [0, 1)", dropout, 0.1)

    def loop_for(self, n: int, *, seed: int | None = None) -> LoopOptions:
        """The loop for ``n`` training samples: epochs become steps."""
        steps = self.loop.steps
        if self.epochs is not None:
            steps = max(1, -(-self.epochs * n // self.loop.batch))
        return replace(self.loop, steps=steps, seed=self.loop.seed if seed is None else seed)

    def condition_for(self, width: int) -> ConditionPolicy:
        """The policy for embeddings of ``width``."""
        return replace(self.condition, width=width)


TINY = DiffusionPreset(
    name="tiny",
    size=32,
    autoencoder=AutoencoderOptions(
        patch=4,
        widths=(16,),
        groups=4,
        codes=64,
        steps_free=20,
        steps_quantized=10,
        batch=8,
        crop=0,
    ),
    latent_scale="std",
    unet=UNetOptions(widths=(16, 32), attention=(False, True), layers=1, head_width=16, groups=8),
    condition=ConditionPolicy(width=32),
    loop=LoopOptions(steps=20, batch=8, lr=1e-3, warmup=5, ema=0.99),
    sampler=SamplerOptions("dpm", steps=4, guidance=2.0, batch=4),
)

MINI = DiffusionPreset(
    name="mini",
    size=64,
    # f4 as in latent diffusion: pixel pairs become channels, then one halving. Plain 4 px patches
    # lose texture.
    autoencoder=AutoencoderOptions(
        patch=2, widths=(32, 64), channels=4, codes=8192, steps_free=2000, steps_quantized=300
    ),
    latent_scale="std",
    unet=UNetOptions(
        widths=(64, 96), attention=(False, True), layers=1, head_width=32, groups=16, modulate=True
    ),
    # Gap and noise go beyond the paper: the text-image gap is wide in small encoders.
    condition=ConditionPolicy(width=128, gap="mean-shift", noise=0.3, source="mixed"),
    loop=LoopOptions(steps=800, batch=8, lr=1e-3, warmup=50, ema=0.99),
    schedule=Schedule(prediction="v_prediction"),
    sampler=SamplerOptions("dpm", steps=8, guidance=4.0),
)

#: The paper's model as far as it is known; reference/paper.md section 9 gives the reason for each
#: open choice.
PAPER = DiffusionPreset(
    name="paper",
    size=256,
    autoencoder=None,
    latent_scale="one",
    unet=UNetOptions(
        widths=(192, 384, 576, 960),
        attention=(False, True, True, True),
        layers=2,
        head_width=32,
        groups=32,
    ),
    condition=ConditionPolicy(width=768),
    loop=LoopOptions(
        steps=0,
        batch=32,
        lr=2e-6 * 32,
        warmup=0,
        decay="constant",
        weight_decay=0.01,
        clip_norm=None,
        ema=0.9999,
    ),
    epochs=30,
    sampler=SamplerOptions("ddim", steps=200, guidance=7.5),
)

PRESETS = {preset.name: preset for preset in (TINY, MINI, PAPER)}


def preset_named(name: str) -> DiffusionPreset:
    """The preset of that name.

    Raises:
        PalpateError: if there is none.
    """
    require_choice("preset", name, PRESETS)
    return PRESETS[name]
