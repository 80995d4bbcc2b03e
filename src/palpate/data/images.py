"""Images: read as 8-bit RGB, whole or rejected, one by one or as arrays.

:mod:`palpate.core.images` has the one function that opens images, and the rules by which all of
them become upright 8-bit RGB. A batch for a network is the center square, resized by Pillow's
antialiased bicubic filter, or what a :class:`Preprocess` says: an image is turned, fitted to the
encoder's shape (the center of it, the whole of it between black borders, or squashed), and resized;
for some encoders the sensor's image without contact is subtracted first, and an earlier frame of
the video follows in three further channels. What results is 8-bit and may be cached; then comes
``(x / 255 - mean) / std`` per channel. No step depends on the content of other images.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import KW_ONLY, asdict, dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, BinaryIO, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import (
    ImageError,
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    cached,
    decoded,
    digest_file,
    digest_json,
    open_image,
    quiet,
    read_record,
    require,
    short,
)
from palpate.core.images import ORIENTATION, SUFFIXES

if TYPE_CHECKING:
    from torch import Tensor

    from palpate.data.manifest import Manifest

Check = Literal["decode", "header", "none"]
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")
#: What to do about unreadable files that are not being imported now.
REFETCH = "Fetch these files again, or skip the bad ones with: palpate import"
#: What an image processor may have of these.
CHOICES = {
    "fitting": ("crop", "pad", "squash"),
    "turn": ("none", "left", "portrait"),
    "resample": (3, 0, 1, 2, 4, 5),
}
#: (width, height) of what a check keeps of an image.
SMALL = (16, 12)
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
#: A square before the crop is at most so many times what the encoder sees.
MOST_TIMES = 16
SAVE_AGAIN = "Save the encoders again"
#: What an image is prepared from: itself, the sensor's no-contact image, an earlier frame.
Frame = tuple[Path | Image.Image, Path | Image.Image | None, Path | None]
#: Files -> decoded images (s, s, 3), see :func:`decoded_once`.
KEPT: ContextVar[Mapping[Any, NDArray[np.uint8]]] = ContextVar("KEPT", default=MappingProxyType({}))
T = TypeVar("T")
R = TypeVar("R")


class Checked(NamedTuple):
    """What a check of an image says."""

    form: str = ""  # Pillow's name of it
    taken: Sequence[str] = ()  # how it is read where it is not upright 8-bit RGB, in words
    problem: str | None = None  # why it is unusable
    size: tuple[int, int] = (0, 0)  # width and height, in pixels
    small: NDArray[np.uint8] = np.zeros((*SMALL[::-1], 3), np.uint8)  # (12, 16, 3) if decoded


@contextmanager
def decoded_once() -> Generator[None]:
    """Whole images that :func:`load_images` was to keep are not decoded again inside."""
    token = KEPT.set({})
    try:
        yield
    finally:
        KEPT.reset(token)


def read_image(path: Path, at_least: tuple[int, int] | None = None) -> Image.Image:
    """Read one image file as upright 8-bit RGB.

    Args:
        path: the file.
        at_least: (width, height) that are enough; a large JPEG is decoded faster at a fraction.

    Raises:
        PalpateError: if the file is missing, empty, truncated, no image, or of unknown range.
    """
    if (pixels := KEPT.get().get(path)) is not None:
        return Image.fromarray(pixels)
    try:
        with open_image(Path(path)) as image:
            return decoded(image, at_least)[0]
    except ImageError as error:
        must = f"The image {path} must be whole and readable"
        raise PalpateError(must, str(error), "Fetch the file again") from None


def image_size(path: Path) -> tuple[int, int] | None:
    """(width, height) of an image as it is read, by its first bytes; None if it is none."""
    with suppress(ImageError), open_image(path) as image:
        width, height = image.size  # of a PNG, EXIF is read by decoding it
        turned = width != height and image.getexif().get(ORIENTATION) in range(5, 9)
        return (height, width) if turned else (width, height)
    return None


def check_image(source: Path | BinaryIO, check: Check = "decode") -> Checked:
    """Look whether an image is usable.

    Args:
        source: the file, or its content.
        check: ``decode`` reads every byte (a JPEG at an eighth of its size, which detects
            truncation as well), ``header`` reads the first bytes only.
    """
    try:
        with open_image(source) as image:
            form, size, least = (
                str(image.format),
                image.size,
                (image.width // 8 + 1, image.height // 8 + 1),
            )
            if check != "decode":
                return Checked(form, size=size)
            rgb, taken = decoded(image, least)
            small = np.asarray(rgb.resize(SMALL, Image.Resampling.BOX))
            return Checked(form, taken, size=size, small=small)
    except ImageError as error:
        return Checked(problem=str(error))


class Frames(NamedTuple):
    """The files of samples, and the names of their sensors ('' if unknown)."""

    files: list[Frame]
    sensors: list[str]

    @classmethod
    def alone(
        cls, images: Sequence[Path | Image.Image], gels: Sequence[Path | Image.Image] = ()
    ) -> Frames:
        """Images, each with its no-contact image if there are any, of unknown sensors."""
        empty = gels or [None] * len(images)
        files: list[Frame] = [(image, gel, None) for image, gel in zip(images, empty, strict=True)]
        return cls(files, [""] * len(images))

    def stamps(self, root: Path) -> list[object]:
        """What changes with the no-contact images, the earlier frames and the sensors."""
        more = {path for _, *further in self.files for path in further if isinstance(path, Path)}
        stamp: dict[object, list[object]] = {
            path: [os.path.relpath(path, root), *file_stamp(path)] for path in more
        }
        return [[[stamp.get(path) for path in more] for _, *more in self.files], self.sensors]


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

    #: Of what is prepared, and whether it is a residual, which no sample must have an image for.
    dtype: ClassVar[np.dtype[Any]] = np.dtype(np.uint8)
    residual: ClassVar[bool] = False

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
    def plainly(self) -> Preprocess:
        """For the image alone, as its digest is taken: nothing subtracted."""
        return replace(self, subtract=())

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and channels of what :meth:`prepare` gives."""
        return self.height or self.resize, self.resize, 6 if self.lag else 3

    def prepare(
        self,
        image: Image.Image,
        background: Image.Image | None = None,
        previous: Image.Image | None = None,
    ) -> NDArray[Any]:
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

    def fit(self, images: NDArray[np.uint8], gels: NDArray[np.uint8] | None = None) -> NDArray[Any]:
        """Images (n, h, w, 3) as :meth:`prepare` gives them; those that are so stay.

        ``gels`` are their no-contact images, for encoders that subtract them.
        """
        if self.plain and images.shape[1:3] == self.shape[:2]:
            return images
        empty = (
            [None] * len(images)
            if gels is None or not self.subtract
            else map(Image.fromarray, gels)
        )
        pairs = zip(map(Image.fromarray, images), empty, strict=True)
        fitted = [self.prepare(image, gel) for image, gel in pairs]
        return np.stack(fitted) if fitted else images.reshape(0, *self.shape)

    def frames(self, manifest: Manifest, column: str, *, still: bool = False) -> Frames:
        """The files that samples are prepared from; ``still`` takes no earlier frames.

        Raises:
            PalpateError: if a sample lacks its image, or the no-contact image of its sensor.
        """
        paths, names = manifest.paths(column), manifest.column("sensor")
        gels = manifest.column("background")
        if self.residual and None in gels:  # of one kind for all
            gels = [None] * len(gels)
        positions = list(zip(manifest.column("video"), manifest.column("frame"), strict=True))
        at = dict(zip(positions, paths, strict=True)) if self.lag and not still else {}
        sensors = [(name or "").lower() for name in names]
        fix = "Fill the column background: palpate background"
        files: list[Frame] = []
        for k, (path, gel) in enumerate(zip(paths, gels, strict=True)):
            need = column == "tactile" and any(word in sensors[k] for word in self.subtract)
            must = f"The encoder subtracts the no-contact image of {names[k] or 'every sensor'}"
            there = not need or gel is not None or self.residual
            require(there, None, must, f"none for {path.name}", fix=fix)
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


def load_images(
    files: Sequence[Path | Image.Image | Frame],
    shape: int | Preprocess,
    *,
    progress: Progress = quiet,
    into: NDArray[np.uint8] | None = None,
    keep: bool = False,
) -> NDArray[np.uint8]:
    """Load and prepare images as one array; files that occur twice are decoded once.

    Args:
        files: images, or each with what else it is prepared from.
        shape: side of center squares in pixels, or how the images are prepared.
        progress: progress callback.
        into: (n, height, width, channels), to be filled.
        keep: whether the result stays, so that :func:`decoded_once` may look files up in it.

    Returns:
        (n, height, width, channels), 0 to 255: ``into``, or a new array.

    Raises:
        ProblemsError: naming every unreadable file.
    """
    preprocess = shape if isinstance(shape, Preprocess) else Preprocess(shape, shape)
    wanted = (len(files), *preprocess.shape)
    images = np.empty(wanted, preprocess.dtype) if into is None else into
    frames = [file if isinstance(file, tuple) else (file, None, None) for file in files]
    rows: dict[object, list[int]] = {}
    for k, frame in enumerate(frames):
        rows.setdefault(frame if isinstance(frame[0], Path) else k, []).append(k)
    kept = KEPT.get()

    def read(path: Path) -> Image.Image:  # threads have no context
        return Image.fromarray(kept[path]) if path in kept else read_image(path)

    background = lru_cache(64)(read)  # many samples share one

    def decode(at: list[int]) -> Problem | None:
        image, gel, before = frames[at[0]]
        file: object = image
        try:
            image = read(image) if isinstance(image, Path) else image
            empty = background(file := gel) if isinstance(gel, Path) else gel
            previous = read(file := before) if before else None
            images[at] = preprocess.prepare(image, empty, previous)
            whole = keep and preprocess.plain and image.size == preprocess.shape[1::-1]
            if whole and isinstance(kept, dict):
                kept[frames[at[0]][0]] = images[at[0]]
        except PalpateError as error:
            return Problem(str(file), "bad-image", error.got)
        return None

    decoded = in_threads(decode, [*rows.values()], "decoding images", progress)
    problems = [problem for _, problem in decoded if problem]
    if problems:
        raise ProblemsError(sorted(problems, key=lambda p: p.where), REFETCH)
    return images


def cached_images(
    manifest: Manifest,
    column: str,
    shape: int | Preprocess,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> NDArray[np.uint8]:
    """Load one image column of a manifest; with a cache, decode once and map the file afterwards.

    Args:
        manifest: the samples.
        column: ``vision``, ``tactile`` or ``background``.
        shape: as of :func:`load_images`.
        cache: folder for ``<column>-<size>-<digest>.npy``; None keeps the array in memory. The
            digest covers paths, file sizes, modification times, ``column`` and how the images are
            prepared, so a changed file is decoded again.
        progress: progress callback.

    Returns:
        (n, height, width, channels), 0 to 255, in row order; read-only if it is mapped.

    Raises:
        PalpateError: if a row has no such image, or lacks the no-contact image of its sensor.
        ProblemsError: naming every missing or unreadable file.
    """
    preprocess = shape if isinstance(shape, Preprocess) else Preprocess(shape, shape)
    frames = preprocess.frames(manifest, column)
    if cache is None:
        return load_images(frames.files, preprocess, progress=progress)
    geometry = asdict(replace(preprocess, mean=CLIP_MEAN, std=CLIP_STD))
    geometry["dtype"] = preprocess.dtype.str
    stamps = [] if preprocess.plain else frames.stamps(manifest.root)
    key = short(digest_json([geometry, image_stamp(manifest, column), stamps]))

    rows = (len(manifest), *preprocess.shape)

    def decode(part: Path) -> None:
        images = np.lib.format.open_memmap(part, mode="w+", dtype=preprocess.dtype, shape=rows)
        load_images(frames.files, preprocess, progress=progress, into=images, keep=True)
        images.flush()

    file = Path(cache) / f"{column}-{preprocess.resize}-{key}.npy"
    return cached(file, decode, mapped, progress)


def mapped(file: Path) -> NDArray[Any]:
    """An array in a file, mapped read-only."""
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
    return Preprocess(size, size).prepare(image)


def images_below(folder: Path) -> list[Path]:
    """The image files below a folder, sorted."""
    return sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())


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
