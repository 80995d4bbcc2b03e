"""The three encoders: frozen CLIP vision and text, and a tactile encoder of the same kind with random initial weights (paper section 3).

Every encoder maps into one space: features are *projected* (``visual_projection``, ``text_projection``) and L2-normalized. States
before the projection live in no common space, so nothing here returns them.

A saved set is a folder::

    palpate.json        the card: preset, training and split digests, seeds, steps, versions, loss curve, digests of the encoders
    clip/               transformers' CLIPModel: config.json, model.safetensors, tokenizer files, preprocessor_config.json
    touch/              transformers' CLIPVisionModelWithProjection: config.json, model.safetensors, preprocessor_config.json
    README.md           the card for people; clip/ has both files of its own

The digest of a encoder is SHA-256 over the architecture, the preprocessing (for text: the tokenizer) and every weight. Weights may be
saved in 16 bits (:mod:`palpate.encoders.half`); they are rounded before the digest is taken, and are 32 bits again when loaded.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import AutoTokenizer, CLIPModel, CLIPVisionConfig, CLIPVisionModelWithProjection
from transformers.utils.hub import cached_file

from palpate.core import (
    PalpateError,
    atomic_folder,
    read_record,
    reading_entry,
    seed_for,
    write_json,
)
from palpate.core.shipped import SHIPPED, is_hub_id, shipped_folder
from palpate.encoders.half import Rounding, round_to_half
from palpate.encoders.hub import fetch, find_model
from palpate.encoders.preprocess import Preprocess
from palpate.encoders.tokenizer import save_tokenizer
from palpate.encoders.weights import (
    UNREADABLE,
    architecture,
    digest_modules,
    load_weights,
    save_weights,
    silent,
    tokenizer_digest,
)
from palpate.training.cards import write_model_cards
from palpate.training.device import require_device_name

Modality = Literal["vision", "text", "tactile"]
MODALITIES: tuple[Modality, ...] = get_args(Modality)
FORMAT = "palpate-encoders/2"
#: Format 1 called the tactile encoder ``touch`` and a set of encoders ``towers``; it is still read.
FORMAT_1 = "palpate-towers/1"
CLIP_FORMAT = "palpate-clip/1"
#: What a local CLIP folder must hold, as alternatives.
CLIP_FILES = {
    "config.json": ("config.json",),
    "model.safetensors": (
        "model.safetensors",
        "model.safetensors.index.json",
        "pytorch_model.bin",
        "pytorch_model.bin.index.json",
    ),
    "tokenizer.json (or vocab.json and merges.txt)": ("tokenizer.json", "vocab.json"),
    "preprocessor_config.json": ("preprocessor_config.json",),
}


@dataclass
class ClipEncoders:
    """A CLIP whose vision and text encoders are used as they are.

    Attributes:
        model: in evaluation mode; its parameters do not require gradients.
        tokenizer: a transformers tokenizer that ends every text with the end token.
        preprocess: the evaluation transform of the vision encoder.
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
        """``input_ids`` and ``attention_mask`` (n, length), cut to the encoder's context."""
        context = int(_config(self.model).text_config.max_position_embeddings)
        encoded = self.tokenizer(
            list(texts), padding=True, truncation=True, max_length=context, return_tensors="pt"
        )
        return {
            name: encoded[name].to(self.model.device) for name in ("input_ids", "attention_mask")
        }

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Texts to (n, dim), L2-normalized; differentiable."""
        tokens: dict[str, Any] = {**self.tokens(texts)}
        return F.normalize(_projected(self.model.get_text_features(**tokens)), dim=-1)

    def encode_vision(self, pixels: Tensor) -> Tensor:
        """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalized; differentiable."""
        return F.normalize(_projected(self.model.get_image_features(pixel_values=pixels)), dim=-1)

    def digest(self, encoder: str) -> str:
        """SHA-256 of the vision or the text encoder."""
        if encoder == "vision":
            parts = {"tower": self.model.vision_model, "projection": self.model.visual_projection}
            facts = {
                "preprocess": asdict(self.preprocess),
                **architecture(_config(self.model).vision_config),
            }
        else:
            parts = {"tower": self.model.text_model, "projection": self.model.text_projection}
            facts = {
                "tokenizer": tokenizer_digest(self.tokenizer),
                **architecture(_config(self.model).text_config),
            }
        return digest_modules(parts, facts)

    def halve(self) -> Rounding:
        """Rounds the weights to 16 bits, here and now; see :func:`palpate.encoders.half.round_to_half`."""
        return round_to_half({"clip": self.model})

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Writes the standard CLIP folder, which ``CLIPModel.from_pretrained`` reads; whole or not at all.

        Args:
            folder: must be new or empty.
            half: :meth:`halve` first (this object too), and write 16-bit weights.

        Raises:
            PalpateError: if the folder exists and is not empty, or a weight is too large for 16 bits.
        """
        with atomic_folder(Path(folder)) as part:
            self._write(part, half=half)
            write_model_cards(part)

    def _write(self, folder: Path, *, half: bool) -> None:
        if half:
            self.halve()
        save_weights(self.model, folder, half=half)
        with silent():
            save_tokenizer(self.tokenizer, folder)
        write_json(folder / "preprocessor_config.json", self.preprocess.to_config())
        digests = {encoder: self.digest(encoder) for encoder in ("vision", "text")}
        write_json(
            folder / "palpate.json",
            {"format": CLIP_FORMAT, "name": self.name, "digests": digests, "card": self.card},
        )


def load_clip(name_or_folder: str | Path, *, device: str = "cpu") -> ClipEncoders:
    """A frozen CLIP that ships with the package, from a local folder or from the hub; only the last needs a network.

    Args:
        name_or_folder: a shipped name (``palpate/mini``), a folder as :meth:`ClipEncoders.save` or transformers writes it, or a hub id
            (``openai/clip-vit-large-patch14``); which comes first: :mod:`palpate.core.shipped`. safetensors is preferred; a
            ``.bin`` is read as weights only.
        device: see :func:`pick_device`.

    Raises:
        PalpateError: if files are missing, unreadable, of another model or changed since, or the hub cannot be reached.
    """
    shipped = shipped_folder(name_or_folder, "clip")
    folder = shipped or Path(name_or_folder)
    name = str(folder) if shipped else str(name_or_folder)
    local = not is_hub_id(name_or_folder)
    note = folder / "palpate.json"
    if local and (not str(name_or_folder) or not folder.is_dir()):
        must = f"The CLIP must be a folder, one of {', '.join(SHIPPED)}, or a hub id (owner/name)"
        raise PalpateError(
            must,
            f"no folder {name_or_folder or repr('')}",
            f"Pass a folder that holds {', '.join(CLIP_FILES)}",
        )
    if local:
        missing = [
            what
            for what, choices in CLIP_FILES.items()
            if not any((folder / c).is_file() for c in choices)
        ]
        if missing:
            raise PalpateError(
                f"The CLIP folder {folder} must hold {', '.join(CLIP_FILES)}",
                f"no {', no '.join(missing)}",
                "Add the files",
            )
    else:  # a small file first: out of reach, the hub is asked once instead of many times
        note = (
            fetch(
                name,
                ("config.json", "palpate.json"),
                "CLIP",
                f"Pass a folder that holds {', '.join(CLIP_FILES)}",
            )
            / "palpate.json"
        )
    try:
        with silent():
            model = load_weights(CLIPModel, name, local_files_only=local)
            tokenizer = AutoTokenizer.from_pretrained(name, local_files_only=local)
            processor = cached_file(name, "preprocessor_config.json", local_files_only=local)
    except UNREADABLE as error:
        must = (
            f"{name} must be a CLIP model"
            if local
            else f"The CLIP {name} must be a local folder, or a hub id within reach"
        )
        fix = f"Pass a folder that holds {', '.join(CLIP_FILES)}"
        raise PalpateError(
            must, (str(error).splitlines() or [type(error).__name__])[0], fix
        ) from None
    preprocess = _preprocess(Path(str(processor)), int(_config(model).vision_config.image_size))
    digests, card, called = {}, {}, name
    if note.is_file():
        about = read_record(
            note, "card of the CLIP", form=CLIP_FORMAT, keys=("name", "digests", "card")
        )
        (digests, card), called = _card(note, about), str(about["name"])
    clip = ClipEncoders(
        model.float().eval().requires_grad_(False),
        tokenizer,
        preprocess,
        str(name_or_folder) if shipped else called,
        card,
    )
    _require_digests(clip.digest, digests, name)
    move(clip.model, pick_device(device))
    return clip


def new_touch(config: CLIPVisionConfig, seed: int) -> CLIPVisionModelWithProjection:
    """A tactile encoder with random weights that depend on ``seed`` alone; global random state is left as it was."""
    with seeded(seed, "tactile encoder"):
        return CLIPVisionModelWithProjection(config)


@dataclass
class EncoderSet:
    """Vision, text and, once trained, touch.

    Attributes:
        clip: the frozen vision and text encoders.
        touch: the tactile encoder, or None.
        touch_preprocess: its evaluation transform, or None.
        card: see the head of this file; ``{}`` for encoders that were not trained here.
    """

    clip: ClipEncoders
    touch: CLIPVisionModelWithProjection | None = None
    touch_preprocess: Preprocess | None = None
    card: dict[str, Any] = field(default_factory=dict)

    @property
    def dim(self) -> int:
        """Width of the common space."""
        return self.clip.dim

    @property
    def device(self) -> torch.device:
        """Where the encoders are."""
        return self.clip.model.device

    def to(self, device: str) -> EncoderSet:
        """Moves all encoders; returns self."""
        for model in (self.clip.model, self.touch):
            if model is not None:
                move(model, pick_device(device))
        return self

    def preprocess(self, encoder: str) -> Preprocess:
        """The evaluation transform of ``vision`` or ``touch``.

        Raises:
            PalpateError: for another name, or if there is no tactile encoder.
        """
        if encoder == "vision":
            return self.clip.preprocess
        return self._touch(encoder)[1]

    def encode(self, encoder: str, batch: Tensor | Sequence[str]) -> Tensor:
        """One batch to (n, dim), projected and L2-normalized.

        Args:
            encoder: ``vision``, ``text`` or ``touch``.
            batch: preprocessed pixels (n, 3, size, size) on the encoders' device, or texts.
        """
        if encoder == "text":
            return self.clip.encode_text([str(text) for text in batch])
        pixels = torch.as_tensor(batch)
        return (
            self.clip.encode_vision(pixels)
            if encoder == "vision"
            else encode_touch(self._touch(encoder)[0], pixels)
        )

    def digest(self, encoder: str) -> str:
        """SHA-256 of one encoder: weights, architecture, preprocessing."""
        if encoder == "vision" or encoder == "text":
            return self.clip.digest(encoder)
        touch, preprocess = self._touch(encoder)
        return digest_modules(
            {"touch": touch}, {"preprocess": asdict(preprocess), **architecture(touch.config)}
        )

    def halve(self) -> Rounding:
        """Rounds the weights of all encoders to 16 bits, here and now; see :func:`palpate.encoders.half.round_to_half`."""
        return round_to_half(
            {"clip": self.clip.model} | ({} if self.touch is None else {"touch": self.touch})
        )

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Writes the folder described at the head of this file; whole or not at all.

        Args:
            folder: must be new or empty.
            half: :meth:`halve` first (this object too), and write 16-bit weights.

        Raises:
            PalpateError: if the folder exists and is not empty, or a weight is too large for 16 bits.
        """
        with atomic_folder(Path(folder)) as part:
            (part / "clip").mkdir()
            if half:
                self.halve()
            self.clip._write(part / "clip", half=half)  # pyright: ignore[reportPrivateUsage]
            if self.touch is not None and self.touch_preprocess is not None:
                save_weights(self.touch, part / "tactile", half=half)
                write_json(
                    part / "tactile" / "preprocessor_config.json", self.touch_preprocess.to_config()
                )
            names = [t for t in MODALITIES if t != "tactile" or self.touch is not None]
            write_json(
                part / "palpate.json",
                {
                    "format": FORMAT,
                    "digests": {t: self.digest(t) for t in names},
                    "card": self.card,
                },
            )
            write_model_cards(part)

    @classmethod
    def load(cls, source: str | Path, *, device: str = "cpu") -> EncoderSet:
        """Reads what :meth:`save` wrote and checks every encoder against its digest.

        Args:
            source: a shipped name (``palpate/mini``), a folder or a hub id; see :mod:`palpate.core.shipped`.
            device: see :func:`pick_device`.

        Raises:
            PalpateError: if the folder is of another kind, incomplete, or changed since, or the hub cannot be reached.
        """
        folder = find_model(
            source, "encoders", "set of encoders", "Train one with: palpate encoder"
        )
        note = folder / "palpate.json"
        digests, card = _card(
            note,
            read_record(
                note, "card of the encoders", form=(FORMAT, FORMAT_1), keys=("digests", "card")
            ),
        )
        # A shipped CLIP keeps its name, so that cards of what is trained beside it say it.
        clip = (
            load_clip(source)
            if str(source) in SHIPPED and isinstance(source, str)
            else load_clip(folder / "clip")
        )
        encoders = cls(clip, card=card)
        if "tactile" in digests:
            place = folder / "tactile"
            place = place if place.is_dir() else folder / "touch"  # format 1
            encoders.touch = _load_touch(place)
            place = place / "preprocessor_config.json"
            encoders.touch_preprocess = _preprocess(place, int(_config(encoders.touch).image_size))
        _require_digests(encoders.digest, digests, str(folder))
        return encoders.to(device)

    def _touch(self, encoder: str) -> tuple[CLIPVisionModelWithProjection, Preprocess]:
        if encoder == "text":
            raise PalpateError(
                "A encoder of images must be vision or touch",
                repr(encoder),
                "Pass texts to the text encoder",
            )
        if encoder != "tactile":
            raise PalpateError(
                f"A encoder must be one of {', '.join(MODALITIES)}",
                repr(encoder),
                "Choose one of these",
            )
        if self.touch is None or self.touch_preprocess is None:
            raise PalpateError(
                "These encoders must include a tactile encoder",
                "vision and text only",
                "Train one with: palpate encoder",
            )
        return self.touch, self.touch_preprocess


def encode_touch(touch: nn.Module, pixels: Tensor) -> Tensor:
    """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalized; differentiable."""
    return F.normalize(touch(pixel_values=pixels).image_embeds, dim=-1)


def pick_device(device: str) -> torch.device:
    """``auto`` is CUDA, else Apple's MPS, else the CPU; any other name is torch's.

    Raises:
        PalpateError: for a name that torch does not know or a device that is not there.
    """
    require_device_name(device)
    if device == "auto":
        mps = torch.backends.mps.is_available()
        device = "cuda" if torch.cuda.is_available() else "mps" if mps else "cpu"
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise PalpateError(
            "--device must be auto, cpu, or a device that is there",
            repr(device),
            str(error).splitlines()[0],
        ) from None
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


def _card(note: Path, about: Mapping[str, Any]) -> tuple[dict[str, str], dict[str, Any]]:
    """The digests by encoder and the card that a ``palpate.json`` holds.

    Raises:
        PalpateError: if one of them is no object, or there is no digest of vision or text.
    """
    digests, card = about["digests"], about["card"]
    if about["format"] == FORMAT_1 and isinstance(digests, dict):
        digests = {
            "tactile" if name == "touch" else name: digest for name, digest in digests.items()
        }
    if (
        not isinstance(digests, dict)
        or not isinstance(card, dict)
        or not {"vision", "text"} <= set(digests) <= set(MODALITIES)
    ):
        must = f"In {note}, digests must be an object with vision and text, and card an object"
        got = f"digests {json.dumps(digests)[:80]} and a card of type {type(card).__name__}"
        raise PalpateError(must, got, "Save the encoders again")
    return digests, card


def _preprocess(path: Path, size: int) -> Preprocess:
    config = read_record(path, "image processor")
    with reading_entry(path, "An entry"):
        return Preprocess.from_config(config, size)


def _require_digests(digest: Callable[[str], str], wanted: Mapping[str, str], place: str) -> None:
    for name, value in wanted.items():
        if digest(name) != value:
            must = f"The {name} encoder in {place} must match its digest"
            raise PalpateError(
                must, "weights or settings that were changed", "Save the encoders again"
            )


def _load_touch(folder: Path) -> CLIPVisionModelWithProjection:
    try:
        with silent():
            model = load_weights(
                CLIPVisionModelWithProjection,
                str(folder),
                local_files_only=True,
                use_safetensors=True,
            )
    except UNREADABLE as error:
        got = (str(error).splitlines() or ["unreadable files"])[0]
        raise PalpateError(
            f"The tactile encoder {folder} must hold config.json and model.safetensors",
            got,
            "Save the encoders again",
        ) from None
    return model.float().eval().requires_grad_(False)


def _projected(output: Any) -> Tensor:
    """The projected features: a tensor in transformers 4, the field ``pooler_output`` in 5."""
    return output if isinstance(output, Tensor) else output.pooler_output
