"""Array helpers of the world, all in float32.

NumPy 2 keeps float32 only when the other operand is a Python number or float32 itself; one ``np.float64`` scalar (``np.cos(0.3)``,
``array.std()`` of float64, ``rng.choice([0.1, 0.2])``) silently doubles every array behind it. So scalars here are Python floats, and
constants become arrays through :func:`f32`.
"""

from __future__ import annotations

import colorsys
from typing import TypeAlias

import numpy as np
from scipy import ndimage

#: A float32 array; shapes stand in the docstrings.
Array: TypeAlias = np.ndarray


def f32(value: object) -> Array:
    """``value`` as a float32 array."""
    return np.asarray(value, np.float32)


def smoothstep(x: Array, start: float, end: float) -> Array:
    """Cubic step t²(3 - 2t) that is 0 at ``start`` and 1 at ``end``; ``end < start`` gives a falling step."""
    t = np.clip((x - float(start)) * (1.0 / (float(end) - float(start))), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blend(a: Array, b: Array, weight: Array) -> Array:
    """Colours ``a`` (weight 0) to ``b`` (weight 1); ``weight`` has shape (h, w), the colours (3,) or (h, w, 3)."""
    return a + (b - a) * np.clip(weight, 0.0, 1.0)[..., None]


def hsv(hue: float, saturation: float, value: float) -> Array:
    """An RGB colour of shape (3,) in [0, 1]; the hue wraps, the others are clipped."""
    return f32(colorsys.hsv_to_rgb(hue % 1.0, min(1.0, max(0.0, saturation)), min(1.0, max(0.0, value))))


def tint(colour: Array, factor: Array) -> Array:
    """``colour`` of shape (3,) or (h, w, 3) times a field of shape (h, w)."""
    return colour * factor[..., None]


def to_bytes(image: Array) -> np.ndarray:
    """An image in [0, 1] as uint8, clipped and rounded."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def smooth(field: Array, sigma: float) -> Array:
    """Gaussian-like blur of (h, w) by ``sigma`` pixels, edges repeated: exact below 2.5 px, above it two box passes.

    Two boxes of width k have variance (k² - 1) / 6, hence k = sqrt(6 sigma² + 1).
    """
    if sigma < 2.5:
        return ndimage.gaussian_filter(field, sigma, truncate=3.0, mode="nearest")
    width = round((6.0 * sigma * sigma + 1.0) ** 0.5) | 1
    return ndimage.uniform_filter(ndimage.uniform_filter(field, width, mode="nearest"), width, mode="nearest")


def sample_periodic(field: Array, y: Array, x: Array) -> Array:
    """Bilinear lookup in a periodic field of shape (n, n) or (n, n, k) at pixel positions ``y``, ``x`` of any size (h, w)."""
    n = field.shape[0]
    low_y, low_x = np.floor(y), np.floor(x)
    part_y, part_x = y - low_y, x - low_x
    top = low_y.astype(np.int32) % n
    left = low_x.astype(np.int32) % n
    below, right = (top + 1) % n * n, (left + 1) % n
    top *= n
    flat = field.reshape(n * n, -1) if field.ndim == 3 else field.reshape(n * n)
    if field.ndim == 3:
        part_y, part_x = part_y[..., None], part_x[..., None]
    first, second = flat.take(top + left, axis=0), flat.take(below + left, axis=0)
    first += (flat.take(top + right, axis=0) - first) * part_x
    second += (flat.take(below + right, axis=0) - second) * part_x
    return first + (second - first) * part_y


def resample(field: Array, size: int) -> Array:
    """A square field (n, n) or (n, n, k) as (size, size[, k]), each output pixel the mean over the area it covers.

    The mean over [a, b] is the difference of the running integral at b and a; the integral is linear inside a source pixel.
    """
    for axis in (0, 1):
        n = field.shape[axis]
        if n == size:
            continue
        moved = np.moveaxis(field, axis, 0)
        integral = np.concatenate([np.zeros_like(moved[:1], np.float64), np.cumsum(moved, axis=0, dtype=np.float64)])
        at = np.linspace(0.0, n, size + 1)
        low = np.minimum(at.astype(np.intp), n - 1)
        part = (at - low).reshape(-1, *[1] * (field.ndim - 1))
        edges = integral[low] * (1.0 - part) + integral[low + 1] * part
        field = np.moveaxis(f32(np.diff(edges, axis=0) * (size / n)), 0, axis)
    return f32(field)


def grid(size: int) -> tuple[Array, Array]:
    """Pixel centres of a square image in [-1, 1]: ``y`` of shape (size, 1) and ``x`` of shape (1, size)."""
    at = f32((np.arange(size) + 0.5) / size * 2.0 - 1.0)
    return at[:, None], at[None]
