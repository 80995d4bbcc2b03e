"""Where a touch touches: the contact mask, from the touch and the empty gel alone.

Root mean square over the channels of touch - background, markers filled from around them, blurred by a Gaussian of 1/48 of the shorter side,
above a threshold: 4 gray levels, or three times what the noise of that background leaves after the blur if that is more; then dilated by
1/64 of the side. Markers are pixels darker than 0.82 of the median luma around, of the touch or the background, and (from 48 px on) a pixel
around them. A mask under 1 % of the pixels is empty.
"""

from __future__ import annotations

import hashlib
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.core import PalpateError
from palpate.metrics.compat import as_images
from palpate.metrics.inputs import checked_images
from palpate.metrics.kernels import Array

Mask = NDArray[np.bool_]

#: Least change that is a contact, on the scale of [0, 1].
LEAST = 4 / 255
#: How many times the noise after the blur a contact must exceed.
TIMES_NOISE = 3.0
#: Share of the pixels under which a mask is empty.
SMALLEST = 0.01
#: A marker is darker than this share of the median luma in a window of a sixth of the side.
MARKER = 0.82


def contact_mask(touch: Any, background: Any, *, least: float = LEAST) -> Mask:
    """Where each touch touches.

    Args:
        touch: (n, h, w, 3 or 1) uint8, or float in [0, 1].
        background: the same shape: the gel without contact, of the same sensor at the same time.
        least: least change that is a contact, on the scale of [0, 1]; the noise of the gel can only raise it.

    Returns:
        (n, h, w), markers included; all False where the touch is empty.

    Raises:
        PalpateError: on other shapes, dtypes or ranges, or a ``least`` that is not positive.
    """
    checked_least(least)
    touch, background = checked_touches("touch", touch, background)
    return np.stack(
        [mask_of(unit(t), unit(b), least)[0] for t, b in zip(touch, background, strict=True)]
    )


def checked_least(least: Any) -> None:
    """Refuses a least change that is not inside (0, 1)."""
    if not isinstance(least, int | float | np.number) or not 0 < least < 1:
        raise PalpateError(
            "least must lie in (0, 1), the scale of the images",
            repr(least),
            "Leave it out for 4 / 255",
        )


def mask_of(touch: Array, background: Array, least: float) -> tuple[Mask, Mask]:
    """Mask of one touch (h, w), and the pixels on or beside a marker."""
    side = min(touch.shape[:2])
    near = _markers(touch) | _markers(background)
    if side >= 48:  # a smaller image has markers of a pixel, and hardly two of gel between them
        near = np.asarray(ndimage.binary_dilation(near, iterations=max(1, side // 96)), bool)
    sigma = side / 48
    d = ndimage.gaussian_filter(_filled(touch - background, ~near, side / 32), (sigma, sigma, 0))
    left = (
        np.sqrt(2) * _noise(background, ~near) / (2 * np.sqrt(np.pi) * max(sigma, 0.5))
    )  # of white noise of two images, after the blur
    mask = np.sqrt((d * d).mean(axis=2)) > max(least, TIMES_NOISE * left)
    if mask.mean() < SMALLEST:
        return np.zeros_like(mask), near
    return np.asarray(ndimage.binary_dilation(mask, iterations=max(1, side // 64)), bool), near


def _markers(image: Array) -> Mask:
    gray = image @ (np.array([0.299, 0.587, 0.114]) if image.shape[2] == 3 else np.ones(1))
    step = max(
        1, min(gray.shape) // 64
    )  # a median over a sixth of the side changes slowly, and costs the fourth power of the side
    small = gray[::step, ::step]
    around = ndimage.median_filter(small, min(small.shape) // 6 | 1, mode="reflect")
    return gray < MARKER * around.repeat(step, 0).repeat(step, 1)[: gray.shape[0], : gray.shape[1]]


def _filled(d: Array, keep: Mask, sigma: float) -> Array:
    """``d`` (h, w, c) with the pixels not kept replaced by a blur of the kept ones around."""
    weight = ndimage.gaussian_filter(keep.astype(np.float64), sigma)[..., None]
    around = ndimage.gaussian_filter(d * keep[..., None], (sigma, sigma, 0)) / np.maximum(
        weight, 1e-6
    )
    return np.where(keep[..., None], d, around)


def _noise(background: Array, keep: Mask) -> float:
    """Deviation of a pixel's noise: 1.4826 times the median size of a second difference in both directions, whose weights have the norm 6.

    Where hardly a pixel is away from the markers the noise cannot be told from them, and is taken as 0.
    """
    kernel = np.outer([1, -2, 1], [1, -2, 1])[..., None]
    away = np.asarray(ndimage.binary_erosion(keep, np.ones((3, 3)), border_value=1), bool)
    if away.mean() < 1 / 16:
        return 0.0
    return (
        1.4826
        * float(np.median(np.abs(ndimage.convolve(background, kernel, mode="mirror"))[away]))
        / 6
    )


def unit(image: NDArray[Any]) -> Array:
    """An image of 8 bits or floats as float64 in [0, 1]."""
    return image.astype(np.float64) / (255 if image.dtype == np.uint8 else 1)


def pictures_digest(images: Any) -> str:
    """Sixteen digits for the different pictures of a stack (n, h, w, c), in whatever order and type.

    Contacts against other empty gels are not comparable.
    """
    images = as_images("background", images)
    rows = (np.rint(unit(image) * 65535).astype("<u2").tobytes() for image in images)
    return hashlib.sha256(
        b"".join(sorted({hashlib.sha256(row).digest() for row in rows}))
    ).hexdigest()[:16]


def checked_touches(name: str, touch: Any, background: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """A stack of touches and its backgrounds; the check calls them generated and reference, so its words are put right."""
    try:
        return checked_images(as_images(name, touch), as_images(f"{name} background", background))
    except PalpateError as error:
        words = {
            "Generated and reference images": f"The {name} touches and their backgrounds",
            "generated": name,
            "reference": f"{name} background",
        }
        must = re.sub("|".join(words), lambda found: words[found[0]], error.must)
        raise PalpateError(must, error.got, error.fix) from None
