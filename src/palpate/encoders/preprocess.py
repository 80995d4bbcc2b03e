"""How an encoder prepares its images; part of the encoder's identity.

An image is turned, fitted to the encoder's shape (the center of it, or the whole of it between
black borders, or the whole of it squashed), and resized; for some encoders the sensor's image
without contact is subtracted first, and an earlier frame of the video follows in three further
channels. What results is 8-bit and may be cached. Then ``(x / 255 - mean) / std`` per channel.

The images that an encoder was trained on are known by these pixels: a digest is the first eight
bytes of their SHA-256. Names play no part, as two data sets may both have a ``0001.jpg``. 100,000
digests take 800 kB; that any of 100,000 other images has one of them by chance has the probability
100,000^2 / 2^64 = 5e-10.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file
from torch import Tensor

from palpate.core import (
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    digest_json,
    quiet,
    read_record,
    require,
    require_regular,
    short,
)
from palpate.data.images import (
    REFETCH,
    SUFFIXES,
    cached_images,
    file_stamp,
    image_stamp,
    in_threads,
    mapped_images,
    read_image,
)

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

SAVE_AGAIN, FETCH_AGAIN = "Save the encoders again", "Fetch the encoder again"
#: What an image processor may have of these.
CHOICES = {
    "fitting": ("crop", "pad", "squash"),
    "turn": ("none", "left", "portrait"),
    "resample": (3, 0, 1, 2, 4, 5),
}
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
#: A square before the crop is at most so many times what the encoder sees.
MOST_TIMES = 16
#: Digests of images, (n,) uint64.
Digests = NDArray[np.uint64]
#: Their file in the folder of an encoder.
SEEN = "seen.safetensors"
#: What an image is prepared from: itself, the sensor's no-contact image, an earlier frame.
Frame = tuple[Path | Image.Image, Path | None, Path | None]


class Frames(NamedTuple):
    """The files of samples, and the names of their sensors ('' if unknown)."""

    files: list[Frame]
    sensors: list[str]

    @classmethod
    def alone(cls, images: Sequence[Path | Image.Image]) -> Frames:
        """Images without further ones, of unknown sensors."""
        return cls([(image, None, None) for image in images], [""] * len(images))

    def stamps(self, root: Path) -> list[object]:
        """What changes with the no-contact images, the earlier frames and the sensors."""
        more = {path for _, *further in self.files for path in further if path is not None}
        stamp = {path: [os.path.relpath(path, root), *file_stamp(path)] for path in more}
        return [[[path and stamp[path] for path in more] for _, *more in self.files], self.sensors]


@dataclass(frozen=True)
class Preprocess:
    """How one encoder prepares its images, in training and in evaluation.

    Attributes:
        size: side of what the encoder sees, in pixels; its width if ``height`` is given.
        resize: side of the square before the center crop, in pixels (``size`` for CLIP).
        mean, std: per channel, of values in [0, 1].
        fitting: ``crop`` takes the center, ``pad`` the whole between black borders, ``squash`` the
            whole, whatever its aspect.
        resample: Pillow's number of the filter: 3 bicubic, 2 bilinear.
        turn: ``left`` turns by 90 degrees counterclockwise, ``portrait`` turns images that are
            wider than high clockwise.
        height: in pixels, of encoders that see no square.
        subtract: words in the names of sensors whose no-contact image is subtracted: 127 + image -
            no-contact image, cut to 0..255; ('',) is all sensors.
        lag: frames between the image and the earlier one whose channels follow; 0: none.
    """

    size: int
    resize: int
    mean: tuple[float, ...] = CLIP_MEAN
    std: tuple[float, ...] = CLIP_STD
    _: KW_ONLY
    fitting: Literal["crop", "pad", "squash"] = "crop"
    resample: int = 3
    turn: Literal["none", "left", "portrait"] = "none"
    height: int | None = None
    subtract: tuple[str, ...] = ()
    lag: int = 0

    @classmethod
    def from_config(cls, path: Path, size: int | None) -> Preprocess:
        """Read a ``preprocessor_config.json`` of transformers, in old or new spelling.

        Args:
            path: the file; CLIP's constants are the defaults of its entries.
            size: the encoder's image side, which the crop must agree with; None: any.

        Raises:
            PalpateError: if the crop has another size than the encoder, or an entry is malformed.
        """
        config = read_record(path, "image processor")
        try:
            crop = _side(config.get("crop_size"), size or 224)
            resize = _side(config.get("size"), crop)
            if (patches := config.get("max_num_patches")) is not None:  # SigLIP 2 of any aspect
                resize = crop = round(int(patches) ** 0.5) * int(config["patch_size"])
            mean, std = config.get("image_mean") or CLIP_MEAN, config.get("image_std") or CLIP_STD
            (r, g, b), (sr, sg, sb) = map(float, mean), map(float, std)
            squash = isinstance(config.get("size"), Mapping) and "height" in config["size"]
            squash = squash or patches is not None
            shape: dict[str, Any] = {"fitting": "squash" if squash else "crop", "turn": "none"}
            shape |= {"resample": 3 if config.get("resample") is None else config["resample"]}
            shape |= config.get("palpate") or {}
            bad = [f"{k} {shape[k]!r}" for k, choices in CHOICES.items() if shape[k] not in choices]
            bad += shape.keys() - CHOICES.keys()
            bad += [f"std {v}" for v in (sr, sg, sb) if not 1e-6 < v < math.inf]
            bad += [f"mean {v}" for v in (r, g, b) if not math.isfinite(v)]
            if bad:
                raise ValueError(", ".join(bad))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            must = f"Size, crop and statistics in {path} must be those of an image processor"
            raise PalpateError(must, str(error), SAVE_AGAIN) from None
        if not config.get("do_center_crop", "crop_size" in config or not squash):
            crop = resize
        side = size or crop
        fits = crop == side and 0 < side <= resize <= MOST_TIMES * side
        must, fix = f"{path} must give the encoder's {side} px", "Set size and crop_size to that"
        require(fits, None, must, f"{crop} px from {resize} px", fix=fix)
        if not config.get("do_normalize", True):
            (r, g, b), (sr, sg, sb) = (0.0,) * 3, (1.0,) * 3
        return cls(
            side,
            resize,
            (r, g, b),
            (sr, sg, sb),
            fitting=shape["fitting"],
            turn=shape["turn"],
            resample=shape["resample"],
        )

    def to_config(self) -> dict[str, Any]:
        """The same as a ``preprocessor_config.json`` for transformers' ``CLIPImageProcessor``."""
        return {
            "image_processor_type": "CLIPImageProcessor",
            "do_convert_rgb": True,
            "do_resize": True,
            "size": {"shortest_edge": self.resize},
            "resample": self.resample,
            "do_center_crop": True,
            "crop_size": {"height": self.size, "width": self.size},
            "do_rescale": True,
            "rescale_factor": 1 / 255,
            "do_normalize": True,
            "image_mean": list(self.mean),
            "image_std": list(self.std),
            "palpate": {name: getattr(self, name) for name in ("fitting", "turn")},
        }

    @property
    def plain(self) -> bool:
        """Whether the center square is all, as :func:`palpate.data.images.square` cuts it."""
        return replace(self, mean=CLIP_MEAN, std=CLIP_STD) == Preprocess(self.size, self.resize)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and channels of what :meth:`prepare` gives."""
        return self.height or self.resize, self.resize, 6 if self.lag else 3

    def prepare(
        self,
        image: Image.Image,
        background: Image.Image | None = None,
        previous: Image.Image | None = None,
    ) -> NDArray[np.uint8]:
        """One RGB image as 8-bit (height, width, channels).

        Args:
            image: the image.
            background: of the sensor without contact, to be subtracted.
            previous: the earlier frame; None takes the image twice where there must be one.
        """
        frames = [image, previous or image] if self.lag else [image]
        fitted = [self._fitted(_minus(frame, background)) for frame in frames]
        return np.concatenate(fitted, axis=2)

    def _fitted(self, image: Image.Image) -> NDArray[np.uint8]:
        if self.turn == "left" or (self.turn == "portrait" and image.width > image.height):
            left = self.turn == "left"
            turn = Image.Transpose.ROTATE_90 if left else Image.Transpose.ROTATE_270
            image = image.transpose(turn)
        (width, height), (rows, columns, _) = image.size, self.shape
        if self.fitting == "pad":
            side = max(width, height)
            canvas = Image.new("RGB", (side, side))
            canvas.paste(image, ((side - width) // 2, (side - height) // 2))
            image = canvas
        elif self.fitting == "crop":
            w = min(width, round(height * columns / rows))
            h = min(height, round(width * rows / columns))
            left, top = (width - w) // 2, (height - h) // 2
            image = image.crop((left, top, left + w, top + h))
        return np.asarray(image.resize((columns, rows), Image.Resampling(self.resample)))

    def fit(self, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Images (n, h, w, 3) as :meth:`prepare` gives them; those that are so stay."""
        if self.plain and images.shape[1:3] == self.shape[:2]:
            return images
        fitted = [self.prepare(Image.fromarray(image)) for image in images]
        return np.stack(fitted) if fitted else images.reshape(0, *self.shape)

    def frames(self, manifest: Manifest, column: str, *, still: bool = False) -> Frames:
        """The files that samples are prepared from; ``still`` takes no earlier frames.

        Raises:
            PalpateError: if a sample lacks its image, or the no-contact image of its sensor.
        """
        paths, names = manifest.paths(column), manifest.column("sensor")
        positions = list(zip(manifest.column("video"), manifest.column("frame"), strict=True))
        at = dict(zip(positions, paths, strict=True)) if self.lag and not still else {}
        sensors = [(name or "").lower() for name in names]
        fix = "Fill the column background: palpate background"
        files: list[Frame] = []
        for k, (path, gel) in enumerate(zip(paths, manifest.column("background"), strict=True)):
            need = column == "tactile" and any(word in sensors[k] for word in self.subtract)
            must = f"The encoder subtracts the no-contact image of {names[k] or 'every sensor'}"
            require(not need or gel is not None, None, must, f"none for {path.name}", fix=fix)
            video, frame = positions[k]
            before = None
            if video is not None and frame is not None:
                before = at.get((video, frame - self.lag))
            files.append((path, manifest.path(gel) if need and gel is not None else None, before))
        return Frames(files, sensors)

    def normalize(self, unit: Tensor) -> Tensor:
        """``(x - mean) / std`` for x in [0, 1], (b, channels, h, w)."""
        times = unit.shape[1] // len(self.mean)
        mean, std = (unit.new_tensor(v * times).view(1, -1, 1, 1) for v in (self.mean, self.std))
        return (unit - mean) / std

    def __call__(self, unit: Tensor) -> Tensor:
        """Center crop and normalization of prepared images in [0, 1], (b, channels, h, w)."""
        edge = 0 if self.height else (self.resize - self.size) // 2
        rows = self.height or self.size
        return self.normalize(unit[..., edge : edge + rows, edge : edge + self.size])


def load_frames(files: Sequence[Frame], preprocess: Preprocess) -> NDArray[np.uint8]:
    """Decode and prepare images: (n, height, width, channels), 0 to 255.

    Raises:
        ProblemsError: naming every unreadable file.
    """
    images = np.empty((len(files), *preprocess.shape), np.uint8)
    background = lru_cache(64)(read_image)  # many samples share one

    def decode(k: int) -> Problem | None:
        image, gel, before = files[k]
        file: object = image
        try:
            image = read_image(image) if isinstance(image, Path) else image
            empty = background(file := gel) if gel else None
            previous = read_image(file := before) if before else None
            images[k] = preprocess.prepare(image, empty, previous)
        except PalpateError as error:
            return Problem(str(file), "bad-image", error.got)
        return None

    problems = [problem for _, problem in in_threads(decode, range(len(files))) if problem]
    if problems:
        raise ProblemsError(sorted(problems, key=lambda p: p.where), REFETCH)
    return images


def prepared_images(
    manifest: Manifest,
    column: str,
    preprocess: Preprocess,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> NDArray[np.uint8]:
    """The prepared images of a manifest; with a cache they are made once and mapped afterwards.

    Returns:
        (n, height, width, channels), 0 to 255, in row order.

    Raises:
        PalpateError: if a row lacks an image, or the no-contact image of its sensor.
        ProblemsError: naming unreadable files.
    """
    if preprocess.plain:
        return cached_images(manifest, column, preprocess.resize, cache, progress)
    frames, shape = preprocess.frames(manifest, column), (len(manifest), *preprocess.shape)

    def fill(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
        for start in range(0, len(images), 256):
            rows = slice(start, start + 256)
            images[rows] = load_frames(frames.files[rows], preprocess)
            progress("preparing images", min(start + 256, len(images)), len(images))
        return images

    if cache is None:
        return fill(np.empty(shape, np.uint8))
    geometry = asdict(replace(preprocess, mean=CLIP_MEAN, std=CLIP_STD))
    key = digest_json([geometry, image_stamp(manifest, column), frames.stamps(manifest.root)])
    return mapped_images(Path(cache) / f"{column}-prepared-{short(key)}.npy", shape, fill)


def to_unit(
    images: NDArray[np.uint8], device: torch.device | str = "cpu", *, signed: bool = False
) -> Tensor:
    """8-bit images (b, h, w, c) as float32 (b, c, h, w) in [0, 1], or in [-1, 1] if ``signed``."""
    # np.array copies: a mapped cache is read-only, which torch warns about.
    pixels = torch.from_numpy(np.array(images)).to(device).permute(0, 3, 1, 2).float()
    return pixels / 127.5 - 1 if signed else pixels / 255


def _minus(image: Image.Image, background: Image.Image | None) -> Image.Image:
    """127 + image - background, cut to 0..255."""
    if background is None:
        return image
    if background.size != image.size:
        background = background.resize(image.size, Image.Resampling.BICUBIC)
    difference = np.asarray(image, np.int16) - np.asarray(background, np.int16) + 127
    return Image.fromarray(difference.clip(0, 255).astype(np.uint8))


def _side(value: Any, default: int) -> int:
    """A side in pixels from a number, ``{"shortest_edge": s}`` or ``{"height": s, "width": s}``."""
    if isinstance(value, Mapping):
        value = value.get("shortest_edge", value.get("height"))
    return default if value is None else int(value)


def list_images(inputs: Any) -> list[Path | Image.Image]:
    """Images in any form that :meth:`Encoder.encode` takes, as a list of files and PIL images.

    Raises:
        PalpateError: for arrays of another type or shape, a missing path, or other objects.
    """
    if isinstance(inputs, str | Path):
        path = Path(inputs)
        if not path.is_dir():
            return [path]
        files = (p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
        return [*sorted(files)]
    if isinstance(inputs, Image.Image):
        return [inputs.convert("RGB")]
    if hasattr(inputs, "shape"):
        return [Image.fromarray(image) for image in _bytes(inputs)]
    if isinstance(inputs, Sequence):
        return [image for entry in inputs for image in list_images(entry)]
    must, fix = "must be files, PIL images, arrays or tensors", "Pass e.g. a list of files"
    raise PalpateError(must, type(inputs).__name__, fix, argument="images")


def squares(images: Sequence[Path | Image.Image], size: int) -> NDArray[np.uint8]:
    """Decode images to center squares (n, size, size, 3)."""
    return load_frames(Frames.alone(images).files, Preprocess(size, size))


def _bytes(images: Any) -> NDArray[np.uint8]:
    """An array or tensor as uint8 (n, h, w, 3)."""
    array = np.asarray(images.detach().cpu() if hasattr(images, "detach") else images)
    shape = array.shape
    array = array[None] if array.ndim == 3 else array
    if hasattr(images, "detach") and array.ndim == 4 and array.shape[1] == 3:
        array = array.transpose(0, 2, 3, 1)
        if array.dtype.kind == "f" and array.size and array.min() >= 0 and array.max() <= 1:
            array = np.rint(array * 255).astype(np.uint8)
    rgb = array.ndim == 4 and array.shape[3] == 3 and array.dtype == np.uint8
    must = "must be uint8 (n, h, w, 3), or a tensor (n, 3, h, w) in [0, 1]"
    got = f"{array.dtype} of shape {shape}"
    require(rgb, "images", must, got, fix="Scale to 0..255 and round")
    return np.ascontiguousarray(array)


def digest_images(images: NDArray[np.uint8]) -> Digests:
    """Digests (n,) of images (n, h, w, c) in memory or in a mapped file, in their order."""
    names = (hashlib.sha256(image.tobytes()).digest()[:8] for image in images)
    return np.frombuffer(b"".join(names), np.uint64)


def union(*sets: Digests | None) -> Digests:
    """The sorted distinct digests of several sets; None is an empty one."""
    return np.unique(np.concatenate([np.empty(0, np.uint64), *(s for s in sets if s is not None)]))


def save_seen(seen: Digests | None, folder: Path) -> None:
    """Write the digests into the folder of an encoder; None writes nothing."""
    if seen is not None:
        save_file({"digests": seen}, folder / SEEN)


def load_seen(folder: Path, count: int | None) -> Digests | None:
    """Read what :func:`save_seen` wrote.

    Args:
        folder: of the encoder.
        count: how many there must be, by the card; None for a card without a count.

    Raises:
        PalpateError: if the file is missing, damaged, or holds another number.
    """
    if count is None:
        return None
    require_regular(folder / SEEN)
    must = f"{folder / SEEN} must hold the digests of the {count:,} images of the training"
    try:
        seen = load_file(folder / SEEN)["digests"]
    except (OSError, KeyError, SafetensorError) as error:
        raise PalpateError(must, str(error), FETCH_AGAIN) from None
    complete = len(seen) == count and seen.dtype == np.uint64
    require(complete, None, must, f"{len(seen):,}", fix=FETCH_AGAIN)
    return seen
