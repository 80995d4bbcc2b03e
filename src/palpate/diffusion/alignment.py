"""Alignment of a denoiser with a frozen encoder (REPA, Yu et al. 2024).

    L = L_diffusion + weight (1 - mean over positions of cos(head(middle block), states))

``states`` are those of the encoder's patches for the clean tactile image, and the head is trained
with the denoiser and left afterwards. An encoder that guided a generator flatters it, so its digest
is kept in the card and with the images, and :func:`palpate.score` rejects it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from numpy.typing import NDArray
from torch import Tensor, nn

from palpate.core import Progress, require
from palpate.data.manifest import Manifest
from palpate.diffusion.encoding import encode_states
from palpate.encoders.embed import embed
from palpate.encoders.encoder_set import EncoderSet, Modality
from palpate.encoders.tactile import TactileModule

#: Positions that are compared: 8 x 8.
POSITIONS = 64


@dataclass(frozen=True)
class Alignment:
    """An encoder that guides a training.

    Attributes:
        encoders: its tactile encoder, or without one its vision encoder, sees the tactile images.
        weight: of the term in the loss.
    """

    encoders: EncoderSet
    weight: float = 0.5

    @classmethod
    def of(cls, encoders: EncoderSet | str | Path, weight: float, device: str) -> Alignment:
        """Load the encoders, if they are named, on a device.

        Raises:
            PalpateError: if there are none of that name, or the weight is negative.
        """
        holds = 0 <= weight < math.inf
        require(holds, "align_weight", "must be a finite number from 0 on", weight, 0.5)
        loaded = encoders if isinstance(encoders, EncoderSet) else EncoderSet.load(encoders)
        return cls(loaded.to(device), weight)

    @property
    def modality(self) -> Modality:
        """Which encoder of the set it is."""
        return "tactile" if "tactile" in self.encoders.modalities else "vision"

    @property
    def about(self) -> dict[str, Any]:
        """What the card says of it; who scores looks for the digest."""
        digest = self.encoders.digest(self.modality)
        return {"encoder": digest, "modality": self.modality, "weight": self.weight}

    def states(self, part: Manifest, folder: Path, progress: Progress) -> NDArray[Any]:
        """States (n, 64, width) of patches of the tactile images, or embeddings (n, 1, width)."""
        if isinstance(self.encoders.tactile, TactileModule):  # of others, whose patches differ
            how: dict[str, Any] = {"cache": folder, "progress": progress}
            return embed(part, self.encoders, "tactile", **how).features[:, None]
        how = {"folder": folder, "column": "tactile", "progress": progress}
        return encode_states(part, self.encoders, self.modality, POSITIONS, **how)


class Guide(nn.Module):
    """Aligns the middle block with a frozen encoder of the clean image (REPA, Yu et al. 2024).

    1 - mean over positions of cos(head(features), states)
    """

    def __init__(self, unet: UNet2DConditionModel, width: int) -> None:
        """Take the U-Net, and the width of the encoder's states."""
        super().__init__()
        channels = int(unet.config["block_out_channels"][-1])
        self.head = nn.Sequential(
            nn.Linear(channels, channels), nn.SiLU(), nn.Linear(channels, width)
        )
        self.features = torch.empty(0)
        self.hook = unet.mid_block.register_forward_hook(self._keep)

    def _keep(self, _: nn.Module, __: Any, output: Tensor) -> None:
        self.features = output

    def forward(self, states: Tensor) -> Tensor:
        """Distances (n,) of the last pass's features from states (n, k, width), k a square."""
        pooled = nn.functional.adaptive_avg_pool2d(self.features, math.isqrt(states.shape[1]))
        made = self.head(pooled.flatten(2).transpose(1, 2)).float()
        return 1 - nn.functional.cosine_similarity(made, states, dim=2).mean(1)
