"""What a material returns, and the entry it has in the table of materials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from palpate.core import PalpateError
from palpate.sim.arrays import Array, f32
from palpate.sim.tile import Tile


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
        PalpateError: naming the material, if it returned a wrong shape, numbers that are not finite, an unknown subtype, or no words.
    """
    surface = material.draw(Tile(n, rng), rng)
    fix = f"Mend the function {getattr(material.draw, '__qualname__', material.draw)!r} of this material"
    if not isinstance(surface, Surface):  # pyright: ignore[reportUnnecessaryIsInstance] - the function may be a user's
        raise PalpateError(f"The material {name!r} must return a Surface", type(surface).__name__, fix)
    for what, array, shape in (("height", surface.height, (n, n)), ("albedo", surface.albedo, (n, n, 3))):
        if np.shape(array) != shape:
            raise PalpateError(f"The material {name!r} must return a {what} of shape {shape}", f"shape {np.shape(array)}", fix)
        if bad := int(np.count_nonzero(~np.isfinite(array))):
            raise PalpateError(f"The material {name!r} must return a finite {what}", f"NaN or infinity in {bad} places", fix)
    if material.subtypes and surface.subtype not in material.subtypes:
        raise PalpateError(f"The material {name!r} must draw one of its subtypes {material.subtypes}", repr(surface.subtype), fix)
    if not surface.words:
        raise PalpateError(f"The material {name!r} must say how it feels", "no words", fix)
    if not (0.0 <= surface.gloss <= 1.0 and 0.0 <= surface.softness <= 1.0):
        raise PalpateError(
            f"The material {name!r} must have gloss and softness in [0, 1]", f"{surface.gloss:g} and {surface.softness:g}", fix
        )
    height = f32(surface.height)
    height = np.ascontiguousarray(height - float(np.median(height)))
    albedo = np.ascontiguousarray(np.clip(f32(surface.albedo), 0.01, 1.0))
    noun = surface.noun or material.noun
    return Surface(height, albedo, surface.subtype, surface.words, float(surface.gloss), float(surface.softness), noun)
