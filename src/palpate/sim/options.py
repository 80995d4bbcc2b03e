"""What a world consists of: every option with its range and meaning, checked once."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from palpate.core import digest_json, few, require, require_choice, rng_for
from palpate.sim.materials import MATERIALS, check_material

if TYPE_CHECKING:
    from palpate.sim.scans import Scan

#: Raised at every change of the images, texts or lists; enters every random draw and the digest.
VERSION = 2
#: The background of a contact is the frame this many before its first.
BACKGROUND_OFFSET = 4
#: Least and largest value of each number; whole ones where these are.
RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "size": (16, 256),
    "test": (0.01, 0.99),
    "tile": (64, 1024),
    "objects_per_material": (1, 10_000),
    "videos_per_object": (1, 100),
    "two_videos": (0.0, 1.0),
    "contacts_per_video": (1, 100),
    "frames_per_contact": (1, 200),
    "free_frames": (BACKGROUND_OFFSET + 1, 200),
    "mixed": (0.0, 1.0),
    "sensors": (1, 100),
    "markers": (0, 40),
    "hard": (0.0, 1.0),
    "pad_mm": (5.0, 50.0),
    "load_mm": (0.01, 1.0),
    "sensor_noise": (0.0, 0.05),
    "quality": (10, 100),
    "view_mm": (20.0, 500.0),
}
#: Value of a later field in older worlds, which keep their digest: it names a world where it is
#: another.
LATER: dict[str, Any] = {
    "pad_mm": 14.0,
    "load_mm": (0.09, 0.42),
    "sensor_noise": (0.002, 0.006),
    "quality": 95,
    "phases": "spaced",
    "scale": "near",
    "view_mm": (150.0, 400.0),
    "surfaces": "",
}
#: Fields that are a range.
PAIRS = ("load_mm", "sensor_noise", "view_mm")


@dataclass(frozen=True)
class WorldOptions:
    """Everything that decides a world; equal options give equal bytes.

    Attributes:
        seed: 0 .. 2^31 - 1; worlds of different seeds share no object, video, text.
        size: side of the images, 16 .. 256; even for the layout videos [px].
        materials: names, or how many of them, evenly spaced.
        look: sensor: a GelSight with markers, or a darker DIGIT without.
        leak: what test may share with train: videos (contact), contacts (frame), or neither.
        layout: Touch and Go as JPEG frames or as H.264 videos.
        test: share of the contact frames in the test list, 0.01 .. 0.99.
        tile: points along the 64 mm of a surface, 64 .. 1024; 512 for images of 128 [px].
        objects_per_material: objects of each material that have videos, 1 .. 10,000.
        videos_per_object: videos of each object, 1 .. 100.
        two_videos: share of the objects with an additional video.
        contacts_per_video: contacts in a video, 1 .. 100.
        frames_per_contact: frames of a contact, 1 .. 200.
        phases: of these frames: drawn, so that press, hold and slide are equally frequent in
            worlds of any number of frames; or spaced from the first to the last moment, where one
            frame is the deepest of a contact, and two are the lightest.
        free_frames: frames without contact before each contact, 5 .. 200.
        free_written: frames without contact to write as JPEG: all, or one background.
        mixed: share of the videos with two or three objects.
        sensors: gel units, 1 .. 100; each video uses one of them.
        markers: rows of markers a side of a gelsight pad, 0 (none) .. 40.
        hard: how much photos vary in what cannot be felt (light, hands ...), 0 .. 1.
        pad_mm: side of the gel pad, 5 .. 50 [mm].
        load_mm: range of a contact's peak load as mean indentation, log-uniform, .01 .. 1 [mm].
        sensor_noise: range of the units' image noise (deviation, of white), 0 .. 0.05.
        quality: of the JPEG files of tactile images, 10 .. 100.
        scale: near: photos of 30 to 45 mm of a tile; real: photos of view_mm of a ground, with
            joints of true size, off the middle, and relief and load by material
            (:mod:`palpate.sim.ground`).
        view_mm: range of the width of the views of scale real, log-uniform, 20 .. 500 [mm].
        surfaces: folder of photo-scanned surfaces, further looks in scale real
            (:mod:`palpate.sim.scans`).

    Raises:
        PalpateError: if an option is out of range.
    """

    seed: int = 0
    size: int = 64
    materials: tuple[str, ...] | int = 20
    look: Literal["gelsight", "digit"] = "gelsight"
    leak: Literal["contact", "frame", "none"] = "contact"
    layout: Literal["frames", "videos"] = "frames"
    test: float = 0.25
    tile: int = 256
    objects_per_material: int = 5
    videos_per_object: int = 1
    two_videos: float = 0.0
    contacts_per_video: int = 4
    frames_per_contact: int = 3
    phases: Literal["drawn", "spaced"] = "drawn"
    free_frames: int = 5
    free_written: Literal["all", "background"] = "all"
    mixed: float = 0.12
    sensors: int = 3
    markers: int = 8
    hard: float = 0.5
    pad_mm: float = 14.0
    load_mm: tuple[float, float] = (0.09, 0.42)
    sensor_noise: tuple[float, float] = (0.002, 0.006)
    quality: int = 95
    scale: Literal["near", "real"] = "near"
    view_mm: tuple[float, float] = (150.0, 400.0)
    surfaces: str = ""

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            kind, value = type(low), getattr(self, name)
            ends = value if isinstance(value, tuple) else (value,)
            numbers = all(isinstance(v, int if kind is int else (int, float)) for v in ends)
            fits = numbers and low <= min(ends) and max(ends) <= high and [*ends] == sorted(ends)
            must = f"must be a {'whole ' * (kind is int)}number from {low:g} to {high:g}"
            must = f"must be two rising numbers from {low:g} to {high:g}" if name in PAIRS else must
            require(fits and len(ends) == 1 + (name in PAIRS), name, must, repr(value))
            same = tuple(map(kind, ends))  # 1 and 1.0 are one world
            object.__setattr__(self, name, same if name in PAIRS else same[0])
        for name, hint in get_type_hints(WorldOptions).items():
            if get_origin(hint) is Literal:
                require_choice(name, getattr(self, name), get_args(hint))
        odd = self.layout == "videos" and self.size % 2 == 1
        require(not odd, "size", "must be even for the layout videos", self.size)
        fits = self.scale == "real" or not self.surfaces
        require(fits, "scale", "must be real for scanned surfaces", self.scale, "real")
        object.__setattr__(self, "surfaces", str(self.surfaces or ""))
        _ = self.scans  # raises for a folder that cannot be used
        object.__setattr__(self, "materials", _names(self.materials))
        for name in self.names:
            check_material(name)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the materials."""
        return self.materials if isinstance(self.materials, tuple) else ()

    @property
    def scans(self) -> tuple[Scan, ...]:
        """The scanned surfaces, in the order of their table."""
        from palpate.sim.scans import read_scans

        return read_scans(Path(self.surfaces)) if self.surfaces else ()

    @property
    def video_length(self) -> int:
        """Frames of a video, including those that are not written."""
        return self.contacts_per_video * (self.free_frames + self.frames_per_contact)

    @property
    def digest(self) -> str:
        """SHA-256 over the options and VERSION: names what the world will be."""
        options = dataclasses.asdict(self).items()
        named = {k: v for k, v in options if k not in LATER or v != LATER[k]}
        if self.surfaces:
            from palpate.sim.scans import scans_digest

            named["surfaces"] = scans_digest(Path(self.surfaces))
        return digest_json({"version": VERSION, "options": named})

    def rng(self, purpose: str, *ids: str | int) -> np.random.Generator:
        """Return a generator that depends on VERSION, the seed, the purpose and the ids alone."""
        return rng_for(self.seed, "world", VERSION, purpose, *ids)


def _names(materials: Any) -> tuple[str, ...]:
    """Return the names of materials, of a count evenly spaced ones."""
    names = tuple(MATERIALS)
    if type(materials) is int and 1 <= materials <= len(names):
        return tuple(names[k * len(names) // materials] for k in range(materials))
    chosen: tuple[str, ...] = materials if isinstance(materials, tuple) else ()
    must = f"must be different names, or a count from 1 to {len(names)}"
    fix = f"Names: {', '.join(names)}"
    differ = len({*chosen}) == len(chosen) > 0
    require(differ, "materials", must, repr(materials), fix=fix)
    unknown = [name for name in chosen if name not in MATERIALS]
    require(not unknown, "materials", "must be names of materials", few(unknown), fix=fix)
    return chosen
