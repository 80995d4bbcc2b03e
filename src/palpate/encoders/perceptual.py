"""LPIPS, the learned perceptual distance (Zhang et al., arXiv 1801.03924), v0.1 with AlexNet.

``d(x, y) = sum_l mean_hw sum_c w_lc (f_lc(x) - f_lc(y))^2``: f_l is the l-th of AlexNet's five
convolutions after its ReLU, divided at every position by its norm over channels (plus 1e-10), w_l
the weights of a 1 x 1 convolution that was fitted to human judgments. Pixels in [-1, 1] are shifted
and scaled per channel first.

Two local files, read as weights only:

* the backbone, torchvision's ``alexnet-owt-7be5be79.pth``: ``features.0``, ``.3``, ``.6``, ``.8``,
  ``.10`` with ``.weight`` and ``.bias``;
* the heads, ``alex.pth`` of LPIPS v0.1: ``lin0.model.1.weight`` (1, 64, 1, 1) to
  ``lin4.model.1.weight`` (1, 256, 1, 1).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, relu

from palpate.core import PalpateError, Progress, quiet, require
from palpate.encoders.embed import exact
from palpate.encoders.models import digest_modules, read_weights
from palpate.metrics.images import image_pairs

#: Shortest side in pixels; under 31 the second pooling leaves nothing.
SMALLEST = 32
#: Per channel, of pixels in [-1, 1]; constants of LPIPS v0.1.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
EPSILON = 1e-10
#: Index in torchvision's ``features``, channels in and out, kernel, stride, padding.
LAYERS = (
    (0, 3, 64, 11, 4, 2),
    (3, 64, 192, 5, 1, 2),
    (6, 192, 384, 3, 1, 1),
    (8, 384, 256, 3, 1, 1),
    (10, 256, 256, 3, 1, 1),
)
#: Stages (from 0) whose input is first pooled: a 3 x 3 maximum of stride 2.
POOLED = (1, 2)
BACKBONE_URL = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
HEADS_URL = (
    "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/alex.pth"
)
FIX = (
    f"Pass two files: the backbone alexnet-owt-7be5be79.pth ({BACKBONE_URL}, 233 MB) and the heads "
    f"alex.pth ({HEADS_URL}, 6 kB)"
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
        """f_1 ... f_5 (b, c, h', w'), of unit norm over channels, of pixels (b, 3, h, w)."""
        x = (pixels - self.get_buffer("shift")) / self.get_buffer("scale")
        features: list[Tensor] = []
        for k, stage in enumerate(self.stages):
            x = relu(stage(max_pool2d(x, 3, 2) if k in POOLED else x))
            features.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + EPSILON))
        return features

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """The distances (b,), float64, of pixels (b, 3, h, w) in [-1, 1]; differentiable."""
        total = torch.zeros(len(first), dtype=torch.float64, device=first.device)
        stages = zip(self.stages_of(first), self.stages_of(second), self.heads, strict=True)
        for a, b, head in stages:
            total = total + head((a - b).square()).double().mean(dim=(1, 2, 3))
        return total


def load_lpips(backbone: Path, heads: Path) -> Lpips:
    """The LPIPS network from its two files; ``.safetensors`` of the same names are read as well.

    Args:
        backbone: state of torchvision's AlexNet; its classifier is not used.
        heads: state of the linear layers of LPIPS v0.1 for AlexNet.

    Raises:
        PalpateError: if a file is missing, holds more than weights, or other weights; both files
            and their origin are named.
    """
    files = [Path(backbone), Path(heads)]
    missing = [str(path) for path in files if not path.is_file()]
    must = "LPIPS must have the files of its backbone and of its heads"
    require(not missing, None, must, f"no {', no '.join(missing)}", fix=FIX)
    states = [read_weights(path, FIX) for path in files]
    network = Lpips()
    try:
        for k, (index, *_) in enumerate(LAYERS):
            names = {part: f"features.{index}.{part}" for part in ("weight", "bias")}
            network.stages[k].load_state_dict({p: states[0][name] for p, name in names.items()})
            network.heads[k].load_state_dict({"weight": states[1][f"lin{k}.model.1.weight"]})
    except (KeyError, RuntimeError) as error:
        must = f"{files[0]} and {files[1]} must hold the weights of AlexNet and of LPIPS"
        raise PalpateError(must, " ".join(str(error).split())[:200], FIX) from None
    network.eval().requires_grad_(False)
    network.digest = digest_modules({"lpips": network}, {"version": "0.1", "net": "alex"})
    return network


def lpips_per_image(
    generated: NDArray[Any],
    reference: NDArray[Any],
    network: Lpips,
    *,
    batch: int = 64,
    progress: Progress = quiet,
) -> NDArray[np.float64]:
    """LPIPS of each pair of images, at the size they have.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 32. Published values are of
            64 px patches, or of whole images.
        reference: the same shape; image i is the partner of generated image i.
        network: of :func:`load_lpips`.
        batch: pairs at a time.
        progress: called with the number of pairs done.

    Returns:
        (n,) distances, 0 for identical images; lower is better.

    Raises:
        PalpateError: on other shapes, dtypes, ranges (image numbers are named), or images smaller
            than 32 x 32.
    """
    generated, reference = image_pairs(generated, reference)
    height, width = generated.shape[1:3]
    must, got = f"must be at least {SMALLEST} x {SMALLEST} for LPIPS", f"{height} x {width}"
    require(min(height, width) >= SMALLEST, "generated", must, got, fix="Score larger images")
    distances = np.empty(len(generated), np.float64)
    device = network.get_buffer("shift").device
    with exact():
        for start in range(0, len(distances), batch):
            rows = slice(start, start + batch)
            pair = (_pixels(images[rows], device) for images in (generated, reference))
            distances[rows] = network(*pair).cpu().numpy()
            progress("LPIPS", min(start + batch, len(distances)), len(distances))
    return distances


def _pixels(images: NDArray[Any], device: torch.device) -> Tensor:
    unit = np.array(images, dtype=np.float32) / (255 if images.dtype == np.uint8 else 1)
    return torch.from_numpy(unit).to(device).permute(0, 3, 1, 2).expand(-1, 3, -1, -1) * 2 - 1
