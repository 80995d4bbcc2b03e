"""What a generator is made of, as plain records; this file needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

if TYPE_CHECKING:
    from torch import Tensor

Source = Literal["text", "vision"]
Sources = Literal["text", "vision", "both", "resnet"]
SOURCES: tuple[Source, ...] = ("text", "vision")
Method = Literal["ddim", "dpm"]


@dataclass(frozen=True)
class AutoencoderOptions:
    """Shape and training of a VQ autoencoder.

    Attributes:
        patch: side of the patches of the stem; 1: none [px].
        widths: channels of each resolution level; each level after the first halves the size.
        layers: residual blocks a level.
        codes: entries of the codebook.
        channels: latent channels.
        groups: of the group normalization.
        steps_free: length of the first stage [optimizer steps].
        steps_quantized: length of the second stage [optimizer steps].
        batch: of both stages [images].
        lr: peak learning rate; the last stage starts at half of it.
        crop: side of the random crops of stage 1; 0: whole images [px].
    """

    patch: int = 4
    widths: tuple[int, ...] = (64,)
    layers: int = 1
    codes: int = 4096
    channels: int = 3
    groups: int = 16
    steps_free: int = 1700
    steps_quantized: int = 200
    batch: int = 8
    lr: float = 2e-3
    crop: int = 32

    @property
    def factor(self) -> int:
        """Pixels of the image that a latent covers along one side."""
        return self.patch * 2 ** (len(self.widths) - 1)


@dataclass(frozen=True)
class BackgroundOptions:
    """Shape and training of an autoencoder that is given the gel's no-contact image.

    Attributes:
        channels: latent channels.
        narrow: channels of the networks at half of the size.
        wide: channels of the networks at a quarter of the size.
        steps: length of the training [optimizer steps].
        batch: of the training [images].
        lr: peak learning rate.
        crop: side of the random crops, a multiple of 4; 0: whole images [px].
    """

    factor: ClassVar[int] = 4

    channels: int = 8
    narrow: int = 48
    wide: int = 96
    steps: int = 2000
    batch: int = 16
    lr: float = 2e-3
    crop: int = 48


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
    """How an embedding becomes a token.

    Attributes:
        width: d, length of the embeddings and of the tokens.
        gap: ``none``; ``pairs``: subtract the mean of the source's training embeddings, and give a
            photo in the place of a text by the texts of the training photos that are near it, the
            mean of these weighted by softmax(cosine / 0.02), and in its own place by the same mean
            of the photos.
        noise: standard deviation, in units of the token's typical entry, of Gaussian noise added in
            training.
        dropout: probability that training replaces the condition by the unconditional token; with
            ``both``, for each of the two on its own.
        source: what training conditions on: ``text`` (the paper), ``vision`` (the paper's baseline
            without text), ``both`` (two tokens: text, then photo), ``resnet`` (that baseline as
            published, GVST: 8 x 8 tokens that a residual network makes of the photo; it is trained
            with the denoiser, and no encoder is needed).
        photo_size: of ``resnet``: side of the photos, a power of 2 from 16 on [px].
        photo_width: of ``resnet``: channels of its first level, a multiple of 4; each further level
            halves the size and doubles them, up to eight times.
        patches: tokens that follow the embedding of a photo: the states of its patches in the
            encoder's last layer, averaged to a square of so many; 0: none.
        contact: whether place, area, strength and shear of touches condition as well, where there
            is an autoencoder that is given the gel, and data that show or name them.
    """

    width: int
    gap: Literal["none", "pairs"] = "none"
    noise: float = 0.0
    dropout: float = 0.1
    source: Sources = "text"
    photo_size: int = 64
    photo_width: int = 32
    patches: int = 0
    contact: bool = False

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources whose embeddings training needs."""
        if self.source == "resnet":
            return ()
        return SOURCES if self.source == "both" else (self.source,)

    @property
    def modalities(self) -> tuple[Source, ...]:
        """The encoders that training needs: vision for the samples that it draws, at least."""
        if not self.sources:
            return ()
        return SOURCES if "text" in self.sources else ("vision",)


@dataclass(frozen=True)
class Schedule:
    """The forward process, and what the network predicts.

    ``epsilon`` (the paper): z_t = sqrt(a_t) z + sqrt(1 - a_t) eps. ``flow``: z_t = (1 - t) z + t
    eps, and the network predicts eps - z (flow matching, Lipman et al. 2023; Liu et al. 2023), with
    t = sigmoid(normal(0.5, 1)) in training (Esser et al. 2024).

    Attributes:
        beta_start: the first beta; sqrt(beta) is linear to the last (diffusers'
            ``scaled_linear``); not of ``flow``.
        beta_end: the last beta.
        steps: T; a time from 0 to 1 goes into the network as T t.
        prediction: what the network predicts: the noise, or the velocity of flow matching.
    """

    beta_start: float = 0.0015
    beta_end: float = 0.0195
    steps: int = 1000
    prediction: Literal["epsilon", "flow"] = "epsilon"

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
        method: ``dpm`` (DPM-Solver++ of order 2), or ``ddim`` (eta 0), for epsilon alone.
        steps: network evaluations a sample; two each under guidance.
        guidance: s; 1 means none.
        batch: at once; results do not depend on it, up to rounding [images].
        rescale: share phi of the guidance rescaling of Lin et al. (2024), which pulls the spread of
            the guided prediction back to that of the conditional one; 0 is the plain formula.
        high: guide only at times t / T up to this (Kynkaanniemi et al. 2024).
    """

    method: Method = "ddim"
    steps: int = 200
    guidance: float = 7.5
    batch: int = 16
    rescale: float = 0.0
    high: float = 1.0
