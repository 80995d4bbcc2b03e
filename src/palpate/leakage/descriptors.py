"""Pictures as thumbnails and as vectors to search by.

Each distinct file is decoded once, a JPEG at the smallest scale that libjpeg offers above 32 pixels (Pillow's ``draft``), and averaged to a
thumbnail of 32 x 32 pixels in YCbCr: 3 kB a picture. Modes become YCbCr by the rules of :mod:`palpate.data.images`. Files that are cut, empty or no
images are told, not raised: an audit goes on without them.

The search vector of a band-passed thumbnail x (``verify.band_pass``) joins two parts of equal length:

* the magnitudes of the windowed spectrum up to 4 cycles a side, |F(w x)|^(1/2): a shift changes only phases;
* G_2 x at every fourth pixel: where things are, blurred by more than a shift moves them.

Its neighbours are candidates; ``verify.similarities`` judges them.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from scipy import fft, ndimage

from palpate.core import PalpateError, Progress, atomic_path, digest_json, quiet, short, write_json
from palpate.core.files import read_json
from palpate.data.images import BROKEN, check_image, in_threads, read_image
from palpate.leakage.verify import BLOCK, SIDE, Floats, Ints

VERSION = 1
CHUNK = 64
#: Pictures below which starting processes costs more than it saves.
FEW = 2000
#: A JPEG is decoded at no less than this: libjpeg's own reduction aliases, and differently after a shift.
DRAFT = 48
#: Modes that need no rule of their own.
PLAIN = ("YCbCr", "RGB", "L")
_HIGHEST = 4
_HANN = np.hanning(SIDE + 2)[1:-1]
_WINDOW = np.outer(_HANN, _HANN).astype(np.float32)
_BLUR = ndimage.gaussian_filter1d(np.eye(SIDE), 2.0, axis=0, mode="nearest")[2::4].astype(np.float32)


@dataclass(frozen=True)
class Thumbnails:
    """Distinct pictures, decoded.

    Attributes:
        row: (n,) the thumbnail of each path that was given; -1 where it could not be read or there was none.
        pixels: (u, 32, 32, 3) YCbCr, 0 to 255; read-only if it is mapped from a cache.
        unreadable: path -> why.
    """

    row: Ints
    pixels: NDArray[np.uint8]
    unreadable: dict[str, str]


def thumbnail(path: Path) -> NDArray[np.uint8] | str:
    """One picture, (32, 32, 3) YCbCr; or why it cannot be read."""
    try:
        with Image.open(path) as image:
            image.draft("YCbCr", (DRAFT, DRAFT))
            image.load()
            if image.mode in PLAIN and not image.has_transparency_data:
                upright = ImageOps.exif_transpose(image) if image.info.get("exif") else image
                small = upright.resize((SIDE, SIDE), Image.Resampling.BILINEAR)
                return np.asarray(small if small.mode == "YCbCr" else small.convert("YCbCr"))
        return np.asarray(read_image(path).resize((SIDE, SIDE), Image.Resampling.BILINEAR).convert("YCbCr"))
    except PalpateError as error:
        return error.got
    except BROKEN as error:
        return check_image(path) or str(error) or type(error).__name__


def thumbnails(
    paths: Sequence[Path | None], *, cache: Path | None = None, processes: int | None = None, progress: Progress = quiet
) -> Thumbnails:
    """Decodes every distinct path once.

    Args:
        paths: (n,) files; None where a sample has no picture.
        cache: folder for ``thumbnails-<digest>.npy``; the digest covers paths, file sizes and modification times. None keeps them in memory.
        processes: that decode; None takes one a core.
        progress: told about files.

    Returns:
        The thumbnails, in the order in which the paths first occur, whatever the number of processes.
    """
    place: dict[Path, int] = {}
    for path in paths:
        if path is not None:
            place.setdefault(path, len(place))
    files = list(place)
    pixels, reasons = _load(files, cache, processes, progress)
    row = np.array([-1 if p is None or place[p] in reasons else place[p] for p in paths], np.int64)
    return Thumbnails(row, pixels, {str(files[k]): why for k, why in sorted(reasons.items())})


def _load(files: list[Path], cache: Path | None, processes: int | None, progress: Progress) -> tuple[NDArray[np.uint8], dict[int, str]]:
    """Thumbnails of different files, from the cache if they are there, and why some cannot be read."""
    shape = (len(files), SIDE, SIDE, 3)
    if cache is None or not files:
        pixels = np.zeros(shape, np.uint8)
        return pixels, _decode(files, pixels, processes, progress)
    target = Path(cache) / f"thumbnails-{short(digest_json([VERSION, [[str(f), *_stamp(f)] for f in files]]))}.npy"
    told = target.with_suffix(".json")
    try:
        pixels = np.load(target, mmap_mode="r", allow_pickle=False)
        reasons = {int(k): str(v) for k, v in read_json(told, "list of unreadable pictures").items()}
        if pixels.shape == shape and pixels.dtype == np.uint8:
            return pixels, reasons
    except (OSError, ValueError, EOFError, PalpateError, AttributeError):
        pass  # absent or damaged: decoded again
    with atomic_path(target) as part:
        pixels = np.lib.format.open_memmap(part, mode="w+", dtype=np.uint8, shape=shape)
        reasons = _decode(files, pixels, processes, progress)
        pixels.flush()
        del pixels
        write_json(told, {str(k): v for k, v in reasons.items()})
    return np.load(target, mmap_mode="r", allow_pickle=False), reasons


def _stamp(path: Path) -> tuple[int, int]:
    try:
        found = path.stat()
    except OSError:
        return (-1, -1)
    return (found.st_size, found.st_mtime_ns)


def _decode(files: list[Path], out: NDArray[np.uint8], processes: int | None, progress: Progress) -> dict[int, str]:
    """Fills ``out``; returns file number -> why, for files that cannot be read."""
    reasons: dict[int, str] = {}
    done = 0
    progress("decoding pictures", 0, len(files))
    chunks = [(start, files[start : start + CHUNK]) for start in range(0, len(files), CHUNK)]
    for start, (pixels, bad) in _chunks(chunks, processes or os.cpu_count() or 1, len(files)):
        out[start : start + len(pixels)] = pixels
        reasons.update({start + k: why for k, why in bad.items()})
        done += len(pixels)
        progress("decoding pictures", done, len(files))
    return reasons


Chunk = tuple[int, list[Path]]
Decoded = tuple[NDArray[np.uint8], dict[int, str]]


def _chunks(chunks: list[Chunk], processes: int, count: int) -> Iterator[tuple[int, Decoded]]:
    """Decodes chunks in processes if they are many, else in threads (Pillow lets go of the interpreter while it decodes)."""
    left = dict(chunks)
    if processes > 1 and count >= FEW:
        context = multiprocessing.get_context("spawn")  # a forked copy of a process with threads may hang
        try:
            with ProcessPoolExecutor(processes, context) as pool:
                try:
                    for (start, _), decoded in zip(chunks, _started(pool, [files for _, files in chunks]), strict=True):
                        del left[start]
                        yield start, decoded
                finally:
                    pool.shutdown(cancel_futures=True)
            return
        except BrokenProcessPool:
            pass  # called from a script without a main guard, or a worker was killed: the threads below take what is left
    for (start, _), decoded in in_threads(_decode_chunk_at, left.items(), processes):
        yield start, decoded


def _started(pool: ProcessPoolExecutor, chunks: list[list[Path]]) -> Iterator[Decoded]:
    """``pool.map``, whose processes start deaf to Ctrl-C: a terminal sends it to all, and each would print a traceback."""
    if threading.current_thread() is not threading.main_thread():  # only there can signals be set
        return pool.map(_decode_chunk, chunks)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return pool.map(_decode_chunk, chunks)
    finally:
        signal.signal(signal.SIGINT, before)


def _decode_chunk_at(chunk: Chunk) -> Decoded:
    return _decode_chunk(chunk[1])


def _decode_chunk(files: list[Path]) -> Decoded:
    pixels, reasons = np.zeros((len(files), SIDE, SIDE, 3), np.uint8), {}
    for k, path in enumerate(files):
        found = thumbnail(path)
        if isinstance(found, str):
            reasons[k] = found
        else:
            pixels[k] = found
    return pixels, reasons


def search_vectors(plates: NDArray[np.int8]) -> Floats:
    """Vectors whose nearest neighbours are candidates for near-duplicates.

    Args:
        plates: (n, 3, 32, 32) band-passed pictures of any scale.

    Returns:
        (n, 327), both parts of length 1; zeros where a picture is flat.
    """
    keep = _HIGHEST + 1
    out: list[Floats] = []
    for start in range(0, len(plates), BLOCK):
        x = plates[start : start + BLOCK].astype(np.float32)
        spectrum = np.asarray(fft.rfft2(x * _WINDOW), np.complex64)
        near = np.concatenate([spectrum[:, :, :keep, :keep], spectrum[:, :, -_HIGHEST:, :keep]], axis=2)
        out.append(np.hstack([_unit(np.sqrt(np.abs(near)).astype(np.float32)), _unit(np.asarray(_BLUR @ x @ _BLUR.T, np.float32))]))
    return np.concatenate(out) if out else np.zeros((0, 3 * (2 * _HIGHEST + 1) * keep + 192), np.float32)


def _unit(x: Floats) -> Floats:
    """Each picture's numbers as a row of length 1 (or 0)."""
    flat = x.reshape(len(x), -1)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), np.float32(1e-12))
