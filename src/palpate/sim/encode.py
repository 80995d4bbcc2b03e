"""Frames to files: JPEG (quality 95, 4:4:4) or H.264 at 30 frames a second."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from palpate.core import MissingExtraError

FPS = 30


def require_av() -> None:
    """Checks that videos can be written.

    Raises:
        MissingExtraError: if PyAV is not installed.
    """
    if importlib.util.find_spec("av") is None:
        raise MissingExtraError("av", "video", "Writing a world as videos")


def write_jpeg(path: Path, image: np.ndarray) -> None:
    """Writes a uint8 image of shape (h, w, 3)."""
    Image.fromarray(image).save(path, "JPEG", quality=95, subsampling=0)


def write_png(path: Path, image: np.ndarray) -> None:
    """Writes a uint8 image of shape (h, w, 3), without loss."""
    Image.fromarray(image).save(path, "PNG")


def write_mp4(path: Path, images: Iterable[np.ndarray], size: int) -> None:
    """Writes uint8 images of shape (size, size, 3) as H.264 (constant rate factor 18), so that bytes repeat.

    One thread; x264 without the code whose rounding depends on the processor; and frames converted before they reach the encoder, since those that
    it converts itself make its decisions differ from run to run.

    Raises:
        MissingExtraError: if PyAV is not installed.
    """
    require_av()
    import av

    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream(
            "libx264",
            rate=FPS,
            options={"crf": "18", "preset": "veryfast", "x264-params": "cpu-independent=1"},
        )
        stream.width = stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.thread_count = 1
        stream.time_base = Fraction(1, FPS)
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
