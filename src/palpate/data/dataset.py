"""The samples of a part as a map-style data set, for ``torch.utils.data.DataLoader`` and others."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from palpate.core import MissingExtraError
from palpate.data.images import read_image

#: An image -> what a model takes.
Transform = Callable[[Image.Image], Any]


@dataclass(frozen=True)
class SampleDataset:
    """Samples by number, as dictionaries of the columns that none of them lacks.

    Images are read when a sample is asked for; it may be pickled, and read by several workers: it
    holds plain lists, as a frame of polars does not survive the fork of a worker. ``len`` and
    ``[k]`` are all that PyTorch's loaders need, so it loads no torch.

    Attributes:
        columns: name -> the values of all samples; of images the paths.
        images: the columns of images.
        transform: of each image, upright 8-bit RGB, e.g. of torchvision; or one for each of the
            columns ``vision``, ``tactile`` and ``background``. None: an array (height, width, 3) of
            bytes.
    """

    columns: Mapping[str, Sequence[Any]]
    images: Sequence[str]
    transform: Transform | Mapping[str, Transform] | None = None

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
