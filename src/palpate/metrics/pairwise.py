"""SSIM and PSNR between a generated image and its reference, averaged over images; and which reference belongs to which image.

* SSIM (Wang et al. 2004): local means, variances and covariance under an 11 x 11 Gaussian of sigma 1.5,
  ``(2 mx my + C1)(2 cov + C2) / ((mx^2 + my^2 + C1)(vx + vy + C2))`` with C1 = (0.01 L)^2, C2 = (0.03 L)^2, data range L = 1, on each
  color channel, no downsampling, weighted population variances; averaged over the windows that lie wholly inside the image (as the
  original; no padding).
* PSNR: ``-10 log10(mean squared error)`` of an image, data range 1, all channels together. Two identical images have no PSNR
  (infinite): they are left out of the mean and counted in ``details["identical"]``, and the note says so.

The average is over images, never over pooled pixels. Neither metric sees what a touch is about: most pixels show the sensor itself
(module ``contact`` leaves it out). ``compat=`` reproduces other packages' variants (module ``compat``); such a score refuses to stand
beside one of ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate import __version__
from palpate.core import PalpateError, Score
from palpate.metrics.compat import (
    SSIM_CONVENTIONS,
    Compat,
    Pairs,
    Range,
    checked_pairs,
    psnr_values,
    ssim_values,
)
from palpate.metrics.inputs import checked_level, checked_names
from palpate.metrics.intervals import mean_interval
from palpate.metrics.kernels import Array


def paired_by_id(
    generated_ids: Sequence[str], reference_ids: Sequence[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where the two images of each id stand; the order of the lists may differ, their ids may not.

    Args:
        generated_ids: one id a generated image.
        reference_ids: one id a reference image.

    Returns:
        Two index arrays (n,) such that ``generated[first]`` and ``reference[second]`` are partners, in the order of ``reference_ids``.

    Raises:
        PalpateError: if an id stands twice in a list, or in one list only; the first are named.
    """
    lists = {
        "generated": [str(v) for v in generated_ids],
        "reference": [str(v) for v in reference_ids],
    }
    for name, ids in lists.items():
        if not ids:
            raise PalpateError(
                f"There must be {name} ids", "none", f"Pass the ids of the {name} images"
            )
        if twice := [i for i, count in Counter(ids).items() if count > 1]:
            got = (
                f"{len(twice)} that stand{'s' * (len(twice) == 1)} more than once: {_first(twice)}"
            )
            raise PalpateError(f"Every {name} id must stand once", got, "Keep one image an id")
    made, wanted = (dict.fromkeys(v) for v in lists.values())
    missing, surplus = [i for i in wanted if i not in made], [i for i in made if i not in wanted]
    if missing or surplus:
        parts = [
            f"{len(ids)} {what}: {_first(ids)}"
            for what, ids in (("not generated", missing), ("without reference", surplus))
            if ids
        ]
        fix = "Score the same samples on both sides: take() the common ids if that is what you mean"
        raise PalpateError(
            "Generated and reference ids must be the same set", "; ".join(parts), fix
        )
    at = {i: k for k, i in enumerate(lists["generated"])}
    return np.array([at[i] for i in lists["reference"]], dtype=np.int64), np.arange(
        len(wanted), dtype=np.int64
    )


def _first(ids: Sequence[str]) -> str:
    return ", ".join(repr(i) for i in ids[:3]) + f" and {len(ids) - 3} more" * (len(ids) > 3)


def ssim_per_image(
    generated: Any, reference: Any, *, data_range: Range | None = None, compat: Compat | None = None
) -> Array:
    """SSIM of each pair of images.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11 (7 for skimage).
        reference: the same shape.
        data_range: of other numbers, see :func:`ssim`.
        compat: another package's convention, see :func:`ssim`.

    Returns:
        (n,) values in [-1, 1].

    Raises:
        PalpateError: on other shapes, dtypes, ranges, or images smaller than the window.
    """
    return ssim_values(checked_pairs(generated, reference, data_range, compat), compat)


def psnr_per_image(
    generated: Any, reference: Any, *, data_range: Range | None = None, compat: Compat | None = None
) -> Array:
    """PSNR in dB of each pair of images, infinity where they are identical (80 dB for piq).

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1].
        reference: the same shape.
        data_range: of other numbers, see :func:`ssim`.
        compat: another package's convention, see :func:`psnr`; only piq's changes the value of an image.

    Returns:
        (n,) values.

    Raises:
        PalpateError: on other shapes, dtypes or ranges.
    """
    return psnr_values(checked_pairs(generated, reference, data_range, compat), compat)


def mean_score(
    metric: str,
    values: Array,
    ids: Sequence[str] | None,
    groups: Sequence[str] | None,
    *,
    bounds: tuple[float, float] | None = None,
    better: bool = True,
    level: float,
    **rest: Any,
) -> Score:
    """The score of a mean over pairs of images.

    Args:
        metric: its name.
        values: (n,) one value a pair; infinite where a pair is identical, NaN where it has no value (``rest["note"]`` says why): both are
            left out.
        ids: n names.
        groups: n group names.
        bounds: what a mean cannot leave; the t interval knows no bounds.
        better: whether higher is better.
        level: coverage of the interval.
        **rest: further fields of the score; ``details`` and ``note`` are joined to those made here.
    """
    checked_level(level)
    names = checked_names("ids", ids, len(values))
    groups = checked_names("groups", groups, len(values))
    finite = np.isfinite(values)
    kept = values[finite]
    identical = int(np.isinf(values).sum())
    interval, method = mean_interval(
        kept,
        None if groups is None else [g for g, k in zip(groups, finite, strict=True) if k],
        level,
    )
    if interval is not None and bounds is not None:
        interval = (max(bounds[0], interval[0]), min(bounds[1], interval[1]))
    worst = np.argsort(
        np.where(np.isnan(values), np.inf, values if better else -values), kind="stable"
    )[:5]
    details: dict[str, Any] = {
        "sd": float(kept.std(ddof=1)) if len(kept) > 1 else None,
        "median": float(np.median(kept)) if len(kept) else None,
        "identical": identical,
        "lowest" if better else "highest": [
            {"id": names[i] if names else str(i), "value": float(values[i])}
            for i in worst
            if finite[i]
        ],
        "groups": len(set(groups)) if groups else None,
        "version": __version__,
    }
    note = (
        f"{identical} of {len(values)} pairs are identical (infinite), left out of the mean"
        if identical
        else ""
    )
    if not len(kept):
        note = (
            f"Undefined: all {len(values)} pairs are identical, so the value is infinite"
            if identical
            else "Undefined: no pair has a value"
        )
    elif interval is None:
        note = ". ".join(
            filter(
                None, [note, "No interval: one image or one group, or no variation between them"]
            )
        )
    note = ". ".join(filter(None, [note, rest.pop("note", "")]))
    value = float(kept.mean()) if len(kept) else None
    return Score(
        metric,
        value=value,
        interval=interval,
        level=level,
        interval_method=method,
        estimator="per-image mean",
        n=len(values),
        m=len(values),
        higher_is_better=better,
        details=details | rest.pop("details", {}),
        note=note,
        **rest,
    )


def ssim(
    generated: Any,
    reference: Any,
    *,
    ids: Sequence[str] | None = None,
    groups: Sequence[str] | None = None,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
    data_range: Range | None = None,
    compat: Compat | None = None,
) -> Score:
    """Mean SSIM over pairs of images; 1 is identical.

    Args:
        generated: (n, h, w, 3 or 1) uint8, or float in [0, 1]; h, w >= 11 (7 for skimage).
        reference: the same shape; image i is the partner of generated image i.
        ids: n names, for ``details["lowest"]``.
        groups: n group names (videos); the interval is then robust to whole groups deviating together.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.
        level: coverage of the interval.
        data_range: None, or ``(low, high)`` (a number: from 0) for images of other numbers, floats or integers. They are mapped to [0, 1],
            so the score is that of the picture in any coding and stays comparable (``details["coding"]`` keeps the range); values outside are
            refused. A peer's convention takes the numbers as they are: its score of a coding with low != 0 is another one, and its
            settings say so.
        compat: None for the convention above; ``"torchmetrics"``: the image mirrored at its edge, every pixel averaged, variances clamped
            at 0; ``"skimage"``: uniform 7 x 7 window, sample variances; ``"piq"``: average pooling by round(shorter side / 256) before.
            Kept in the settings.

    Raises:
        PalpateError: as :func:`ssim_per_image`.
    """
    pairs = checked_pairs(generated, reference, data_range, compat)
    convention = SSIM_CONVENTIONS[compat]
    settings = convention.settings | {
        "data_range": pairs.data_range,
        "border": convention.border,
        "size": _size(pairs),
    }
    if compat == "piq":
        settings["pooling"] = convention.factor(*_size(pairs))
    values = ssim_values(pairs, compat)
    return mean_score(
        "SSIM",
        values,
        ids,
        groups,
        bounds=(-1.0, 1.0),
        subject=subject,
        split=split,
        level=level,
        settings=settings | _named(compat),
        details=pairs.coding,
    )


def psnr(
    generated: Any,
    reference: Any,
    *,
    ids: Sequence[str] | None = None,
    groups: Sequence[str] | None = None,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
    data_range: Range | None = None,
    compat: Compat | None = None,
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
        data_range: as in :func:`ssim`; PSNR is the same in any coding.
        compat: None for the convention above; ``"torchmetrics"``: the PSNR of the squared error pooled over all images, identical ones
            included (interval by the delta method); ``"skimage"``: our values; ``"piq"``: 1e-8 added to each squared error, so that
            identical images count as 80 dB. Kept in the settings.

    Raises:
        PalpateError: as :func:`psnr_per_image`.
    """
    pairs = checked_pairs(generated, reference, data_range, compat)
    rest: dict[str, Any] = {
        "subject": subject,
        "split": split,
        "level": level,
        "details": pairs.coding,
    }
    rest["settings"] = {"data_range": pairs.data_range, "size": _size(pairs)} | _named(compat)
    if compat == "torchmetrics":
        return _pooled_psnr(pairs.squared_errors(), ids, groups, rest)
    return mean_score("PSNR", psnr_values(pairs, compat), ids, groups, **rest)


def _pooled_psnr(
    errors: Array, ids: Sequence[str] | None, groups: Sequence[str] | None, rest: dict[str, Any]
) -> Score:
    """``-10 log10`` of the mean of all squared errors; its interval has the reach ``10 / ln 10 * reach(mean) / mean``."""
    names, groups = (
        checked_names("ids", ids, len(errors)),
        checked_names("groups", groups, len(errors)),
    )
    mean, level = float(errors.mean()), rest["level"]
    checked_level(level)
    value, interval = (-10 * float(np.log10(mean)) if mean > 0 else None), None
    around, method = mean_interval(errors, groups, level)
    if value is not None and around is not None:
        reach = 10 / np.log(10) * (around[1] - around[0]) / (2 * mean)
        interval, method = (float(value - reach), float(value + reach)), f"{method}, delta method"
    note = "" if interval else "No interval: one image or one group, or no variation between them"
    worst = np.argsort(-errors, kind="stable")[:5]
    lowest = [
        {"id": names[i] if names else str(i), "value": -10 * float(np.log10(errors[i]))}
        for i in worst
        if errors[i] > 0
    ]
    details = {
        "identical": int((errors == 0).sum()),
        "lowest": lowest,
        "groups": len(set(groups)) if groups else None,
    }
    rest = rest | {"details": details | {"version": __version__} | rest["details"]}
    return Score(
        "PSNR",
        value=value,
        interval=interval,
        interval_method=method if interval else "",
        estimator="pooled squared error",
        n=len(errors),
        m=len(errors),
        higher_is_better=True,
        note=note
        if value is not None
        else f"Undefined: all {len(errors)} pairs are identical, so the value is infinite",
        **rest,
    )


def _named(compat: str | None) -> dict[str, str]:
    return {} if compat is None else {"compat": compat}


def _size(pairs: Pairs) -> list[int]:
    return [int(v) for v in pairs.a.shape[1:3]]
