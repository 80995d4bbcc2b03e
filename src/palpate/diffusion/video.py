"""Videos in and out: frames as images that lose nothing, and images as an MP4."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from palpate.core import Progress, atomic_path
from palpate.data.images import square
from palpate.data.video import VideoReader


def save_frames(
    video: Path, folder: Path, size: int, progress: Progress
) -> tuple[dict[str, Path], float]:
    """Write all frames of a video, ``size`` pixels square, as PNGs.

    Returns:
        number of the frame -> file; frames a second.

    Raises:
        MissingExtraError: if PyAV is not installed.
        PalpateError: if the video is not whole.
    """
    with VideoReader(video) as reader:
        frames = {f"{k:06d}": folder / f"{k:06d}.png" for k in range(len(reader))}
        for k, path in enumerate(frames.values()):
            Image.fromarray(square(Image.fromarray(reader[k]), size)).save(path)
            progress("reading frames", k + 1, len(frames))
        steps = np.diff(reader.seconds)
    return frames, float(1 / steps.mean()) if len(steps) else 1.0


def write_video(path: Path, images: list[Image.Image], rate: float) -> None:
    """Write images of one size as an MP4 of ``rate`` frames a second; sides are made even."""
    import av

    width, height = (side + side % 2 for side in images[0].size)
    with atomic_path(path) as part, av.open(str(part), "w", format="mp4") as container:
        stream: Any = container.add_stream("libx264", Fraction(rate).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "12"}
        for image in images:
            frame = av.VideoFrame.from_image(image.resize((width, height)))
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
