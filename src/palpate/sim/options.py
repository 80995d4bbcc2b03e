"""What a world is made of: every option with its range and meaning, checked once."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from palpate.core import PalpateError, digest_json, require, require_choice, rng_for
from palpate.sim.materials import MATERIALS, check_material

#: Raised at every change of the images, texts or lists; enters every random draw and the digest.
VERSION = 2
#: The background of a contact is the frame this many before its first.
BACKGROUND_OFFSET = 4


def _number(default: float, low: float, high: float, meaning: str) -> Any:
    """A number in [low, high]; a whole one where ``low`` is an int."""
    return field(default=default, metadata={"low": low, "high": high, "help": meaning})


def _share(default: float, meaning: str) -> Any:
    return _number(default, 0.0, 1.0, meaning)


def _choice(meaning: str, *choices: str) -> Any:
    """One of a few words, by default the first."""
    return field(default=choices[0], metadata={"choices": choices, "help": meaning})


@dataclass(frozen=True)
class WorldOptions:
    """Everything that decides a world; equal options give equal bytes.

    Every field has its range and meaning in its metadata, from which the command line and the
    documentation are made.

    Raises:
        PalpateError: if an option is out of range.
    """

    seed: int = _number(0, 0, 2**31 - 1, "worlds of different seeds share no object, video, text")
    size: int = _number(64, 16, 256, "side of the images in pixels; even for the layout videos")
    materials: tuple[str, ...] | int = field(
        default=20, metadata={"help": "names, or how many of them, evenly spaced"}
    )
    look: Literal["gelsight", "digit"] = _choice(
        "sensor: a GelSight with markers, or a darker DIGIT without", "gelsight", "digit"
    )
    leak: Literal["contact", "frame", "none"] = _choice(
        "what test may share with train: videos (contact), contacts (frame), or neither",
        *("contact", "frame", "none"),
    )
    layout: Literal["frames", "videos"] = _choice(
        "Touch and Go as JPEG frames or as H.264 videos", "frames", "videos"
    )
    test: float = _number(0.25, 0.01, 0.99, "share of the contact frames in the test list")
    tile: int = _number(256, 64, 1024, "pixels along the 64 mm of a surface; 512 for images of 128")
    objects_per_material: int = _number(5, 1, 10_000, "objects of each material that have videos")
    videos_per_object: int = _number(1, 1, 100, "videos of each object")
    two_videos: float = _share(0.0, "share of the objects with an additional video")
    contacts_per_video: int = _number(4, 1, 100, "contacts in a video")
    frames_per_contact: int = _number(3, 1, 200, "frames of a contact")
    free_frames: int = _number(
        5, BACKGROUND_OFFSET + 1, 200, "frames without contact before each contact"
    )
    free_written: Literal["all", "background"] = _choice(
        "frames without contact to write as JPEG: all, or one background", *("all", "background")
    )
    mixed: float = _share(0.12, "share of the videos with two or three objects")
    sensors: int = _number(3, 1, 100, "gel units; each video uses one of them")
    markers: int = _number(8, 0, 40, "rows of markers a side of a gelsight pad; 0 for none")
    hard: float = _share(0.5, "how much photos vary in what cannot be felt (light, hands ...)")

    def __post_init__(self) -> None:
        if type(self.materials) is int and 1 <= self.materials <= len(MATERIALS):
            names = list(MATERIALS)
            some = tuple(names[k * len(names) // self.materials] for k in range(self.materials))
            object.__setattr__(self, "materials", some)
        for option in dataclasses.fields(self):
            name, limits, value = option.name, option.metadata, getattr(self, option.name)
            if "choices" in limits:
                require_choice(name, value, limits["choices"])
            elif "low" in limits:
                low, high = limits["low"], limits["high"]
                whole = isinstance(low, int)
                fits = isinstance(value, int if whole else (int, float)) and low <= value <= high
                must = f"must be a {'whole ' * whole}number from {low:g} to {high:g}"
                require(fits, name, must, repr(value))
                object.__setattr__(self, name, value if whole else float(value))
        _require_materials(self.materials)
        if self.layout == "videos":
            require(self.size % 2 == 0, "size", "must be even for the layout videos", self.size)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the materials."""
        return self.materials if isinstance(self.materials, tuple) else ()

    @property
    def video_length(self) -> int:
        """Frames of a video, including those that are not written."""
        return self.contacts_per_video * (self.free_frames + self.frames_per_contact)

    @property
    def digest(self) -> str:
        """SHA-256 over the options and VERSION: names what the world will be."""
        return digest_json({"version": VERSION, "options": dataclasses.asdict(self)})

    def rng(self, purpose: str, *ids: str | int) -> np.random.Generator:
        """Return a generator that depends on VERSION, the seed, the purpose and the ids alone."""
        return rng_for(self.seed, "world", VERSION, purpose, *ids)


def _require_materials(names: Any) -> None:
    """Check names of materials, and their entries."""
    known = f"Known: {', '.join(MATERIALS)}"
    if not isinstance(names, tuple) or not names or len(set(names)) < len(names):
        must = f"must be different names, or a count from 1 to {len(MATERIALS)}"
        raise PalpateError(must, repr(names), known, argument="materials")
    for name in names:
        if name not in MATERIALS:
            raise PalpateError("must be names of materials", name, known, argument="materials")
        check_material(name)
