"""One side of a recording, as a folder of numbered pictures or as a video whose needed frames are cached as pictures.

Both answer the same questions: how long is it, is frame ``k`` there, and in which file does it lie. A cached frame is
``<cache>/%010d.jpg`` (quality 95, no chroma subsampling, since a gel's color carries the surface normal) or ``.png``,
written whole or not at all, so an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import PalpateError, atomic_path, inside
from palpate.data.images import SUFFIXES, read_image
from palpate.data.video import VideoReader

ImageFormat = Literal["jpg", "png"]
IMAGE_FORMATS: tuple[str, ...] = ("jpg", "png")
QUALITY = 95
#: A manifest's frames have 64 bits, so a longer number is none.
DIGITS = 18


class Frames(Protocol):
    """One side of a recording."""

    source: Path
    raw: bool

    def __len__(self) -> int:
        """Number of positions; a folder may have holes."""
        ...

    @property
    def numbers(self) -> Sequence[int]:
        """The frames that can be had, in order."""
        ...

    def has(self, k: int) -> bool:
        """Whether frame ``k`` can be had."""
        ...

    def path(self, k: int) -> Path:
        """The picture file of frame ``k``; a cached one may not be written yet."""
        ...


class FolderFrames:
    """Frames in a folder, named by their number (``0000000033.jpg``); other files are ignored.

    ``leaving`` holds the frames that are links to files outside ``root``; they do not count as there. Of several pictures of one number
    the first by name is read; ``doubled`` holds the others as (name, name that is read).
    """

    raw = False

    def __init__(self, folder: Path, root: Path) -> None:
        self.source = folder
        self.leaving: set[int] = set()
        self._names: dict[int, str] = {}
        self.doubled: list[tuple[str, str]] = []
        with os.scandir(folder) as entries:
            for entry in sorted(entries, key=lambda e: e.name):
                stem, suffix = os.path.splitext(entry.name)  # noqa: PTH122 (a data set has hundreds of thousands of these)
                if not stem.isdecimal() or len(stem) > DIGITS or suffix.lower() not in SUFFIXES:
                    continue
                if (before := self._names.setdefault(int(stem), entry.name)) != entry.name:
                    self.doubled.append((entry.name, before))
                elif entry.is_symlink() and inside(root, os.path.relpath(entry.path, root)) is None:
                    self.leaving.add(int(stem))
        self.numbers: Sequence[int] = sorted(k for k in self._names if k not in self.leaving)

    def __len__(self) -> int:
        return max(self._names, default=-1) + 1

    def has(self, k: int) -> bool:
        """Whether there is a file for frame ``k`` inside the root."""
        return k in self._names and k not in self.leaving

    def path(self, k: int) -> Path:
        """The file of frame ``k``."""
        return self.source / self._names[k]


class VideoFrames:
    """Frames of a video file, cached as pictures in ``cache``.

    Raises:
        PalpateError: if the video is cut short or unreadable.
    """

    raw = True

    def __init__(self, source: Path, cache: Path, suffix: ImageFormat, size: int | None) -> None:
        self.source, self.cache, self.suffix, self.size = source, cache, suffix, size
        with VideoReader(source) as reader:
            self.numbers: Sequence[int] = range(len(reader))

    def __len__(self) -> int:
        return len(self.numbers)

    def has(self, k: int) -> bool:
        """Whether ``k`` lies within the video."""
        return k in self.numbers

    def path(self, k: int) -> Path:
        """Where frame ``k`` is cached."""
        return self.cache / f"{k:010d}.{self.suffix}"

    def decode(self, wanted: set[int], decoded: set[int], stop: Event) -> None:
        """Decodes the wanted frames without keeping them, and enters the whole ones into ``decoded``.

        Raises:
            PalpateError: if the video breaks off.
        """
        with VideoReader(self.source) as reader:
            for k, _ in reader.frames(sorted(wanted)):
                if stop.is_set():
                    return
                decoded.add(k)

    def extract(self, wanted: set[int], created: list[Path], stop: Event) -> None:
        """Decodes the wanted frames that are not cached yet, in one pass, and enters the new files into ``created``.

        Raises:
            PalpateError: if the video breaks off; what came before stays.
        """
        missing = [k for k in sorted(wanted) if not self.path(k).is_file()]
        if not missing:
            return
        with VideoReader(self.source) as reader:
            for k, picture in reader.frames(missing):
                if stop.is_set():
                    return
                created.append(self.path(k))
                save_picture(self.path(k), picture, self.size)


def save_picture(path: Path, picture: NDArray[np.uint8], size: int | None) -> None:
    """Writes (h, w, 3) atomically, in the format of the suffix, its shorter side reduced to ``size`` if it is longer."""
    image = Image.fromarray(picture)
    if size is not None and min(image.size) > size:
        scale = size / min(image.size)
        image = image.resize(
            (max(size, round(image.width * scale)), max(size, round(image.height * scale))),
            Image.Resampling.BICUBIC,
        )
    with atomic_path(path) as part:
        if path.suffix == ".png":
            image.save(part, format="PNG")
        else:
            image.save(part, format="JPEG", quality=QUALITY, subsampling=0)


def nearest_to_median(frames: Frames, indices: Sequence[int]) -> tuple[int, NDArray[np.uint8]]:
    """Of some frames the one nearest to their median (pixel by pixel) in mean absolute difference; the first if several are.

    Returns:
        Its number and its picture, (h, w, 3), 0 to 255.

    Raises:
        PalpateError: if a frame is unreadable, or the frames differ in size.
    """
    order = sorted(indices)
    if frames.raw:
        with VideoReader(frames.source) as reader:
            pictures = [picture for _, picture in reader.frames(order)]
    else:
        pictures = [np.asarray(read_image(frames.path(k))) for k in order]
    if len({p.shape for p in pictures}) > 1:
        raise PalpateError(
            f"The frames in {frames.source} must have one size",
            "several",
            "Extract them again from the video",
        )
    stack = np.stack(pictures)
    median = np.median(stack, axis=0).astype(np.float32)
    best = int(np.argmin([np.abs(p - median).mean() for p in stack]))
    return order[best], pictures[best]
