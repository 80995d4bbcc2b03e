"""Numbers and words, the same in every front end.

Numbers are written with a true minus sign, comma thousands and, inside one column, equal decimals.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from palpate.core import SampleRef

#: What to run to fill an empty section of a page.
HINTS = {
    "gallery": ("No generated tactile image is in these results.", "palpate generate --help"),
    "scores": ("Nothing was scored in these results.", "palpate score --help"),
    "audits": ("No split was audited in these results.", "palpate audit --help"),
    "commands": ("No command was recorded with these results.", "palpate --help"),
    "settings": ("No settings were recorded with these results.", "palpate --help"),
}
#: What every reader of scores needs to know.
HOW_TO_READ = (
    "Arrows give the better direction: for TMMD, FID, KID, CMMD and LPIPS lower is better; for "
    "SSIM, PSNR and accuracies higher is; for I-, CI- and D-TMMD (→) closer to the floor is. "
    "The floor is what real images of other videos score on the same metric: it, and not zero, is "
    "the target. I- and CI-TMMD far below it mean that the images vary less than real ones "
    "(collapse), not that they are better. "
    "The null band is where a meaningless difference would fall: a score inside it says nothing, "
    "and two scores whose intervals overlap widely are not distinguished."
)
#: Names in a sentence; the others are counted.
NAMES = 5


def count(value: int | None) -> str:
    """Return a whole number with comma thousands; a dash for None."""
    return "–" if value is None else f"{value:,}"


def percent(fraction: float) -> str:
    """Return a fraction in [0, 1] in percent, never rounded to 0 % or 100 %."""
    if not math.isfinite(fraction):
        return "–"
    if 0 < fraction < 0.0001:
        return "< 0.01 %"
    if 0.9999 < fraction < 1:
        return "> 99.99 %"
    if fraction in (0, 1):
        return f"{100 * fraction:.0f} %"
    return f"{100 * fraction:.{1 if 0.01 <= fraction < 0.99 else 2}f} %"


def decimals(values: Iterable[float]) -> int:
    """Return the decimals that give the largest of ``values`` three or four digits."""
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if largest == 0:
        return 1
    power = math.floor(math.log10(largest))
    return max(0, min(8, 3 - max(0, power) if largest >= 0.1 else 2 - power))


def number(value: float | None, digits: int | None = None) -> str:
    """Return a number with ``digits`` decimals, by default those of :func:`decimals`."""
    if value is None or not math.isfinite(value):
        return "–"
    digits = decimals([value]) if digits is None else digits
    return f"{value:z,.{digits}f}".replace("-", "−")


def score_text(value: float) -> str:
    """Return a score in [0, 1] with three decimals, or as many as distinguish it from 1."""
    if not math.isfinite(value):
        return "–"
    digits = next((d for d in range(3, 9) if f"{value:.{d}f}" != f"{1:.{d}f}"), 9)
    return f"{value:.{3 if value >= 1 else digits}f}"


def plural(n: int, singular: str, many: str | None = None) -> str:
    """Return ``"1 video"``, ``"1,234 videos"``; ``many`` where the plural is irregular."""
    return f"{n:,} {singular if n == 1 else many or singular + 's'}"


def few(names: Sequence[str]) -> str:
    """Return ``"a, b, c, d, e and 3 more"``."""
    more = len(names) - NAMES
    return ", ".join(names[:NAMES]) + (f" and {more} more" if more > 0 else "")


def where(sample: SampleRef) -> str:
    """Return ``"video, frame 12"``, or the id where the sample has no video."""
    if sample.video is None:
        return sample.id
    return sample.video if sample.frame is None else f"{sample.video}, frame {sample.frame}"
