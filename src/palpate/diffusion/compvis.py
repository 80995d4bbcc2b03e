"""VQ autoencoders in one file, by the names of latent diffusion (CompVis): ``vq-f4`` ...

=================================  ===============================================
in the file                        diffusers
=================================  ===============================================
``encoder.down.I.block.J``         ``encoder.down_blocks.I.resnets.J``
``encoder.down.I.downsample``      ``encoder.down_blocks.I.downsamplers.0``
``decoder.up.I`` (0 is the image)  ``decoder.up_blocks.(levels - 1 - I)``
``mid.block_1``, ``mid.attn_1``    ``mid_block.resnets.0``, ``mid_block.attentions.0``
``q, k, v, proj_out`` (1x1 convs)  ``to_q, to_k, to_v, to_out.0`` (linear)
``norm_out``, ``nin_shortcut``     ``conv_norm_out``, ``conv_shortcut``
=================================  ===============================================

``quant_conv``, ``post_quant_conv`` and ``quantize.embedding`` are the same. In a whole latent
diffusion checkpoint the names begin with ``first_stage_model.``, and all others
are left. So are ``loss.`` (discriminator and LPIPS) and ``model_ema.``.

The geometry is read off the shapes, the number of groups of all normalizations is 32, as in all of
these models. Every name must be there with its shape, and no other.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers.models.autoencoders.vq_model import VQModel
from torch import Tensor

from palpate.core import PalpateError, require
from palpate.encoders.models import read_weights

PREFIX = "first_stage_model."
LEFT = ("loss.", "model_ema.")
GROUPS = 32
FIX = "Pass a .ckpt or .safetensors file of latent diffusion, or the folder of a diffusers model"
FIX_PICKLE = (
    "Save its state_dict as .safetensors where you trust the file, or pass a diffusers folder"
)
#: Problems of one kind that an error lists.
SHOWN = 3
_NAMES = (
    (r"mid_block\.resnets\.0", "mid.block_1"),
    (r"mid_block\.resnets\.1", "mid.block_2"),
    (r"mid_block\.attentions\.0", "mid.attn_1"),
    (r"down_blocks", "down"),
    (r"up_blocks", "up"),
    (r"resnets", "block"),
    (r"attentions", "attn"),
    (r"(down|up)samplers\.0", r"\1sample"),
    (r"conv_norm_out", "norm_out"),
    (r"conv_shortcut", "nin_shortcut"),
    (r"group_norm", "norm"),
    (r"to_out\.0", "proj_out"),
    (r"to_([qkv])", r"\1"),
)


def read_compvis(path: Path) -> VQModel:
    """Read a VQ autoencoder of latent diffusion; weights are float32, without gradients.

    Raises:
        PalpateError: if the file is unreadable, holds more than weights, or not exactly one such
            autoencoder.
    """
    content = read_weights(path, FIX_PICKLE)
    inner = {k.removeprefix(PREFIX): v for k, v in content.items() if k.startswith(PREFIX)}
    state = {k: v for k, v in (inner or content).items() if not k.startswith(LEFT)}
    config = _geometry(path, state)
    with torch.device("meta"):
        model = VQModel(**config)
    levels = len(config["block_out_channels"])
    needed = {_name(k, levels): (k, tuple(v.shape)) for k, v in model.state_dict().items()}
    shapes = {name: _shape(name, value) for name, value in state.items()}
    _require_equal(path, {k: s for k, (_, s) in needed.items()}, shapes)
    weights = {
        ours: state[theirs].reshape(shape).to(torch.float32, copy=True)
        for theirs, (ours, shape) in needed.items()
    }
    model.load_state_dict(weights, assign=True)
    return model.eval().requires_grad_(False)


def _geometry(path: Path, state: Mapping[str, Tensor]) -> dict[str, Any]:
    """The options that make the model."""

    def size(name: str, axis: int) -> int:
        if name not in state or state[name].ndim <= axis:
            must = f"{path} must be a VQ autoencoder of latent diffusion"
            theirs = any(".down_blocks." in other for other in state)
            fix = "Pass the folder with its config.json" if theirs else FIX
            raise PalpateError(must, f"no weight {name}", fix)
        return state[name].shape[axis]

    def count(pattern: str) -> int:
        return len({m[1] for name in state if (m := re.match(pattern, name))})

    levels = max(1, count(r"encoder\.down\.(\d+)\."))
    widths = [size(f"encoder.down.{i}.block.0.conv1.weight", 0) for i in range(levels)]
    fits = not any(width % GROUPS for width in widths)
    must = f"{path} must have levels whose widths are multiples of {GROUPS}"
    require(fits, None, must, ", ".join(map(str, widths)), fix=FIX)
    attends = [f"encoder.down.{i}.attn.0.q.weight" in state for i in range(levels)]
    back = [f"decoder.up.{i}.attn.0.q.weight" in state for i in reversed(range(levels))]
    book = "quantize.embedding.weight"
    return {
        "in_channels": size("encoder.conv_in.weight", 1),
        "out_channels": size("decoder.conv_out.weight", 0),
        "down_block_types": tuple(f"{'Attn' * a}DownEncoderBlock2D" for a in attends),
        "up_block_types": tuple(f"{'Attn' * a}UpDecoderBlock2D" for a in back),
        "block_out_channels": tuple(widths),
        "layers_per_block": count(r"encoder\.down\.0\.block\.(\d+)\."),
        # What the decoder's first convolution reads are the latents, before `post_quant_conv`.
        "latent_channels": size("decoder.conv_in.weight", 1),
        "norm_num_groups": GROUPS,
        "mid_block_add_attention": any(".mid.attn_1." in name for name in state),
        "num_vq_embeddings": size(book, 0),
        "vq_embed_dim": size(book, 1),
    }


def _name(ours: str, levels: int) -> str:
    """The name in the file of a weight of diffusers."""
    ours = re.sub(r"up_blocks\.(\d+)", lambda m: f"up_blocks.{levels - 1 - int(m[1])}", ours)
    for pattern, theirs in _NAMES:
        ours = re.sub(pattern, theirs, ours)
    return ours


def _shape(name: str, value: Tensor) -> tuple[int, ...]:
    """Shape of a weight; that of the linear layer for the 1x1 convolutions of attention."""
    linear = re.search(r"\.attn(_1|\.\d+)\.(q|k|v|proj_out)\.weight$", name)
    square = value.ndim == 4 and value.shape[2:] == (1, 1)
    return tuple(value.shape[:2] if linear and square else value.shape)


def _require_equal(
    path: Path, needed: Mapping[str, tuple[int, ...]], shapes: Mapping[str, tuple[int, ...]]
) -> None:
    """Raise unless names and shapes agree."""
    both = [name for name in needed if name in shapes]
    kinds = {
        "missing": [name for name in needed if name not in shapes],
        "not part of it": [name for name in shapes if name not in needed],
        "of another shape": [
            f"{name} {shapes[name]} for {needed[name]}"
            for name in both
            if shapes[name] != needed[name]
        ],
    }
    problems = [
        f"{len(names)} {kind}: {', '.join(names[:SHOWN])}" for kind, names in kinds.items() if names
    ]
    must = f"{path} must hold the weights of one VQModel and no other"
    require(not problems, None, must, "; ".join(problems), fix=FIX)
