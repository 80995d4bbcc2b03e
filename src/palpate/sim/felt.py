"""What can be felt at a contact, measured on the simulated surface, and words for it.

Six attributes of the relief under the pad (height h in mm, its plane removed; p = |grad h|^2):

- roughness: log of the root mean square slope, sqrt(mean p);
- grain: log of the mean wavelength in mm, sum(S) / sum(S f) over the power spectrum S of h;
- regularity: share of the twelve strongest of the frequencies in S;
- direction: (l1 - l2) / (l1 + l2) of the eigenvalues of mean(grad h grad h^T);
- hardness: 1 - softness of the material;
- friction: softness + roughness / 4 - gloss / 2; rough, soft and matt surfaces hold the finger.

Each has five levels, at fixed limits that the contacts of the twenty materials fill about equally.
A describer is uncertain: normal noise, 0.15 levels wide, is added to each attribute.
The three to five attributes farthest from their middle are named. Nothing but the measured numbers
enters, so two materials share words where they feel the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from palpate.sim.arrays import Array
from palpate.sim.options import WorldOptions

#: Wavelengths above this are the body's shape, not its surface.
LONGEST_MM = 10.0
#: Slope that counts as none, so that its logarithm is finite.
SMOOTHEST = 1e-3
STRONGEST = 12
#: Deviation of the describer, in levels.
DESCRIBER = 0.15
#: The words, joined by commas and "and".
TEMPLATES = ("{}", "it feels {}", "a surface that feels {}", "{} to the touch")
TINY = 1e-12


@dataclass(frozen=True)
class Scale:
    """Five levels of an attribute."""

    limits: tuple[float, float, float, float]  # the four limits between the levels
    #: The words of each level; any of them is chosen. None leaves a level without a name.
    words: tuple[tuple[str, ...], ...]

    def level(self, value: float) -> float:
        """Return the level as a real number from 0 to 5, linear between the limits."""
        low, high = 2 * self.limits[0] - self.limits[1], 2 * self.limits[3] - self.limits[2]
        return float(np.interp(value, (low, *self.limits, high), range(6)))


SCALES: dict[str, Scale] = {
    "roughness": Scale(
        (-2.2, -1.35, -0.8, -0.4),
        (
            ("very smooth", "sleek"),
            ("smooth", "even"),
            ("slightly rough", "faintly rough"),
            ("rough", "coarse"),
            ("very rough", "rugged"),
        ),
    ),
    "grain": Scale(
        (0.5, 0.85, 1.2, 1.5),
        (
            ("very fine", "hair-fine"),
            ("fine-grained", "fine"),
            ("medium-grained",),
            ("large-grained", "bumpy"),
            ("broad", "wavy"),
        ),
    ),
    "regularity": Scale(
        (0.33, 0.47, 0.64, 0.84),
        (("random", "irregular"), ("uneven",), (), ("fairly regular",), ("regular", "repeating")),
    ),
    "direction": Scale(
        (0.05, 0.12, 0.25, 0.65),
        (("without direction",), (), (), ("slightly lined",), ("lined", "ridged")),
    ),
    "hardness": Scale(
        (0.4, 0.6, 0.8, 0.95),
        (("soft", "springy"), ("yielding",), ("slightly yielding",), ("firm",), ("hard", "rigid")),
    ),
    "friction": Scale(
        (-0.65, -0.3, 0.0, 0.35),
        (
            ("slippery", "slick"),
            ("easy to slide on",),
            (),
            ("grippy",),
            ("clinging", "very grippy"),
        ),
    ),
}


def measure(relief: Array, px: float, softness: float, gloss: float) -> dict[str, float]:
    """Measure the attributes of a patch: its relief (n, n) in mm with pixels of ``px`` mm.

    Softness and gloss of the material are in [0, 1].
    """
    n = len(relief)
    at = np.arange(n) - (n - 1) / 2
    height = relief - relief.mean()
    slopes = (at @ height).sum(), (height @ at).sum()
    height = height - (slopes[0] * at[:, None] + slopes[1] * at) / (n * (at @ at))
    dy, dx = np.gradient(height, px)
    smallest, largest = np.linalg.eigvalsh(np.cov([dy.ravel(), dx.ravel()]))
    window = np.hanning(n)
    power = np.abs(np.fft.rfft2(height * window * window[:, None])) ** 2
    frequency = np.hypot(np.fft.fftfreq(n, px)[:, None], np.fft.rfftfreq(n, px))
    power = power * (frequency > 1.0 / LONGEST_MM) + TINY
    roughness = math.log(math.sqrt(float((dy**2 + dx**2).mean())) + SMOOTHEST)
    return {
        "roughness": roughness,
        "grain": math.log(power.sum() / (power * frequency).sum()),
        "regularity": float(np.sort(power, axis=None)[-STRONGEST:].sum() / power.sum()),
        "direction": float((largest - smallest) / (largest + smallest + TINY)),
        "hardness": 1.0 - softness,
        "friction": softness + roughness / 4.0 - gloss / 2.0,
    }


def caption(options: WorldOptions, video: int, contact: int, felt: Mapping[str, float]) -> str:
    """Write the caption of a contact: three to five words or phrases of different attributes.

    Args:
        options: the world's.
        video: index of the video.
        contact: number of the contact in it.
        felt: what :func:`measure` returns.
    """
    rng = options.rng("felt text", video, contact)
    salience: dict[str, tuple[float, str]] = {}
    for name, scale in SCALES.items():
        level = scale.level(felt[name]) + DESCRIBER * float(rng.standard_normal())
        words = scale.words[min(max(int(level), 0), 4)]
        if words:
            salience[name] = abs(level - 2.5), words[int(rng.integers(len(words)))]
    chosen = sorted(salience.values(), reverse=True)[: int(rng.integers(3, 6))]
    *first, last = (chosen[k][1] for k in rng.permutation(len(chosen)))
    template = TEMPLATES[int(rng.integers(len(TEMPLATES)))]
    text = template.format(f"{', '.join(first)} and {last}")
    return f"{text[0].upper()}{text[1:]}."
