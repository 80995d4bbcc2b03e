"""Models on disk: found by name, loaded whole, saved plainly, named by a digest.

A name is a shipped model, a local folder, or a Hugging Face hub id, in that order: a *string* that
begins with ``palpate/`` is a shipped name, whatever lies in the working directory; a folder
``palpate/mini`` is named ``./palpate/mini``, or passed as a :class:`pathlib.Path`, which is always
a folder. From the hub only JSON, text and safetensors are fetched, once. Shipped models are in the
package, and no network is used::

    palpate/mini/encoders/      vision, text and tactile; clip/ in it is a plain CLIP folder
    palpate/mini/autoencoder/   autoencoder of tactile images
    palpate/mini/generator/     photo to tactile image; refers to the other two by name and digest

Weights may be saved in 16 bits. They are rounded in the model first, so that what is scored and
digested is what is written: IEEE 754 half precision has 11 significant bits, so a weight of normal
size changes by at most 2^-11 = 4.9e-4 of itself; from 65,520 on there is only infinity. Everything
is computed in 32 bits.

The images that a model was trained on are known by their prepared 8-bit pixels: a digest is the
first eight bytes of their SHA-256. Names play no part, as two data sets may both have a
``0001.jpg``. 100,000 digests take 800 kB; that any of 100,000 other images has one of them by
chance has the probability 100,000^2 / 2^64 = 5e-10. The guard lets no encoder judge images that it
was trained on.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import json
import pickle
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from palpate.core import PalpateError, content_of, require, require_regular
from palpate.core.files import canonical_json
from palpate.core.hub import HUB_ID, fetch

if TYPE_CHECKING:  # names are checked before torch is imported, which takes seconds
    import torch
    from torch import Tensor, nn


Part = Literal["clip", "encoders", "autoencoder", "generator"]
#: The shipped names, and the folder of each in :func:`shipped_root`.
SHIPPED = {"palpate/mini": "mini"}
#: Rulers, and the file of each.
RULERS = {"palpate/handcrafted": "mini/rulers/handcrafted.safetensors"}
#: Where the parts are in the folder of a name.
PARTS: dict[Part, str] = {
    "clip": "encoders/clip",
    "encoders": "encoders",
    "autoencoder": "autoencoder",
    "generator": "generator",
}
PREFIX = "palpate/"
FIX_MODEL = "Make one with: palpate train generator"
FIX_ENCODERS = "Train one with: palpate train encoder"
FETCH_AGAIN = "Fetch the encoder again"
#: Digests of images, (n,) uint64.
Digests = NDArray[np.uint64]
#: Their file in the folder of an encoder.
SEEN = "seen.safetensors"
#: Raised for an unreachable hub, absent files, foreign formats and pickled objects.
UNREADABLE = (
    OSError,
    ValueError,
    RuntimeError,
    KeyError,
    TypeError,
    AttributeError,
    SafetensorError,
    pickle.UnpicklingError,
)
#: What palpate's saved folders hold, and the small files of a single model.
PATTERNS = ("*.json", "*.txt", "*.md", "*.safetensors", "gel.png")
SMALL_FILES = ("README.md", "config.json", "palpate.json", "preprocessor_config.json")
#: What was got instead of weights, and the fix.
POINTER = ("a pointer of Git LFS without the weights", "Fetch them: git lfs pull")
#: Settings of a transformers or diffusers model that decide what it computes; others name files or
#: versions.
ARCHITECTURE = """
    hidden_size intermediate_size num_hidden_layers num_attention_heads image_size patch_size
    num_channels vocab_size max_position_embeddings eos_token_id projection_dim hidden_act
    layer_norm_eps num_register_tokens layerscale_value use_swiglu_ffn mlp_ratio qkv_bias

    act_fn attention_head_dim block_out_channels class_embed_type cross_attention_dim
    down_block_types downsample_padding flip_sin_to_cos freq_shift in_channels latent_channels
    layers_per_block lookup_from_codebook mid_block_add_attention mid_block_scale_factor
    mid_block_type norm_eps norm_num_groups norm_type num_vq_embeddings only_cross_attention
    out_channels resnet_time_scale_shift scaling_factor shift_factor time_embedding_type
    timestep_post_act transformer_layers_per_block up_block_types use_linear_projection vq_embed_dim
""".split()  # noqa: SIM905 - readable as a list of words


@dataclass(frozen=True)
class Origin:
    """What is known of an encoder that others trained.

    Attributes:
        name: of the encoder.
        license: of its weights; ``unknown`` without a word on it.
        trained_on: data sets whose images it has seen, by its authors.
    """

    name: str
    license: str
    trained_on: tuple[str, ...]


def shipped_root() -> Path:
    """The folder of the installed package, which holds the folders of :data:`SHIPPED`."""
    return Path(__file__).resolve().parents[1]


def is_shipped(name: object) -> bool:
    """Whether ``name`` refers to a shipped model, known or not."""
    return isinstance(name, str) and name.startswith(PREFIX)


def shipped_folder(name: str | Path, part: Part) -> Path | None:
    """The folder of one part of a shipped model, or None where ``name`` is no shipped name.

    Raises:
        PalpateError: for an unknown name that begins with ``palpate/``, or if the files are absent.
    """
    if not is_shipped(name):
        return None
    names = (*SHIPPED, *(RULERS if part == "encoders" else ()))
    must = f"A name that begins with {PREFIX} must be one of {', '.join(names)}"
    fix = f"Choose one of these; a folder of that name is written ./{name}"
    require(name in SHIPPED, None, must, f"{name!r}", fix=fix)
    folder = shipped_root() / SHIPPED[str(name)] / PARTS[part]
    must, got = f"{name} must lie in the installed package", f"no {part} in {shipped_root()}"
    installed = (folder / "palpate.json").is_file()
    require(installed, None, must, got, fix="Install palpate again, from its wheel")
    return folder


def is_hub_id(name: str | Path) -> bool:
    """Whether ``name`` is a hub id: a string ``owner/name`` or ``owner/name@revision``, not shipped
    and no folder here.
    """
    if not isinstance(name, str) or is_shipped(name):
        return False
    return bool(HUB_ID.fullmatch(name)) and not Path(name).is_dir()


def find_model(
    source: str | Path, part: Part, role: str, fix: str, files: Sequence[str] = PATTERNS
) -> Path:
    """The local folder of a saved model, fetched from the hub where needed.

    Args:
        source: a shipped name, a folder, or a hub id; a :class:`~pathlib.Path` is always a folder.
        part: which part of a shipped model.
        role: of the model, for the error (``"pipeline"``).
        fix: how to get one, for the error.
        files: patterns of what is fetched.

    Raises:
        PalpateError: for an unknown shipped name, a missing folder, or a hub out of reach.
    """
    if (shipped := shipped_folder(source, part)) is not None:
        return shipped
    if is_hub_id(source):
        return _of_size(fetch(str(source), files, role, fix))
    must = f"The {role} must be a folder, one of {', '.join(SHIPPED)}, or a hub id (owner/name)"
    found = str(source) != "" and Path(source).is_dir()
    require(found, None, must, f"no folder {source or repr('')}", fix=fix)
    return _of_size(Path(source))


def _of_size(folder: Path) -> Path:
    """The folder, whose texts other libraries read at once; PalpateError where one is too large."""
    for path in (*folder.glob("*"), *folder.glob("*/*")):
        if path.suffix in (".json", ".txt") and path.is_file():
            content_of(path)
    return folder


def parts_of(source: str | Path) -> list[str | Path]:
    """The sources of ``tactile.pth+clip``: a tactile encoder, and the CLIP of its space."""
    parts = str(source).split("+")
    return [source] if len(parts) != 2 or Path(source).exists() else [*parts]


def find_encoder(source: str | Path) -> tuple[Path, str | None]:
    """The local folder or file of an encoder of any kind, and the sensor that its name gives.

    Args:
        source: a shipped name, a folder, a file of weights, a hub id, or ``owner/name:file`` for
            one file of a hub id; behind a file ``#digit`` names the sensor of all images.

    Raises:
        PalpateError: if there is none of that name, a folder holds none, or the hub is out of
            reach.
    """
    if is_shipped(source) and source in RULERS:
        return shipped_root() / RULERS[str(source)], None
    name, _, sensor = str(source).partition("#")
    owner, colon, file = name.partition(":")
    if str(source) and Path(source).exists() and not is_shipped(source):
        path, sensor = Path(source), ""
    elif colon and is_hub_id(owner):
        path = fetch(owner, [file], "encoder", FIX_ENCODERS) / file
    elif Path(name).is_file():
        path = Path(name)
    else:
        path = Path(name) if isinstance(source, Path) else name
        path = find_model(path, "encoders", "encoder", FIX_ENCODERS)
    if path.is_dir() and not any((path / f).is_file() for f in ("palpate.json", "config.json")):
        files = sorted(path.glob("*.safetensors")) or sorted(path.glob("*.pth"))
        must = f"The folder {path} must hold a set of encoders, a CLIP, or one file of weights"
        got, fix = ", ".join(p.name for p in files), "Pass the file" if files else FIX_ENCODERS
        require(len(files) == 1, None, must, got or "none of these", fix=fix)
        path = files[0]
    return _of_size(path) if path.is_dir() else path, sensor.lower() or None


def find_single(
    source: str | Path, part: Part, role: str, fix: str, within: Sequence[str] = ()
) -> tuple[str, Path]:
    """Return what ``from_pretrained`` takes, and the local folder of the small files.

    Those of the subfolders ``within`` are fetched from the hub as well.
    """
    # Small files first: a hub out of reach is queried once, not many times.
    files = (*SMALL_FILES, *(f"{folder}/*.json" for folder in within))
    whole = "@" in str(source)  # a revision: all of it lies in a folder of its own
    folder = find_model(source, part, role, fix, PATTERNS if whole else files)
    return str(source if is_hub_id(source) and not whole else folder), folder


def stated(folder: Path) -> dict[str, Any]:
    """License and data sets of a model of others, by the head of its card (``README.md``)."""
    from huggingface_hub.repocard import metadata_load

    try:
        head = metadata_load(folder / "README.md") or {}
    except Exception:  # no card, or one of broken YAML: neither keeps a model from its use
        head = {}
    terms, sets = head.get("license_name") or head.get("license"), head.get("datasets") or []
    terms, sets = (v if isinstance(v, list) else [v] for v in (terms or "unknown", sets))
    return {"license": ", ".join(map(str, terms)), "trained_on": [str(v) for v in sets if v]}


def first_line(error: Exception) -> str:
    """The first line of an error, or its kind if it has none.

    Not of torch's on a pickle, which recommends to load it all the same.
    """
    if "weights_only" in str(error) or isinstance(error, pickle.UnpicklingError):
        return "a pickle that holds more than weights, which could run any program"
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def read_weights(path: Path, fix: str) -> dict[str, Tensor]:
    """All tensors of a file, by name; those under ``model`` or ``state_dict`` if it nests them.

    Raises:
        PalpateError: if it is unreadable, or holds more than weights.
    """
    import torch
    from safetensors import torch as safetensors_torch

    require_regular(path)
    must = f"{path} must hold weights and nothing else"
    if is_pointer(path):
        raise PalpateError(must, *POINTER)
    # TVL keeps its options so; latent diffusion names the class of a callback, which stays unused.
    callback = "pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint"
    safe: list[Any] = [argparse.Namespace, (argparse.Namespace, callback)]
    try:
        if path.suffix == ".safetensors":
            return safetensors_torch.load_file(path)
        with path.open("rb") as file:
            head = file.read(2)
        if head != b"PK" and not head.startswith(b"\x80"):  # neither torch's archive nor a pickle
            raise ValueError("a file of another kind")
        with torch.serialization.safe_globals(safe):
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=is_zipfile(path))
    except Exception as error:  # of a damaged file torch raises many kinds
        raise PalpateError(must, first_line(error)[:160], fix) from None
    for key in ("model", "state_dict"):
        content = content.get(key, content) if isinstance(content, Mapping) else content
    require(isinstance(content, Mapping), None, must, type(content).__name__, fix=fix)
    return {str(name): value for name, value in content.items() if hasattr(value, "shape")}


def is_pointer(path: Path) -> bool:
    """Whether a file is the pointer of Git LFS to one that was not fetched."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(64).startswith(b"version https://git-lfs")


def load_model(
    kind: Any, name: str, must: str, fix: str, *, strict: bool = False, **options: Any
) -> Any:
    """``kind.from_pretrained(name)`` in float32, for evaluation, without gradients.

    Raises:
        PalpateError: ``must``, if files are absent, unreadable, or lack weights, which transformers
            would draw at random; with ``strict`` also for weights that the model has not.
    """
    try:
        with silent():
            model, report = kind.from_pretrained(name, output_loading_info=True, **options)
    except Exception as error:  # the libraries raise many kinds
        if any(map(is_pointer, Path(name, options.get("subfolder") or "").glob("*"))):
            raise PalpateError(must, *POINTER) from None
        raise PalpateError(must, first_line(error), fix) from None
    missing, extra = (sorted(report[f"{kind}_keys"]) for kind in ("missing", "unexpected"))
    got = f"{len(missing)} weights are missing, first {''.join(missing[:1])}"
    require(not missing, None, must, got, fix=fix)
    got = f"{len(extra)} unknown weights, first {''.join(extra[:1])}"
    require(not (strict and extra), None, must, got, fix=fix)
    return model.float().eval().requires_grad_(False)


def save_model(model: Any, folder: Path, *, half: bool) -> None:
    """Call ``model.save_pretrained``, with ``half`` of a 16-bit copy of rounded weights.

    Two entries of ``config.json`` would make equal models differ: the path that the model was
    loaded from is removed, and ``dtype`` is that of the weights in this file in every part.
    """
    with silent():
        (copy.deepcopy(model).half() if half else model).save_pretrained(folder)
    path = Path(folder) / "config.json"
    config = json.loads(path.read_text(encoding="utf-8"))
    before = copy.deepcopy(config)
    config.pop("_name_or_path", None)
    if "dtype" in config:  # diffusers has none
        parts = (v for k, v in config.items() if k.endswith("_config") and isinstance(v, dict))
        for part in (config, *parts):
            part["dtype"] = "float16" if half else str(model.dtype).removeprefix("torch.")
    if config != before:
        path.write_text(json.dumps(config, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def round_to_half(modules: Mapping[str, nn.Module]) -> None:
    """Round the floating-point weights of modules to float16 values, in place; their type stays.

    Raises:
        PalpateError: if a weight is not finite in 16 bits; nothing is changed then.
    """
    states = {f"{part}.{k}": v for part, m in modules.items() for k, v in m.state_dict().items()}
    before = {name: value for name, value in states.items() if value.is_floating_point()}
    after = {name: value.half().to(value.dtype) for name, value in before.items()}
    for name, value in after.items():
        if not bool(value.isfinite().all()):
            got = f"{name} with values up to {float(before[name].abs().max()):.3g}"
            must = "Weights saved in 16 bits must be finite and below 65,520 in size"
            raise PalpateError(must, got, "Save them in 32 bits")
    for name, value in before.items():
        value.copy_(after[name])  # the tensors of state_dict are the module's, without gradients


def architecture(config: Any) -> dict[str, Any]:
    """Return the part of a model's configuration that belongs into a digest."""
    get = config.get if isinstance(config, Mapping) else lambda name: getattr(config, name, None)
    return {name: value for name in ARCHITECTURE if (value := get(name)) is not None}


def digest_tensors(tensors: Mapping[str, Tensor], facts: Mapping[str, Any] | None = None) -> str:
    """SHA-256 over facts (JSON) and names, types, shapes and values; the same on every device."""
    state = hashlib.sha256(canonical_json(dict(facts or {})).encode())
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().contiguous()
        state.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        state.update(value.numpy().tobytes())
    return state.hexdigest()


def digest_modules(modules: Mapping[str, nn.Module], facts: Mapping[str, Any]) -> str:
    """:func:`digest_tensors` of the weights of modules, as ``module.name``."""
    states = {part: module.state_dict() for part, module in modules.items()}
    return digest_tensors({f"{p}.{k}": v for p, s in states.items() for k, v in s.items()}, facts)


def pick_device(device: str | torch.device) -> torch.device:
    """``auto`` is CUDA, else Apple's MPS, else the CPU; any other name is torch's.

    Raises:
        PalpateError: for a name that torch does not know or a device that is absent.
    """
    import torch

    there = torch.cuda.is_available(), torch.backends.mps.is_available(), True
    devices = [*compress(("cuda", "mps", "cpu"), there)]
    if device == "auto":
        device = devices[0]
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        must = "must be auto, cpu, or a device of this machine"
        fix = f"This machine has: auto, {', '.join(devices)}"
        got = f"{str(device)!r}: {first_line(error)}"
        raise PalpateError(must, got, fix, argument="device") from None
    return torch.device(device)


@contextmanager
def silent() -> Generator[None]:
    """No load reports or progress bars of transformers inside; its settings are restored."""
    if "transformers" not in sys.modules:  # which takes seconds to import
        yield
        return
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def to_unit(
    images: NDArray[np.uint8], device: torch.device | str = "cpu", *, signed: bool = False
) -> Tensor:
    """8-bit images (b, h, w, c) as float32 (b, c, h, w) in [0, 1], or in [-1, 1] if ``signed``."""
    import torch

    # np.array copies: a mapped cache is read-only, which torch warns about.
    pixels = torch.from_numpy(np.array(images)).to(device).permute(0, 3, 1, 2).float()
    return pixels / 127.5 - 1 if signed else pixels / 255


def digest_images(images: NDArray[np.uint8]) -> Digests:
    """Digests (n,) of images (n, h, w, c) in memory or in a mapped file, in their order."""
    names = (hashlib.sha256(image.tobytes()).digest()[:8] for image in images)
    return np.frombuffer(b"".join(names), np.uint64)


def union(*sets: Digests | None) -> Digests:
    """The sorted distinct digests of several sets; None is an empty one."""
    return np.unique(np.concatenate([np.empty(0, np.uint64), *(s for s in sets if s is not None)]))


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
        raise PalpateError(must, str(error), FETCH_AGAIN) from None
    complete = len(seen) == count and seen.dtype == np.uint64
    require(complete, None, must, f"{len(seen):,}", fix=FETCH_AGAIN)
    return seen
