"""LPIPS, the learned perceptual distance of two images (Zhang et al., arXiv 1801.03924), version 0.1 with AlexNet; 0 is identical.

``d(x, y) = sum_l mean_hw sum_c w_lc (f_lc(x) - f_lc(y))^2``: f_l is the l-th of AlexNet's five convolutions after its ReLU, divided at every
place by its norm over channels (plus 1e-10), w_l the weights of a 1 x 1 convolution that was fitted to human judgments.
Pixels in [-1, 1] are shifted and scaled per channel first.

Two files of one's own, read as weights only:

* the backbone, torchvision's ``alexnet-owt-7be5be79.pth``: ``features.0``, ``.3``, ``.6``, ``.8``, ``.10`` with ``.weight`` and ``.bias``;
* the heads, ``alex.pth`` of LPIPS v0.1: ``lin0.model.1.weight`` (1, 64, 1, 1) to ``lin4.model.1.weight`` (1, 256, 1, 1).
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from palpate.core import PalpateError, Progress, quiet
from palpate.encoders.embed import _exact  # pyright: ignore[reportPrivateUsage]
from palpate.encoders.encoder_set import pick_device
from palpate.encoders.weights import digest_modules

#: Below this the last stage has no pixel left that saw the whole image.
SMALLEST = 32
#: Per channel, of pixels in [-1, 1]; constants of LPIPS v0.1.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
EPSILON = 1e-10
#: Place in torchvision's ``features``, channels in and out, kernel, stride, padding; a 3 x 3 maximum of stride 2 comes before the second and third.
LAYERS = (
    (0, 3, 64, 11, 4, 2),
    (3, 64, 192, 5, 1, 2),
    (6, 192, 384, 3, 1, 1),
    (8, 384, 256, 3, 1, 1),
    (10, 256, 256, 3, 1, 1),
)
POOLED = (1, 2)
FIX = (
    "Pass two files: the backbone alexnet-owt-7be5be79.pth (https://download.pytorch.org/models/alexnet-owt-7be5be79.pth, 233 MB) and the "
    "heads alex.pth (https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/alex.pth, 6 kB)"
)


class Lpips(nn.Module):
    """The network of :func:`load_lpips`.

    Attributes:
        digest: SHA-256 of all weights that it uses.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            nn.Conv2d(i, o, kernel, stride, padding) for _, i, o, kernel, stride, padding in LAYERS
        )
        self.heads = nn.ModuleList(nn.Conv2d(layer[2], 1, 1, bias=False) for layer in LAYERS)
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1), persistent=False)
        self.digest = ""

    def stages_of(self, pixels: Tensor) -> list[Tensor]:
        """Pixels (b, 3, h, w) in [-1, 1] to five stages (b, c, h', w') of unit norm over channels."""
        x, found = (pixels - self.get_buffer("shift")) / self.get_buffer("scale"), []
        for k, stage in enumerate(self.stages):
            if k in POOLED:
                x = F.max_pool2d(x, 3, 2)
            x = F.relu(stage(x))
            found.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + EPSILON))
        return found

    def forward(self, first: Tensor, second: Tensor, weights: Tensor | None = None) -> Tensor:
        """The distances (b,), float64, of pixels (b, 3, h, w) in [-1, 1]; differentiable.

        ``weights`` (b, 1, h, w), not negative and not all 0, is averaged over the pixels of every place of a stage and weighs it there.
        """
        found: list[Tensor] = []
        for a, b, head in zip(
            self.stages_of(first), self.stages_of(second), self.heads, strict=True
        ):
            places = head((a - b).square()).double()
            if weights is None:
                found.append(places.mean(dim=(1, 2, 3)))
            else:
                w = F.adaptive_avg_pool2d(weights.double(), places.shape[2:])
                found.append((w * places).sum(dim=(1, 2, 3)) / w.sum(dim=(1, 2, 3)))
        return torch.stack(found).sum(dim=0)


def load_lpips(backbone: Path, heads: Path, *, device: str = "cpu") -> Lpips:
    """The LPIPS network from its two files (see the head of this file); ``.safetensors`` of the same names are read as well.

    Args:
        backbone: state of torchvision's AlexNet; its classifier is left out.
        heads: state of the linear layers of LPIPS v0.1 for AlexNet.
        device: see :func:`palpate.encoders.encoder_set.pick_device`.

    Raises:
        PalpateError: if a file is missing, holds more than weights, or other weights; both files and their origin are named.
    """
    places = [Path(backbone), Path(heads)]
    missing = [str(path) for path in places if not path.is_file()]
    if missing:
        raise PalpateError(
            "LPIPS must have the files of its backbone and of its heads",
            f"no {', no '.join(missing)}",
            FIX,
        )
    states = [_read(path) for path in places]
    network = Lpips()
    for k, (place, *_) in enumerate(LAYERS):
        for part in ("weight", "bias"):
            _fill(
                getattr(network.stages[k], part), states[0], f"features.{place}.{part}", places[0]
            )
        _fill(
            network.heads[k].get_parameter("weight"), states[1], f"lin{k}.model.1.weight", places[1]
        )
    network.eval().requires_grad_(False)
    network.digest = digest_modules({"lpips": network}, {"version": "0.1", "net": "alex"})
    return network.to(pick_device(device))


def lpips_per_image(
    generated: NDArray[Any],
    reference: NDArray[Any],
    network: Lpips,
    *,
    mask: NDArray[np.bool_] | None = None,
    batch: int = 64,
    progress: Progress = quiet,
) -> NDArray[np.float64]:
    """LPIPS of each pair of images, at the size they have.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 32. Published values are of 64 px patches, or of whole images.
        reference: the same shape; image i is the partner of generated image i. One channel stands for three equal ones.
        network: of :func:`load_lpips`.
        mask: (n, h, w): the pixels whose distances are averaged, the others only lend the network their surroundings; default all.
        batch: pairs at a time.
        progress: told how many pairs are done.

    Returns:
        (n,) distances, 0 for identical images; lower is better. NaN where the mask is empty.

    Raises:
        PalpateError: on other shapes, dtypes, ranges (image numbers are named), or images smaller than 32 x 32.
    """
    generated, reference = (
        _array(name, v) for name, v in (("generated", generated), ("reference", reference))
    )
    _check(generated, reference)
    mask = None if mask is None else _array("mask", mask)
    if mask is not None and (mask.shape != generated.shape[:3] or mask.dtype != bool):
        must = f"The mask must be of shape {generated.shape[:3]} and of truth values"
        raise PalpateError(
            must, f"shape {mask.shape}, dtype {mask.dtype}", "Pass one mask an image"
        )
    if isinstance(batch, bool) or not isinstance(batch, int) or batch < 1:
        raise PalpateError(
            "batch must be a whole number of at least 1", repr(batch), "Pass e.g. batch=64"
        )
    out = np.empty(len(generated), np.float64)
    device = network.get_buffer("shift").device
    with _exact():
        for start in range(0, len(out), batch):
            at = slice(start, start + batch)
            weights = (
                None
                if mask is None
                else torch.from_numpy(mask[at][:, None].astype(np.float32)).to(device)
            )
            out[at] = (
                network(_pixels(generated[at], device), _pixels(reference[at], device), weights)
                .cpu()
                .numpy()
            )
            progress("LPIPS", min(start + batch, len(out)), len(out))
    return out


def _read(path: Path) -> Mapping[str, Any]:
    try:
        state = (
            load_file(path)
            if path.suffix == ".safetensors"
            else torch.load(path, map_location="cpu", weights_only=True)
        )
    except (
        OSError,
        RuntimeError,
        ValueError,
        EOFError,
        KeyError,
        pickle.UnpicklingError,
        SafetensorError,
    ) as error:
        got = (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
        raise PalpateError(f"{path} must hold weights and nothing else", got, FIX) from None
    if not isinstance(state, Mapping):
        raise PalpateError(
            f"{path} must hold a table of weights by name", type(state).__name__, FIX
        )
    return state


def _fill(parameter: Tensor, state: Mapping[str, Any], name: str, path: Path) -> None:
    value = state.get(name)
    shape = tuple(parameter.shape)
    if not isinstance(value, Tensor) or tuple(value.shape) != shape:
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else "none of that name"
        raise PalpateError(f"{path} must hold {name} of shape {shape}", got, FIX)
    if not bool(torch.isfinite(value).all()):
        raise PalpateError(
            f"{name} in {path} must be finite", "NaN or infinity", "Fetch the file again"
        )
    with torch.no_grad():
        parameter.copy_(value)


def _pixels(images: NDArray[Any], device: torch.device) -> Tensor:
    unit = np.array(images, dtype=np.float32) / (255 if images.dtype == np.uint8 else 1)
    return torch.from_numpy(unit).to(device).permute(0, 3, 1, 2).expand(-1, 3, -1, -1) * 2 - 1


def _array(name: str, images: Any) -> NDArray[Any]:
    try:
        return np.asarray(images.detach().cpu() if isinstance(images, Tensor) else images)
    except (TypeError, ValueError) as error:
        raise PalpateError(
            f"The {name} {'images ' * (name != 'mask')}must be one array",
            str(error).splitlines()[0],
            "Stack them, of one size",
        ) from None


def _check(generated: NDArray[Any], reference: NDArray[Any]) -> None:
    names: Sequence[tuple[str, NDArray[Any]]] = (("generated", generated), ("reference", reference))
    for name, images in names:
        if images.ndim != 4 or images.shape[3] not in (1, 3) or 0 in images.shape:
            must = f"The {name} images must have shape (n, h, w, 3), n >= 1"
            raise PalpateError(must, f"shape {images.shape}", "Stack them with channels last")
        if images.dtype != np.uint8 and images.dtype.kind != "f":
            raise PalpateError(
                f"The {name} images must be uint8, or floats in [0, 1]",
                f"dtype {images.dtype}",
                "Convert them",
            )
        for number, image in enumerate(images if images.dtype.kind == "f" else ()):
            low, high = float(image.min()), float(image.max())
            if not (low >= -1e-6 and high <= 1 + 1e-6):  # also false for NaN
                got = f"[{low:.4g}, {high:.4g}] in image {number}"
                raise PalpateError(
                    f"The {name} images must lie in [0, 1]", got, "Scale them to [0, 1]"
                )
    if generated.shape != reference.shape:
        got, fix = (
            f"shapes {generated.shape} and {reference.shape}",
            "Pass the same samples in the same order and size",
        )
        raise PalpateError(
            "Generated and reference images must pair one to one in one size", got, fix
        )
    if min(generated.shape[1:3]) < SMALLEST:
        got = f"{generated.shape[1]} x {generated.shape[2]}"
        raise PalpateError(
            f"Images must be at least {SMALLEST} x {SMALLEST} for LPIPS", got, "Score larger images"
        )
