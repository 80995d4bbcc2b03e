"""Public tactile encoders, recognized by the names of their weights.

==========  ===================================  ==============================================
format      recognized by                        features
==========  ===================================  ==============================================
Sparsh      ``pos_embed.frequency_bands``        mean of the patch tokens after ``norm``
TVL         ``tactile_encoder.*``                ``head`` of the mean patch token after ``fc_norm``
AnyTouch 1  ``touch_mae_model.touch_model.*``    ``touch_projection`` of the class token
==========  ===================================  ==============================================

All are L2-normalized. A vision transformer of L blocks (width d, heads d / 64, LayerNorm before):

    x = patches W + positions, further tokens in front,
    x = x + s_1 * attention(norm_1(x)),  x = x + s_2 * mlp(norm_2(x)),  mlp with GELU,

with learned scales s in Sparsh, else 1. Sparsh's positions of a patch at (row, column) are sines
and cosines of row and column times ``frequency_bands``; TVL's are learned. AnyTouch is the CLIP
vision encoder of transformers with five learned tokens of the sensor behind the class token.

Weights are read as weights only; every name must be there with its shape, and no other. Names,
shapes and preprocessing are facts of the published files and their loaders; two public loaders of
one Sparsh file disagree in size and background, so that preprocessing is part of the digest here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, normalize, scaled_dot_product_attention

from palpate.core import PalpateError
from palpate.data.images import Preprocess
from palpate.encoders.gel import GEL
from palpate.encoders.models import read_weights
from palpate.encoders.rulers import HANDCRAFTED
from palpate.encoders.tactile_module import Format, State, TactileModule

NON_COMMERCIAL = "CC-BY-NC-4.0"
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
SPARSH = "the .safetensors file of facebook/sparsh-{mae,dino,dinov2,ijepa}-{small,base}"
KNOWN = f"{SPARSH}, tvl_enc_vit{{t,s,b}}.pth of TVL, or checkpoint.pth of AnyTouch 1"
#: Words in the names of sensors, in the order in which they are looked for -> AnyTouch's number.
SENSOR_NUMBERS = {"digit": 1, "gelslim": 2, "mini": 3, "duragel": 4, "gelsight": 0}
#: Width of a head of every vision transformer here.
HEAD_WIDTH = 64
#: Sides in pixels of the patches of Sparsh and TVL, and of AnyTouch.
PATCH, ANYTOUCH_PATCH = 16, 14


class Attention(nn.Module):
    """Multi-head self-attention with one matrix for queries, keys and values."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.heads = width // HEAD_WIDTH

    def forward(self, x: Tensor) -> Tensor:
        """(n, tokens, width) to the same."""
        q, k, v = self.qkv(x).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return self.proj(scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Two layers with GELU."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, hidden), nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        """(n, tokens, width) to the same."""
        return self.fc2(gelu(self.fc1(x)))


class LayerScale(nn.Module):
    """A learned factor per channel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        """(n, tokens, width) to the same."""
        return x * self.gamma


class Block(nn.Module):
    """One block of a vision transformer."""

    def __init__(self, width: int, *, scaled: bool) -> None:
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(width, eps=1e-6) for _ in range(2))
        self.attn, self.mlp = Attention(width), Mlp(width, 4 * width)
        self.ls1, self.ls2 = (LayerScale(width) if scaled else nn.Identity() for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        """(n, tokens, width) to the same."""
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class PatchEmbedding(nn.Module):
    """The image's patches as tokens."""

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(channels, width, PATCH, PATCH)

    def forward(self, x: Tensor) -> Tensor:
        """(n, channels, h, w) to (n, width, h', w')."""
        return self.proj(x)


class SinusoidalPositions(nn.Module):
    """Sparsh's positions: sines and cosines of row and column."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("frequency_bands", torch.empty(2, width // 4))

    def forward(self, rows: int, columns: int) -> Tensor:
        """(rows * columns, width)."""
        bands = self.get_buffer("frequency_bands")
        axes = [torch.arange(n, device=bands.device) for n in (rows, columns)]
        angles = torch.cartesian_prod(*axes)[:, :, None] * bands
        return torch.cat([angles.sin(), angles.cos()], dim=2).flatten(1)


def _blocks(state: State, width: int, *, scaled: bool) -> nn.ModuleList:
    numbers = {name.split(".")[1] for name in state if name.startswith("blocks.")}
    return nn.ModuleList(Block(width, scaled=scaled) for _ in numbers)


class Sparsh(TactileModule):
    """Sparsh's ViT of six channels: the image, and that of five frames before."""

    preprocess = Preprocess(
        240,
        240,
        (0.0,) * 3,
        (1.0,) * 3,
        resample=2,
        turn="portrait",
        height=320,
        subtract=("digit", "mini"),
        lag=5,
    )

    def __init__(self, state: State) -> None:
        super().__init__()
        self.dim = width = state["norm.weight"].shape[0]
        self.blocks, self.norm = _blocks(state, width, scaled=True), nn.LayerNorm(width, eps=1e-6)
        self.patch_embed = PatchEmbedding(width, 6)  # two frames
        self.pos_embed = SinusoidalPositions(width)
        if "register_tokens" in state:  # all but MAE
            self.register_tokens = nn.Parameter(torch.empty(1, 1, width))

    def forward(self, pixels: Tensor, sensors: Tensor | None = None) -> Tensor:
        """(n, 6, 320, 240) to (n, width)."""
        patches = self.patch_embed(pixels)
        x = patches.flatten(2).transpose(1, 2)
        x = x + self.pos_embed(*patches.shape[2:]).to(x.dtype)
        registers = getattr(self, "register_tokens", x[:1, :0])
        x = torch.cat([registers.expand(len(x), -1, -1), x], dim=1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, registers.shape[1] :].mean(dim=1)


class Tvl(TactileModule):
    """TVL's ViT with the mean patch token and a head into the space of its CLIP."""

    preprocess = Preprocess(
        224,
        224,
        (0.29174602, 0.29713256, 0.29104045),
        (0.18764469, 0.19467652, 0.21871583),
        fitting="pad",
        resample=2,
        turn="left",
    )

    def __init__(self, state: State) -> None:
        super().__init__()
        self.dim, width = state["head.weight"].shape
        side = math.isqrt(state["pos_embed"].shape[1] - 1)
        self.preprocess = replace(self.preprocess, size=side * PATCH, resize=side * PATCH)
        self.blocks = _blocks(state, width, scaled=False)
        self.fc_norm = nn.LayerNorm(width, eps=1e-6)
        self.patch_embed = PatchEmbedding(width, 3)
        self.cls_token = nn.Parameter(torch.empty(1, 1, width))
        self.pos_embed = nn.Parameter(torch.empty(1, side**2 + 1, width))
        self.head = nn.Linear(width, self.dim)

    def forward(self, pixels: Tensor, sensors: Tensor | None = None) -> Tensor:
        """(n, 3, 224, 224) to (n, dim)."""
        x = self.patch_embed(pixels).flatten(2).transpose(1, 2)
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), x], dim=1) + self.pos_embed
        for block in self.blocks:
            x = block(x)
        return self.head(self.fc_norm(x[:, 1:].mean(dim=1)))


class AnyTouch(TactileModule):
    """AnyTouch 1: a CLIP vision encoder with tokens of the sensor."""

    preprocess = Preprocess(224, 224, *IMAGENET, fitting="squash", resample=2)

    def __init__(self, state: State) -> None:
        from transformers import CLIPVisionConfig, CLIPVisionModel

        super().__init__()
        self.dim, width = state["touch_projection.weight"].shape
        layers = re.findall(r"encoder\.layers\.(\d+)\.", " ".join(state))
        tokens = state["touch_model.embeddings.position_embedding.weight"].shape[0]
        size = math.isqrt(tokens - 1) * ANYTOUCH_PATCH
        self.preprocess = replace(self.preprocess, size=size, resize=size)
        config = CLIPVisionConfig(
            hidden_size=width,
            intermediate_size=4 * width,
            num_hidden_layers=len(set(layers)),
            num_attention_heads=width // HEAD_WIDTH,
            image_size=size,
            patch_size=ANYTOUCH_PATCH,
            hidden_act="gelu",
            layer_norm_eps=1e-5,
        )
        model: Any = CLIPVisionModel(config)
        self.touch_model = getattr(model, "vision_model", model)  # a level less in transformers 5
        self.sensor_token = nn.Parameter(torch.empty(10, 5, width))  # sensors, tokens
        self.touch_projection = nn.Linear(width, self.dim, bias=False)

    def encode(self, pixels: Tensor, sensors: Sequence[str] | None = None) -> Tensor:
        """Prepared pixels (n, 3, h, w), and names of sensors, to (n, dim), L2-normalized."""
        names = [""] * len(pixels) if sensors is None else list(sensors)
        return normalize(self(pixels, sensor_numbers(names, pixels.device)), dim=-1)

    def forward(self, pixels: Tensor, sensors: Tensor | None = None) -> Tensor:
        """(n, 3, 224, 224) and the sensors' numbers (n,) to (n, dim)."""
        assert sensors is not None
        model: Any = self.touch_model
        x = model.embeddings(pixels)
        x = torch.cat([x[:, :1], self.sensor_token[sensors], x[:, 1:]], dim=1)
        x = model.encoder(inputs_embeds=model.pre_layrnorm(x)).last_hidden_state
        return self.touch_projection(model.post_layernorm(x[:, 0]))


FORMATS = (
    Format(
        "AnyTouch 1",
        "MIT",
        ("Touch and Go", "VisGel", "Cloth", "ObjectFolder", "HCT", "SSVTP", "YCB-Slide", "TacQuad"),
        "touch_mae_model.",
        "touch_model.embeddings.class_embedding",
        AnyTouch,
    ),
    Format(
        "TVL", NON_COMMERCIAL, ("HCT", "SSVTP"), "tactile_encoder.", "patch_embed.proj.weight", Tvl
    ),
    Format(
        "Sparsh",
        NON_COMMERCIAL,
        ("YCB-Slide", "Touch-Slide", "Touch and Go", "ObjectFolder"),
        "",
        "pos_embed.frequency_bands",
        Sparsh,
    ),
)
#: Parts of AnyTouch 1 under its prefix that pretrain the encoder and are no part of it.
PRETRAINING_PARTS = re.compile(r"(?!touch_model\.|sensor_token$|touch_projection\.)")


def load_tactile(path: Path) -> TactileModule:
    """Load a public tactile encoder.

    Args:
        path: a ``.safetensors`` file, or a torch file of weights.

    Raises:
        PalpateError: for a file that holds more than weights, of no known format, or whose weights
            lack a name, have one more, or another shape.
    """
    state = read_weights(path, f"Pass {KNOWN}")
    form = next((f for f in (GEL, HANDCRAFTED, *FORMATS) if f.prefix + f.signature in state), None)
    if form is None:
        must = f"{path} must be a tactile encoder that is recognized by the names of its weights"
        got = f"{len(state)} weights, first {', '.join(list(state)[:3]) or 'none'}"
        raise PalpateError(must, got, f"Pass {KNOWN}")
    state = {k.removeprefix(form.prefix): v for k, v in state.items() if k.startswith(form.prefix)}
    if form.name == "AnyTouch 1":
        state = {k: v for k, v in state.items() if not PRETRAINING_PARTS.match(k)}
    state = {k: v.float() for k, v in state.items() if not k.endswith("position_ids")}
    try:
        module = form.build(state)
        module.load_state_dict(state, assign=True)
    except Exception as error:  # of other shapes torch and transformers raise many kinds
        must, got = f"{path} must hold the weights of {form.name}", " ".join(str(error).split())
        fix = "Fetch the file again; weights are never filled in"
        raise PalpateError(must, f"other names or shapes: {got[:300]}", fix) from None
    module.format = form
    return module.eval().requires_grad_(False)


def sensor_numbers(names: list[str], device: torch.device) -> Tensor:
    """AnyTouch's numbers (n,) of sensors.

    Raises:
        PalpateError: for a name without one.
    """
    numbers = {
        n: next((v for word, v in SENSOR_NUMBERS.items() if word in n), None) for n in set(names)
    }
    if unknown := sorted(n for n, number in numbers.items() if number is None):
        must = f"AnyTouch must be given sensors whose names have one of {', '.join(SENSOR_NUMBERS)}"
        got = f"{unknown[0]!r} for {names.count(unknown[0])} of {len(names)} images"
        fix = "Fill the manifest's column sensor, or name one for all: checkpoint.pth#digit"
        raise PalpateError(must, got, fix)
    return torch.tensor([numbers[name] for name in names], device=device)
