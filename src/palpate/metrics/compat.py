"""The conventions of SSIM and PSNR: ours, and those of the packages whose numbers stand in other people's tables.

One name, several metrics: on one pair of images the packages differ by up to 0.15 in SSIM and 10 dB in PSNR. As read in
torchmetrics 1.9.0, scikit-image 0.26 and piq 0.8.0, with their defaults:

=============  =========================================  ===============================  ========================================
convention     SSIM window                                SSIM pixels averaged             PSNR
=============  =========================================  ===============================  ========================================
ours (None)    Gaussian 11 x 11, sigma 1.5, population    windows inside the image         per image; identical images left out
torchmetrics   the same; variances clamped at 0           all, image mirrored at its edge  of the mean squared error of all images
skimage        uniform 7 x 7, variances over n - 1 = 48   windows inside the image         per image; identical images left out
piq            as ours, after average pooling by          windows inside the pooled image  per image, 1e-8 added to the mean squared
               round(shorter side / 256), cut at the edge                                  error: identical images have 80 dB
=============  =========================================  ===============================  ========================================

All take the mean over windows, channels and images with K1 = 0.01 and K2 = 0.03. Three things are not reproduced: the peers' habit of
guessing a data range from the pixels (it is always stated here), float32 arithmetic, and an infinite mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.core import PalpateError
from palpate.metrics.inputs import checked_choice, checked_images
from palpate.metrics.kernels import Array

Compat = Literal["torchmetrics", "skimage", "piq"]
Range = float | tuple[float, float]

WINDOW, SIGMA, K1, K2 = 11, 1.5, 0.01, 0.03
#: What piq adds to a mean squared error.
PIQ_EPSILON = 1e-8
#: Shorter side that piq pools down to, nearly.
PIQ_SIDE = 256


@dataclass(frozen=True)
class Convention:
    """How local statistics are taken.

    Attributes:
        window: side in pixels, odd.
        gaussian: Gaussian weights of sigma 1.5, else equal ones.
        border: average the windows inside the image (``"valid"``), or a window at every pixel of the image mirrored at its edge.
        sample: variances and covariance over n - 1 instead of n pixels.
        clamp: negative variances (rounding) become 0.
        pool: average-pool by round(shorter side / 256) before.
    """

    window: int = WINDOW
    gaussian: bool = True
    border: Literal["valid", "mirror"] = "valid"
    sample: bool = False
    clamp: bool = False
    pool: bool = False

    @property
    def weights(self) -> Array:
        """(window,) weights along one axis; the window is their outer product."""
        if not self.gaussian:
            return np.full(self.window, 1 / self.window)
        at = np.arange(self.window) - self.window // 2
        weights = np.exp(-0.5 * (at / SIGMA) ** 2)
        return weights / weights.sum()

    @property
    def settings(self) -> dict[str, Any]:
        """What a score keeps of it."""
        sigma = {"sigma": SIGMA} if self.gaussian else {"weights": "uniform"}
        more = {"covariance": "sample"} if self.sample else {}
        return {"window": self.window, **sigma, "k1": K1, "k2": K2, **more}

    def factor(self, height: int, width: int) -> int:
        """By how much an image of that size is pooled: 1 is not at all. Halves go to the even number."""
        return max(1, round(min(height, width) / PIQ_SIDE)) if self.pool else 1


OWN = Convention()
SSIM_CONVENTIONS: Mapping[str | None, Convention] = {
    None: OWN,
    "torchmetrics": Convention(border="mirror", clamp=True),
    "skimage": Convention(window=7, gaussian=False, sample=True),
    "piq": Convention(pool=True),
}


def checked_compat(compat: Any) -> None:
    """Refuses a name that is not among the conventions."""
    if compat is not None:
        checked_choice("compat", compat, [c for c in SSIM_CONVENTIONS if c is not None])


@dataclass(frozen=True)
class Pairs:
    """Checked pairs of images and how their numbers are read.

    Attributes:
        a: generated, (n, h, w, c).
        b: reference, the same shape.
        span: (low, high) of an explicit data range, or None: 8 bit from 0 to 255, floats from 0 to 1.
        shift: whether ``low`` becomes 0, as it must for a metric of pictures. The peers leave it, and SSIM depends on it.
    """

    a: NDArray[Any]
    b: NDArray[Any]
    span: tuple[float, float] | None
    shift: bool

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.a)

    def unit(self, image: NDArray[Any]) -> Array:
        """One image as float64 in units of the data range, which is 1 from then on."""
        if self.span is None:
            return image.astype(np.float64) / (255 if image.dtype == np.uint8 else 1)
        low, high = self.span
        return (image.astype(np.float64) - (low if self.shift else 0)) / (high - low)

    def channels(self, i: int) -> tuple[Array, Array]:
        """Pair ``i`` as two contiguous (c, h, w)."""
        x, y = (np.ascontiguousarray(np.moveaxis(self.unit(v[i]), 2, 0)) for v in (self.a, self.b))
        return x, y

    def squared_errors(self) -> Array:
        """(n,) mean squared error of each pair, all channels together."""
        return np.array(
            [
                ((self.unit(x) - self.unit(y)) ** 2).mean()
                for x, y in zip(self.a, self.b, strict=True)
            ]
        )

    @property
    def coding(self) -> dict[str, list[float]]:
        """``{"coding": [low, high]}`` where the range was given."""
        return {} if self.span is None else {"coding": list(self.span)}

    @property
    def data_range(self) -> int | list[float]:
        """The range that belongs to the settings: 1, since a picture's score does not depend on its coding, unless a peer's does."""
        return 1 if self.span is None or self.shift or self.span[0] == 0 else list(self.span)


def as_images(name: str, images: Any) -> NDArray[Any]:
    """``images`` as a NumPy array; tensors must be on the host.

    Raises:
        PalpateError: on ragged lists, and tensors that are on a device or track gradients.
    """
    try:
        return np.asarray(images)
    except (TypeError, ValueError, RuntimeError) as error:
        raise PalpateError(
            f"The {name} images must turn into a NumPy array",
            str(error).splitlines()[0],
            "Pass an array, or tensor.detach().cpu()",
        ) from None


def checked_pairs(
    generated: Any, reference: Any, data_range: Range | None = None, compat: str | None = None
) -> Pairs:
    """The images, checked against the data range.

    Args:
        generated: (n, h, w, 3 or 1).
        reference: the same shape.
        data_range: None: uint8, or floats in [0, 1], as :func:`checked_images`. ``(low, high)`` or ``high`` (low = 0): floats or
            integers, all within.
        compat: whose convention the images are for; with one, ``low`` is not moved to 0.

    Raises:
        PalpateError: on other shapes, dtypes or ranges (image numbers are named), or a range that the convention does not know.
    """
    checked_compat(compat)
    pair = [as_images("generated", generated), as_images("reference", reference)]
    if data_range is None:
        return Pairs(*checked_images(*pair), None, compat is None)
    low, high = _span(data_range)
    if compat == "piq" and low != 0:
        raise PalpateError(
            "piq knows only data ranges from 0",
            f"data_range=({low:g}, {high:g})",
            "Shift the images, or leave compat out",
        )
    for name, images in zip(("generated", "reference"), pair, strict=True):
        if images.dtype.kind not in "uif":
            raise PalpateError(
                f"The {name} images must be numbers", f"dtype {images.dtype}", "Convert them"
            )
        for number, image in (
            enumerate(images) if images.ndim == 4 and 0 not in images.shape else ()
        ):
            least, most = float(image.min()), float(image.max())
            reach = 1e-6 * (high - low)
            if not (least >= low - reach and most <= high + reach):  # also false for NaN
                got = f"[{least:.4g}, {most:.4g}] in image {number}"
                raise PalpateError(
                    f"The {name} images must lie in the data range [{low:g}, {high:g}]", got, _HINT
                )
        if (
            images.dtype.kind == "f"
            and images.size
            and high - low >= 100
            and 0 < float(images.max()) <= 1
            and float(images.min()) >= 0
        ):
            raise PalpateError(
                f"The {name} images must fill the data range [{low:g}, {high:g}]",
                "floats in [0, 1]",
                "Leave data_range out, or scale them",
            )
    # The shapes are checked as ever, on empty stand-ins: the ranges are already.
    checked_images(*(np.broadcast_to(np.uint8(0), v.shape) for v in pair))
    return Pairs(pair[0], pair[1], (low, high), compat is None)


_HINT = "Pass the range of the numbers, e.g. data_range=(-1, 1) for images in [-1, 1]"


def _span(data_range: Any) -> tuple[float, float]:
    try:
        low, high = (
            (0.0, float(data_range)) if np.ndim(data_range) == 0 else (float(v) for v in data_range)
        )
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise PalpateError(
            "data_range must be a positive number, or (low, high) with low < high",
            repr(data_range),
            _HINT,
        )
    return low, high


def local_maps(
    x: Array, y: Array, convention: Convention, reach: float = 1.0
) -> tuple[Array, Array]:
    """SSIM and its contrast-structure factor at every window.

    Args:
        x: (c, h, w).
        y: the same shape.
        convention: window, border and variance.
        reach: the data range L; C1 = (K1 L)^2, C2 = (K2 L)^2.

    Returns:
        Two (c, h', w'): ``(2 mx my + C1)(2 cov + C2) / ((mx^2 + my^2 + C1)(vx + vy + C2))``, and ``(2 cov + C2) / (vx + vy + C2)``.
    """
    weights, edge = convention.weights, convention.window // 2
    cut = edge if convention.border == "valid" else 0
    inside = (slice(None), slice(cut, x.shape[1] - cut), slice(cut, x.shape[2] - cut))
    c1, c2 = (K1 * reach) ** 2, (K2 * reach) ** 2

    def blur(image: Array) -> Array:
        down = ndimage.correlate1d(image, weights, axis=1, mode="mirror")[inside[:2]]
        return ndimage.correlate1d(down, weights, axis=2, mode="mirror")[:, :, inside[2]]

    mx, my, xx, yy, xy = blur(x), blur(y), blur(x * x), blur(y * y), blur(x * y)
    both = mx * my
    squares = mx * mx + my * my
    covariance, variances = xy - both, xx + yy - squares
    if convention.sample:
        bessel = convention.window**2 / (convention.window**2 - 1)
        covariance, variances = covariance * bessel, variances * bessel
    if convention.clamp:
        variances = np.maximum(xx - mx * mx, 0) + np.maximum(yy - my * my, 0)
    above, below = 2 * covariance + c2, variances + c2
    return ((2 * both + c1) * above) / ((squares + c1) * below), above / below


def pooled(image: Array, factor: int) -> Array:
    """(c, h, w) averaged over blocks of ``factor`` pixels a side; rows and columns that fill no block are dropped."""
    if factor == 1:
        return image
    h, w = image.shape[1] // factor, image.shape[2] // factor
    return (
        image[:, : h * factor, : w * factor]
        .reshape(len(image), h, factor, w, factor)
        .mean(axis=(2, 4))
    )


def ssim_values(pairs: Pairs, compat: str | None) -> Array:
    """(n,) SSIM of each pair by a convention.

    Raises:
        PalpateError: on images smaller than the window.
    """
    convention = SSIM_CONVENTIONS[compat]
    height, width = pairs.a.shape[1:3]
    if min(height, width) < convention.window:
        size = f"{convention.window} x {convention.window}"
        raise PalpateError(
            f"Images must be at least {size} for SSIM", f"{height} x {width}", "Score larger images"
        )
    factor, values = convention.factor(height, width), np.empty(len(pairs))
    for i in range(len(pairs)):
        x, y = (pooled(v, factor) for v in pairs.channels(i))
        values[i] = local_maps(x, y, convention)[0].mean()
    return values


def psnr_values(pairs: Pairs, compat: str | None) -> Array:
    """(n,) PSNR in dB of each pair by a convention; infinite where a pair is identical. Only piq's differs; torchmetrics pools errors."""
    error = pairs.squared_errors() + (PIQ_EPSILON if compat == "piq" else 0)
    with np.errstate(divide="ignore"):
        return -10 * np.log10(error)
