"""Images: read as 8-bit RGB, whole or rejected, one by one or as arrays.

Everything that Pillow reads becomes 8-bit RGB by fixed rules: EXIF orientation is applied; 16-bit
gray ``v`` becomes ``(v + 128) // 257``, so that 65535 is 255; transparency is laid over white; of
an animation the first image counts. A batch for a network is the center square, resized by Pillow's
antialiased bicubic filter. No step depends on the content of other images: the range is never
stretched.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import TYPE_CHECKING, BinaryIO, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from palpate.core import (
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    atomic_path,
    digest_file,
    digest_json,
    quiet,
    require,
    short,
)

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

Check = Literal["decode", "header", "none"]
SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")
_CUT = (struct.error, zlib.error, Image.DecompressionBombError)
#: What Pillow raises for files that are cut, empty, or no images.
BROKEN = (OSError, SyntaxError, ValueError, EOFError, IndexError, TypeError, *_CUT)
#: What to do about unreadable files that are not being imported now.
REFETCH = "Fetch these files again, or skip the bad ones with: palpate import"
#: Pixels of the largest image that is decoded: some twenty bytes each while it becomes RGB.
LARGEST = 50_000_000
T = TypeVar("T")
R = TypeVar("R")


def opened(source: Path | BinaryIO) -> Image.Image:
    """Open an image whose pixels fit into memory; they are not decoded yet.

    Raises:
        Image.DecompressionBombError: if there are more than ``LARGEST``.
        OSError: with most other broken files; see ``BROKEN``.
    """
    if isinstance(source, Path) and source.is_fifo():
        raise OSError("a pipe, which is no file")
    try:
        image = Image.open(source)
    except Image.DecompressionBombError:  # in Pillow's words
        raise Image.DecompressionBombError(f"more than {LARGEST:,} pixels") from None
    if image.width * image.height > LARGEST:
        size = f"{image.width} x {image.height} pixels"
        raise Image.DecompressionBombError(f"{size}, more than {LARGEST:,}")
    return image


def read_image(path: Path, at_least: tuple[int, int] | None = None) -> Image.Image:
    """Read one image file as 8-bit RGB.

    Args:
        path: the file.
        at_least: (width, height) that are enough; a large JPEG is decoded faster at a fraction.

    Raises:
        PalpateError: if the file is missing, empty, truncated, or no image.
    """
    path = Path(path)
    try:
        with opened(path) as image:
            if at_least is not None:
                image.draft("RGB", at_least)
            image.load()
            ImageOps.exif_transpose(image, in_place=True)
            return rgb(image)
    except BROKEN as error:
        must = f"The image {path} must be whole and readable"
        raise PalpateError(must, _reason(path, error), "Fetch the file again") from None


def check_image(path: Path, check: Check = "decode") -> str | None:
    """Return why an image file is unusable, or None.

    Args:
        path: the file.
        check: ``decode`` reads every byte (a JPEG at an eighth of its size, which detects
            truncation as well), ``header`` reads the first bytes only.
    """
    path = Path(path)
    try:
        form_of(path, check)
    except BROKEN as error:
        return _reason(path, error)
    return None


def form_of(source: Path | BinaryIO, check: Check) -> str:
    """What Pillow calls the form of an image that is usable; raises one of ``BROKEN`` if not."""
    with opened(source) as image:
        if check == "decode":
            image.draft("L", (max(1, image.width // 8), max(1, image.height // 8)))
            image.load()
        return str(image.format)


def load_images(
    paths: Sequence[Path],
    size: int,
    *,
    progress: Progress = quiet,
    into: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Load images as one array; a path that occurs twice is decoded once.

    Returns:
        (n, size, size, 3), 0 to 255: ``into``, or a new array.

    Raises:
        ProblemsError: naming every unreadable file.
    """
    images = np.empty((len(paths), size, size, 3), np.uint8) if into is None else into
    rows: dict[Path, list[int]] = {}
    for k, path in enumerate(paths):
        rows.setdefault(Path(path), []).append(k)

    def decode(path: Path) -> str | None:
        try:
            images[rows[path]] = square(read_image(path), size)
        except PalpateError as error:
            return error.got
        return None

    decoded = in_threads(decode, rows, "decoding images", progress)
    problems = [Problem(str(path), "bad-image", reason) for path, reason in decoded if reason]
    if problems:
        raise ProblemsError(sorted(problems, key=lambda p: p.where), REFETCH)
    return images


def cached_images(
    manifest: Manifest,
    column: str,
    size: int,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> NDArray[np.uint8]:
    """Load one image column of a manifest; with a cache, decode once and map the file afterwards.

    Args:
        manifest: the samples.
        column: ``vision``, ``tactile`` or ``background``.
        size: side of the squares, in pixels.
        cache: folder for ``<column>-<size>-<digest>.npy``; None keeps the array in memory. The
            digest covers paths, file sizes, modification times, ``size`` and ``column``, so a
            changed file is decoded again.
        progress: progress callback.

    Returns:
        (n, size, size, 3), 0 to 255, in row order; read-only if it is mapped.

    Raises:
        PalpateError: if a row has no such image.
        ProblemsError: naming every missing or unreadable file.
    """
    paths = manifest.paths(column)
    if cache is None:
        return load_images(paths, size, progress=progress)
    key = short(digest_json([2, size, image_stamp(manifest, column)]))

    def fill(images: NDArray[np.uint8]) -> None:
        load_images(paths, size, progress=progress, into=images)

    return mapped_images(
        Path(cache) / f"{column}-{size}-{key}.npy", (len(paths), size, size, 3), fill
    )


def mapped_images(
    file: Path, shape: tuple[int, ...], fill: Callable[[NDArray[np.uint8]], object]
) -> NDArray[np.uint8]:
    """Map an array of bytes read-only from its file; ``fill`` computes one that is not there."""
    with suppress(Exception):  # a damaged header is parsed as Python, and fails in many ways
        mapped = np.load(file, mmap_mode="r", allow_pickle=False)
        if mapped.shape == shape and mapped.dtype == np.uint8:
            return mapped
    with atomic_path(file) as part:
        images = np.lib.format.open_memmap(part, mode="w+", dtype=np.uint8, shape=shape)
        fill(images)
        images.flush()
        del images
    return np.load(file, mmap_mode="r", allow_pickle=False)


def image_stamp(manifest: Manifest, column: str) -> str:
    """Digest of the paths, file sizes and modification times of one image column.

    For keys of caches and checkpoints, which must not outlive the images they were made from.
    """
    paths = manifest.paths(column)
    stamps = {path: file_stamp(path) for path in dict.fromkeys(paths)}
    names = manifest.column(column)
    return digest_json([column, [[n, *stamps[p]] for n, p in zip(names, paths, strict=True)]])


def square(image: Image.Image, size: int) -> NDArray[np.uint8]:
    """The center square of an RGB image, resized: (size, size, 3), 0 to 255."""
    width, height = image.size
    side = min(width, height)
    left, top = (width - side) // 2, (height - side) // 2
    image = image.crop((left, top, left + side, top + side))
    return np.asarray(image.resize((size, size), Image.Resampling.BICUBIC))


def in_threads(
    function: Callable[[T], R],
    items: Collection[T],
    task: str = "",
    progress: Progress = quiet,
    *,
    threads: int | None = None,
    stop: Event | None = None,
) -> Iterator[tuple[T, R]]:
    """Yield ``(item, function(item))`` as they finish; few are in flight, so errors end it soon.

    Args:
        function: the work.
        items: what to work on.
        task: name of the work for ``progress``; work without a name is not reported.
        progress: progress callback.
        threads: how many; default: the number of cores, 16 at most.
        stop: set when the caller leaves early, for functions that run long and look at it.
    """
    require(threads is None or threads >= 1, "threads", "must be at least 1", threads)
    threads = threads or min(16, os.cpu_count() or 1)
    remaining = iter(items)
    report = progress if task else None
    if report:
        report(task, 0, len(items))
    running: dict[Future[R], T] = {}
    ended: SimpleQueue[Future[R]] = SimpleQueue()  # quicker than to wait for any of several
    with ThreadPoolExecutor(threads) as pool:

        def submit(count: int) -> None:
            for item in islice(remaining, count):
                future = pool.submit(function, item)
                running[future] = item
                future.add_done_callback(ended.put)

        try:
            submit(4 * threads)
            done = 0
            while running:
                future = ended.get()
                yield running.pop(future), future.result()
                done += 1
                if report:
                    report(task, done, len(items))
                submit(1)
        finally:
            if stop is not None:
                stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


def file_stamp(path: Path) -> tuple[int, int]:
    """Size in bytes and modification time in nanoseconds; (-1, -1) if the file is missing."""
    try:
        stat = path.stat()
    except OSError:
        return (-1, -1)
    return (stat.st_size, stat.st_mtime_ns)


def file_digest(path: Path) -> str | None:
    """SHA-256 of a file's bytes; None if it cannot be read, or is a pipe."""
    with suppress(OSError):
        if path.is_file():
            return digest_file(path)
    return None


def rgb(image: Image.Image) -> Image.Image:
    """8-bit RGB by the rules in the head of this file."""
    if image.mode == "RGB":
        return image
    if image.mode.startswith("I"):  # 16-bit gray; "I" is the same in 32-bit cells
        values = np.clip(np.asarray(image), 0, 65535).astype(np.int32)
        return Image.fromarray(((values + 128) // 257).astype(np.uint8)).convert("RGB")
    if image.mode == "F":
        raise ValueError("floating-point pixels, whose range is not defined")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB")
    return image.convert("RGB")


def _reason(path: Path, error: BaseException) -> str:
    """What Pillow raised, in plain words."""
    if not path.exists():
        return "no such file"
    if path.is_dir():
        return "a folder"
    if path.stat().st_size == 0:
        return "an empty file (0 bytes)"
    if isinstance(error, Image.UnidentifiedImageError):
        return "not an image"
    return str(error).replace(str(path), path.name) or type(error).__name__
