"""The samples of a part as a map-style data set, for ``torch.utils.data.DataLoader`` and others."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from palpate.core import MissingExtraError, require
from palpate.data.images import read_image
from palpate.data.manifest import IMAGE_COLUMNS, Manifest

#: An image -> what a model takes.
Transform = Callable[[Image.Image], Any]


class SampleDataset:
    """Samples by number, as dictionaries of the columns that none of them lacks.

    Images are read when a sample is asked for; it may be pickled, and read by several workers.
    ``len`` and ``[k]`` are all that PyTorch's loaders need, so it loads no torch.

    Args:
        manifest: the samples, at least one.
        transform: of each image, upright 8-bit RGB, e.g. of torchvision; or one for each of the
            columns ``vision``, ``tactile`` and ``background``. None: an array (height, width, 3) of
            bytes.

    Raises:
        PalpateError: if no image column is whole.
    """

    def __init__(
        self, manifest: Manifest, transform: Transform | Mapping[str, Transform] | None = None
    ) -> None:
        table = manifest.table
        whole = [column.name for column in table if not column.null_count()]
        self.images = [name for name in IMAGE_COLUMNS if name in whole and len(table)]
        lacks = {n: f"{table[n].null_count():,} {n}" for n in IMAGE_COLUMNS[:2]}
        must = "A data set must have an image column that no sample lacks"
        got = f"{' and '.join(lacks.values())} images missing of {len(table):,} samples"
        fix = "Import the images, or take the samples that have them"
        require(bool(self.images), None, must, got, fix=fix)
        # Plain lists: a frame of polars does not survive the fork of a worker.
        self.columns = {name: table[name].to_list() for name in whole}
        self.columns |= {name: manifest.paths(name) for name in self.images}
        self.transform = transform

    def __len__(self) -> int:
        return len(self.columns["id"])

    def __getitem__(self, k: int) -> dict[str, Any]:
        """Sample ``k``, negative from the end.

        Raises:
            IndexError: beyond the last.
            PalpateError: if an image cannot be read.
        """
        sample = {name: column[operator.index(k)] for name, column in self.columns.items()}
        for name in self.images:
            sample[name] = self._image(name, sample[name])
        return sample

    def _image(self, name: str, path: Path) -> Any:
        each = self.transform
        transform = each.get(name) if isinstance(each, Mapping) else each
        return (transform or np.array)(read_image(path))

    def to_hf(self) -> Any:
        """The same samples as a ``datasets.Dataset``, whose images are decoded on access.

        The transform is left out: ``with_transform`` is that of ``datasets``.

        Raises:
            MissingExtraError: without the package ``datasets``.
        """
        try:
            import datasets
        except ImportError:
            raise MissingExtraError("datasets", "hf", "A Hugging Face data set") from None
        paths = {name: list(map(str, self.columns[name])) for name in self.images}
        whole = datasets.Dataset.from_dict({**self.columns, **paths})
        for name in self.images:
            whole = whole.cast_column(name, datasets.Image())
        return whole
