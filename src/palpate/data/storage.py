"""How images are stored, and one storage for all sides of a comparison.

A judge of fine texture sees the codec first. A JPEG is known by its quantization tables and chroma
subsampling; all else counts as lossless, frames of videos too: their files do not say what they
went through. Where sides differ, each image of a side goes through the form of a random image of
every other side, unless its own side has that form: what was stored once is stored once, at the
size at which the other side was.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl
from PIL import Image, JpegImagePlugin

from palpate.core import ImageError, image_bytes, open_image, rng_for, save_image
from palpate.data.images import check_image, read_image
from palpate.data.samples import Samples

#: Mean of the table of luma of libjpeg at quality 50.
_LUMA = 57.625
LOSSLESS = "lossless"


@dataclass(frozen=True)
class Form:
    """A lossy form.

    Attributes:
        tables: of quantization, 64 numbers each; luma first.
        subsampling: of chroma, as Pillow numbers it: 0 none, 1 half the columns, 2 half of both.
        size: of the images (width, height).
    """

    tables: tuple[tuple[int, ...], ...]
    subsampling: int
    size: tuple[int, int]

    def __str__(self) -> str:
        """``JPEG of quality 95``, as libjpeg would call tables of that strength."""
        strength = sum(self.tables[0]) / len(self.tables[0]) / _LUMA
        return f"JPEG of quality {100 - 50 * strength if strength < 1 else 50 / strength:.0f}"

    @property
    def options(self) -> dict[str, object]:
        """What Pillow's writer takes."""
        return {"qtables": [list(t) for t in self.tables], "subsampling": self.subsampling}

    def through(self, image: Image.Image) -> Image.Image:
        """The image, 8-bit RGB, after it was stored so."""
        sized = image if image.size == self.size else image.resize(self.size)
        with open_image(io.BytesIO(image_bytes(sized, "JPEG", **self.options))) as stored:
            decoded = stored.convert("RGB")
        return decoded if decoded.size == image.size else decoded.resize(image.size)


def form_of(file: Path) -> Form | None:
    """The lossy form of an image file; None of a lossless one, and of what cannot be read."""
    with suppress(ImageError), open_image(file) as image:
        if not isinstance(image, JpegImagePlugin.JpegImageFile):
            return None
        tables = tuple(map(tuple, image.quantization.values()))
        return Form(tables, JpegImagePlugin.get_sampling(image), image.size)
    return None


def forms_of(samples: Samples) -> list[Form | None]:
    """The form of each tactile image; arrays count as lossless."""
    if samples.rows is not None:
        return [None] * len(samples)
    return [form_of(path) for path in samples.manifest.paths("tactile")]


def alike(
    sides: Mapping[str, Sequence[Samples]], folder: Path, seed: int
) -> tuple[dict[str, list[Samples]], dict[str, list[str]]]:
    """The sides of a comparison after the same storage.

    Args:
        sides: name -> sets of images that are one side.
        folder: receives images that were changed, as PNG.
        seed: of the draws where a side mixes forms.

    Returns:
        The sets, and the forms of each side in words where sides differ; else the same, and none.
    """
    forms = {name: [forms_of(s) for s in sets] for name, sets in sides.items()}
    pools = {name: [f for each in of for f in each] for name, of in forms.items()}
    if len({frozenset(pool) for pool in pools.values()}) == 1:
        return {name: [*sets] for name, sets in sides.items()}, {}
    words = {name: sorted({str(f or LOSSLESS) for f in pool}) for name, pool in pools.items()}
    stored: dict[str, list[Samples]] = {}
    for name, sets in sides.items():
        own = {*pools[name]}
        others = {n: pool for n, pool in pools.items() if {*pool} != own and {*pool} != {None}}
        stored[name] = []
        for k, samples in enumerate(sets):
            drawn = [
                {
                    pool[rng_for(seed, "storage", n, i).integers(len(pool))]
                    for n, pool in others.items()
                }
                for i in samples.ids
            ]
            lacking = [
                [f for f in each if f is not None and (f not in own or form is None)]
                for each, form in zip(drawn, forms[name][k], strict=True)
            ]
            stored[name].append(_stored(samples, lacking, folder / f"{len(stored)}-{k}"))
    return stored, words


def _stored(samples: Samples, lacking: Sequence[Sequence[Form]], folder: Path) -> Samples:
    """The samples, each image through its forms."""
    if not any(lacking):
        return samples
    if samples.rows is not None:
        rows = [
            np.array(_through(Image.fromarray(x), f))
            for x, f in zip(samples.rows, lacking, strict=True)
        ]
        return replace(samples, rows=np.stack(rows))
    files: list[str] = []
    for k, (path, forms) in enumerate(zip(samples.manifest.paths("tactile"), lacking, strict=True)):
        file = path
        if forms and not check_image(path).problem:  # others report what cannot be read
            file = folder / f"{k}.png"
            save_image(file, _through(read_image(path), forms))
        files.append(str(file.resolve()))
    return samples.with_columns(pl.Series("tactile", files, pl.String))


def _through(image: Image.Image, forms: Sequence[Form]) -> Image.Image:
    for form in sorted(forms, key=str):
        image = form.through(image)
    return image
