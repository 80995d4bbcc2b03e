"""What is scored: images or features of samples, next to a table of what is known of each.

Three loaders read all that can be scored:

- image files: a folder, a table, a manifest, a folder of ``palpate generate``, a list of files. The
  id of an image in a folder is its path below the folder, with ``/`` and without the suffix;
- images in memory: an array or tensor, a list of arrays or PIL images;
- features: an array (n, d), a :class:`palpate.core.FeatureSet`, ``.npy`` (memory-mapped), or
  ``.npz`` with ``features`` (n, d) and optionally ``ids``, ``labels``, ``groups`` (n strings each)
  and ``encoder``, which is what ``FeatureSet.save`` writes; or a folder of ``palpate embed``. No
  pickle is ever loaded.

Rows without ids are numbered. Further columns come from a table of labels, by id.
"""

from __future__ import annotations

import hashlib
import os
import posixpath
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import polars as pl
from numpy.typing import NDArray
from PIL import Image

from palpate.core import (
    FeatureSet,
    Note,
    PalpateError,
    ProblemsError,
    Progress,
    digest_file,
    digest_json,
    inside,
    read_json,
    reading_entry,
    require,
    require_regular,
    short,
)
from palpate.core.features import is_missing, to_numpy
from palpate.core.files import canonical_json
from palpate.core.messages import require_rows
from palpate.data.images import cached_images, image_size, load_images, mapped, read_image, square
from palpate.data.manifest import Manifest, is_image, is_manifest
from palpate.data.recordings import LEVELS, name_recordings
from palpate.data.slices import is_parted, whole_parts
from palpate.data.tables import TABLES, headless_names, open_table, table_of

#: Decoded images of more bytes than this are kept in a file of the cache.
IN_MEMORY = 1 << 30
#: Bytes that an array of an archive may unpack to, and times its packed size on top, at most.
UNPACKED, MOST_TIMES = 1 << 28, 20
FEATURES = (".npy", ".npz")
#: Files of a part of ``palpate embed``, and the column that says what the encoder was trained on.
PART_FEATURES, PART_ROWS, SEEN = "features.npy", "rows.parquet", "seen_by_encoder"
KINDS = (
    "a folder or table of images, a manifest, a folder of palpate generate, or embeddings "
    f"({', '.join(FEATURES)})"
)
#: What ids get to be read as names of files.
SUFFIX = ".png"
#: Columns that a table of labels may have, and other names of theirs.
LABELS = ("material", "object", "session", "video", "contact")
#: Columns of features -> those of a manifest.
_COLUMNS = {"ids": "id", "labels": "material", "groups": "video"}
_NAMES = {name: name for name in ("id", *LABELS)} | {"label": "material", "group": "video"}


@dataclass(frozen=True)
class Samples:
    """Samples of one generator, or of the reference.

    Attributes:
        source: path or name, for errors.
        manifest: a row a sample, with its image files where ``rows`` is None (column ``tactile``; a
            reference may have ``vision`` and ``background``).
        rows: images (n, h, w, 3) uint8, or features (n, d), possibly memory-mapped.
        numbered: whether the ids are row numbers, which pair nothing.
        group: level of what stays together.
        encoder: digest of the encoder that made the features.
        gel: one no-contact image (h, w, 3) for all of a reference.
        settings: of ``palpate generate``, for its folders.
        made: of ``palpate embed``, for its folders: settings, notes, and digests of medians.
    """

    source: str
    manifest: Manifest
    rows: NDArray[Any] | None = None
    numbered: bool = False
    group: str = "video"
    encoder: str | None = None
    gel: NDArray[np.uint8] | None = field(default=None, repr=False)
    settings: Mapping[str, Any] | None = None
    made: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __len__(self) -> int:
        return len(self.manifest)

    @property
    def ids(self) -> list[str]:
        """The ids, each once."""
        return self.manifest.ids

    @property
    def embedded(self) -> bool:
        """Whether these are features."""
        return self.rows is not None and self.rows.ndim == 2

    @property
    def ruled(self) -> bool:
        """Whether these are raw numbers of a ruler."""
        return self.made.get("background") is not None

    @property
    def labels(self) -> list[str] | None:
        """The materials."""
        return self.column("material")

    @property
    def groups(self) -> list[str] | None:
        """What stays together; None where no two samples do (``frame``)."""
        return None if self.group == "frame" else self.column(self.group)

    def column(self, name: str) -> list[str] | None:
        """A column of the table, '' where it is unknown; None where it is for all."""
        values = self.manifest.column(name)
        return [v or "" for v in values] if any(values) else None

    def with_columns(self, *columns: pl.Series | pl.Expr) -> Samples:
        """The samples with other columns of text in their table."""
        table = self.manifest.table.with_columns(*columns)
        return replace(self, manifest=replace(self.manifest, table=table))

    @property
    def has_background(self) -> bool:
        """Whether every sample has its no-contact image, or there is one for all."""
        known = not self.manifest.table["background"].null_count()
        return self.gel is not None or (self.rows is None and known)

    def take(self, ids: Sequence[str]) -> Samples:
        """The samples of ``ids``, in that order.

        Raises:
            PalpateError: if an id is missing.
        """
        must = f"{self.source} must have every id of the split's test part"
        at = require_rows(self.ids, ids, must, "Use the split that was made for it")
        manifest = replace(self.manifest, table=self.manifest.table[at])
        return replace(self, manifest=manifest, rows=None if self.rows is None else self.rows[at])

    def feature_set(self, features: NDArray[Any], encoder: str | None) -> FeatureSet:
        """Features of these samples with their ids, materials and groups.

        Raises:
            PalpateError: on NaN or infinity; the rows are named.
        """
        try:
            return FeatureSet(self.ids, features, self.labels, self.groups, encoder)
        except PalpateError as error:
            raise PalpateError(f"{self.source}: {error.must}", error.got, error.fix) from None

    @cached_property
    def side(self) -> int:
        """The shorter side of the images.

        Raises:
            PalpateError: if they differ in size.
        """
        if self.rows is not None:
            return min(self.rows.shape[1:3])
        paths = self.manifest.paths("tactile")
        sizes = {path: image_size(path) or read_image(path).size for path in paths}
        first = next(iter(sizes))
        other = next((p for p, size in sizes.items() if size != sizes[first]), None)
        if other is not None:
            got = " and ".join("{} of {} x {}".format(p.name, *sizes[p]) for p in (first, other))
            must = f"All images of {self.source} must have one size for scores of pixels"
            fix, example = "Resize them, or request other companions", {"companions": ["fid"]}
            raise PalpateError(must, got, fix, example=example)
        return min(sizes[first])

    def pixels(
        self, size: int, cache: Path, progress: Progress, column: str = "tactile"
    ) -> NDArray[np.uint8]:
        """The images as squares, (n, size, size, 3); many of them memory-mapped from the cache."""
        if column == "background" and self.gel is not None:
            gel = square(Image.fromarray(self.gel), size)
            return np.broadcast_to(gel, (len(self), *gel.shape))
        if self.rows is not None:
            return np.stack([square(Image.fromarray(image), size) for image in self.rows])
        if len(self) * size * size * 3 > IN_MEMORY:
            return cached_images(self.manifest, column, size, self.folder(cache, column), progress)
        return load_images(self.manifest.paths(column), size, progress=progress, keep=True)

    def folder(self, cache: Path, column: str = "tactile") -> Path:
        """A folder of the cache for the bytes of these images, whatever their names and times."""
        return cache / short(self.image_digest(column))

    def image_digest(self, column: str = "tactile") -> str:
        """SHA-256 over id and bytes of every image, in any order: the same for a copied folder."""
        if self.rows is None:
            paths = self.manifest.paths(column)
            digests = [_file_digest(path, path.stat().st_ctime_ns) for path in paths]
        else:
            digests = [hashlib.sha256(image.tobytes()).hexdigest() for image in self.rows]
        return digest_json(sorted(map(list, zip(self.ids, digests, strict=True))))

    @property
    def digest(self) -> str:
        """Digest of ids and images, or of ids and features."""
        if self.embedded:
            return self.feature_set(cast("NDArray[Any]", self.rows), None).digest
        return self.image_digest()


@lru_cache(maxsize=1 << 20)
def _file_digest(path: Path, _changed: int) -> str:
    """SHA-256 of a file, read once per run unless its time of change differs."""
    return digest_file(path)


def read_samples(source: Any, name: str) -> Samples:
    """Read one source, which errors call ``name`` if it is no path; see the head of this module.

    Raises:
        PalpateError: if it is nothing that can be scored, or empty.
    """
    items: list[Any] = list(cast("Any", source)) if isinstance(source, list | tuple) else []
    if isinstance(source, str | Path):
        samples = _of_path(Path(source))
    elif isinstance(source, Manifest):
        samples = Samples(name, source)
    elif isinstance(source, FeatureSet):
        columns = {"ids": source.ids, "labels": source.labels, "groups": source.groups}
        texts = {
            column: ["" if is_missing(value) else str(value) for value in values]
            for column, values in columns.items()
            if values is not None
        }
        samples = _features(source.features, name, texts, source.encoder)
    elif items and isinstance(items[0], str | Path):
        paths = [Path(item).absolute() for item in items]
        ids = [without_suffix(p.name) for p in paths]
        ids = ids if len(set(ids)) == len(ids) else [without_suffix(str(p)) for p in paths]
        samples = Samples(name, _manifest(Path.cwd(), id=ids, tactile=[str(p) for p in paths]))
    else:
        samples = _of_arrays(items or source, name)
    must = f"There must be samples in {samples.source}"
    require(len(samples) > 0, None, must, "none", fix=f"Pass {KINDS}")
    return samples


def one_image(source: Any) -> NDArray[np.uint8]:
    """An image (h, w, 3): a file, an array or a PIL image."""
    one = read_samples([source], "background")
    path = [] if one.rows is not None else one.manifest.paths("tactile")
    return np.asarray(read_image(path[0])) if path else cast("NDArray[Any]", one.rows)[0]


def _manifest(root: Path, **columns: Sequence[str]) -> Manifest:
    """Columns of text as a manifest; those left out, and '', are null."""
    cells = {name: [v or None for v in values] for name, values in columns.items()}
    table = pl.DataFrame(cells, schema=dict.fromkeys(columns, pl.String))
    return Manifest.of_table(table, root)


def _of_path(path: Path) -> Samples:
    must, got = "What is scored must exist", f"nothing at {path}"
    require(path.exists(), None, must, got, fix=f"Pass {KINDS}")
    require_regular(path)
    if path.suffix.lower() in FEATURES and path.is_file():
        return _of_feature_file(path)
    if is_parted(path):
        return _of_parts(path)
    if path.is_file() and not is_manifest(path):
        is_table = path.suffix.lower() in TABLES or bool(headless_names(path))
        must, fix = f"{path} must be {KINDS}", "Pass one of these; pickles are never loaded"
        require(is_table, None, must, path.suffix or "no suffix", fix=fix)
        return Samples(str(path), _of_table(path))
    require_utf8("Paths of images", os.path.realpath(path))
    if is_manifest(path):
        manifest = Manifest.load(path)
        kinds = ("empty", "null-id", "duplicate-id")
        problems = [p for p in manifest.problems() if "tactile" in p.text or p.kind in kinds]
        if problems:
            raise ProblemsError(problems, "Fix the rows, or import again and skip them")
        return Samples(str(path), manifest)
    index = path / "index.json"
    content: Any = read_json(index, "index of generated images") if index.is_file() else None
    if isinstance(content, dict) and str(content.get("format")).startswith("palpate-generated/"):
        with reading_entry(index, "The index"):
            files, settings = generated_files(path, content), dict(content["settings"])
        manifest = _manifest(path, id=[*files], tactile=[*files.values()])
        return Samples(str(path), manifest, settings=settings)
    files = _files_below(path)
    return Samples(str(path), _manifest(path, id=[*files], tactile=[*files.values()]))


def _of_parts(path: Path) -> Samples:
    """The parts of ``palpate embed`` or ``palpate generate`` as one, in the order of the ids."""
    parts = whole_parts(path)
    first = parts[0]
    if "features" not in first.settings:
        files, settings = dict[str, str](), dict[str, Any]()
        for part in parts:
            samples = _of_path(path / part.place)
            own = samples.manifest.table.select("id", "tactile").iter_rows()
            files |= {i: f"{part.place}/{image}" for i, image in own}
            settings = dict(samples.settings or {})
        ids = sorted(files)
        manifest = _manifest(path, id=ids, tactile=[files[i] for i in ids])
        return Samples(str(path), manifest, settings=settings)
    manifests = [Manifest.load(path / part.place / PART_ROWS) for part in parts]
    arrays: list[NDArray[Any]] = []
    for part, manifest in zip(parts, manifests, strict=True):
        with reading_entry(file := path / part.place / PART_FEATURES, "The array"):
            arrays.append(mapped(file))
        whole = arrays[-1].shape[:1] == (len(manifest),)
        must = f"{file} must have a row for each sample"
        require(whole, None, must, f"shape {arrays[-1].shape}", fix="Make that part again")
    table, rows = pl.concat([m.table for m in manifests]), arrays[0]
    require_ids(table["id"].to_list(), str(path))
    if len(parts) > 1:
        order = table["id"].arg_sort().to_numpy()
        table, rows = table[order], np.concatenate(arrays)[order]
    notes = {canonical_json(note): note for part in parts for note in part.notes}
    gels = {gel for part in parts for gel in part.facts["gels"]}
    made = {**first.settings, "notes": [*notes.values()], "gels": sorted(gels)}
    manifest, encoder = replace(manifests[0], table=table), str(first.settings["features"])
    return Samples(str(path), manifest, rows, encoder=encoder, made=made)


def files_of(source: Any) -> Samples:
    """Samples that are image files.

    Raises:
        PalpateError: if they are arrays or embeddings, or as :func:`read_samples`.
    """
    samples = read_samples(source, "data")
    must = "What is embedded must be image files"
    require(samples.rows is None, None, must, samples.source, fix="Name the images")
    return samples


def judged(samples: Samples, *, allow_seen: bool) -> list[Note]:
    """What a reader must know of the encoder that embedded a folder's samples.

    Raises:
        PalpateError: if it was trained on some of them, unless that is allowed.
    """
    made = samples.made
    if not made:
        return []
    notes = [Note(note["code"], note["params"]) for note in made["notes"]]
    seen, n = samples.manifest.table[SEEN].count(), len(samples)
    if seen:
        params = {"modality": made["modality"], "seen": seen, "n": n}
        notes.append(Note("seen-images", params))
    must = f"The {made['modality']} encoder must judge images that it has not seen"
    codes = {note.code for note in notes} & {"seen-images", "seen-dataset"}
    got = f"{seen:,} of {n:,} that it was trained on" if seen else "images of its training data"
    fix = "Judge other images or use another encoder, or allow it: every score then says so"
    if codes and not allow_seen:
        raise PalpateError(must, got, fix, example={"allow_seen": True})
    return notes


def _of_table(path: Path) -> Manifest:
    from palpate.data.reading import read  # what is scored is a table of images least often

    manifest = read(path, images=True).manifest
    must, fix = f"{path} must name a tactile image in every row", "Name the column tactile"
    without = manifest.table["tactile"].null_count()
    require(not without, None, must, f"{without} rows without", fix=fix)
    return manifest


def generated_files(folder: Path, index: Mapping[str, Any]) -> dict[str, str]:
    """Id -> file below a finished folder of ``palpate generate``, by its index.

    Raises:
        PalpateError: if it was left half done, or names a file that is missing or outside.
        ValueError: if the names are no texts.
    """
    must, fix = f"{folder} must be finished", "Run the same command again: it continues"
    require(index["complete"], None, must, "a folder left half done", fix=fix)
    images = index["images"]
    names = [*images.values()] if isinstance(images, Mapping) else [images]
    if kinds := {type(name).__name__ for name in names} - {"str"}:
        raise ValueError(f"images of type {min(kinds)}")
    paths = [inside(folder / "images", name) for name in names]
    bad = [n for n, p in zip(names, paths, strict=True) if p is None or not p.is_file()]
    must = f"Every image of {folder / 'index.json'} must lie in images/"
    got = f"{len(bad)} that do not, first {bad[:1]}"
    require(not bad, None, must, got, fix="Generate again")
    return {i: f"images/{name}" for i, name in images.items()}


def _files_below(path: Path) -> dict[str, str]:
    """Id -> image file, relative to the folder."""
    files: dict[str, str] = {}
    for file in sorted(path.rglob("*")):
        relative = file.relative_to(path).as_posix()
        hidden = any(part.startswith(".") for part in relative.split("/"))
        if hidden or not is_image(file) or not file.is_file():
            continue
        require_utf8(f"File names in {path}", relative)
        name = without_suffix(relative)
        must = f"Images in {path} must differ in name, suffixes aside"
        got = f"{files.get(name)!r} and {relative!r}"
        require(name not in files, None, must, got, fix="Rename one of them")
        files[name] = relative
    return files


def require_utf8(subject: str, text: str) -> None:
    """Raise if a path or a file name cannot be written down as UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise PalpateError(f"{subject} must be UTF-8", ascii(text), "Rename it") from None


def without_suffix(name: str) -> str:
    """A path without the suffix of an image; another suffix is part of the name."""
    return posixpath.splitext(name)[0] if is_image(name) else name


def _of_arrays(source: Any, name: str) -> Samples:
    """An array or tensor of features or images, or a list of rows or images."""
    try:
        rgb = lambda item: to_numpy(item.convert("RGB") if hasattr(item, "getbands") else item)
        array = np.stack([*map(rgb, source)]) if isinstance(source, list) else rgb(source)
    except (TypeError, ValueError) as error:
        fix = f"Pass {KINDS}, an array or tensor, or a list of images of one size"
        raise PalpateError(f"{name} must be something to score", str(error), fix) from None
    if array.ndim == 2:
        return _features(array, name, {})
    images = as_images(array, name)
    ids = [str(k) for k in range(len(images))]
    return Samples(name, _manifest(Path(), id=ids), images, numbered=True)


def as_images(array: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """(n, h, w, c) or (n, c, h, w) of uint8, or of floats in [0, 1], as (n, h, w, 3) uint8.

    Raises:
        PalpateError: on another shape, type or range.
    """
    if array.ndim == 3:
        one, fix = array.shape[2] in (1, 3, 4), "Pass a list of images"
        must, got = f"{name} must be several images (n, h, w, 3)", f"one of shape {array.shape}"
        require(not one, None, must, got, fix=fix)
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


def _of_feature_file(path: Path) -> Samples:
    texts: dict[str, list[str]] = {}
    try:
        if path.suffix.lower() == ".npz":
            x, texts = _arrays_in(path)
        else:
            x = np.load(path, mmap_mode="r", allow_pickle=False)
            if not isinstance(x, np.ndarray):
                raise ValueError("an archive of arrays, which is named .npz")
    except KeyError as error:
        must, fix = f"{path} must hold features under the name 'features'", "Save them so"
        raise PalpateError(must, f"no {error}", fix) from None
    except Exception as error:  # a damaged file raises many kinds in NumPy, zipfile and zlib
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        must = f"{path} must be a whole {path.suffix} file without pickles"
        raise PalpateError(must, reason, "Write it again") from None
    encoder = next(iter(texts.pop("encoder", ())), None)
    return _features(x, str(path), texts, encoder)


def _arrays_in(path: Path) -> tuple[NDArray[Any], dict[str, list[str]]]:
    """``features`` of an archive, and its other arrays as lists of strings."""
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.file_size > UNPACKED + MOST_TIMES * entry.compress_size:
                size, packed = entry.file_size / 1e9, entry.compress_size / 1e6
                raise ValueError(f"{entry.filename} unpacks to {size:.1f} GB from {packed:.1f} MB")
    with np.load(path, allow_pickle=False) as data:
        names = [name for name in (*_COLUMNS, "encoder") if name in data]
        return data["features"], {name: [*map(str, data[name].reshape(-1))] for name in names}


def _features(
    x: NDArray[Any], source: str, texts: Mapping[str, list[str]], encoder: str | None = None
) -> Samples:
    """Features of samples with columns (``_COLUMNS``); half precision is widened to float32.

    Raises:
        PalpateError: if they are no floats (n, d), columns have other lengths, or an id is empty or
            occurs twice.
    """
    floats = x.dtype.kind == "f" and x.ndim == 2 and 0 not in x.shape
    must = f"The features in {source} must be floats of shape (n, d), n and d at least 1"
    fix = "Save one row of the encoder's output per sample"
    require(floats, None, must, f"{x.dtype} of shape {x.shape}", fix=fix)
    columns = {"ids": [*map(str, range(len(x)))]} | {
        n: column for n, column in texts.items() if column
    }
    for name, column in columns.items():
        must = f"{name} in {source} must have one entry per row ({len(x)})"
        require(len(column) == len(x), None, must, len(column), fix="Write it again")
        require_utf8(f"{name} in {source}", "".join(column))
    require_ids(columns["ids"], source)
    manifest = _manifest(Path(), **{_COLUMNS[name]: column for name, column in columns.items()})
    x = x.astype(np.float32) if x.dtype.itemsize < 4 else x
    return Samples(source, manifest, x, "ids" not in texts, encoder=encoder)


def require_ids(ids: Sequence[str], source: str) -> None:
    """Raise if an id is empty or occurs twice."""
    row = next((k for k, name in enumerate(ids, 1) if not name), 0)
    must = f"Every row of {source} must have an id"
    require(row == 0, None, must, f"none in row {row}", fix="Fill the ids")
    repeated = [i for i, n in Counter(ids).items() if n > 1]
    got = f"{len(repeated)} that occur more than once, first {''.join(repeated[:1])!r}"
    must = f"Every id in {source} must occur once"
    require(not repeated, None, must, got, fix="Keep one row per id")


def named_sources(
    generated: Any, names: Sequence[str] | None, reserved: Sequence[str]
) -> dict[str, Any]:
    """Name -> source of every generator; names must differ, and must not be those of a control."""
    if isinstance(generated, Mapping):
        sources = dict(cast("Mapping[str, Any]", generated))
    else:
        several = isinstance(generated, list | tuple) and not _is_image_list(generated)
        items: list[Any] = list(cast("Sequence[Any]", generated)) if several else [generated]
        got, fix = f"{len(names or ())} for {len(items)}", "Pass one name each"
        complete = not names or len(names) == len(items)
        require(complete, "names", "must name every generator", got, fix=fix)
        chosen = list(names or [_name_of(item, k, len(items)) for k, item in enumerate(items)])
        must, got = "must differ from generator to generator", ", ".join(map(repr, chosen))
        distinct = len(set(chosen)) == len(chosen) and "" not in chosen
        require(distinct, "names", must, got, fix=fix)
        sources = dict(zip(chosen, items, strict=True))
    must = "must hold something to score"
    require(len(sources) > 0, "generated", must, "nothing", fix=f"Pass {KINDS}")
    must = f"must not be {' or '.join(map(repr, reserved))}, which the tables have already"
    for name, source in sources.items():
        got = f"{name!r} for {source}"
        require(name not in reserved, "names", must, got, fix="Pass another name")
    return sources


def _is_image_list(items: Sequence[Any]) -> bool:
    """Whether a list holds images of one generator: PIL images, arrays (h, w, c), files."""
    return bool(items) and all(
        is_image(item)
        if isinstance(item, str | Path)
        else hasattr(item, "getbands") or getattr(item, "ndim", 0) == 3
        for item in items
    )


def _name_of(item: Any, k: int, count: int) -> str:
    if not isinstance(item, str | Path):
        return "generated" if count == 1 else f"generated {k + 1}"
    path = Path(os.path.realpath(item))
    name = path.stem if path.is_file() else path.name
    name = path.parent.name if name in ("touches", "images") else name
    return name.encode(errors="surrogateescape").decode(errors="replace")


def read_labels(source: Any) -> pl.DataFrame | None:
    """A table with the column ``id`` and some of ``LABELS``.

    Args:
        source: a table (:mod:`palpate.data.tables`), id -> material, one material per row, or None.
            The column ``label`` stands for ``material``, ``group`` for ``video``.

    Raises:
        PalpateError: if it is none of these, rows are bad, or ids are missing or repeated.
    """
    if source is None:
        return None
    if isinstance(source, str | Path):
        table = open_table(Path(source))
    elif hasattr(source, "columns") or isinstance(next(iter(source), None), dict):
        table = table_of(source, "labels")
    else:
        values = source.items() if isinstance(source, Mapping) else enumerate(source)
        table = table_of([{"id": str(i), "material": value} for i, value in values], "labels")
    columns = {_NAMES[c]: c for c in reversed(table.names) if c in _NAMES}
    must = f"{table.name} must have a column id, and material or video"
    got, usable = f"the columns {', '.join(table.names)}", "id" in columns and len(columns) > 1
    require(usable, None, must, got, fix="Add the column, or rename it")
    cells = table.read([*columns.values()])
    if table.problems:
        raise ProblemsError(table.problems, "Correct these rows")
    require_ids(cells[columns["id"]].fill_null("").to_list(), table.name)
    return cells.select(pl.col(name).alias(own) for own, name in columns.items())


def with_full_ids(samples: Samples, full: Sequence[str]) -> Samples:
    """Image files whose ids are full ids but for the suffix take the full ids."""
    if samples.rows is not None:
        return samples
    exact, bare = {*full}, {without_suffix(i): i for i in reversed(full)}
    ids = [i if i in exact else bare.get(without_suffix(i), i) for i in samples.ids]
    if len(set(ids)) < len(ids):  # two names that one id could mean
        return samples
    return samples.with_columns(pl.Series("id", ids, pl.String))


def labeled(samples: Samples, table: pl.DataFrame | None, source: str = "the labels") -> Samples:
    """Samples with the columns of a table, by id; those without any id in it stay.

    Raises:
        PalpateError: if some of the ids are not in the table, which errors call ``source``.
    """
    if table is None:
        return samples
    if samples.numbered:
        must = f"{samples.source}, which has no ids, must have as many rows as {source}"
        got = f"{len(samples)} and {len(table)}"
        require(len(table) == len(samples), None, must, got, fix="Give them ids")
        samples = replace(samples.with_columns(table["id"]), numbered=False)
    ids = samples.manifest.table["id"]
    missing = ids.filter(~ids.is_in(table["id"].implode()))
    if len(missing) == len(samples):
        return samples
    columns = " and ".join(table.columns[1:])
    must = f"Every id of {samples.source} must be in {source}, which gives {columns} by id"
    got = f"{len(missing)} of {len(samples)} without, first {next(iter(missing), '')!r}"
    require(missing.is_empty(), None, must, got, fix="Remove these, or pass labels for every id")
    rows = samples.manifest.table.select("id").join(table, "id", "left", maintain_order="left")
    return samples.with_columns(*rows.drop("id"))


def labeled_as(samples: Samples, other: Samples) -> Samples:
    """Samples with what only another set knows of the same ids; errors as :func:`labeled`."""
    mine, theirs = samples.manifest.filled(), other.manifest.filled()
    lacking = [c for c in LABELS if c in theirs.columns and c not in mine.columns]
    table = theirs.select("id", *lacking) if lacking and not samples.numbered else None
    return labeled(samples, table, other.source)


def with_recordings(sets: Sequence[Samples]) -> list[Samples]:
    """The sets with the recordings that the names of files show, or ids, read together.

    Samples whose names show no recording, where others' do, are recordings of their own.
    """
    suffix = pl.concat_str("id", pl.lit(SUFFIX)).alias("tactile")
    files = [s if s.rows is None else s.with_columns(suffix) for s in sets if not s.numbered]
    manifests = iter(name_recordings([s.manifest for s in files]))
    named: list[Samples] = []
    for samples in sets:
        manifest = samples.manifest if samples.numbered else next(manifests)
        levels = (level for level in LEVELS[:-1] if f"{level}_from" in manifest.facts)
        alone = [pl.col(level).fill_null(pl.col("id")) for level in levels]
        own = samples.manifest.table["tactile"]
        named.append(replace(samples, manifest=manifest).with_columns(own, *alone))
    return named
