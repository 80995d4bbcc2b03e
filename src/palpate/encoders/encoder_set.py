"""The three encoders: frozen CLIP vision and text, and a tactile encoder (paper section 3).

Every encoder maps into one space: features are *projected* (``visual_projection``,
``text_projection``) and L2-normalized. States before the projection share no space, so nothing here
returns them.

Images are prepared by :class:`Preprocess`: center square, antialiased bicubic to ``resize``, center
crop to ``size``, then ``(x / 255 - mean) / std`` per channel, as in CLIP's
``preprocessor_config.json``.

A saved set is a folder::

    palpate.json   {"format": "palpate-encoders/1", "digests": {modality: sha256}, "card": {...}}
    clip/          CLIPModel, its tokenizer and preprocessor_config.json
    tactile/       CLIPVisionModelWithProjection and preprocessor_config.json
    */seen.safetensors   digests of the images that an encoder was trained on, if they are known
    README.md      the card for people

The digest of an encoder is SHA-256 over its architecture, preprocessing (text: tokenizer) and
weights.
"""

from __future__ import annotations

import json
import math
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, normalize
from transformers import (
    AutoModel,
    AutoTokenizer,
    CLIPModel,
    CLIPVisionConfig,
    CLIPVisionModelWithProjection,
)

from palpate.core import (
    PalpateError,
    Progress,
    atomic_folder,
    digest_json,
    quiet,
    read_record,
    require_regular,
    seed_for,
    write_json,
)
from palpate.data.manifest import Manifest
from palpate.encoders.models import (
    Origin,
    architecture,
    digest_modules,
    find_encoder,
    find_single,
    first_line,
    is_shipped,
    load_model,
    parts_of,
    pick_device,
    round_to_half,
    save_model,
    silent,
    stated,
)
from palpate.encoders.preprocess import (
    SAVE_AGAIN,
    Digests,
    Frame,
    Preprocess,
    digest_images,
    load_frames,
)
from palpate.encoders.tactile import TactileModule, load_tactile
from palpate.encoders.tokenizer import save_tokenizer
from palpate.training.cards import write_model_cards

Modality = Literal["vision", "text", "tactile"]
MODALITIES: tuple[Modality, ...] = get_args(Modality)
FORMAT, CLIP_FORMAT = "palpate-encoders/1", "palpate-clip/1"
#: Kinds of transformers' models that see, and whether they read, too.
FAMILIES = {
    "clip": True,
    "siglip": True,
    "siglip2": True,
    "dinov2": False,
    "dinov2_with_registers": False,
    "dinov3_vit": False,
}
#: Digests of the images that an encoder was trained on, in its folder.
SEEN = "seen.safetensors"
CLIP_FIX = (
    "Pass a folder that holds config.json, model.safetensors, the tokenizer's files and "
    "preprocessor_config.json"
)


@dataclass
class ClipEncoders:
    """A CLIP, SigLIP or SigLIP 2 whose vision and text encoders are used as they are, or a DINO.

    Attributes:
        model: in evaluation mode; its parameters do not require gradients.
        tokenizer: a transformers tokenizer that ends every text with the end token; None of a
            vision encoder alone.
        preprocess: for the vision encoder.
        name: hub id or folder it came from, or the preset that made it.
        card: how it was trained, if palpate trained it; else ``license`` and ``trained_on``.
        seen: digests of the images that the vision encoder was trained on; None: unknown.
    """

    model: Any
    tokenizer: Any
    preprocess: Preprocess
    name: str
    card: dict[str, Any] = field(default_factory=dict)
    seen: Digests | None = None

    @property
    def dim(self) -> int:
        """Width of the shared space."""
        config = _config(self.model)
        if self.family == "clip":
            return int(config.projection_dim)
        return int(getattr(config, "vision_config", config).hidden_size)

    @property
    def family(self) -> str:
        """The model's kind in transformers, a key of :data:`FAMILIES`."""
        return str(_config(self.model).model_type)

    def tokens(self, texts: Sequence[str]) -> dict[str, Tensor]:
        """``input_ids`` and ``attention_mask`` (n, length), cut to the encoder's context."""
        context = int(_config(self.model).text_config.max_position_embeddings)
        names, how = ("input_ids", "attention_mask"), {"padding": True}
        if self.family != "clip":  # SigLIP was trained on lower case, and on padding without a mask
            names, how = ("input_ids",), {"padding": "max_length"}
            texts = [text.lower() for text in texts]
        options: dict[str, Any] = {"truncation": True, "max_length": context, **how}
        encoded = self.tokenizer(list(texts), return_tensors="pt", **options)
        return {k: encoded[k].to(self.model.device) for k in names}

    def length(self, text: str) -> tuple[int, int]:
        """Tokens of a text, marks of its ends included, and the most that the encoder takes."""
        most = int(_config(self.model).text_config.max_position_embeddings)
        with silent():  # the tokenizer warns of long texts, in its own words
            return len(self.tokenizer(text)["input_ids"]), most

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Texts to (n, dim), L2-normalized; differentiable."""
        tokens: dict[str, Any] = {**self.tokens(texts)}
        return normalize(_projected(self.model.get_text_features(**tokens)), dim=-1)

    def encode_vision(self, pixels: Tensor) -> Tensor:
        """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalized; differentiable."""
        if not hasattr(self.model, "get_image_features"):  # a DINO: its class token
            model: Any = self.model
            return normalize(model(pixel_values=pixels).pooler_output, dim=-1)
        inputs = _patches(pixels, self.model) if self.family == "siglip2" else {}
        inputs = {"pixel_values": pixels, **inputs}
        return normalize(_projected(self.model.get_image_features(**inputs)), dim=-1)

    def patches(self, pixels: Tensor, count: int) -> Tensor:
        """States of a photo's patches in the last layer, before the projection.

        Args:
            pixels: preprocessed (n, 3, size, size).
            count: a square number; the patches are averaged to so many.

        Returns:
            (n, count, width); what others put before the patches (CLS) is left out.
        """
        model: Any = getattr(self.model, "vision_model", self.model)
        inputs = _patches(pixels, self.model) if self.family == "siglip2" else {}
        output = model(**{"pixel_values": pixels, **inputs})
        grid = pixels.shape[2] // int(model.config.patch_size)
        states = output.last_hidden_state[:, -(grid**2) :].transpose(1, 2)
        states = states.unflatten(2, (grid, grid))
        return adaptive_avg_pool2d(states, math.isqrt(count)).flatten(2).transpose(1, 2)

    def digest(self, modality: str) -> str:
        """SHA-256 of the vision or the text encoder."""
        config, model, facts = _config(self.model), self.model, {"family": self.family}
        if modality == "vision":
            facts |= {"preprocess": asdict(self.preprocess)}
            facts |= architecture(getattr(config, "vision_config", config))
            parts = {"encoder": getattr(model, "vision_model", model)}
        else:
            facts |= {"tokenizer": _tokenizer_digest(self.tokenizer)}
            facts |= architecture(config.text_config)
            parts = {"encoder": model.text_model}
        if self.family == "clip":
            vision = modality == "vision"
            parts["projection"] = model.visual_projection if vision else model.text_projection
        return digest_modules(parts, facts)

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Write a folder for ``CLIPModel.from_pretrained``, whole or not at all.

        Args:
            folder: must be new or empty.
            half: round the weights to 16 bits first (here too) and write 16-bit weights.

        Raises:
            PalpateError: if the folder is not empty, or a weight is too large for 16 bits.
        """
        with atomic_folder(Path(folder)) as part:
            if half:
                round_to_half({"clip": self.model})
            self.write(part, half=half)
            write_model_cards(part)

    def write(self, folder: Path, *, half: bool) -> None:
        """Write the files into ``folder``; see :meth:`save`, which does so atomically."""
        save_model(self.model, folder, half=half)
        modalities = ("vision", "text") if self.tokenizer is not None else ("vision",)
        if self.tokenizer is not None:
            with silent():
                save_tokenizer(self.tokenizer, folder)
        write_json(folder / "preprocessor_config.json", self.preprocess.to_config())
        digests = {modality: self.digest(modality) for modality in modalities}
        about = {"format": CLIP_FORMAT, "name": self.name, "digests": digests, "card": self.card}
        write_json(folder / "palpate.json", about | _counts({"vision": self.seen}))
        save_seen(self.seen, folder)


def load_clip(source: str | Path, *, device: str = "cpu") -> ClipEncoders:
    """Load a frozen CLIP, SigLIP or DINO; only one from the hub needs a network, once.

    Args:
        source: a shipped name (``palpate/mini``), a folder as :meth:`ClipEncoders.save` or
            transformers writes it, a set of encoders, or a hub id
            (``openai/clip-vit-large-patch14``). safetensors is preferred; a ``.bin`` is read as
            weights only.
        device: see :func:`palpate.encoders.models.pick_device`.

    Raises:
        PalpateError: if files are missing, unreadable, of another model or changed since, or the
            hub is out of reach.
    """
    name, folder = find_single(source, "clip", "CLIP", CLIP_FIX)
    local, must = name == str(folder), f"{source} must be a CLIP model"
    note = folder / "palpate.json"
    if note.is_file() and read_record(note, "card of the CLIP").get("format") == FORMAT:
        return EncoderSet.load(source, device=device).clip
    config = folder / "config.json"
    family = read_record(config, "model").get("model_type") if config.is_file() else "clip"
    if not isinstance(family, str) or family not in FAMILIES:
        got = f"model_type {family!r} in {config}"
        raise PalpateError(f"{source} must be one of {', '.join(FAMILIES)}", got, CLIP_FIX)
    kind = CLIPModel if family == "clip" else AutoModel
    model = load_model(kind, name, must, CLIP_FIX, local_files_only=local)
    tokenizer = None
    try:
        with silent():
            if FAMILIES[family]:
                tokenizer = AutoTokenizer.from_pretrained(name, local_files_only=local)
    except Exception as error:  # tokenizers raises bare ones
        raise PalpateError(must, first_line(error), CLIP_FIX) from None
    sized = family in ("clip", "siglip")  # the others take images of any size
    size = int(model.config.vision_config.image_size) if sized else None
    preprocess = Preprocess.from_config(folder / "preprocessor_config.json", size)
    clip = ClipEncoders(model, tokenizer, preprocess, str(source))
    if not note.is_file():
        clip.card = stated(folder)
    else:
        about = _read_card(folder, CLIP_FORMAT)
        clip.card = about["card"]
        clip.name = clip.name if is_shipped(source) else str(about["name"])
        clip.seen = load_seen(folder, about["seen"].get("vision"))
        _require_digests(clip, about["digests"], folder)
    model.to(pick_device(device))
    return clip


@dataclass
class EncoderSet:
    """Vision, text and, once trained, tactile encoder.

    Attributes:
        clip: the frozen vision and text encoders.
        tactile: the tactile encoder, or None.
        tactile_preprocess: for the tactile encoder, or None.
        card: how the tactile encoder was trained; ``{}`` if palpate did not train it.
        seen: digests of the images that the tactile encoder was trained on; None: unknown.
        sensor: name of the sensor of all tactile images; None takes the manifest's.
    """

    clip: ClipEncoders
    tactile: CLIPVisionModelWithProjection | TactileModule | None = None
    tactile_preprocess: Preprocess | None = None
    card: dict[str, Any] = field(default_factory=dict)
    seen: Digests | None = None
    sensor: str | None = None

    @property
    def dim(self) -> int:
        """Width of the shared space; of a set without one, that of its only encoder."""
        return self.clip.dim if self._has_clip else self.width("tactile")

    def width(self, modality: str) -> int:
        """Width of one encoder's embeddings."""
        if modality != "tactile":
            return self._clip(modality).dim
        tactile = self._tactile(modality)[0]
        foreign = isinstance(tactile, TactileModule)
        return tactile.dim if foreign else int(_config(tactile).projection_dim)

    @property
    def device(self) -> torch.device:
        """Where the encoders are."""
        return next(p for module in self._modules().values() for p in module.parameters()).device

    @property
    def modalities(self) -> list[Modality]:
        """The modalities of this set."""
        text = self._has_clip and self.clip.tokenizer is not None
        has = {"vision": self._has_clip, "text": text, "tactile": self.tactile is not None}
        return [m for m in MODALITIES if has[m]]

    @property
    def _has_clip(self) -> bool:
        return getattr(self, "clip", None) is not None

    def _clip(self, modality: str) -> ClipEncoders:
        if modality not in self.modalities:
            raise _lacks(modality, self.modalities)
        return self.clip

    def to(self, device: str | torch.device) -> EncoderSet:
        """Move all encoders; returns self."""
        for module in self._modules().values():
            module.to(pick_device(device))
        return self

    def preprocess(self, modality: str) -> Preprocess:
        """The preprocessing of ``vision`` or ``tactile``.

        Raises:
            PalpateError: for another modality, or if there is no tactile encoder.
        """
        clip = modality == "vision"
        return self._clip(modality).preprocess if clip else self._tactile(modality)[1]

    def encode(
        self, modality: str, batch: Tensor | Sequence[str], sensors: Sequence[str] | None = None
    ) -> Tensor:
        """One batch to (n, dim), projected and L2-normalized; differentiable.

        Args:
            modality: ``vision``, ``text`` or ``tactile``.
            batch: preprocessed pixels (n, 3, size, size) on the encoders' device, or texts.
            sensors: names of the sensors (n), for tactile encoders that take them.
        """
        if modality == "text":
            return self._clip(modality).encode_text([str(text) for text in batch])
        pixels = torch.as_tensor(batch)
        if modality == "vision":
            return self._clip(modality).encode_vision(pixels)
        tactile = self._tactile(modality)[0]
        if isinstance(tactile, TactileModule):
            names = [self.sensor] * len(pixels) if self.sensor else sensors
            return tactile.encode(pixels, names)
        return encode_tactile(tactile, pixels)

    def digest(self, modality: str) -> str:
        """SHA-256 of one encoder: weights, architecture, preprocessing."""
        if modality in ("vision", "text"):
            return self._clip(modality).digest(modality)
        tactile, preprocess = self._tactile(modality)
        facts = {"preprocess": asdict(preprocess), "sensor": self.sensor}
        facts |= architecture(getattr(tactile, "config", {}))
        return digest_modules({"encoder": tactile}, facts)

    def seen_by(self, modality: str) -> Digests | None:
        """Digests of the images that one encoder was trained on; None: unknown, or of texts."""
        clip = self.clip.seen if self._has_clip else None
        return {"vision": clip, "tactile": self.seen}.get(modality)

    def knows_seen(self, modality: str) -> bool:
        """Whether all images are known that one encoder was trained on; else some, or none."""
        card = self.clip.card if modality == "vision" else self.card
        return self.seen_by(modality) is not None and not card.get("seen_in_part")

    def saw(
        self,
        modality: str,
        images: Manifest | Sequence[Path | Image.Image],
        *,
        batch: int = 128,
        progress: Progress = quiet,
    ) -> NDArray[np.bool_]:
        """Whether one encoder was trained on images, by their pixels, whatever their names.

        Returns:
            (n,) booleans; all false where the encoder's images are not known (public ones).
        """
        known = self.seen_by(modality)
        if known is None:
            return np.zeros(len(images), bool)
        preprocess = replace(self.preprocess(modality), subtract=())
        files: Sequence[Frame] = (
            preprocess.frames(images, modality).files
            if isinstance(images, Manifest)
            else [(image, None, None) for image in images]
        )
        seen = np.zeros(len(files), bool)
        for start in range(0, len(files), batch):
            pixels = load_frames(files[start : start + batch], preprocess)
            seen[start : start + batch] = np.isin(digest_images(pixels), known)
            progress("looking for known images", start + len(pixels), len(files))
        return seen

    def origin(self, modality: str) -> Origin | None:
        """What is known of an encoder that others trained; None of palpate's and one's own."""
        if modality == "tactile":
            return self.tactile.format if isinstance(self.tactile, TactileModule) else None
        clip = self._clip(modality)
        if "trained_on" not in clip.card:
            return None
        return Origin(clip.name, clip.card["license"], tuple(clip.card["trained_on"]))

    def halve(self) -> None:
        """Round all weights to 16 bits in place; see ``models.round_to_half``."""
        round_to_half(self._modules())

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Write the folder described in the module's docstring; whole or not at all.

        Args:
            folder: must be new or empty.
            half: :meth:`halve` first (this object too), and write 16-bit weights.

        Raises:
            PalpateError: if the folder is not empty, a weight is too large for 16 bits, or the
                tactile encoder is a public one, which is named by its file.
        """
        if not self._has_clip or isinstance(self.tactile, TactileModule):
            must, fix = "Encoders to be saved must be palpate's own", "Name the public one's file"
            raise PalpateError(must, "a public tactile encoder", fix)
        with atomic_folder(Path(folder)) as part:
            (part / "clip").mkdir()
            if half:
                self.halve()
            self.clip.write(part / "clip", half=half)
            if self.tactile is not None and self.tactile_preprocess is not None:
                save_model(self.tactile, part / "tactile", half=half)
                config = self.tactile_preprocess.to_config()
                write_json(part / "tactile" / "preprocessor_config.json", config)
                save_seen(self.seen, part / "tactile")
            digests = {m: self.digest(m) for m in self.modalities}
            about = {"format": FORMAT, "digests": digests, "card": self.card}
            write_json(part / "palpate.json", about | _counts({"tactile": self.seen}))
            write_model_cards(part)

    @classmethod
    def load(cls, source: str | Path, *, device: str = "cpu") -> EncoderSet:
        """Load encoders of any kind: palpate's, a CLIP, SigLIP or DINO, a public tactile encoder.

        What :meth:`save` wrote is compared with its digests.

        Args:
            source: a shipped name (``palpate/mini``); a folder of palpate or transformers, or its
                hub id; a file of a public tactile encoder (:mod:`palpate.encoders.tactile`),
                ``owner/name:file`` for one on the hub, ``file#digit`` to name the sensor of all
                images; or ``tactile+clip``, two of these that share a space.
            device: see :func:`palpate.encoders.models.pick_device`.

        Raises:
            PalpateError: if the folder is of another kind, incomplete, or changed since, or the hub
                is out of reach.
        """
        if len(parts := parts_of(source)) == 2:
            tactile, clip = (cls.load(part, device=device) for part in parts)
            return tactile.with_clip(clip)
        folder, sensor = find_encoder(source)
        if folder.is_file():
            module = load_tactile(folder)
            card = {"name": str(source), "license": module.format.license}
            foreign = cls(None, module, module.preprocess, card, sensor=sensor)  # type: ignore[arg-type]
            return foreign.to(device)
        note = folder / "palpate.json"
        if not note.is_file() or read_record(note, "card").get("format") == CLIP_FORMAT:
            return cls(load_clip(source, device=device))
        about = _read_card(folder, FORMAT)
        # A shipped CLIP keeps its name, so that cards of what is trained with it say so.
        clip = load_clip(source if is_shipped(source) else folder / "clip")
        encoders = cls(clip, card=about["card"])
        if "tactile" in about["digests"]:
            place = folder / "tactile"
            must = f"The tactile encoder {place} must hold config.json and model.safetensors"
            options = {"local_files_only": True, "use_safetensors": True}
            kind = CLIPVisionModelWithProjection
            encoders.tactile = tactile = load_model(kind, str(place), must, SAVE_AGAIN, **options)
            path, size = place / "preprocessor_config.json", _config(tactile).image_size
            encoders.tactile_preprocess = Preprocess.from_config(path, size)
            encoders.seen = load_seen(place, about["seen"].get("tactile"))
        _require_digests(encoders, about["digests"], folder)
        return encoders.to(device)

    def with_clip(self, other: EncoderSet) -> EncoderSet:
        """This tactile encoder with another set's vision and text, whose space it was trained for.

        Raises:
            PalpateError: if the widths of the spaces differ.
        """
        widths = self.width("tactile"), other.width("vision")
        if widths[0] != widths[1]:
            must, got = "Encoders of one space must have one width", " and ".join(map(str, widths))
            raise PalpateError(must, got, "Join an encoder with the CLIP that it was trained with")
        return replace(self, clip=other.clip).to(other.device)

    def _modules(self) -> dict[str, nn.Module]:
        modules = {"clip": self.clip.model if self._has_clip else None, "tactile": self.tactile}
        return {name: module for name, module in modules.items() if module is not None}

    def _tactile(
        self, modality: str
    ) -> tuple[CLIPVisionModelWithProjection | TactileModule, Preprocess]:
        if modality != "tactile":
            must, fix = "must be vision or tactile for images", "Pass texts to the text encoder"
            raise PalpateError(must, repr(modality), fix, argument="modality")
        if self.tactile is None or self.tactile_preprocess is None:
            raise _lacks(modality, self.modalities)
        return self.tactile, self.tactile_preprocess


def new_tactile(config: CLIPVisionConfig, seed: int) -> CLIPVisionModelWithProjection:
    """A tactile encoder with random weights that depend on ``seed`` alone."""
    with seeded(seed, "tactile encoder"):
        return CLIPVisionModelWithProjection(config)


def encode_tactile(tactile: nn.Module, pixels: Tensor) -> Tensor:
    """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalized; differentiable."""
    return normalize(tactile(pixel_values=pixels).image_embeds, dim=-1)


@contextmanager
def seeded(seed: int, purpose: str) -> Generator[None]:
    """Seed torch's CPU generator by (seed, purpose) inside and restore it afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(seed, purpose))
        yield


def _config(model: nn.Module) -> Any:
    """The model's configuration, whose fields transformers types too loosely."""
    return model.config


def _lacks(modality: str, modalities: Sequence[str]) -> PalpateError:
    must, got = f"These encoders must include a {modality} encoder", f"{' and '.join(modalities)}"
    return PalpateError(must, f"{got} only", "Use others, or train one: palpate.train_encoder")


def save_seen(seen: Digests | None, folder: Path) -> None:
    """Write the digests into the folder of an encoder; None writes nothing."""
    if seen is not None:
        save_file({"digests": seen}, folder / SEEN)


def load_seen(folder: Path, count: int | None) -> Digests | None:
    """Read what :func:`save_seen` wrote.

    Args:
        folder: of the encoder.
        count: how many there must be, by the card; None for a card without a count.

    Raises:
        PalpateError: if the file is missing, damaged, or holds another number.
    """
    if count is None:
        return None
    require_regular(folder / SEEN)
    must = f"{folder / SEEN} must hold the digests of the {count:,} images of the training"
    try:
        seen = load_file(folder / SEEN)["digests"]
    except (OSError, KeyError, SafetensorError) as error:
        raise PalpateError(must, str(error), "Fetch the encoder again") from None
    if len(seen) != count or seen.dtype != np.uint64:
        raise PalpateError(must, f"{len(seen):,}", "Fetch the encoder again")
    return seen


def _counts(seen: Mapping[str, Digests | None]) -> dict[str, Any]:
    """The number of images that each encoder was trained on, for the card; {} if unknown."""
    counts = {name: len(digests) for name, digests in seen.items() if digests is not None}
    return {"seen": counts} if counts else {}


def _read_card(folder: Path, form: str) -> dict[str, Any]:
    about = read_record(
        folder / "palpate.json", "card of the encoders", form=form, keys=("digests", "card")
    )
    parts = [about["digests"], about["card"], about.setdefault("seen", {})]
    kinds = [type(count) for count in parts[2].values()] if isinstance(parts[2], dict) else [str]
    if not all(isinstance(part, dict) for part in parts) or {*kinds} - {int}:
        must = f"digests, card and seen in {folder / 'palpate.json'} must be as palpate writes them"
        raise PalpateError(must, "other values", "Fetch the encoder again")
    return about


def _require_digests(
    encoders: ClipEncoders | EncoderSet, digests: Mapping[str, str], folder: Path
) -> None:
    for modality, digest in digests.items():
        if encoders.digest(modality) != digest:
            must = f"The {modality} encoder in {folder} must match its digest"
            raise PalpateError(must, "weights or settings that were changed", SAVE_AGAIN)


def _tokenizer_digest(tokenizer: Any) -> str:
    """SHA-256 of all that a tokenizer does to a text."""
    backend = getattr(tokenizer, "backend_tokenizer", None)
    if backend is None:  # a slow tokenizer of transformers 4
        return digest_json(tokenizer.get_vocab())
    # Truncation and padding are state of the last call, not of the tokenizer.
    table = json.loads(backend.to_str())
    return digest_json({k: v for k, v in table.items() if k not in ("truncation", "padding")})


def _patches(pixels: Tensor, model: Any) -> dict[str, Tensor]:
    """Images (n, 3, side, side) as the rows of patches that SigLIP 2 of any aspect takes."""
    patch = int(model.config.vision_config.patch_size)
    n, side = len(pixels), pixels.shape[2] // patch
    cells = pixels.unflatten(3, (side, patch)).unflatten(2, (side, patch))
    rows = cells.permute(0, 2, 4, 3, 5, 1).reshape(n, side * side, -1)
    shapes = torch.full((n, 2), side, device=pixels.device)
    mask = torch.ones(rows.shape[:2], dtype=torch.int32, device=pixels.device)
    return {"pixel_values": rows, "pixel_attention_mask": mask, "spatial_shapes": shapes}


def _projected(output: Any) -> Tensor:
    """The projected features: a tensor in transformers 4, the field ``pooler_output`` in 5."""
    return output if isinstance(output, Tensor) else output.pooler_output
