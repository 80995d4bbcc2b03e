"""U-Nets of diffusers: untrained ones by their geometry, and trained ones to go on from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel

from palpate.core import require
from palpate.diffusion.denoiser import slots_of
from palpate.diffusion.options import ConditionPolicy, UNetOptions
from palpate.encoders.models import find_single, is_hub_id, load_model

FIX_UNET = "Pass a folder or hub id, e.g. of Stable Diffusion 1.5"


def build_unet(
    options: UNetOptions, policy: ConditionPolicy, *, channels: int, size: int, background: int = 0
) -> UNet2DConditionModel:
    """Build an untrained U-Net for latents (channels, size, size) and the tokens of a policy.

    ``background`` channels of the no-contact image and of contacts follow those of the latent.
    """
    down = ["CrossAttnDownBlock2D" if a else "DownBlock2D" for a in options.attention]
    up = ["CrossAttnUpBlock2D" if a else "UpBlock2D" for a in reversed(options.attention)]
    # diffusers keeps the number of heads under this name.
    heads: Any = tuple(max(1, w // options.head_width) for w in options.widths)
    return UNet2DConditionModel(
        sample_size=size,
        in_channels=channels + background,
        out_channels=channels,
        down_block_types=tuple(down),
        up_block_types=tuple(up),
        block_out_channels=options.widths,
        layers_per_block=options.layers,
        cross_attention_dim=policy.width,
        norm_num_groups=options.groups,
        class_embed_type="projection" if options.modulate else None,
        projection_class_embeddings_input_dim=(
            max(1, slots_of(policy)) * policy.width if options.modulate else None
        ),
        attention_head_dim=heads,
    )


def find_unet(source: str | Path) -> tuple[str, str]:
    """Return what ``from_pretrained`` takes, and the subfolder of the U-Net.

    Args:
        source: a folder or hub id of a U-Net, or of a generator that has one as ``unet``.

    Raises:
        PalpateError: if there is none, or the hub is out of reach.
    """
    name, root = find_single(source, "generator", "U-Net", FIX_UNET, ("unet",))
    inside = "" if (root / "config.json").is_file() else "unet"
    there = (root / inside / "config.json").is_file()
    require(there, None, f"{source} must hold a U-Net of diffusers", "no config.json", fix=FIX_UNET)
    return name, inside


def load_unet(
    source: str | Path, policy: ConditionPolicy, *, channels: int, background: int = 0
) -> UNet2DConditionModel:
    """Load a trained U-Net to go on from.

    Raises:
        PalpateError: if it is none of diffusers, or made for other latents or tokens.
    """
    name, inside = find_unet(source)
    must = f"{source} must hold a UNet2DConditionModel of diffusers"
    unet = load_model(
        UNet2DConditionModel,
        name,
        must,
        FIX_UNET,
        strict=True,
        low_cpu_mem_usage=False,
        subfolder=inside or None,
        local_files_only=not is_hub_id(source),
    )
    config = unet.config
    must = f"must have {config['out_channels']} latent channels, as the U-Net"
    require(channels == config["out_channels"], "autoencoder", must, channels)
    must = f"must give embeddings of width {config['cross_attention_dim']}, as the U-Net knows"
    require(policy.width == config["cross_attention_dim"], "clip", must, policy.width)
    plain = config["class_embed_type"] is None and config["in_channels"] == channels + background
    require(plain, "unet", "must see latents and tokens alone", str(source))
    return unet.requires_grad_(True)
