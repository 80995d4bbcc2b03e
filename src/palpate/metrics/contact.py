"""Touch-aware companions of PSNR and SSIM: contact minus background, inside the contact mask, so that untouched gel earns nothing.

Most pixels of a touch show the sensor, and a generator that paints the empty gel gets them right. Here every image is reduced to
d = touch - background in [-1, 1] and compared where the real touch touches:

* *Mask* (from the real touch and its background alone): root mean square over the channels of d, markers filled from around them, blurred
  by a Gaussian of 1/48 of the shorter side, above a threshold: 4 grey levels, or three times what the noise of that background leaves
  after the blur if that is more; then dilated by 1/64 of the side. Markers are pixels darker than 0.82 of the median luma around, of the
  touch or the background, and (from 48 px on) a pixel around them. They move with the membrane and would outweigh the print (on the real
  clips of Touch and Go they hold three quarters of the squared d), so a marker is no contact, and its pixels are left out of the comparison
  unless ``markers="keep"``. A mask under 1 % of the pixels is empty: that touch is left out, counted and named.
* *Residual*: ``sum (d' - d)^2 / sum (d'^2 + d^2)`` over the mask (d' generated), which is 1 - 2 <d', d> / (|d'|^2 + |d|^2). 0: the touch;
  exactly 1: empty gel, and on average any touch that has nothing to do with it; 2: its negative. The sum below is over both because
  sum d^2 alone would reward the empty gel: there a touch that is as strong and unrelated has 2, and a real touch of the same material
  loses to empty gel; that ratio is in ``details["per_real_energy"]``.
* *SSIM*: the map of SSIM (Gaussian 11 / 1.5, population variances, mirrored at the edge so that contact at the edge counts) of d' and d,
  averaged over mask and channels. Its data range is 0.25, a few deviations of a contact: with 2, the range of d, C2 exceeds the
  contact's own variance and empty gel is rated above a real touch of the same material.
* *PSNR*: -10 log10 of the mean squared d' - d over the mask, data range 1 (of the images: on one background it is the image's own PSNR
  there). A squared error prefers empty gel to a wrong touch, here as everywhere: read it beside ``details["empty"]``, what empty gel has.
* *IoU*: of the generated touch's mask (made in the same way) and the real one. A contact everywhere has ``details["everywhere"]``.

There is no contact MS-SSIM: at the coarser scales of a 64 pixel touch an 11 pixel window is the whole pad, and the mask means nothing.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.core import PalpateError, Score
from palpate.metrics.checks import checked_choice, checked_images, checked_names, checked_positive
from palpate.metrics.compat import WINDOW, Convention, as_images, local_maps
from palpate.metrics.kernels import Array
from palpate.metrics.pairwise import mean_score

Mask = NDArray[np.bool_]
Markers = Literal["skip", "keep"]

#: Least change that is a contact, on the scale of [0, 1].
LEAST = 4 / 255
#: How many times the noise after the blur a contact must exceed.
TIMES_NOISE = 3.0
#: Share of the pixels under which a mask is empty.
SMALLEST = 0.01
#: Data range of the SSIM of differences.
SSIM_RANGE = 0.25
#: A marker is darker than this share of the median luma in a window of a sixth of the side.
MARKER = 0.82
_SSIM = Convention(border="mirror")


def contact_mask(touch: Any, background: Any, *, least: float = LEAST) -> Mask:
    """Where each touch touches.

    Args:
        touch: (n, h, w, 3 or 1) uint8, or float in [0, 1].
        background: the same shape: the gel without contact, of the same sensor at the same time.
        least: least change that is a contact, on the scale of [0, 1]; the noise of the gel can only raise it.

    Returns:
        (n, h, w), markers included; all False where the touch is empty.

    Raises:
        PalpateError: on other shapes, dtypes or ranges, or a ``least`` that is not positive.
    """
    checked_positive(least=least)
    touch, background = _checked("touch", touch, background)
    return np.stack([_mask(_unit(t), _unit(b), least)[0] for t, b in zip(touch, background, strict=True)])


@dataclass(frozen=True)
class Contacts:
    """What each pair has in the contact; NaN where the real touch is empty.

    Attributes:
        psnr: (n,) dB, infinite where the differences are identical.
        ssim: (n,) in [-1, 1].
        residual: (n,) in [0, 2].
        iou: (n,) in [0, 1].
        per_real_energy: (n,) squared error over the energy of the real contact alone, 1 for empty gel.
        empty_psnr: (n,) PSNR of empty gel; empty_ssim: (n,) its SSIM.
        area: (n,) share of the pixels in the real mask, 0 where it is empty.
    """

    psnr: Array
    ssim: Array
    residual: Array
    iou: Array
    per_real_energy: Array
    empty_psnr: Array
    empty_ssim: Array
    area: Array


def contact_per_image(
    generated: Any,
    reference: Any,
    background: Any,
    *,
    generated_background: Any = None,
    markers: Markers = "skip",
    least: float = LEAST,
) -> Contacts:
    """Every contact metric of each pair, from one mask.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11: generated touches.
        reference: the same shape: the real touches.
        background: the same shape: the real gel without contact.
        generated_background: the same shape: the gel without contact as the generator has it; default ``background``.
        markers: leave the pixels of the real markers out (``"skip"``), or compare them too.
        least: as in :func:`contact_mask`.

    Raises:
        PalpateError: on other shapes, dtypes or ranges, images smaller than the window, or unknown options.
    """
    checked_choice("markers", markers, ("skip", "keep"))
    checked_positive(least=least)
    real, empty = _checked("reference", reference, background)
    made, own = _checked("generated", generated, background if generated_background is None else generated_background)
    made, real = checked_images(made, real)
    if min(real.shape[1:3]) < WINDOW:
        got = f"{real.shape[1]} x {real.shape[2]}"
        raise PalpateError(f"Images must be at least {WINDOW} x {WINDOW} for contact metrics", got, "Score larger images")
    names = ("psnr", "ssim", "residual", "iou", "per_real_energy", "empty_psnr", "empty_ssim")
    found = {name: np.full(len(real), np.nan) for name in names} | {"area": np.zeros(len(real))}
    for i in range(len(real)):
        t, b, g, gb = (_unit(v[i]) for v in (real, empty, made, own))
        mask, near = _mask(t, b, least)
        kept = mask & ~near if markers == "skip" else mask
        if not kept.any():
            continue
        other = _mask(g, gb, least)[0]
        row = _compared(g - gb, t - b, kept) | {"iou": float((mask & other).sum() / (mask | other).sum()), "area": float(mask.mean())}
        for name, value in row.items():
            found[name][i] = value
    return Contacts(**found)


class ContactOptions(TypedDict, total=False):
    """Options of every contact score.

    Attributes:
        generated_background: the generator's own gel without contact; default the real one.
        markers, least: as in :func:`contact_per_image`.
        ids: n names, for ``details``.
        groups: n group names (videos); the interval is then robust to whole groups deviating together.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.
        level: coverage of the interval, 0.95.
    """

    generated_background: Any
    markers: Markers
    least: float
    ids: Sequence[str] | None
    groups: Sequence[str] | None
    subject: str
    split: str | None
    level: float


def contact_scores(generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]) -> list[Score]:
    """Mean residual, SSIM, PSNR and IoU of the contact over the touches that touch something, from one mask a touch.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11: generated touches.
        reference: the same shape; touch i is the partner of generated touch i.
        background: the same shape: the real gel without contact.
        **options: :class:`ContactOptions`.

    Returns:
        Four scores. Touches without contact are left out of the mean; ``details["no_contact"]`` counts them and names the first ten, and
        the note says so.

    Raises:
        PalpateError: as :func:`contact_per_image`.
    """
    given: dict[str, Any] = {k: v for k, v in options.items() if k in ("generated_background", "markers", "least")}
    rest: dict[str, Any] = {"ids": None, "groups": None, "subject": "generated", "split": None, "level": 0.95}
    if unknown := sorted(set(options) - set(given) - set(rest)):
        raise PalpateError("Options of a contact score must be known", ", ".join(unknown), f"Choose from {', '.join(_OPTIONS)}")
    rest |= {k: v for k, v in options.items() if k in rest}
    found = contact_per_image(generated, reference, background, **given)
    bare = found.area == 0
    names = checked_names("ids", rest["ids"], len(bare)) or [str(i) for i in range(len(bare))]
    no_contact = {"count": int(bare.sum()), "ids": [names[i] for i in np.flatnonzero(bare)[:10]]}
    note = f"{no_contact['count']} of {len(bare)} real touches show no contact, left out of the mean" if bare.any() else ""
    size = [int(v) for v in np.shape(reference)[1:3]]
    settings = {"markers": given.get("markers", "skip"), "least": round(float(given.get("least", LEAST)), 6), "size": size}
    settings |= {"generated_background": "real" if given.get("generated_background") is None else "own"}
    touched = ~bare
    beside = {
        "contact residual": {"empty": 1.0, "per_real_energy": _mean(found.per_real_energy[touched])},
        "contact SSIM": {"empty": _mean(found.empty_ssim[touched])},
        "contact PSNR": {"empty": _mean(found.empty_psnr[touched])},
        "contact IoU": {"empty": 0.0, "everywhere": _mean(found.area[touched])},
    }
    window = _SSIM.settings | {"border": _SSIM.border, "data_range": SSIM_RANGE}
    kinds: list[tuple[str, Array, tuple[float, float] | None, dict[str, Any]]] = [
        ("contact residual", found.residual, (0.0, 2.0), {"energy": "both"}),
        ("contact SSIM", found.ssim, (-1.0, 1.0), window),
        ("contact PSNR", found.psnr, None, {"data_range": 1}),
        ("contact IoU", found.iou, (0.0, 1.0), {}),
    ]
    return [
        mean_score(
            metric, values, bounds=bounds, better=metric != "contact residual", settings=settings | own, note=note,
            details=beside[metric] | {"no_contact": no_contact, "area": _mean(found.area[touched])}, **rest,
        )
        for metric, values, bounds, own in kinds
    ]  # fmt: skip


def contact_residual(generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]) -> Score:
    """The residual alone; arguments, errors and details as :func:`contact_scores`. 0 is the touch, 1 empty gel; lower is better."""
    return contact_scores(generated, reference, background, **options)[0]


def contact_ssim(generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]) -> Score:
    """The SSIM of the contact alone; arguments, errors and details as :func:`contact_scores`. 1 is the touch."""
    return contact_scores(generated, reference, background, **options)[1]


def contact_psnr(generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]) -> Score:
    """The PSNR of the contact alone, in dB; arguments, errors and details as :func:`contact_scores`. Compare with ``details["empty"]``."""
    return contact_scores(generated, reference, background, **options)[2]


def contact_iou(generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]) -> Score:
    """The overlap of the contact masks alone; arguments, errors and details as :func:`contact_scores`. 1 is the same mask, 0 empty gel."""
    return contact_scores(generated, reference, background, **options)[3]


_OPTIONS = tuple(ContactOptions.__annotations__)


def _compared(made: Array, real: Array, kept: Mask) -> dict[str, float]:
    """Every metric of two differences (h, w, c) on the pixels ``kept``, and of no difference at all."""
    error, energy, own = (float((v[kept] ** 2).mean()) for v in (made - real, real, made))
    x, y = (np.ascontiguousarray(np.moveaxis(v, 2, 0)) for v in (made, real))
    maps = [local_maps(v, y, _SSIM, SSIM_RANGE)[0] for v in (x, np.zeros_like(y))]
    with np.errstate(divide="ignore"):
        levels = -10 * np.log10([error, energy])
    return {
        "psnr": float(levels[0]), "empty_psnr": float(levels[1]),
        "ssim": float(maps[0][:, kept].mean()), "empty_ssim": float(maps[1][:, kept].mean()),
        "residual": error / (energy + own) if energy + own else np.nan, "per_real_energy": error / energy if energy else np.nan,
    }  # fmt: skip


def _mask(touch: Array, background: Array, least: float) -> tuple[Mask, Mask]:
    """Mask of one touch (h, w), and the pixels on or beside a marker."""
    side = min(touch.shape[:2])
    near = _markers(touch) | _markers(background)
    if side >= 48:  # a smaller image has markers of a pixel, and hardly two of gel between them
        near = np.asarray(ndimage.binary_dilation(near, iterations=max(1, side // 96)), bool)
    sigma = side / 48
    d = ndimage.gaussian_filter(_filled(touch - background, ~near, side / 32), (sigma, sigma, 0))
    left = np.sqrt(2) * _noise(background, ~near) / (2 * np.sqrt(np.pi) * max(sigma, 0.5))  # of white noise of two images, after the blur
    mask = np.sqrt((d * d).mean(axis=2)) > max(least, TIMES_NOISE * left)
    if mask.mean() < SMALLEST:
        return np.zeros_like(mask), near
    return np.asarray(ndimage.binary_dilation(mask, iterations=max(1, side // 64)), bool), near


def _markers(image: Array) -> Mask:
    grey = image @ (np.array([0.299, 0.587, 0.114]) if image.shape[2] == 3 else np.ones(1))
    step = max(1, min(grey.shape) // 64)  # a median over a sixth of the side changes slowly, and costs the fourth power of the side
    small = grey[::step, ::step]
    around = ndimage.median_filter(small, min(small.shape) // 6 | 1, mode="reflect")
    return grey < MARKER * around.repeat(step, 0).repeat(step, 1)[: grey.shape[0], : grey.shape[1]]


def _filled(d: Array, keep: Mask, sigma: float) -> Array:
    """``d`` (h, w, c) with the pixels not kept replaced by a blur of the kept ones around."""
    weight = ndimage.gaussian_filter(keep.astype(np.float64), sigma)[..., None]
    around = ndimage.gaussian_filter(d * keep[..., None], (sigma, sigma, 0)) / np.maximum(weight, 1e-6)
    return np.where(keep[..., None], d, around)


def _noise(background: Array, keep: Mask) -> float:
    """Deviation of a pixel's noise: 1.4826 times the median size of a second difference in both directions, whose weights have the norm 6.

    Where hardly a pixel is away from the markers the noise cannot be told from them, and is taken as 0.
    """
    kernel = np.outer([1, -2, 1], [1, -2, 1])[..., None]
    away = np.asarray(ndimage.binary_erosion(keep, np.ones((3, 3)), border_value=1), bool)
    if away.mean() < 1 / 16:
        return 0.0
    return 1.4826 * float(np.median(np.abs(ndimage.convolve(background, kernel, mode="mirror"))[away])) / 6


def _unit(image: NDArray[Any]) -> Array:
    return image.astype(np.float64) / (255 if image.dtype == np.uint8 else 1)


def _mean(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def _checked(name: str, touch: Any, background: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """A stack of touches and its backgrounds; the check calls them generated and reference, so its words are put right."""
    try:
        return checked_images(as_images(name, touch), as_images(f"{name} background", background))
    except PalpateError as error:
        words = {
            "Generated and reference images": f"The {name} touches and their backgrounds",
            "generated": name,
            "reference": f"{name} background",
        }
        must = re.sub("|".join(words), lambda found: words[found[0]], error.must)
        raise PalpateError(must, error.got, error.fix) from None
