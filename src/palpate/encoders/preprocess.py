"""What happens to pixels before a encoder sees them: an evaluation transform, and a training-only augmentation.

Evaluation (:class:`Preprocess`): center square, antialiased bicubic to ``resize``, center crop to ``size``, then per channel
``(x / 255 - mean) / std``. It is read from and written to CLIP's ``preprocessor_config.json``.

Training (:class:`Augment`): a random window of the square (scale s in [1 - crop, 1], anywhere inside), resampled bilinearly,
then ``gain * x + offset`` per picture. It is another type on purpose: nothing that evaluates accepts it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from palpate.core import PalpateError
from palpate.data.images import square

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


@dataclass(frozen=True)
class Preprocess:
    """The evaluation transform of one encoder.

    Attributes:
        size: side of what the encoder sees, in pixels.
        resize: side of the square before the center crop, in pixels (``size`` for CLIP).
        mean, std: per channel, of values in [0, 1].
    """

    size: int
    resize: int
    mean: tuple[float, float, float] = CLIP_MEAN
    std: tuple[float, float, float] = CLIP_STD

    @classmethod
    def of_size(
        cls,
        size: int,
        mean: tuple[float, float, float] = CLIP_MEAN,
        std: tuple[float, float, float] = CLIP_STD,
    ) -> Preprocess:
        """The transform that resizes straight to ``size``."""
        return cls(size, size, mean, std)

    @classmethod
    def from_config(cls, config: Mapping[str, Any], size: int) -> Preprocess:
        """Reads ``preprocessor_config.json`` of transformers' CLIP image processor, old and new spelling.

        Args:
            config: the file's JSON object; may be empty, then CLIP's constants hold.
            size: the encoder's image side, which the crop must agree with.

        Raises:
            PalpateError: if the crop has another size than the encoder.
        """
        crop = _side(config.get("crop_size"), size)
        resize = _side(config.get("size"), crop)
        if not config.get("do_center_crop", True):
            crop = resize
        if crop != size or resize < size:
            raise PalpateError(
                f"The image processor must give the encoder's {size} px",
                f"{crop} px from {resize} px",
                "Mend preprocessor_config.json",
            )
        if not config.get("do_normalize", True):
            return cls(size, resize, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        return cls(
            size,
            resize,
            _three(config.get("image_mean") or CLIP_MEAN),
            _three(config.get("image_std") or CLIP_STD),
        )

    def to_config(self) -> dict[str, Any]:
        """The same as a ``preprocessor_config.json`` that transformers' ``CLIPImageProcessor`` reads."""
        return {
            "image_processor_type": "CLIPImageProcessor",
            "do_convert_rgb": True,
            "do_resize": True,
            "size": {"shortest_edge": self.resize},
            "resample": 3,
            "do_center_crop": True,
            "crop_size": {"height": self.size, "width": self.size},
            "do_rescale": True,
            "rescale_factor": 1 / 255,
            "do_normalize": True,
            "image_mean": list(self.mean),
            "image_std": list(self.std),
        }

    def fit(self, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Images of any size, (n, h, w, 3), as (n, resize, resize, 3) by the rule for files.

        Raises:
            PalpateError: if the array is not 8-bit RGB.
        """
        if images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] != 3:
            raise PalpateError(
                "Images must be uint8 of shape (n, h, w, 3)",
                f"{images.dtype} of shape {images.shape}",
                "Scale to 0..255, round and clip",
            )
        if images.shape[1:3] == (self.resize, self.resize):
            return images
        out = np.empty((len(images), self.resize, self.resize, 3), np.uint8)
        for k, image in enumerate(images):
            out[k] = square(Image.fromarray(image), self.resize)
        return out

    def crop(self, images: Tensor) -> Tensor:
        """The center (b, 3, size, size) of (b, 3, resize, resize)."""
        edge = (self.resize - self.size) // 2
        return images[..., edge : edge + self.size, edge : edge + self.size]

    def normalize(self, images: Tensor) -> Tensor:
        """``(x - mean) / std`` for x in [0, 1], (b, 3, h, w)."""
        mean = torch.tensor(self.mean, dtype=images.dtype, device=images.device).view(1, 3, 1, 1)
        std = torch.tensor(self.std, dtype=images.dtype, device=images.device).view(1, 3, 1, 1)
        return (images - mean) / std


def to_unit(images: NDArray[np.uint8], device: torch.device | str = "cpu") -> Tensor:
    """8-bit (b, h, w, 3) as float32 (b, 3, h, w) in [0, 1]."""
    # np.array copies: a mapped cache is read-only, which torch warns about.
    return torch.from_numpy(np.array(images)).to(device).permute(0, 3, 1, 2).float() / 255


def statistics(
    images: NDArray[np.uint8],
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Mean and standard deviation per channel of (n, h, w, 3) in [0, 1], over at most 2,000 evenly spaced images."""
    some = np.asarray(images[:: max(1, len(images) // 2000)], dtype=np.float64).reshape(-1, 3) / 255
    mean, std = some.mean(axis=0), np.maximum(some.std(axis=0), 1 / 255)
    return _three(mean.round(6)), _three(std.round(6))


@dataclass(frozen=True)
class Augment:
    """Random changes of training images; never used in evaluation (recipes, pitfall 5).

    Attributes:
        crop: the window's side is 1 - ``crop`` to 1 of the image's.
        gain: sd of the logarithm of the contrast factor.
        offset: sd of the brightness offset, in [0, 1] units.
        flips: mirror each axis with probability 1/2. Off: a flip must hit both pictures of a pair or none, and it swaps the
            sides that a sensor's colored lights come from.
        quarter_turns: rotate by a random multiple of 90 degrees. Off, for the same reason.
    """

    crop: float = 0.1
    gain: float = 0.1
    offset: float = 0.05
    flips: bool = False
    quarter_turns: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.crop < 1 or self.gain < 0 or self.offset < 0:
            raise PalpateError(
                "Augmentation must have crop in [0, 1), gain >= 0, offset >= 0",
                repr(self),
                "Change the preset",
            )

    def __call__(self, images: Tensor, generator: torch.Generator) -> Tensor:
        """(b, 3, h, w) in [0, 1] to the same shape; values may leave [0, 1] as over-exposure would before clipping.

        Args:
            images: the batch, on any device.
            generator: on the CPU; the only source of randomness.
        """
        n = len(images)
        scale = 1 - self.crop * torch.rand(n, generator=generator)
        place = (2 * torch.rand(n, 2, generator=generator) - 1) * (1 - scale)[:, None]
        angle = torch.randint(0, 4, (n,), generator=generator) * (
            torch.pi / 2 if self.quarter_turns else 0.0
        )
        mirror = 1.0 - 2.0 * torch.randint(0, 2, (n, 2), generator=generator) * (
            1.0 if self.flips else 0.0
        )
        gain = torch.exp(self.gain * torch.randn(n, generator=generator))
        offset = self.offset * torch.randn(n, generator=generator)
        cos, sin = scale * torch.cos(angle), scale * torch.sin(angle)
        window = torch.stack(
            [torch.stack([cos, -sin, place[:, 0]], 1), torch.stack([sin, cos, place[:, 1]], 1)], 1
        )
        window[:, :, :2] *= mirror[:, None]
        grid = F.affine_grid(window.to(images.device), list(images.shape), align_corners=False)
        images = F.grid_sample(images, grid, align_corners=False, padding_mode="reflection")
        return images * gain.to(images.device).view(n, 1, 1, 1) + offset.to(images.device).view(
            n, 1, 1, 1
        )


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    r, g, b = values
    return float(r), float(g), float(b)


def _side(value: Any, default: int) -> int:
    """The side in pixels from a number or from ``{"shortest_edge": s}`` or ``{"height": s, "width": s}``."""
    if isinstance(value, Mapping):
        value = value.get("shortest_edge", value.get("height"))
    return default if value is None else int(value)
