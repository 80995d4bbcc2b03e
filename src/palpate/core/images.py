"""Images from and to files.

They are decoded by Pillow, by the decoders in ``IMAGE_FORMATS`` alone, none of which starts a
program, and become upright 8-bit RGB by fixed rules:

- EXIF orientation is applied; of an animation the first image counts;
- 16-bit gray ``v`` becomes ``(v + 128) // 257``, so that 65535 is 255; the white of a TIFF of 12
  bits is 4095, and ``MinIsWhite`` is inverted;
- transparency is laid over white; CMYK and palettes become RGB by Pillow's plain formulas;
- floating-point pixels, whole numbers beyond 65535, and 16-bit pixels of which none reaches 4096 (a
  camera of 12 bits, or of 10?) have no range that could be known: such an image cannot be read.

No rule depends on other images, and no range is stretched.
"""

from __future__ import annotations

import importlib
import io
from collections.abc import Generator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from palpate.core.files import atomic_path

if TYPE_CHECKING:
    from PIL import Image

#: Pillow's names of the images that are read. What is in the file chooses among these alone.
IMAGE_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "PPM", "GIF", "AVIF", "HEIF")
#: Suffixes of the names of images.
SUFFIXES = (
    *(".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"),
    *(".ppm", ".pgm", ".gif", ".avif", ".heic", ".heif"),
)
#: Pixels of the largest image that is decoded: some twenty bytes each while it becomes RGB.
MOST_PIXELS = 50_000_000
#: White of 16-bit pixels, and the least brightest pixel of an image that is one of them.
WHITE_16, BRIGHT_16 = 65535, 4096
#: Tags of EXIF and TIFF.
ORIENTATION, BITS, PHOTOMETRIC = 0x0112, 258, 262


class ImageError(ValueError):
    """Why an image cannot be read, in words."""


@contextmanager
def open_image(source: Path | BinaryIO) -> Generator[Image.Image]:
    """Open an image for the statements inside, which may decode it.

    Raises:
        ImageError: for whatever is wrong with it, there or here.
    """
    from PIL import Image

    try:
        if isinstance(source, Path) and source.is_fifo():  # it would be waited for
            raise ImageError("a pipe, which is no file")
        with Image.open(source, formats=_installed_formats()) as image:
            if image.width * image.height > MOST_PIXELS:
                size = f"{image.width} x {image.height} pixels"
                raise ImageError(f"{size}, more than {MOST_PIXELS:,}")
            yield image
    except ImageError:
        raise
    except Exception as error:  # of a damaged file Pillow raises almost anything
        raise ImageError(_why_unreadable(source, error)) from None


@cache
def _installed_formats() -> tuple[str, ...]:
    from PIL import Image

    for library in ("pi_heif", "pillow_heif"):
        with suppress(ImportError):
            importlib.import_module(library).register_heif_opener()
            break
    Image.init()
    return tuple(name for name in IMAGE_FORMATS if name in Image.OPEN)


def _why_unreadable(source: Path | BinaryIO, error: Exception) -> str:
    """What Pillow raised, in plain words."""
    from PIL import Image

    if isinstance(error, FileNotFoundError | IsADirectoryError):
        return "a folder" if isinstance(error, IsADirectoryError) else "no such file"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, Image.DecompressionBombError):
        return f"more than {MOST_PIXELS:,} pixels"
    if not isinstance(error, Image.UnidentifiedImageError):
        words = str(error) or type(error).__name__
        return words.replace(str(source), source.name) if isinstance(source, Path) else words
    with source.open("rb") if isinstance(source, Path) else source as file:
        file.seek(0)
        head = file.read(11)
    if not head:
        return "an empty file (0 bytes)"
    if head[4:] in (b"ftyphei", b"ftyphev", b"ftypmif") and "HEIF" not in _installed_formats():
        return "HEIC, which needs the package pi-heif: pip install pi-heif"
    return f"not an image that can be read ({', '.join(IMAGE_FORMATS)})"


def decoded(
    image: Image.Image, at_least: tuple[int, int] | None = None
) -> tuple[Image.Image, list[str]]:
    """Decode an open image by the rules in the head of this file.

    Args:
        image: of :func:`open_image`.
        at_least: (width, height) that are enough; a large JPEG is decoded faster at a fraction.

    Returns:
        The image, 8-bit RGB, and in words how it was read where it was not that already.

    Raises:
        ImageError: if its pixels have no range that is known.
    """
    from PIL import Image, ImageOps

    layout, tags = str(getattr(image, "tile", "")), getattr(image, "tag_v2", {})
    several = image.format != "MPO" and getattr(image, "is_animated", False)  # MPO: of a phone
    taken = ["the first of several images"] if several else []
    if at_least is not None:
        image.draft("RGB", at_least)
    image.load()
    if image.getexif().get(ORIENTATION) in range(2, 9):
        taken.append("turned upright by EXIF")
        ImageOps.exif_transpose(image, in_place=True)
    if image.mode == "F":
        raise ImageError("floating-point pixels, whose range is not defined")
    if image.mode.startswith("I"):
        bits = min(16, *tags.get(BITS, (16,)))
        image = Image.fromarray(_gray(np.asarray(image), 2**bits - 1, tags.get(PHOTOMETRIC) == 0))
        taken.append(f"{bits}-bit gray with {2**bits - 1} as white")
    elif ";16" in layout:  # Pillow has the upper eight bits alone
        colors = np.asarray(image).reshape(-1, len(image.getbands()))
        colors = colors[:, :-1] if "A" in image.getbands() else colors
        _require_bright(256 * int(colors.max()) + 255)
        taken.append(f"16-bit color with {WHITE_16} as white")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
        taken.append("transparency laid over white")
    taken += ["CMYK without its color profile"] if image.mode == "CMYK" else []
    return image if image.mode == "RGB" else image.convert("RGB"), taken


def _gray(values: NDArray[Any], white: int, inverted: bool) -> NDArray[np.uint8]:
    """Whole numbers (h, w) as bytes."""
    low, high = int(values.min()), int(values.max())
    if low < 0 or high > white:
        raise ImageError(f"whole numbers from {low} to {high}, whose range is not defined")
    if white == WHITE_16:
        _require_bright(high)
    values = values.astype(np.int64)
    values = white - values if inverted else values
    return ((values * 255 + white // 2) // white).astype(np.uint8)


def _require_bright(high: int) -> None:
    if 0 < high < BRIGHT_16:
        text = f"16-bit pixels up to {high} of {WHITE_16}: fewer bits that are not stated"
        raise ImageError(f"{text}, or nearly black; write them as 8 bits")


def image_bytes(image: Image.Image | NDArray[np.uint8], form: str, **options: Any) -> bytes:
    """An image as the content of a file; written at once, a full disk is noticed, as by Pillow not.

    Args:
        image: 8-bit, (h, w, 3) or of Pillow.
        form: Pillow's name of it.
        options: of Pillow's writer.
    """
    from PIL import Image

    data = io.BytesIO()
    image = image if isinstance(image, Image.Image) else Image.fromarray(image)
    image.save(data, form, **options)
    return data.getvalue()


def save_image(
    path: Path, image: Image.Image | NDArray[np.uint8], form: str = "PNG", **options: Any
) -> None:
    """Write an image (see :func:`image_bytes`) whole or not at all.

    Raises:
        OSError: if the disk is full.
        PalpateError: if nothing can be written there.
    """
    data = image_bytes(image, form, **options)
    with atomic_path(path, flush=False) as part:
        part.write_bytes(data)
