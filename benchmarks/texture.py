"""A judge of texture that nothing learned: local binary patterns and the spectrum of the contact.

Of d = tactile image - no-contact image (gray, without its slow part): histograms of uniform local
binary patterns at three radii, and the logarithm of the power in rings and sectors of the spectrum.
A support vector machine names the material by them. It sees the fine grain first: noise of the
sensor, and what a codec left of it. ``masked`` buries both under noise of four gray levels.
"""

import numpy as np
from scipy import ndimage
from skimage.feature import local_binary_pattern
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

#: Deviation of the noise that masks the grain, in gray levels.
MASK = 4.0
RADII, RINGS, SECTORS = (1, 2, 4), 20, 8


def masked(images, seed):
    """Images (n, h, w, 3) under white noise, another one in every image."""
    noise = np.random.default_rng(seed).normal(0, MASK, images.shape)
    return np.rint(images + noise).clip(0, 255).astype(np.uint8)


def texture(images, gels):
    """(n, d) features of bytes (n, h, w, 3)."""
    return np.stack([_texture(*pair) for pair in zip(images, gels, strict=True)])


def _texture(image, gel):
    change = image.astype(np.float32).mean(2) - gel.astype(np.float32).mean(2)
    change -= ndimage.gaussian_filter(change, min(change.shape) / 8)
    return np.concatenate([_patterns(change), _spectrum(change)])


def _patterns(change):
    rows = []
    for radius in RADII:
        smooth = ndimage.gaussian_filter(change, (radius - 1) / 2)
        # at quarters of a gray level, so that rounding decides no comparison of equals
        codes = local_binary_pattern(np.rint(4 * smooth).astype(int), 8, radius, "nri_uniform")
        rows.append(np.sqrt(np.bincount(codes.astype(int).ravel(), minlength=59) / codes.size))
    return np.concatenate(rows)


def _spectrum(change):
    window = np.outer(*(np.hanning(side) for side in change.shape))
    power = np.abs(np.fft.fft2(change * window)) ** 2
    fy, fx = np.meshgrid(*(np.fft.fftfreq(side) for side in change.shape), indexing="ij")
    ring = np.digitize(np.hypot(fx, fy), np.geomspace(0.02, 0.5, RINGS)).ravel()
    sector = (np.arctan2(fy, fx) % np.pi * SECTORS / np.pi).astype(int).ravel() % SECTORS
    rings = np.bincount(ring, power.ravel(), RINGS + 1) / np.maximum(
        np.bincount(ring, minlength=RINGS + 1), 1
    )
    sectors = np.bincount(sector, power.ravel(), SECTORS)
    return np.concatenate([np.log(rings + 1), np.log(sectors / sectors.sum() + 1e-6)])


class TextureJudge:
    """Names materials; learns from real images alone."""

    def __init__(self, images, gels, labels):
        self.machine = make_pipeline(StandardScaler(), SVC(C=10.0))
        self.machine.fit(texture(images, gels), labels)

    def names(self, images, gels):
        return self.machine.predict(texture(images, gels))
