"""Marker motion as scores: do the markers of generated images move as far as those of real ones?

Of each image whose gel has markers, against the no-contact image (:mod:`palpate.metrics.markers`),
in % of the image's width:

* *marker motion*: root mean square displacement;
* *marker shear*: length of the mean displacement, the net shear;
* *marker divergence*: of an affine fit, how far markers are pushed apart, by the normal load;
* *marker curl*: likewise, how far they are turned, in either direction, by a twist.

A photo does not decide how hard the sensor was pressed and dragged, so images are not compared
one by one: a score is the mean over images, and its floor that of the real ones. Closer to the
floor is better.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from palpate.core import Note, Score
from palpate.metrics.contact import background_digest, for_all
from palpate.metrics.images import Array, ImageOptions, PerImage, image_pairs
from palpate.metrics.markers import marker_motion

METRICS = ("marker motion", "marker shear", "marker divergence", "marker curl")


def marker_scores(
    generated: Any, reference: Any, background: Any, **options: Unpack[ImageOptions]
) -> list[Score]:
    """Mean motion, shear, divergence and curl of the markers, with those of real images as floor.

    Args:
        generated: (n, h, w, 3 or 1) array or tensor, uint8 or float in [0, 1].
        reference: the same shape: real tactile images of the same gels.
        background: the same shape, or one image (h, w, c) for all: the real gel without contact.
        **options: of :meth:`palpate.metrics.PerImage.score`.

    Returns:
        Four scores in % of the width, none of gels without markers. Images whose markers are not
        found again are excluded and counted in ``details["no_markers"]``; ``details["mean"]`` of
        the shear is the mean displacement, x to the right and y down.

    Raises:
        PalpateError: on other shapes, dtypes or ranges.
    """
    each = marker_per_image({"": generated}, reference, background)
    return [metric.score(**options) for metric in each.get("", ())]


def marker_per_image(
    generated: Mapping[str, Any], reference: Any, background: Any
) -> dict[str, list[PerImage]]:
    """Motion of the markers in several stacks, by name; empty where the gels have no markers.

    Arguments and errors as :func:`marker_scores`.
    """
    backgrounds = for_all(background, reference)
    real, gels = image_pairs(reference, backgrounds, arguments=("reference", "background"))
    found = _measured(real, gels)
    if not np.isfinite(found).any():
        return {}
    settings = {"size": list(real.shape[1:3]), "background": background_digest(background)}
    floors = np.nanmean(found, axis=0)[: len(METRICS)]
    result: dict[str, list[PerImage]] = {}
    for name, images in generated.items():
        values = _measured(image_pairs(images, real)[0], gels)
        lost = int(np.isnan(values[:, 0]).sum())
        details: dict[str, Any] = {"no_markers": lost}
        if lost < len(values):
            details["mean"] = np.nanmean(values, axis=0)[len(METRICS) :].tolist()
        notes = [Note("no-markers", {"count": lost, "n": len(values)})] * (lost > 0)
        result[name] = [
            PerImage(
                metric,
                of_metric,
                (-np.inf if metric == "marker divergence" else 0.0, np.inf),
                settings,
                notes,
                details,
                None,
                floor=float(floor),
            )
            for metric, of_metric, floor in zip(METRICS, values.T, floors, strict=False)
        ]
    return result


def _measured(images: NDArray[Any], gels: NDArray[Any]) -> Array:
    """(n, 6) the metrics and the mean displacement of each image; NaN without markers."""
    rows = np.full((len(images), len(METRICS) + 2), np.nan)
    for row, image, gel in zip(rows, images, gels, strict=True):
        if motion := marker_motion(image, gel):
            mean = motion.mean
            row[:] = motion.rms, np.hypot(*mean), motion.divergence, abs(motion.curl), *mean
    return rows
