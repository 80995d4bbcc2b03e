"""Contact metrics: image minus background inside the contact mask.

Most pixels of a tactile image show the sensor, and a generator that returns the no-contact image
(the background) gets them right. Here every image is reduced to d = image - background in [-1, 1]
and compared where the real image shows contact, so that the no-contact image earns nothing:

* *Mask*: root mean square of d over the channels, markers filled from around them, blurred by a
  Gaussian of 1/48 of the shorter side, above a threshold: 4 gray levels, or three times what the
  noise of that background leaves after the blur if that is more; then dilated by 1/64 of the side.
  An image whose mask covers under 1 % of the pixels shows no contact: it is excluded and counted.
* *Markers*: pixels darker than 0.82 of the median luma around, of the image or the background, and
  (from 48 px on) a pixel around them. They move with the membrane and would outweigh the print (on
  the real clips of Touch and Go they hold three quarters of the squared d), so they are skipped.
* *Residual*: ``sum (d' - d)^2 / sum (d'^2 + d^2)`` over the mask, d' generated. 0: identical; 1:
  the no-contact image, and on average any contact unrelated to the real one; 2: its negative. The
  sum below is over both, because sum d^2 alone would reward the no-contact image.
* *SSIM*: the SSIM map of d' and d, with a window at every pixel, averaged over mask and channels.
  Its data range is 0.25, a few deviations of a contact: with 2, the range of d, C2 exceeds the
  contact's variance and the no-contact image scores above a real image of the same material.
* *IoU*: of the generated mask and the real one. A contact everywhere has ``details["area"]``.

Compare each with ``details["empty"]``, the score of the no-contact image.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, Unpack

import numpy as np
import scipy

from palpate.core import Note, Score
from palpate.metrics.images import (
    WINDOW_SETTINGS,
    Array,
    ImageOptions,
    PerImage,
    as_unit,
    image_pairs,
    image_stack,
    local_maps,
    require_side,
)
from palpate.metrics.inputs import checked_names, to_host
from palpate.metrics.markers import Mask, marker_mask

#: Data range of the SSIM of differences.
SSIM_RANGE = 0.25
_SSIM_SETTINGS = WINDOW_SETTINGS | {"border": "mirror", "data_range": SSIM_RANGE}
#: Metric -> bounds, whether higher is better, settings of its own.
METRICS: dict[str, tuple[tuple[float, float], bool, dict[str, Any]]] = {
    "contact residual": ((0, 2), False, {"energy": "both"}),
    "contact SSIM": ((-1, 1), True, _SSIM_SETTINGS),
    "contact IoU": ((0, 1), True, {}),
}
#: Least change that is a contact, on the scale of [0, 1].
LEAST = 4 / 255
#: How many times the noise after the blur a contact must exceed.
TIMES_NOISE = 3.0
#: Share of the pixels under which a mask is empty.
SMALLEST = 0.01
#: What every score keeps of the comparison.
SETTINGS = {"markers": "skip", "least": round(LEAST, 6), "generated_background": "real"}


def contact_mask(tactile: Any, background: Any) -> Mask:
    """Where each tactile image shows contact.

    Args:
        tactile: (n, h, w, 3 or 1) array or tensor, uint8 or float in [0, 1].
        background: the same shape, or one image (h, w, c) for all: the gel without contact, of the
            same sensor at the same time.

    Returns:
        (n, h, w), markers included; all False where there is no contact.

    Raises:
        PalpateError: on other shapes, dtypes or ranges.
    """
    background = for_all(background, tactile)
    x, gel = image_pairs(tactile, background, arguments=("tactile", "background"))
    return np.stack([mask_of(as_unit(a), as_unit(b))[0] for a, b in zip(x, gel, strict=True)])


def contact_scores(
    generated: Any, reference: Any, background: Any, **options: Unpack[ImageOptions]
) -> list[Score]:
    """Mean contact residual, SSIM and IoU, over the images that show contact.

    Args:
        generated: (n, h, w, 3 or 1) array or tensor, uint8 or float in [0, 1]; h, w >= 11.
        reference: the same shape: the real tactile image of each generated one.
        background: the same shape, or one image (h, w, c) for all: the real gel without contact.
        **options: of :meth:`palpate.metrics.PerImage.score`.

    Returns:
        Three scores: residual (0: identical, 1: no contact), SSIM, IoU of the masks. Images without
        contact are excluded; ``details["no_contact"]`` counts them and names the first ten.

    Raises:
        PalpateError: on other shapes, dtypes or ranges, or images smaller than the window.
    """
    each = contact_per_image({"": generated}, reference, background, options.get("ids"))[""]
    return [metric.score(**options) for metric in each]


def contact_per_image(
    generated: Mapping[str, Any], reference: Any, background: Any, ids: Sequence[str] | None = None
) -> dict[str, list[PerImage]]:
    """Contact residual, SSIM and IoU of each pair of several stacks, by name; NaN without contact.

    What the real images show is measured once. ``details["empty"]`` is the score of the no-contact
    image, ``details["area"]`` the mean share of the pixels in the real mask. Arguments and errors
    as :func:`contact_scores`.
    """
    backgrounds = for_all(background, reference)
    real, gels = image_pairs(reference, backgrounds, arguments=("reference", "background"))
    require_side(real.shape[1:3], "contact metrics")
    stacks = {name: image_pairs(images, real)[0] for name, images in generated.items()}
    n = len(real)
    names = checked_names("ids", ids, n) or [str(i) for i in range(n)]
    area, empty = np.zeros(n), np.full((len(METRICS), n), np.nan)
    values = {name: empty.copy() for name in stacks}
    for i, pair in enumerate(zip(real, gels, strict=True)):
        tactile, gel = map(as_unit, pair)
        markers = marker_mask(gel)
        mask, near_marker = mask_of(tactile, gel, markers)
        contact, compared = tactile - gel, mask & ~near_marker
        if not compared.any():
            continue
        area[i] = mask.mean()
        empty[:, i] = *_residual_and_ssim(np.zeros_like(contact), contact, compared), 0.0
        for name, images in stacks.items():
            image = as_unit(images[i])
            generated_mask = mask_of(image, gel, markers)[0]
            iou = (mask & generated_mask).sum() / (mask | generated_mask).sum()
            values[name][:, i] = *_residual_and_ssim(image - gel, contact, compared), iou
    without = np.flatnonzero(area == 0)
    notes = [Note("no-contact", {"count": len(without), "n": n})] * (len(without) > 0)
    shared = {"no_contact": {"count": len(without), "ids": [names[i] for i in without[:10]]}}
    shared |= {"area": _mean(area[area > 0])}
    size = list(real.shape[1:3])
    settings = SETTINGS | {"size": size, "background": background_digest(background)}
    return {
        name: [
            PerImage(
                metric,
                of_metric,
                bounds,
                settings | further,
                notes,
                {"empty": _mean(of_empty), **shared},
                higher_is_better,
            )
            for (metric, (bounds, higher_is_better, further)), of_metric, of_empty in zip(
                METRICS.items(), of_name, empty, strict=True
            )
        ]
        for name, of_name in values.items()
    }


def _residual_and_ssim(x: Array, y: Array, at: Mask) -> tuple[float, float]:
    """Residual and SSIM of a generated and a real difference (h, w, c), on the pixels ``at``."""
    error, real, generated = (float((v[at] ** 2).mean()) for v in (x - y, y, x))
    residual = error / (real + generated) if real + generated else np.nan
    return residual, float(local_maps(x, y, "mirror", SSIM_RANGE)[0][at].mean())


def _mean(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def for_all(background: Any, images: Any) -> Any:
    """One background (h, w, c) repeated for all images (n, h, w, c); a stack as it is."""
    if getattr(background, "ndim", 4) != 3:
        return background
    gel = np.asarray(to_host(background))
    return np.broadcast_to(gel, (len(images), *gel.shape))


def background_digest(images: Any) -> str:
    """Sixteen digits for the different images of a stack, or one, in any order and dtype.

    16 bits a channel, so that uint8 and float of one image agree. Contact scores against other
    backgrounds are not comparable.
    """
    rows = {
        hashlib.sha256(np.rint(as_unit(image) * 65535).astype("<u2").tobytes()).digest()
        for image in image_stack("background", for_all(images, [0]))  # one image: a stack of one
    }
    return hashlib.sha256(b"".join(sorted(rows))).hexdigest()[:16]


def mask_of(image: Array, background: Array, markers: Mask | None = None) -> tuple[Mask, Mask]:
    """Contact mask (h, w) of one image, and the pixels on or next to a marker.

    ``markers``: those of the background; None to look for them.
    """
    still = marker_mask(background) if markers is None else markers
    return contact_of(image, background, (marker_mask(image), still))[:2]


def contact_of(
    image: Array, background: Array, markers: tuple[Mask, Mask]
) -> tuple[Mask, Mask, Array]:
    """Contact mask (h, w) of one image, the pixels on or next to a marker, and the smoothed |d|.

    ``markers``: of the image and of the background.
    """
    side = min(image.shape[:2])
    near = markers[0] | markers[1]
    if side >= 48:  # a smaller image has markers of a pixel, and hardly two of gel between them
        near = _dilated(near, side // 96)
    sigma = side / 48
    change = fill(image - background, ~near, side / 32)
    change = scipy.ndimage.gaussian_filter(change, (sigma, sigma, 0))
    # of white noise, that of two images: a Gaussian blur leaves 1 / (2 sqrt(pi) sigma) of its sd
    noise = np.sqrt(2) * _noise(background, ~near) / (2 * np.sqrt(np.pi) * max(sigma, 0.5))
    size = np.sqrt((change**2).mean(axis=2))
    mask = size > max(LEAST, TIMES_NOISE * noise)
    if mask.mean() < SMALLEST:
        return np.zeros_like(mask), near, size
    return _dilated(mask, side // 64), near, size


def fill(image: Array, keep: Mask, sigma: float) -> Array:
    """An image (h, w, c) with the pixels not kept replaced by a blur of the kept ones around."""
    weights = keep[..., None].astype(np.float64)
    blur = (sigma, sigma, 0)
    around = scipy.ndimage.gaussian_filter(image * weights, blur)
    around /= np.maximum(scipy.ndimage.gaussian_filter(weights, blur), 1e-6)
    return np.where(keep[..., None], image, around)


def _noise(background: Array, keep: Mask) -> float:
    """Standard deviation of a pixel's noise away from the markers.

    1.4826 times the median size of normal noise is its standard deviation; that of the second
    difference in both directions, which flat gel does not have, is 6 (the norm of its weights)
    times a pixel's. 0 where hardly a pixel is away from the markers.
    """
    away = np.asarray(scipy.ndimage.binary_erosion(keep, np.ones((3, 3)), border_value=1), bool)
    if away.mean() < 1 / 16:
        return 0.0
    kernel = np.outer([1, -2, 1], [1, -2, 1])[..., None]
    change = np.abs(scipy.ndimage.convolve(background, kernel, mode="mirror"))
    return 1.4826 * float(np.median(change[away])) / 6


def _dilated(mask: Mask, pixels: int) -> Mask:
    return np.asarray(scipy.ndimage.binary_dilation(mask, iterations=max(1, pixels)), bool)
