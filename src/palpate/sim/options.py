"""What a world is made of: the options, their ranges, and the presets."""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from palpate.core import PalpateError, Problem, ProblemsError, digest_json, rng_for
from palpate.sim.materials import MATERIALS

#: Raised at every change of the pictures, texts or lists; enters every random draw and the digest.
VERSION = 1
#: Frames of the background rule: the background of a touch is the frame this many before its first.
BACKGROUND_OFFSET = 4

#: Option -> smallest and largest value.
RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "size": (16, 512),
    "objects_per_material": (1, 10_000),
    "videos_per_object": (1, 100),
    "touches_per_video": (1, 100),
    "frames_per_touch": (1, 200),
    "free_frames": (BACKGROUND_OFFSET + 1, 200),
    "objects_per_video": (1, 14),
    "mixed": (0.0, 1.0),
    "sensors": (1, 100),
    "hard": (0.0, 1.0),
    "named": (0.0, 1.0),
    "test": (0.01, 0.99),
    "tile": (64, 2048),
}
CHOICES: dict[str, tuple[str, ...]] = {
    "look": ("gelsight", "digit"),
    "leak": ("frame", "touch", "none"),
    "layout": ("frames", "videos"),
    "free_written": ("all", "background"),
}


@dataclass(frozen=True)
class WorldOptions:
    """Everything that decides a world; equal options give equal bytes.

    Attributes:
        seed: worlds of different seeds share no object, video or text.
        size: side of the square images in pixels, 16 to 512 (even for ``layout="videos"``).
        materials: names of ``MATERIALS``, or how many of them, spread evenly over the table; becomes a tuple of names.
        objects_per_material: objects of each material that have videos of their own.
        videos_per_object: videos of each object.
        touches_per_video: contacts in a video.
        frames_per_touch: frames in contact in each touch.
        free_frames: frames without contact before each touch, at least 5, so that the first contact frame - 4 shows the passive sensor.
        free_written: ``"all"`` writes them all; ``"background"`` only the one that the background rule needs (frame numbers stay).
        objects_per_video: a mixed video touches 2 to this many objects of different materials (1: no video is mixed).
        mixed: share of the videos that are mixed; their further objects appear in no other video.
        sensors: gel units of the sensor family; each video uses one.
        look: ``"gelsight"`` (markers, near-field colours) or ``"digit"`` (no markers, darker, stronger colours).
        hard: 0 to 1, scales everything in the photos that is irrelevant to touch (stains, hand, edges, shadows, light, gain drift).
        named: share of the captions that name the thing; the others say only how it feels.
        leak: how ``train.txt`` and ``test.txt`` are cut: random ``"frame"``, random whole ``"touch"``, or by video (``"none"``).
        test: share of the contact frames in ``test.txt``, nearly.
        layout: ``"frames"`` (JPEG files) or ``"videos"`` (H.264, needs PyAV).
        tile: pixels a side of an object's 64 mm tile; 256 fits 64 px images, 512 fits 128 px. Another tile is another object.

    Raises:
        PalpateError: if an option is out of range; :class:`~palpate.core.ProblemsError` if several are.
    """

    seed: int = 0
    size: int = 64
    materials: tuple[str, ...] | int = 20
    objects_per_material: int = 5
    videos_per_object: int = 1
    touches_per_video: int = 4
    frames_per_touch: int = 3
    free_frames: int = 5
    free_written: Literal["all", "background"] = "all"
    objects_per_video: int = 3
    mixed: float = 0.12
    sensors: int = 3
    look: Literal["gelsight", "digit"] = "gelsight"
    hard: float = 0.5
    named: float = 0.5
    leak: Literal["frame", "touch", "none"] = "touch"
    test: float = 0.25
    layout: Literal["frames", "videos"] = "frames"
    tile: int = 256

    def __post_init__(self) -> None:
        found = [*self._out_of_range()]
        if isinstance(self.materials, int):
            count = self.materials
            if 1 <= count <= len(MATERIALS):
                names = list(MATERIALS)
                object.__setattr__(self, "materials", tuple(names[k * len(names) // count] for k in range(count)))
            else:
                found.append(PalpateError("materials must be 1 to " + str(len(MATERIALS)), str(count), "Pass a smaller count, or names"))
        else:
            object.__setattr__(self, "materials", tuple(self.materials))
            found.extend(_unknown_materials(self.names))
        if self.layout == "videos" and self.size % 2:
            found.append(PalpateError("size must be even for layout='videos'", str(self.size), f"Pass size={self.size + 1}"))
        if self.layout == "videos" and self.free_written != "all":
            found.append(PalpateError("layout='videos' must write all free frames", "free_written='background'", "Leave free_written out"))
        if len(found) == 1:
            raise found[0]
        if found:
            raise ProblemsError([Problem("WorldOptions", "bad-option", str(e)) for e in found], str(found[0]))

    def _out_of_range(self) -> list[PalpateError]:
        found: list[PalpateError] = []
        for name, (low, high) in RANGES.items():
            value: Any = getattr(self, name)
            whole = isinstance(low, int)
            right_kind = isinstance(value, int) if whole else isinstance(value, int | float)
            if not right_kind or isinstance(value, bool) or not low <= value <= high:
                kind = "a whole number" if whole else "a number"
                found.append(PalpateError(f"{name} must be {kind} from {low:g} to {high:g}", repr(value), f"Pass e.g. {name}={low:g}"))
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                listed = ", ".join(map(repr, choices))
                found.append(PalpateError(f"{name} must be one of {listed}", repr(getattr(self, name)), f"Pass {name}={choices[0]!r}"))
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the materials."""
        return self.materials if isinstance(self.materials, tuple) else ()

    @property
    def video_length(self) -> int:
        """Frames of a video, the unwritten ones included."""
        return self.touches_per_video * (self.free_frames + self.frames_per_touch)

    @property
    def digest(self) -> str:
        """SHA-256 over the options and VERSION: names what the world will be."""
        return digest_json({"version": VERSION, "options": dataclasses.asdict(self)})

    def rng(self, purpose: str, *ids: str | int) -> np.random.Generator:
        """The generator for one purpose; depends on VERSION, the seed, the purpose and the ids alone."""
        return rng_for(self.seed, "world", VERSION, purpose, *ids)


def _unknown_materials(names: tuple[str, ...]) -> list[PalpateError]:
    found: list[PalpateError] = []
    if not names:
        found.append(PalpateError("materials must name at least one material", "none", "Pass e.g. materials=('Wood', 'Grass')"))
    if len(set(names)) < len(names):
        found.append(PalpateError("materials must name each material once", repr(names), "Leave out the repeated names"))
    for name in names:
        if name not in MATERIALS:
            near = difflib.get_close_matches(name, MATERIALS, 1, 0.3)
            fix = f"Did you mean {near[0]!r}? Known: {', '.join(MATERIALS)}" if near else f"Known: {', '.join(MATERIALS)}"
            found.append(PalpateError("materials must be names of MATERIALS", repr(name), fix))
    return found
