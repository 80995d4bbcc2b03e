"""What a material draws, and its entry in the table of materials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np

from palpate.core import PalpateError
from palpate.sim.arrays import Array, f32
from palpate.sim.tile import Tile

T = TypeVar("T")
#: Highest and deepest relief in mm; far above what a gel can feel.
HIGHEST_MM = 50.0


@dataclass(frozen=True)
class Surface:
    """A piece of a material, as a periodic tile.

    Attributes:
        height: relief in mm, shape (n, n), float32.
        albedo: reflectance in [0, 1], shape (n, n, 3), float32; of man-made things it must not
            reveal the relief.
        subtype: the kind that was drawn, one of the material's ``subtypes``.
        gloss: 0 matt to 1 mirror-like.
        softness: 0 rigid to 1 (yields under the gel).
    """

    height: Array
    albedo: Array
    subtype: str
    gloss: float = 0.0
    softness: float = 0.0


#: Draws a piece of a material on a tile; all randomness comes from the generator, also the tile's.
Draw: TypeAlias = Callable[[Tile, np.random.Generator], Surface]


@dataclass(frozen=True)
class Material:
    """An entry of ``MATERIALS``.

    Attributes:
        label: id in ``label.txt``.
        draw: the function that draws a piece.
        subtypes: the kinds that ``draw`` chooses from.
    """

    label: int
    draw: Draw
    subtypes: tuple[str, ...] = ()


def pick(rng: np.random.Generator, *choices: T) -> T:
    """Draw one of ``choices`` with equal probability."""
    return choices[int(rng.integers(len(choices)))]


def flip(rng: np.random.Generator, share: float) -> bool:
    """Return True with probability ``share``."""
    return bool(rng.random() < share)


def rising(height: Array) -> Array:
    """Scale heights to [0, 1]."""
    low, high = float(height.min()), float(height.max())
    return (height - low) * (1.0 / (high - low + 1e-9))


def plain(tile: Tile, color: Array) -> Array:
    """Return an albedo of a single color."""
    return np.broadcast_to(color, (tile.n, tile.n, 3))


def draw_surface(name: str, material: Material, n: int, rng: np.random.Generator) -> Surface:
    """Draw and check a piece.

    Returns:
        The surface with median height 0, albedo clipped to [0.01, 1], arrays in float32, C order.

    Raises:
        PalpateError: naming the material, if its function failed, or returned a wrong shape,
            numbers that are not finite or far out of range, or an unknown subtype.
    """
    function = getattr(material.draw, "__qualname__", type(material.draw).__name__)

    def require(condition: bool, must: str, got: object) -> None:
        if not condition:
            fix = f"Correct the function {function!r} of this material"
            raise PalpateError(f"The material {name!r} must {must}", str(got)[:200], fix)

    try:
        surface = material.draw(Tile(n, rng), rng)
        height, albedo = f32(surface.height), f32(surface.albedo)
    except Exception as error:  # whatever a user's function raises
        require(False, "draw a Surface without an error", f"{type(error).__name__}: {error}")
        raise
    shapes, wanted = (height.shape, albedo.shape), ((n, n), (n, n, 3))
    require(shapes == wanted, f"return a height and an albedo of shapes {wanted}", shapes)
    finite = bool(np.isfinite(height).all() and np.isfinite(albedo).all())
    require(finite, "return finite numbers", "NaN or infinity")
    low, high = float(height.min()), float(height.max())
    fits = -HIGHEST_MM <= low <= high <= HIGHEST_MM
    require(fits, f"have a height of at most {HIGHEST_MM:g} mm", f"{low:g} to {high:g}")
    low, high = float(albedo.min()), float(albedo.max())
    # Highlights may overshoot [0, 1] a little; 0 to 255 is no reflectance.
    require(-1.0 <= low <= high <= 4.0, "have an albedo in [0, 1]", f"{low:g} to {high:g}")
    known = not material.subtypes or surface.subtype in material.subtypes
    require(known, f"draw one of its subtypes {material.subtypes}", repr(surface.subtype))
    shares = (surface.gloss, surface.softness)
    require(all(0.0 <= v <= 1.0 for v in shares), "have gloss and softness in [0, 1]", shares)
    height = np.ascontiguousarray(height - float(np.median(height)))
    albedo = np.ascontiguousarray(np.clip(albedo, 0.01, 1.0))
    return Surface(height, albedo, surface.subtype, *map(float, shares))
