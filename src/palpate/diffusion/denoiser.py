"""The denoiser eps_theta(z_t, t, condition): a diffusers U-Net with cross-attention, and the policy of its condition.

The condition is one *projected* embedding c of the shared space, so that text and vision embeddings fit into the
same slot (paper section 2; section 9, "token type"):

    token = sqrt(d) * (c - m_source) / ||c - m_source||,   repeated k times

with m_source = 0 (``gap="none"``, the paper's reading) or the train-side mean of that modality (``"mean-shift"``,
which closes the constant part of the gap between text and vision embeddings). The unconditional token of
classifier-free guidance is all zeros, or learned. Everything here is part of the checkpoint.

Beside cross-attention the token may also be added, through two layers, to the embedding of the time step (``UNetOptions.modulate``), which
then shifts every residual block: beyond the paper, cheap, and learned much sooner by a small network than one token of attention.

The variant "w/ BG" concatenates the latent of the no-contact image to the noisy latent along channels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import torch
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from palpate.core import PalpateError, atomic_path
from palpate.encoders.half import Rounding, round_to_half
from palpate.encoders.weights import UNREADABLE, save_weights

Source = Literal["text", "vision"]
SOURCES: tuple[Source, ...] = ("text", "vision")


@dataclass(frozen=True)
class ConditionPolicy:
    """How an embedding becomes tokens.

    Attributes:
        width: d, length of the embeddings and of the tokens.
        tokens: k, how often the token is repeated.
        null: the unconditional token, ``zeros`` or ``learned``.
        gap: ``none``, or ``mean-shift`` (subtract the mean of the source's training embeddings).
        noise: standard deviation, in units of the token's typical entry, of Gaussian noise added in training.
        dropout: probability that training replaces the condition by the unconditional token.
        source: what training conditions on: ``text`` (the paper), ``vision`` (the GVST baseline), ``mixed`` (half each).
    """

    width: int
    tokens: int = 1
    null: Literal["zeros", "learned"] = "zeros"
    gap: Literal["none", "mean-shift"] = "none"
    noise: float = 0.0
    dropout: float = 0.1
    source: Literal["text", "vision", "mixed"] = "text"

    def __post_init__(self) -> None:
        if not 0 <= self.dropout < 1:
            raise PalpateError("Condition dropout must lie in [0, 1)", str(self.dropout), "Use 0.1")

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources that training needs."""
        return SOURCES if self.source == "mixed" else (self.source,)


@dataclass(frozen=True)
class UNetOptions:
    """Geometry of the U-Net.

    Attributes:
        widths: channels of each resolution level.
        attention: whether each level attends (to itself and to the condition); the middle block always does.
        layers: residual blocks a level.
        head_width: channels of an attention head.
        groups: of the group normalization.
        modulate: also add the (first) token to the time embedding; the paper has cross-attention alone.
    """

    widths: tuple[int, ...]
    attention: tuple[bool, ...]
    layers: int = 2
    head_width: int = 32
    groups: int = 32
    modulate: bool = False


def build_unet(
    options: UNetOptions, *, channels: int, size: int, width: int, background: bool
) -> UNet2DConditionModel:
    """An untrained U-Net for latents (channels, size, size) and tokens of ``width``; weights from torch's global generator.

    With ``background`` it takes twice the channels: noisy latent, then background latent.
    """
    if len(options.widths) != len(options.attention):
        raise PalpateError(
            "Every level of the U-Net needs a width and an attention flag",
            str(options),
            "Make both tuples equally long",
        )
    return UNet2DConditionModel(
        sample_size=size,
        in_channels=channels * (2 if background else 1),
        out_channels=channels,
        down_block_types=tuple(
            "CrossAttnDownBlock2D" if a else "DownBlock2D" for a in options.attention
        ),
        up_block_types=tuple(
            "CrossAttnUpBlock2D" if a else "UpBlock2D" for a in reversed(options.attention)
        ),
        block_out_channels=options.widths,
        layers_per_block=options.layers,
        cross_attention_dim=width,
        norm_num_groups=options.groups,
        class_embed_type="projection" if options.modulate else None,
        projection_class_embeddings_input_dim=width if options.modulate else None,
        # diffusers keeps the number of heads under this name.
        attention_head_dim=tuple(max(1, w // options.head_width) for w in options.widths),  # pyright: ignore[reportArgumentType]
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
        """With ``gap="mean-shift"``, ``means`` gives the training mean (d,) of each source that will be used."""
        super().__init__()
        self.unet, self.policy = unet, policy
        outputs, inputs = int(unet.config["out_channels"]), int(unet.config["in_channels"])
        if (
            inputs not in (outputs, 2 * outputs)
            or unet.config["cross_attention_dim"] != policy.width
        ):
            raise PalpateError(
                f"The U-Net must take {outputs} or {2 * outputs} channels and tokens of width {policy.width}",
                f"{inputs} channels and width {unet.config['cross_attention_dim']}",
                "Use the U-Net and palpate.json of one checkpoint",
            )
        self.background = inputs == 2 * outputs
        # A source without a mean is marked by NaN, and refused when it is used.
        fill = 0.0 if policy.gap == "none" else float("nan")
        rows = [
            means[s].float()
            if means is not None and s in means
            else torch.full((policy.width,), fill)
            for s in SOURCES
        ]
        self.register_buffer(
            "means",
            torch.stack(rows) if policy.gap != "none" else torch.zeros(len(SOURCES), policy.width),
        )
        self.null = (
            nn.Parameter(0.02 * torch.randn(policy.width)) if policy.null == "learned" else None
        )

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
        if conditions.ndim != 2 or conditions.shape[1] != self.policy.width:
            raise PalpateError(
                f"Conditions must be embeddings of shape (n, {self.policy.width})",
                str(tuple(conditions.shape)),
                "Use the pipeline's own encoders",
            )
        mean = self.means[SOURCES.index(source)]
        if not torch.isfinite(mean).all():
            raise PalpateError(
                f"gap='mean-shift' needs the training mean of {source} embeddings",
                "a checkpoint without it",
                f"Give training the {source} embeddings too",
            )
        token = (
            nn.functional.normalize(conditions.to(self.device, torch.float32) - mean, dim=1)
            * self.policy.width**0.5
        )
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
            background: normalized latents of the no-contact images (n, c, h, w).
        """
        if self.background:
            if background is None:
                raise PalpateError(
                    "This generator needs a background image per sample",
                    "none",
                    "Fill the manifest's column background",
                )
            x = torch.cat([x, background], dim=1)
        first = tokens[:, 0] if self.unet.config["class_embed_type"] == "projection" else None
        return cast(
            "Tensor",
            self.unet(x, t, encoder_hidden_states=tokens, class_labels=first, return_dict=False)[0],
        )

    def halve(self) -> Rounding:
        """Rounds the U-Net's weights to 16 bits, here and now; see :func:`palpate.encoders.half.round_to_half`."""
        return round_to_half({"unet": self.unet})

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Writes the U-Net in diffusers' format and ``condition.safetensors`` (means, learned token) beside it.

        With ``half``, :meth:`halve` first (this object too), and the U-Net's weights are 16-bit; the few others stay float32.
        """
        if half:
            self.halve()
        save_weights(self.unet, folder, half=half)
        extra = {"means": self.means.cpu().contiguous()} | (
            {} if self.null is None else {"null": self.null.detach().cpu().contiguous()}
        )
        with atomic_path(Path(folder) / "condition.safetensors") as part:
            save_file(extra, part)

    @classmethod
    def load(cls, folder: Path, policy: ConditionPolicy) -> Denoiser:
        """Reads what :meth:`save` wrote.

        Raises:
            PalpateError: if a file is missing, unreadable, incomplete, or of another policy.
        """
        try:
            unet = UNet2DConditionModel.from_pretrained(
                str(folder), low_cpu_mem_usage=False, use_safetensors=True, local_files_only=True
            )
            extra = load_file(Path(folder) / "condition.safetensors")
            model = cls(unet.float(), policy)
            wanted = {"means": model.means} | (
                {} if model.null is None else {"null": model.null.data}
            )
            for name, place in wanted.items():
                if (shape := tuple(extra[name].shape) if name in extra else None) != place.shape:
                    raise ValueError(
                        f"condition.safetensors has {name} of shape {shape}, not {tuple(place.shape)}"
                    )
                place.copy_(extra[name])
        except (*UNREADABLE, AttributeError) as error:
            got = (str(error).splitlines() or [type(error).__name__])[0]
            fix = "Copy the whole pipeline folder again"
            raise PalpateError(
                "The denoiser must be a folder written by palpate", f"{folder}: {got}", fix
            ) from None
        return model.eval().requires_grad_(requires_grad=False)
