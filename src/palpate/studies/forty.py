"""Companions on forty items, as the paper seems to have them, and what forty can carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from palpate.core import Score, rng_for
from palpate.core.score import ARROWS
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics import mean_score, per_image
from palpate.metrics.intervals import spread_of_values
from palpate.report.study import StudyTable
from palpate.studies.photo_companions import Images, patch_distances

#: Items of the paper's human study and pairwise scores.
FORTY = 40


def companions_on_forty(
    images: Mapping[str, Images],
    real: Images,
    ids: Sequence[str],
    groups: Sequence[str] | None,
    encoders: EncoderSet | None = None,
    *,
    name: str = "palpate/mini",
    seed: int = 0,
) -> StudyTable:
    """SSIM, PSNR and, with a photo encoder, the distance of patches; see :func:`forty_table`.

    Args:
        images: method -> (n, h, w, 3); the first two are compared.
        real: (n, h, w, 3), in the same order.
        ids: of the n samples.
        groups: their videos, or None.
        encoders: whose vision encoder stands in for that of LPIPS.
        name: of the encoders.
        seed: of the choice of the items.
    """
    pixels: tuple[Literal["SSIM", "PSNR"], ...] = ("SSIM", "PSNR")
    values = {m: {n: per_image(m, x, real).values for n, x in images.items()} for m in pixels}
    better = dict.fromkeys(values, True)
    if encoders is not None:
        patches = f"patch distance ({name} vision)"
        distances = {n: patch_distances(x, real, encoders) for n, x in images.items()}
        return forty_table(
            values | {patches: distances}, ids, groups, better=better | {patches: False}, seed=seed
        )
    return forty_table(values, ids, groups, better=better, seed=seed)


def seeded_items(ids: Sequence[str], seed: int = 0, count: int = FORTY) -> list[int]:
    """Rows of ``count`` samples (or of all), chosen by seed and id alone."""
    order = sorted(range(len(ids)), key=lambda k: rng_for(seed, "companions", ids[k]).random())
    return sorted(order[:count])


def forty_table(
    values: Mapping[str, Mapping[str, NDArray[np.float64]]],
    ids: Sequence[str],
    groups: Sequence[str] | None,
    *,
    better: Mapping[str, bool],
    seed: int = 0,
    count: int = FORTY,
) -> StudyTable:
    """Companions on forty seeded items, as in the paper, beside all samples; what forty can carry.

    Args:
        values: metric -> method -> (n,) a value an image, e.g. of
            :func:`palpate.metrics.per_image`; values that are not finite are skipped.
        ids: of the n samples.
        groups: their videos, or None.
        better: metric -> whether higher is better.
        seed: of the choice.
        count: how many items.
    """
    items = seeded_items(ids, seed, count)
    rows: list[list[Score | str | None]] = []
    worst: list[str] = []
    for metric, of_method in values.items():
        for method, v in of_method.items():
            few, everything = (
                mean_score(
                    metric,
                    v[at],
                    ids=[ids[k] for k in at],
                    groups=None if groups is None else [groups[k] for k in at],
                    higher_is_better=better[metric],
                    subject=method,
                    settings={"items": len(at)},
                )
                for at in (items, [*range(len(ids))])
            )
            rows.append([method, f"{metric} {ARROWS[better[metric]]}", few, everything])
        worst += _needed(metric, of_method, groups, items)
    text = (
        f"Companions on {len(items)} items chosen by seed, as the paper's pairwise scores, and on "
        f"all {len(ids)}. {' '.join(worst)}"
    )
    columns = ["method", "metric", f"{len(items)} items", f"all {len(ids)}"]
    return StudyTable("Companions on forty items", text.strip(), columns, rows)


def _needed(
    metric: str,
    of_method: Mapping[str, NDArray[np.float64]],
    groups: Sequence[str] | None,
    items: Sequence[int],
) -> list[str]:
    """What the items can carry: the least difference they decide, and items for that of all."""
    names = list(of_method)
    if len(names) < 2:
        return []
    a, b = names[:2]
    delta = of_method[a] - of_method[b]
    rows = [k for k in items if np.isfinite(delta[k])]
    spread = spread_of_values(delta[rows], None if groups is None else [groups[k] for k in rows])
    interval, whole = spread.interval(), float(delta[np.isfinite(delta)].mean())
    if interval is None:
        return []
    reach = (interval[1] - interval[0]) / 2
    needed = int(np.ceil(len(rows) * (reach / whole) ** 2)) if whole else 0
    verdict = "decide" if reach < abs(whole) else f"cannot decide, which takes about {needed:,},"
    return [
        f"{metric}: {len(rows)} items tell {a} from {b} only where they differ by more than "
        f"{reach:.2g}, and {verdict} the {abs(whole):.2g} of all."
    ]
