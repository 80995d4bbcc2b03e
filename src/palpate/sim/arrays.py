"""Array helpers of the world, all in float32.

NumPy 2 keeps float32 only when the other operand is a Python number or float32 itself; one
``np.float64`` scalar (``np.cos(0.3)``, ``array.std()`` of float64, ``rng.choice([0.1, 0.2])``)
silently doubles every array behind it. So scalars here are Python floats, and constants become
arrays through :func:`f32`.
"""

from __future__ import annotations

import colorsys
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from scipy import ndimage

#: A float32 array; shapes stand in the docstrings.
Array: TypeAlias = np.ndarray


def f32(value: object) -> Array:
    """``value`` as a float32 array."""
    return np.asarray(value, np.float32)


def smoothstep(x: Array, start: float, end: float) -> Array:
    """Cubic step t²(3 - 2t) that is 0 at ``start`` and 1 at ``end``; ``end < start`` gives a
    falling step.
    """
    t = np.clip((x - float(start)) * (1.0 / (float(end) - float(start))), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blend(a: Array, b: Array, weight: Array) -> Array:
    """Colors ``a`` (weight 0) to ``b`` (weight 1); ``weight`` has shape (h, w), the colors (3,) or
    (h, w, 3).
    """
    return a + (b - a) * np.clip(weight, 0.0, 1.0)[..., None]


def over(image: Array, color: Array, weight: Array) -> Array:
    """A planar image (3, h, w) covered by ``color``, (3,) or (3, h, w), to the degree ``weight`` in
    [0, 1], shape (h, w).
    """
    if color.ndim == 1:
        color = color[:, None, None]
    return image + (color - image) * weight


def hsv(hue: float, saturation: float, value: float) -> Array:
    """An RGB color of shape (3,) in [0, 1]; the hue wraps, the others are clipped."""
    return f32(
        colorsys.hsv_to_rgb(hue % 1.0, min(1.0, max(0.0, saturation)), min(1.0, max(0.0, value)))
    )


def tint(color: Array, factor: Array) -> Array:
    """``color`` of shape (3,) or (h, w, 3) times a field of shape (h, w)."""
    return color * factor[..., None]


def to_bytes(image: Array) -> np.ndarray:
    """An image in [0, 1] as uint8, clipped and rounded."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def smooth(field: Array, sigma: float) -> Array:
    """Gaussian-like blur of (h, w) by ``sigma`` pixels, edges repeated: exact below 2.5 px, above
    it two box passes.

    Two boxes of width k have variance (k² - 1) / 6, hence k = sqrt(6 sigma² + 1).
    """
    if sigma < 2.5:
        return ndimage.gaussian_filter(field, sigma, truncate=3.0, mode="nearest")
    width = round((6.0 * sigma * sigma + 1.0) ** 0.5) | 1
    for axis in (0, 1, 0, 1):
        field = ndimage.uniform_filter1d(field, width, axis, mode="nearest")
    return field


def _wrapped(index: np.ndarray, n: int) -> np.ndarray:
    """``index`` modulo n; by masking where n is a power of two, since dividing integers is slow."""
    return index & (n - 1) if n & (n - 1) == 0 else index % n


def sample_clipped(field: Array, y: Array, x: Array) -> Array:
    """Bilinear lookup in (h, w) at pixel positions ``y``, ``x``; positions outside take the nearest
    edge.
    """
    h, w = field.shape
    y, x = np.clip(y, 0.0, h - 1.0), np.clip(x, 0.0, w - 1.0)
    top, left = np.minimum(y.astype(np.intp), h - 2), np.minimum(x.astype(np.intp), w - 2)
    part_y, part_x = f32(y - top), f32(x - left)
    corner, flat = top * w + left, field.reshape(h * w)
    a, b, c, d = (flat.take(corner + step) for step in (0, 1, w, w + 1))
    a += (b - a) * part_x
    c += (d - c) * part_x
    return a + (c - a) * part_y


def sample_periodic(field: Array, y: Array, x: Array) -> Array:
    """Bilinear lookup in a periodic field at pixel positions ``y``, ``x`` of any size (h, w).

    Args:
        field: (n, n), or channels first (k, n, n).
        y: row of each output pixel.
        x: column of each output pixel.

    Returns:
        (h, w), or (k, h, w).
    """
    n = field.shape[-1]
    low_y, low_x = np.floor(y), np.floor(x)
    part_y, part_x = y - low_y, x - low_x
    top, left = _wrapped(low_y.astype(np.intp), n), _wrapped(low_x.astype(np.intp), n)
    below, right = _wrapped(top + 1, n) * n, _wrapped(left + 1, n)
    top *= n
    corners = top + left, top + right, below + left, below + right
    flat = field.reshape(*field.shape[:-2], n * n)
    if field.ndim == 2:
        a, b, c, d = (flat.take(k) for k in corners)
    else:
        a, b, c, d = (flat.take(k, axis=1) for k in corners)
    a += (b - a) * part_x
    c += (d - c) * part_x
    return a + (c - a) * part_y


def resample(field: Array, size: int) -> Array:
    """A square field (n, n) or (n, n, k) as (size, size[, k]), each output pixel the mean over the
    area it covers.

    The mean over [a, b] is the difference of the running integral at b and a; the integral is
    linear inside a source pixel.
    """
    for axis in (0, 1):
        n = field.shape[axis]
        if n == size:
            continue
        moved = np.moveaxis(field, axis, 0)
        integral = np.concatenate(
            [np.zeros_like(moved[:1], np.float64), np.cumsum(moved, axis=0, dtype=np.float64)]
        )
        at = np.linspace(0.0, n, size + 1)
        low = np.minimum(at.astype(np.intp), n - 1)
        part = (at - low).reshape(-1, *[1] * (field.ndim - 1))
        edges = integral[low] * (1.0 - part) + integral[low + 1] * part
        field = np.moveaxis(f32(np.diff(edges, axis=0) * (size / n)), 0, axis)
    return f32(field)


@lru_cache(maxsize=16)
def grid(size: int) -> tuple[Array, Array]:
    """Pixel centers of a square image in [-1, 1]: ``y`` of shape (size, 1) and ``x`` of shape (1,
    size).
    """
    at = f32((np.arange(size) + 0.5) / size * 2.0 - 1.0)
    at.flags.writeable = False
    return at[:, None], at[None]


def slopes(field: Array, step: float) -> tuple[Array, Array]:
    """Derivatives of (n, n) along y and x for pixels of ``step``: central differences, one-sided at
    the edges.
    """
    down, right = np.empty_like(field), np.empty_like(field)
    np.subtract(field[2:], field[:-2], out=down[1:-1])
    np.subtract(field[:, 2:], field[:, :-2], out=right[:, 1:-1])
    down[1:-1] /= 2.0 * step
    right[:, 1:-1] /= 2.0 * step
    down[0], down[-1] = (field[1] - field[0]) / step, (field[-1] - field[-2]) / step
    right[:, 0], right[:, -1] = (
        (field[:, 1] - field[:, 0]) / step,
        (field[:, -1] - field[:, -2]) / step,
    )
    return down, right
