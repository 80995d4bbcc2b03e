"""The contact mask: where a tactile image shows contact, from it and its background alone.

Root mean square over the channels of image - background, markers filled from around them, blurred
by a Gaussian of 1/48 of the shorter side, above a threshold: 4 gray levels, or three times what the
noise of that background leaves after the blur if that is more; then dilated by 1/64 of the side.
Markers are pixels darker than 0.82 of the median luma around, of the image or the background, and
(from 48 px on) a pixel around them. A mask under 1 % of the pixels is empty.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.core import PalpateError
from palpate.metrics.images import Array, image_pairs, image_stack

Mask = NDArray[np.bool_]

#: Least change that is a contact, on the scale of [0, 1].
LEAST = 4 / 255
#: How many times the noise after the blur a contact must exceed.
TIMES_NOISE = 3.0
#: Share of the pixels under which a mask is empty.
SMALLEST = 0.01
#: A marker is darker than this share of the median luma in a window of a sixth of the side.
MARKER = 0.82
LUMA = np.array([0.299, 0.587, 0.114])


def contact_mask(tactile: Any, background: Any, *, least: float = LEAST) -> Mask:
    """Where each tactile image shows contact.

    Args:
        tactile: (n, h, w, 3 or 1) array or tensor, uint8 or float in [0, 1].
        background: the same shape: the gel without contact, of the same sensor at the same time.
        least: least change that is a contact, on the scale of [0, 1]; noise can only raise it.

    Returns:
        (n, h, w), markers included; all False where there is no contact.

    Raises:
        PalpateError: on other shapes, dtypes or ranges, or a ``least`` outside (0, 1).
    """
    check_least(least)
    pairs = image_pairs(tactile, background, arguments=("tactile", "background"))
    return np.stack([mask_of(image, empty, least)[0] for image, empty in pairs])


def check_least(least: Any) -> None:
    """Reject a least change that is not inside (0, 1)."""
    if not isinstance(least, int | float | np.number) or not 0 < least < 1:
        must, fix = "must lie in (0, 1), the scale of the images", "Use the default, 4 / 255"
        raise PalpateError(must, repr(least), fix, argument="least")


def mask_of(image: Array, background: Array, least: float) -> tuple[Mask, Mask]:
    """Contact mask (h, w) of one image, and the pixels on or next to a marker."""
    side = min(image.shape[:2])
    near = _markers(image) | _markers(background)
    if side >= 48:  # a smaller image has markers of a pixel, and hardly two of gel between them
        near = _dilated(near, side // 96)
    sigma = side / 48
    change = _fill(image - background, ~near, side / 32)
    change = ndimage.gaussian_filter(change, (sigma, sigma, 0))
    # white noise of two images after the blur
    noise = np.sqrt(2) * _noise(background, ~near) / (2 * np.sqrt(np.pi) * max(sigma, 0.5))
    mask = np.sqrt((change**2).mean(axis=2)) > max(least, TIMES_NOISE * noise)
    if mask.mean() < SMALLEST:
        return np.zeros_like(mask), near
    return _dilated(mask, side // 64), near


def background_digest(images: Any) -> str:
    """Sixteen digits for the different images of a stack (n, h, w, c), in any order and dtype.

    Contact scores against other backgrounds are not comparable.
    """
    stack = image_stack("background", images)
    rows = {
        hashlib.sha256(np.rint(stack[i] * 65535).astype("<u2").tobytes()).digest()
        for i in range(len(stack))
    }
    return hashlib.sha256(b"".join(sorted(rows))).hexdigest()[:16]


def _dilated(mask: Mask, pixels: int) -> Mask:
    return np.asarray(ndimage.binary_dilation(mask, iterations=max(1, pixels)), bool)


def _markers(image: Array) -> Mask:
    gray = image @ LUMA if image.shape[2] == 3 else image[..., 0]
    # a median over a sixth of the side changes slowly, and costs the fourth power of the side
    step = max(1, min(gray.shape) // 64)
    small = gray[::step, ::step]
    around = ndimage.median_filter(small, min(small.shape) // 6 | 1, mode="reflect")
    around = around.repeat(step, 0).repeat(step, 1)[: gray.shape[0], : gray.shape[1]]
    return gray < MARKER * around


def _fill(image: Array, keep: Mask, sigma: float) -> Array:
    """``image`` (h, w, c) with the pixels not kept replaced by a blur of the kept ones around."""
    weights = keep[..., None].astype(np.float64)
    blur = (sigma, sigma, 0)
    around = ndimage.gaussian_filter(image * weights, blur)
    around /= np.maximum(ndimage.gaussian_filter(weights, blur), 1e-6)
    return np.where(keep[..., None], image, around)


def _noise(background: Array, keep: Mask) -> float:
    """Standard deviation of a pixel's noise away from the markers.

    1.4826 times the median size of a second difference in both directions, whose weights have the
    norm 6. 0 where hardly a pixel is away from the markers.
    """
    away = np.asarray(ndimage.binary_erosion(keep, np.ones((3, 3)), border_value=1), bool)
    if away.mean() < 1 / 16:
        return 0.0
    kernel = np.outer([1, -2, 1], [1, -2, 1])[..., None]
    change = np.abs(ndimage.convolve(background, kernel, mode="mirror"))
    return 1.4826 * float(np.median(change[away])) / 6
