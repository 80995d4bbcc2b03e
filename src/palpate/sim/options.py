# ruff: noqa: RUF009 - the calls below are dataclasses.field with metadata
"""What a world is made of: every option with its range and meaning, checked once.

Lengths are in mm, angles in degrees. Materials live on a periodic tile of 64 mm; a view of w mm
turned by 45 degrees is w sqrt(2) wide, so views are at most 64 / sqrt(2) = 45.25 mm wide and never
show the repeat.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpate.core import PalpateError, Problem, ProblemsError, digest_json, read_json, rng_for
from palpate.sim.materials import MATERIALS, check_material

#: Raised at every change of the images, texts or lists; enters every random draw and the digest.
VERSION = 2
WORLD_FORMAT = "palpate-world/3"
#: Format 2 called contacts touches; its options are read.
WORLD_FORMAT_2 = "palpate-world/2"
#: The background of a contact is the frame this many before its first.
BACKGROUND_OFFSET = 4
#: Former options, whose defaults all worlds have; digests are over them, too.
FORMER = {"captions": "felt", "named": 0.5, "balance": "uniform"}
Span = tuple[float, float]
#: The first option of each group.
_FIRST = {"seed": "world", "objects_per_material": "amounts", "curved": "physics", "hard": "photos"}
#: Names of format 2, over which the digests of VERSION 2 are taken.
_FORMAT_2 = {"contacts_per_video": "touches_per_video", "frames_per_contact": "frames_per_touch"}


def _number(default: float, low: float, high: float, meaning: str) -> Any:
    """A number in [low, high]; a whole one where ``low`` is an int."""
    return field(default=default, metadata=_limits("number", meaning, low, high))


def _span(default: Span, low: float, high: float, meaning: str) -> Any:
    """A range (low, high) that values are drawn from."""
    return field(default=default, metadata=_limits("span", meaning, low, high))


def _series(default: tuple[float, ...], low: float, high: float, meaning: str) -> Any:
    """Up to eight numbers in [low, high]."""
    return field(default=default, metadata=_limits("series", meaning, low, high))


def _choice(meaning: str, *choices: str) -> Any:
    """One of a few words, by default the first."""
    return field(default=choices[0], metadata=_limits("choice", meaning) | {"choices": choices})


def _share(default: float, meaning: str) -> Any:
    return _number(default, 0.0, 1.0, meaning)


def _limits(kind: str, meaning: str, low: float = 0, high: float = 0) -> dict[str, Any]:
    return {"kind": kind, "low": low, "high": high, "help": meaning}


@dataclass(frozen=True)
class WorldOptions:
    """Everything that decides a world; equal options give equal bytes.

    Every field has its range and meaning in its metadata, from which the command line and the
    documentation are made.

    Raises:
        PalpateError: if an option is out of range; :class:`~palpate.core.ProblemsError` if several
            are.
    """

    # world
    seed: int = _number(0, 0, 2**31 - 1, "worlds of different seeds share no object, video, text")
    size: int = _number(64, 16, 256, "side of the images in pixels; even for the layout videos")
    materials: tuple[str, ...] | int = field(
        default=20, metadata=_limits("materials", "names, or how many of them, evenly spaced")
    )
    look: Literal["gelsight", "digit"] = _choice(
        "sensor: a GelSight with markers, or a darker DIGIT without", "gelsight", "digit"
    )
    leak: Literal["contact", "frame", "none"] = _choice(
        "what test may share with train: videos (contact), contacts (frame), or neither",
        *("contact", "frame", "none"),
    )
    layout: Literal["frames", "videos", "hct"] = _choice(
        "Touch and Go as JPEG frames or as H.264 videos, or HCT", "frames", "videos", "hct"
    )
    test: float = _number(0.25, 0.01, 0.99, "share of the contact frames in the test list")
    tile: int = _number(256, 64, 1024, "pixels along the 64 mm of a surface; 512 for images of 128")
    # amounts
    objects_per_material: int = _number(5, 1, 10_000, "objects of each material that have videos")
    videos_per_object: int = _number(1, 1, 100, "videos of each object")
    two_videos: float = _share(0.0, "share of the objects with an additional video")
    contacts_per_video: int = _number(4, 1, 100, "contacts in a video")
    frames_per_contact: int = _number(3, 1, 200, "frames of a contact")
    free_frames: int = _number(
        5, BACKGROUND_OFFSET + 1, 200, "frames without contact before each contact"
    )
    free_written: Literal["all", "background"] = _choice(
        "frames without contact to write: all, or one background", "all", "background"
    )
    objects_per_video: int = _number(3, 1, 14, "a mixed video has 2 to this many objects")
    mixed: float = _share(0.12, "share of the videos with several objects")
    sensors: int = _number(3, 1, 100, "gel units; each video uses one of them")
    describer: float = _number(0.15, 0.0, 5.0, "noise of captions, in levels of a word scale")
    # physics
    curved: float = _share(0.4, "share of the objects that are curved")
    radius_mm: Span = _span(
        (25.0, 90.0), 5.0, 1000.0, "radius of curved objects (3.3 times as much of dents)"
    )
    pad_mm: float = _number(14.0, 5.0, 30.0, "side of the gel pad; at most the low end of view_mm")
    gel_mm: float = _number(1.6, 0.5, 10.0, "depth of the gel; at least the high end of load_mm")
    relax_mm: tuple[float, ...] = _series(
        (2.4, 0.9, 0.35), 0.01, 10.0, "blurs of the gel where nothing touches it, one by one"
    )
    optical_mm: float = _number(0.14, 0.0, 2.0, "blur of the sensor's optics")
    dome_mm: Span = _span((30.0, 80.0), 10.0, 1000.0, "radius of the domed gel of a unit")
    markers: int = _number(8, 0, 40, "rows of markers a side of a gelsight pad; 0 for none")
    dirt: float = _number(1.0, 0.0, 10.0, "factor on uneven coating, specks and scratches")
    vignette: Span = _span((0.03, 0.16), 0.0, 0.9, "darkening at half the pad's side")
    sensor_noise: Span = _span((0.002, 0.006), 0.0, 0.2, "image noise of a unit (deviation, of 1)")
    load_mm: Span = _span((0.09, 0.42), 0.005, 1.5, "peak load as mean indentation, log-uniform")
    revisit_mm: float = _number(3.5, 0.0, 32.0, "deviation of a video's contacts around its first")
    jump: float = _share(0.25, "share of the contacts that go far away instead")
    slide_mm: tuple[float, ...] = _series(
        (0.0, 1.5, 5.0), 0.0, 32.0, "deviations, one drawn per contact, of the sensor's slide"
    )
    tilt: float = _number(0.045, 0.0, 0.5, "deviation of the pad's slope")
    shear: float = _number(0.7, 0.0, 5.0, "deviation of the drag in mm per mm of depth")
    # photos
    hard: float = _share(0.5, "how much photos vary in what cannot be felt (light, hands ...)")
    view_mm: Span = _span((30.0, 45.0), 15.0, 45.25, "width of the photo, log-uniform")
    elevation_deg: Span = _span((18.0, 75.0), 1.0, 89.0, "height of the light")
    hand: float = _share(0.6, "share of the videos with a hand in view, at hard 0.5")
    shadow: float = _share(0.5, "share with a cast shadow, at hard 0.5")
    edge: float = _share(0.35, "share with the edge of the object in view, at hard 0.5")
    stains: float = _number(1.0, 0.0, 10.0, "factor on the number of stains and stickers")
    sway: float = _number(1.0, 0.0, 10.0, "factor on the slow drift of the camera")
    blur_px: tuple[float, ...] = _series(
        (0.35, 0.6, 1.1), 0.0, 5.0, "blurs in pixels at 128 px, one drawn per video"
    )

    def __post_init__(self) -> None:
        fields = dataclasses.fields(self)
        for option in fields:
            object.__setattr__(self, option.name, _normal(getattr(self, option.name), option))
        errors = [e for option in fields for e in _check(option, getattr(self, option.name))]
        errors = errors or list(self._inconsistent())
        if len(errors) == 1:
            raise errors[0]
        if errors:
            problems = [Problem("WorldOptions", "bad-option", str(e)) for e in errors]
            must = "Every option of the world must lie in its range and fit the others"
            raise ProblemsError(problems, "Correct them", must)

    def _inconsistent(self) -> Iterator[PalpateError]:
        """Yield the errors between options that are each in range."""
        if self.layout == "videos" and self.size % 2:
            must, fix = "must be even for the layout videos", "Choose an even size"
            yield _error("size", must, self.size, fix, self.size + 1)
        if self.layout == "videos" and self.free_written != "all":
            must, fix = "must be 'all' for the layout videos", "A video holds every frame"
            yield _error("free_written", must, self.free_written, fix)
        if self.load_mm[1] > self.gel_mm:
            fix = "Choose a smaller load or a deeper gel"
            yield _error("load_mm", f"must not exceed the gel, {self.gel_mm:g}", self.load_mm, fix)
        if self.pad_mm > self.view_mm[0]:
            must = f"must not exceed the lower end of view_mm, {self.view_mm[0]:g}"
            yield _error("pad_mm", must, self.pad_mm, "The pad must lie in the photo")

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
        return digest_json({"version": VERSION, "options": self.format_2()})

    def format_2(self) -> dict[str, Any]:
        """Return the options under the names of format 2, over which digests are taken."""
        values = {_FORMAT_2.get(k, k): v for k, v in dataclasses.asdict(self).items()}
        values["leak"] = "touch" if self.leak == "contact" else self.leak
        return values | FORMER

    def rng(self, purpose: str, *ids: str | int) -> np.random.Generator:
        """Return a generator that depends on VERSION, the seed, the purpose and the ids alone."""
        return rng_for(self.seed, "world", VERSION, purpose, *ids)


def option_groups() -> dict[str, list[dataclasses.Field[Any]]]:
    """Return the options of each group: world, amounts, physics, photos."""
    options = dataclasses.fields(WorldOptions)
    starts = [k for k, option in enumerate(options) if option.name in _FIRST]
    ends = [*starts[1:], len(options)]
    return {_FIRST[options[a].name]: list(options[a:b]) for a, b in zip(starts, ends, strict=True)}


def _normal(value: Any, option: dataclasses.Field[Any]) -> Any:
    """Return a single form of every value: tuples for lists, floats, names for a count."""
    kind, low = option.metadata["kind"], option.metadata["low"]
    if isinstance(value, list):
        value = tuple(value)
    if kind in ("span", "series") and isinstance(value, tuple):
        return tuple(map(_real, value))
    if kind == "number" and isinstance(low, float):
        return _real(value)
    if kind == "materials" and type(value) is int and 1 <= value <= len(MATERIALS):
        names = list(MATERIALS)
        return tuple(names[k * len(names) // value] for k in range(value))
    return value


def _real(value: Any) -> Any:
    return float(value) if type(value) is int and abs(value) < 10**15 else value


def _error(name: str, must: str, got: Any, fix: str, example: Any = None) -> PalpateError:
    suggestion = {} if example is None else {name: example}
    return PalpateError(must, repr(got)[:120], fix, argument=name, example=suggestion)


def _check(option: dataclasses.Field[Any], value: Any) -> Iterator[PalpateError]:
    """Yield what is wrong with a value."""
    name, limits = option.name, option.metadata
    kind, low, high = limits["kind"], limits["low"], limits["high"]
    if kind == "materials":
        yield from _check_materials(value)
    elif kind == "choice":
        if not isinstance(value, str) or value not in limits["choices"]:
            must = f"must be one of {', '.join(map(repr, limits['choices']))}"
            yield _error(name, must, value, "", limits["choices"][0])
    elif kind == "number":
        whole = isinstance(low, int)
        if not _in_range(value, low, high, whole):
            must = f"must be a {'whole ' * whole}number from {low:g} to {high:g}"
            near = min(max(value, low), high) if _in_range(value, -math.inf, math.inf) else low
            yield _error(name, must, value, "", round(near) if whole else near)
    else:
        pair = kind == "span"
        numbers = isinstance(value, tuple) and all(_in_range(v, low, high) for v in value)
        if not numbers or len(value) > 8 or (pair and len(value) != 2):
            count = "two numbers" if pair else "up to eight numbers"
            yield _error(name, f"must be {count} from {low:g} to {high:g}", value, "", (low, high))
        elif pair and list(value) != sorted(value):
            yield _error(name, "must have its lower end first", value, "", tuple(sorted(value)))
        elif not value and name != "relax_mm":
            yield _error(name, "must hold a number", value, "", (low,))


def _in_range(value: Any, low: float, high: float, whole: bool = False) -> bool:
    kinds = int if whole else (int, float)
    return isinstance(value, kinds) and not isinstance(value, bool) and low <= value <= high


def _check_materials(names: Any) -> Iterator[PalpateError]:
    known = f"Known: {', '.join(MATERIALS)}"
    if not isinstance(names, tuple) or not names:
        must = f"must be names, or a count from 1 to {len(MATERIALS)}"
        yield _error("materials", must, names, known, ("Wood", "Grass"))
        return
    if len(set(names)) < len(names):
        fix = "Remove the repeated names"
        yield _error("materials", "must name each material once", names, fix)
    for name in names:
        if name in MATERIALS:
            yield from check_material(name)
        else:
            yield _error("materials", "must be names of materials", name, _nearest(name, MATERIALS))


def _nearest(name: Any, known: Iterable[str]) -> str:
    """Return a fix: the most similar known name, or all."""
    near = difflib.get_close_matches(str(name), known := list(known), 1, 0.5)
    return f"Did you mean {near[0]!r}?" if near else f"Known: {', '.join(known)}"


def load_options(path: str | Path) -> WorldOptions:
    """Read the options of a world from its ``world.json`` or its folder.

    Raises:
        PalpateError: if the file is missing, is none of a world, is of another VERSION, or was
            edited.
        ProblemsError: if several options are out of range.
    """
    path = Path(path)
    path = path / "world.json" if path.is_dir() else path
    data = read_world(path)
    options = data.get("options")
    if not isinstance(options, dict):
        must = f"{path} must hold the options of a world"
        raise PalpateError(must, "none", "Name the world.json of a finished world")
    current = {old: new for new, old in _FORMAT_2.items()}
    for name, value in FORMER.items():
        if options.get(name, value) != value:
            must = f"{path} must be of a world of this release, whose {name} is {value!r}"
            raise PalpateError(must, repr(options[name]), "Make another world")
    values = {current.get(str(k), str(k)): v for k, v in options.items() if k not in FORMER}
    if values.get("leak") == "touch":
        values["leak"] = "contact"
    known = [option.name for option in dataclasses.fields(WorldOptions)]
    if unknown := [name for name in values if name not in known]:
        must, fix = f"The options in {path} must be those of a world", _nearest(unknown[0], known)
        raise PalpateError(must, repr(unknown[0]), fix)
    world = WorldOptions(**values)
    if data.get("options_digest", world.digest) != world.digest:
        fix = "Pass changed options as arguments, or remove options_digest from a copy"
        raise PalpateError(f"The digest in {path} must match its options", "edited options", fix)
    return world


def read_world(path: Path) -> Mapping[str, Any]:
    """Read the record of a world of this VERSION."""
    data, fix = read_json(path, "world record"), "Choose another folder, or remove it"
    formats = (WORLD_FORMAT, WORLD_FORMAT_2)
    if not isinstance(data, dict) or data.get("format") not in formats:
        must = f"{path} must be the record of a world ({WORLD_FORMAT})"
        raise PalpateError(must, "other JSON", fix)
    if data.get("version") != VERSION:
        must = f"{path} must be of version {VERSION} of the world"
        raise PalpateError(must, f"version {data.get('version')}", "Make the world again")
    return data
