"""What can be scored, as :class:`~palpate.evaluation.samples.Samples`.

A source is a folder of images, a manifest, a folder of ``palpate generate``, a file of embeddings
(:mod:`palpate.evaluation.embedding_files`), an array or tensor of images or features, a list of
images or image files, or a :class:`palpate.core.FeatureSet`. The id of an image in a folder is its
path below the folder, with ``/`` and without the suffix. Rows without ids are numbered.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import (
    FeatureSet,
    PalpateError,
    ProblemsError,
    read_json,
    require,
    require_regular,
)
from palpate.core.features import is_missing, to_numpy
from palpate.evaluation.embedding_files import SUFFIXES, Embeddings, checked, read_embeddings
from palpate.evaluation.samples import Samples

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

Source = Any
KINDS = (
    "a folder of images, a manifest, a folder of palpate generate, or embeddings "
    f"({', '.join(SUFFIXES)})"
)


def read(source: Source, name: str, group: str = "video") -> Samples:
    """Read one source, which errors call ``name`` if it is no path; see the head of this module.

    Raises:
        PalpateError: if it is nothing that can be scored, or empty.
    """
    if isinstance(source, str | Path):
        samples = _read_path(Path(source), group)
    elif isinstance(source, FeatureSet):
        labels, groups = map(_strings, (source.labels, source.groups))
        rows = Embeddings(source.features, list(source.ids), labels, groups, source.encoder)
        samples = _of_embeddings(rows, name)
    elif hasattr(source, "table") and hasattr(source, "root"):
        samples = _of_manifest(source, name, group)
    else:
        samples = _read_array(source, name)
    must = f"There must be samples in {samples.source}"
    require(len(samples) > 0, None, must, "none", fix=f"Pass {KINDS}")
    return samples


def _strings(column: Sequence[Any] | None) -> list[str] | None:
    return None if column is None else ["" if is_missing(v) else str(v) for v in column]


def _read_path(path: Path, group: str) -> Samples:
    must, got = "What is scored must exist", f"nothing at {path}"
    require(path.exists(), None, must, got, fix=f"Pass {KINDS}")
    require_regular(path)
    from palpate.data.manifest import Manifest, is_manifest

    if path.is_file() and not is_manifest(path):
        must, fix = f"{path} must be {KINDS}", "Pass one of these; pickles are never loaded"
        got = path.suffix or "no suffix"
        require(path.suffix.lower() in SUFFIXES, None, must, got, fix=fix)
        return _of_embeddings(read_embeddings(path), str(path), path)
    require_utf8("Paths of images", os.path.realpath(path))
    if path.is_file() or (path / "manifest.parquet").is_file():
        manifest = Manifest.load(path)
        kinds = ("empty", "null-id", "duplicate-id")
        problems = [p for p in manifest.problems() if "tactile" in p.text or p.kind in kinds]
        if problems:
            raise ProblemsError(problems, "Fix the rows, or import again and skip them")
        return _of_manifest(manifest, str(path), group)
    index = path / "index.json"
    content = read_json(index, "index of generated images") if index.is_file() else None
    if isinstance(content, dict) and str(content.get("format")).startswith("palpate-generated/"):
        from palpate.diffusion.generated import Generated

        folder = Generated.load(path)
        rows = [{"id": i, "tactile": f"images/{file}"} for i, file in folder.files.items()]
        samples = _of_manifest(Manifest.from_rows(rows, path), str(path), group)
        return replace(samples, generator=folder.settings)
    return _of_manifest(Manifest.from_rows(_folder_rows(path), path), str(path), group)


def require_utf8(subject: str, text: str) -> None:
    """Raise if a path or a file name cannot be written down as UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise PalpateError(f"{subject} must be UTF-8", ascii(text), "Rename it") from None


def _folder_rows(path: Path) -> list[dict[str, str]]:
    rows: dict[str, str] = {}
    for file in sorted(path.rglob("*")):
        relative = file.relative_to(path).as_posix()
        hidden = any(part.startswith(".") for part in relative.split("/"))
        if hidden or not is_image_file(file) or not file.is_file():
            continue
        require_utf8(f"File names in {path}", relative)
        name = without_suffix(relative)
        must = f"Images in {path} must differ in name, suffixes aside"
        got = f"{rows.get(name)!r} and {relative!r}"
        require(name not in rows, None, must, got, fix="Rename one of them")
        rows[name] = relative
    return [{"id": name, "tactile": file} for name, file in rows.items()]


def is_image_file(path: str | Path) -> bool:
    """Whether a path has the suffix of an image."""
    from palpate.data.images import SUFFIXES as IMAGE_SUFFIXES

    return PurePosixPath(path).suffix.lower() in IMAGE_SUFFIXES


def without_suffix(name: str) -> str:
    """A path without the suffix of an image; another suffix is part of the name."""
    return name[: -len(PurePosixPath(name).suffix)] if is_image_file(name) else name


def _of_manifest(manifest: Manifest, source: str, group: str) -> Samples:
    labels, groups = (
        [v or "" for v in values] if any(values := manifest.column(name)) else None
        for name in ("material", group)
    )
    kind = group if groups else None
    return Samples(source, manifest.ids, False, labels, groups, kind, manifest)


def _of_embeddings(embeddings: Embeddings, source: str, path: Path | None = None) -> Samples:
    return Samples(
        source,
        embeddings.ids or [str(k) for k in range(len(embeddings.features))],
        embeddings.ids is None,
        embeddings.labels,
        embeddings.groups,
        "video" if embeddings.groups else None,
        features=embeddings.features,
        encoder=embeddings.encoder,
        path=path,
    )


def _read_array(source: Any, name: str) -> Samples:
    """An array or tensor of features or images, or a list of images or image files."""
    items: list[Any] = list(source) if isinstance(source, list | tuple) else []
    if items and isinstance(items[0], str | Path):
        from palpate.data.manifest import Manifest

        paths = [Path(item).absolute() for item in items]
        ids = [without_suffix(p.name) for p in paths]
        ids = ids if len(set(ids)) == len(ids) else [without_suffix(str(p)) for p in paths]
        rows = [{"id": i, "tactile": str(p)} for i, p in zip(ids, paths, strict=True)]
        return _of_manifest(Manifest.from_rows(rows, Path.cwd()), name, "video")
    try:
        array = np.stack([_as_array(item) for item in items]) if items else _as_array(source)
    except (TypeError, ValueError) as error:
        fix = f"Pass {KINDS}, an array or tensor, or a list of images of one size"
        raise PalpateError(f"{name} must be something to score", str(error), fix) from None
    if array.ndim == 2:
        return _of_embeddings(checked(Embeddings(array), name), name)
    images = _as_images(array, name)
    return Samples(name, [str(k) for k in range(len(images))], True, images=images)


def _as_array(value: Any) -> NDArray[Any]:
    return to_numpy(value.convert("RGB") if hasattr(value, "getbands") else value)


def _as_images(array: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """(n, h, w, c) or (n, c, h, w) of uint8, or of floats in [0, 1], as (n, h, w, 3) uint8."""
    if array.ndim == 3:
        array = array[..., None]
    if array.ndim == 4 and array.shape[1] in (1, 3) and array.shape[3] not in (1, 3):
        array = np.moveaxis(array, 1, 3)
    unit = array.dtype.kind == "f" and array.size and array.min() >= 0 and array.max() <= 1
    colors = array.ndim == 4 and array.shape[3] in (1, 3)
    must = f"{name} must be features (n, d), or images of uint8 or of floats in [0, 1]"
    got, fix = f"{array.dtype} of shape {array.shape}", "Scale and reshape it"
    require(colors and (unit or array.dtype == np.uint8), None, must, got, fix=fix)
    array = np.round(array * 255).astype(np.uint8) if unit else array
    return np.ascontiguousarray(np.broadcast_to(array, (*array.shape[:3], 3)))
