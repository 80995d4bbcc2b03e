"""Inception, the encoder of published FID and KID, as a TorchScript module.

It maps 8-bit images (n, 3, h, w), 0 to 255, to features (n, d). The widely used file is
``inception-2015-12-05.pt``: it resizes to 299 px itself (bilinear, as TensorFlow did in 2015) and
gives the 2048 pool features when called with ``return_features=True``.

**Trust.** A TorchScript file is a program: loading it unpickles no Python object, but running it
runs any torch operation that its author chose, those that write files too, with the rights of this
process. So it is loaded only where the caller says that it is trusted; no record says so for him.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from palpate.core import PalpateError, Progress, digest_file, digest_json, quiet, require
from palpate.encoders.embed import exact, require_rgb
from palpate.encoders.models import first_line

FILE = "inception-2015-12-05.pt"
URL = f"https://nvlabs-fi-cdn.nvidia.com/stylegan2-ada-pytorch/pretrained/metrics/{FILE}"
FIX = f"Fetch {FILE} (about 96 MB) from {URL} and pass its path"
RUNS = (
    "If you trust its publisher, say so: a TorchScript file is a program, which runs with your "
    "rights and can write files"
)


@dataclass(frozen=True)
class Inception:
    """The module of :func:`load_inception`.

    Attributes:
        path: the file.
        module: the TorchScript module.
        digest: SHA-256 of the file.
    """

    path: Path
    module: Any
    digest: str

    def embed(
        self, images: NDArray[np.uint8], *, batch: int = 64, progress: Progress = quiet
    ) -> NDArray[np.float32]:
        """Features (n, d) of images (n, h, w, 3), 0 to 255, in memory or in a mapped file.

        Raises:
            PalpateError: if the array is not 8-bit RGB, or the module gives no features.
        """
        require_rgb(images)
        parts: list[NDArray[np.float32]] = []
        with exact():
            for start in range(0, len(images), batch):
                parts.append(self._forward(images[start : start + batch]))
                progress("embedding with Inception", min(start + batch, len(images)), len(images))
        return np.concatenate(parts)

    def _forward(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        pixels = torch.from_numpy(np.array(images)).permute(0, 3, 1, 2).contiguous()
        n = len(images)
        must = f"The module {self.path} must map {n} uint8 images to floats ({n}, d)"
        try:
            features: Any = self.module(pixels, return_features=True)
        except RuntimeError as error:
            got = (str(error).strip().splitlines() or ["an error of torch"])[-1][:200]
            raise PalpateError(must, got, FIX) from None
        shape = tuple(getattr(features, "shape", ()))
        good = len(shape) == 2 and shape[0] == n and features.is_floating_point()
        require(good, None, must, f"{type(features).__name__} of shape {shape}", fix=FIX)
        return features.float().numpy()


def require_trusted(path: str | Path, trust_torchscript: bool) -> None:
    """Check that the user trusts a TorchScript file before it is loaded.

    Raises:
        PalpateError: if not, with what it would do.
    """
    must, example = "must be given for a file of TorchScript", {"trust_torchscript": True}
    if not trust_torchscript:
        raise PalpateError(must, str(path), RUNS, argument="trust_torchscript", example=example)


def load_inception(path: str | Path, *, trust_torchscript: bool = False) -> Inception:
    """Load a TorchScript file, whose code then runs; see the head of this module on trust.

    Raises:
        PalpateError: if it is not trusted, missing or another kind of file, with where to get it.
    """
    require_trusted(path, trust_torchscript)
    path = Path(path)
    must = f"The Inception weights {path} must be a file"
    require(path.is_file(), None, must, "no such file", fix=FIX)
    try:
        with warnings.catch_warnings():  # torch deprecates TorchScript; published weights stay
            warnings.simplefilter("ignore", DeprecationWarning)
            module: Any = torch.jit.load(str(path), map_location="cpu")
    except (RuntimeError, OSError, ValueError) as error:
        got = f"another file ({first_line(error)[:120]}); pickles are never loaded"
        raise PalpateError(f"{path} must be a TorchScript module", got, FIX) from None
    module.eval()
    return Inception(path, module, digest_json({"kind": "torchscript", "file": digest_file(path)}))
