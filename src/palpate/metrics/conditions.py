"""What physics decides of a contact, measured on the tactile image: place, area, strength, shear.

With d = tactile image - no-contact image, markers filled from around them and smoothed as in
:mod:`palpate.metrics.contact`, and |d| its root mean square over the channels:

* *at*: the |d|-weighted centroid inside the contact mask, in shares of width and height from the
  top left;
* *area*: the share of the gel in the mask;
* *strength*: the mean of |d| inside the mask, in gray levels (its sum is nearly the area);
* *shear*: the mean displacement of all markers in percent of the gel's width, x to the right and y
  down (:mod:`palpate.metrics.markers`).

A mask under 1 % is no contact: strength 0, area 0, no place. A gel without markers has no shear.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.metrics.contact import contact_of, for_all
from palpate.metrics.images import Array, as_unit, image_pairs
from palpate.metrics.markers import is_marker, luma_and_around, motion_of

#: The columns of what is measured.
CONDITIONS = ("at_x", "at_y", "area", "strength", "shear_x", "shear_y")


def contact_conditions(tactile: Any, background: Any) -> NDArray[np.float64]:
    """Place, area, strength and shear of contacts.

    Args:
        tactile: (n, h, w, 3 or 1) array or tensor, uint8 or float in [0, 1].
        background: the same shape, or one image (h, w, c) for all: the gel without contact.

    Returns:
        (n, 6) in the order of :data:`CONDITIONS`; NaN where there is none.

    Raises:
        PalpateError: on other shapes, dtypes or ranges.
    """
    gels = for_all(background, tactile)
    images, gels = image_pairs(tactile, gels, arguments=("tactile", "background"))
    rows, seen = [], list[tuple[NDArray[Any], tuple[Array, Array]]]()
    for image, gel in zip(images, gels, strict=True):
        if not seen or not np.array_equal(gel, seen[0][0]):  # frames of a contact share one
            seen = [(gel, luma_and_around(as_unit(gel)))]
        rows.append(_measured(as_unit(image), as_unit(gel), seen[0][1]))
    return np.array(rows, float).reshape(-1, len(CONDITIONS))


def _measured(image: Array, gel: Array, still: tuple[Array, Array]) -> tuple[float, ...]:
    seen = luma_and_around(image), still
    mask, _, size = contact_of(image, gel, (is_marker(*seen[0]), is_marker(*seen[1])))
    (h, w), motion = mask.shape, motion_of(*seen)
    shear = (np.nan, np.nan) if motion is None else tuple(motion.mean)
    if not mask.any():
        return np.nan, np.nan, 0.0, 0.0, *shear
    weight = size * mask
    total, (y, x) = weight.sum(), np.mgrid[:h, :w] + 0.5
    place = (x * weight).sum() / total / w, (y * weight).sum() / total / h
    return *place, mask.mean(), 255 * total / mask.sum(), *shear
