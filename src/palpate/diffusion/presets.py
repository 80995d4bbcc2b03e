"""Presets: complete configurations of autoencoder, denoiser, training and sampling.

For tests, for two CPU cores, and the paper's:

==============  ====================  ============================  ================================
setting         ``tiny``              ``mini``                      ``paper``
==============  ====================  ============================  ================================
for             tests, seconds        two CPU cores, minutes        GPUs; paper sections 2 and 9
image, latents  32 px, 3 x 8 x 8      64 px, 8 x 16 x 16            256 px, 3 x 64 x 64
autoencoder     patch 4, width 16     given the gel, 48-96          latent diffusion ``vq-f4``
latent scale    std                   std                           one (recorded, not applied)
U-Net           16-32                 64-96, modulated, 2.6 M       192 x (1, 2, 3, 5), 406.3 M
schedule        beta, T = 1000        flow                          beta, T = 1000
prediction      eps                   velocity                      eps (Eq. 1)
condition       one token             text and photo, a token each  one token
source          text                  both                          text
gap, noise      none, 0               pairs, 0.3                    none, 0
optimizer       AdamW 1e-3, EMA 0.99  AdamW 1e-3, cosine, EMA 0.99  AdamW 6.4e-5, EMA 0.9999
length          20 steps of 8         400 steps of 16               30 epochs of batch 32
sampler         DPM-Solver++ 4        DPM-Solver++ 10               DDIM 200, eta 0
guidance        2                     3 up to t = .8, rescaled .7   7.5
==============  ====================  ============================  ================================

beta: linear in its square root, 0.0015 -> 0.0195. Dropout 0.1 in all presets.

``small`` is for a small GPU and has not been trained to its end: 128 px, 8 x 32 x 32 latents of an
autoencoder that is given the gel (64-128), a modulated U-Net of 128-256-384 (64 M), condition and
objective of ``mini``; AdamW 3e-4, cosine, EMA 0.9995, 30,000 steps of 64; DPM-Solver++ 20, guidance
2.5.

``mini`` is the geometry of the models that ship (docs/concepts/mini.md, with their scores and with
what did not work): what is trained with it can go on from them. A condition whose source is
``text`` is the paper's training.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from palpate.core import require, require_choice
from palpate.diffusion.options import (
    AutoencoderOptions,
    BackgroundOptions,
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
        size: side of the tactile images [px].
        autoencoder: how to train one, or None if a trained one is given (``paper``: a
            ``vq-f4``).
        latent_scale: what divides the latents: their standard deviation, or one.
        unet: geometry of an untrained one, or the folder or hub id of a trained one of diffusers to
            go on from; its latents and tokens must be those of autoencoder and encoders.
        schedule, sampler: see there.
        condition: the policy; its width is replaced by that of the encoders at hand.
        loop: training; ``steps`` is ignored if ``epochs`` is given.
        epochs: passes over the training part, or None.
        cost: what it takes.
        score: what it has reached, and where.
    """

    name: str
    size: int
    autoencoder: AutoencoderOptions | BackgroundOptions | None
    latent_scale: Literal["std", "one"]
    unet: UNetOptions | str
    condition: ConditionPolicy
    loop: LoopOptions
    cost: str
    score: str
    epochs: int | None = None
    schedule: Schedule = field(default_factory=Schedule)
    sampler: SamplerOptions = field(default_factory=SamplerOptions)

    def __post_init__(self) -> None:
        """Raise ``PalpateError`` for settings out of range."""
        dropout, size = self.condition.dropout, self.condition.photo_size
        require(0 <= dropout < 1, "condition.dropout", "must lie in [0, 1)", dropout, 0.1)
        power = size >= 16 and size & (size - 1) == 0
        require(power, "condition.photo_size", "must be a power of 2 from 16 on", size, 64)
        patches, width = self.condition.patches, self.condition.photo_width
        square = math.isqrt(patches) ** 2 == patches
        require(square, "condition.patches", "must be a square number", patches, 64)
        must = "must be a multiple of 4"
        require(width % 4 == 0 < width, "condition.photo_width", must, width, 32)

    def loop_for(self, n: int, *, seed: int | None = None) -> LoopOptions:
        """The loop for ``n`` training samples: epochs become steps."""
        steps = self.loop.steps
        if self.epochs is not None:
            steps = max(1, -(-self.epochs * n // self.loop.batch))
        return replace(self.loop, steps=steps, seed=self.loop.seed if seed is None else seed)

    def condition_for(self, width: int) -> ConditionPolicy:
        """The policy for embeddings of ``width``; photos alone need no memory of texts."""
        gap = self.condition.gap if "text" in self.condition.sources else "none"
        return replace(self.condition, width=width, gap=gap)

    def with_steps(self, steps: int | None) -> DiffusionPreset:
        """The same with so many optimizer steps; None: as it is.

        Raises:
            PalpateError: if they are none.
        """
        if steps is None:
            return self
        fix = "Leave it out for the preset's length"
        require(steps >= 1, "steps", "must be at least 1", steps, fix=fix)
        return replace(self, epochs=None, loop=replace(self.loop, steps=steps))


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
    cost="seconds",
    score="for tests",
    sampler=SamplerOptions("dpm", steps=4, guidance=2.0, batch=4),
)

MINI = DiffusionPreset(
    name="mini",
    size=64,
    autoencoder=BackgroundOptions(),
    latent_scale="std",
    unet=UNetOptions(
        widths=(64, 96), attention=(False, True), layers=1, head_width=32, groups=16, modulate=True
    ),
    # Gap and noise go beyond the paper: the text-image gap is wide in small encoders.
    condition=ConditionPolicy(width=128, gap="pairs", noise=0.3, source="both"),
    loop=LoopOptions(steps=400, batch=16, lr=1e-3, warmup=50, ema=0.99),
    cost="minutes on two cores; palpate/mini: autoencoder 20 core-minutes, generator 101",
    score="palpate/mini on new worlds: autoencoder 37 dB PSNR, generator TMMD 0.24",
    schedule=Schedule(prediction="flow"),
    # Guidance at the noisiest times, and the contrast that it adds, are what costs TMMD.
    sampler=SamplerOptions("dpm", steps=10, guidance=3.0, rescale=0.7, high=0.8),
)

#: The paper's model as far as it is known; what it leaves open is as usual in latent diffusion
#: (docs/concepts/generator.md says what else was tried).
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
    condition=ConditionPolicy(width=768, photo_size=256, photo_width=64),
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
    cost="30 epochs at 126 images/s on one H100 with TF32, 270 in bf16 compiled",
    score="not measured here",
    epochs=30,
    sampler=SamplerOptions("ddim", steps=200, guidance=7.5),
)

SMALL = DiffusionPreset(
    name="small",
    size=128,
    autoencoder=BackgroundOptions(narrow=64, wide=128, steps=10_000, crop=64),
    latent_scale="std",
    unet=UNetOptions(
        widths=(128, 256, 384),
        attention=(False, True, True),
        layers=2,
        head_width=64,
        groups=32,
        modulate=True,
    ),
    condition=replace(MINI.condition, photo_size=128, photo_width=64),
    loop=LoopOptions(steps=30_000, batch=64, lr=3e-4, warmup=500, ema=0.9995),
    cost="30,000 steps of 64 on one small GPU; not measured",
    score="not trained to its end",
    schedule=Schedule(prediction="flow"),
    sampler=SamplerOptions("dpm", steps=20, guidance=2.5),
)

PRESETS = {preset.name: preset for preset in (TINY, MINI, SMALL, PAPER)}


def preset_of(preset: str | DiffusionPreset) -> DiffusionPreset:
    """A preset as it is, or by name.

    Raises:
        PalpateError: if there is none of that name.
    """
    if isinstance(preset, DiffusionPreset):
        return preset
    require_choice("preset", preset, PRESETS)
    return PRESETS[preset]
