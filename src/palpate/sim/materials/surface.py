"""What a material draws, and its entry in the table of materials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from palpate.core import require
from palpate.sim.arrays import Array, f32
from palpate.sim.tile import TILE_MM, Tile


@dataclass(frozen=True)
class Surface:
    """A piece of a material, as a periodic tile, on the body that it covers.

    Attributes:
        height: relief in mm, shape (n, n), float32.
        albedo: reflectance in [0, 1], shape (n, n, 3), float32; of man-made things it must not
            reveal the relief.
        subtype: the kind that was drawn.
        gloss: 0 matt to 1 mirror-like.
        softness: 0 rigid to 1 (yields under the gel).
        curvature: 1 / radius of the body in 1/mm along x of the pad, positive for a bulge; 0 for
            flat. An object draws it, no material.
        side_mm: side of the tile.
        ground: what the photo shows, and what is felt beside the relief; None for the tile itself.
    """

    height: Array
    albedo: Array
    subtype: str
    gloss: float = 0.0
    softness: float = 0.0
    curvature: float = 0.0
    side_mm: float = TILE_MM
    ground: Surface | None = None

    @property
    def px(self) -> float:
        """Pixel size in mm."""
        return self.side_mm / len(self.height)


#: Draws a piece of a material on a tile; all randomness comes from the tile's generator.
Draw: TypeAlias = Callable[[Tile], Surface]


@dataclass(frozen=True)
class Material:
    """An entry of ``MATERIALS``.

    Attributes:
        label: id in ``label.txt``.
        draw: the function that draws a piece.
    """

    label: int
    draw: Draw


def rising(height: Array) -> Array:
    """Scale heights to [0, 1]."""
    low, high = float(height.min()), float(height.max())
    return (height - low) * (1.0 / (high - low + 1e-9))


def of_top(height: Array) -> Array:
    """Divide heights by the largest and clip them to [0, 1]."""
    return np.clip(height * (1.0 / float(height.max())), 0.0, 1.0)


def draw_surface(
    name: str, material: Material, n: int, rng: np.random.Generator, *, whole: bool = False
) -> Surface:
    """Draw and check a piece; see :class:`~palpate.sim.tile.Tile`.

    Returns:
        The surface with median height 0, albedo clipped to [0.01, 1], arrays in float32, C order.

    Raises:
        PalpateError: naming the material, if its function returned a wrong shape or numbers that
            are not finite.
    """
    surface = material.draw(Tile(n, rng, whole=whole))
    height, albedo = f32(surface.height), f32(surface.albedo)
    must = f"The material {name!r} must return a height and an albedo of"
    got, shapes = (height.shape, albedo.shape), ((n, n), (n, n, 3))
    require(got == shapes, None, f"{must} shapes {shapes}", got, fix="Correct it")
    finite = bool(np.isfinite(height).all() and np.isfinite(albedo).all())
    require(finite, None, f"{must} finite numbers", "NaN or infinity", fix="Correct it")
    return replace(
        surface,
        height=np.ascontiguousarray(height - float(np.median(height))),
        albedo=np.ascontiguousarray(np.clip(albedo, 0.01, 1.0)),
    )
