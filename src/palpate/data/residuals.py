"""Residuals: tactile images minus the same gel without contact, in floating point.

A residual is ``image - no-contact image`` in gray levels, of the center square, averaged to the
encoder's side. 8 bits would round away what averages keep of a faint contact.

Where the right no-contact image is missing, the next best takes its place. From best to worst, as
measured on held-out real videos (the ruler's accuracy, and TMMD's power at five videos a side):

1. the manifest's column ``background``, or one image for all; ``palpate background`` fills it with
   the rest just before each contact, else the frame at rest of the video;
2. the median of images of at least :data:`LEAST` different objects of one gel and day (columns
   ``sensor``, ``session``, ``object``);
3. the median of the video's own images;
4. the median of the whole reference;
5. none: the image's own low frequencies are taken off.

Never the raw image, by which another gel or lamp outweighs every contact. All sets that are
compared take the same kind: of unequal kinds 58 to 100 % of equal sets differ at p < .05. A
generated image takes the no-contact image that its own set states, else what the real image of its
id takes; by a median of their own, equal images would have no residual.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray
from PIL import Image

from palpate.core import digest_lines, is_whole, save_image, sealed_path, short
from palpate.data.images import Preprocess, image_stamp, read_image

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

Kind = Literal["no contact", "other objects", "own video", "whole set", "low-pass"]
#: The fact of a manifest that says the kind.
KIND = "background_kind"
#: Columns within which a median is taken, of each kind.
MEDIANS: Mapping[Kind, tuple[str, ...]] = {
    "other objects": ("sensor", "session"),
    "own video": ("video",),
    "whole set": (),
}
#: Objects, or images of one video, that a median needs: 20 of them cost .01 of accuracy, 5 .04.
LEAST, LEAST_OF_VIDEO = 20, 5
#: Images that a median is taken of, at most.
MOST = 100
#: Rows of what is subtracted where there is no other image.
COARSE = 8


@dataclass(frozen=True)
class Residual(Preprocess):
    """How a ruler prepares images: float16 gray levels around 0, as the head of this file says."""

    mean: tuple[float, ...] = (0.0,) * 3
    std: tuple[float, ...] = (1 / 255,) * 3  # networks take values divided by 255
    subtract: tuple[str, ...] = ("",)

    #: Side at which the digest of an image is taken: of its pixels, not of a residual.
    plain_side: ClassVar[int] = 64

    dtype = np.dtype(np.float16)
    residual = True

    @property
    def plainly(self) -> Preprocess:
        """The center square at :attr:`plain_side`."""
        return Preprocess(self.plain_side, self.plain_side)

    def prepare(
        self,
        image: Image.Image,
        background: Image.Image | None = None,
        previous: Image.Image | None = None,
    ) -> NDArray[np.float16]:
        """The residual of one RGB image, (size, size, 3); without a background low-passed."""
        own = _squared(image)
        if background is None:
            small = _resized(own, (COARSE, COARSE), Image.Resampling.BOX)
            gel = _resized(small, own.shape[:2], Image.Resampling.BICUBIC)
        else:
            gel = _squared(background)
            if gel.shape != own.shape:
                gel = _resized(gel, own.shape[:2], Image.Resampling.BICUBIC)
        side = (self.size, self.size)
        return _resized(own - gel, side, Image.Resampling.BILINEAR).astype(np.float16)


def _squared(image: Image.Image) -> NDArray[np.float32]:
    """The center square in gray levels."""
    (width, height), side = image.size, min(image.size)
    left, top = (width - side) // 2, (height - side) // 2
    return np.asarray(image.crop((left, top, left + side, top + side)), np.float32)


def _resized(
    values: NDArray[np.float32], shape: tuple[int, ...], resample: Image.Resampling
) -> NDArray[np.float32]:
    """Values (h, w, 3) at another (h, w), antialiased, without rounding."""
    if values.shape[:2] == shape:
        return values
    rows, columns = shape
    channels = (Image.fromarray(np.ascontiguousarray(values[..., c])) for c in range(3))
    return np.stack([np.asarray(c.resize((columns, rows), resample)) for c in channels], axis=2)


def with_gels(
    reference: Manifest, sets: Sequence[Manifest], folder: Path, *, real: Collection[int] = ()
) -> tuple[Kind, list[Manifest]]:
    """Samples with what is subtracted from each in their column ``background``.

    Args:
        reference: real images.
        sets: what is compared with it, all with image files; images of the reference's ids take
            its backgrounds, unless the set states no-contact images itself.
        folder: for medians, as PNG files.
        real: numbers of the sets that are real images, too, which take their own backgrounds.

    Returns:
        The kind of background, the best that all samples with a tactile image have, and the
        reference and the sets; of the kind ``low-pass`` without backgrounds. The fact
        :data:`KIND` of each says the kind.
    """
    kind: Kind
    parts = [reference, *sets]
    for kind in ("no contact", *MEDIANS):
        gels = _gels(reference, kind, folder)
        columns = [gels]
        for k, part in enumerate(sets):
            columns.append(_lent(part, reference, gels))
            if k in real or kind == "no contact":  # its own, where it says it
                own = _gels(part, kind, folder)
                columns[-1] = [mine or lent for mine, lent in zip(own, columns[-1], strict=True)]
        if all(map(_complete, parts, columns)):
            break
    else:
        kind, columns = "low-pass", [[None] * len(part) for part in parts]
    return kind, [
        replace(
            part,
            table=part.table.with_columns(pl.Series("background", gels, pl.String)),
            facts={**part.facts, KIND: kind},
        )
        for part, gels in zip(parts, columns, strict=True)
    ]


def kind_of(part: Manifest) -> str:
    """The kind of background of samples: as :func:`with_gels` found, or by the manifest alone."""
    alone = "no contact" if _complete(part, part.column("background")) else "low-pass"
    return part.facts.get(KIND, alone)


def of_one_kind(part: Manifest) -> Manifest:
    """The samples with the fact :data:`KIND`, so that each slice of them is of that kind."""
    kind = kind_of(part)
    table = part.table
    if kind == "low-pass":
        table = table.with_columns(pl.lit(None, pl.String).alias("background"))
    return replace(part, table=table, facts={**part.facts, KIND: kind})


def _complete(part: Manifest, gels: Sequence[str | None]) -> bool:
    """Whether each sample with a tactile image has a background."""
    images = part.column("tactile")
    return all(gel or not image for gel, image in zip(gels, images, strict=True))


def _lent(part: Manifest, reference: Manifest, gels: Sequence[str | None]) -> list[str | None]:
    """The backgrounds of a set: the reference's by id, or the only one there is."""
    by_id = dict(zip(reference.ids, gels, strict=True))
    only = gels[0] if len({*gels}) == 1 else None
    return [by_id.get(name, only) for name in part.ids]


def _gels(part: Manifest, kind: Kind, folder: Path) -> list[str | None]:
    """Absolute paths of one kind of backgrounds; None where a sample has none."""
    if kind == "no contact":
        return [gel and str(part.path(gel).resolve()) for gel in part.column("background")]
    columns = MEDIANS[kind]
    if any(part.table[name].null_count() for name in columns):
        return [None] * len(part)
    gels: list[str | None] = [None] * len(part)
    rows = (
        part.table.select("object", "tactile", *columns).with_row_index("row").drop_nulls("tactile")
    )
    for group in rows.partition_by(columns) if columns else [rows]:
        at, objects = group["row"].to_list(), group["object"]
        if kind == "other objects":  # one image of each
            at = group.drop_nulls("object").unique("object", maintain_order=True)["row"].to_list()
        several = kind != "whole set" or objects.n_unique() > 1 or objects.is_null().all()
        if several and len(at) >= (LEAST_OF_VIDEO if kind == "own video" else LEAST):
            evenly = np.linspace(0, len(at) - 1, min(MOST, len(at))).astype(int)
            gel = _median(part, [at[k] for k in evenly], folder)
            for row in group["row"]:
                gels[row] = gel
    return gels


def _median(part: Manifest, rows: Sequence[int], folder: Path) -> str | None:
    """The file of the median of images; None where they differ in size."""
    some = replace(part, table=part.table[list(rows)])
    file = folder / f"median-{short(digest_lines([image_stamp(some, 'tactile')]))}.png"
    if not is_whole(file):
        images = [np.asarray(read_image(path)) for path in some.paths("tactile")]
        if len({image.shape for image in images}) > 1:
            return None
        with sealed_path(file) as temporary:
            save_image(temporary, np.median(images, axis=0).round().astype(np.uint8))
    return str(file.resolve())
