"""Statistics of tactile images, the same for real and rendered ones.

All take images of shape (n, n, 3) in gray levels 0 .. 255 and a pad of 14 mm a side, the default of
the world, so that a pixel is PAD_MM / n mm.

- Markers: pixels whose luma is below 0.82 of the median luma in a window of a sixth of the side (of
  every 2nd pixel from 128 px on, and so forth), joined to blobs (8-neighbors).
- Contrast: over the pixels without marker in either image, of d = contact - background: rms and 95
  % of |d| a channel. Chroma share: with m the mean of d over the channels, 1 - 3 sum(m²) / sum(d²):
  0 if the color never changes, 1 if the brightness never does.
- Spectrum: d with the markers filled from around them (normalized blur), less its mean, times a
  Hann window w; power |FFT(d w)|² / (n² sum w²) summed over the rings of each band and averaged
  over the channels: by Parseval the bands add up to the windowed mean square of d, so their roots
  are gray levels. The slope is that of the log ring power against the log frequency from 0.15 to 2
  cycles/mm.
- Contact area: share of the pad where the root mean square over the channels of d, blurred by 1/48
  of the side, exceeds a threshold that two frames without contact seldom exceed.
"""

import itertools

import numpy as np
from scipy import ndimage

from palpate.sim.arrays import f32, resample

#: Side of the pad in mm.
PAD_MM = 14.0
#: Edges of the bands of the spectrum in cycles/mm; those above the Nyquist frequency are empty.
BANDS = (0.05, 0.2, 0.5, 1.0, 2.2)


def to_size(image, size):
    """Resize (n, n, 3) to float32 (size, size, 3), means over the area of each output pixel."""
    return resample(f32(image), size)


def luma(image):
    """Rec. 601 luma, (n, n)."""
    return f32(image) @ f32([0.299, 0.587, 0.114])


def marker_mask(image):
    """Where the image is darker than 0.82 of the median around: bool, (n, n)."""
    gray = luma(image)
    n = gray.shape[0]
    step = max(1, n // 64)  # the median changes slowly, and costs the fourth power of the side
    around = ndimage.median_filter(gray[::step, ::step], n // step // 6 | 1, mode="reflect")
    return gray < 0.82 * around.repeat(step, 0).repeat(step, 1)[:n, :n]


def marker_statistics(image):
    """Count of dark blobs a pad, their share of the pad, and share of the largest."""
    mask = marker_mask(image)
    label = ndimage.label(mask, np.ones((3, 3)))[0]
    areas = np.bincount(label.ravel())[1:] / mask.size
    largest = float(areas.max(initial=0.0))
    return {"count": float(areas.size), "area": float(mask.mean()), "largest": largest}


def color_grid(image, cells=3):
    """Mean RGB of each cell of a coarse grid without the markers, (cells, cells, 3)."""
    keep = f32(~marker_mask(image))[..., None]
    return resample(f32(image) * keep, cells) / np.maximum(resample(keep, cells), 1e-3)


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


def fill(d, keep):
    """``d`` (n, n, 3) with the pixels not kept replaced by a blur of the kept ones around."""
    sigma = d.shape[0] / 32
    weight = np.maximum(ndimage.gaussian_filter(f32(keep), sigma)[..., None], 1e-6)
    around = ndimage.gaussian_filter(d * keep[..., None], (sigma, sigma, 0)) / weight
    return np.where(keep[..., None], d, around)


def spectrum(contact, background):
    """Root band powers ``band_0``.. in gray levels, and the log-log ``slope`` of the density."""
    d, keep = difference(contact, background)
    n = d.shape[0]
    window = np.hanning(n + 2)[1:-1]
    window = f32(window[:, None] * window[None])[..., None]
    d = fill(d, keep)
    d = (d - (d * window).sum((0, 1)) / window.sum()) * window
    power = (np.abs(np.fft.fft2(d, axes=(0, 1))) ** 2).mean(2)
    power = power / (n * n * float((window * window).sum()))
    axis = np.fft.fftfreq(n, PAD_MM / n)
    radius = np.hypot(axis[:, None], axis[None])
    ring = lambda low, high: power[(radius >= low) & (radius < high)]
    bands = [float(np.sqrt(ring(*edges).sum())) for edges in itertools.pairwise(BANDS)]
    rings = np.geomspace(0.15, 2.0, 9)
    density = [max(float(ring(*edges).mean()), 1e-12) for edges in itertools.pairwise(rings)]
    slope = np.polyfit(np.log(np.sqrt(rings[1:] * rings[:-1])), np.log(density), 1)[0]
    return {f"band_{k}": value for k, value in enumerate(bands)} | {"slope": float(slope)}


def change(contact, background):
    """Rms over the channels of the blurred difference, markers filled, in gray levels, (n, n)."""
    d, keep = difference(contact, background)
    sigma = d.shape[0] / 48
    return np.sqrt((ndimage.gaussian_filter(fill(d, keep), (sigma, sigma, 0)) ** 2).mean(2))


def contact_area(contact, background, threshold):
    """Share of the pad whose :func:`change` exceeds ``threshold`` gray levels."""
    return float((change(contact, background) > threshold).mean())


def noise_level(image):
    """1.4826 times the median of what a blur of a pixel removes from the luma, without markers.

    Independent noise of deviation s in each channel gives 0.58 s: 0.67 s in the luma, of which
    0.87 differs from the blur.
    """
    gray = luma(image)
    keep = ~ndimage.binary_dilation(marker_mask(image), iterations=3)
    return 1.4826 * float(np.median(np.abs(gray - ndimage.gaussian_filter(gray, 1.0))[keep]))
