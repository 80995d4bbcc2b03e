"""MS-SSIM: structural similarity over several scales, averaged over images.

Wang, Simoncelli and Bovik 2003: with the factors l (luminance) and cs (contrast and structure) of SSIM at scale j, where scale 1 is the
image and each further one has the 2 x 2 block means of the one before (a last odd row or column is dropped),

    MS-SSIM = l_M^w_M  prod_j cs_j^w_j,      w = 0.0448, 0.2856, 0.3001, 0.2363, 0.1333

with cs_j averaged over the windows of scale j, at the last scale the average of l cs; a negative average counts as 0, for it has no real
power. Each scale is on the convention of our SSIM (``pairwise``): Gaussian 11 / 1.5, windows inside the image, each color channel on its
own; the mean over channels is taken of the products.

The coarsest scale must hold a window of 11 pixels: five scales need 176 pixels a side, an image of 64 holds three. ``scales="auto"``
takes as many as fit and divides their weights by their sum; MS-SSIM of unequal numbers of scales are different metrics, so the settings
keep the number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError, Score
from palpate.metrics.compat import (
    OWN,
    WINDOW,
    Convention,
    Pairs,
    Range,
    checked_pairs,
    local_maps,
    pooled,
)
from palpate.metrics.kernels import Array
from palpate.metrics.pairwise import mean_score

#: The published exponents, finest scale first. Their sum is 1.0001; all five are taken as published.
WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
Scales = int | Literal["auto"]


def least_side(scales: int) -> int:
    """The shorter side in pixels that so many scales need."""
    return WINDOW << (scales - 1)


def scale_weights(scales: int) -> Array:
    """(scales,) exponents: the first of the published ones, divided by their sum unless it is all five."""
    weights = np.array(WEIGHTS[:scales])
    return weights if scales == len(WEIGHTS) else weights / weights.sum()


def ms_ssim_per_image(
    generated: Any, reference: Any, *, scales: Scales = "auto", data_range: Range | None = None
) -> Array:
    """MS-SSIM of each pair of images.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11.
        reference: the same shape.
        scales: 1 to 5, or as many as the images hold.
        data_range: of other numbers, see :func:`palpate.metrics.pairwise.ssim`.

    Returns:
        (n,) values in [0, 1].

    Raises:
        PalpateError: on other shapes, dtypes, ranges, or images too small for the scales (the side they need is named).
    """
    pairs = checked_pairs(generated, reference, data_range)
    return _values(pairs, _number(scales, pairs))


def ms_ssim(
    generated: Any,
    reference: Any,
    *,
    ids: Sequence[str] | None = None,
    groups: Sequence[str] | None = None,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
    scales: Scales = "auto",
    data_range: Range | None = None,
) -> Score:
    """Mean MS-SSIM over pairs of images; 1 is identical.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11.
        reference: the same shape; image i is the partner of generated image i.
        ids: n names, for ``details["lowest"]``.
        groups: n group names (videos); the interval is then robust to whole groups deviating together.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.
        level: coverage of the interval.
        scales: 1 to 5, or ``"auto"``: as many as the images hold, which the settings keep and, below five, the note says.
        data_range: of other numbers, see :func:`palpate.metrics.pairwise.ssim`.

    Raises:
        PalpateError: as :func:`ms_ssim_per_image`.
    """
    pairs = checked_pairs(generated, reference, data_range)
    number = _number(scales, pairs)
    size = [int(v) for v in pairs.a.shape[1:3]]
    settings = OWN.settings | {
        "data_range": pairs.data_range,
        "border": OWN.border,
        "size": size,
        "scales": number,
        "downsampling": "2 x 2 mean",
        "weights": [round(float(v), 6) for v in scale_weights(number)],
    }
    note = ""
    if number < len(WEIGHTS):
        why = (
            f"five need {least_side(len(WEIGHTS))} pixels a side"
            if scales == "auto"
            else "as asked"
        )
        note = f"{number} of the 5 scales ({why}), weights divided by their sum: not comparable with MS-SSIM of 5"
    return mean_score(
        "MS-SSIM",
        _values(pairs, number),
        ids,
        groups,
        bounds=(0.0, 1.0),
        subject=subject,
        split=split,
        level=level,
        settings=settings,
        note=note,
        details=pairs.coding,
    )


def fitting_scales(size: Sequence[int]) -> int:
    """How many scales, of at most five, an image of that height and width holds; 0 where it is smaller than the window."""
    return max((m for m in range(1, len(WEIGHTS) + 1) if min(size) >= least_side(m)), default=0)


def weighted_ms_ssim(
    x: Array, y: Array, kept: NDArray[np.bool_], scales: int, convention: Convention, reach: float
) -> float:
    """MS-SSIM of two images over some of their pixels.

    The factors of each scale are averaged with the share of a cell that is kept as weight; a last odd row or column is repeated instead of
    dropped, so that what is kept there counts.

    Args:
        x: (c, h, w).
        y: the same shape.
        kept: (h, w), at least one pixel.
        scales: of :func:`fitting_scales`.
        convention: a window at every pixel (``border="mirror"``).
        reach: the data range.

    Returns:
        A value in [0, 1].
    """
    weight, means = kept.astype(np.float64)[None], np.empty((scales, len(x)))
    for j in range(scales):
        if j:
            x, y, weight = (
                pooled(_even(x, "edge"), 2),
                pooled(_even(y, "edge"), 2),
                pooled(_even(weight, "constant"), 2),
            )
        similarity, structure = signed_maps(x, y, convention, reach)
        means[j] = np.average(
            (similarity if j == scales - 1 else structure).reshape(len(x), -1),
            axis=1,
            weights=weight.ravel(),
        )
    return float(np.prod(np.maximum(means, 0) ** scale_weights(scales)[:, None], axis=0).mean())


def signed_maps(x: Array, y: Array, convention: Convention, reach: float) -> tuple[Array, Array]:
    """As :func:`palpate.metrics.compat.local_maps`, of images that have negative values: those of a touch and of its negative have both factors
    negative, and their product must not call that alike.
    """
    similarity, structure = local_maps(x, y, convention, reach)
    return np.where((structure < 0) & (similarity > 0), -similarity, similarity), structure


def _even(image: Array, mode: Literal["edge", "constant"]) -> Array:
    """(c, h, w) with even h and w."""
    return np.pad(image, [(0, 0), *((0, n % 2) for n in image.shape[1:])], mode=mode)


def _number(scales: Any, pairs: Pairs) -> int:
    side = min(pairs.a.shape[1:3])
    size = f"{pairs.a.shape[1]} x {pairs.a.shape[2]}"
    if scales == "auto":
        if side < WINDOW:
            raise PalpateError(
                f"Images must be at least {WINDOW} x {WINDOW} for MS-SSIM",
                size,
                "Score larger images",
            )
        return fitting_scales(pairs.a.shape[1:3])
    if (
        isinstance(scales, bool)
        or not isinstance(scales, int | np.integer)
        or not 1 <= scales <= len(WEIGHTS)
    ):
        raise PalpateError(
            f'scales must be "auto" or a whole number from 1 to {len(WEIGHTS)}',
            repr(scales),
            "Leave it out for the default",
        )
    if side < (need := least_side(int(scales))):
        fix = f'Score images of at least {need} pixels a side, or pass scales="auto"'
        raise PalpateError(
            f"Images must be at least {need} x {need} for MS-SSIM of {scales} scales", size, fix
        )
    return int(scales)


def _values(pairs: Pairs, scales: int) -> Array:
    weights, values = scale_weights(scales)[:, None], np.empty(len(pairs))
    for i in range(len(pairs)):
        x, y = pairs.channels(i)
        means = np.empty((scales, len(x)))
        for j in range(scales):
            if j:
                x, y = pooled(x, 2), pooled(y, 2)
            similarity, structure = local_maps(x, y, OWN)
            means[j] = (similarity if j == scales - 1 else structure).mean(axis=(1, 2))
        values[i] = np.prod(np.maximum(means, 0) ** weights, axis=0).mean()
    return values
