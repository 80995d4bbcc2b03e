"""Images, videos and folders of them: random ones, and some that carry their own number."""

import csv
import io
from collections.abc import Sequence
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


def write_images(root: Path, names: Sequence[str], start: int = 1) -> None:
    for k, name in enumerate(names, start):
        write_image(root / name, k)


def encoded(image: Image.Image, suffix: str) -> bytes:
    stream = io.BytesIO()
    image.save(stream, {".png": "PNG", ".jpg": "JPEG"}[suffix])
    return stream.getvalue()


#: (width, height) of a tactile image, upright as a DIGIT's; and of a photo.
TACTILE, PHOTO = (48, 64), (64, 48)


def gel(
    seed: int, size: tuple[int, int] = TACTILE, rig: int = 0, pressed: bool = True
) -> Image.Image:
    """A gel's shading, similar within a rig, with a round print somewhere if it is pressed."""
    width, height = size
    y, x = np.mgrid[:height, :width] / height
    image = np.stack([0.25 + 0.2 * y, 0.3 + 0.1 * x + 0.05 * rig, 0.5 - 0.2 * y], axis=2)
    if pressed:
        cx, cy = np.random.default_rng([1, seed]).uniform(0.25, 0.55, 2)
        image += 0.15 * (((x - cx) ** 2 + (y - cy) ** 2) < 0.02)[:, :, None]
    return Image.fromarray((255 * image.clip(0, 1)).astype(np.uint8))


def photo(seed: int, size: tuple[int, int] = PHOTO) -> Image.Image:
    """Coarse patches of any color."""
    small = np.random.default_rng([2, seed]).integers(0, 256, (4, 4, 3)).astype(np.uint8)
    return Image.fromarray(small).resize(size, Image.Resampling.BICUBIC)


def put(path: Path, image: Image.Image) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, quality=90)
    return path


def write_csv(path: Path, columns: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([*([columns] if columns else []), *rows])


def paint(folder: Path, names, seed: int, suffix=".png", side=32, low=90, high=160):
    """Random images, one file a name; returns their arrays by name."""
    rng = np.random.default_rng(seed)
    images = {}
    for name in names:
        images[name] = rng.integers(low, high, (side, side, 3)).astype(np.uint8)
        put(folder / f"{name}{suffix}", Image.fromarray(images[name]))
    return images


def write_photos(folder: Path, n: int, *size: int) -> list[Path]:
    """So many random photos, `0.png` and so on, of a side or of a height and a width."""
    height, width = (*size, *size)[:2] if size else (20, 24)
    images = np.random.default_rng(0).integers(0, 256, (n, height, width, 3), dtype=np.uint8)
    return [put(folder / f"{k}.png", Image.fromarray(image)) for k, image in enumerate(images)]


def photos(n: int, size: int = 16) -> np.ndarray:
    """Random images (n, size, size, 3)."""
    return np.random.default_rng(0).integers(0, 256, (n, size, size, 3), dtype=np.uint8)


def slow_ssim(x, y, data_range=1.0):
    """SSIM and its contrast-structure of two (h, w), window by window inside them."""
    at = np.arange(11) - 5
    window = np.exp(-(at[:, None] ** 2 + at[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    similarity, structure = np.empty((2, x.shape[0] - 10, x.shape[1] - 10))
    for i, j in np.ndindex(similarity.shape):
        u, v = (w[i : i + 11, j : j + 11] for w in (x, y))
        mu, mv = (window * u).sum(), (window * v).sum()
        vu, vv = (window * (u - mu) ** 2).sum(), (window * (v - mv) ** 2).sum()
        uv = (window * (u - mu) * (v - mv)).sum()
        luminance = (2 * mu * mv + c1) / (mu**2 + mv**2 + c1)
        structure[i, j] = (2 * uv + c2) / (vu + vv + c2)
        negative = luminance < 0 and structure[i, j] < 0
        similarity[i, j] = (-luminance if negative else luminance) * structure[i, j]
    return similarity, structure
