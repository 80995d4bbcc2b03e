"""Touch-aware companions of PSNR, SSIM and MS-SSIM: contact minus background, inside the contact mask, so that untouched gel earns nothing.

Most pixels of a touch show the sensor, and a generator that paints the empty gel gets them right. Here every image is reduced to
d = touch - background in [-1, 1] and compared where the real touch touches:

* *Mask*: of the real touch and its background alone, see :mod:`palpate.metrics.masks`. Markers move with the membrane and would outweigh the
  print (on the real clips of Touch and Go they hold three quarters of the squared d), so a marker is no contact, and its pixels are left
  out of the comparison unless ``markers="keep"``. A touch whose mask is empty is left out, counted and named.
* *Residual*: ``sum (d' - d)^2 / sum (d'^2 + d^2)`` over the mask (d' generated), which is 1 - 2 <d', d> / (|d'|^2 + |d|^2). 0: the touch;
  exactly 1: empty gel, and on average any touch that has nothing to do with it; 2: its negative. The sum below is over both because
  sum d^2 alone would reward the empty gel: there a touch that is as strong and unrelated has 2, and a real touch of the same material
  loses to empty gel; that ratio is in ``details["per_real_energy"]``.
* *SSIM*: the map of SSIM (Gaussian 11 / 1.5, population variances, mirrored at the edge so that contact at the edge counts) of d' and d,
  averaged over mask and channels; where luminance and structure are both negative, as of a touch and its negative, so is their product.
  Its data range is 0.25, a few deviations of a contact: with 2, the range of d, C2 exceeds the contact's own variance and empty gel is
  rated above a real touch of the same material.
* *MS-SSIM*: the same maps at every scale that the image holds (:mod:`palpate.metrics.multiscale`), each averaged with the share of a cell that
  is in the mask as its weight. A window of the coarsest scale sees 11 cells a side, most of a small touch, so what it adds is whether
  the contact as a whole lies right.
* *PSNR*: -10 log10 of the mean squared d' - d over the mask, data range 1 (of the images: on one background it is the image's own PSNR
  there). A squared error prefers empty gel to a wrong touch, here as everywhere: read it beside ``details["empty"]``, what empty gel has.
* *IoU*: of the generated touch's mask (made in the same way) and the real one. A contact everywhere has ``details["everywhere"]``.

For a network that compares pictures, as LPIPS does, :func:`contact_pictures` gives the differences as pictures, neutral gray outside the mask,
and the mask to average by.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError, Score
from palpate.metrics.compat import WINDOW, Convention
from palpate.metrics.inputs import checked_choice, checked_images, checked_names
from palpate.metrics.kernels import Array
from palpate.metrics.masks import (
    LEAST,
    Mask,
    checked_least,
    checked_touches,
    mask_of,
    pictures_digest,
    unit,
)
from palpate.metrics.multiscale import fitting_scales, signed_maps, weighted_ms_ssim
from palpate.metrics.pairwise import mean_score

Markers = Literal["skip", "keep"]

#: Data range of the SSIM of differences.
SSIM_RANGE = 0.25
_SSIM = Convention(border="mirror")


@dataclass(frozen=True)
class Contacts:
    """What each pair has in the contact; NaN where the real touch is empty.

    Attributes:
        psnr: (n,) dB, infinite where the differences are identical.
        ssim: (n,) in [-1, 1].
        ms_ssim: (n,) in [0, 1].
        residual: (n,) in [0, 2].
        iou: (n,) in [0, 1].
        per_real_energy: (n,) squared error over the energy of the real contact alone, 1 for empty gel.
        empty_psnr: (n,) PSNR of empty gel; empty_ssim, empty_ms_ssim: (n,) its SSIM and MS-SSIM.
        area: (n,) share of the pixels in the real mask, 0 where it is empty.
    """

    psnr: Array
    ssim: Array
    ms_ssim: Array
    residual: Array
    iou: Array
    per_real_energy: Array
    empty_psnr: Array
    empty_ssim: Array
    empty_ms_ssim: Array
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
    names = (
        "psnr",
        "ssim",
        "ms_ssim",
        "residual",
        "iou",
        "per_real_energy",
        "empty_psnr",
        "empty_ssim",
        "empty_ms_ssim",
    )
    pairs = _Pairs.of(generated, reference, background, generated_background, markers, least)
    found = {name: np.full(len(pairs.real), np.nan) for name in names} | {
        "area": np.zeros(len(pairs.real))
    }
    for i, made, real, kept, mask in pairs:
        other = mask_of(unit(pairs.made[i]), unit(pairs.own[i]), least)[0]
        row = _compared(made, real, kept) | {
            "iou": float((mask & other).sum() / (mask | other).sum()),
            "area": float(mask.mean()),
        }
        for name, value in row.items():
            found[name][i] = value
    return Contacts(**found)


@dataclass(frozen=True)
class ContactPictures:
    """Differences to the empty gel as pictures, for a network that compares pictures.

    Attributes:
        generated: (n, h, w, c) float32 in [0, 1]: 0.5 + touch - background inside the contact mask, cut to [0, 1]; 0.5 outside.
        reference: the same shape: of the real touches.
        mask: (n, h, w): the pixels compared; all False where the real touch is empty.
    """

    generated: NDArray[np.float32]
    reference: NDArray[np.float32]
    mask: Mask


def contact_pictures(
    generated: Any,
    reference: Any,
    background: Any,
    *,
    generated_background: Any = None,
    markers: Markers = "skip",
    least: float = LEAST,
) -> ContactPictures:
    """The contact of each pair as two pictures and a mask; arguments and errors as :func:`contact_per_image`."""
    pairs = _Pairs.of(generated, reference, background, generated_background, markers, least)
    pictures = [np.full(pairs.real.shape, 0.5, np.float32) for _ in range(2)]
    masks = np.zeros(pairs.real.shape[:3], bool)
    for i, made, real, kept, _ in pairs:
        masks[i] = kept
        for picture, d in zip(pictures, (made, real), strict=True):
            picture[i][kept] = np.clip(0.5 + d[kept], 0, 1)
    return ContactPictures(pictures[0], pictures[1], masks)


@dataclass(frozen=True)
class _Pairs:
    """Checked touches (n, h, w, c) of both sides, each with its empty gel."""

    made: NDArray[Any]
    own: NDArray[Any]
    real: NDArray[Any]
    empty: NDArray[Any]
    markers: Markers
    least: float

    @classmethod
    def of(
        cls,
        generated: Any,
        reference: Any,
        background: Any,
        generated_background: Any,
        markers: Markers,
        least: float,
    ) -> _Pairs:
        """Checks everything; errors as :func:`contact_per_image`."""
        checked_choice("markers", markers, ("skip", "keep"))
        checked_least(least)
        real, empty = checked_touches("reference", reference, background)
        made, own = checked_touches(
            "generated",
            generated,
            background if generated_background is None else generated_background,
        )
        made, real = checked_images(made, real)
        if min(real.shape[1:3]) < WINDOW:
            got = f"{real.shape[1]} x {real.shape[2]}"
            raise PalpateError(
                f"Images must be at least {WINDOW} x {WINDOW} for contact metrics",
                got,
                "Score larger images",
            )
        return cls(made, own, real, empty, markers, least)

    def __iter__(self) -> Iterator[tuple[int, Array, Array, Mask, Mask]]:
        """Of every touch that touches: its number, the differences (h, w, c) generated and real, the pixels to compare, and the whole mask."""
        for i in range(len(self.real)):
            t, b, g, gb = (unit(v[i]) for v in (self.real, self.empty, self.made, self.own))
            mask, near = mask_of(t, b, self.least)
            kept = mask & ~near if self.markers == "skip" else mask
            if kept.any():
                yield i, g - gb, t - b, kept, mask


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


def contact_scores(
    generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]
) -> list[Score]:
    """Mean residual, SSIM, PSNR, IoU and MS-SSIM of the contact over the touches that touch something, from one mask a touch.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11: generated touches.
        reference: the same shape; touch i is the partner of generated touch i.
        background: the same shape: the real gel without contact.
        **options: :class:`ContactOptions`.

    Returns:
        Five scores. Touches without contact are left out of the mean; ``details["no_contact"]`` counts them and names the first ten, and
        the note says so.

    Raises:
        PalpateError: as :func:`contact_per_image`.
    """
    given: dict[str, Any] = {
        k: v for k, v in options.items() if k in ("generated_background", "markers", "least")
    }
    rest: dict[str, Any] = {
        "ids": None,
        "groups": None,
        "subject": "generated",
        "split": None,
        "level": 0.95,
    }
    if unknown := sorted(set(options) - set(given) - set(rest)):
        raise PalpateError(
            "Options of a contact score must be known",
            ", ".join(unknown),
            f"Choose from {', '.join(_OPTIONS)}",
        )
    rest |= {k: v for k, v in options.items() if k in rest}
    found = contact_per_image(generated, reference, background, **given)
    bare = found.area == 0
    names = checked_names("ids", rest["ids"], len(bare)) or [str(i) for i in range(len(bare))]
    no_contact = {"count": int(bare.sum()), "ids": [names[i] for i in np.flatnonzero(bare)[:10]]}
    note = (
        f"{no_contact['count']} of {len(bare)} real touches show no contact, left out of the mean"
        if bare.any()
        else ""
    )
    size = [int(v) for v in np.shape(reference)[1:3]]
    settings = {
        "markers": given.get("markers", "skip"),
        "least": round(float(given.get("least", LEAST)), 6),
        "size": size,
    }
    settings |= {
        "generated_background": "real" if given.get("generated_background") is None else "own",
        "background": pictures_digest(background),
    }
    touched, scales = ~bare, fitting_scales(size)
    beside = {
        "contact residual": {
            "empty": 1.0,
            "per_real_energy": _mean(found.per_real_energy[touched]),
        },
        "contact SSIM": {"empty": _mean(found.empty_ssim[touched])},
        "contact PSNR": {"empty": _mean(found.empty_psnr[touched])},
        "contact IoU": {"empty": 0.0, "everywhere": _mean(found.area[touched])},
        "contact MS-SSIM": {"empty": _mean(found.empty_ms_ssim[touched])},
    }
    window = _SSIM.settings | {"border": _SSIM.border, "data_range": SSIM_RANGE}
    kinds: list[tuple[str, Array, tuple[float, float] | None, dict[str, Any]]] = [
        ("contact residual", found.residual, (0.0, 2.0), {"energy": "both"}),
        ("contact SSIM", found.ssim, (-1.0, 1.0), window),
        ("contact PSNR", found.psnr, None, {"data_range": 1}),
        ("contact IoU", found.iou, (0.0, 1.0), {}),
        ("contact MS-SSIM", found.ms_ssim, (0.0, 1.0), window | {"scales": scales}),
    ]
    return [
        mean_score(
            metric,
            values,
            bounds=bounds,
            better=metric != "contact residual",
            settings=settings | own,
            note=note,
            details=beside[metric] | {"no_contact": no_contact, "area": _mean(found.area[touched])},
            **rest,
        )
        for metric, values, bounds, own in kinds
    ]


def contact_residual(
    generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]
) -> Score:
    """The residual alone; arguments, errors and details as :func:`contact_scores`. 0 is the touch, 1 empty gel; lower is better."""
    return contact_scores(generated, reference, background, **options)[0]


def contact_ssim(
    generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]
) -> Score:
    """The SSIM of the contact alone; arguments, errors and details as :func:`contact_scores`. 1 is the touch."""
    return contact_scores(generated, reference, background, **options)[1]


def contact_psnr(
    generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]
) -> Score:
    """The PSNR of the contact alone, in dB; arguments, errors and details as :func:`contact_scores`. Compare with ``details["empty"]``."""
    return contact_scores(generated, reference, background, **options)[2]


def contact_iou(
    generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]
) -> Score:
    """The overlap of the contact masks alone; arguments, errors and details as :func:`contact_scores`. 1 is the same mask, 0 empty gel."""
    return contact_scores(generated, reference, background, **options)[3]


def contact_ms_ssim(
    generated: Any, reference: Any, background: Any, **options: Unpack[ContactOptions]
) -> Score:
    """The MS-SSIM of the contact alone; arguments, errors and details as :func:`contact_scores`. 1 is the touch."""
    return contact_scores(generated, reference, background, **options)[4]


_OPTIONS = tuple(ContactOptions.__annotations__)


def _compared(made: Array, real: Array, kept: Mask) -> dict[str, float]:
    """Every metric of two differences (h, w, c) on the pixels ``kept``, and of no difference at all."""
    error, energy, own = (float((v[kept] ** 2).mean()) for v in (made - real, real, made))
    x, y = (np.ascontiguousarray(np.moveaxis(v, 2, 0)) for v in (made, real))
    maps = [signed_maps(v, y, _SSIM, SSIM_RANGE)[0] for v in (x, np.zeros_like(y))]
    scales = fitting_scales(kept.shape)
    several = [
        weighted_ms_ssim(v, y, kept, scales, _SSIM, SSIM_RANGE) for v in (x, np.zeros_like(y))
    ]
    with np.errstate(divide="ignore"):
        levels = -10 * np.log10([error, energy])
    return {
        "psnr": float(levels[0]),
        "empty_psnr": float(levels[1]),
        "ssim": float(maps[0][:, kept].mean()),
        "empty_ssim": float(maps[1][:, kept].mean()),
        "ms_ssim": several[0],
        "empty_ms_ssim": several[1],
        "residual": error / (energy + own) if energy + own else np.nan,
        "per_real_energy": error / energy if energy else np.nan,
    }


def _mean(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None
