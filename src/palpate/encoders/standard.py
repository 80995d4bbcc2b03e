"""The encoders that published scores of images were taken with: Inception for FID and KID, CLIP for CMMD. Weights are files of one's own.

* ``inception``: a TorchScript module that maps 8-bit images (n, 3, h, w), 0 to 255, to features (n, d). The widely used one is
  ``inception-2015-12-05.pt``: it resizes to 299 px itself (bilinear, as TensorFlow did in 2015) and gives the 2048 pool features when
  called with ``return_features=True``; that keyword is passed wherever the module's ``forward`` names it.
* ``clip``: the vision encoder of a CLIP, projected and L2-normalized. CMMD (arXiv 2401.09603) takes ``openai/clip-vit-large-patch14-336``:
  the center square of an image, resized by the antialiased bicubic filter to 336 px.

The digest names what computed the features: of a TorchScript module the SHA-256 of its file, of a CLIP that of weights, architecture and
preprocessing, equal to :meth:`palpate.encoders.encoder_set.ClipEncoders.digest` of the same encoder.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor
from transformers import CLIPConfig, CLIPVisionConfig, CLIPVisionModelWithProjection
from transformers.utils.hub import cached_file

from palpate.core import (
    PalpateError,
    Progress,
    digest_file,
    digest_json,
    quiet,
    read_record,
    reading_entry,
)
from palpate.core.shipped import is_hub_id, shipped_folder
from palpate.encoders.embed import _exact  # pyright: ignore[reportPrivateUsage]
from palpate.encoders.encoder_set import CLIP_FILES, pick_device
from palpate.encoders.hub import fetch
from palpate.encoders.preprocess import Preprocess, to_unit
from palpate.encoders.weights import UNREADABLE, architecture, digest_modules, load_weights, silent

Kind = Literal["inception", "clip"]
KINDS: tuple[Kind, ...] = get_args(Kind)
INCEPTION_FILE = "inception-2015-12-05.pt"
INCEPTION_FIX = (
    f"Fetch {INCEPTION_FILE} (about 96 MB) from https://nvlabs-fi-cdn.nvidia.com/stylegan2-ada-pytorch/pretrained/metrics/{INCEPTION_FILE} "
    "and pass its path"
)
CLIP_NAME = "openai/clip-vit-large-patch14-336"
CLIP_FIX = f"Fetch one with: hf download {CLIP_NAME} --local-dir clip-336, and pass that folder"
#: What a folder must hold for its vision encoder alone; no tokenizer.
VISION_FILES = {name: choices for name, choices in CLIP_FILES.items() if "tokenizer" not in name}


@dataclass(frozen=True)
class StandardEncoder:
    """An encoder of images that is not ours.

    Attributes:
        kind: ``inception`` or ``clip``.
        digest: SHA-256; see the head of this file.
        size: side in pixels that images are brought to before ``forward``, or None where the module takes any size.
        forward: 8-bit images (b, h, w, 3) to features (b, d), float32.
    """

    kind: Kind
    digest: str
    size: int | None
    forward: Callable[[NDArray[np.uint8]], Tensor]

    def embed(
        self, images: NDArray[np.uint8], *, batch: int = 64, progress: Progress = quiet
    ) -> NDArray[np.float32]:
        """Features of images in memory or in a mapped file.

        Args:
            images: (n, h, w, 3), 0 to 255, n >= 1.
            batch: images at a time.
            progress: told how many images are done.

        Returns:
            (n, d) float32; of CLIP with rows of norm 1.

        Raises:
            PalpateError: if the array is not 8-bit RGB or empty, or features come out in another form or not finite (images are named).
        """
        if (
            images.dtype != np.uint8
            or images.ndim != 4
            or images.shape[3] != 3
            or 0 in images.shape
        ):
            got = f"{images.dtype} of shape {images.shape}"
            raise PalpateError(
                "Images must be uint8 of shape (n, h, w, 3), n >= 1",
                got,
                "Scale to 0..255, round and clip",
            )
        if batch < 1:
            raise PalpateError("--batch must be at least 1", str(batch), "Pass e.g. --batch 64")
        out: list[NDArray[np.float32]] = []
        with _exact():
            for start in range(0, len(images), batch):
                out.append(self.forward(images[start : start + batch]).float().cpu().numpy())
                progress(
                    f"embedding with {self.kind}", min(start + batch, len(images)), len(images)
                )
        features = np.concatenate(out)
        if (bad := np.flatnonzero(~np.isfinite(features).all(axis=1))).size:
            got = f"NaN or infinity for {bad.size} of {len(images)} images, first number {int(bad[0])}"
            raise PalpateError(
                f"The features of {self.kind} must be finite",
                got,
                "Check these images and the weights",
            )
        return features


def embed_standard(
    images: NDArray[np.uint8],
    source: str | Path,
    *,
    kind: Kind = "inception",
    sha256: str | None = None,
    batch: int = 64,
    device: str = "cpu",
    progress: Progress = quiet,
) -> tuple[NDArray[np.float32], str]:
    """Features of images by a standard encoder, and the encoder's digest: what a :class:`palpate.core.FeatureSet` needs.

    Args:
        images: (n, h, w, 3), 0 to 255.
        source: see :func:`load_standard`; to embed several sets, load once and call :meth:`StandardEncoder.embed`.
        kind: ``inception`` or ``clip``.
        sha256: see :func:`load_standard`.
        batch: images at a time.
        device: see :func:`palpate.encoders.encoder_set.pick_device`.
        progress: told how many images are done.

    Returns:
        Features (n, d) float32 and a digest of 64 hex digits.

    Raises:
        PalpateError: as :func:`load_standard` and :meth:`StandardEncoder.embed`.
    """
    encoder = load_standard(source, kind=kind, sha256=sha256, device=device)
    return encoder.embed(images, batch=batch, progress=progress), encoder.digest


def load_standard(
    source: str | Path, *, kind: Kind = "inception", sha256: str | None = None, device: str = "cpu"
) -> StandardEncoder:
    """Loads a standard encoder.

    **Whom to trust.** A TorchScript file is a program: loading it unpickles no Python object, but running it runs any torch operation that
    its author chose, with the rights of this process, through a parser that is not hardened against malice. Take such a file from its
    publisher alone, and pass ``sha256`` to have it compared with a digest that you know *before* it is opened. A CLIP is read from
    safetensors, or from a ``.bin`` as weights only.

    Args:
        source: for ``inception`` a TorchScript file; for ``clip`` a folder of transformers (a CLIPModel or a
            CLIPVisionModelWithProjection), a shipped name or a hub id.
        kind: ``inception`` or ``clip``.
        sha256: hex digest that the TorchScript file must have, or its first digits (at least 8).
        device: see :func:`palpate.encoders.encoder_set.pick_device`.

    Raises:
        PalpateError: for an unknown kind; if files are missing, unreadable, of another digest or another kind of model, saying which file
            and where to get it; or if the hub cannot be reached.
    """
    if kind not in KINDS:
        raise PalpateError(
            f"A standard encoder must be one of {', '.join(KINDS)}",
            repr(kind),
            "Choose one of these",
        )
    if kind == "clip":
        if sha256 is not None:
            raise PalpateError(
                "sha256 must go with a TorchScript file",
                "a CLIP",
                "Leave it out; a CLIP's weights hold no program",
            )
        return _load_clip(source, pick_device(device))
    return _load_script(Path(source), sha256, pick_device(device))


def _load_script(path: Path, sha256: str | None, device: torch.device) -> StandardEncoder:
    if not path.is_file():
        raise PalpateError(
            f"The Inception weights {path} must be a file", "no such file", INCEPTION_FIX
        )
    found = digest_file(path)
    if sha256 is not None and (len(sha256) < 8 or not found.startswith(sha256.lower())):
        raise PalpateError(
            f"The file {path} must have the SHA-256 {sha256}",
            found,
            "Fetch the file again, from its publisher",
        )
    try:
        with (
            warnings.catch_warnings()
        ):  # torch deprecates TorchScript; published weights will stay in it
            warnings.simplefilter("ignore", DeprecationWarning)
            module: Any = torch.jit.load(str(path), map_location=device)
        named = [argument.name for argument in module.forward.schema.arguments]
    except (RuntimeError, OSError, ValueError, AttributeError) as error:
        got = f"something else ({(str(error).strip().splitlines() or [type(error).__name__])[0][:120]}); pickles are never loaded"
        raise PalpateError(f"{path} must be a TorchScript module", got, INCEPTION_FIX) from None
    module.eval()
    keywords = {"return_features": True} if "return_features" in named else {}

    def forward(images: NDArray[np.uint8]) -> Tensor:
        pixels = torch.from_numpy(np.array(images)).to(device).permute(0, 3, 1, 2).contiguous()
        try:
            out = module(pixels, **keywords)
        except RuntimeError as error:
            reason = (str(error).strip().splitlines() or ["an error of torch"])[-1][:200]
            raise PalpateError(
                f"The module {path} must map uint8 images (n, 3, h, w) to features",
                reason,
                INCEPTION_FIX,
            ) from None
        if isinstance(out, Tensor) and out.ndim == 4 and out.shape[2:] == (1, 1):
            out = out.flatten(1)
        if (
            not isinstance(out, Tensor)
            or out.ndim != 2
            or len(out) != len(images)
            or not out.is_floating_point()
        ):
            got = (
                f"{out.dtype} of shape {tuple(out.shape)}"
                if isinstance(out, Tensor)
                else type(out).__name__
            )
            raise PalpateError(
                f"The module {path} must map {len(images)} images to floats ({len(images)}, d)",
                got,
                INCEPTION_FIX,
            )
        return out

    return StandardEncoder(
        "inception", digest_json({"kind": "torchscript", "file": found, **keywords}), None, forward
    )


def _load_clip(source: str | Path, device: torch.device) -> StandardEncoder:
    shipped = shipped_folder(source, "clip")
    folder, local = shipped or Path(source), not is_hub_id(source)
    name = str(folder) if local else str(source)
    if local:
        missing = [
            what
            for what, choices in VISION_FILES.items()
            if not any((folder / c).is_file() for c in choices)
        ]
        if missing:
            must = f"The CLIP folder {folder} must hold {', '.join(VISION_FILES)}"
            raise PalpateError(must, f"no {', no '.join(missing)}", CLIP_FIX)
    else:  # a small file first: out of reach, the hub is asked once instead of many times
        folder = fetch(name, ("config.json", "preprocessor_config.json"), "CLIP", CLIP_FIX)
    config = _vision_config(folder / "config.json")
    try:
        with silent():
            model = load_weights(
                CLIPVisionModelWithProjection, name, config=config, local_files_only=local
            )
            processor = Path(
                str(cached_file(name, "preprocessor_config.json", local_files_only=local))
            )
    except UNREADABLE as error:
        got = (str(error).splitlines() or [type(error).__name__])[0]
        raise PalpateError(f"{name} must be a CLIP with a vision encoder", got, CLIP_FIX) from None
    record = read_record(processor, "image processor")
    with reading_entry(processor, "An entry"):
        preprocess = Preprocess.from_config(record, int(config.image_size))
    model = model.float().eval().requires_grad_(False)
    parts = {"tower": model.vision_model, "projection": model.visual_projection}
    digest = digest_modules(parts, {"preprocess": asdict(preprocess), **architecture(config)})
    model.to(device)

    def forward(images: NDArray[np.uint8]) -> Tensor:
        pixels = preprocess.normalize(preprocess.crop(to_unit(preprocess.fit(images), device)))
        return F.normalize(model(pixel_values=pixels).image_embeds, dim=-1)

    return StandardEncoder("clip", digest, preprocess.size, forward)


def _vision_config(path: Path) -> Any:
    """The configuration of the vision encoder, from that of a whole CLIP or of the encoder alone."""
    config = read_record(path, "configuration of the CLIP")
    with reading_entry(path, "An entry"):
        if config.get("model_type") == "clip_vision_model":
            return CLIPVisionConfig(**config)
        if config.get("model_type") == "clip":
            whole: Any = CLIPConfig(**config)
            whole.vision_config.projection_dim = (
                whole.projection_dim
            )  # the encoder's own entry is often a default that nothing uses
            return whole.vision_config
    raise PalpateError(
        f"{path} must describe a CLIP", f"model_type {config.get('model_type')!r}", CLIP_FIX
    )
