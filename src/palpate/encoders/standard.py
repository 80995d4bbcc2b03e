"""The encoders of published scores: Inception for FID and KID, CLIP for CMMD.

* ``inception``: a TorchScript module that maps 8-bit images (n, 3, h, w), 0 to 255, to features (n,
  d). The widely used one is ``inception-2015-12-05.pt``: it resizes to 299 px itself (bilinear, as
  TensorFlow did in 2015) and gives the 2048 pool features when called with
  ``return_features=True``; that keyword is passed wherever the module's ``forward`` has it.
* ``clip``: the vision encoder of a CLIP, projected and L2-normalized. CMMD (arXiv 2401.09603) takes
  ``openai/clip-vit-large-patch14-336``: the center square, antialiased bicubic to 336 px.

The digest is the SHA-256 of a TorchScript file, or that of a CLIP's weights, architecture and
preprocessing, equal to :meth:`palpate.encoders.encoder_set.ClipEncoders.digest` of the same
encoder.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize
from transformers import CLIPConfig, CLIPVisionConfig, CLIPVisionModelWithProjection

from palpate.core import (
    PalpateError,
    Progress,
    digest_file,
    digest_json,
    quiet,
    read_record,
    require_choice,
)
from palpate.encoders.embed import exact, require_rgb
from palpate.encoders.encoder_set import CLIP_FILES, Preprocess, require_files, vision_digest
from palpate.encoders.models import find_single, first_line, load_model, pick_device
from palpate.encoders.preprocess import to_unit

Kind = Literal["inception", "clip"]
KINDS: tuple[Kind, ...] = get_args(Kind)
INCEPTION_FILE = "inception-2015-12-05.pt"
INCEPTION_URL = "https://nvlabs-fi-cdn.nvidia.com/stylegan2-ada-pytorch/pretrained/metrics"
INCEPTION_FIX = (
    f"Fetch {INCEPTION_FILE} (about 96 MB) from {INCEPTION_URL}/{INCEPTION_FILE} and pass its path"
)
CLIP_NAME = "openai/clip-vit-large-patch14-336"
CLIP_FIX = f"Fetch one with: hf download {CLIP_NAME} --local-dir clip-336, and pass that folder"
#: What a folder must hold for its vision encoder alone.
VISION_FILES = {name: files for name, files in CLIP_FILES.items() if "tokenizer" not in name}


@dataclass(frozen=True)
class StandardEncoder:
    """An encoder of images that others trained.

    Attributes:
        kind: ``inception`` or ``clip``.
        digest: SHA-256; see the module's docstring.
        size: side in pixels that images are brought to before ``forward``, or None where any size
            is taken.
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
            progress: called with the number of images done.

        Returns:
            (n, d) float32; of CLIP with rows of norm 1.

        Raises:
            PalpateError: if the array is not 8-bit RGB or empty, or features are not finite (images
                are named).
        """
        require_rgb(images)
        if not images.size:
            raise PalpateError("must not be empty", "none", "Check the folder", argument="images")
        if batch < 1:
            example = {"batch": 64}
            raise PalpateError(
                "must be at least 1", str(batch), "", argument="batch", example=example
            )
        parts: list[NDArray[np.float32]] = []
        with exact():
            for start in range(0, len(images), batch):
                parts.append(self.forward(images[start : start + batch]).float().cpu().numpy())
                done = min(start + batch, len(images))
                progress(f"embedding with {self.kind}", done, len(images))
        features = np.concatenate(parts)
        if (bad := np.flatnonzero(~np.isfinite(features).all(axis=1))).size:
            count = f"NaN or infinity for {bad.size} of {len(images)} images"
            must, got = (
                f"The features of {self.kind} must be finite",
                f"{count}, first {int(bad[0])}",
            )
            raise PalpateError(must, got, "Check these images and the weights")
        return features


def load_standard(
    source: str | Path, *, kind: Kind = "inception", sha256: str | None = None, device: str = "cpu"
) -> StandardEncoder:
    """Load a standard encoder.

    **Trust.** A TorchScript file is a program: loading it unpickles no Python object, but running
    it runs any torch operation that its author chose, with the rights of this process. Take such a
    file from its publisher alone, and pass ``sha256`` to have it compared *before* it is opened. A
    CLIP is read from safetensors, or from a ``.bin`` as weights only.

    Args:
        source: for ``inception`` a TorchScript file; for ``clip`` a folder of transformers (a
            CLIPModel or a CLIPVisionModelWithProjection), a shipped name or a hub id.
        kind: ``inception`` or ``clip``.
        sha256: hex digest that the TorchScript file must have, or its first digits (at least 8).
        device: see :func:`palpate.encoders.models.pick_device`.

    Raises:
        PalpateError: for an unknown kind; if files are missing, unreadable, of another digest or
            another kind of model, naming the file and where to get it; or if the hub is out of
            reach.
    """
    require_choice("kind", kind, KINDS)
    if kind == "clip":
        if sha256 is not None:
            must, fix = "must go with a TorchScript file", "Leave it out; a CLIP is no program"
            raise PalpateError(must, "a CLIP", fix, argument="sha256")
        return _load_clip(source, pick_device(device))
    return _load_script(Path(source), sha256, pick_device(device))


def _load_script(path: Path, sha256: str | None, device: torch.device) -> StandardEncoder:
    if not path.is_file():
        must = f"The Inception weights {path} must be a file"
        raise PalpateError(must, "no such file", INCEPTION_FIX)
    digest = digest_file(path)
    if sha256 is not None and (len(sha256) < 8 or not digest.startswith(sha256.lower())):
        must, fix = f"The file {path} must have the SHA-256 {sha256}", "Fetch it from its publisher"
        raise PalpateError(must, digest, fix)
    try:
        with (
            warnings.catch_warnings()
        ):  # torch deprecates TorchScript; published weights stay in it
            warnings.simplefilter("ignore", DeprecationWarning)
            module: Any = torch.jit.load(str(path), map_location=device)
        arguments = [argument.name for argument in module.forward.schema.arguments]
    except (RuntimeError, OSError, ValueError, AttributeError) as error:
        got = f"another file ({first_line(error)[:120]}); pickles are never loaded"
        raise PalpateError(f"{path} must be a TorchScript module", got, INCEPTION_FIX) from None
    module.eval()
    keywords = {"return_features": True} if "return_features" in arguments else {}

    def forward(images: NDArray[np.uint8]) -> Tensor:
        pixels = torch.from_numpy(np.array(images)).to(device).permute(0, 3, 1, 2).contiguous()
        must = f"The module {path} must map {len(images)} uint8 images to floats ({len(images)}, d)"
        try:
            features: Any = module(pixels, **keywords)
        except RuntimeError as error:
            got = (str(error).strip().splitlines() or ["an error of torch"])[-1][:200]
            raise PalpateError(must, got, INCEPTION_FIX) from None
        shape = tuple(getattr(features, "shape", ()))
        if shape[2:] == (1, 1):
            features, shape = features.flatten(1), shape[:2]
        if len(shape) != 2 or shape[0] != len(images) or not features.is_floating_point():
            raise PalpateError(must, f"{type(features).__name__} of shape {shape}", INCEPTION_FIX)
        return features

    facts = {"kind": "torchscript", "file": digest, **keywords}
    return StandardEncoder("inception", digest_json(facts), None, forward)


def _load_clip(source: str | Path, device: torch.device) -> StandardEncoder:
    name, folder = find_single(source, "clip", "CLIP", CLIP_FIX)
    local = name == str(folder)
    if local:
        require_files(folder, VISION_FILES, CLIP_FIX)
    config = _vision_config(folder / "config.json")
    must = f"{name} must be a CLIP with a vision encoder"
    options = {"config": config, "local_files_only": local}
    model = load_model(CLIPVisionModelWithProjection, name, must, CLIP_FIX, **options)
    path = folder / "preprocessor_config.json"
    preprocess = Preprocess.from_config(path, int(config.image_size))
    digest = vision_digest(model, config, preprocess)
    model.to(device)

    def forward(images: NDArray[np.uint8]) -> Tensor:
        pixels = preprocess(to_unit(preprocess.fit(images), device))
        return normalize(model(pixel_values=pixels).image_embeds, dim=-1)

    return StandardEncoder("clip", digest, preprocess.size, forward)


def _vision_config(path: Path) -> Any:
    """Read the configuration of the vision encoder of a whole CLIP, or of the encoder alone."""
    config = read_record(path, "configuration of the CLIP")
    if config.get("model_type") == "clip_vision_model":
        return CLIPVisionConfig(**config)
    if config.get("model_type") == "clip":
        whole: Any = CLIPConfig(**config)
        # The vision part's entry is often a default that nothing uses.
        whole.vision_config.projection_dim = whole.projection_dim
        return whole.vision_config
    got = f"model_type {config.get('model_type')!r}"
    raise PalpateError(f"{path} must describe a CLIP", got, CLIP_FIX)
