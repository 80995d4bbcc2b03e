"""What a generator is made of, as plain records; this file needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from torch import Tensor

Source = Literal["text", "vision"]
SOURCES: tuple[Source, ...] = ("text", "vision")


@dataclass(frozen=True)
class AutoencoderOptions:
    """Shape and training of a VQ autoencoder.

    Attributes:
        patch: side of the patches of the stem (1: none).
        widths: channels of each resolution level; each level after the first halves the size.
        layers: residual blocks a level.
        codes: entries of the codebook.
        channels: latent channels.
        groups: of the group normalization.
        attention: whether the middle block attends.
        steps_free, steps_quantized: optimizer steps of the two stages.
        batch, lr: of both stages; the last starts at half the rate.
        crop: side of the random crops of stage 1 in pixels (0: whole images).
        noise: standard deviation of the noise of stage 1, as a share of the latents'.
        l1, l2, edge, codebook: weights in the loss.
    """

    patch: int = 4
    widths: tuple[int, ...] = (64,)
    layers: int = 1
    codes: int = 4096
    channels: int = 3
    groups: int = 16
    attention: bool = False
    steps_free: int = 1700
    steps_quantized: int = 200
    batch: int = 8
    lr: float = 2e-3
    crop: int = 32
    noise: float = 0.02
    l1: float = 0.25
    l2: float = 10.0
    edge: float = 10.0
    codebook: float = 0.25


@dataclass(frozen=True)
class UNetOptions:
    """Geometry of the U-Net.

    Attributes:
        widths: channels of each resolution level.
        attention: whether each level attends (to itself and to the condition); the middle block
            always does.
        layers: residual blocks per level.
        head_width: channels of an attention head.
        groups: of the group normalization.
        modulate: also add the (first) token to the time embedding; the paper has cross-attention
            alone.
    """

    widths: tuple[int, ...]
    attention: tuple[bool, ...]
    layers: int = 2
    head_width: int = 32
    groups: int = 32
    modulate: bool = False


@dataclass(frozen=True)
class ConditionPolicy:
    """How an embedding becomes tokens.

    Attributes:
        width: d, length of the embeddings and of the tokens.
        tokens: k, how often the token is repeated.
        null: the unconditional token, ``zeros`` or ``learned``.
        gap: ``none``, or ``mean-shift`` (subtract the mean of the source's training embeddings).
        noise: standard deviation, in units of the token's typical entry, of Gaussian noise added in
            training.
        dropout: probability that training replaces the condition by the unconditional token.
        source: what training conditions on: ``text`` (the paper), ``vision`` (the GVST baseline),
            ``mixed`` (half each).
    """

    width: int
    tokens: int = 1
    null: Literal["zeros", "learned"] = "zeros"
    gap: Literal["none", "mean-shift"] = "none"
    noise: float = 0.0
    dropout: float = 0.1
    source: Literal["text", "vision", "mixed"] = "text"

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources that training needs."""
        return SOURCES if self.source == "mixed" else (self.source,)


@dataclass(frozen=True)
class Schedule:
    """The forward process z_t = sqrt(a_t) z + sqrt(1 - a_t) eps, and what the network predicts.

    Attributes:
        beta_start, beta_end: first and last beta; sqrt(beta) is linear between them
            (diffusers' ``scaled_linear``).
        steps: T.
        prediction: ``epsilon`` (the paper) or ``v_prediction``.
        min_snr: g of the min-SNR weight, or None for Eq. 1's uniform weight.
    """

    beta_start: float = 0.0015
    beta_end: float = 0.0195
    steps: int = 1000
    prediction: Literal["epsilon", "v_prediction"] = "epsilon"
    min_snr: float | None = None

    def alphas(self) -> Tensor:
        """a_t = prod_{s<=t} (1 - beta_s) for t = 1..T as float64 (T,)."""
        import torch

        ends = self.beta_start**0.5, self.beta_end**0.5
        betas = torch.linspace(*ends, self.steps, dtype=torch.float64) ** 2
        return torch.cumprod(1 - betas, dim=0)


@dataclass(frozen=True)
class SamplerOptions:
    """How to sample.

    Attributes:
        method: ``ddim`` (eta 0) or ``dpm`` (DPM-Solver++ of order 2).
        steps: network evaluations per sample (two each under guidance).
        guidance: s; 1 means none.
        batch: samples at once; results do not depend on it (up to rounding).
        rescale: share phi of the guidance rescaling of Lin et al. (2024), which pulls the spread of
            the guided prediction back to that of the conditional one; 0 is the plain formula.
    """

    method: Literal["ddim", "dpm"] = "ddim"
    steps: int = 200
    guidance: float = 7.5
    batch: int = 16
    rescale: float = 0.0
