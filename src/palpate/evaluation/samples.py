"""Samples of one generator or of the reference, whatever they were read from."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError, Progress, digest_file, digest_json, short
from palpate.core.messages import require_rows

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

#: Decoded images of more bytes than this are kept in a file of the cache.
IN_MEMORY = 1 << 30


@dataclass(frozen=True)
class Samples:
    """Samples of one generator or the reference: ``features``, ``manifest`` or ``images`` is set.

    Attributes:
        source: path or name, for errors.
        ids: n distinct ids.
        numbered: whether the ids are row numbers, which pair nothing.
        labels, groups: n strings each ('' where unknown), or None.
        group: what the groups are: a column name, ``video`` for groups that came with features.
        manifest: image files (column ``tactile``; a reference may have ``vision``, ``background``).
        images: (n, h, w, 3) uint8.
        features: (n, d), possibly memory-mapped.
        encoder: digest of the encoder that made the features.
        path: file of the features.
        background: one no-contact image for all of a reference.
        generator: settings of ``palpate generate``, for its folders.
    """

    source: str
    ids: list[str]
    numbered: bool = False
    labels: list[str] | None = None
    groups: list[str] | None = None
    group: str | None = None
    manifest: Manifest | None = None
    images: NDArray[np.uint8] | None = None
    features: NDArray[Any] | None = None
    encoder: str | None = None
    path: Path | None = None
    background: Samples | None = None
    generator: Mapping[str, Any] | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def has_background(self) -> bool:
        """Whether every sample has its no-contact image, or there is one for all."""
        rows = self.manifest is not None and not self.manifest.table["background"].null_count()
        return rows or self.background is not None

    def take(self, ids: Sequence[str]) -> Samples:
        """The samples of ``ids``, in that order.

        Raises:
            PalpateError: if an id is missing.
        """
        must = f"{self.source} must have every id of the split's test part"
        at = require_rows(self.ids, ids, must, "Use the split that was made for it")
        groups = picked(self.groups, at)
        return replace(
            self,
            ids=list(ids),
            labels=picked(self.labels, at),
            groups=groups if groups and any(groups) else None,
            manifest=self.manifest and self.manifest.take(ids),
            images=None if self.images is None else self.images[at],
            features=None if self.features is None else self.features[at],
        )

    def feature_set(self, features: NDArray[Any], encoder: str | None) -> FeatureSet:
        """Features of these samples with their ids, labels and groups.

        Raises:
            PalpateError: on NaN or infinity; the rows are named.
        """
        try:
            return FeatureSet(self.ids, features, self.labels, self.groups, encoder)
        except PalpateError as error:
            raise PalpateError(f"{self.source}: {error.must}", error.got, error.fix) from None

    @cached_property
    def side(self) -> int:
        """The shorter side of the images.

        Raises:
            PalpateError: if they differ in size.
        """
        if self.manifest is None:
            return min(cast("NDArray[np.uint8]", self.images).shape[1:3])
        sizes = {path: _image_size(path) for path in self.manifest.paths("tactile")}
        first = next(iter(sizes))
        other = next((p for p, size in sizes.items() if size != sizes[first]), None)
        if other is not None:
            got = " and ".join("{} of {} x {}".format(p.name, *sizes[p]) for p in (first, other))
            must = f"All images of {self.source} must have one size for scores of pixels"
            fix, example = "Resize them, or request other companions", {"companions": ["fid"]}
            raise PalpateError(must, got, fix, example=example)
        return min(sizes[first])

    def pixels(
        self, size: int, cache: Path, progress: Progress, column: str = "tactile"
    ) -> NDArray[np.uint8]:
        """The images as squares, (n, size, size, 3); many of them memory-mapped from the cache."""
        from palpate.data.images import cached_images, load_images, square

        if column == "background" and self.background is not None:
            gel = self.background.pixels(size, cache, progress)[0]
            return np.broadcast_to(gel, (len(self), *gel.shape))
        if self.manifest is None:
            from PIL import Image

            images = cast("NDArray[np.uint8]", self.images)
            return np.stack([square(Image.fromarray(image), size) for image in images])
        if len(self) * size * size * 3 > IN_MEMORY:
            return cached_images(self.manifest, column, size, self.folder(cache, column), progress)
        return load_images(self.manifest.paths(column), size, progress=progress)

    def folder(self, cache: Path, column: str = "tactile") -> Path:
        """A folder of the cache for the bytes of these images, whatever their names and times."""
        return cache / short(self.image_digest(column))

    def image_digest(self, column: str = "tactile") -> str:
        """SHA-256 over id and bytes of every image, in any order: the same for a copied folder."""
        if self.manifest is None:
            images = cast("NDArray[np.uint8]", self.images)
            digests = [hashlib.sha256(image.tobytes()).hexdigest() for image in images]
        else:
            paths = self.manifest.paths(column)
            digests = [_file_digest(path, path.stat().st_ctime_ns) for path in paths]
        return digest_json(sorted(map(list, zip(self.ids, digests, strict=True))))

    @property
    def digest(self) -> str:
        """Digest of the images, or of the file of features."""
        if self.features is None:
            return self.image_digest()
        return digest_file(self.path) if self.path else self.feature_set(self.features, None).digest


def picked(column: Sequence[str] | None, at: Sequence[int]) -> list[str] | None:
    """Some entries of a column; None stays None."""
    return None if column is None else [column[k] for k in at]


@lru_cache(maxsize=1 << 20)
def _file_digest(path: Path, _changed: int) -> str:
    """SHA-256 of a file, read once per run unless its time of change differs."""
    return digest_file(path)


def _image_size(path: Path) -> tuple[int, int]:
    from palpate.data.images import BROKEN, opened, read_image

    try:
        with opened(path) as image:  # reads the header alone
            return image.size
    except BROKEN:
        return read_image(path).size  # raises the reason
