"""Statistics of tactile images (n, n, 3) in gray levels 0 .. 255, real or rendered.

- Markers: pixels whose luma is below 0.82 of the median luma around, joined to blobs (8-neighbors).
- Contrast: over the pixels without marker in either image, of d = contact - background: rms and 95
  % of |d| a channel. Chroma share: with m the mean of d over the channels, 1 - 3 sum(m²) / sum(d²):
  0 if the color never changes, 1 if the brightness never does.
- Contact area: share of the pad where d changes more than two frames without contact seldom do.
"""

import numpy as np
from scipy import ndimage

from palpate.sim.arrays import f32


def marker_mask(image):
    """Where the image is darker than 0.82 of the median in a sixth of the side: bool, (n, n)."""
    gray = f32(image) @ f32([0.299, 0.587, 0.114])
    n = gray.shape[0]
    step = max(1, n // 64)  # the median changes slowly, and costs the fourth power of the side
    around = ndimage.median_filter(gray[::step, ::step], n // step // 6 | 1, mode="reflect")
    return gray < 0.82 * around.repeat(step, 0).repeat(step, 1)[:n, :n]


def marker_count(image):
    """Number of dark blobs of a pad."""
    return ndimage.label(marker_mask(image), np.ones((3, 3)))[1]


def difference(contact, background):
    """Contact minus background (n, n, 3), and where neither has a marker (n, n)."""
    near = marker_mask(contact) | marker_mask(background)
    near = ndimage.binary_dilation(near, iterations=max(1, contact.shape[0] // 96))
    return f32(contact) - f32(background), ~near


def contrast(contact, background):
    """``rms_r/g/b``, ``p95_r/g/b``, ``rms`` over the channels in gray levels; ``chroma`` share."""
    d, keep = difference(contact, background)
    d = d[keep].astype(np.float64)
    rms, high = np.sqrt((d * d).mean(0)), np.percentile(np.abs(d), 95, axis=0)
    values = {f"rms_{c}": float(v) for c, v in zip("rgb", rms, strict=True)}
    values |= {f"p95_{c}": float(v) for c, v in zip("rgb", high, strict=True)}
    total, mean = float((d * d).sum()), d.mean(1)
    chroma = 1.0 - 3.0 * float((mean * mean).sum()) / total if total else 0.0
    return values | {"rms": float(np.sqrt((d * d).mean())), "chroma": chroma}


def change(contact, background):
    """Rms over the channels of the blurred difference, in gray levels, (n, n).

    Markers are first filled with a blur of the pixels around.
    """
    d, keep = difference(contact, background)
    wide, narrow = d.shape[0] / 32, d.shape[0] / 48
    weight = np.maximum(ndimage.gaussian_filter(f32(keep), wide)[..., None], 1e-6)
    around = ndimage.gaussian_filter(d * keep[..., None], (wide, wide, 0)) / weight
    filled = np.where(keep[..., None], d, around)
    return np.sqrt((ndimage.gaussian_filter(filled, (narrow, narrow, 0)) ** 2).mean(2))


def contact_area(contact, background, threshold):
    """Share of the pad whose :func:`change` exceeds ``threshold`` gray levels."""
    return float((change(contact, background) > threshold).mean())
