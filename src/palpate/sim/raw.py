"""Worlds as arrays: the fastest to read.

::

    vision.npy  tactile.npy  background.npy      uint8, (n, size, size, 3), C order: memory maps
    ids.txt                                      line k + 1 names row k
    manifest.parquet  splits/Orig.json  leak.csv  world.json

Row k of every array is row k of the manifest, so ``manifest.ids[k]`` tells what it is. Arrays are made whole before anything is rendered, so that a disk
that is too small is told at once (a memory map on a full disk would kill the process), and filled video by video.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate.core import PalpateError, atomic_path
from palpate.data.manifest import Manifest
from palpate.sim.options import WorldOptions
from palpate.sim.plan import VideoPlan, contact_frames
from palpate.sim.video import Video

ARRAYS = ("vision", "tactile", "background")


@dataclass(frozen=True)
class Arrays:
    """A raw world, opened.

    Attributes:
        manifest: its rows.
        vision, tactile, background: read-only memory maps, uint8 (n, size, size, 3), in the order of the manifest.
    """

    manifest: Manifest
    vision: np.ndarray
    tactile: np.ndarray
    background: np.ndarray


def open_arrays(folder: Path) -> Arrays:
    """Opens a world of ``layout="raw"``.

    Raises:
        PalpateError: if an array is missing, cut short, of another kind, or not as long as the manifest.
    """
    folder = Path(folder)
    manifest = Manifest.load(folder)
    found: dict[str, np.ndarray] = {}
    for name in ARRAYS:
        path, fix = folder / f"{name}.npy", "Write the world again: palpate world --layout raw"
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except FileNotFoundError:
            raise PalpateError(
                "A raw world must have vision.npy, tactile.npy and background.npy",
                f"no file {path}",
                fix,
            ) from None
        except (ValueError, EOFError) as error:
            raise PalpateError(
                f"{path} must be an array in NumPy's format", str(error), fix
            ) from None
        if (
            array.dtype != np.uint8
            or array.ndim != 4
            or len(array) != len(manifest)
            or array.shape[3] != 3
        ):
            got = f"{array.dtype} of shape {array.shape}"
            raise PalpateError(
                f"{path} must be uint8 of shape ({len(manifest)}, size, size, 3), as its manifest has rows",
                got,
                fix,
            )
        found[name] = array
    return Arrays(manifest, found["vision"], found["tactile"], found["background"])


def allocate_arrays(folder: Path, options: WorldOptions, rows: int) -> None:
    """Makes those arrays that are not there yet, filled with zeros, each whole or not at all.

    Raises:
        OSError: if the disk has no room.
    """
    for name in ARRAYS:
        path = folder / f"{name}.npy"
        if path.is_file():
            continue
        with atomic_path(path) as part:
            np.lib.format.open_memmap(
                part, "w+", np.uint8, (rows, options.size, options.size, 3)
            ).flush()
            with part.open("r+b") as file:
                _reserve(file.fileno(), part.stat().st_size)


def _reserve(file: int, size: int) -> None:
    """Takes the disk's space for a sparse file of zeros.

    Raises:
        OSError: if there is not enough.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
        return
    start = os.lseek(file, 0, os.SEEK_SET)
    head = os.read(file, 4096)
    os.lseek(file, start + len(head), os.SEEK_SET)
    left, zeros = size - len(head), bytes(1 << 20)
    while left > 0:
        left -= os.write(file, zeros[: min(left, len(zeros))])


def write_rows(folder: Path, options: WorldOptions, plan: VideoPlan, video: Video) -> None:
    """Renders the contact frames of one video into the arrays, and waits until they are on disk."""
    whole = {name: np.lib.format.open_memmap(folder / f"{name}.npy", "r+") for name in ARRAYS}
    at = plan.index * options.touches_per_video * options.frames_per_touch
    for touch in range(options.touches_per_video):
        background = video.background_of(touch)
        for frame in contact_frames(options, touch):
            whole["vision"][at], whole["tactile"][at], whole["background"][at] = (
                video.vision(frame),
                video.tactile(frame),
                background,
            )
            at += 1
    for array in whole.values():
        array.flush()
