"""Pixels as arrays (n, height, width, 3) of bytes, and as tensors (n, 3, height, width) in [-1, 1]; hashes of weights.

One pair of functions for the whole room, so that no two places disagree about range or axis order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from palpate.core import PalpateError


def to_unit(images: np.ndarray | Tensor) -> Tensor:
    """Bytes (n, h, w, 3) -> float32 (n, 3, h, w) in [-1, 1].

    Raises:
        PalpateError: for another shape or type.
    """
    tensor = (
        images
        if isinstance(images, Tensor)
        else torch.from_numpy(np.require(images, requirements=["C", "W"]))
    )
    if tensor.dtype != torch.uint8 or tensor.ndim != 4 or tensor.shape[3] != 3:
        raise PalpateError(
            "Images must be bytes of shape (n, height, width, 3)",
            f"{tensor.dtype} of shape {tuple(tensor.shape)}",
            "Decode them to RGB",
        )
    return tensor.permute(0, 3, 1, 2).to(torch.float32).div(127.5).sub(1.0)


def to_bytes(unit: Tensor) -> np.ndarray:
    """Floats (n, 3, h, w) -> uint8 array (n, h, w, 3); values outside [-1, 1] are clipped, halves go to even."""
    pixels = unit.detach().clamp(-1.0, 1.0).add(1.0).mul(127.5).round().to(torch.uint8)
    return pixels.permute(0, 2, 3, 1).cpu().numpy()


def digest_tensors(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and values, sorted by name; the same on every device."""
    state = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().contiguous()
        state.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        state.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return state.hexdigest()


#: The settings of a diffusers model that decide what it computes; others name files, versions, or what only other kinds of model read.
ARCHITECTURE = (
    "act_fn",
    "attention_head_dim",
    "block_out_channels",
    "class_embed_type",
    "cross_attention_dim",
    "down_block_types",
    "downsample_padding",
    "flip_sin_to_cos",
    "freq_shift",
    "in_channels",
    "latent_channels",
    "layers_per_block",
    "lookup_from_codebook",
    "mid_block_add_attention",
    "mid_block_scale_factor",
    "mid_block_type",
    "norm_eps",
    "norm_num_groups",
    "norm_type",
    "num_attention_heads",
    "num_vq_embeddings",
    "only_cross_attention",
    "out_channels",
    "resnet_time_scale_shift",
    "scaling_factor",
    "time_embedding_type",
    "timestep_post_act",
    "transformer_layers_per_block",
    "up_block_types",
    "use_linear_projection",
    "vq_embed_dim",
)


def architecture(config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a diffusers configuration that belongs into a digest; unset entries are left out, as versions differ in them."""
    return {name: config[name] for name in ARCHITECTURE if config.get(name) is not None}
