"""Pictures as thumbnails and as vectors to search by.

Each distinct file is decoded once, a JPEG at the smallest scale that libjpeg offers above 48 pixels (Pillow's ``draft``), and averaged to a
thumbnail of 32 x 32 pixels in YCbCr: 3 kB a picture. Equal thumbnails are kept once, so millions of files of one frame need no memory. Modes become YCbCr by
the rules of :mod:`palpate.data.images`. Files that are cut, empty or no images are told, not raised: an audit goes on without them.

With a cache, thumbnails are written in pieces of 1,024 files as they come, so that a run that was stopped goes on where it was.

The search vector of a band-passed thumbnail x (``verify.band_pass``) joins two parts of equal length:

* the magnitudes of the windowed spectrum up to 4 cycles a side, |F(w x)|^(1/2): a shift changes only phases;
* G_2 x at every fourth pixel: where things are, blurred by more than a shift moves them.

Its neighbors are candidates; ``verify.similarities`` judges them.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import signal
import threading
import zipfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from scipy import fft, ndimage

from palpate.core import PalpateError, Progress, atomic_path, digest_json, quiet, short
from palpate.core.processes import follow_parent
from palpate.data.images import BROKEN, check_image, file_stamp, in_threads, read_image
from palpate.leakage.verify import BLOCK, SIDE, Floats, Ints

VERSION = 2
#: Files that a process decodes at a time, and files of one cached piece.
CHUNK, PIECE = 64, 1024
#: Pictures below which starting processes costs more than it saves.
FEW = 2000
#: A JPEG is decoded at no less than this: libjpeg's own reduction aliases, and differently after a shift.
DRAFT = 48
#: Modes that need no rule of their own.
PLAIN = ("YCbCr", "RGB", "L")
_HIGHEST = 4
_HANN = np.hanning(SIDE + 2)[1:-1]
_WINDOW = np.outer(_HANN, _HANN).astype(np.float32)
_BLUR = ndimage.gaussian_filter1d(np.eye(SIDE), 2.0, axis=0, mode="nearest")[2::4].astype(
    np.float32
)


@dataclass(frozen=True)
class Thumbnails:
    """Different pictures, decoded.

    Attributes:
        row: (n,) the thumbnail of each path that was given; -1 where it could not be read or there was none. Files that look the same share one.
        pixels: (u, 32, 32, 3) YCbCr, 0 to 255, all different.
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
        return np.asarray(
            read_image(path).resize((SIDE, SIDE), Image.Resampling.BILINEAR).convert("YCbCr")
        )
    except PalpateError as error:
        return error.got
    except BROKEN as error:
        return check_image(path) or str(error) or type(error).__name__


def thumbnails(
    paths: Sequence[Path | None],
    *,
    cache: Path | None = None,
    processes: int | None = None,
    progress: Progress = quiet,
) -> Thumbnails:
    """Decodes every distinct path once.

    Args:
        paths: (n,) files; None where a sample has no picture.
        cache: folder for ``thumbnails-<digest>.npz``, a piece of the sorted files each; the digest covers paths, file sizes and modification times, so
            another split of the same files finds them. None keeps nothing.
        processes: that decode; None takes one a core.
        progress: told about files.

    Returns:
        The thumbnails, in the order of the sorted paths, whatever the number of processes.
    """
    files = sorted({path for path in paths if path is not None})
    place = {path: k for k, path in enumerate(files)}
    pixels, found, reasons = _load(
        files, None if cache is None else Path(cache), processes, progress
    )
    row = np.array([-1 if path is None else found[place[path]] for path in paths], np.int64)
    return Thumbnails(row, pixels, {str(files[k]): why for k, why in sorted(reasons.items())})


def _load(
    files: list[Path], cache: Path | None, processes: int | None, progress: Progress
) -> tuple[NDArray[np.uint8], Ints, dict[int, str]]:
    """Different thumbnails of files, the row of each file among them (-1 where it cannot be read), and why some cannot."""
    pieces = [files[start : start + PIECE] for start in range(0, len(files), PIECE)]
    stored = [
        None if cache is None else cache / f"thumbnails-{_key(piece)}.npz" for piece in pieces
    ]
    ready = {
        k: path
        for k, path in enumerate(stored)
        if path is not None and _read(path, len(pieces[k])) is not None
    }
    progress("decoding pictures", 0, len(files))
    fresh = _decode(
        [(k, piece) for k, piece in enumerate(pieces) if k not in ready], stored, processes
    )
    kept, row, reasons = _Different(len(files)), np.full(len(files), -1, np.int64), dict[int, str]()
    done = 0
    early: dict[int, Decoded] = {}
    for k, piece in enumerate(
        pieces
    ):  # in order, so that rows do not depend on what was cached or came first
        while k not in ready and k not in early:
            early.update([next(fresh)])
        decoded = early.pop(k) if k in early else _read(ready[k], len(piece))
        assert decoded is not None
        pixels, bad = decoded
        for j in range(len(piece)):
            if j in bad:
                reasons[k * PIECE + j] = bad[j]
            else:
                row[k * PIECE + j] = kept.add(pixels[j])
        done += len(piece)
        progress("decoding pictures", done, len(files))
    return kept.pixels(), row, reasons


class _Different:
    """Thumbnails that differ, in the order in which they first come."""

    def __init__(self, most: int) -> None:
        self._rows: dict[bytes, int] = {}
        self._pixels = np.empty((min(most, PIECE), SIDE, SIDE, 3), np.uint8)

    def add(self, picture: NDArray[np.uint8]) -> int:
        """The row of a thumbnail."""
        digest = hashlib.blake2b(picture.tobytes(), digest_size=16).digest()
        row = self._rows.setdefault(digest, len(self._rows))
        if row == len(self._pixels):
            # realloc moves pages instead of copying them, so growing never holds the array twice
            self._pixels.resize((2 * row, SIDE, SIDE, 3), refcheck=False)
        self._pixels[row] = picture
        return row

    def pixels(self) -> NDArray[np.uint8]:
        """(u, 32, 32, 3)."""
        self._pixels.resize((len(self._rows), SIDE, SIDE, 3), refcheck=False)
        return self._pixels


def _key(files: list[Path]) -> str:
    """Changes with the paths, sizes and times of a piece's files."""
    return short(digest_json([VERSION, [[str(f), *file_stamp(f)] for f in files]]))


def _read(path: Path, count: int) -> Decoded | None:
    """A piece from the cache; None if it is absent or damaged, to be decoded again."""
    try:
        with np.load(path, allow_pickle=False) as found:
            pixels, bad, why = found["pixels"], found["bad"], found["why"]
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        return None
    if pixels.shape != (count, SIDE, SIDE, 3) or pixels.dtype != np.uint8:
        return None
    return pixels, {int(k): str(text) for k, text in zip(bad, why, strict=True)}


def _decode(
    pieces: list[tuple[int, list[Path]]], stored: list[Path | None], processes: int | None
) -> Iterator[tuple[int, Decoded]]:
    """Decodes pieces, writing each to its place in the cache when it is whole; yields (piece, thumbnails and what cannot be read)."""
    chunks = [
        ((k, start), files[start : start + CHUNK])
        for k, files in pieces
        for start in range(0, len(files), CHUNK)
    ]
    size = {k: len(files) for k, files in pieces}
    partial: dict[int, Decoded] = {}
    left = dict(size)
    for (k, start), (pixels, bad) in _chunks(
        chunks, processes or os.cpu_count() or 1, sum(size.values())
    ):
        whole, reasons = partial.setdefault(k, (np.zeros((size[k], SIDE, SIDE, 3), np.uint8), {}))
        whole[start : start + len(pixels)] = pixels
        reasons.update({start + j: why for j, why in bad.items()})
        left[k] -= len(pixels)
        if not left[k]:
            decoded = partial.pop(k)
            if (path := stored[k]) is not None:
                with atomic_path(path) as part, open(part, "wb") as file:
                    np.savez(
                        file,
                        pixels=decoded[0],
                        bad=np.array(list(decoded[1]), np.int64),
                        why=np.array(list(decoded[1].values()), str),
                    )
            yield k, decoded


Place = tuple[int, int]
Chunk = tuple[Place, list[Path]]
Decoded = tuple[NDArray[np.uint8], dict[int, str]]


def _chunks(chunks: list[Chunk], processes: int, count: int) -> Iterator[tuple[Place, Decoded]]:
    """Decodes chunks in processes if they are many, else in threads (Pillow lets go of the interpreter while it decodes)."""
    left = dict(chunks)
    if processes > 1 and count >= FEW:
        context = multiprocessing.get_context(
            "spawn"
        )  # a forked copy of a process with threads may hang
        try:
            with ProcessPoolExecutor(processes, context, initializer=follow_parent) as pool:
                try:
                    for (place, _), decoded in zip(
                        chunks, _started(pool, [files for _, files in chunks]), strict=True
                    ):
                        del left[place]
                        yield place, decoded
                finally:
                    pool.shutdown(cancel_futures=True)
            return
        except BrokenProcessPool:
            pass  # called from a script without a main guard, or a worker was killed: the threads below take what is left
    for (place, _), decoded in in_threads(_decode_chunk_at, left.items(), threads=processes):
        yield place, decoded


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
    """Vectors whose nearest neighbors are candidates for near-duplicates.

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
        near = np.concatenate(
            [spectrum[:, :, :keep, :keep], spectrum[:, :, -_HIGHEST:, :keep]], axis=2
        )
        out.append(
            np.hstack(
                [
                    _unit(np.sqrt(np.abs(near)).astype(np.float32)),
                    _unit(np.asarray(_BLUR @ x @ _BLUR.T, np.float32)),
                ]
            )
        )
    return (
        np.concatenate(out)
        if out
        else np.zeros((0, 3 * (2 * _HIGHEST + 1) * keep + 192), np.float32)
    )


def _unit(x: Floats) -> Floats:
    """Each picture's numbers as a row of length 1 (or 0)."""
    flat = x.reshape(len(x), -1)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), np.float32(1e-12))
