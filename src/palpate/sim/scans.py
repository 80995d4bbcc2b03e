"""Photo-scanned surfaces of a folder: color, and height or normals, as looks of the materials.

::

    surfaces.csv                 name, class, width_mm or width_mm_guess; relief_mm where known
    <class>/<name>/color.jpg     the photograph; it should repeat without a seam
    <class>/<name>/height.png    white is high; or normal.png, whose blue is up

Blanks of a class are ``_`` in the folder's name; color, height and normal may be .jpg or .png.
A class is a material of the world or one of :data:`CLASSES`. Height maps have no unit: their range
is ``relief_mm``, else a guess by class. Of normals the slopes are known, and their integral is the
height (Frankot and Chellappa 1988); whether green is up or down is what makes them a gradient.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from palpate.core import PalpateError, ProblemsError, digest_file, digest_lines, few, require
from palpate.core.files import inside
from palpate.core.images import ImageError, open_image
from palpate.data.images import image_size, read_image
from palpate.data.tables import open_table
from palpate.sim.arrays import Array, f32, resample
from palpate.sim.materials import MATERIALS

#: Class of a scan -> material, and range of its relief in mm (a guess).
CLASSES: dict[str, tuple[str, float]] = {
    "brick": ("Brick", 8),
    "paving stone": ("Rock", 10),
    "roof tile": ("Brick", 25),
    "tile": ("Tile", 2),
    "plaster": ("Concrete", 2),
    "asphalt": ("Concrete", 6),
    "rock": ("Rock", 40),
    "marble": ("Tile", 0.05),
    "wood": ("Wood", 1),
    "bark": ("Tree", 18),
    "fabric": ("Natural Fabric", 0.8),
    "paper": ("Paper", 0.3),
    "metal": ("Metal", 0.5),
    "plastic": ("Plastic", 0.3),
    "gravel": ("Gravel", 15),
    "sand": ("Sand", 12),
    "soil": ("Soil", 40),
    "grass": ("Grass", 30),
    "leaf litter": ("Soil", 50),
    "snow": ("Sand", 15),
    "ice": ("Glass", 5),
}
#: Relief in mm of a class that is named like a material.
RELIEF_MM = 2.0
COLUMNS = ("name", "class", "width_mm", "width_mm_guess", "relief_mm")


@dataclass(frozen=True)
class Scan:
    """A photo-scanned surface.

    Attributes:
        name: in surfaces.csv.
        material: the world's.
        color, relief: its files.
        size: width and height of the color in pixels.
        width_mm: of the picture.
        guessed: whether that is a guess.
        relief_mm: range of the height; of normals not used.
    """

    name: str
    material: str
    color: Path
    relief: Path
    size: tuple[int, int]
    width_mm: float
    guessed: bool
    relief_mm: float

    @property
    def px(self) -> float:
        """Size of its pixels in mm."""
        return self.width_mm / self.size[0]

    def read(self, size: int) -> tuple[Array, Array, float]:
        """Read color (size, size, 3) in [0, 1] and height (size, size) in mm, and the side in mm.

        A picture that is no square is repeated along its short side.

        Raises:
            PalpateError: if a file cannot be read.
        """
        width, height = self.size
        color, relief = f32(read_image(self.color)) / 255, _values(self.relief)
        if self.relief.stem == "normal":
            relief = integrated(f32(relief[..., :3]) / 127.5 - 1) * self.px
        else:
            relief = relief.mean(2) if relief.ndim == 3 else relief
            low, high = np.percentile(relief, (0.1, 99.9))
            relief = (relief - low) * (self.relief_mm / max(float(high - low), 1e-9))
        times = max(1, round(width / height)), max(1, round(height / width))
        color, relief = np.tile(color, (*times, 1)), np.tile(relief, times)
        relief = resample(f32(relief), size)
        side = self.width_mm * times[1]
        return resample(color, size), relief - float(np.median(relief)), side


@lru_cache(maxsize=4)
def read_scans(folder: Path) -> tuple[Scan, ...]:
    """Read what surfaces.csv of a folder names; images are opened, not decoded.

    Raises:
        PalpateError: if the table or a file is missing, a class is unknown, a surface has no width,
            or its relief another size than its color.
    """
    table = open_table(folder / "surfaces.csv")
    missing = [name for name in ("name", "class") if name not in table.names]
    require(not missing, None, f"{table.name} must have the columns name, class", table.names)
    rows = table.read([name for name in COLUMNS if name in table.names])
    if table.problems:
        raise ProblemsError(table.problems, "Correct it")
    return tuple(_scan(folder, row) for row in rows.iter_rows(named=True))


def scan_notes(scans: Sequence[Scan]) -> list[str]:
    """Return what a reader must know of scans: widths that are guesses, and pixels beyond 1 mm."""
    guessed = [scan.name for scan in scans if scan.guessed]
    rough = [f"{scan.name} ({1 / scan.px:.2g})" for scan in scans if scan.px > 1]
    widths = f"Widths of {len(guessed)} of {len(scans)} surfaces are guesses: {few(guessed)}."
    pixels = f"Surfaces below 1 pixel per mm, too coarse for touches: {few(rough)}."
    return [*[widths] * bool(guessed), *[pixels] * bool(rough)]


def scans_digest(folder: Path) -> str:
    """Return the SHA-256 over all that :func:`read_scans` names, wherever the folder is."""
    lines = (
        f"{s.name} {s.material} {s.width_mm} {s.relief_mm} {digest_file(s.color)} "
        f"{digest_file(s.relief)}"
        for s in read_scans(folder)
    )
    return digest_lines(lines)


def integrated(normals: Array) -> Array:
    """Return the height in pixels of periodic normals (n, m, 3), by least squares.

    With slopes p, q along x and y, the transform of the height is -i (u P + v Q) / (u² + v²). The
    sign of q is that with the smaller curl.
    """
    up = np.maximum(normals[..., 2], 0.05)
    p, q = (np.fft.fft2(-normals[..., k] / up) for k in (0, 1))
    n, m = up.shape
    v, u = 2 * math.pi * np.fft.fftfreq(n)[:, None], 2 * math.pi * np.fft.fftfreq(m)[None]
    if abs(v * p - u * q).sum() > abs(v * p + u * q).sum():  # green is up: y is down in pixels
        q = -q
    square = u * u + v * v
    square[0, 0] = 1
    return f32(np.fft.ifft2(-1j * (u * p + v * q) / square).real)


def _scan(folder: Path, row: Mapping[str, str | None]) -> Scan:
    name, kind = row["name"] or "", (row["class"] or "").lower()
    of_world = {material.lower(): (material, RELIEF_MM) for material in MATERIALS}
    classes = of_world | CLASSES
    must = f"The class of {name} must be a material, or one of {', '.join(CLASSES)}"
    require(kind in classes, None, must, repr(row["class"]), fix="Correct surfaces.csv")
    width, guessed = _number(row, "width_mm"), _number(row, "width_mm_guess")
    must = f"{name} must have its width in mm in surfaces.csv (width_mm, or width_mm_guess)"
    fix = "Measure or guess how wide the surface in its picture is"
    require(max(width, guessed) > 0, None, must, "neither", fix=fix)
    at = inside(folder, f"{(row['class'] or '').replace(' ', '_')}/{name}")
    if at is None:
        raise PalpateError("A surface must lie in its folder", repr(name), "Rename it")
    color, relief = _file(at, "color"), _file(at, "height", "normal")
    sizes = [image_size(path) or (0, 0) for path in (color, relief)]
    must = f"{relief} must be as large as {color.name}, {_text(sizes[0])}"
    require(sizes[0] == sizes[1] != (0, 0), None, must, _text(sizes[1]), fix="Resize it")
    material, range_mm = classes[kind]
    range_mm = _number(row, "relief_mm") or float(range_mm)
    return Scan(name, material, color, relief, sizes[0], width or guessed, not width, range_mm)


def _number(row: Mapping[str, str | None], column: str) -> float:
    """Return a number above 0 of the table; 0 where there is none."""
    text = row.get(column) or "0"
    with suppress(ValueError):
        if 0 <= (value := float(text)) < math.inf:
            return value
    must = f"{column} of {row['name']} must be a number of mm above 0"
    raise PalpateError(must, repr(text), "Correct surfaces.csv")


def _file(folder: Path, *names: str) -> Path:
    """Return the first of the files name.jpg, name.png that is there."""
    files = [folder / f"{name}{suffix}" for name in names for suffix in (".jpg", ".png")]
    must = f"{folder} must hold one of {', '.join(file.name for file in files)}"
    found = [file for file in files if file.is_file()]
    require(bool(found), None, must, "none of them", fix="Add it, or remove the row")
    return found[0]


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]} pixels"


def _values(path: Path) -> Array:
    """Read the pixels of an image at their full depth: (h, w) or (h, w, k)."""
    try:
        with open_image(path) as image:
            return f32(image.convert("RGB") if image.mode == "P" else image)
    except ImageError as error:
        must = f"The image {path} must be whole and readable"
        raise PalpateError(must, str(error), "Fetch the file again") from None
