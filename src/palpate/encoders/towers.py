"""The three towers: frozen CLIP vision and text, and a touch tower of the same kind with random initial weights (paper section 3).

Every tower maps into one space: features are *projected* (``visual_projection``, ``text_projection``) and L2-normalised. States
before the projection live in no common space, so nothing here returns them.

A saved set is a folder::

    palpate.json        the card: preset, training and split digests, seeds, steps, versions, loss curve, digests of the towers
    clip/               transformers' CLIPModel: config.json, model.safetensors, tokenizer files, preprocessor_config.json
    touch/              transformers' CLIPVisionModelWithProjection: config.json, model.safetensors, preprocessor_config.json

The digest of a tower is SHA-256 over the architecture, the preprocessing (for text: the tokenizer) and every weight.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from torch import Tensor, nn
from transformers import AutoTokenizer, CLIPModel, CLIPVisionConfig, CLIPVisionModelWithProjection
from transformers.utils import logging as hf_logging
from transformers.utils.hub import cached_file

from palpate.core import PalpateError, atomic_folder, digest_json, read_json, seed_for, write_json
from palpate.core.digest import canonical_json
from palpate.encoders.preprocess import Preprocess
from palpate.encoders.tokenizer import save_tokenizer

TowerName = Literal["vision", "text", "touch"]
TOWERS: tuple[TowerName, ...] = get_args(TowerName)
FORMAT = "palpate-towers/1"
#: What a local CLIP folder must hold, as alternatives.
CLIP_FILES = {
    "config.json": ("config.json",),
    "model.safetensors": ("model.safetensors", "model.safetensors.index.json", "pytorch_model.bin", "pytorch_model.bin.index.json"),
    "tokenizer.json (or vocab.json and merges.txt)": ("tokenizer.json", "vocab.json"),
    "preprocessor_config.json": ("preprocessor_config.json",),
}
#: What transformers and huggingface_hub raise for an unreachable hub, absent files, foreign formats and pickled objects.
UNREADABLE = (OSError, ValueError, RuntimeError, KeyError, TypeError, SafetensorError, pickle.UnpicklingError)
#: The part of a configuration that decides what a tower computes; the rest varies between versions of transformers.
ARCHITECTURE = (
    "hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads", "image_size", "patch_size", "num_channels",
    "vocab_size", "max_position_embeddings", "eos_token_id", "projection_dim", "hidden_act", "layer_norm_eps",
)  # fmt: skip


@dataclass
class FrozenClip:
    """A CLIP whose vision and text towers are used as they are.

    Attributes:
        model: in evaluation mode; its parameters do not require gradients.
        tokenizer: a transformers tokenizer that ends every text with the end token.
        preprocess: the evaluation transform of the vision tower.
        name: hub id or folder it came from, or the preset that made it.
        card: how it was trained, if it was trained here.
    """

    model: CLIPModel
    tokenizer: Any
    preprocess: Preprocess
    name: str
    card: dict[str, Any] = field(default_factory=dict)

    @property
    def dim(self) -> int:
        """Width of the common space."""
        return int(_config(self.model).projection_dim)

    def tokens(self, texts: Sequence[str]) -> dict[str, Tensor]:
        """``input_ids`` and ``attention_mask`` (n, length), cut to the tower's context."""
        context = int(_config(self.model).text_config.max_position_embeddings)
        encoded = self.tokenizer(list(texts), padding=True, truncation=True, max_length=context, return_tensors="pt")
        return {name: encoded[name].to(self.model.device) for name in ("input_ids", "attention_mask")}

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Texts to (n, dim), L2-normalised; differentiable."""
        tokens: dict[str, Any] = {**self.tokens(texts)}
        return F.normalize(_projected(self.model.get_text_features(**tokens)), dim=-1)

    def encode_vision(self, pixels: Tensor) -> Tensor:
        """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalised; differentiable."""
        return F.normalize(_projected(self.model.get_image_features(pixel_values=pixels)), dim=-1)

    def digest(self, tower: TowerName) -> str:
        """SHA-256 of the vision or the text tower."""
        if tower == "vision":
            parts = {"tower": self.model.vision_model, "projection": self.model.visual_projection}
            facts = {"preprocess": asdict(self.preprocess), **_architecture(_config(self.model).vision_config)}
        else:
            parts = {"tower": self.model.text_model, "projection": self.model.text_projection}
            facts = {"tokenizer": _tokenizer_digest(self.tokenizer), **_architecture(_config(self.model).text_config)}
        return _digest(parts, facts)

    def save(self, folder: Path) -> None:
        """Writes the standard CLIP folder, which ``CLIPModel.from_pretrained`` reads; whole or not at all.

        Raises:
            PalpateError: if the folder exists and is not empty.
        """
        with atomic_folder(Path(folder)) as part:
            self._write(part)

    def _write(self, folder: Path) -> None:
        with _silent():
            self.model.save_pretrained(folder)
            save_tokenizer(self.tokenizer, folder)
        write_json(folder / "preprocessor_config.json", self.preprocess.to_config())
        write_json(folder / "palpate.json", {"format": "palpate-clip/1", "name": self.name, "card": self.card})


def load_clip(name_or_folder: str | Path, *, device: str = "cpu") -> FrozenClip:
    """A frozen CLIP from a local folder or from the hub; a local folder needs no network.

    Args:
        name_or_folder: a folder as :meth:`FrozenClip.save` or transformers writes it, or a hub id (``openai/clip-vit-large-patch14``).
            safetensors is preferred; a ``.bin`` is read as weights only.
        device: see :func:`pick_device`.

    Raises:
        PalpateError: if files are missing, unreadable or of another model, or the hub cannot be reached.
    """
    name, folder = str(name_or_folder), Path(name_or_folder)
    local = folder.is_dir()
    if local:
        missing = [what for what, choices in CLIP_FILES.items() if not any((folder / c).is_file() for c in choices)]
        if missing:
            raise PalpateError(
                f"The CLIP folder {folder} must hold {', '.join(CLIP_FILES)}", f"no {', no '.join(missing)}", "Add the files"
            )
    try:
        with _silent():
            model = _whole(CLIPModel, name, local_files_only=local)
            tokenizer = AutoTokenizer.from_pretrained(name, local_files_only=local)
            processor = cached_file(name, "preprocessor_config.json", local_files_only=local)
    except UNREADABLE as error:
        must = f"{name} must be a CLIP model" if local else f"The CLIP {name} must be a local folder, or a hub id within reach"
        fix = f"Pass a folder that holds {', '.join(CLIP_FILES)}"
        raise PalpateError(must, (str(error).splitlines() or [type(error).__name__])[0], fix) from None
    config = read_json(Path(str(processor)), "image processor")
    preprocess = Preprocess.from_config(config, int(_config(model).vision_config.image_size))
    card = read_json(folder / "palpate.json", "CLIP card") if local and (folder / "palpate.json").is_file() else {}
    clip = FrozenClip(model.float().eval().requires_grad_(False), tokenizer, preprocess, card.get("name", name), card.get("card", {}))
    move(clip.model, pick_device(device))
    return clip


def new_touch(config: CLIPVisionConfig, seed: int) -> CLIPVisionModelWithProjection:
    """A touch tower with random weights that depend on ``seed`` alone; global random state is left as it was."""
    with seeded(seed, "touch tower"):
        return CLIPVisionModelWithProjection(config)


@dataclass
class Towers:
    """Vision, text and, once trained, touch.

    Attributes:
        clip: the frozen vision and text towers.
        touch: the touch tower, or None.
        touch_preprocess: its evaluation transform, or None.
        card: see the head of this file; ``{}`` for towers that were not trained here.
    """

    clip: FrozenClip
    touch: CLIPVisionModelWithProjection | None = None
    touch_preprocess: Preprocess | None = None
    card: dict[str, Any] = field(default_factory=dict)

    @property
    def dim(self) -> int:
        """Width of the common space."""
        return self.clip.dim

    @property
    def device(self) -> torch.device:
        """Where the towers are."""
        return self.clip.model.device

    def to(self, device: str) -> Towers:
        """Moves all towers; returns self."""
        for model in (self.clip.model, self.touch):
            if model is not None:
                move(model, pick_device(device))
        return self

    def preprocess(self, tower: str) -> Preprocess:
        """The evaluation transform of ``vision`` or ``touch``.

        Raises:
            PalpateError: for another name, or if there is no touch tower.
        """
        if tower == "vision":
            return self.clip.preprocess
        return self._touch(tower)[1]

    def encode(self, tower: str, batch: Tensor | Sequence[str]) -> Tensor:
        """One batch to (n, dim), projected and L2-normalised.

        Args:
            tower: ``vision``, ``text`` or ``touch``.
            batch: preprocessed pixels (n, 3, size, size) on the towers' device, or texts.
        """
        if tower == "text":
            return self.clip.encode_text([str(text) for text in batch])
        pixels = torch.as_tensor(batch)
        return self.clip.encode_vision(pixels) if tower == "vision" else encode_touch(self._touch(tower)[0], pixels)

    def digest(self, tower: str) -> str:
        """SHA-256 of one tower: weights, architecture, preprocessing."""
        if tower == "vision" or tower == "text":
            return self.clip.digest(tower)
        touch, preprocess = self._touch(tower)
        return _digest({"touch": touch}, {"preprocess": asdict(preprocess), **_architecture(touch.config)})

    def save(self, folder: Path) -> None:
        """Writes the folder described at the head of this file; whole or not at all.

        Raises:
            PalpateError: if the folder exists and is not empty.
        """
        with atomic_folder(Path(folder)) as part:
            (part / "clip").mkdir()
            self.clip._write(part / "clip")  # pyright: ignore[reportPrivateUsage]
            if self.touch is not None and self.touch_preprocess is not None:
                with _silent():
                    self.touch.save_pretrained(part / "touch")
                write_json(part / "touch" / "preprocessor_config.json", self.touch_preprocess.to_config())
            names = [t for t in TOWERS if t != "touch" or self.touch is not None]
            write_json(part / "palpate.json", {"format": FORMAT, "digests": {t: self.digest(t) for t in names}, "card": self.card})

    @classmethod
    def load(cls, folder: Path, *, device: str = "cpu") -> Towers:
        """Reads what :meth:`save` wrote and checks every tower against its digest.

        Raises:
            PalpateError: if the folder is of another kind, incomplete, or changed since.
        """
        folder = Path(folder)
        card = read_json(folder / "palpate.json", "card of the towers")
        if not isinstance(card, Mapping) or card.get("format") != FORMAT:
            raise PalpateError(f"{folder} must hold towers ({FORMAT})", "another kind of folder", "Train with: palpate encoder")
        towers = cls(load_clip(folder / "clip"), card=dict(card["card"]))
        if "touch" in card["digests"]:
            towers.touch = _load_touch(folder / "touch")
            config = read_json(folder / "touch" / "preprocessor_config.json", "touch preprocessing")
            towers.touch_preprocess = Preprocess.from_config(config, int(_config(towers.touch).image_size))
        for name, digest in card["digests"].items():
            if towers.digest(name) != digest:
                raise PalpateError(
                    f"The {name} tower in {folder} must match its digest", "weights or settings that were changed", "Save the towers again"
                )
        return towers.to(device)

    def _touch(self, tower: str) -> tuple[CLIPVisionModelWithProjection, Preprocess]:
        if tower == "text":
            raise PalpateError("A tower of images must be vision or touch", repr(tower), "Pass texts to the text tower")
        if tower != "touch":
            raise PalpateError(f"A tower must be one of {', '.join(TOWERS)}", repr(tower), "Choose one of these")
        if self.touch is None or self.touch_preprocess is None:
            raise PalpateError("These towers must include a touch tower", "vision and text only", "Train one with: palpate encoder")
        return self.touch, self.touch_preprocess


def encode_touch(touch: nn.Module, pixels: Tensor) -> Tensor:
    """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalised; differentiable."""
    return F.normalize(touch(pixel_values=pixels).image_embeds, dim=-1)


def pick_device(device: str) -> torch.device:
    """``auto`` is CUDA, else Apple's MPS, else the CPU; any other name is torch's.

    Raises:
        PalpateError: for a name that torch does not know or a device that is not there.
    """
    if device == "auto":
        mps = torch.backends.mps.is_available()
        device = "cuda" if torch.cuda.is_available() else "mps" if mps else "cpu"
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise PalpateError("--device must be auto, cpu, or a device that is there", repr(device), str(error).splitlines()[0]) from None
    return torch.device(device)


@contextmanager
def seeded(seed: int, purpose: str) -> Generator[None]:
    """CPU randomness of torch seeded by (seed, purpose) inside, and as it was before outside: for random initial weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(seed, purpose))
        yield


def move(module: nn.Module, device: torch.device) -> None:
    """Moves a module in place."""
    module.to(device)


def _config(model: nn.Module) -> Any:
    """The model's configuration, whose fields transformers types too loosely."""
    return model.config


def _load_touch(folder: Path) -> CLIPVisionModelWithProjection:
    try:
        with _silent():
            model = _whole(CLIPVisionModelWithProjection, str(folder), local_files_only=True, use_safetensors=True)
    except UNREADABLE as error:
        got = (str(error).splitlines() or ["unreadable files"])[0]
        raise PalpateError(f"The touch tower {folder} must hold config.json and model.safetensors", got, "Save the towers again") from None
    return model.float().eval().requires_grad_(False)


def _whole(kind: Any, name: str, **how: bool) -> Any:
    """``kind.from_pretrained``, refusing what transformers only warns about: weights that the file lacks are drawn at random."""
    model, report = kind.from_pretrained(name, output_loading_info=True, **how)
    if lacking := sorted(report["missing_keys"]):
        raise ValueError(f"{len(lacking)} weights are missing, first {lacking[0]}")
    return model


def _projected(output: Any) -> Tensor:
    """The projected features: a tensor in transformers 4, the field ``pooler_output`` in 5."""
    return output if isinstance(output, Tensor) else output.pooler_output


def _architecture(config: Any) -> dict[str, Any]:
    return {name: getattr(config, name) for name in ARCHITECTURE if hasattr(config, name)}


def _tokenizer_digest(tokenizer: Any) -> str:
    backend = getattr(tokenizer, "backend_tokenizer", None)
    if backend is None:  # a slow tokenizer of transformers 4
        return digest_json(tokenizer.get_vocab())
    # Truncation and padding are state of the last call, not of the tokenizer.
    table = json.loads(backend.to_str())
    return digest_json({k: v for k, v in table.items() if k not in ("truncation", "padding")})


def _digest(parts: Mapping[str, nn.Module], facts: Mapping[str, Any]) -> str:
    state = hashlib.sha256(canonical_json(dict(facts)).encode())
    for part, module in sorted(parts.items()):
        for name, value in sorted(module.state_dict().items()):
            array: np.ndarray = value.detach().cpu().contiguous().numpy()
            state.update(f"{part}.{name} {array.dtype} {array.shape}\n".encode())
            state.update(array.tobytes())
    return state.hexdigest()


@contextmanager
def _silent() -> Generator[None]:
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
