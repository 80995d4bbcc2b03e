"""Embeddings of a manifest: each frozen encoder runs once, and the result is cached by slices.

The key of a cached slice is SHA-256 over: the encoder's digest, the ids, and the image paths with
file sizes and modification times (for text: the texts). A changed image, weight or row is therefore
another key, of its own slice; the root and the batch size are not part of it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.nn.functional import normalize

from palpate.core import (
    FeatureSet,
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    cached,
    digest_json,
    quiet,
    require,
    require_choice,
    short,
)
from palpate.data.captions import NAMED, caption
from palpate.data.images import REFETCH, Frames, image_stamp, images_below, load_images, mapped
from palpate.data.residuals import kind_of, of_one_kind
from palpate.data.slices import Slice
from palpate.encoders.encoder_set import MODALITIES, EncoderSet, Modality, vision_state
from palpate.encoders.models import to_unit

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

#: Samples of a cached slice, about: a set of twice as many is cut into twice as many slices.
ROWS = 4096


def texts_of(manifest: Manifest) -> tuple[list[str], str]:
    """One text per sample: the manifest's, else a caption of its material, object, video or id.

    Returns:
        n texts, and their source: ``manifest``, ``caption`` (of the material), ``caption of the
        object`` ..., joined by ``and``; the fact ``text_source`` replaces ``manifest``.
    """
    texts: list[str] = []
    sources: set[str] = set()
    default = str(manifest.facts.get("text_source") or "manifest")
    for row in manifest.table.select("text", *NAMED).iter_rows(named=True):
        column = next(name for name in ("text", *NAMED) if row[name] or name == "id")
        text = str(row[column])
        texts.append(text if column == "text" else caption(text, str(row["id"])))
        caption_source = "caption" if column == "material" else f"caption of the {column}"
        sources.add(default if column == "text" else caption_source)
    return texts, " and ".join(sorted(sources, key=lambda s: (s != default, s)))


def embed(
    manifest: Manifest,
    encoders: EncoderSet,
    modality: Modality = "tactile",
    *,
    groups: str = "video",
    cache: Path | None = None,
    still: bool = False,
    raw: bool = False,
    batch: int = 128,
    progress: Progress = quiet,
) -> FeatureSet:
    """Embeddings of every sample of a manifest, with its material as label.

    Args:
        manifest: the samples, in the order of the result.
        encoders: see :class:`EncoderSet`.
        modality: ``tactile``, ``vision`` or ``text``.
        groups: column to carry along as groups; one without any value gives None.
        cache: folder for ``<modality>-<key>.npy``, one file a slice; None computes anew.
        still: take each image alone, also for encoders that look at an earlier frame, too.
        raw: leave the numbers of a ruler, or of a vision encoder, as they are, not of length 1.
        batch: images at a time; changes the result by rounding only (1e-5).
        progress: called with the number of samples done.

    Returns:
        n rows, float32, L2-normalized, with the encoder's digest as ``encoder``. A ruler subtracts
        the no-contact images of the manifest where all samples have one, else low frequencies; the
        digest covers which.

    Raises:
        PalpateError: for an unknown modality, an empty manifest, or samples without the image or
            text.
        ProblemsError: naming every unreadable image.
    """
    _require(modality, batch)
    fix = "Check the split: is that part empty?"
    require(len(manifest) > 0, None, "There must be samples to embed", "none", fix=fix)
    manifest = of_one_kind(manifest)
    task = partial(Task, encoders=encoders, modality=modality, still=still, raw=raw)
    of = 1 if cache is None else 1 << (len(manifest) // ROWS).bit_length()
    features: Any = None
    whole = task(manifest)
    if cache is None:
        features = whole.rows(batch, progress)
    for number in range(1, of + 1) if cache else ():
        at = Slice(number, of).rows(manifest)
        some = whole if of == 1 else task(replace(manifest, table=manifest.table[at]))
        if not some.n:
            continue
        file = Path(cache or "") / f"{modality}-{short(some.key)}.npy"
        make = partial(some.write, batch=batch, progress=progress)
        rows = cached(file, make, mapped, progress)
        if features is None:
            features = rows if of == 1 else np.empty((whole.n, rows.shape[1]), rows.dtype)
        if of > 1:
            features[at] = rows
    progress(f"embedding {modality}", whole.n, whole.n)
    label, group = words_of(manifest, "material"), words_of(manifest, groups)
    return FeatureSet(manifest.ids, features, label, group, whole.encoder)


class Task:
    """Samples that an encoder is to embed, all or those of a slice; options as of :func:`embed`.

    Attributes:
        n: how many.
        encoder: digest of the encoder; of a ruler with the kind of background.
        key: digest of all that is read.
    """

    def __init__(
        self,
        manifest: Manifest,
        encoders: EncoderSet,
        modality: Modality,
        *,
        still: bool = False,
        raw: bool = False,
    ) -> None:
        self.encoders, self.raw = encoders, raw
        self.modality: Modality = modality
        self.n, self.encoder, self.frames = len(manifest), encoders.digest(modality), None
        ruled = modality == "tactile" and encoders.preprocess(modality).residual
        if ruled:  # rulers compare features of one kind
            self.encoder = digest_json([self.encoder, kind_of(manifest)])
        self.texts = texts_of(manifest)[0] if modality == "text" else []
        inputs: list[Any] = self.texts
        if modality != "text":
            self.frames = encoders.preprocess(modality).frames(manifest, modality, still=still)
            inputs = [image_stamp(manifest, modality), *self.frames.stamps(manifest.root)]
        read = [self.encoder, manifest.ids, inputs, raw and (ruled or modality == "vision")]
        self.key = digest_json(["palpate-embedding/3", *read])

    def rows(self, batch: int, progress: Progress) -> NDArray[np.float32]:
        """The embeddings, (n, dim)."""
        if self.frames is None:
            return embed_texts(self.texts, self.encoders, batch=batch, progress=progress)
        return embed_frames(
            self.frames, self.encoders, self.modality, batch, progress, raw=self.raw
        )

    def write(self, file: Path, batch: int, progress: Progress) -> None:
        """The same as ``.npy``, of which no more than a batch is in memory."""
        parts = (
            [self.rows(batch, progress)]
            if self.frames is None
            else _frame_batches(
                self.frames, self.encoders, self.modality, batch, progress, raw=self.raw
            )
        )
        shape = (self.n, self.encoders.width(self.modality))
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        with open(file, "wb") as target:
            np.lib.format.write_array_header_1_0(target, header)
            for rows in parts:
                target.write(np.ascontiguousarray(rows, "<f4").data)


def embed_images(
    images: NDArray[np.uint8],
    encoders: EncoderSet,
    modality: Modality = "tactile",
    *,
    gels: NDArray[np.uint8] | None = None,
    raw: bool = False,
    batch: int = 128,
    progress: Progress = quiet,
) -> NDArray[np.float32]:
    """Embeddings of images (n, h, w, 3), 0 to 255, in memory or in a mapped file.

    Other sizes than the encoder's are cut and resized as files are. ``gels`` are the no-contact
    images (n, h, w, 3), for encoders that subtract them; ``raw`` as of :func:`embed`.

    Returns:
        (n, dim) float32, L2-normalized.

    Raises:
        PalpateError: if the modality is unknown or text, or the array is not 8-bit RGB.
    """
    _require(modality, batch)
    require_rgb(images)
    fit, n = encoders.preprocess(modality).fit, len(images)

    def load(rows: slice) -> NDArray[Any]:
        return fit(images[rows], None if gels is None else gels[rows])

    parts = _batches(n, load, encoders, modality, batch=batch, progress=progress, raw=raw)
    return _joined(parts, n, encoders.width(modality))


def embed_texts(
    texts: Sequence[str], encoders: EncoderSet, *, batch: int = 128, progress: Progress = quiet
) -> NDArray[np.float32]:
    """Embeddings of texts, (n, dim) float32, L2-normalized; each distinct text is computed once."""
    distinct = sorted(set(texts), key=lambda t: (len(t), t))  # equal lengths together: less padding
    rows = np.empty((len(distinct), encoders.width("text")), np.float32)
    with exact():
        for start in range(0, len(distinct), batch):
            part = encoders.encode("text", distinct[start : start + batch])
            rows[start : start + batch] = part.cpu().numpy()
            progress("embedding text", min(start + batch, len(distinct)), len(distinct))
    row = {text: k for k, text in enumerate(distinct)}
    return rows[[row[text] for text in texts]]


def require_rgb(images: NDArray[np.uint8]) -> None:
    """Raise unless ``images`` are uint8 (n, h, w, 3)."""
    rgb = images.dtype == np.uint8 and images.ndim == 4 and images.shape[3] == 3
    must, got = "must be uint8 of shape (n, h, w, 3)", f"{images.dtype} of shape {images.shape}"
    require(rgb, "images", must, got, fix="Scale to 0..255, round and clip")


@contextmanager
def exact() -> Generator[None]:
    """Compute without gradients, and without TF32, by which results depend on the batch size."""
    exactly = torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    )
    with torch.inference_mode(), exactly:
        yield


def embed_frames(
    frames: Frames,
    encoders: EncoderSet,
    modality: Modality,
    batch: int,
    progress: Progress,
    *,
    raw: bool = False,
) -> NDArray[np.float32]:
    """Embed files; report all unreadable ones together."""
    parts = _frame_batches(frames, encoders, modality, batch, progress, raw=raw)
    return _joined(parts, len(frames.files), encoders.width(modality))


def _frame_batches(
    frames: Frames,
    encoders: EncoderSet,
    modality: Modality,
    batch: int,
    progress: Progress,
    *,
    raw: bool,
) -> Iterator[NDArray[np.float32]]:
    preprocess, n, sensors = encoders.preprocess(modality), len(frames.files), frames.sensors

    def load(rows: slice) -> NDArray[np.uint8]:
        return load_images(frames.files[rows], preprocess)

    return _batches(
        n, load, encoders, modality, batch=batch, progress=progress, sensors=sensors, raw=raw
    )


def _joined(parts: Iterable[NDArray[Any]], n: int, width: int) -> NDArray[np.float32]:
    features, start = np.empty((n, width), np.float32), 0
    for rows in parts:
        features[start : start + len(rows)] = rows
        start += len(rows)
    return features


def _batches(
    n: int,
    load: Callable[[slice], NDArray[np.uint8]],
    encoders: EncoderSet,
    modality: Modality,
    *,
    batch: int,
    progress: Progress,
    sensors: Sequence[str] | None = None,
    raw: bool = False,
) -> Iterator[NDArray[np.float32]]:
    """Embed n prepared images, a batch in memory at a time; those before an unreadable one."""
    preprocess = encoders.preprocess(modality)
    problems: list[Problem] = []
    for start in range(0, n, batch):
        rows = slice(start, start + batch)
        try:
            images = load(rows)
        except ProblemsError as error:
            problems += error.problems
            continue
        if not problems:
            with exact():
                pixels = preprocess(to_unit(images, encoders.device))
                if raw and modality == "vision":
                    part = vision_state(encoders.clip, pixels)
                else:
                    part = encoders.encode(modality, pixels, sensors and sensors[rows])
                if preprocess.residual and not raw:
                    part = normalize(part, dim=-1)
                embedded = part.float().cpu().numpy()
            yield embedded
        progress(f"embedding {modality}", min(start + batch, n), n)
    if problems:
        raise ProblemsError(problems, REFETCH)


def _require(modality: str, batch: int) -> None:
    require_choice("modality", modality, MODALITIES)
    require(batch >= 1, "batch", "must be at least 1", batch, 128)


def words_of(manifest: Manifest, name: str) -> list[str] | None:
    """A column as texts, '' for none; None where all are."""
    values = manifest.column(name)
    return None if all(v is None for v in values) else ["" if v is None else str(v) for v in values]


def list_images(inputs: Any) -> list[Path | Image.Image]:
    """Images in any form that :meth:`Encoder.encode` takes, as a list of files and PIL images.

    Raises:
        PalpateError: for arrays of another type or shape, a missing path, or other objects.
    """
    if isinstance(inputs, str | Path):
        path = Path(inputs)
        return [*images_below(path)] if path.is_dir() else [path]
    if isinstance(inputs, Image.Image):
        return [inputs.convert("RGB")]
    if hasattr(inputs, "shape"):
        return [Image.fromarray(image) for image in _bytes(inputs)]
    if isinstance(inputs, Sequence):
        return [image for entry in inputs for image in list_images(entry)]
    must, fix = "must be files, PIL images, arrays or tensors", "Pass e.g. a list of files"
    raise PalpateError(must, type(inputs).__name__, fix, argument="images")


def _bytes(images: Any) -> NDArray[np.uint8]:
    """An array or tensor as uint8 (n, h, w, 3); of four channels the last, alpha, is left out."""
    tensor = hasattr(images, "detach")
    array = np.asarray(images.detach().cpu().float() if tensor else images)
    shape = array.shape
    array = array[..., None] if array.ndim == 2 and not tensor else array
    array = array[None] if array.ndim == 2 else array
    array = array[None] if array.ndim == 3 else array
    if tensor and array.ndim == 4 and array.shape[1] in (1, 3, 4):
        array = array.transpose(0, 2, 3, 1)
    if tensor and images.dtype.itemsize == 1:
        array = array.astype(np.uint8)
    if array.dtype.kind == "f" and array.size and array.min() >= 0 and array.max() <= 1:
        array = np.rint(array * 255).astype(np.uint8)
    if array.ndim == 4 and array.shape[3] in (1, 4):
        array = array[..., [0, 0, 0] if array.shape[3] == 1 else [0, 1, 2]]
    rgb = array.ndim == 4 and array.shape[3] == 3 and array.dtype == np.uint8
    must = "must be (n, h, w, c), or a tensor (n, c, h, w), of bytes or of floats in [0, 1]"
    got = f"{array.dtype} of shape {shape}"
    require(rgb, "images", must, got, fix="Scale to 0..255 and round")
    return np.ascontiguousarray(array)
