"""Array helpers of the world, all in float32.

NumPy 2 keeps float32 only when the other operand is a Python number or float32 itself; one
``np.float64`` scalar (``np.cos(0.3)``, a float64 ``array.std()``) silently doubles every array
behind it. So scalars here are Python floats, and constants become arrays through :func:`f32`.
"""

from __future__ import annotations

import colorsys
import math
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import scipy

#: A float32 array; shapes are given in the docstrings.
Array: TypeAlias = np.ndarray


def f32(value: object) -> Array:
    """Return ``value`` as a float32 array."""
    return np.asarray(value, np.float32)


def smoothstep(x: Array, start: float, end: float) -> Array:
    """Step as t²(3 - 2t) from 0 at ``start`` to 1 at ``end``; ``end < start`` gives a fall."""
    t = np.clip((x - float(start)) * (1.0 / (float(end) - float(start))), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blend(a: Array, b: Array, weight: Array) -> Array:
    """Mix colors ``a`` (weight 0) and ``b`` (1), (3,) or (h, w, 3), by a ``weight`` of (h, w)."""
    return a + (b - a) * np.clip(weight, 0.0, 1.0)[..., None]


def over(image: Array, color: Array, weight: Array) -> Array:
    """Cover a planar image (3, h, w) by ``color``, (3,) or (3, h, w), to ``weight``, (h, w)."""
    color = color[:, None, None] if color.ndim == 1 else color
    return image + (color - image) * weight


def hsv(hue: float, saturation: float, value: float) -> Array:
    """Return an RGB color of shape (3,) in [0, 1]; the hue wraps, the others are clipped."""
    saturation, value = min(1.0, max(0.0, saturation)), min(1.0, max(0.0, value))
    return f32(colorsys.hsv_to_rgb(hue % 1.0, saturation, value))


def tint(color: Array, factor: Array) -> Array:
    """Multiply ``color`` of shape (3,) or (h, w, 3) by a field of shape (h, w)."""
    return color * factor[..., None]


def to_bytes(image: Array) -> np.ndarray:
    """Clip and round an image in [0, 1] to uint8."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def smooth(field: Array, sigma: float) -> Array:
    """Blur (h, w) by ``sigma`` pixels, edges repeated: a Gaussian below 2.5, else two boxes.

    Two boxes of width k have variance (k² - 1) / 6, hence k = sqrt(6 sigma² + 1).
    """
    if sigma < 2.5:
        return scipy.ndimage.gaussian_filter(field, sigma, truncate=3.0, mode="nearest")
    width = round((6.0 * sigma * sigma + 1.0) ** 0.5) | 1
    for axis in (0, 1, 0, 1):
        field = scipy.ndimage.uniform_filter1d(field, width, axis, mode="nearest")
    return field


def _wrapped(index: np.ndarray, n: int) -> np.ndarray:
    """Return ``index`` modulo n; a mask where n is a power of two, since division is slow."""
    return index & (n - 1) if n & (n - 1) == 0 else index % n


def _bilinear(corners: list[Array], part_y: Array, part_x: Array) -> Array:
    a, b, c, d = corners
    a += (b - a) * part_x
    c += (d - c) * part_x
    return a + (c - a) * part_y


def sample_clipped(field: Array, y: Array, x: Array) -> Array:
    """Look up (h, w) bilinearly at pixel positions; outside, take the nearest edge."""
    h, w = field.shape
    y, x = np.clip(y, 0.0, h - 1.0), np.clip(x, 0.0, w - 1.0)
    top, left = np.minimum(y.astype(np.intp), h - 2), np.minimum(x.astype(np.intp), w - 2)
    corner, flat = top * w + left, field.reshape(h * w)
    corners = [flat.take(corner + step) for step in (0, 1, w, w + 1)]
    return _bilinear(corners, f32(y - top), f32(x - left))


def sample_periodic(field: Array, y: Array, x: Array) -> Array:
    """Look up a periodic field, (n, n) or (k, n, n), bilinearly at pixel positions of (h, w)."""
    n = field.shape[-1]
    low_y, low_x = np.floor(y), np.floor(x)
    top, left = _wrapped(low_y.astype(np.intp), n), _wrapped(low_x.astype(np.intp), n)
    below, right = _wrapped(top + 1, n) * n, _wrapped(left + 1, n)
    top *= n
    flat = field.reshape(*field.shape[:-2], n * n)
    indices = (top + left, top + right, below + left, below + right)
    return _bilinear([flat.take(k, axis=-1) for k in indices], y - low_y, x - low_x)


def window(
    field: Array, at: tuple[Array, Array], angle: float, reach: float, center: tuple[float, float]
) -> Array:
    """Look a periodic field up in a turned window.

    Args:
        field: (n, n) or (k, n, n).
        at: y and x in half widths of the window.
        angle: of the window in radians.
        reach: half its width in pixels of the field.
        center: x and y of its middle in pixels.
    """
    (y, x), c, s = at, math.cos(angle) * reach, math.sin(angle) * reach
    return sample_periodic(field, s * x + c * y + center[1], c * x - s * y + center[0])


def resample(field: Array, size: int) -> Array:
    """Resize (n, n) or (n, n, k) to (size, size[, k]): means over the area of each output pixel.

    The mean over [a, b] is the difference of the running integral at b and a; the integral is
    linear inside a source pixel.
    """
    for axis in (0, 1):
        n = field.shape[axis]
        if n == size:
            continue
        moved = np.moveaxis(field, axis, 0)
        sums = np.cumsum(moved, axis=0, dtype=np.float64)
        integral = np.concatenate([np.zeros_like(sums[:1]), sums])
        at = np.linspace(0.0, n, size + 1)
        low = np.minimum(at.astype(np.intp), n - 1)
        part = (at - low).reshape(-1, *[1] * (field.ndim - 1))
        edges = integral[low] * (1.0 - part) + integral[low + 1] * part
        field = np.moveaxis(f32(np.diff(edges, axis=0) * (size / n)), 0, axis)
    return f32(field)


@lru_cache(maxsize=16)
def grid(size: int) -> tuple[Array, Array]:
    """Return pixel centers in [-1, 1]: ``y`` of shape (size, 1) and ``x`` of shape (1, size)."""
    at = f32((np.arange(size) + 0.5) / size * 2.0 - 1.0)
    at.flags.writeable = False
    return at[:, None], at[None]


def turned(y: Array, x: Array, angle: float) -> tuple[Array, Array]:
    """Return the positions along and across the direction ``angle`` (radians, 0 along x)."""
    c, s = math.cos(angle), math.sin(angle)
    return c * x + s * y, c * y - s * x
