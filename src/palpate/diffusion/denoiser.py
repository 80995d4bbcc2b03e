"""The denoiser eps_theta(z_t, t, condition): a diffusers U-Net, its condition, its schedule.

The condition is one *projected* embedding c of the shared space, so that text and vision embeddings
fit into the same slot (paper section 2; section 9, "token type"):

    token = sqrt(d) * (c - m_source) / ||c - m_source||,   repeated k times

with m_source = 0 (``gap="none"``, the paper's reading) or the mean of that modality on the train
part (``"mean-shift"``, which closes the constant part of the gap between text and vision
embeddings). The unconditional token of classifier-free guidance is all zeros, or learned. All of
this is part of the checkpoint.

With ``UNetOptions.modulate`` the token is also added, through two layers, to the embedding of the
time step, which shifts every residual block. That is not in the paper; a small network trains
faster with it than with cross-attention to one token. The paper's variant with background ("w/ BG")
concatenates the latent of the no-contact image to the noisy latent along channels.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from palpate.core import PalpateError, atomic_path
from palpate.diffusion.options import SOURCES, ConditionPolicy, Source, UNetOptions
from palpate.encoders.models import UNREADABLE, first_line, load_model, round_to_half, save_model


def build_unet(
    options: UNetOptions, *, channels: int, size: int, width: int, background: bool
) -> UNet2DConditionModel:
    """Build an untrained U-Net for latents (channels, size, size) and tokens of ``width``.

    With ``background`` it takes twice the channels: noisy latent, then background latent.
    """
    down = ["CrossAttnDownBlock2D" if a else "DownBlock2D" for a in options.attention]
    up = ["CrossAttnUpBlock2D" if a else "UpBlock2D" for a in reversed(options.attention)]
    # diffusers keeps the number of heads under this name.
    heads: Any = tuple(max(1, w // options.head_width) for w in options.widths)
    return UNet2DConditionModel(
        sample_size=size,
        in_channels=channels * (2 if background else 1),
        out_channels=channels,
        down_block_types=tuple(down),
        up_block_types=tuple(up),
        block_out_channels=options.widths,
        layers_per_block=options.layers,
        cross_attention_dim=width,
        norm_num_groups=options.groups,
        class_embed_type="projection" if options.modulate else None,
        projection_class_embeddings_input_dim=width if options.modulate else None,
        attention_head_dim=heads,
    )


class Denoiser(nn.Module):
    """U-Net, condition policy, the modality means and the unconditional token.

    Attributes:
        unet: the diffusers model.
        policy: see :class:`ConditionPolicy`.
        background: whether a background latent is expected.
    """

    means: Tensor

    def __init__(
        self,
        unet: UNet2DConditionModel,
        policy: ConditionPolicy,
        means: Mapping[Source, Tensor] | None = None,
    ) -> None:
        """Take, for ``gap="mean-shift"``, the training mean (d,) of each source as ``means``."""
        super().__init__()
        self.unet, self.policy = unet, policy
        self.background = unet.config["in_channels"] == 2 * unet.config["out_channels"]
        # A source without a mean is marked by NaN, and raises when it is used.
        fill = 0.0 if policy.gap == "none" else float("nan")
        known = means if means is not None and policy.gap != "none" else {}
        rows = [known.get(s, torch.full((policy.width,), fill)).float() for s in SOURCES]
        self.register_buffer("means", torch.stack(rows))
        learned = policy.null == "learned"
        self.null = nn.Parameter(0.02 * torch.randn(policy.width)) if learned else None

    @property
    def channels(self) -> int:
        """Latent channels."""
        return int(self.unet.config["out_channels"])

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.means.device

    def tokens(self, conditions: Tensor, source: Source) -> Tensor:
        """Embeddings (n, d) of one source -> tokens (n, k, d).

        Raises:
            PalpateError: for another width, or a source whose training mean is unknown.
        """
        width = self.policy.width
        if conditions.ndim != 2 or conditions.shape[1] != width:
            must, got = f"must be embeddings of shape (n, {width})", str(tuple(conditions.shape))
            fix = "Use the pipeline's encoders"
            raise PalpateError(must, got, fix, argument="conditions")
        mean = self.means[SOURCES.index(source)]
        if not torch.isfinite(mean).all():
            must = f"gap='mean-shift' needs the training mean of {source} embeddings"
            fix = f"Give training the {source} embeddings too"
            raise PalpateError(must, "a checkpoint without it", fix)
        centered = conditions.to(self.device, torch.float32) - mean
        token = nn.functional.normalize(centered, dim=1) * width**0.5
        return token.unsqueeze(1).expand(-1, self.policy.tokens, -1)

    def null_tokens(self, n: int) -> Tensor:
        """The unconditional tokens (n, k, d)."""
        shape = (n, self.policy.tokens, self.policy.width)
        return (
            torch.zeros(shape, device=self.device) if self.null is None else self.null.expand(shape)
        )

    def forward(
        self, x: Tensor, t: Tensor, tokens: Tensor, background: Tensor | None = None
    ) -> Tensor:
        """The network's output (n, c, h, w): noise, or v where the schedule says so.

        Args:
            x: noisy normalized latents (n, c, h, w).
            t: steps, int64 (n,) in 0..T-1 (the paper's 1..T).
            tokens: (n, k, d).
            background: normalized latents of the no-contact images (n, c, h, w), for the variant w/
                BG.
        """
        x = x if background is None else torch.cat([x, background], dim=1)
        first = tokens[:, 0] if self.unet.config["class_embed_type"] == "projection" else None
        options: Any = {"encoder_hidden_states": tokens, "class_labels": first}
        return cast("Tensor", self.unet(x, t, return_dict=False, **options)[0])

    def halve(self) -> float:
        """Round the U-Net's weights to 16 bits in place; see ``models.round_to_half``."""
        return round_to_half({"unet": self.unet})

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Write the U-Net and ``condition.safetensors`` (means, learned token).

        With ``half``, :meth:`halve` first (this object too), and the U-Net's weights are 16-bit;
        the few others stay float32.
        """
        if half:
            self.halve()
        save_model(self.unet, folder, half=half)
        extra = {"means": self.means} | ({} if self.null is None else {"null": self.null.detach()})
        with atomic_path(Path(folder) / "condition.safetensors") as part:
            save_file({k: v.cpu().contiguous() for k, v in extra.items()}, part)

    @classmethod
    def load(cls, folder: Path, policy: ConditionPolicy) -> Denoiser:
        """Read what :meth:`save` wrote.

        Raises:
            PalpateError: if a file is missing, unreadable, incomplete, or of another policy.
        """
        must, fix = f"The denoiser {folder} must be as palpate writes it", "Copy the folder again"
        options = {"low_cpu_mem_usage": False, "use_safetensors": True, "local_files_only": True}
        model = cls(load_model(UNet2DConditionModel, str(folder), must, fix, **options), policy)
        try:
            extra = load_file(Path(folder) / "condition.safetensors")
            model.load_state_dict(extra, strict=False)
            if missing := {"means", "null"} & set(model.state_dict()) - set(extra):
                raise KeyError(f"no {', '.join(missing)}")
        except UNREADABLE as error:
            raise PalpateError(must, first_line(error), fix) from None
        return model.eval().requires_grad_(False)
