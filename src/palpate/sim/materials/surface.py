"""What a material returns, and the entry it has in the table of materials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from palpate.core import PalpateError
from palpate.sim.arrays import Array, f32
from palpate.sim.tile import Tile

#: Highest and deepest relief in mm; far above what a gel can feel.
HIGHEST_MM = 50.0
#: Albedos beyond this are no reflectance (0 to 255, say); within it they are clipped to [0.01, 1], as highlights may overshoot.
ALBEDO = (-1.0, 4.0)
#: How many words a piece has.
FEWEST, MOST = 2, 4


@dataclass(frozen=True)
class Surface:
    """One piece of a material, as a periodic tile.

    Attributes:
        height: relief in mm, shape (n, n), float32.
        albedo: reflectance in [0, 1], shape (n, n, 3), float32; it must not give away the touch of man-made things.
        subtype: the kind that was drawn, one of the material's ``subtypes``.
        words: 2 to 4 adjectives that say how this piece feels, never its colour or light.
        gloss: 0 matt to 1 mirror-like; softness: 0 rigid to 1 (yields under the gel).
        noun: what the text calls it, ``"tree bark"`` or, where it can be counted, ``"a leaf"``; '' takes the material's noun.
    """

    height: Array
    albedo: Array
    subtype: str
    words: tuple[str, ...]
    gloss: float = 0.0
    softness: float = 0.0
    noun: str = ""


#: Draws one piece of a material on a tile; all randomness comes from the generator (also the tile's own).
Draw: TypeAlias = Callable[[Tile, np.random.Generator], Surface]


@dataclass(frozen=True)
class Material:
    """An entry of ``MATERIALS``.

    Attributes:
        label: id in ``label.txt``.
        noun: what the text calls it, ``"tree bark"`` or, where it can be counted, ``"a leaf"``.
        draw: the function that draws one piece.
        subtypes: the kinds that ``draw`` chooses from.
    """

    label: int
    noun: str
    draw: Draw
    subtypes: tuple[str, ...] = field(default=())


def pick(rng: np.random.Generator, *choices: str) -> str:
    """One of ``choices``, each as likely."""
    return choices[int(rng.integers(len(choices)))]


def flip(rng: np.random.Generator, share: float) -> bool:
    """True with probability ``share``."""
    return bool(rng.random() < share)


def plain(tile: Tile, colour: Array) -> Array:
    """An albedo of one colour."""
    return np.broadcast_to(colour, (tile.n, tile.n, 3))


def draw_surface(name: str, material: Material, n: int, rng: np.random.Generator) -> Surface:
    """Draws and checks one piece.

    Returns:
        The surface with median height 0, albedo clipped to [0.01, 1], arrays in float32 and C order.

    Raises:
        PalpateError: naming the material, if its function failed, or returned a wrong shape, numbers that are not finite or far out of range, an
            unknown subtype, or words that make no caption.
    """
    called = getattr(material.draw, "__qualname__", type(material.draw).__name__)
    fix = f"Mend the function {called!r} of this material"
    try:
        surface = material.draw(Tile(n, rng), rng)
    except PalpateError:
        raise
    except Exception as error:  # whatever a user's function raises
        raise PalpateError(
            f"The material {name!r} must draw a piece without an error", _told(error), fix
        ) from error
    if not isinstance(surface, Surface):  # pyright: ignore[reportUnnecessaryIsInstance] - the function may be a user's
        raise PalpateError(
            f"The material {name!r} must return a Surface", type(surface).__name__, fix
        )
    height = _field(
        name,
        fix,
        "a height",
        surface.height,
        (n, n),
        (-HIGHEST_MM, HIGHEST_MM),
        f"-{HIGHEST_MM:g} to {HIGHEST_MM:g} mm",
    )
    albedo = _field(name, fix, "an albedo", surface.albedo, (n, n, 3), ALBEDO, "0 to 1")
    if material.subtypes and (
        not isinstance(surface.subtype, str) or surface.subtype not in material.subtypes
    ):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise PalpateError(
            f"The material {name!r} must draw one of its subtypes {material.subtypes}",
            ascii(surface.subtype),
            fix,
        )
    words = _words(name, fix, surface.words)
    gloss, softness = (
        _share(name, fix, what, getattr(surface, what)) for what in ("gloss", "softness")
    )
    if not isinstance(surface.noun, str) or (surface.noun and not is_line(surface.noun)):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise PalpateError(
            f"The material {name!r} must have a noun of one line, or '' for its own",
            ascii(surface.noun),
            fix,
        )
    height = np.ascontiguousarray(height - float(np.median(height)))
    albedo = np.ascontiguousarray(np.clip(albedo, 0.01, 1.0))
    return Surface(
        height, albedo, surface.subtype, words, gloss, softness, surface.noun or material.noun
    )


def is_line(value: object) -> bool:
    """Whether ``value`` is text of one line that is not blank."""
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


def _told(error: Exception) -> str:
    """An error in one line."""
    said = " ".join(str(error).split())
    return f"{type(error).__name__}: {said}" if said else type(error).__name__


def _field(
    name: str,
    fix: str,
    what: str,
    given: object,
    shape: tuple[int, ...],
    bounds: tuple[float, float],
    wanted: str,
) -> Array:
    """``given`` as float32, if it is real numbers of that shape within ``bounds``."""
    must = f"The material {name!r} must return {what}"
    if isinstance(given, np.ma.MaskedArray):
        raise PalpateError(f"{must} without a mask", "a masked array", fix)
    try:
        array = np.asarray(given)
    except Exception as error:  # a list of unequal rows, or anything that pretends to be an array
        raise PalpateError(f"{must} of shape {shape}", _told(error), fix) from error
    if array.shape != shape:
        raise PalpateError(f"{must} of shape {shape}", f"shape {array.shape}", fix)
    if array.dtype.kind not in "fiu":
        raise PalpateError(f"{must} of real numbers", f"dtype {array.dtype}", fix)
    with np.errstate(over="ignore"):
        array = f32(array)
    if bad := int(np.count_nonzero(~np.isfinite(array))):
        finite = what.replace("an ", "a ").replace("a ", "a finite ")
        raise PalpateError(
            f"The material {name!r} must return {finite}", f"NaN or infinity in {bad} places", fix
        )
    low, high = float(array.min()), float(array.max())
    if low < bounds[0] or high > bounds[1]:
        raise PalpateError(f"{must} of {wanted}", f"{low:g} to {high:g}", fix)
    return array


def _words(name: str, fix: str, given: object) -> tuple[str, ...]:
    words = tuple(given) if isinstance(given, tuple | list) else ()
    if (
        not all(map(is_line, words))
        or not FEWEST <= len(words) <= MOST
        or len(set(words)) < len(words)
    ):
        must = f"The material {name!r} must say how it feels in {FEWEST} to {MOST} different words"
        raise PalpateError(must, ascii(given)[:200] if words or given else "no words", fix)
    return words


def _share(name: str, fix: str, what: str, given: Any) -> float:
    number = isinstance(given, int | float | np.integer | np.floating) and not isinstance(
        given, bool
    )
    if not number or not 0.0 <= given <= 1.0:
        raise PalpateError(
            f"The material {name!r} must have gloss and softness in [0, 1]",
            f"{what} {ascii(given)[:80]}",
            fix,
        )
    return float(given)
