"""Models of transformers and diffusers on disk: read whole or refused, written without noise, named by a digest of what they compute."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from torch import nn
from transformers.utils import logging as hf_logging

from palpate.core import digest_json
from palpate.core.digest import canonical_json
from palpate.encoders.half import half_copy

#: What transformers and huggingface_hub raise for an unreachable hub, absent files, foreign formats and pickled objects.
UNREADABLE = (
    OSError,
    ValueError,
    RuntimeError,
    KeyError,
    TypeError,
    SafetensorError,
    pickle.UnpicklingError,
)
#: The part of a configuration that decides what a encoder computes; the rest varies between versions of transformers.
ARCHITECTURE = (
    "hidden_size",
    "intermediate_size",
    "num_hidden_layers",
    "num_attention_heads",
    "image_size",
    "patch_size",
    "num_channels",
    "vocab_size",
    "max_position_embeddings",
    "eos_token_id",
    "projection_dim",
    "hidden_act",
    "layer_norm_eps",
)


def save_weights(model: Any, folder: Path, *, half: bool) -> None:
    """A model's ``save_pretrained``, of a 16-bit copy if asked for; the weights must have been rounded before.

    Two entries of ``config.json`` would make equal models differ: where the model was loaded from, a path on the machine that wrote
    it, is left out; and ``dtype``, which the parts of a CLIP have only from the file that they were loaded from, is that of the weights
    in this file in every part.
    """
    with silent():
        (half_copy(model) if half else model).save_pretrained(folder)
    place = Path(folder) / "config.json"
    config = json.loads(place.read_text(encoding="utf-8"))
    before = json.dumps(config)
    config.pop("_name_or_path", None)
    if "dtype" in config:  # diffusers has none
        for part in (
            config,
            *(v for k, v in config.items() if k.endswith("_config") and isinstance(v, dict)),
        ):
            part["dtype"] = "float16" if half else str(model.dtype).removeprefix("torch.")
    if json.dumps(config) != before:
        place.write_text(json.dumps(config, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def load_weights(kind: Any, name: str, **how: bool) -> Any:
    """``kind.from_pretrained``, refusing what transformers only warns about: weights that the file lacks are drawn at random."""
    model, report = kind.from_pretrained(name, output_loading_info=True, **how)
    if lacking := sorted(report["missing_keys"]):
        raise ValueError(f"{len(lacking)} weights are missing, first {lacking[0]}")
    return model


def architecture(config: Any) -> dict[str, Any]:
    """The fields of a configuration that :data:`ARCHITECTURE` names, as far as it has them."""
    return {name: getattr(config, name) for name in ARCHITECTURE if hasattr(config, name)}


def tokenizer_digest(tokenizer: Any) -> str:
    """SHA-256 of all that a tokenizer does to a text."""
    backend = getattr(tokenizer, "backend_tokenizer", None)
    if backend is None:  # a slow tokenizer of transformers 4
        return digest_json(tokenizer.get_vocab())
    # Truncation and padding are state of the last call, not of the tokenizer.
    table = json.loads(backend.to_str())
    return digest_json({k: v for k, v in table.items() if k not in ("truncation", "padding")})


def digest_modules(parts: Mapping[str, nn.Module], facts: Mapping[str, Any]) -> str:
    """SHA-256 over facts (JSON) and the names, types, shapes and values of all weights; the same on every device."""
    state = hashlib.sha256(canonical_json(dict(facts)).encode())
    for part, module in sorted(parts.items()):
        for name, value in sorted(module.state_dict().items()):
            array: np.ndarray = value.detach().cpu().contiguous().numpy()
            state.update(f"{part}.{name} {array.dtype} {array.shape}\n".encode())
            state.update(array.tobytes())
    return state.hexdigest()


@contextmanager
def silent() -> Generator[None]:
    """No load reports or progress bars of transformers inside; its settings are restored."""
    level, bars = hf_logging.get_verbosity(), hf_logging.is_progress_bar_enabled()
    hf_logging.set_verbosity_error()
    hf_logging.disable_progress_bar()
    try:
        yield
    finally:
        hf_logging.set_verbosity(level)
        if bars:
            hf_logging.enable_progress_bar()
