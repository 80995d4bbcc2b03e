"""SSIM and PSNR between a generated image and its reference, averaged over images.

* SSIM (Wang et al. 2004): local means, variances and covariance under an 11 x 11 Gaussian of sigma 1.5,
  ``(2 mx my + C1)(2 cov + C2) / ((mx^2 + my^2 + C1)(vx + vy + C2))`` with C1 = (0.01 L)^2, C2 = (0.03 L)^2, data range L = 1, on each colour
  channel, no downsampling, weighted population variances; averaged over the windows that lie wholly inside the image (as the original; no padding).
* PSNR: ``-10 log10(mean squared error)`` of an image, data range 1, all channels together. Two identical images have no PSNR
  (infinite): they are left out of the mean and counted in ``details["identical"]``, and the note says so.

The average is over images, never over pooled pixels. Neither metric sees what a touch is about: most pixels show the sensor itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate import __version__
from palpate.core import PalpateError, Score
from palpate.metrics.checks import checked_images, checked_names
from palpate.metrics.intervals import mean_interval
from palpate.metrics.kernels import Array

WINDOW, SIGMA, K1, K2 = 11, 1.5, 0.01, 0.03


def _window() -> Array:
    at = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-0.5 * (at / SIGMA) ** 2)
    return weights / weights.sum()


def _unit(image: NDArray[Any]) -> Array:
    return image.astype(np.float64) / (255 if image.dtype == np.uint8 else 1)


def ssim_per_image(generated: Any, reference: Any) -> Array:
    """SSIM of each pair of images.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11.
        reference: the same shape.

    Returns:
        (n,) values in [-1, 1].

    Raises:
        PalpateError: on other shapes, dtypes, ranges, or images smaller than the window.
    """
    a, b = checked_images(generated, reference)
    if min(a.shape[1:3]) < WINDOW:
        raise PalpateError(f"Images must be at least {WINDOW} x {WINDOW} for SSIM", f"{a.shape[1]} x {a.shape[2]}", "Score larger images")
    edge = WINDOW // 2
    inside = (slice(None), slice(edge, a.shape[1] - edge), slice(edge, a.shape[2] - edge))
    weights, values = _window(), np.empty(len(a))

    def blur(image: Array) -> Array:
        down = ndimage.correlate1d(image, weights, axis=1)[inside[:2]]
        return ndimage.correlate1d(down, weights, axis=2)[:, :, inside[2]]

    for i in range(len(a)):
        x, y = (np.ascontiguousarray(np.moveaxis(_unit(v[i]), 2, 0)) for v in (a, b))
        mx, my, xx, yy, xy = blur(x), blur(y), blur(x * x), blur(y * y), blur(x * y)
        both = mx * my
        squares = mx * mx + my * my
        values[i] = ((2 * both + K1**2) * (2 * (xy - both) + K2**2) / ((squares + K1**2) * (xx + yy - squares + K2**2))).mean()
    return values


def psnr_per_image(generated: Any, reference: Any) -> Array:
    """PSNR in dB of each pair of images, infinity where they are identical.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1].
        reference: the same shape.

    Returns:
        (n,) values.

    Raises:
        PalpateError: on other shapes, dtypes or ranges.
    """
    a, b = checked_images(generated, reference)
    error = np.array([((_unit(x) - _unit(y)) ** 2).mean() for x, y in zip(a, b, strict=True)])
    with np.errstate(divide="ignore"):
        return -10 * np.log10(error)


def _mean_score(metric: str, values: Array, ids: Sequence[str] | None, groups: Sequence[str] | None, **rest: Any) -> Score:
    names = checked_names("ids", ids, len(values))
    groups = checked_names("groups", groups, len(values))
    level: float = rest.pop("level")
    finite = np.isfinite(values)
    kept = values[finite]
    identical = int((~finite).sum())
    interval, method = mean_interval(kept, None if groups is None else [g for g, k in zip(groups, finite, strict=True) if k], level)
    if interval is not None and metric == "SSIM":  # the t interval knows no bounds, SSIM does
        interval = (max(-1.0, interval[0]), min(1.0, interval[1]))
    worst = np.argsort(values, kind="stable")[:5]
    details: dict[str, Any] = {
        "sd": float(kept.std(ddof=1)) if len(kept) > 1 else None,
        "median": float(np.median(kept)) if len(kept) else None,
        "identical": identical,
        "lowest": [{"id": names[i] if names else str(i), "value": float(values[i])} for i in worst if finite[i]],
        "groups": len(set(groups)) if groups else None,
        "version": __version__,
    }
    note = f"{identical} of {len(values)} pairs are identical (infinite), left out of the mean" if identical else ""
    if not len(kept):
        note = f"Undefined: all {len(values)} pairs are identical, so the value is infinite"
    elif interval is None:
        note = ". ".join(filter(None, [note, "No interval: one image or one group, or no variation between them"]))
    value = float(kept.mean()) if len(kept) else None
    return Score(
        metric, value=value, interval=interval, level=level, interval_method=method, estimator="per-image mean", n=len(values),
        m=len(values), higher_is_better=True, details=details, note=note, **rest,
    )  # fmt: skip


def ssim(
    generated: Any,
    reference: Any,
    *,
    ids: Sequence[str] | None = None,
    groups: Sequence[str] | None = None,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
) -> Score:
    """Mean SSIM over pairs of images; 1 is identical.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11.
        reference: the same shape; image i is the partner of generated image i.
        ids: n names, for ``details["lowest"]``.
        groups: n group names (videos); the interval is then robust to whole groups deviating together.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.
        level: coverage of the interval.

    Raises:
        PalpateError: as :func:`ssim_per_image`.
    """
    settings = {"window": WINDOW, "sigma": SIGMA, "k1": K1, "k2": K2, "data_range": 1, "border": "valid", "size": _size(generated)}
    values = ssim_per_image(generated, reference)
    return _mean_score("SSIM", values, ids, groups, subject=subject, split=split, level=level, settings=settings)


def psnr(
    generated: Any,
    reference: Any,
    *,
    ids: Sequence[str] | None = None,
    groups: Sequence[str] | None = None,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
) -> Score:
    """Mean PSNR in dB over pairs of images that are not identical.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1].
        reference: the same shape; image i is the partner of generated image i.
        ids: n names, for ``details["lowest"]``.
        groups: n group names (videos), for the interval.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.
        level: coverage of the interval.

    Raises:
        PalpateError: as :func:`psnr_per_image`.
    """
    values = psnr_per_image(generated, reference)
    settings = {"data_range": 1, "size": _size(generated)}
    return _mean_score("PSNR", values, ids, groups, subject=subject, split=split, level=level, settings=settings)


def _size(images: Any) -> list[int]:
    return [int(v) for v in np.shape(images)[1:3]]
