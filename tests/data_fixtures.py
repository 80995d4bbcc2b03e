"""Images, videos and folders of frames that carry their own number."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

SIZE = 64


def picture(k: int, size: int = SIZE) -> np.ndarray:
    """Eight vertical bars: the bits of ``k``, least first. Survives any lossy codec."""
    out = np.zeros((size, size, 3), np.uint8)
    for bit in range(8):
        if k >> bit & 1:
            out[:, bit * size // 8 : (bit + 1) * size // 8] = 230
    return out


def number(array: np.ndarray) -> int:
    """The number drawn by :func:`picture`."""
    bars = np.split(array, 8, axis=1)
    return sum(1 << bit for bit, bar in enumerate(bars) if bar[:, 2:-2].mean() > 115)


def write_video(
    path: Path,
    count: int,
    *,
    start: int = 0,
    codec: str = "libx264",
    gop: int = 12,
    b_frames: int = 3,
    options=None,
) -> Path:
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(
        str(path), "w", options={"movflags": "faststart"} if path.suffix == ".mp4" else {}
    ) as out:
        stream = out.add_stream(codec, rate=30)
        stream.width = stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        stream.codec_context.gop_size = gop
        stream.codec_context.max_b_frames = b_frames
        stream.options = options or {}
        for k in range(count):
            frame = av.VideoFrame.from_ndarray(picture(k), format="rgb24")
            frame.pts = k + start
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    return path


def write_image(path: Path, k: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(k)).save(path, quality=92)
    return path


def write_frames(folder: Path, count: int) -> None:
    for k in range(count):
        write_image(folder / f"{k:010d}.jpg", k)


def tree(folder: Path) -> set[str]:
    """All files and folders below ``folder``."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*")}


@dataclass(frozen=True)
class Tree:
    """A small data set, all of it below the folder that its maker was given.

    Attributes:
        source: what a user would name: a folder or a table.
        samples: how many samples an import must give.
        options: options of the import that it needs; paths below the folder follow a copied tree.
        remove: removes what one sample needs, given the source; default: deletes the tactile image
            of the last sample.
        cut: damages it instead; default: cuts that file in half.
    """

    source: Path
    samples: int
    options: Mapping[str, object] = field(default_factory=dict)
    remove: Callable[[Path], None] | None = None
    cut: Callable[[Path], None] | None = None
