"""Frames of one modality of a recording: a folder, or a video or stack with a cache of images.

A cached frame is ``<cache>/%010d.jpg`` (quality 95, no chroma subsampling, since the color of a gel
carries the surface normal), written whole or not at all; its digest and name are a line of
``frames.sha256`` next to it. An interrupted run goes on with the frames that have theirs.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from threading import Event

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import digest_file, require_regular, save_image
from palpate.core.images import SUFFIXES
from palpate.data.contacts import SIZE, thumbnail
from palpate.data.images import VIDEOS, read_image
from palpate.data.manifest import DIGITS
from palpate.data.stacks import SUFFIX, StackReader
from palpate.data.tables import text_in
from palpate.data.video import VideoReader

#: Digests of the cached frames.
SEAL = "frames.sha256"
#: Files that hold many frames.
MOVING = (*VIDEOS, SUFFIX)

#: (n, 48, 64, 3) thumbnails and, of a video, (n,) seconds.
Stream = tuple[NDArray[np.uint8], NDArray[np.float64] | None]


def reader_of(source: Path) -> VideoReader | StackReader:
    """A reader of a video, or of a stack in a ``.npy`` file."""
    require_regular(source)
    return (StackReader if source.suffix.lower() == SUFFIX else VideoReader)(source)


def thumbnail_of(path: Path) -> NDArray[np.uint8]:
    """(48, 64, 3) of an image file."""
    return thumbnail(read_image(path, at_least=(2 * SIZE[0], 2 * SIZE[1])))


class FolderFrames:
    """Frames in a folder, named by their number (``0000000033.jpg``); other files are ignored.

    Attributes:
        source: the folder.
        numbers: the frames in it, in order; a folder may have gaps.
        duplicates: (name, name that is read) of further images of the same number.
    """

    def __init__(self, folder: Path) -> None:
        self.source = folder
        self.duplicates: list[tuple[str, str]] = []
        self._names: dict[int, str] = {}
        with os.scandir(folder) as entries:
            for entry in sorted(entries, key=lambda e: e.name):
                stem, suffix = Path(entry.name).stem, Path(entry.name).suffix
                if suffix.lower() not in SUFFIXES or not stem.isdecimal() or len(stem) > DIGITS:
                    continue
                first = self._names.setdefault(int(stem), entry.name)
                if first != entry.name:
                    self.duplicates.append((entry.name, first))
        self.numbers: Sequence[int] = sorted(self._names)

    def __len__(self) -> int:
        """Number of positions, gaps included."""
        return max(self._names, default=-1) + 1

    def has(self, k: int) -> bool:
        """Whether frame ``k`` is there."""
        return k in self._names

    def path(self, k: int) -> Path:
        """The file of frame ``k``."""
        return self.source / self._names[k]

    def read(self, indices: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield ``(k, (h, w, 3) image)``."""
        return ((k, np.asarray(read_image(self.path(k)))) for k in indices)

    def stream(self) -> Stream | None:
        """Thumbnails of all frames; None if numbers are missing."""
        if not self.numbers or self.numbers[-1] - self.numbers[0] >= len(self.numbers):
            return None
        return np.stack([thumbnail_of(self.path(k)) for k in self.numbers]), None


class VideoFrames:
    """Frames of a video or stack, cached as images in ``cache``; the methods of a folder."""

    duplicates: tuple[tuple[str, str], ...] = ()

    def __init__(self, source: Path, cache: Path, size: int | None) -> None:
        self.source, self.cache, self.size = source, cache, size
        self.turned = False  # whether the video turned the frames that were read
        with reader_of(source) as reader:
            self.numbers: Sequence[int] = range(len(reader))
            self.seconds: NDArray[np.float64] | None = reader.seconds

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.numbers)

    def has(self, k: int) -> bool:
        """Whether ``k`` lies within the video."""
        return k in self.numbers

    def path(self, k: int) -> Path:
        """Where frame ``k`` is cached, whether it is there already or not."""
        return self.cache / f"{k:010d}.jpg"

    def read(self, indices: Iterable[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield ``(k, (h, w, 3) image)``, decoding rising numbers in one pass."""
        with reader_of(self.source) as reader:
            yield from reader.frames(indices)
            self.turned |= reader.turned

    def stream(self) -> Stream:
        """Thumbnails of all frames, and when each is presented, in seconds."""
        with reader_of(self.source) as reader:
            return reader.thumbnails(), reader.seconds

    def extract(self, frames: set[int], created: list[Path], stop: Event) -> None:
        """Cache the frames that are not, or are damaged; new files are added to ``created``.

        Raises:
            PalpateError: if the video breaks off; earlier frames stay.
        """
        seal, line = self.cache / SEAL, lambda path: f"{digest_file(path)} {path.name}"
        sealed = set(text_in(seal).split("\n")) if seal.is_file() else set[str]()
        needed = {self.path(k): k for k in sorted(frames)}
        whole = lambda path: path.is_file() and line(path) in sealed
        missing = [k for path, k in needed.items() if not whole(path)]
        for k, image in self.read(missing) if missing else ():
            if stop.is_set():
                return
            path = self.path(k)
            created += [path] if seal.exists() else [path, seal]
            save_frame(path, image, self.size)
            with open(seal, "a", encoding="utf-8") as file:
                file.write(f"\n{line(path)}\n")  # a kill may have cut the line before


class TimedFrames(VideoFrames):
    """Frames of a video by the numbers of another, each the one that is nearest in time.

    Args:
        own: the video.
        nearest: (n,) its frame for each frame of the other; -1 where none is near.
    """

    def __init__(self, own: VideoFrames, nearest: NDArray[np.int64]) -> None:
        self.source, self.cache, self.size, self.nearest = own.source, own.cache, own.size, nearest
        self.numbers: Sequence[int] = np.flatnonzero(nearest >= 0).tolist()
        self.seconds = None

    def __len__(self) -> int:
        """Number of frames of the other."""
        return len(self.nearest)

    def has(self, k: int) -> bool:
        """Whether a frame is near frame ``k`` of the other."""
        return 0 <= k < len(self.nearest) and self.nearest[k] >= 0

    def path(self, k: int) -> Path:
        """Where the frame near frame ``k`` is cached."""
        return super().path(int(self.nearest[k]))

    def read(self, indices: Iterable[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield ``(k, (h, w, 3) image near it)`` of rising numbers."""
        pairs = [(k, int(self.nearest[k])) for k in indices]
        images = super().read(dict.fromkeys(own for _, own in pairs))
        number, image = next(images, (-1, None))
        for k, own in pairs:
            while number != own:
                number, image = next(images)
            assert image is not None
            yield k, image

    def stream(self) -> Stream:
        """Thumbnails of all frames that are near one; their seconds are no steps."""
        images, _ = super().stream()
        return images[np.maximum.accumulate(np.maximum(self.nearest, 0))], None


def nearest_in_time(
    times: NDArray[np.float64], others: NDArray[np.float64]
) -> tuple[NDArray[np.int64], float] | None:
    """For each of (n,) seconds the nearest of (m,) others, where equal numbers are other instants.

    Returns:
        (n,) the nearest, -1 where none is within half a step of the slower stream, and that half in
        seconds; None where rates and gaps are alike, so that frame k of both is one instant.
    """
    if min(len(times), len(others)) < 2:
        return None
    near = 0.505 * max(float(np.median(np.diff(t))) for t in (times, others))
    count = min(len(times), len(others))
    if np.abs(times[:count] - others[:count]).max() <= near:
        return None
    after = np.searchsorted(others, times).clip(1, len(others) - 1)
    before = times - others[after - 1] <= others[after] - times + 1e-6  # of two, the earlier
    nearest = after - before
    return np.where(np.abs(others[nearest] - times) <= near, nearest, -1), near


Frames = FolderFrames | VideoFrames


def streams_of(
    frames: Mapping[str, Frames],
) -> tuple[dict[str, NDArray[np.uint8]], dict[str, NDArray[np.float64]]]:
    """Thumbnails of each modality without gaps, and the seconds of those that are videos."""
    streams = {modality: source.stream() for modality, source in frames.items()}
    there = {modality: stream for modality, stream in streams.items() if stream is not None}
    seconds = {modality: times for modality, (_, times) in there.items() if times is not None}
    return {modality: images for modality, (images, _) in there.items()}, seconds


def save_frame(path: Path, image: NDArray[np.uint8], size: int | None) -> None:
    """Write (h, w, 3) atomically, with its shorter side reduced to ``size`` if it is longer."""
    frame = Image.fromarray(image)
    if size is not None and min(frame.size) > size:
        scale = size / min(frame.size)
        width, height = (max(size, round(side * scale)) for side in frame.size)
        frame = frame.resize((width, height), Image.Resampling.BICUBIC)
    save_image(path, frame, "JPEG", quality=95, subsampling=0)
