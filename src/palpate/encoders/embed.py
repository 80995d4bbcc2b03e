"""Embeddings of a manifest: each frozen encoder runs once, and the result lies in a cache named by what went into it.

The key is SHA-256 over: the encoder's digest (weights, architecture, preprocessing), the ids, the image paths with file sizes and
modification times (for text: the texts), labels and groups. A changed image, weight or row is therefore another key; the root and
the order of batches are not part of it.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from palpate.core import (
    FeatureSet,
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    digest_json,
    quiet,
    short,
)
from palpate.data.captions import caption
from palpate.data.images import REFETCH, cached_images, load_images
from palpate.data.manifest import Manifest
from palpate.encoders.encoder_set import MODALITIES, EncoderSet
from palpate.encoders.preprocess import Preprocess, to_unit

COLUMN = {"vision": "vision", "tactile": "tactile", "text": "text"}


def texts_of(manifest: Manifest, *, seed: int = 0) -> tuple[list[str], str]:
    """One text a sample: the manifest's, else a caption written from the material; deterministic (recipes, pitfall 4).

    Returns:
        n texts, and where they come from: ``manifest``, ``caption``, or ``manifest and caption``; a fact ``text_source`` of the
        manifest stands for ``manifest``.

    Raises:
        PalpateError: if a sample has neither text nor material.
    """
    texts: list[str] = []
    sources: set[str] = set()
    own = str(manifest.facts.get("text_source") or "manifest")
    for name, text, material in zip(
        manifest.ids, manifest.column("text"), manifest.column("material"), strict=True
    ):
        if text:
            texts.append(str(text))
            sources.add(own)
        elif material:
            texts.append(caption(str(material), str(name), seed))
            sources.add("caption")
        else:
            raise PalpateError(
                "Every sample must have a text or a material here",
                f"neither for {name!r}",
                "Fill one of the two columns",
            )
    return texts, " and ".join(sorted(sources, key=lambda s: (s != own, s)))


def embed(
    manifest: Manifest,
    encoders: EncoderSet,
    encoder: str = "tactile",
    *,
    column: str | None = None,
    labels: str = "material",
    groups: str = "video",
    cache: Path | None = None,
    keep_pixels: bool = True,
    batch: int = 128,
    progress: Progress = quiet,
) -> FeatureSet:
    """Embeddings of every sample of a manifest.

    Args:
        manifest: the samples, in the order of the result.
        encoders: see :class:`EncoderSet`.
        encoder: ``touch``, ``vision`` or ``text``.
        column: image column to read; default: ``tactile`` for touch, ``vision`` for vision.
        labels: column to carry along as labels; one without any value gives None.
        groups: the same, as groups.
        cache: folder for ``<encoder>-<key>.npz`` and the decoded pixels; None computes anew and keeps nothing.
        keep_pixels: whether the decoded pixels are kept in the cache, for another encoder or another column of labels.
        batch: images at a time; changes the result by rounding only (1e-5).
        progress: told how many samples are done.

    Returns:
        n rows, float32, L2-normalized, with the encoder's digest as ``encoder``.

    Raises:
        PalpateError: for an unknown encoder, an empty manifest, or samples without the image or text.
        ProblemsError: naming every unreadable image.
    """
    _require(encoder, batch)
    if not len(manifest):
        raise PalpateError(
            "There must be samples to embed", "none", "Check the split: is that part empty?"
        )
    column = COLUMN[encoder] if column is None or encoder == "text" else column
    digest = encoders.digest(encoder)
    inputs: list[object] = (
        list(texts_of(manifest)[0]) if encoder == "text" else _stamps(manifest, column)
    )
    label, group = _column(manifest, labels), _column(manifest, groups)
    key = digest_json(["palpate-embedding/1", digest, manifest.ids, column, inputs, label, group])
    file = Path(cache) / f"{encoder}-{short(key)}.npz" if cache else None
    if file is not None and (found := _cached(file, manifest.ids, digest)) is not None:
        progress(f"embedding {encoder}", len(manifest), len(manifest), "cached")
        return found
    if encoder == "text":
        features = embed_texts([str(t) for t in inputs], encoders, batch=batch, progress=progress)
    elif cache is not None and keep_pixels:
        pixels = cached_images(
            manifest, column, encoders.preprocess(encoder).resize, cache, progress
        )
        features = embed_images(pixels, encoders, encoder, batch=batch, progress=progress)
    else:
        features = _embed_files(manifest.paths(column), encoders, encoder, batch, progress)
    result = FeatureSet(manifest.ids, features, label, group, digest)
    if file is not None:
        result.save(file)
    return result


def embed_images(
    images: NDArray[np.uint8],
    encoders: EncoderSet,
    encoder: str = "tactile",
    *,
    batch: int = 128,
    progress: Progress = quiet,
) -> NDArray[np.float32]:
    """Embeddings of images in memory or in a mapped file, e.g. generated ones.

    Args:
        images: (n, h, w, 3), 0 to 255; other sizes than the encoder's are cut and resized as files are.
        encoders: see :class:`EncoderSet`.
        encoder: ``touch`` or ``vision``.
        batch: images at a time.
        progress: told how many images are done.

    Returns:
        (n, dim) float32, L2-normalized.

    Raises:
        PalpateError: if the encoder is unknown or takes no images, or the array is not 8-bit RGB.
    """
    _require(encoder, batch)
    preprocess = encoders.preprocess(encoder)
    out = np.empty((len(images), encoders.dim), np.float32)
    with _exact():
        for start in range(0, len(images), batch):
            out[start : start + batch] = _forward(
                preprocess.fit(images[start : start + batch]), encoders, encoder, preprocess
            )
            progress(f"embedding {encoder}", min(start + batch, len(images)), len(images))
    return out


def embed_texts(
    texts: Sequence[str], encoders: EncoderSet, *, batch: int = 128, progress: Progress = quiet
) -> NDArray[np.float32]:
    """Embeddings of texts, (n, dim) float32, L2-normalized; each distinct text is computed once."""
    distinct = sorted(set(texts), key=lambda t: (len(t), t))  # equal lengths together: less padding
    rows = np.empty((len(distinct), encoders.dim), np.float32)
    with _exact():
        for start in range(0, len(distinct), batch):
            rows[start : start + batch] = (
                encoders.encode("text", distinct[start : start + batch]).cpu().numpy()
            )
            progress("embedding text", min(start + batch, len(distinct)), len(distinct))
    place = {text: k for k, text in enumerate(distinct)}
    return rows[[place[text] for text in texts]]


def _embed_files(
    paths: Sequence[Path], encoders: EncoderSet, encoder: str, batch: int, progress: Progress
) -> NDArray[np.float32]:
    """As :func:`embed_images`, from files, a batch in memory at a time; every unreadable file is told at once."""
    preprocess = encoders.preprocess(encoder)
    out = np.empty((len(paths), encoders.dim), np.float32)
    problems: list[Problem] = []
    with _exact():
        for start in range(0, len(paths), batch):
            try:
                images = load_images(paths[start : start + batch], preprocess.resize)
            except ProblemsError as error:
                problems += error.problems
                continue
            if not problems:
                out[start : start + batch] = _forward(images, encoders, encoder, preprocess)
            progress(f"embedding {encoder}", min(start + batch, len(paths)), len(paths))
    if problems:
        raise ProblemsError(problems, REFETCH)
    return out


def _forward(
    images: NDArray[np.uint8], encoders: EncoderSet, encoder: str, preprocess: Preprocess
) -> NDArray[np.float32]:
    pixels = preprocess.normalize(preprocess.crop(to_unit(images, encoders.device)))
    return encoders.encode(encoder, pixels).float().cpu().numpy()


@contextmanager
def _exact() -> Generator[None]:
    """No gradients, and full float32 in cuDNN's convolutions, whose TF32 would make results depend on the batch size."""
    with (
        torch.inference_mode(),
        torch.backends.cudnn.flags(
            enabled=True, benchmark=False, deterministic=True, allow_tf32=False
        ),
    ):
        yield


def _require(encoder: str, batch: int) -> None:
    if encoder not in MODALITIES:
        raise PalpateError(
            f"A encoder must be one of {', '.join(MODALITIES)}",
            repr(encoder),
            "Choose one of these",
        )
    if batch < 1:
        raise PalpateError("--batch must be at least 1", str(batch), "Pass e.g. --batch 128")


def _stamps(manifest: Manifest, column: str) -> list[object]:
    """Relative path, size and modification time of every image; a missing file is left to the decoder to report."""
    known: dict[Path, list[int]] = {}
    for path in manifest.paths(column):
        if path not in known:
            stat = path.stat() if path.is_file() else None
            known[path] = [stat.st_size, stat.st_mtime_ns] if stat else [-1, -1]
    return [
        [name, *known[path]]
        for name, path in zip(manifest.column(column), manifest.paths(column), strict=True)
    ]


def _column(manifest: Manifest, name: str) -> list[str] | None:
    values = manifest.column(name)
    return None if all(v is None for v in values) else ["" if v is None else str(v) for v in values]


def _cached(file: Path, ids: Sequence[str], digest: str) -> FeatureSet | None:
    """The cached features if the file is whole and belongs to these ids and this encoder."""
    try:
        found = FeatureSet.load(file)
    except Exception:  # of a damaged file NumPy, zipfile and zlib raise many kinds
        return None
    return found if list(found.ids) == list(ids) and found.encoder == digest else None
