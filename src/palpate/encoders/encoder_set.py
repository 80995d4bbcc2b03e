"""The encoders of one space: frozen vision and text, and a tactile encoder (paper section 3).

Images are prepared by :class:`~palpate.data.images.Preprocess`: center square, antialiased
bicubic to ``resize``, center crop to ``size``, then ``(x / 255 - mean) / std`` per channel, as in
CLIP's ``preprocessor_config.json``.

A saved set is a folder::

    palpate.json   {"format": "palpate-encoders/1", "digests": {modality: sha256}, "card": {...}}
    clip/          CLIPModel, its tokenizer and preprocessor_config.json; not of a ruler alone
    tactile/       the learned ruler (:mod:`palpate.encoders.gel`), one file, or a
                   CLIPVisionModelWithProjection and its preprocessor_config.json
    */seen.safetensors   digests of the images that an encoder was trained on, if they are known
    README.md      the card for people

The digest of an encoder is SHA-256 over its architecture, preprocessing (text: tokenizer) and
weights.

Vision and text are one model of transformers: CLIP, SigLIP or SigLIP 2; a DINO sees alone. Features
of CLIP are *projected* (``visual_projection``, ``text_projection``), and all features are
L2-normalized. States before the projection share no space; :meth:`EncoderSet.patches` returns them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, normalize

from palpate.core import (
    PalpateError,
    Progress,
    atomic_folder,
    digest_json,
    quiet,
    read_record,
    require,
    write_json,
)
from palpate.data.images import SAVE_AGAIN, Frames, Preprocess, load_images
from palpate.encoders.clip import Clip, ClipTokenizer
from palpate.encoders.gel import WEIGHTS, GelEncoder
from palpate.encoders.models import (
    FETCH_AGAIN,
    Digests,
    Origin,
    architecture,
    digest_images,
    digest_modules,
    find_encoder,
    find_single,
    first_line,
    is_shipped,
    load_model,
    load_seen,
    parts_of,
    pick_device,
    round_to_half,
    save_model,
    save_seen,
    silent,
    stated,
    union,
)
from palpate.encoders.rulers import Handcrafted
from palpate.encoders.tactile import load_tactile
from palpate.encoders.tactile_module import TactileModule
from palpate.training.cards import write_model_cards
from palpate.training.steps import seeded

if TYPE_CHECKING:  # transformers takes seconds to import, and a ruler needs none of it
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    from palpate.data.manifest import Manifest

Modality = Literal["vision", "text", "tactile"]
MODALITIES: tuple[Modality, ...] = get_args(Modality)
FORMAT, CLIP_FORMAT = "palpate-encoders/1", "palpate-clip/1"
CLIP_FIX = (
    "Pass a folder that holds config.json, model.safetensors, the tokenizer's files and "
    "preprocessor_config.json"
)
#: Encoders of residuals, which palpate makes.
RULERS = (Handcrafted, GelEncoder)
#: Kinds of transformers' models that see, and whether they read, too.
FAMILIES = {
    "clip": True,
    "siglip": True,
    "siglip2": True,
    "dinov2": False,
    "dinov2_with_registers": False,
    "dinov3_vit": False,
}


@dataclass
class EncoderSet:
    """Vision, text and tactile encoder, as many of them as there are.

    Models are in evaluation mode, and their parameters do not require gradients.

    Attributes:
        clip: transformers' CLIP, SigLIP or SigLIP 2 of vision and text, or a DINO, which sees
            alone.
        tokenizer: of transformers, ends every text with the end token; None without text.
        tactile: palpate's tactile encoder, or a public one.
        preprocesses: of the images of ``vision`` and ``tactile``.
        name: of vision and text: hub id or folder, or the preset that made them.
        clip_card: how vision and text were trained, if palpate trained them; else ``license`` and
            ``trained_on``.
        card: how the tactile encoder was trained; ``{}`` if palpate did not train it.
        seen: digests of the images that ``vision`` and ``tactile`` were trained on; without an
            entry, or None: unknown.
        sensor: name of the sensor of all tactile images; None takes the manifest's.
    """

    clip: Any = None
    tokenizer: Any = None
    tactile: CLIPVisionModelWithProjection | TactileModule | None = None
    preprocesses: dict[str, Preprocess] = field(default_factory=dict)
    name: str = ""
    clip_card: dict[str, Any] = field(default_factory=dict)
    card: dict[str, Any] = field(default_factory=dict)
    seen: dict[str, Digests | None] = field(default_factory=dict)
    sensor: str | None = None

    @property
    def modalities(self) -> list[Modality]:
        """The modalities of this set."""
        models = {"vision": self.clip, "text": self.tokenizer, "tactile": self.tactile}
        return [m for m in MODALITIES if models[m] is not None]

    @property
    def dim(self) -> int:
        """Width of the shared space; of a set without one, that of its only encoder."""
        return self.width("tactile" if self.clip is None else "vision")

    def width(self, modality: str) -> int:
        """Width of one encoder's embeddings."""
        self._require(modality)
        model: Any = self.tactile if modality == "tactile" else self.clip
        if isinstance(model, TactileModule):
            return model.dim
        config = model.config
        if modality == "tactile" or family_of(model) == "clip":
            return int(config.projection_dim)
        return int(getattr(config, "vision_config", config).hidden_size)

    @property
    def shared_width(self) -> int:
        """Width of the tactile encoder's embeddings in the space of photos and texts."""
        if isinstance(self.tactile, GelEncoder):
            return self.tactile.head.out_features
        return self.width("tactile")

    def shared(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Tactile features (n, width) in the space of photos and texts, (n, dim), L2-normalized.

        Those of a ruler must be its numbers, of any length; of other encoders they are in it.
        """
        if not isinstance(self.tactile, GelEncoder):
            return rows
        with torch.no_grad():
            return self.tactile.shared(torch.from_numpy(rows).to(self.device)).cpu().numpy()

    @property
    def device(self) -> torch.device:
        """Where the encoders are."""
        return next(p for module in self._modules().values() for p in module.parameters()).device

    def to(self, device: str | torch.device) -> EncoderSet:
        """Move all encoders; returns self."""
        for module in self._modules().values():
            module.to(pick_device(device))
        return self

    def preprocess(self, modality: str) -> Preprocess:
        """The preprocessing of ``vision`` or ``tactile``.

        Raises:
            PalpateError: for another modality, or if there is no such encoder.
        """
        must, fix = "must be vision or tactile for images", "Pass texts to the text encoder"
        require(modality in ("vision", "tactile"), "modality", must, f"{modality!r}", fix=fix)
        self._require(modality)
        return self.preprocesses[modality]

    def encode(
        self, modality: str, batch: Tensor | Sequence[str], sensors: Sequence[str] | None = None
    ) -> Tensor:
        """One batch to (n, dim), projected and L2-normalized, by a ruler to its standardized
        numbers; differentiable.

        Args:
            modality: ``vision``, ``text`` or ``tactile``.
            batch: preprocessed pixels (n, 3, size, size) on the encoders' device, or texts.
            sensors: names of the sensors (n), for tactile encoders that take them.
        """
        self._require(modality)
        if modality == "text":
            return encode_text(self.clip, self.tokenizer, [str(text) for text in batch])
        pixels = torch.as_tensor(batch)
        if modality == "vision":
            return encode_vision(self.clip, pixels)
        if isinstance(self.tactile, TactileModule):
            names = [self.sensor] * len(pixels) if self.sensor else sensors
            return self.tactile.encode(pixels, names)
        assert self.tactile is not None
        return encode_tactile(self.tactile, pixels)

    def patches(self, pixels: Tensor, count: int) -> Tensor:
        """States of photos' patches in the last layer, before the projection.

        Args:
            pixels: preprocessed (n, 3, size, size).
            count: a square number; the patches are averaged to so many.

        Returns:
            (n, count, width); what others put before the patches (CLS) is left out.
        """
        vision: Any = getattr(self.clip, "vision_model", self.clip)
        output = vision(**_inputs(self.clip, pixels))
        grid = pixels.shape[2] // int(vision.config.patch_size)
        states = output.last_hidden_state[:, -(grid**2) :].transpose(1, 2)
        states = states.unflatten(2, (grid, grid))
        return adaptive_avg_pool2d(states, math.isqrt(count)).flatten(2).transpose(1, 2)

    def length(self, text: str) -> tuple[int, int]:
        """Tokens of a text, marks of its ends included, and the most that the encoder takes."""
        with silent():  # the tokenizer warns of long texts, in its own words
            return len(self.tokenizer(text)["input_ids"]), _context(self.clip)

    def digest(self, modality: str) -> str:
        """SHA-256 of one encoder: weights, architecture, preprocessing (of text: the tokenizer)."""
        self._require(modality)
        facts: dict[str, Any]
        if modality == "tactile":
            assert self.tactile is not None
            config, parts = getattr(self.tactile, "config", {}), {"encoder": self.tactile}
            facts = {"sensor": self.sensor}
        else:
            config = getattr(self.clip.config, f"{modality}_config", self.clip.config)
            parts = {"encoder": getattr(self.clip, f"{modality}_model", self.clip)}
            facts = {"family": family_of(self.clip)}
            if facts["family"] == "clip":
                name = {"vision": "visual", "text": "text"}[modality]
                parts["projection"] = getattr(self.clip, f"{name}_projection")
        if modality == "text":
            facts["tokenizer"] = _tokenizer_digest(self.tokenizer)
        else:
            facts["preprocess"] = asdict(self.preprocesses[modality])
        return digest_modules(parts, facts | architecture(config))

    # --- what the encoders were trained on -------------------------------------------------------

    def knows_seen(self, modality: str) -> bool:
        """Whether all images are known that one encoder was trained on; else some, or none."""
        card = self.clip_card if modality == "vision" else self.card
        return self.seen.get(modality) is not None and not card.get("seen_in_part")

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
        digests, seen = self.seen.get(modality), np.zeros(len(images), bool)
        if digests is None or not len(digests):
            return seen
        preprocess = self.preprocess(modality).plainly
        alone = isinstance(images, Sequence)
        frames = Frames.alone(images) if alone else preprocess.frames(images, modality)
        for start in range(0, len(seen), batch):
            rows = slice(start, start + batch)
            seen[rows] = np.isin(
                digest_images(load_images(frames.files[rows], preprocess)), digests
            )
            progress("looking for known images", min(start + batch, len(seen)), len(seen))
        return seen

    def origin(self, modality: str) -> Origin | None:
        """What is known of an encoder that others trained; None of palpate's and one's own."""
        self._require(modality)
        if modality == "tactile":
            public = self.tactile if isinstance(self.tactile, TactileModule) else None
            return None if public is None or isinstance(public, RULERS) else public.format
        if "trained_on" not in self.clip_card:
            return None
        return Origin(self.name, self.clip_card["license"], tuple(self.clip_card["trained_on"]))

    # --- joining, saving, loading ----------------------------------------------------------------

    def without_tactile(self) -> EncoderSet:
        """The same vision and text encoders alone."""
        return replace(
            self,
            tactile=None,
            preprocesses={"vision": self.preprocess("vision")},
            card={},
            seen={"vision": self.seen.get("vision")},
            sensor=None,
        )

    def with_tactile(self, other: EncoderSet) -> EncoderSet:
        """These vision and text encoders with another set's tactile encoder, trained for them.

        Raises:
            PalpateError: if the widths of the spaces differ.
        """
        widths = other.shared_width, self.width("vision")
        require(
            widths[0] == widths[1],
            None,
            "Encoders of one space must have one width",
            " and ".join(map(str, widths)),
            fix="Join an encoder with the CLIP that it was trained with",
        )
        return replace(
            self,
            tactile=other.tactile,
            preprocesses={**self.preprocesses, "tactile": other.preprocess("tactile")},
            card=other.card,
            seen={**self.seen, "tactile": other.seen.get("tactile")},
            sensor=other.sensor,
        ).to(self.device)

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
        must, fix = "Encoders to be saved must be palpate's own", "Name the public one's file"
        public = isinstance(self.tactile, TactileModule) and not isinstance(
            self.tactile, GelEncoder
        )
        require(not public, None, must, "a public tactile encoder", fix=fix)
        with atomic_folder(Path(folder)) as part:
            if half:
                self.halve()
            pair = [m for m in self.modalities if m != "tactile"]
            if pair:
                self._write(part / "clip", self.clip, "vision", half)
                about = {"format": CLIP_FORMAT, "name": self.name}
                about |= self._about(pair, self.clip_card, "vision")
                write_json(part / "clip" / "palpate.json", about)
            if self.tokenizer is not None:
                from palpate.encoders.tokenizer import save_tokenizer

                with silent():
                    save_tokenizer(self.tokenizer, part / "clip")
            if self.tactile is not None:
                self._write(part / "tactile", self.tactile, "tactile", half)
            about = {"format": FORMAT, **self._about(self.modalities, self.card, "tactile")}
            write_json(part / "palpate.json", about)
            write_model_cards(part)

    @classmethod
    def load(cls, source: str | Path, *, device: str = "cpu", alone: bool = False) -> EncoderSet:
        """Load encoders of any kind: palpate's, a CLIP, SigLIP or DINO, a public tactile encoder.

        What :meth:`save` wrote is compared with its digests.

        Args:
            source: a shipped name (``palpate/mini``); a folder of palpate or transformers, or its
                hub id; a file of a public tactile encoder (:mod:`palpate.encoders.tactile`),
                ``owner/name:file`` for one on the hub, ``file#digit`` to name the sensor of all
                images; or ``tactile+clip``, two of these that share a space.
            device: see :func:`palpate.encoders.models.pick_device`.
            alone: leave out the vision and text that a tactile encoder was trained with.

        Raises:
            PalpateError: if the folder is of another kind, incomplete, or changed since, or the hub
                is out of reach.
        """
        if len(parts := parts_of(source)) == 2:
            tactile = cls.load(parts[0], device=device)
            return tactile if alone else cls.load(parts[1], device=device).with_tactile(tactile)
        folder, sensor = find_encoder(source)
        if folder.is_file():
            public = load_tactile(folder)
            must = (
                f"The ruler {folder} must be named by its set, which knows what it was trained on"
            )
            bare = isinstance(public, GelEncoder)
            require(not bare, None, must, "its weights", fix=f"Pass {folder.parent.parent}")
            card = {"name": str(source), "license": public.format.license}
            shape = {"tactile": public.preprocess}
            seen: dict[str, Digests | None] = {}
            if isinstance(public, Handcrafted):  # it saw no image
                seen["tactile"] = union()
            return cls(None, None, public, shape, "", {}, card, seen, sensor).to(device)
        note = folder / "palpate.json"
        if not note.is_file() or read_record(note, "card").get("format") == CLIP_FORMAT:
            return load_clip(source, device=device)
        about = _read_card(folder, FORMAT)
        # A shipped CLIP keeps its name, so that cards of what is trained with it say so.
        touch = "tactile" in about["digests"]
        pair = len(about["digests"]) > touch and not (touch and alone)
        encoders = load_clip(source if is_shipped(source) else folder / "clip") if pair else cls()
        encoders.card = about["card"]
        if touch:
            part = folder / "tactile"
            encoders.tactile, encoders.preprocesses["tactile"] = _load_trained(part)
            encoders.seen["tactile"] = load_seen(part, about["seen"].get("tactile"))
        loaded = {m: d for m, d in about["digests"].items() if m == "tactile" or pair}
        _require_digests(encoders, loaded, folder)
        return encoders.to(device)

    def _modules(self) -> dict[str, nn.Module]:
        modules = {"clip": self.clip, "tactile": self.tactile}
        return {name: module for name, module in modules.items() if module is not None}

    def _require(self, modality: str) -> None:
        require(
            modality in self.modalities,
            None,
            f"These encoders must include a {modality} encoder",
            f"{' and '.join(self.modalities)} only",
            fix="Use others, or train one: palpate.train_encoder",
        )

    def _write(self, folder: Path, model: nn.Module, modality: str, half: bool) -> None:
        """Write a model of images, how they are prepared, and which it was trained on."""
        if isinstance(model, GelEncoder):
            model.save(folder, half=half)
        else:
            save_model(model, folder, half=half)
            config = self.preprocesses[modality].to_config()
            write_json(folder / "preprocessor_config.json", config)
        save_seen(self.seen.get(modality), folder)

    def _about(
        self, modalities: Sequence[str], card: Mapping[str, Any], seen: str
    ) -> dict[str, Any]:
        """What ``palpate.json`` says of encoders; ``seen``: whose images it counts."""
        digests = self.seen.get(seen)
        return {
            "digests": {modality: self.digest(modality) for modality in modalities},
            "card": card,
            **({} if digests is None else {"seen": {seen: len(digests)}}),
        }


def _load_trained(folder: Path) -> tuple[Any, Preprocess]:
    """A tactile encoder of :meth:`EncoderSet.save`, and how its images are prepared."""
    if not (folder / "config.json").is_file() and (folder / WEIGHTS).is_file():
        ruler = load_tactile(folder / WEIGHTS)
        return ruler, ruler.preprocess
    from transformers import CLIPVisionModelWithProjection as Vit

    must = f"The tactile encoder {folder} must hold config.json and {WEIGHTS}"
    model = load_model(
        Vit, str(folder), must, SAVE_AGAIN, local_files_only=True, use_safetensors=True
    )
    size, path = int(model.config.image_size), folder / "preprocessor_config.json"
    return model, Preprocess.from_config(path, size)


def load_clip(source: str | Path, *, device: str = "cpu") -> EncoderSet:
    """Load a frozen CLIP, SigLIP or DINO; only one from the hub needs a network, once.

    Args:
        source: a shipped name (``palpate/mini``), a folder of transformers, a set of encoders,
            whose tactile encoder is left out, or a hub id (``openai/clip-vit-large-patch14``).
            safetensors is preferred; a ``.bin`` is read as weights only.
        device: see :func:`palpate.encoders.models.pick_device`.

    Raises:
        PalpateError: if files are missing, unreadable, of another model or changed since, or the
            hub is out of reach.
    """
    name, folder = find_single(source, "clip", "CLIP", CLIP_FIX)
    local, must = name == str(folder), f"{source} must be a CLIP model"
    note, config = folder / "palpate.json", folder / "config.json"
    if note.is_file() and read_record(note, "card of the CLIP").get("format") == FORMAT:
        return EncoderSet.load(source, device=device).without_tactile()
    family = read_record(config, "model").get("model_type") if config.is_file() else "clip"
    require(
        isinstance(family, str) and family in FAMILIES,
        None,
        f"{source} must be one of {', '.join(FAMILIES)}",
        f"model_type {family!r} in {config}",
        fix=CLIP_FIX,
    )
    kind, reader = Clip, ClipTokenizer
    if not (family == "clip" and local and note.is_file()):  # else as palpate writes it
        from transformers import AutoModel, AutoTokenizer, CLIPModel

        kind, reader = CLIPModel if family == "clip" else AutoModel, AutoTokenizer
    model = load_model(kind, name, must, CLIP_FIX, local_files_only=local)
    tokenizer: Any = None
    try:
        with silent():
            if FAMILIES[str(family)]:
                tokenizer = reader.from_pretrained(name, local_files_only=local)
    except Exception as error:  # tokenizers raises bare ones
        raise PalpateError(must, first_line(error), CLIP_FIX) from None
    sized = family in ("clip", "siglip")  # the others take images of any size
    size = int(model.config.vision_config.image_size) if sized else None
    preprocess = Preprocess.from_config(folder / "preprocessor_config.json", size)
    encoders = EncoderSet(model, tokenizer, preprocesses={"vision": preprocess}, name=str(source))
    if not note.is_file():
        encoders.clip_card = stated(folder)
        return encoders.to(device)
    about = _read_card(folder, CLIP_FORMAT)
    encoders.clip_card = about["card"]
    encoders.name = encoders.name if is_shipped(source) else str(about["name"])
    encoders.seen["vision"] = load_seen(folder, about["seen"].get("vision"))
    _require_digests(encoders, about["digests"], folder)
    return encoders.to(device)


def new_tactile(config: CLIPVisionConfig, seed: int) -> CLIPVisionModelWithProjection:
    """A tactile encoder with random weights that depend on ``seed`` alone."""
    from transformers import CLIPVisionModelWithProjection

    with seeded(seed, "tactile encoder"):
        return CLIPVisionModelWithProjection(config)


def encode_tactile(tactile: nn.Module, pixels: Tensor) -> Tensor:
    """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalized; differentiable."""
    return normalize(tactile(pixel_values=pixels).image_embeds, dim=-1)


def family_of(model: Any) -> str:
    """The kind of a model of vision in transformers, a key of :data:`FAMILIES`."""
    return str(model.config.model_type)


def _context(model: Any) -> int:
    """The most tokens of a text that a model takes, marks of its ends included."""
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
        max_length=_context(model),
        padding=True if masked else "max_length",
    )
    names = ("input_ids", "attention_mask") if masked else ("input_ids",)
    return {name: encoded[name].to(model.device) for name in names}


def encode_text(model: Any, tokenizer: Any, texts: Sequence[str]) -> Tensor:
    """Texts to (n, dim), L2-normalized; differentiable."""
    return normalize(_projected(model.get_text_features(**tokens(model, tokenizer, texts))), dim=-1)


def encode_vision(model: Any, pixels: Tensor) -> Tensor:
    """Preprocessed pixels (n, 3, size, size) to (n, dim), L2-normalized; differentiable.

    Of a DINO, which has no projection, its class token.
    """
    return normalize(vision_state(model, pixels), dim=-1)


def vision_state(model: Any, pixels: Tensor) -> Tensor:
    """As :func:`encode_vision`, of whatever length."""
    encode = getattr(model, "get_image_features", model)
    return _projected(encode(**_inputs(model, pixels)))


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


def _tokenizer_digest(tokenizer: Any) -> str:
    """SHA-256 of all that a tokenizer does to a text."""
    backend = getattr(tokenizer, "backend_tokenizer", None)
    if backend is None:  # a slow tokenizer of transformers 4
        return digest_json(tokenizer.get_vocab())
    # Truncation and padding are state of the last call, not of the tokenizer.
    table = json.loads(backend.to_str())
    return digest_json({k: v for k, v in table.items() if k not in ("truncation", "padding")})


def _read_card(folder: Path, form: str) -> dict[str, Any]:
    path = folder / "palpate.json"
    about = read_record(path, "card of the encoders", form=form, keys=("digests", "card"))
    digests, card, seen = about["digests"], about["card"], about.setdefault("seen", {})
    tables = all(isinstance(part, dict) for part in (digests, card, seen))
    require(
        tables and all(type(count) is int for count in seen.values()),
        None,
        f"digests, card and seen in {path} must be as palpate writes them",
        "other values",
        fix=FETCH_AGAIN,
    )
    return about


def _require_digests(encoders: EncoderSet, digests: Mapping[str, str], folder: Path) -> None:
    for modality, digest in digests.items():
        must = f"The {modality} encoder in {folder} must match its digest"
        got = "weights or settings that were changed"
        require(encoders.digest(modality) == digest, None, must, got, fix=SAVE_AGAIN)
