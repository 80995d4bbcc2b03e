"""Recordings whose vision and tactile folders are swapped, found by image size and by color.

Where the sides of a recording differ in size and vision has the sensor's, they are swapped. Where
sizes say nothing, colors do: each side becomes an 8 x 8 thumbnail (the mean of a few frames, RGB in
[0, 1]). Untouched gel looks similar in every recording of one rig, so the side whose thumbnails
``x`` spread less around their median ``c`` is the gel's, if it spreads less than half as much. With
``d(x) = sqrt(mean((x - c)^2))`` a recording is swapped if its vision has ``d`` under half that of
its tactile side, and no more than three spreads (plus 0.02, five gray levels).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import Progress
from palpate.data.images import BROKEN, in_threads, opened

#: Fewer recordings than this have no typical gel.
FEWEST = 3
THUMBNAIL = 8


@dataclass(frozen=True)
class Look:
    """What one side of a recording looks like.

    Attributes:
        size: (width, height) of its first frame, in pixels.
        thumbnail: (8, 8, 3), 0 to 1, the mean of its frames.
    """

    size: tuple[int, int]
    thumbnail: NDArray[np.float64]


def look(paths: Sequence[Path]) -> Look | None:
    """The look of a few frames; None if none of them can be read."""
    sizes: list[tuple[int, int]] = []
    thumbnails: list[NDArray[np.float64]] = []
    for path in paths:
        try:
            with opened(path) as image:
                size = image.size
                image.draft("RGB", (max(THUMBNAIL, size[0] // 8), max(THUMBNAIL, size[1] // 8)))
                small = image.convert("RGB").resize((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX)
        except BROKEN:
            continue
        sizes.append(size)
        thumbnails.append(np.asarray(small, np.float64) / 255)
    return Look(sizes[0], np.mean(thumbnails, axis=0)) if sizes else None


def looks(
    files: Mapping[str, tuple[Sequence[Path], Sequence[Path]]], progress: Progress
) -> dict[str, tuple[Look, Look]]:
    """Recording -> (vision, tactile) looks of the given frames, without unreadable recordings."""
    look_at = lambda name: (look(files[name][0]), look(files[name][1]))  # noqa: E731
    pairs = dict(in_threads(look_at, files, "looking for swapped folders", progress))
    return {name: (v, t) for name in files for v, t in [pairs[name]] if v and t}


def swapped(sides: Mapping[str, tuple[Look, Look]], sensor_size: tuple[int, int]) -> dict[str, str]:
    """Recordings of one rig that are swapped, with the evidence.

    Args:
        sides: recording -> (vision, tactile).
        sensor_size: (width, height) of the sensor's images.
    """
    evidence: dict[str, str] = {}
    undecided: dict[str, tuple[Look, Look]] = {}
    for name, (vision, tactile) in sides.items():
        if sensor_size not in (vision.size, tactile.size) or vision.size == tactile.size:
            undecided[name] = (vision, tactile)
        elif vision.size == sensor_size:
            sizes = "frames of vision are {}x{} pixels as the sensor's should be, tactile {}x{}"
            evidence[name] = sizes.format(*vision.size, *tactile.size)
    return evidence | (_by_color(undecided) if len(undecided) >= FEWEST else {})


def _by_color(sides: Mapping[str, tuple[Look, Look]]) -> dict[str, str]:
    stacks = [np.stack([pair[k].thumbnail for pair in sides.values()]) for k in (0, 1)]
    medians = [np.median(stack, axis=0) for stack in stacks]
    spreads = [float(np.median(_distance(s, c))) for s, c in zip(stacks, medians, strict=True)]
    gel = int(np.argmin(spreads))
    if not min(spreads) < 0.5 * max(spreads):
        return {}
    evidence: dict[str, str] = {}
    distances = (_distance(stack, medians[gel]) for stack in stacks)
    for name, vision, tactile in zip(sides, *distances, strict=True):
        if vision < 0.5 * tactile and vision <= 3 * spreads[gel] + 0.02:
            colors = "colors of vision are {:.3f} from this rig's typical gel, of tactile {:.3f}"
            evidence[name] = colors.format(vision, tactile)
    return evidence


def _distance(stack: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square difference of each thumbnail to one: (n,)."""
    return np.sqrt(((stack - center) ** 2).mean(axis=(1, 2, 3)))
