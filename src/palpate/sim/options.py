"""What a world is made of: the options, checked against :mod:`palpate.sim.ranges` and against each other."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from palpate.core import PalpateError, Problem, ProblemsError, digest_json, rng_for
from palpate.sim.materials import MATERIALS
from palpate.sim.materials.entries import bad_entries
from palpate.sim.ranges import (
    BACKGROUND_OFFSET,
    CHOICES,
    PAIRS,
    RANGES,
    SERIES,
    out_of_range,
    shown,
)

__all__ = ["BACKGROUND_OFFSET", "CHOICES", "PAIRS", "RANGES", "SERIES", "VERSION", "WorldOptions"]

#: Raised at every change of the pictures, texts or lists; enters every random draw and the digest.
VERSION = 2
Span = tuple[float, float]


@dataclass(frozen=True)
class WorldOptions:
    """Everything that decides a world; equal options give equal bytes. Ranges stand in :mod:`palpate.sim.ranges`.

    Attributes:
        seed: worlds of different seeds share no object, video or text.
        size: side of the square images in pixels, 16 to 256 (even for ``layout="videos"``).
        materials: names of ``MATERIALS``, or how many of them, spread evenly over the table; becomes a tuple of names.
        objects_per_material: objects of each material that have videos of their own (their mean if ``balance`` is not uniform).
        balance: ``"uniform"``, or ``"touch-and-go"``: classes as unequal as in Touch and Go, see :mod:`palpate.sim.balance`.
        videos_per_object: videos of each object.
        two_videos: share of the objects that have one video more.
        touches_per_video: contacts in a video.
        frames_per_touch: frames in contact in each touch.
        free_frames: frames without contact before each touch, at least 5, so that the first contact frame - 4 shows the passive sensor.
        free_written: ``"all"`` writes them all; ``"background"`` only the one that the background rule needs (frame numbers stay).
        objects_per_video: a mixed video touches 2 to this many objects of different materials (1: no video is mixed).
        mixed: share of the videos that are mixed; their further objects appear in no other video.
        sensors: gel units of the sensor family; each video uses one.
        look: ``"gelsight"`` (markers, near-field colors) or ``"digit"`` (no markers, darker, stronger colors).
        hard: 0 to 1, scales everything in the photos that is irrelevant to touch (stains, hand, edges, shadows, light, gain drift).
        named: share of the captions that name the thing; the others say only how it feels.
        leak: how the world's own train and test lists are cut: random ``"frame"``, random whole ``"contact"``, or by video (``"none"``).
        test: share of the contact frames in the test list, nearly.
        layout: ``"frames"`` (Touch and Go as JPEG files), ``"videos"`` (Touch and Go as H.264, needs PyAV), ``"hct"`` (HCT of TVL) or ``"raw"``
            (uint8 arrays).
        tile: pixels a side of an object's 64 mm tile; 256 fits 64 px images, 512 fits 128 px. Another tile is another object.
        curved: share of the objects that are curved; radius_mm: range of their radius (as dents they are 3.3 times flatter).
        pad_mm: side of the gel pad; gel_mm: depth to which it can be indented.
        relax_mm: blurs of the free membrane, the contact re-imposed after each; optical_mm: blur of the sensor's optics.
        dome_mm: range of the radius of a unit's domed gel.
        markers: rows of printed markers a side on a ``"gelsight"`` pad, 0 for none; a ``"digit"`` never has any.
        dirt: factor on uneven coating, specks and scratches; vignette: range of the darkening at half the pad's side.
        sensor_noise: range of a unit's deviation of the image noise, of 1.
        load_mm: range of the peak load of a touch, as mean indentation; drawn evenly in its logarithm.
        revisit_mm: deviation of the places that a video touches around its first; jump: share of the touches that go far away instead.
        slide_mm: deviations, one drawn a touch, of how far the sensor slides in contact.
        tilt: deviation of the pad's slope; shear: deviation of the drag in mm per mm of depth.
        view_mm: range of the width of the photo, drawn evenly in its logarithm; elevation_deg: range of the sun's height.
        hand, shadow, edge: shares of the videos at ``hard=0.5`` with a hand, a cast shadow, the edge of the object in view.
        stains: factor on the number of stains and stickers; sway: factor on the slow drift of the camera.
        blur_px: deviations, one drawn a video, of the photo's blur in pixels at 128 px.

    Raises:
        PalpateError: if an option is out of range; :class:`~palpate.core.ProblemsError` if several are.
    """

    seed: int = 0
    size: int = 64
    materials: tuple[str, ...] | int = 20
    objects_per_material: int = 5
    balance: Literal["uniform", "touch-and-go"] = "uniform"
    videos_per_object: int = 1
    two_videos: float = 0.0
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
    leak: Literal["frame", "contact", "none"] = "contact"
    test: float = 0.25
    layout: Literal["frames", "videos", "hct", "raw"] = "frames"
    tile: int = 256
    curved: float = 0.4
    radius_mm: Span = (25.0, 90.0)
    pad_mm: float = 14.0
    gel_mm: float = 1.6
    relax_mm: tuple[float, ...] = (2.4, 0.9, 0.35)
    optical_mm: float = 0.14
    dome_mm: Span = (30.0, 80.0)
    markers: int = 8
    dirt: float = 1.0
    vignette: Span = (0.03, 0.16)
    sensor_noise: Span = (0.002, 0.006)
    load_mm: Span = (0.09, 0.42)
    revisit_mm: float = 3.5
    jump: float = 0.25
    slide_mm: tuple[float, ...] = (0.0, 1.5, 5.0)
    tilt: float = 0.045
    shear: float = 0.7
    view_mm: Span = (30.0, 45.0)
    elevation_deg: Span = (18.0, 75.0)
    hand: float = 0.6
    shadow: float = 0.5
    edge: float = 0.35
    stains: float = 1.0
    sway: float = 1.0
    blur_px: tuple[float, ...] = (0.35, 0.6, 1.1)

    def __post_init__(self) -> None:
        for name in ("materials", *PAIRS, *SERIES):
            if isinstance(getattr(self, name), list):  # as JSON gives them
                object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in (*PAIRS, *SERIES):
            if isinstance(
                value := getattr(self, name), tuple
            ):  # 26 and 26.0 are one option, with one digest
                object.__setattr__(self, name, tuple(map(_real, value)))
        for name, (low, _) in RANGES.items():
            if isinstance(low, float) and type(value := getattr(self, name)) is int:
                object.__setattr__(self, name, _real(value))
        found = [*out_of_range({f.name: getattr(self, f.name) for f in dataclasses.fields(self)})]
        found += self._materials()
        found += [] if found else self._inconsistent()
        if len(found) == 1:
            raise found[0]
        if found:
            problems = [Problem("WorldOptions", "bad-option", str(e)) for e in found]
            raise ProblemsError(
                problems,
                str(found[0]),
                "Every option of the world must lie in its range and fit the others",
            )

    def _materials(self) -> list[PalpateError]:
        """Turns a count into names; what is wrong with the names."""
        if isinstance(self.materials, int):
            count = self.materials
            if isinstance(count, bool) or not 1 <= count <= len(MATERIALS):
                must = f"materials must be 1 to {len(MATERIALS)}"
                return [PalpateError(must, shown(count), "Pass a smaller count, or names")]
            names = list(MATERIALS)
            object.__setattr__(
                self, "materials", tuple(names[k * len(names) // count] for k in range(count))
            )
            return [*bad_entries(self.names)]
        if not isinstance(self.materials, tuple) or not all(
            isinstance(name, str) for name in self.materials
        ):
            return [
                PalpateError(
                    "materials must be names or a count",
                    shown(self.materials),
                    "Pass e.g. materials=('Wood', 'Grass')",
                )
            ]
        return _unknown_materials(self.materials) or [*bad_entries(self.materials)]

    def _inconsistent(self) -> Iterator[PalpateError]:
        """What is wrong between options that are each in range."""
        if self.layout == "videos" and self.size % 2:
            yield PalpateError(
                "size must be even for layout='videos'",
                str(self.size),
                f"Pass size={self.size + 1}",
            )
        if self.layout == "videos" and self.free_written != "all":
            yield PalpateError(
                "layout='videos' must write all free frames",
                "free_written='background'",
                "Leave free_written out",
            )
        if self.load_mm[1] > self.gel_mm:
            got = f"load_mm up to {self.load_mm[1]:g}, gel_mm {self.gel_mm:g}"
            yield PalpateError(
                "load_mm must not exceed gel_mm",
                got,
                f"Pass load_mm=({min(self.load_mm[0], self.gel_mm):g}, {self.gel_mm:g})",
            )
        if self.pad_mm > self.view_mm[0]:
            got = f"pad_mm {self.pad_mm:g}, view_mm from {self.view_mm[0]:g}"
            yield PalpateError(
                "the pad must lie in the photo: pad_mm must not exceed the lower end of view_mm",
                got,
                "Pass a smaller pad_mm",
            )
        if self.balance != "uniform" and self.objects_per_material < 2:
            yield PalpateError(
                f"balance={self.balance!r} must have 2 objects a material or more",
                "1",
                "Pass objects_per_material=2 or more",
            )

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


def _real(value: object) -> object:
    """A whole number as a float if it can be one; anything else as it is."""
    try:
        return float(value) if type(value) is int else value
    except OverflowError:
        return value


def _unknown_materials(names: tuple[str, ...]) -> list[PalpateError]:
    found: list[PalpateError] = []
    if not names:
        found.append(
            PalpateError(
                "materials must name at least one material",
                "none",
                "Pass e.g. materials=('Wood', 'Grass')",
            )
        )
    if len(set(names)) < len(names):
        found.append(
            PalpateError(
                "materials must name each material once",
                repr(names),
                "Leave out the repeated names",
            )
        )
    for name in names:
        if name not in MATERIALS:
            near = difflib.get_close_matches(name, MATERIALS, 1, 0.3)
            fix = (
                f"Did you mean {near[0]!r}? Known: {', '.join(MATERIALS)}"
                if near
                else f"Known: {', '.join(MATERIALS)}"
            )
            found.append(PalpateError("materials must be names of MATERIALS", repr(name), fix))
    return found
