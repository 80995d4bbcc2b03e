"""SSIM, PSNR and MS-SSIM between generated images and their references, averaged over images.

* SSIM (Wang et al. 2004): local means, variances and covariance under an 11 x 11 Gaussian of
  sigma 1.5, ``(2 mx my + C1)(2 cov + C2) / ((mx^2 + my^2 + C1)(vx + vy + C2))``, C1 = (0.01 L)^2,
  C2 = (0.03 L)^2, data range L = 1; population variances, each color channel, averaged over the
  windows that lie inside the image.
* PSNR: ``-10 log10(mean squared error)`` of an image, data range 1, all channels together.
  Identical images have no PSNR (infinite): they are excluded from the mean and counted.
* MS-SSIM (Wang, Simoncelli and Bovik 2003): with the luminance l and the contrast-structure cs of
  SSIM at scale j, where each scale has the 2 x 2 block means of the one before,
  ``l_M^w_M prod_j cs_j^w_j``; cs_j is averaged over the windows of its scale, a negative average
  counts as 0. The coarsest scale must hold a window: five scales need 176 pixels, 64 hold three.

The average is over images, never over pooled pixels. Most pixels of a tactile image show the
sensor itself; :mod:`palpate.metrics.contact` compares the contact alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from palpate._version import __version__
from palpate.core import Note, Score, require
from palpate.metrics.inputs import Array, as_array, checked_names, to_host
from palpate.metrics.intervals import score_of, spread_of_values

Border = Literal["valid", "mirror"]

WINDOW, SIGMA, K1, K2 = 11, 1.5, 0.01, 0.03
#: The window in one direction.
_BELL = np.exp(-0.5 * ((np.arange(WINDOW) - WINDOW // 2) / SIGMA) ** 2)
LINE = _BELL / _BELL.sum()
#: Windows whose sums are one product: longer ones multiply zeros, shorter ones are slow.
TILE = 32
BAND = np.array([np.pad(LINE, (k, TILE - k - 1)) for k in range(TILE)])
#: What a score keeps of the window.
WINDOW_SETTINGS = {"window": WINDOW, "sigma": SIGMA, "k1": K1, "k2": K2}
#: The published exponents, finest scale first. Their sum is 1.0001; all five are as published.
WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


class ImageOptions(TypedDict, total=False):
    """What :meth:`PerImage.score` takes."""

    ids: Sequence[str] | None
    groups: Sequence[str] | None
    subject: str
    split: str | None


def ssim(generated: Any, reference: Any, **options: Unpack[ImageOptions]) -> Score:
    """Mean SSIM over pairs of images; 1 is identical.

    Args:
        generated: (n, h, w, 3 or 1) array or tensor, uint8 or float in [0, 1]; h, w >= 11.
        reference: the same shape; image i is the partner of generated image i.
        **options: of :meth:`PerImage.score`.

    Raises:
        PalpateError: on other shapes, dtypes or ranges, or images smaller than the window.
    """
    return per_image("SSIM", generated, reference).score(**options)


def psnr(generated: Any, reference: Any, **options: Unpack[ImageOptions]) -> Score:
    """Mean PSNR in dB over the pairs of images that are not identical.

    Arguments and errors as :func:`ssim`; images may be smaller than its window.
    """
    return per_image("PSNR", generated, reference).score(**options)


def ms_ssim(generated: Any, reference: Any, **options: Unpack[ImageOptions]) -> Score:
    """Mean MS-SSIM over pairs of images, of as many scales as these hold; 1 is identical.

    Arguments and errors as :func:`ssim`. Weights of fewer than five scales are divided by their
    sum. Values of different numbers of scales are different metrics: the settings keep the number,
    a note names fewer than five.
    """
    return per_image("MS-SSIM", generated, reference).score(**options)


@dataclass(frozen=True)
class PerImage:
    """A metric of each pair of images.

    Attributes:
        metric: its name.
        values: (n,); infinite where the two are identical, NaN where a pair has no value (``notes``
            say why): a mean excludes both.
        bounds: of the metric; a t interval may leave them.
        settings: what a score keeps.
        notes: of the score.
        details: of the score.
        higher_is_better: its direction; None: closer to the floor is better.
        encoder: digest of a network that it needs, or None.
        floor: the same of real images, or None.
    """

    metric: str
    values: Array
    bounds: tuple[float, float] = (-np.inf, np.inf)
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[Note] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    higher_is_better: bool | None = True
    encoder: str | None = None
    floor: float | None = None

    def score(
        self,
        *,
        ids: Sequence[str] | None = None,
        groups: Sequence[str] | None = None,
        subject: str = "generated",
        split: str | None = None,
    ) -> Score:
        """The mean over pairs of images.

        Args:
            ids: n names, for ``details["lowest"]``.
            groups: n groups (videos); the interval is then robust to whole groups deviating
                together.
            subject: what is scored.
            split: digest of the split, kept in the score.
        """
        values, up = self.values, self.higher_is_better
        n, finite = len(values), np.isfinite(values)
        names = checked_names("ids", ids, n) or [str(k) for k in range(n)]
        groups = checked_names("groups", groups, n)
        kept, identical = values[finite], int(np.isinf(values).sum())
        spread = spread_of_values(kept, groups and list(np.array(groups)[finite]))
        worst = [i for i in np.argsort(values if up else -values, kind="stable") if finite[i]][:5]
        details = {
            "sd": float(kept.std(ddof=1)) if len(kept) > 1 else None,
            "median": float(np.median(kept)) if len(kept) else None,
            "identical": identical,
            "lowest" if up else "highest": [
                {"id": names[i], "value": float(values[i])} for i in worst
            ],
            "groups": len(set(groups)) if groups else None,
            "version": __version__,
        }
        if len(kept):
            own = [Note("identical-pairs", {"count": identical, "n": n})] * (identical > 0)
            own += [Note("no-interval-over-images")] * (not spread.known)
        else:
            own = [Note("all-identical", {"n": n}) if identical else Note("no-pair-has-a-value")]
        return score_of(
            self.metric,
            subject,
            spread,
            self.bounds,
            estimator="per-image mean",
            n=n,
            m=n,
            encoder=self.encoder,
            split=split,
            higher_is_better=up,
            floor=self.floor,
            settings=self.settings,
            details=details | dict(self.details),
            notes=(*own, *self.notes),
        )


def per_image(
    metric: Literal["SSIM", "PSNR", "MS-SSIM"],
    generated: Any,
    reference: Any,
    means: Array | None = None,
) -> PerImage:
    """SSIM in [-1, 1], PSNR in dB or MS-SSIM in [0, 1] of each pair of images.

    Arguments and errors as :func:`ssim`; ``means``: of :func:`scale_means`, where they are known.
    """
    x, y = image_pairs(generated, reference)
    size = list(x.shape[1:3])
    settings: dict[str, Any] = {"data_range": 1, "size": size}
    if metric == "PSNR":
        pairs = ((as_unit(a), as_unit(b)) for a, b in zip(x, y, strict=True))
        with np.errstate(divide="ignore"):
            values = -10 * np.log10([((a - b) ** 2).mean() for a, b in pairs])
        return PerImage(metric, values, settings=settings)
    require_side(size, metric)
    settings |= WINDOW_SETTINGS | {"border": "valid"}
    if means is None:
        means = scale_means(x, y, 1 if metric == "SSIM" else len(WEIGHTS))
    if metric == "SSIM":
        return PerImage(metric, means[:, 0, 0].mean(axis=1), (-1.0, 1.0), settings)
    scales = means.shape[1]
    factors = np.append(means[:, :-1, 1], means[:, -1:, 0], axis=1)
    powers = np.maximum(factors, 0) ** scale_weights(scales)[:, None]
    values = powers.prod(axis=1).mean(axis=1)
    weights = [round(float(v), 6) for v in scale_weights(scales)]
    settings |= {"scales": scales, "downsampling": "2 x 2 mean", "weights": weights}
    fewer = Note("fewer-scales", {"scales": scales, "least": least_side(len(WEIGHTS))})
    return PerImage(metric, values, (0.0, 1.0), settings, [fewer] * (scales < len(WEIGHTS)))


def image_pairs(
    generated: Any, reference: Any, arguments: tuple[str, str] = ("generated", "reference")
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Two stacks of images, checked; ``arguments`` names them in errors.

    Raises:
        PalpateError: on other shapes, dtypes or ranges (image numbers are named).
    """
    x, y = image_stack(arguments[0], generated), image_stack(arguments[1], reference)
    must = f"`{arguments[0]}` and `{arguments[1]}` must pair one to one in one size"
    got, fix = f"shapes {x.shape} and {y.shape}", "Pass the same samples in the same order and size"
    require(x.shape == y.shape, None, must, got, fix=fix)
    return x, y


def image_stack(argument: str, images: Any) -> NDArray[Any]:
    """A stack of images, checked; errors as :func:`image_pairs`."""
    pixels = np.asarray(as_array(argument, to_host(images)))
    stacked = pixels.ndim == 4 and pixels.shape[3] in (1, 3) and 0 not in pixels.shape
    must, fix = "must have shape (n, h, w, 3 or 1), n >= 1", "Stack images with channels last"
    require(stacked, argument, must, f"shape {pixels.shape}", fix=fix)
    if pixels.dtype == np.uint8:
        return pixels
    must, fix = "must be uint8, or floats in [0, 1]", "Convert them to this range"
    require(pixels.dtype.kind == "f", argument, must, f"dtype {pixels.dtype}", fix=fix)
    least, most = pixels.min(axis=(1, 2, 3)), pixels.max(axis=(1, 2, 3))
    inside = (least >= -1e-6) & (most <= 1 + 1e-6)  # not for NaN
    k = int(inside.argmin())
    got = f"[{least[k]:.4g}, {most[k]:.4g}] in image {k}"
    require(bool(inside.all()), argument, must, got, fix=fix)
    return pixels


def as_unit(image: NDArray[Any]) -> Array:
    """A checked image as float64 in [0, 1]."""
    return image / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)


def local_maps(
    x: Array, y: Array, border: Border = "valid", data_range: float = 1.0
) -> tuple[Array, Array]:
    """SSIM and its contrast-structure factor at every window.

    Where luminance and structure are both negative, as of an image difference and its negative,
    SSIM is their negative product: it must not call those similar.

    Args:
        x: (h, w, c).
        y: the same shape.
        border: windows inside the image, or one at every pixel of the image mirrored at its edge.
        data_range: L.

    Returns:
        Two (h', w', c).
    """
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    pairs = np.stack([x, y])
    if border == "mirror":
        pairs = np.pad(pairs, ((0, 0), *[(WINDOW // 2,) * 2] * 2, (0, 0)), mode="reflect")
    h, w, c = pairs.shape[1:]
    x, y = pairs.transpose(0, 1, 3, 2).reshape(2, h, c * w)
    rows = _weighted(np.stack([x, y, x * x + y * y, x * y])).reshape(4, -1, w)
    mx, my, both, xy = _weighted(rows.swapaxes(1, 2))  # (4, w', h' c)
    product, squares = mx * my, mx * mx + my * my
    structure = (2 * (xy - product) + c2) / (both - squares + c2)
    similarity = structure * (2 * product + c1) / (squares + c1)
    similarity = np.where(structure < 0, -np.abs(similarity), similarity)
    shape = len(mx), -1, c
    return similarity.reshape(shape).swapaxes(0, 1), structure.reshape(shape).swapaxes(0, 1)


def _weighted(x: Array) -> Array:
    """Means of (k, n, m) over the rows of a window, (k, n - 10, m); a tile of a band a product."""
    k, n, m = x.shape
    means = np.empty((k, n - WINDOW + 1, m))
    for start in range(0, means.shape[1], TILE):
        tile = means[:, start : start + TILE]
        size = tile.shape[1]
        band = BAND[:size, : size + WINDOW - 1]
        np.matmul(band, x[:, start : start + band.shape[1]], out=tile)
    return means


def scale_means(x: NDArray[Any], y: NDArray[Any], most: int = len(WEIGHTS)) -> Array:
    """(n, scales, 2, c) means over the windows of SSIM and of its contrast-structure factor.

    ``most``: of the scales that the images hold.
    """
    scales = min(most, fitting_scales(x.shape[1:3]))
    means = np.empty((len(x), scales, 2, x.shape[3]))
    for k, pair in enumerate(zip(x, y, strict=True)):
        a, b = map(as_unit, pair)
        for j in range(scales):
            a, b = (_halved(a), _halved(b)) if j else (a, b)
            for factor, mean in zip(local_maps(a, b), means[k, j], strict=True):
                rows = factor.swapaxes(0, 1).reshape(-1, len(mean))
                mean[:] = np.ones(len(rows)) @ rows / len(rows)  # a sum over short rows is slow
    return means


def _halved(image: Array) -> Array:
    """Means of 2 x 2 blocks of (h, w, c); an odd last row or column is dropped."""
    h, w = (side // 2 * 2 for side in image.shape[:2])
    rows = image[0:h:2] + image[1:h:2]
    return (rows[:, 0:w:2] + rows[:, 1:w:2]) / 4


def least_side(scales: int) -> int:
    """The shorter side in pixels that so many scales need."""
    return WINDOW << (scales - 1)


def fitting_scales(size: Sequence[int]) -> int:
    """How many scales, of at most five, an image (height, width) holds."""
    return sum(min(size) >= least_side(m) for m in range(1, len(WEIGHTS) + 1))


def scale_weights(scales: int) -> Array:
    """(scales,) the first published exponents, divided by their sum unless it is all five."""
    weights = np.array(WEIGHTS[:scales])
    return weights if scales == len(WEIGHTS) else weights / weights.sum()


def require_side(size: Sequence[int], metric: str) -> None:
    """Reject images (height, width) that are smaller than a window."""
    must = f"Images must be at least {WINDOW} x {WINDOW} for {metric}"
    big = min(size) >= WINDOW
    require(big, None, must, f"{size[0]} x {size[1]}", fix="Score larger images")
