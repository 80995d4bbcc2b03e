"""Words and numbers: how the page and the Markdown say the same thing in the same way.

Numbers are written with a true minus sign, comma thousands and, inside one table column, equal decimals.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from palpate.core import Audit, Results, Score, columns

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
    "Arrows give the better direction: for the TMMD family, FID, KID, CMMD and LPIPS lower is better; for SSIM, PSNR and accuracies higher is.",
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
    return max(0, min(8, 3 - max(0, math.floor(math.log10(largest))) if largest >= 0.1 else 2 - math.floor(math.log10(largest))))


def number(value: float | None, digits: int | None = None) -> str:
    """A number with ``digits`` decimals (chosen by :func:`decimals` if None); a dash if undefined."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:,.{decimals([value]) if digits is None else digits}f}"
    if text.startswith("-"):
        text = text[1:] if float(text.replace(",", "")) == 0 else "−" + text[1:]
    return text


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


def purpose(results: Results) -> str:
    """One sentence that says what the page is."""
    parts: list[str] = []
    if results.gallery or results.scores:
        parts.append("how close touch generated from photos comes to real touch")
    if results.audits:
        parts.append("whether the split behind the numbers leaks from train into test")
    return f"What this page shows: {', and '.join(parts)}." if parts else "Results of palpate; nothing has been measured yet."


def audit_line(audit: Audit) -> str:
    """The finding of one audit in one sentence."""
    if not audit.test_samples:
        return f"{audit.name}: the test part is empty, so nothing can leak."
    if not audit.test_samples_in_shared_groups:
        return f"{audit.name}: no {audit.group} is shared; none of the {plural(audit.test_samples, 'test sample')} leaks."
    one = audit.test_samples_in_shared_groups == 1
    return (
        f"{audit.name}: {percent(audit.leaked_fraction)} of the test samples leak; {count(audit.test_samples_in_shared_groups)} of "
        f"{count(audit.test_samples)} {'comes' if one else 'come'} from a {audit.group} that train holds as well."
    )


def setting_of(score: Score) -> tuple[str, str]:
    """Preset and split: scores that differ in one of them stand in different tables."""
    return str(score.settings.get("preset", "")), score.split or ""


def score_line(scores: Sequence[Score]) -> str:
    """The first column with a value, in one sentence; '' if there is none."""
    first = next((setting_of(s) for s in scores if defined(s)), None)
    for metric, column in columns(s for s in scores if setting_of(s) == first).items():
        shown = [s for s in column if defined(s)]
        if shown:
            digits = decimals([s.value for s in shown if s.value is not None])
            said = ", ".join(f"{s.subject} {number(s.value, digits)}{interval_text(s, digits, before=' ')}" for s in shown[:3])
            floors = [s.floor for s in shown if s.floor is not None]
            floor = f"; floor {number(floors[0], digits)}" if floors else ""
            return f"{metric} ({'higher' if shown[0].higher_is_better else 'lower'} is better): {said}{floor}."
    return ""


def interval_text(score: Score, digits: int, before: str = "") -> str:
    """``"[low, high]"`` after ``before``, or '' where no interval is given."""
    if score.interval is None:
        return ""
    return f"{before}[{number(score.interval[0], digits)}, {number(score.interval[1], digits)}]"


def summary_lines(results: Results) -> list[str]:
    """At most three headline facts for the terminal and the head of the page.

    The facts of the results come first; where there are fewer than three, the first and the last audit and the first
    metric fill up.

    Raises:
        PalpateError: if the scores may not stand in one table.
    """
    lines = list(results.facts[:3])
    ends = [results.audits[0], results.audits[-1]] if len(results.audits) > 1 else list(results.audits)
    candidates = [audit_line(a) for a in ends] + [score_line(results.scores)]
    if len(results.gallery):
        candidates.append(f"{plural(len(results.gallery), 'generated touch', 'generated touches')} in the gallery.")
    return (lines + [c for c in candidates if c and c not in lines])[:3] if len(lines) < 3 else lines
