"""Statistics of tactile images, the same for real and rendered ones: how far is a simulated
GelSight from a real one?

All take images of shape (n, n, 3) in gray levels 0 .. 255 and a pad of 14 mm a side, the default of
the world, so that a pixel is PAD_MM / n mm.

- Markers: pixels whose luma is below 0.82 of the median luma in a window of a sixth of the side (of
  every 2nd pixel from 128 px on, and so forth), joined to blobs (8-neighbors).
- Contrast: over the pixels without marker in either image, of d = contact - background: rms and 95
  % of |d| a channel. Chroma share: with m the mean of d over the channels, 1 - 3 sum(m²) / sum(d²):
  0 if the color never changes, 1 if the brightness never does.
- Spectrum: d with the markers filled from around them (normalized blur), less its mean, times a
  Hann window w; power |FFT(d w)|² / (n² sum w²)
  summed over the rings of each band and averaged over the channels: by Parseval the bands add up to
      the windowed mean square of d,
  so their roots are gray levels. The slope is that of the log ring power against the log frequency
  from 0.15 to 2 cycles/mm.
- Contact area: share of the pad where the root mean square over the channels of d, blurred by 1/48
  of the side, exceeds a threshold that two frames without contact seldom exceed.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy import ndimage

from palpate.sim.arrays import Array, f32, resample

#: Side of the pad in mm.
PAD_MM = 14.0
#: Edges of the bands of the spectrum in cycles/mm; a band above the Nyquist frequency n / (2
#: PAD_MM) is empty.
BANDS: tuple[float, ...] = (0.05, 0.2, 0.5, 1.0, 2.2)


def to_size(image: np.ndarray, size: int) -> Array:
    """A square image (n, n, 3) as float32 (size, size, 3), each pixel the mean over the area it
    covers.
    """
    return resample(f32(image), size)


def luma(image: np.ndarray) -> Array:
    """Rec. 601 luma, (n, n)."""
    return f32(image) @ f32([0.299, 0.587, 0.114])


def marker_mask(image: np.ndarray) -> np.ndarray:
    """Where the image is darker than 0.82 of the median around: bool, (n, n)."""
    gray = luma(image)
    n = gray.shape[0]
    step = max(
        1, n // 64
    )  # a median over a sixth of the side changes slowly, and costs the fourth power of the side
    around = ndimage.median_filter(gray[::step, ::step], n // step // 6 | 1, mode="reflect")
    return gray < 0.82 * around.repeat(step, 0).repeat(step, 1)[:n, :n]


def marker_statistics(image: np.ndarray) -> dict[str, float]:
    """Count of dark blobs a pad, their share of the pad, and share of the largest one."""
    mask = marker_mask(image)
    label = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, np.ones((3, 3)), label)
    areas = np.bincount(label.ravel())[1:] / mask.size
    return {
        "count": float(areas.size),
        "area": float(mask.mean()),
        "largest": float(areas.max(initial=0.0)),
    }


def color_grid(image: np.ndarray, cells: int = 3) -> Array:
    """Mean RGB of each cell of a coarse grid without the markers, (cells, cells, 3)."""
    keep = f32(~marker_mask(image))[..., None]
    return resample(f32(image) * keep, cells) / np.maximum(resample(keep, cells), 1e-3)


def difference(contact: np.ndarray, background: np.ndarray) -> tuple[Array, np.ndarray]:
    """Contact minus background (n, n, 3), and where neither has a marker (n, n)."""
    near = marker_mask(contact) | marker_mask(background)
    near = np.asarray(
        ndimage.binary_dilation(near, iterations=max(1, contact.shape[0] // 96)), bool
    )
    return f32(contact) - f32(background), ~near


def contrast(contact: np.ndarray, background: np.ndarray) -> dict[str, float]:
    """``rms_r/g/b``, ``p95_r/g/b`` in gray levels, ``rms`` over the channels, and ``chroma``, the
    share of the squared difference.
    """
    d, keep = difference(contact, background)
    d = d[keep].astype(np.float64)
    rms, high = np.sqrt((d * d).mean(0)), np.percentile(np.abs(d), 95, axis=0)
    found = {f"rms_{c}": float(v) for c, v in zip("rgb", rms, strict=True)} | {
        f"p95_{c}": float(v) for c, v in zip("rgb", high, strict=True)
    }
    total = float((d * d).sum())
    mean = d.mean(1)
    return found | {
        "rms": float(np.sqrt((d * d).mean())),
        "chroma": 1.0 - 3.0 * float((mean * mean).sum()) / total if total else 0.0,
    }


def fill(d: Array, keep: np.ndarray) -> Array:
    """``d`` (n, n, 3) with the pixels not kept replaced by a blur of the kept ones around."""
    sigma = d.shape[0] / 32
    weight = ndimage.gaussian_filter(f32(keep), sigma)[..., None]
    around = ndimage.gaussian_filter(d * keep[..., None], (sigma, sigma, 0)) / np.maximum(
        weight, 1e-6
    )
    return np.where(keep[..., None], d, around)


def spectrum(contact: np.ndarray, background: np.ndarray) -> dict[str, float]:
    """Root band powers ``band_0``.. in gray levels, and the log-log ``slope`` of the power
    density.
    """
    d, keep = difference(contact, background)
    n = d.shape[0]
    window = np.hanning(n + 2)[1:-1]
    window = f32(window[:, None] * window[None])[..., None]
    d = fill(d, keep)
    d = (d - (d * window).sum((0, 1)) / window.sum()) * window
    power = (np.abs(np.fft.fft2(d, axes=(0, 1))) ** 2).mean(2) / (
        n * n * float((window * window).sum())
    )
    axis = np.fft.fftfreq(n, PAD_MM / n)
    radius = np.hypot(axis[:, None], axis[None])
    found: dict[str, float] = {}
    for k, (low, high) in enumerate(itertools.pairwise(BANDS)):
        found[f"band_{k}"] = float(np.sqrt(power[(radius >= low) & (radius < high)].sum()))
    rings = np.geomspace(0.15, 2.0, 9)
    middle, density = np.sqrt(rings[1:] * rings[:-1]), np.zeros(8)
    for k in range(8):
        density[k] = power[(radius >= rings[k]) & (radius < rings[k + 1])].mean()
    slope = np.polyfit(np.log(middle), np.log(np.maximum(density, 1e-12)), 1)[0]
    return found | {"slope": float(slope)}


def change(contact: np.ndarray, background: np.ndarray) -> Array:
    """Root mean square over the channels of the blurred difference, markers filled, in gray levels,
    (n, n).
    """
    d, keep = difference(contact, background)
    sigma = d.shape[0] / 48
    return np.sqrt((ndimage.gaussian_filter(fill(d, keep), (sigma, sigma, 0)) ** 2).mean(2))


def contact_area(contact: np.ndarray, background: np.ndarray, threshold: float) -> float:
    """Share of the pad whose :func:`change` exceeds ``threshold`` gray levels."""
    return float((change(contact, background) > threshold).mean())


def noise_level(image: np.ndarray) -> float:
    """Deviation of what a blur of one pixel removes from the luma, markers left out, in gray
    levels: 1.4826 times the median of its size.

    Independent noise of deviation s in each channel gives 0.58 s: 0.67 s in the luma, of which the
        blur leaves out 0.87.
    """
    gray = luma(image)
    keep = ~np.asarray(ndimage.binary_dilation(marker_mask(image), iterations=3), bool)
    return 1.4826 * float(np.median(np.abs(gray - ndimage.gaussian_filter(gray, 1.0))[keep]))
