"""The ruler ``palpate/handcrafted``: 149 numbers of residuals (:mod:`palpate.data.residuals`).

It is not trained: what a learned ruler must beat. Of a residual r in the opponent colors gray,
red - green and yellow - blue:

- 51: log power of the spectrum in 17 rings, of each color;
- 36: at three scales (1, 2, 4 pixels) the structure tensor of gray: its energy by direction (8, as
  shares), mean and deviation of its coherence, log of the mean and deviation of the gradient;
- 18: area above five strengths, strength of each color, extent and elongation of the contact;
- 14: deviation, skew and kurtosis of each color, five quantiles of gray;
- 30: rotation-invariant uniform local binary patterns of gray at the same scales.

Numbers are compared after ``(x - center) / spread``: deviations of the simulated contacts that lie
with the weights; ``score`` takes those of the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from palpate.data.images import Preprocess
from palpate.data.residuals import Residual
from palpate.encoders.tactile_module import Format, State, TactileModule

#: Side of the residuals in pixels.
SIDE = 96
#: Rings of the spectrum, from 1 to 48 periods an image.
RINGS = 17
#: Pixels that are averaged before directions and binary patterns are measured.
SCALES = (1, 2, 4)
#: Directions of a half turn.
DIRECTIONS = 8
#: Strengths in gray levels that count as contact.
STRENGTHS = (1.0, 2.0, 4.0, 8.0, 16.0)


class Handcrafted(TactileModule):
    """149 numbers of residuals, standardized but of no unit length.

    Attributes:
        center, spread: mean and deviation (149,) of simulated contacts.
    """

    preprocess: Preprocess = Residual(SIDE, SIDE)

    def __init__(self, state: State) -> None:
        super().__init__()
        self.dim = len(state["center"])
        self.center, self.spread = (nn.Parameter(torch.empty(self.dim)) for _ in range(2))

    def numbers(self, residuals: Tensor) -> Tensor:
        """Residuals (n, 3, h, w) in gray levels to (n, 149): see the head of this file."""
        red, green, blue = residuals.unbind(1)
        gray, yellow = residuals.mean(1), (red + green) / 2
        colors = torch.stack([gray, red - green, yellow - blue], 1)
        parts = [_spectrum(colors), _directions(gray), _contact(colors), _moments(colors)]
        return torch.cat([*parts, _patterns(gray)], 1)

    def forward(self, pixels: Tensor, sensors: Tensor | None = None) -> Tensor:
        """Residuals (n, 3, h, w) in gray levels to (n, 149), standardized."""
        return (self.numbers(pixels) - self.center) / self.spread

    def encode(self, pixels: Tensor, sensors: Sequence[str] | None = None) -> Tensor:
        """The same; its rows keep their length, which the reference's deviations need."""
        return self(pixels)


def _spectrum(colors: Tensor) -> Tensor:
    """Log power in rings (n, 3 * RINGS), of colors (n, 3, side, side) under a Hann window."""
    side = colors.shape[2]
    window = torch.hann_window(side, periodic=False, device=colors.device)
    centered = colors - colors.mean((2, 3), keepdim=True)
    power = torch.fft.fft2(centered * window * window[:, None]).abs() ** 2 / side**2
    ring = torch.from_numpy(_rings(side)).to(colors.device)
    sums = power.new_zeros(*power.shape[:2], RINGS + 2)
    sums.index_add_(2, ring, power.flatten(2))
    counts = torch.bincount(ring, minlength=RINGS + 2).clamp(min=1)
    return torch.log(sums / counts + 1e-4)[:, :, 1:-1].flatten(1)


@lru_cache(4)
def _rings(side: int) -> np.ndarray:
    """The ring of each frequency, 1 to RINGS; 0 is below, RINGS + 1 above."""
    periods = np.fft.fftfreq(side, 1 / side)
    edges = np.append(np.arange(0.5, 5), np.geomspace(5.5, side / 2, RINGS - 4))
    return np.digitize(np.hypot(periods[:, None], periods).ravel(), edges)


def _directions(gray: Tensor) -> Tensor:
    """Energy by direction, coherence and gradient, (n, 3 * (DIRECTIONS + 4))."""
    parts: list[Tensor] = []
    for scale in SCALES:
        y, x = torch.gradient(_blurred(avg_pool2d(gray[:, None], scale))[:, 0], dim=(1, 2))
        energy = x * x + y * y
        local = _blurred(torch.stack([x * x - y * y, 2 * x * y, energy], 1))
        coherence = local[:, :2].norm(dim=1) / (local[:, 2] + 1e-3)
        angle = torch.atan2(y, x).remainder(torch.pi) * (DIRECTIONS / torch.pi)
        bins = angle.long().clamp(max=DIRECTIONS - 1).flatten(1)
        shares = energy.new_zeros(len(gray), DIRECTIONS).scatter_add_(1, bins, energy.flatten(1))
        size = energy.sqrt()
        parts += [shares / (shares.sum(1, keepdim=True) + 1e-6), *_spread_of(coherence)]
        parts += [torch.log(v + 1e-3) for v in _spread_of(size)]
    return torch.cat(parts, 1)


def _spread_of(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and deviation (n, 1) each, of (n, h, w)."""
    flat = values.flatten(1)
    return flat.mean(1, keepdim=True), flat.std(1, keepdim=True)


def _contact(colors: Tensor) -> Tensor:
    """Areas, strengths and shape of the contact, (n, 18)."""
    smooth = _blurred(avg_pool2d(colors, 2))
    strength = smooth.norm(dim=1)
    areas = torch.stack([(strength > level).float().mean((1, 2)) for level in STRENGTHS], 1)
    size = smooth.abs().flatten(2)
    amounts = [size.mean(2), size.quantile(0.95, dim=2), size.amax(2)]
    weight = strength / (strength.sum((1, 2), keepdim=True) + 1e-6)
    y, x = torch.meshgrid(*[torch.linspace(-1, 1, s) for s in weight.shape[1:]], indexing="ij")
    y, x = y.to(weight.device), x.to(weight.device)
    mean = lambda v: (weight * v).sum((1, 2))
    at_y, at_x = mean(y), mean(x)
    yy, xx, xy = mean(y * y) - at_y**2, mean(x * x) - at_x**2, mean(x * y) - at_x * at_y
    apart = ((xx - yy) ** 2 + 4 * xy**2).sqrt() / (xx + yy + 1e-6)
    peaked = strength.amax((1, 2)) / (strength.mean((1, 2)) + 1e-3)
    shape = torch.stack([torch.hypot(at_y, at_x), xx + yy, apart, peaked.add(1e-2).log()], 1)
    return torch.cat([areas, *(torch.log(a + 1e-2) for a in amounts), shape], 1)


def _moments(colors: Tensor) -> Tensor:
    """Deviation, skew and kurtosis of each color, and quantiles of gray, (n, 14)."""
    flat = colors.flatten(2)
    spread = flat.std(2, keepdim=True) + 1e-3
    z = (flat - flat.mean(2, keepdim=True)) / spread
    levels = torch.tensor([0.05, 0.25, 0.5, 0.75, 0.95], device=flat.device)
    gray = avg_pool2d(colors[:, :1], 2).flatten(1)
    quantiles = torch.asinh(gray.quantile(levels, dim=1).T)
    return torch.cat(
        [spread[..., 0].log(), (z**3).mean(2), (z**4).mean(2).add(1e-3).log(), quantiles], 1
    )


def _patterns(gray: Tensor) -> Tensor:
    """Shares of the ten rotation-invariant uniform binary patterns at each radius, (n, 30)."""
    parts: list[Tensor] = []
    for scale in SCALES:
        smooth = avg_pool2d(gray, scale)
        inner = smooth[:, 1:-1, 1:-1]
        rows, columns = inner.shape[1:]
        ring = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
        at = [(1 + dy, 1 + dx) for dy, dx in ring]
        around = [smooth[:, y : y + rows, x : x + columns] for y, x in at]
        above = torch.stack([v >= inner for v in around], 1).long()
        changes = (above != above.roll(1, 1)).sum(1)
        code = torch.where(changes <= 2, above.sum(1), 9).flatten(1)
        counts = gray.new_zeros(len(gray), 10)
        parts.append(counts.scatter_add_(1, code, torch.ones_like(code, dtype=gray.dtype)))
    return torch.cat([p / p.sum(1, keepdim=True) for p in parts], 1)


def _blurred(images: Tensor) -> Tensor:
    """Images (n, c, h, w) under a binomial kernel of a deviation of one pixel."""
    images = pad(images, (2, 2, 2, 2), mode="reflect")
    for axis in (2, 3):
        n = images.shape[axis] - 4
        parts = [w / 16 * images.narrow(axis, k, n) for k, w in enumerate((1, 4, 6, 4, 1))]
        images = torch.stack(parts).sum(0)
    return images


HANDCRAFTED = Format("palpate/handcrafted", "Apache-2.0", (), "handcrafted.", "center", Handcrafted)
