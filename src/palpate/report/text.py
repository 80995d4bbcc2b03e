"""Words and numbers: how the page and the Markdown say the same thing in the same way.

Numbers are written with a true minus sign, comma thousands and, inside one table column, equal decimals.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

from palpate.core import Score

#: What a reader of an empty section can run to fill it.
HINTS: Mapping[str, tuple[str, str]] = {
    "gallery": ("No generated touch is in these results.", "palpate generate --help"),
    "scores": ("Nothing was scored in these results.", "palpate score --help"),
    "audits": ("No split was audited in these results.", "palpate audit --help"),
    "commands": ("No command was recorded with these results.", "palpate --help"),
    "settings": ("No settings were recorded with these results.", "palpate --help"),
}

#: Three sentences that every reader of the scores needs.
HOW_TO_READ = (
    "Arrows give the better direction: for TMMD, FID, KID, CMMD and LPIPS lower is better; for SSIM, PSNR and accuracies higher is; for I-, CI- and D-TMMD (→) closer to the floor is.",
    "The floor is what real touches score on the same metric: it, and not zero, is what to come near. I- and CI-TMMD far below it mean that the "
    "touches vary less than real ones do (collapse), not that they are better.",
    "The null band is where a meaningless difference would fall: a score inside it says nothing, and two scores whose intervals overlap "
    "widely are not told apart.",
)


def count(value: int | None) -> str:
    """A whole number with comma thousands; a dash for None."""
    return "–" if value is None else f"{value:,}"


def percent(fraction: float) -> str:
    """A fraction in [0, 1] as a percentage; never rounds a leak to 0 % nor an incomplete one to 100 %."""
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
    """Decimals that give the largest of ``values`` three or four significant digits."""
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if largest == 0:
        return 1
    return max(
        0,
        min(
            8,
            3 - max(0, math.floor(math.log10(largest)))
            if largest >= 0.1
            else 2 - math.floor(math.log10(largest)),
        ),
    )


def number(value: float | None, digits: int | None = None) -> str:
    """A number with ``digits`` decimals (chosen by :func:`decimals` if None); a dash if undefined."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:,.{decimals([value]) if digits is None else digits}f}"
    if text.startswith("-"):
        text = text[1:] if float(text.replace(",", "")) == 0 else "−" + text[1:]
    return text


def score_text(value: float) -> str:
    """A score in [0, 1] with three decimals, or as many as it takes to tell it from 1."""
    if not math.isfinite(value):
        return "–"
    digits = 3
    while value < 1 and f"{value:.{digits}f}" == f"{1:.{digits}f}" and digits < 9:
        digits += 1
    return f"{value:.{digits}f}"


def plural(n: int, singular: str, many: str | None = None) -> str:
    """``"1 video"``, ``"1,234 videos"``; ``many`` where the plural is not made with an s."""
    return f"{n:,} {singular if n == 1 else many or singular + 's'}"


def defined(score: Score) -> bool:
    """Whether a score has a finite value."""
    return score.value is not None and math.isfinite(score.value)


def plain(value: Any) -> Any:
    """``value`` as JSON can hold it: paths and NumPy numbers or arrays made plain, NaN and infinity made null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, PurePath):
        return value.as_posix()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def setting_of(score: Score) -> tuple[str, str]:
    """Preset and split: scores that differ in one of them stand in different tables."""
    return str(score.settings.get("preset", "")), score.split or ""


def interval_text(score: Score, digits: int, before: str = "") -> str:
    """``"[low, high]"`` after ``before``, or '' where no interval is given."""
    if score.interval is None:
        return ""
    return f"{before}[{number(score.interval[0], digits)}, {number(score.interval[1], digits)}]"
