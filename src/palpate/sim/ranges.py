"""The ranges of a world's options, and what is wrong with values outside them.

Lengths are in mm, angles in degrees. The materials live on a periodic tile of 64 mm; a view of w mm turned by 45 degrees is w sqrt(2) wide, so
views are at most 64 / sqrt(2) = 45.25 mm wide, and the tile never shows its repeat.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from palpate.core import PalpateError

#: Frames of the background rule: the background of a touch is the frame this many before its first.
BACKGROUND_OFFSET = 4
#: The widest view in mm, the tile's side / sqrt(2), rounded down.
WIDEST_VIEW_MM = 45.25

#: Option -> smallest and largest value; whole numbers where these are.
RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "size": (16, 256),
    "objects_per_material": (1, 10_000),
    "videos_per_object": (1, 100),
    "two_videos": (0.0, 1.0),
    "touches_per_video": (1, 100),
    "frames_per_touch": (1, 200),
    "free_frames": (BACKGROUND_OFFSET + 1, 200),
    "objects_per_video": (1, 14),
    "mixed": (0.0, 1.0),
    "sensors": (1, 100),
    "hard": (0.0, 1.0),
    "named": (0.0, 1.0),
    "test": (0.01, 0.99),
    "tile": (64, 1024),
    "curved": (0.0, 1.0),
    "pad_mm": (5.0, 30.0),
    "gel_mm": (0.5, 10.0),
    "optical_mm": (0.0, 2.0),
    "markers": (0, 40),
    "dirt": (0.0, 10.0),
    "revisit_mm": (0.0, 32.0),
    "jump": (0.0, 1.0),
    "tilt": (0.0, 0.5),
    "shear": (0.0, 5.0),
    "hand": (0.0, 1.0),
    "shadow": (0.0, 1.0),
    "edge": (0.0, 1.0),
    "stains": (0.0, 10.0),
    "sway": (0.0, 10.0),
}
#: Options that are a range (low, high) -> smallest low and largest high.
PAIRS: dict[str, tuple[float, float]] = {
    "radius_mm": (5.0, 1000.0),
    "dome_mm": (10.0, 1000.0),
    "vignette": (0.0, 0.9),
    "sensor_noise": (0.0, 0.2),
    "load_mm": (0.005, 1.5),
    "view_mm": (15.0, WIDEST_VIEW_MM),
    "elevation_deg": (1.0, 89.0),
}
#: Options that are a few numbers -> smallest and largest of each, and how few they may be.
SERIES: dict[str, tuple[float, float, int]] = {
    "relax_mm": (0.01, 10.0, 0),
    "slide_mm": (0.0, 32.0, 1),
    "blur_px": (0.0, 5.0, 1),
}
#: Longest series.
LONGEST = 8
CHOICES: dict[str, tuple[str, ...]] = {
    "look": ("gelsight", "digit"),
    "balance": ("uniform", "touch-and-go"),
    "leak": ("frame", "contact", "none"),
    "layout": ("frames", "videos", "hct", "raw"),
    "free_written": ("all", "background"),
}


def is_number(value: Any, whole: bool = False) -> bool:
    """Whether ``value`` is a finite number, and no truth value."""
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        return False
    return isinstance(value, int) or math.isfinite(value)


def shown(value: Any) -> str:
    """``value`` in a message: its repr in one line, not longer than 120 characters."""
    try:
        said = " ".join(repr(value).split())
    except ValueError:  # Python writes no whole number of more than some thousand digits
        said = "a number of too many digits"
    return said if len(said) <= 120 else f"{said[:100]}... ({len(said)} characters)"


def _nearest(value: float, low: float, high: float) -> float:
    """The number in the range that is nearest to ``value``."""
    return min(max(value, low), high)


def _written(number: float) -> str:
    """A number in a message: whole ones with all digits."""
    return str(number) if isinstance(number, int) else f"{number:g}"


def out_of_range(values: dict[str, Any]) -> Iterator[PalpateError]:
    """What is wrong with the values of the options in these tables, each by itself.

    Args:
        values: option -> value, for every option in the tables.
    """
    for name, (low, high) in RANGES.items():
        value, whole = values[name], isinstance(low, int)
        if not is_number(value, whole) or not low <= value <= high:
            kind = "a whole number" if whole else "a number"
            near = _nearest(value, low, high) if is_number(value) else low
            must = f"{name} must be {kind} from {_written(low)} to {_written(high)}"
            yield PalpateError(
                must, shown(value), f"Pass e.g. {name}={_written(round(near) if whole else near)}"
            )
    for name, (low, high) in PAIRS.items():
        value = values[name]
        if (
            not isinstance(value, tuple)
            or len(value) != 2
            or not all(is_number(v) and low <= v <= high for v in value)
        ):
            numbers = isinstance(value, tuple) and len(value) == 2 and all(map(is_number, value))
            near = [_nearest(v, low, high) for v in sorted(value)] if numbers else [low, high]
            fix = f"Pass e.g. {name}=({near[0]:g}, {near[1]:g})"
            yield PalpateError(
                f"{name} must be two numbers from {low:g} to {high:g}", shown(value), fix
            )
        elif value[0] > value[1]:
            yield PalpateError(
                f"{name} must be a range, the lower end first",
                shown(value),
                f"Pass {name}=({value[1]:g}, {value[0]:g})",
            )
    for name, (low, high, least) in SERIES.items():
        value = values[name]
        if (
            not isinstance(value, tuple)
            or not least <= len(value) <= LONGEST
            or not all(is_number(v) and low <= v <= high for v in value)
        ):
            many = f"{least} to {LONGEST} numbers from {low:g} to {high:g}"
            yield PalpateError(
                f"{name} must be {many}", shown(value), f"Pass e.g. {name}=({low:g}, {high:g})"
            )
    for name, choices in CHOICES.items():
        if not isinstance(values[name], str) or values[name] not in choices:
            listed = ", ".join(map(repr, choices))
            yield PalpateError(
                f"{name} must be one of {listed}",
                shown(values[name]),
                f"Pass {name}={choices[0]!r}",
            )
