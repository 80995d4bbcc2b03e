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

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate import __version__
from palpate.core import Note, PalpateError, Score
from palpate.metrics.inputs import as_array, checked_level, checked_names, to_host
from palpate.metrics.intervals import mean_interval

Array = NDArray[np.float64]
Range = float | tuple[float, float]
Scales = int | Literal["auto"]
Border = Literal["valid", "mirror"]

WINDOW, SIGMA, K1, K2 = 11, 1.5, 0.01, 0.03
#: What a score keeps of the window.
WINDOW_SETTINGS = {"window": WINDOW, "sigma": SIGMA, "k1": K1, "k2": K2}
#: The published exponents, finest scale first. Their sum is 1.0001; all five are as published.
WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


class ScoreOptions(TypedDict, total=False):
    """Options of every score of pairs of images.

    Keys:
        ids: n names, for ``details["lowest"]``.
        groups: n groups (videos); the interval is then robust to whole groups deviating together.
        subject: what is scored, default ``"generated"``.
        split: digest of the split, kept in the score.
        level: coverage of the interval, default 0.95.
    """

    ids: Sequence[str] | None
    groups: Sequence[str] | None
    subject: str
    split: str | None
    level: float


def ssim(
    generated: Any,
    reference: Any,
    *,
    data_range: Range | None = None,
    **options: Unpack[ScoreOptions],
) -> Score:
    """Mean SSIM over pairs of images; 1 is identical.

    Args:
        generated: (n, h, w, 3 or 1) array or tensor, uint8 or float in [0, 1]; h, w >= 11.
        reference: the same shape; image i is the partner of generated image i.
        data_range: ``(low, high)``, or ``high`` with low = 0, of other numbers; they are mapped to
            [0, 1], so the score does not depend on the coding (``details["coding"]`` keeps it).
        **options: see :class:`ScoreOptions`.

    Raises:
        PalpateError: on other shapes, dtypes or ranges, or images smaller than the window.
    """
    pairs = image_pairs(generated, reference, data_range)
    settings = WINDOW_SETTINGS | {"data_range": 1, "border": "valid"}
    return _pair_score("SSIM", pairs, _ssim(pairs), settings, (-1.0, 1.0), **options)


def ssim_per_image(generated: Any, reference: Any, *, data_range: Range | None = None) -> Array:
    """SSIM (n,) in [-1, 1] of each pair of images; arguments and errors as :func:`ssim`."""
    return _ssim(image_pairs(generated, reference, data_range))


def psnr(
    generated: Any,
    reference: Any,
    *,
    data_range: Range | None = None,
    **options: Unpack[ScoreOptions],
) -> Score:
    """Mean PSNR in dB over the pairs of images that are not identical.

    Arguments and errors as :func:`ssim`; images may be smaller than its window.
    """
    pairs = image_pairs(generated, reference, data_range)
    return _pair_score("PSNR", pairs, _psnr(pairs), {"data_range": 1}, **options)


def psnr_per_image(generated: Any, reference: Any, *, data_range: Range | None = None) -> Array:
    """PSNR (n,) in dB of each pair, infinity where identical; arguments as :func:`psnr`."""
    return _psnr(image_pairs(generated, reference, data_range))


def ms_ssim(
    generated: Any,
    reference: Any,
    *,
    data_range: Range | None = None,
    scales: Scales = "auto",
    **options: Unpack[ScoreOptions],
) -> Score:
    """Mean MS-SSIM over pairs of images; 1 is identical.

    Arguments and errors as :func:`ssim`, and ``scales``: 1 to 5, or ``"auto"`` for as many as the
    images hold. Weights of fewer than five are divided by their sum. Values of different numbers
    of scales are different metrics: the settings keep the number, a note names fewer than five.
    """
    pairs = image_pairs(generated, reference, data_range)
    count = _scale_count(scales, pairs.size)
    weights = [round(float(v), 6) for v in scale_weights(count)]
    settings = WINDOW_SETTINGS | {"data_range": 1, "border": "valid", "scales": count}
    settings |= {"downsampling": "2 x 2 mean", "weights": weights}
    few = Note("fewer-scales", {"scales": count, "least": least_side(5), "auto": scales == "auto"})
    notes = [few] if count < len(WEIGHTS) else []
    values = _ms_ssim(pairs, count)
    return _pair_score("MS-SSIM", pairs, values, settings, (0.0, 1.0), notes=notes, **options)


def ms_ssim_per_image(
    generated: Any, reference: Any, *, data_range: Range | None = None, scales: Scales = "auto"
) -> Array:
    """MS-SSIM (n,) in [0, 1] of each pair of images; arguments and errors as :func:`ms_ssim`."""
    pairs = image_pairs(generated, reference, data_range)
    return _ms_ssim(pairs, _scale_count(scales, pairs.size))


def _pair_score(
    metric: str,
    pairs: Pairs,
    values: Array,
    settings: dict[str, Any],
    bounds: tuple[float, float] = (-np.inf, np.inf),
    **fields: Any,
) -> Score:
    fields = {"subject": "generated", "bounds": bounds, "details": pairs.coding} | fields
    return mean_score(metric, values, settings=settings | {"size": pairs.size}, **fields)


def mean_score(
    metric: str,
    values: Array,
    *,
    ids: Sequence[str] | None = None,
    groups: Sequence[str] | None = None,
    bounds: tuple[float, float] = (-np.inf, np.inf),
    higher_is_better: bool = True,
    level: float = 0.95,
    notes: Sequence[Note] = (),
    **fields: Any,
) -> Score:
    """The score of a mean over pairs of images.

    Args:
        metric: its name.
        values: (n,) one a pair; infinite where a pair is identical, NaN where it has no value
            (``notes`` say why): both are excluded.
        ids: n names.
        groups: n groups.
        bounds: of the metric; a t interval may leave them.
        higher_is_better: its direction.
        level: coverage of the interval.
        notes: further notes.
        **fields: further fields of the score; ``details`` are merged with those made here.
    """
    checked_level(level)
    n, finite = len(values), np.isfinite(values)
    names = checked_names("ids", ids, n) or [str(k) for k in range(n)]
    groups = checked_names("groups", groups, n)
    kept, identical = values[finite], int(np.isinf(values).sum())
    kept_groups = None if groups is None else list(np.array(groups)[finite])
    interval, method = mean_interval(kept, kept_groups, level)
    if interval is not None:
        interval = (max(bounds[0], interval[0]), min(bounds[1], interval[1]))
    badness = np.where(finite, -values if higher_is_better else values, -np.inf)
    worst = [i for i in np.argsort(-badness, kind="stable")[:5] if finite[i]]
    details = {
        "sd": float(kept.std(ddof=1)) if len(kept) > 1 else None,
        "median": float(np.median(kept)) if len(kept) else None,
        "identical": identical,
        "lowest" if higher_is_better else "highest": [
            {"id": names[i], "value": float(values[i])} for i in worst
        ],
        "groups": len(set(groups)) if groups else None,
        "version": __version__,
    }
    return Score(
        metric,
        value=float(kept.mean()) if len(kept) else None,
        interval=interval,
        level=level,
        interval_method=method,
        estimator="per-image mean",
        n=n,
        m=n,
        higher_is_better=higher_is_better,
        details=details | fields.pop("details", {}),
        notes=(*_mean_notes(n, len(kept), identical, interval is None), *notes),
        **fields,
    )


def _mean_notes(n: int, kept: int, identical: int, no_interval: bool) -> list[Note]:
    if not kept:
        return [Note("all-identical", {"n": n}) if identical else Note("no-pair-has-a-value")]
    notes = [Note("identical-pairs", {"count": identical, "n": n})] if identical else []
    return notes + ([Note("no-interval-over-images")] if no_interval else [])


def paired_by_id(
    generated_ids: Sequence[str], reference_ids: Sequence[str]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of the two images of each id; the order of the lists may differ, their ids may not.

    Returns:
        Two (n,) such that ``generated[first]`` and ``reference[second]`` are partners, in the
        order of ``reference_ids``.

    Raises:
        PalpateError: if an id is repeated, or is in one list only; the first few are named.
    """
    generated, reference = ([str(v) for v in ids] for ids in (generated_ids, reference_ids))
    for name, ids in (("generated", generated), ("reference", reference)):
        if not ids:
            raise PalpateError(f"There must be {name} ids", "none", f"Pass the {name} ids")
        if repeated := [i for i, count in Counter(ids).items() if count > 1]:
            got = f"{len(repeated)} repeated: {_first(repeated)}"
            raise PalpateError(f"Every {name} id must be unique", got, "Keep one image an id")
    row, known = {name: k for k, name in enumerate(generated)}, set(reference)
    missing = [i for i in reference if i not in row]
    surplus = [i for i in generated if i not in known]
    if missing or surplus:
        lists = (("not generated", missing), ("without reference", surplus))
        got = "; ".join(f"{len(ids)} {what}: {_first(ids)}" for what, ids in lists if ids)
        fix = "Score the same samples in both: take() the common ids if that is what you mean"
        raise PalpateError("Generated and reference ids must be the same set", got, fix)
    return np.array([row[i] for i in reference], np.intp), np.arange(len(reference))


def _first(ids: Sequence[str]) -> str:
    return ", ".join(map(repr, ids[:3])) + f" and {len(ids) - 3} more" * (len(ids) > 3)


@dataclass(frozen=True)
class Stack:
    """Checked images (n, h, w, c) whose numbers run from ``low`` (black) to ``high``."""

    pixels: NDArray[Any]
    low: float
    high: float

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, i: int) -> Array:
        """Image i (h, w, c) as float64 in [0, 1]."""
        return (self.pixels[i].astype(np.float64) - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class Pairs:
    """Two stacks of one shape; iterates over pairs of images (h, w, c) in [0, 1]."""

    generated: Stack
    reference: Stack
    data_range: Range | None = None

    def __len__(self) -> int:
        return len(self.reference)

    def __getitem__(self, i: int) -> tuple[Array, Array]:
        return self.generated[i], self.reference[i]

    def __iter__(self) -> Iterator[tuple[Array, Array]]:
        return (self[i] for i in range(len(self)))

    @property
    def size(self) -> list[int]:
        """Height and width."""
        return [int(v) for v in self.reference.pixels.shape[1:3]]

    @property
    def coding(self) -> dict[str, list[float]]:
        """``{"coding": [low, high]}`` where the range was given."""
        given = self.data_range is not None
        return {"coding": [self.reference.low, self.reference.high]} if given else {}


def image_pairs(
    generated: Any,
    reference: Any,
    data_range: Range | None = None,
    arguments: tuple[str, str] = ("generated", "reference"),
) -> Pairs:
    """Two stacks of images, checked; ``arguments`` names them in errors.

    Raises:
        PalpateError: on other shapes, dtypes or ranges (image numbers are named).
    """
    pair = zip(arguments, (generated, reference), strict=True)
    x, y = (image_stack(name, images, data_range) for name, images in pair)
    if x.pixels.shape != y.pixels.shape:
        must = f"`{arguments[0]}` and `{arguments[1]}` must pair one to one in one size"
        got = f"shapes {x.pixels.shape} and {y.pixels.shape}"
        raise PalpateError(must, got, "Pass the same samples in the same order and size")
    return Pairs(x, y, data_range)


def image_stack(argument: str, images: Any, data_range: Range | None = None) -> Stack:
    """A stack of images, checked; errors as :func:`image_pairs`."""
    pixels = np.asarray(as_array(argument, to_host(images)))
    if pixels.ndim != 4 or pixels.shape[3] not in (1, 3) or 0 in pixels.shape:
        must, got = "must have shape (n, h, w, 3 or 1), n >= 1", f"shape {pixels.shape}"
        raise PalpateError(must, got, "Stack images with channels last", argument=argument)
    kind = pixels.dtype.kind
    if data_range is None:
        if pixels.dtype == np.uint8:
            return Stack(pixels, 0, 255)
        must, kinds, low, high = "must be uint8, or floats in [0, 1]", "f", 0.0, 1.0
    else:
        low, high = _span(data_range)
        must, kinds = f"must be numbers in [{low:g}, {high:g}]", "uif"
    fix, example = "Pass the range of the numbers", {"data_range": (-1, 1)}
    if kind not in kinds:
        raise PalpateError(must, f"dtype {pixels.dtype}", "Convert them", argument=argument)
    least, most = pixels.min(axis=(1, 2, 3)), pixels.max(axis=(1, 2, 3))
    slack = 1e-6 * (high - low)
    if (bad := ~((least >= low - slack) & (most <= high + slack))).any():  # also for NaN
        k = int(bad.argmax())
        got = f"[{least[k]:.4g}, {most[k]:.4g}] in image {k}"
        raise PalpateError(must, got, fix, argument=argument, example=example)
    if kind == "f" and high - low >= 100 and least.min() >= 0 and 0 < most.max() <= 1:
        must = f"must fill the data range [{low:g}, {high:g}]"
        raise PalpateError(must, "floats in [0, 1]", "Scale the images", argument=argument)
    return Stack(pixels, low, high)


def _span(data_range: Any) -> tuple[float, float]:
    try:
        low, high = map(float, (0, data_range) if np.ndim(data_range) == 0 else data_range)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not -np.inf < low < high < np.inf:
        must = "must be a positive number, or (low, high) with low < high"
        fix, example = "Pass the range of the numbers", {"data_range": (-1, 1)}
        raise PalpateError(must, repr(data_range), fix, argument="data_range", example=example)
    return low, high


def _ssim(pairs: Pairs) -> Array:
    require_side(pairs.size, WINDOW, "SSIM")
    return np.array([local_maps(x, y)[0].mean() for x, y in pairs])


def _psnr(pairs: Pairs) -> Array:
    with np.errstate(divide="ignore"):
        return -10 * np.log10([((x - y) ** 2).mean() for x, y in pairs])


def _ms_ssim(pairs: Pairs, scales: int) -> Array:
    return np.array([multiscale_similarity(x, y, scales) for x, y in pairs])


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
    weights = np.exp(-0.5 * ((np.arange(WINDOW) - WINDOW // 2) / SIGMA) ** 2)
    weights /= weights.sum()
    cut = WINDOW // 2 if border == "valid" else 0
    rows, columns = (slice(cut, side - cut) for side in x.shape[:2])
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2

    def blur(image: Array) -> Array:
        image = ndimage.correlate1d(image, weights, axis=0, mode="mirror")[rows]
        return ndimage.correlate1d(image, weights, axis=1, mode="mirror")[:, columns]

    mx, my, xx, yy, xy = blur(x), blur(y), blur(x * x), blur(y * y), blur(x * y)
    product, squares = mx * my, mx * mx + my * my
    structure = (2 * (xy - product) + c2) / (xx + yy - squares + c2)
    similarity = structure * (2 * product + c1) / (squares + c1)
    return np.where(structure < 0, -np.abs(similarity), similarity), structure


def multiscale_similarity(
    x: Array, y: Array, scales: int, kept: NDArray[np.bool_] | None = None, data_range: float = 1.0
) -> float:
    """MS-SSIM in [0, 1] of two images (h, w, c), or of some of their pixels.

    With ``kept`` (h, w) there is a window at every pixel, each scale is averaged with the share of
    a cell that is kept as weight, and a last odd row or column is repeated instead of dropped.
    """
    border: Border = "valid" if kept is None else "mirror"
    weights = None if kept is None else kept[..., None].astype(np.float64)
    means = np.empty((scales, x.shape[2]))
    for j in range(scales):
        if j:
            x, y = (_halved(v, None if kept is None else "edge") for v in (x, y))
            weights = None if weights is None else _halved(weights, "constant")
        similarity, structure = local_maps(x, y, border, data_range)
        factor = similarity if j == scales - 1 else structure
        if weights is None:
            means[j] = factor.mean(axis=(0, 1))
        else:
            means[j] = (factor * weights).sum(axis=(0, 1)) / weights.sum()
    powers = np.maximum(means, 0) ** scale_weights(scales)[:, None]
    return float(powers.prod(axis=0).mean())


def _halved(image: Array, pad: Literal["edge", "constant"] | None) -> Array:
    """Means of 2 x 2 blocks of (h, w, c); an odd last row or column is padded, or dropped."""
    h, w, c = image.shape
    if pad is not None:
        image = np.pad(image, [(0, h % 2), (0, w % 2), (0, 0)], mode=pad)
        h, w = image.shape[:2]
    return image[: h // 2 * 2, : w // 2 * 2].reshape(h // 2, 2, w // 2, 2, c).mean(axis=(1, 3))


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


def require_side(size: Sequence[int], side: int, what: str) -> None:
    """Reject images (height, width) whose shorter side is below ``side`` pixels."""
    if min(size) < side:
        must, got = f"Images must be at least {side} x {side} for {what}", f"{size[0]} x {size[1]}"
        raise PalpateError(must, got, "Score larger images")


def _scale_count(scales: Any, size: Sequence[int]) -> int:
    if scales == "auto":
        require_side(size, WINDOW, "MS-SSIM")
        return fitting_scales(size)
    if type(scales) is not int or not 1 <= scales <= len(WEIGHTS):
        must = f'must be "auto" or a whole number from 1 to {len(WEIGHTS)}'
        raise PalpateError(must, repr(scales), "Use the default", argument="scales")
    require_side(size, least_side(scales), f"MS-SSIM of {scales} scales")
    return scales
