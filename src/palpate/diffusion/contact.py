"""Contact conditions of a generator: where, how wide, how hard, and dragged which way.

What is measured of a training touch (:mod:`palpate.metrics.conditions`), or stands in the manifest,
conditions the denoiser as maps beside the noisy latents; tokens learn no place. Each of *place*,
*area*, *strength* and *shear* may be unknown; the channels are

* a blob at the place, as wide as the area or its mean, and the ways from the place in x and y;
* area, strength, shear in x and in y, standardized;
* which of the four are known;
* what the shear does to the markers, as latents: E(gel with its markers moved, gel) - E(gel, gel).
  The autoencoder codes moved markers relative to the gel that it is given, so that a denoiser that
  does not see the gel cannot move them. For the same reason, always, what a shear of 1 % of the
  width does, to the right and down.

Strength is the quantile of the mean change among the training contacts of a sensor. A force or a
depth, where training knew them, becomes a strength by a monotone (isotonic) fit. What is not
requested is drawn among training touches, jointly: of surfaces that look like the one at hand, and
near what is requested.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import isotonic_regression
from torch import Tensor

from palpate.core import require, rng_for
from palpate.diffusion.autoencoder import BackgroundAutoencoder
from palpate.metrics.conditions import CONDITIONS
from palpate.metrics.contact import fill
from palpate.metrics.images import as_unit
from palpate.metrics.markers import marker_mask, marker_motion

Rows = NDArray[np.float64]
#: Requested for, unknown, or dropped together.
PARTS = {"at": [0, 1], "area": [2], "strength": [3], "shear": [4, 5]}
#: The part of each condition.
_PART = [0, 0, 1, 2, 3, 3]
#: In training: probability that all are dropped, and that each part is, by itself.
DROP_ALL, DROP = 0.15, 0.15
#: How near a training touch is of which the rest is drawn: in deviations of what is requested, and
#: in the cosine of the surfaces, as the memory's temperature.
NEAR, LIKE = 0.25, 0.02
#: Training touches that are kept, of which what is not requested is drawn.
KEPT = 4096
#: Points of the tables from strength, force and depth.
POINTS = 101


def channels_of(latent: int) -> int:
    """Channels of the maps, for latents of so many."""
    return 3 + 4 + len(PARTS) + 3 * latent


@dataclass(frozen=True)
class ContactScale:
    """What strength, force and depth mean, by sensor; under ``""`` for any other one.

    Attributes:
        strength: sensor -> quantiles, evenly from 0 to 1, of the strength of its training contacts.
        force: sensor -> least and largest force [N], and the strengths of evenly spaced forces.
        depth: the same of depth [mm].
        missing: training touches without place, area, strength, shear.
        gain: how far from the mean of training each condition is requested, to be as far from it as
            is requested; empty: as far.
    """

    strength: Mapping[str, Sequence[float]] = field(default_factory=dict)
    force: Mapping[str, Sequence[float]] = field(default_factory=dict)
    depth: Mapping[str, Sequence[float]] = field(default_factory=dict)
    missing: Mapping[str, int] = field(default_factory=dict)
    gain: Sequence[float] = ()

    @classmethod
    def of(cls, rows: Rows, sensors: Sequence[str | None]) -> ContactScale:
        """The scale of training touches (n, 8), in the order of the manifest's columns."""
        names = np.array([sensor or "" for sensor in sensors])
        groups = {"": np.ones(len(names), bool)}
        groups |= {str(name): names == name for name in sorted({*names} - {""})}
        strength = {
            name: np.quantile(values, np.linspace(0, 1, POINTS)).tolist()
            for name, of in groups.items()
            if len(values := rows[of & (rows[:, 3] > 0), 3]) > 1
        }
        scale = cls(strength)
        quantiles = scale.requested(rows, sensors)[:, 3]

        def rising(column: int) -> dict[str, list[float]]:
            fits = {name: _monotone(rows[of, column], quantiles[of]) for name, of in groups.items()}
            return {name: fit for name, fit in fits.items() if fit}

        lost = ~_known(rows)
        missing = {part: int(lost[:, k].sum()) for k, part in enumerate(PARTS)}
        return cls(strength, rising(6), rising(7), missing)

    def requested(self, rows: Rows, sensors: Sequence[str | None]) -> NDArray[np.float32]:
        """Measured touches (n, 6 or more) as what is requested: the strength as its quantile."""
        out = rows[:, : len(CONDITIONS)].astype(np.float32)
        for name in {*sensors}:
            of = np.array([sensor == name for sensor in sensors])
            table = self._table(self.strength, name)
            if table is not None:
                out[of, 3] = np.interp(rows[of, 3], table, np.linspace(0, 1, len(table)))
        return out

    def strength_of(self, name: str, value: float, sensor: str | None = None) -> float:
        """The strength of a ``force`` or ``depth``.

        Raises:
            PalpateError: if training did not know it, or saw none like this.
        """
        table = self._table(getattr(self, name), sensor)
        must, fix = "must be left out: training knew none", "Choose a strength from 0 to 1"
        require(table is not None, name, must, f"{value:g}", fix=fix)
        assert table is not None
        low, high, *strengths = table
        unit = "N" if name == "force" else "mm"
        must = f"must lie in {low:.3g} to {high:.3g} {unit}, as in training"
        require(low <= value <= high, name, must, f"{value:g}")
        return float(np.interp(value, np.linspace(low, high, len(strengths)), strengths))

    @staticmethod
    def _table(tables: Mapping[str, Sequence[float]], sensor: str | None) -> Sequence[float] | None:
        return tables.get(sensor or "", tables.get(""))


def _monotone(values: Rows, strengths: NDArray[np.float32]) -> list[float]:
    """Range of the values, and their rising fit to strengths at evenly spaced ones."""
    known = np.isfinite(values) & np.isfinite(strengths)
    if known.sum() < 2 or np.ptp(values[known]) == 0:
        return []
    order = np.argsort(values[known])
    x, y = values[known][order], strengths[known][order]
    grid = np.linspace(x[0], x[-1], POINTS)
    return [float(x[0]), float(x[-1]), *np.interp(grid, x, isotonic_regression(y).x).tolist()]


def _known(rows: Rows) -> NDArray[np.bool_]:
    """(n, 4): which parts of touches are known."""
    return np.stack([np.isfinite(rows[:, of]).all(axis=1) for of in PARTS.values()], axis=1)


def _ink(gel: NDArray[np.uint8]) -> tuple[Rows, Rows]:
    """A gel (h, w, 3) without its markers, and what these add to it."""
    near = np.asarray(ndimage.binary_dilation(marker_mask(unit := as_unit(gel))), bool)
    smooth = 255 * fill(unit, ~near, min(gel.shape[:2]) / 32)
    return smooth, gel - smooth


def _moved(smooth: Rows, ink: Rows, shear: Rows) -> NDArray[np.uint8]:
    """A gel whose markers alone have moved by a shear (2,) in % of the width."""
    x, y = shear * ink.shape[1] / 100
    image = smooth + ndimage.shift(ink, (y, x, 0), order=1, mode="nearest")
    return np.rint(image).clip(0, 255).astype(np.uint8)


def marks_of(
    code: BackgroundAutoencoder, gels: NDArray[np.uint8], shears: NDArray[np.floating[Any]]
) -> Tensor:
    """What shears (n, 2) do to the markers of gels, in latents (n, 3 c, h, w): as they are, NaN
    taken for 0; 1 % to the right; 1 % down.
    """
    each, index = np.unique(gels, axis=0, return_inverse=True)
    index, inks = index.ravel(), [_ink(gel) for gel in each]
    still = code.encode(each, each)

    def change(ways: NDArray[np.floating[Any]], of: NDArray[np.intp]) -> Tensor:
        moved = ((*inks[k], way) for k, way in zip(of, ways, strict=True))
        images = np.stack([_moved(smooth, ink, way) for smooth, ink, way in moved])
        return code.encode(images, each[of]) - still[of]

    units = (change(np.tile(way, (len(each), 1)), np.arange(len(each))) for way in np.eye(2))
    return torch.cat([change(np.nan_to_num(shears), index), *(u[index] for u in units)], dim=1)


def maps_of(requested: Tensor, marks: Tensor, scale: tuple[Tensor, Tensor]) -> Tensor:
    """What the denoiser sees of touches.

    Args:
        requested: (n, 6), NaN where nothing is requested.
        marks: of :func:`marks_of`, for these shears, over the deviation of the latents.
        scale: mean and deviation (6,) of the training touches.

    Returns:
        (n, channels, h, w).
    """
    (mean, std), side, latent = scale, marks.shape[2], marks.shape[1] // 3
    known = torch.stack([torch.isfinite(requested[:, of]).all(1) for of in PARTS.values()], 1)
    at = torch.where(known[:, _PART], requested, mean)
    value, known, grid = (at - mean) / std, known.float(), (torch.arange(side) + 0.5) / side
    dx, dy = (grid - at[:, :1])[:, None, :], (grid - at[:, 1:2])[:, :, None]
    radius = (at[:, 2].clamp(0.02, 1) / torch.pi).sqrt()[:, None, None]
    blob = torch.exp(-(dx**2 + dy**2) / (2 * radius**2))
    place = torch.stack([2 * blob, 4 * dx.expand_as(blob), 4 * dy.expand_as(blob)], 1)
    flat = torch.cat([value[:, 2:], known], 1)[:, :, None, None].expand(-1, -1, side, side)
    shown, dragged = known[:, :1, None, None], known[:, 3:, None, None]
    return torch.cat([place * shown, flat, marks[:, :latent] * dragged, marks[:, latent:]], 1)


def dropped(requested: Tensor, draws: Tensor) -> Tensor:
    """Touches (n, 6) of which parts are dropped, by uniform draws (n, 5)."""
    gone = (draws[:, :1] < DROP_ALL) | (draws[:, 1:] < DROP)
    return torch.where(gone[:, _PART], torch.nan, requested)


def has_markers(gels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether gels (n, h, w, 3) have markers whose motion shows a shear."""
    each, index = np.unique(gels, axis=0, return_inverse=True)
    return np.array([marker_motion(gel, gel) is not None for gel in each])[index.ravel()]


def drawn(
    requested: NDArray[np.floating[Any]],
    touches: NDArray[np.float32],
    similar: Rows | None,
    ids: Sequence[str],
    seed: int,
) -> NDArray[np.float32]:
    """Touches (n, 6) as requested; what is NaN is that of one training touch each, by (seed, id).

    Args:
        requested: (n, 6).
        touches: (m, 6), of training.
        similar: cosines (n, m) of photos or texts with those of the training touches, or None.
        ids: n names.
        seed: of the draws.
    """
    _, deviation = scale_of(torch.from_numpy(touches))
    off = (requested[:, None] - touches) / (NEAR * deviation.numpy())
    weights = -0.5 * np.nansum(off**2, axis=2) + (0 if similar is None else similar / LIKE)
    sums = np.exp(weights - weights.max(axis=1, keepdims=True)).cumsum(axis=1)
    draws = [rng_for(seed, "touch", name).random() for name in ids]
    rows = [np.searchsorted(s, u * s[-1], "right") for s, u in zip(sums, draws, strict=True)]
    return np.where(np.isfinite(requested), requested, touches[rows]).astype(np.float32)


def reach(strengths: NDArray[np.float32], similar: Rows) -> Rows:
    """(n, 2): between what nearly all strengths (m,) lie of training touches of surfaces like
    those of n samples, by the cosines (n, m).
    """
    order = np.argsort(strengths)
    weights = np.exp((similar - similar.max(axis=1, keepdims=True)) / LIKE)[:, order]
    ends = [np.searchsorted(s / s[-1], (0.01, 0.99)) for s in weights.cumsum(axis=1)]
    return strengths[order][np.array(ends).clip(max=len(order) - 1)].astype(float)


def scale_of(touches: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and deviation (6,) of touches (n, 6), 0 and 1 of what none has."""
    mean = touches.nanmean(0).nan_to_num(0.0)
    deviation = (touches - mean).square().nanmean(0).sqrt()
    return mean, torch.where(deviation > 1e-6, deviation, torch.ones(()))
