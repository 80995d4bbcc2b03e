"""The learned ruler: a small network that reads the residual of a touch, not its gel.

Of a residual r (:mod:`palpate.data.residuals`) the median of each channel is taken off, and
``asinh(r / 3)`` keeps faint contacts beside strong ones. Convolutions follow; mean *and deviation*
of the last maps over the image are the ruler's numbers, from which a linear head leads into the
space of photos and texts.

Weights of a convolution are standardized where they are used (Qiao et al. 2019, "Weight
Standardization"): statistics of a batch would make a step depend on how many processes share it,
and those of an image would hide how strong a contact is.

Numbers are compared after ``(x - center) / spread``, of the images of the training; ``score`` takes
mean and deviation of the reference. In what remains, the directions are taken off in which codecs
move images most (Solomonoff et al. 2005, "Nuisance attribute projection"): views that went through
codecs in training cost more accuracy and hid less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.functional import conv2d, layer_norm, normalize, relu

from palpate.data.residuals import Residual
from palpate.encoders.tactile_module import Format, State, TactileModule

#: The file of the weights.
WEIGHTS = "model.safetensors"
#: Gray levels at which the response turns from linear to logarithmic.
KNEE = 3.0
#: Sides of the kernels, and strides, of the layers.
KERNELS, STRIDES = (5, 3, 3, 3, 3), (2, 2, 2, 2, 1)
#: Directions of codecs: with 6 of 256, JPEG 40 moves TMMD by less than its interval.
CODECS = 6
#: Keeps the variance of standard normal numbers behind a ReLU.
KEEPS_VARIANCE = math.sqrt(2 / (1 - 1 / math.pi))


class Layer(nn.Module):
    """A convolution of standardized weights with a gain, and a ReLU that keeps the variance."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int) -> None:
        super().__init__()
        # Standardized weights turn by lr / size a step: small ones learn.
        size = (inputs * kernel**2) ** -0.5
        self.weight = nn.Parameter(size * torch.randn(outputs, inputs, kernel, kernel))
        self.gain, self.bias = nn.Parameter(torch.ones(outputs)), nn.Parameter(torch.zeros(outputs))
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """(n, inputs, h, w) to (n, outputs, h / stride, w / stride)."""
        fan = self.weight[0].numel()
        weight = layer_norm(self.weight, self.weight.shape[1:], eps=1e-8) / math.sqrt(fan)
        weight = weight * self.gain[:, None, None, None]
        padding = self.weight.shape[2] // 2
        return relu(conv2d(x, weight, self.bias, self.stride, padding)) * KEEPS_VARIANCE


class GelEncoder(TactileModule):
    """The learned ruler; see the head of this file.

    Args:
        widths: of the layers.
        shared: width of the space of photos and texts.
        side: of the residuals, in pixels.

    Attributes:
        dim: numbers of the ruler, twice the width of the last layer.
        center, spread: mean and deviation of the numbers over images of the training, (dim,).
        codecs: directions of the standardized numbers that are taken off, orthonormal or 0,
            (CODECS, dim).
        preprocess: residuals of the side.
    """

    center: Tensor
    spread: Tensor
    codecs: Tensor

    def __init__(self, widths: Sequence[int], shared: int, side: int) -> None:
        super().__init__()
        sizes = zip((3, *widths), widths, KERNELS, STRIDES, strict=False)
        self.layers = nn.Sequential(*(Layer(*size) for size in sizes))
        self.dim = 2 * widths[-1]
        self.head = nn.Linear(self.dim, shared, bias=False)
        self.register_buffer("center", torch.zeros(self.dim))
        self.register_buffer("spread", torch.ones(self.dim))
        self.register_buffer("codecs", torch.zeros(CODECS, self.dim))
        self.register_buffer("side", torch.tensor(float(side)))
        self.preprocess = Residual(side, side)

    @classmethod
    def of(cls, state: State) -> GelEncoder:
        """A ruler of the shapes of weights."""
        widths = [len(state[f"layers.{k}.gain"]) for k in range(len(KERNELS))]
        return cls(widths, len(state["head.weight"]), int(state["side"]))

    def save(self, folder: Path, *, half: bool) -> None:
        """Write the weights, with ``half`` in 16 bits, as one file of a folder."""
        state = {GEL.prefix + k: v.half() if half else v for k, v in self.state_dict().items()}
        folder.mkdir(parents=True)
        save_file({k: v.contiguous() for k, v in state.items()}, folder / WEIGHTS)

    def numbers(self, residuals: Tensor) -> Tensor:
        """Residuals (n, 3, h, w) in gray levels to (n, dim), as they are."""
        some = residuals[:, :, ::4, ::4].flatten(2)
        x = (residuals - some.median(2).values[:, :, None, None]) / KNEE
        size = x.abs()
        x = torch.log(size + (size * size + 1).sqrt()).copysign(x)  # asinh, in half its time
        x = self.layers(x).flatten(2)
        return torch.cat([x.mean(2), (x.var(2) + 1e-4).sqrt()], 1)

    def forward(self, pixels: Tensor, sensors: Tensor | None = None) -> Tensor:
        """Residuals (n, 3, h, w) in gray levels to (n, dim), standardized, without codecs."""
        return self.standardized(self.numbers(pixels))

    def standardized(self, numbers: Tensor) -> Tensor:
        """Numbers (n, dim) standardized, without the directions of codecs."""
        x = (numbers - self.center) / self.spread
        return x - x @ self.codecs.T @ self.codecs

    def normed(self, standardized: Tensor) -> Tensor:
        """Standardized numbers (n, dim) as the head takes them."""
        return layer_norm(standardized * self.spread + self.center, (self.dim,))

    def encode(self, pixels: Tensor, sensors: Sequence[str] | None = None) -> Tensor:
        """The same; its rows keep their length, which the reference's deviations need."""
        return self(pixels)

    def shared(self, numbers: Tensor) -> Tensor:
        """Standardized numbers (n, dim) in the space of photos and texts, of length 1."""
        return normalize(self.head(self.normed(numbers)), dim=-1)


GEL = Format("palpate/gel", "unknown", (), "gel.", "center", GelEncoder.of)
