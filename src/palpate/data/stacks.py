"""Stacks of frames: a ``.npy`` file of (n, h, w, 3) or (n, h, w), read without loading it whole.

Pixels are bytes, or floats from 0 to 1. A file that needs unpickling is rejected.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError
from palpate.data.contacts import thumbnail

SUFFIX = ".npy"
#: Headers are parsed as Python, which several threads of Python 3.11 may not do at once.
_PARSING = Lock()


class StackReader:
    """A stack as a sequence of RGB images, with the methods of a video reader.

    Args:
        path: the file.

    Raises:
        PalpateError: if the file is missing, cut short, or no stack of images.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            with _PARSING:
                frames: Any = np.load(self.path, mmap_mode="r", allow_pickle=False)
        except Exception as error:  # a damaged header is parsed as Python, and fails in many ways
            got = "no such file" if not self.path.is_file() else str(error).splitlines()[0]
            raise self._broken(got) from None
        if not isinstance(frames, np.ndarray):
            raise self._broken("an archive of several arrays")
        plain = frames.ndim == 3 or (frames.ndim == 4 and frames.shape[3] in (1, 3))
        if not plain or 0 in frames.shape or frames.dtype.kind not in "uf":
            raise self._broken(f"{frames.dtype} of shape {frames.shape}")
        if frames.dtype.kind == "u" and frames.dtype != np.uint8:
            raise self._broken(f"{frames.dtype} pixels")
        self._frames: NDArray[Any] = frames

    #: Stacks have no timestamps, and no display matrix.
    seconds = None
    turned = False

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._frames)

    def __getitem__(self, k: int) -> NDArray[np.uint8]:
        """Frame ``k`` as (h, w, 3), 0 to 255.

        Raises:
            PalpateError: if a float lies outside 0 to 1.
        """
        frame = np.asarray(self._frames[k])
        if frame.dtype != np.uint8:
            if not (frame.min() >= 0 and frame.max() <= 1):  # also NaN
                raise self._broken(f"frame {k} with values from {frame.min()} to {frame.max()}")
            frame = np.rint(frame * 255).astype(np.uint8)
        frame = frame.reshape(*frame.shape[:2], -1)
        return np.repeat(frame, 3, axis=2) if frame.shape[2] == 1 else frame

    def frames(self, indices: Iterable[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield ``(k, (h, w, 3) image)`` as given."""
        return ((k, self[k]) for k in indices)

    def thumbnails(self) -> NDArray[np.uint8]:
        """All frames reduced to (n, 48, 64, 3)."""
        return np.stack([thumbnail(self[k]) for k in range(len(self))])

    def __enter__(self) -> StackReader:
        return self

    def __exit__(self, *error: object) -> None:
        """Nothing to close: the mapping ends with the last reference."""

    def _broken(self, got: str) -> PalpateError:
        must = f"The stack {self.path} must be bytes, or floats from 0 to 1, of shape (n, h, w, 3)"
        return PalpateError(must, got, "Save it with numpy.save")
