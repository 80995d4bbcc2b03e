"""What a material draws, and its entry in the table of materials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias, TypeVar

import numpy as np

from palpate.core import PalpateError
from palpate.sim.arrays import Array, f32
from palpate.sim.tile import Tile

T = TypeVar("T")


@dataclass(frozen=True)
class Surface:
    """A piece of a material, as a periodic tile.

    Attributes:
        height: relief in mm, shape (n, n), float32.
        albedo: reflectance in [0, 1], shape (n, n, 3), float32; of man-made things it must not
            reveal the relief.
        subtype: the kind that was drawn.
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
    """

    label: int
    draw: Draw


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
        PalpateError: naming the material, if its function returned a wrong shape or numbers that
            are not finite.
    """
    surface = material.draw(Tile(n, rng), rng)
    height, albedo = f32(surface.height), f32(surface.albedo)
    must, fix = f"The material {name!r} must return a height and an albedo of", "Correct it"
    shapes, wanted = (height.shape, albedo.shape), ((n, n), (n, n, 3))
    if shapes != wanted:
        raise PalpateError(f"{must} shapes {wanted}", str(shapes), fix)
    if not (np.isfinite(height).all() and np.isfinite(albedo).all()):
        raise PalpateError(f"{must} finite numbers", "NaN or infinity", fix)
    return replace(
        surface,
        height=np.ascontiguousarray(height - float(np.median(height))),
        albedo=np.ascontiguousarray(np.clip(albedo, 0.01, 1.0)),
    )
