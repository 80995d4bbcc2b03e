"""Vision and text by one model of transformers: CLIP, SigLIP or SigLIP 2; a DINO sees alone.

Features of CLIP are *projected* (``visual_projection``, ``text_projection``), and all features are
L2-normalized. States before the projection share no space; :func:`vision_patches` returns them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, normalize

from palpate.core import digest_json
from palpate.encoders.models import architecture, digest_modules
from palpate.encoders.preprocess import Preprocess

#: Kinds of transformers' models that see, and whether they read, too.
FAMILIES = {
    "clip": True,
    "siglip": True,
    "siglip2": True,
    "dinov2": False,
    "dinov2_with_registers": False,
    "dinov3_vit": False,
}


def family_of(model: Any) -> str:
    """The model's kind in transformers, a key of :data:`FAMILIES`."""
    return str(model.config.model_type)


def width_of(model: Any) -> int:
    """Width of the features."""
    if family_of(model) == "clip":
        return int(model.config.projection_dim)
    return int(getattr(model.config, "vision_config", model.config).hidden_size)


def context_of(model: Any) -> int:
    """The most tokens of a text that the model takes, marks of its ends included."""
    return int(model.config.text_config.max_position_embeddings)


def tokens(model: Any, tokenizer: Any, texts: Sequence[str]) -> dict[str, Tensor]:
    """``input_ids`` and ``attention_mask`` (n, length), cut to the model's context.

    SigLIP was trained on lower case, and on padding without a mask.
    """
    masked = family_of(model) == "clip"
    encoded = tokenizer(
        [text if masked else text.lower() for text in texts],
        return_tensors="pt",
        truncation=True,
        max_length=context_of(model),
        padding=True if masked else "max_length",
    )
    names = ("input_ids", "attention_mask") if masked else ("input_ids",)
    return {name: encoded[name].to(model.device) for name in names}


def encode_text(model: Any, tokenizer: Any, texts: Sequence[str]) -> Tensor:
    """Texts to (n, dim), L2-normalized; differentiable."""
    features = model.get_text_features(**tokens(model, tokenizer, texts))
    return normalize(_projected(features), dim=-1)


def encode_vision(model: Any, pixels: Tensor) -> Tensor:
    """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalized; differentiable."""
    if not hasattr(model, "get_image_features"):  # a DINO: its class token
        return normalize(model(pixel_values=pixels).pooler_output, dim=-1)
    return normalize(_projected(model.get_image_features(**_inputs(model, pixels))), dim=-1)


def vision_patches(model: Any, pixels: Tensor, count: int) -> Tensor:
    """States of a photo's patches in the last layer, before the projection.

    Args:
        model: of the vision encoder.
        pixels: preprocessed (n, 3, size, size).
        count: a square number; the patches are averaged to so many.

    Returns:
        (n, count, width); what others put before the patches (CLS) is left out.
    """
    vision: Any = getattr(model, "vision_model", model)
    output = vision(**_inputs(model, pixels))
    grid = pixels.shape[2] // int(vision.config.patch_size)
    states = output.last_hidden_state[:, -(grid**2) :].transpose(1, 2)
    states = states.unflatten(2, (grid, grid))
    return adaptive_avg_pool2d(states, math.isqrt(count)).flatten(2).transpose(1, 2)


def digest_vision(model: Any, preprocess: Preprocess) -> str:
    """SHA-256 of the vision encoder: architecture, preprocessing, weights."""
    config = getattr(model.config, "vision_config", model.config)
    facts = {"family": family_of(model), "preprocess": asdict(preprocess), **architecture(config)}
    parts = {"encoder": getattr(model, "vision_model", model)}
    if family_of(model) == "clip":
        parts["projection"] = model.visual_projection
    return digest_modules(parts, facts)


def digest_text(model: Any, tokenizer: Any) -> str:
    """SHA-256 of the text encoder: architecture, tokenizer, weights."""
    facts = {"family": family_of(model), "tokenizer": _tokenizer_digest(tokenizer)}
    parts = {"encoder": model.text_model}
    if family_of(model) == "clip":
        parts["projection"] = model.text_projection
    return digest_modules(parts, facts | architecture(model.config.text_config))


def _tokenizer_digest(tokenizer: Any) -> str:
    """SHA-256 of all that a tokenizer does to a text."""
    backend = getattr(tokenizer, "backend_tokenizer", None)
    if backend is None:  # a slow tokenizer of transformers 4
        return digest_json(tokenizer.get_vocab())
    # Truncation and padding are state of the last call, not of the tokenizer.
    table = json.loads(backend.to_str())
    return digest_json({k: v for k, v in table.items() if k not in ("truncation", "padding")})


def _inputs(model: Any, pixels: Tensor) -> dict[str, Tensor]:
    """Pixels (n, 3, side, side) as the model takes them; SigLIP 2 takes rows of patches."""
    if family_of(model) != "siglip2":
        return {"pixel_values": pixels}
    patch = int(model.config.vision_config.patch_size)
    n, side = len(pixels), pixels.shape[2] // patch
    cells = pixels.unflatten(3, (side, patch)).unflatten(2, (side, patch))
    rows = cells.permute(0, 2, 4, 3, 5, 1).reshape(n, side * side, -1)
    return {
        "pixel_values": rows,
        "pixel_attention_mask": torch.ones(rows.shape[:2], dtype=torch.int32, device=pixels.device),
        "spatial_shapes": torch.full((n, 2), side, device=pixels.device),
    }


def _projected(output: Any) -> Tensor:
    """The projected features: a tensor in transformers 4, the field ``pooler_output`` in 5."""
    return output if isinstance(output, Tensor) else output.pooler_output
