"""CLIP in plain torch: reads and writes the folders of transformers' ``CLIPModel``.

transformers takes twice as long to import as torch. Names of weights and settings are its own, and
so are the numbers: a layer is ``x + attention(norm x)``, then ``x + fc2 act(fc1 norm x)``; a text's
features are those of its first end token, which sees all before it, an image's those of the class.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from tokenizers import Tokenizer
from torch import Tensor, nn
from torch.nn.functional import gelu, scaled_dot_product_attention


class _Read:
    """Draws no weights: these are read. On torch's device ``meta`` draws import its compiler."""

    def reset_parameters(self) -> None:
        """Do nothing."""


class Linear(_Read, nn.Linear):
    """Without first weights."""


class Embedding(_Read, nn.Embedding):
    """Without first weights."""


class Conv2d(_Read, nn.Conv2d):
    """Without first weights."""


class LayerNorm(_Read, nn.LayerNorm):
    """Without first weights."""


def _linear(names: Sequence[str], *widths: int) -> nn.ModuleDict:
    pairs = zip(names, widths, widths[1:], strict=False)
    return nn.ModuleDict({name: Linear(a, b) for name, a, b in pairs})


class Layer(nn.Module):
    """One layer of a tower."""

    def __init__(self, config: Any) -> None:
        super().__init__()
        width = config.hidden_size
        self.self_attn = _linear(("q_proj", "k_proj", "v_proj", "out_proj"), *[width] * 5)
        self.mlp = _linear(("fc1", "fc2"), width, config.intermediate_size, width)
        self.layer_norm1, self.layer_norm2 = (_norm(config) for _ in range(2))
        self.heads, self.act = config.num_attention_heads, ACTIVATIONS[config.hidden_act]

    def forward(self, x: Tensor, causal: bool) -> Tensor:
        """(n, tokens, width) to the same."""
        *qkv, out = self.self_attn.values()
        y = self.layer_norm1(x)
        q, k, v = (f(y).unflatten(2, (self.heads, -1)).transpose(1, 2) for f in qkv)
        y = scaled_dot_product_attention(q, k, v, is_causal=causal)
        x = x + out(y.transpose(1, 2).flatten(2))
        first, second = self.mlp.values()
        return x + second(self.act(first(self.layer_norm2(x))))


class Tower(nn.Module):
    """One of the two encoders."""

    def __init__(self, config: Any, tokens: int) -> None:
        super().__init__()
        self.config, self.embeddings = config, nn.Module()
        self.embeddings.position_embedding = Embedding(tokens, config.hidden_size)
        layers = nn.ModuleList(Layer(config) for _ in range(config.num_hidden_layers))
        self.encoder = nn.ModuleDict({"layers": layers})

    def encode(self, x: Tensor, *, causal: bool) -> Tensor:
        """Embedded tokens to their last states, (n, tokens, width)."""
        for layer in self.encoder["layers"].children():
            x = layer(x, causal)
        return x


class Text(Tower):
    """Token ids (n, length) to states of the end token (n, width)."""

    def __init__(self, config: Any) -> None:
        super().__init__(config, config.max_position_embeddings)
        self.embeddings.token_embedding = Embedding(config.vocab_size, config.hidden_size)
        self.final_layer_norm = _norm(config)

    def forward(self, ids: Tensor) -> Tensor:
        """What pads the end of a text is not seen from its end token."""
        parts: Any = self.embeddings
        x = parts.token_embedding(ids) + parts.position_embedding.weight[: ids.shape[1]]
        end = self.config.eos_token_id  # 2 is written where it is the largest id
        last = (ids if end == 2 else (ids == end).int()).argmax(1)
        states = self.final_layer_norm(self.encode(x, causal=True))
        return states[torch.arange(len(ids), device=ids.device), last]


class Vision(Tower):
    """Prepared pixels (n, 3, side, side) to states."""

    def __init__(self, config: Any) -> None:
        patch, width = config.patch_size, config.hidden_size
        super().__init__(config, (config.image_size // patch) ** 2 + 1)
        self.embeddings.class_embedding = nn.Parameter(torch.empty(width))
        self.embeddings.patch_embedding = Conv2d(
            config.num_channels, width, patch, patch, bias=False
        )
        self.pre_layrnorm, self.post_layernorm = (_norm(config) for _ in range(2))

    def forward(self, pixel_values: Tensor) -> SimpleNamespace:
        """``last_hidden_state`` (n, 1 + patches, width), and ``pooler_output`` (n, width)."""
        parts: Any = self.embeddings
        x = parts.patch_embedding(pixel_values).flatten(2).transpose(1, 2)
        first = parts.class_embedding.expand(len(x), 1, -1)
        x = torch.cat([first, x], dim=1) + parts.position_embedding.weight
        x = self.encode(self.pre_layrnorm(x), causal=False)
        return SimpleNamespace(last_hidden_state=x, pooler_output=self.post_layernorm(x[:, 0]))


class Clip(nn.Module):
    """Both towers and their projections."""

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__()
        self.settings = settings
        self.config = json.loads(json.dumps(settings), object_hook=lambda d: SimpleNamespace(**d))
        self.text_model = Text(self.config.text_config)
        self.vision_model = Vision(self.config.vision_config)
        self.text_projection, self.visual_projection = (
            Linear(tower.config.hidden_size, self.config.projection_dim, bias=False)
            for tower in (self.text_model, self.vision_model)
        )
        self.logit_scale = nn.Parameter(torch.empty(()))

    @property
    def device(self) -> torch.device:
        """Where it is."""
        return self.logit_scale.device

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights."""
        return self.logit_scale.dtype

    def get_text_features(self, input_ids: Tensor, **_: Any) -> Tensor:
        """Token ids (n, length), padded behind the end token, to (n, dim)."""
        return self.text_projection(self.text_model(input_ids))

    def get_image_features(self, pixel_values: Tensor) -> Tensor:
        """Prepared pixels (n, 3, side, side) to (n, dim)."""
        return self.visual_projection(self.vision_model(pixel_values).pooler_output)

    @classmethod
    def from_pretrained(cls, folder: str, **_: Any) -> tuple[Clip, dict[str, list[str]]]:
        """The model, and the names of missing and unexpected weights, as of transformers."""
        settings = json.loads((Path(folder) / "config.json").read_text(encoding="utf-8"))
        with torch.device("meta"):
            clip = cls(settings)
        state = load_file(Path(folder) / "model.safetensors")
        missing, extra = clip.load_state_dict(state, strict=False, assign=True)
        return clip, {"missing_keys": missing, "unexpected_keys": extra}

    def save_pretrained(self, folder: Path) -> None:
        """Write ``config.json`` and ``model.safetensors``."""
        folder.mkdir(parents=True, exist_ok=True)
        settings = json.dumps(self.settings, indent=2, sort_keys=True) + "\n"
        (folder / "config.json").write_text(settings, encoding="utf-8")
        save_file(self.state_dict(), folder / "model.safetensors", {"format": "pt"})


class ClipTokenizer:
    """The tokenizer of such a folder."""

    def __init__(self, backend: Tokenizer, settings: dict[str, Any]) -> None:
        self.backend_tokenizer, self.settings = backend, settings

    @classmethod
    def from_pretrained(cls, folder: str, **_: Any) -> ClipTokenizer:
        """Read ``tokenizer.json`` and ``tokenizer_config.json``."""
        settings = (Path(folder) / "tokenizer_config.json").read_text(encoding="utf-8")
        return cls(Tokenizer.from_file(f"{folder}/tokenizer.json"), json.loads(settings))

    def __call__(
        self, texts: str | Sequence[str], *, max_length: int = 0, **_: Any
    ) -> dict[str, Any]:
        """``input_ids`` of one text; of several, cut and padded, with their ``attention_mask``."""
        backend, pad = self.backend_tokenizer, self.settings["pad_token"]
        if isinstance(texts, str):
            backend.no_truncation()
            return {"input_ids": backend.encode(texts).ids}
        backend.enable_truncation(max_length)
        backend.enable_padding(pad_id=backend.token_to_id(pad), pad_token=pad)
        rows = backend.encode_batch(list(texts))
        return {
            "input_ids": torch.tensor([r.ids for r in rows]),
            "attention_mask": torch.tensor([r.attention_mask for r in rows]),
        }

    def __len__(self) -> int:
        """Number of tokens."""
        return self.backend_tokenizer.get_vocab_size()

    def save_pretrained(self, folder: Path) -> None:
        """Write what was read."""
        self.backend_tokenizer.save(str(folder / "tokenizer.json"))
        settings = json.dumps(self.settings)
        (folder / "tokenizer_config.json").write_text(settings, encoding="utf-8")


def _norm(config: Any) -> LayerNorm:
    return LayerNorm(config.hidden_size, eps=config.layer_norm_eps)


def _quick_gelu(x: Tensor) -> Tensor:
    return x * torch.sigmoid(1.702 * x)


ACTIVATIONS = {"quick_gelu": _quick_gelu, "gelu": gelu}
