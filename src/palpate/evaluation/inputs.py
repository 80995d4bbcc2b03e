"""Everything that can be scored, as :class:`Samples`: images or embeddings, with ids, labels and groups.

A source is a folder of images, a manifest, a folder of ``palpate generate``, a file of embeddings
(:mod:`palpate.evaluation.embedding_files`), an array or tensor of images or features, a list of PIL
images or image files, a polars or pandas frame, or a :class:`palpate.core.FeatureSet`. The id of an image
in a folder is its path below the folder, with ``/`` and without the suffix. Rows without ids are numbered.

What a source lacks is completed in this order: from the keywords ``labels`` and ``groups`` (which also
replace what a source has), then, for a generator, from the reference, by id.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from palpate.core import (
    FeatureSet,
    Note,
    PalpateError,
    ProblemsError,
    Progress,
    Split,
    digest_file,
    digest_json,
    read_json,
    short,
)
from palpate.core.features import is_missing
from palpate.core.plain import to_numpy
from palpate.evaluation.embedding_files import (
    GROUPS,
    LABELS,
    SUFFIXES,
    Embeddings,
    checked,
    embeddings_of_table,
    first_of,
    read_embeddings,
    read_parquet,
    require_ids,
    text_column,
)

if TYPE_CHECKING:
    import polars as pl

    from palpate.data.manifest import Manifest

Source = Any
KINDS = f"a folder of images, a manifest, a folder of palpate generate, or embeddings ({', '.join(SUFFIXES)})"
#: Decoded images of more bytes than this are kept in a file of the cache.
IN_MEMORY = 1 << 30
#: Embeddings of more rows without labels and groups are streamed, for TMMD alone.
STREAMED = 50_000
#: Name of the reference in tables and errors.
REFERENCE = "reference"


@dataclass(frozen=True)
class Samples:
    """Samples of one generator, or of the reference. Either ``features`` or one of ``manifest`` and ``images`` is set.

    Attributes:
        source: path or name, for errors.
        ids: n distinct ids.
        numbered: whether the ids are row numbers, which pair nothing.
        labels, groups: n strings each ('' where unknown), or None.
        group: what the groups are: a column name, ``video`` for groups that came with features.
        manifest: image files (column ``tactile``; the reference may have ``vision`` and ``background``).
        images: (n, h, w, 3) uint8.
        features: (n, d), possibly memory-mapped.
        encoder: digest of the encoder that made the features.
        path: file of the features.
        generator: settings of ``palpate generate``, for its folders.
        widened: half-precision type that the features were converted from, if any.
    """

    source: str
    ids: list[str]
    numbered: bool = False
    labels: list[str] | None = None
    groups: list[str] | None = None
    group: str | None = None
    manifest: Manifest | None = None
    images: NDArray[np.uint8] | None = None
    features: NDArray[Any] | None = None
    encoder: str | None = None
    path: Path | None = None
    generator: Mapping[str, Any] | None = None
    widened: str = ""

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def streamed(self) -> bool:
        """Whether there are too many rows to hold, and nothing but TMMD to compute from them."""
        bare = self.labels is None and self.groups is None
        return self.features is not None and bare and len(self) > STREAMED

    @property
    def has_background(self) -> bool:
        """Whether every sample has its no-contact image."""
        return self.manifest is not None and not self.manifest.table["background"].null_count()

    def take(self, ids: Sequence[str]) -> Samples:
        """The samples of ``ids``, in that order.

        Raises:
            PalpateError: if an id is missing.
        """
        row = {name: k for k, name in enumerate(self.ids)}
        if missing := [i for i in ids if i not in row]:
            raise PalpateError(
                f"{self.source} must have every id of the split's test part",
                f"{len(missing)} of {len(ids)} missing, first {missing[0]!r}",
                "Use the split that was made for it",
            )
        at = [row[i] for i in ids]
        labels, groups = (_picked(column, at) for column in (self.labels, self.groups))
        return replace(
            self,
            ids=list(ids),
            manifest=None
            if self.manifest is None
            else self.manifest.take([self.ids[k] for k in at]),
            images=None if self.images is None else self.images[at],
            features=None if self.features is None else self.features[at],
            labels=labels,
            groups=groups if groups and any(groups) else None,
        )

    def feature_set(self, features: NDArray[Any], encoder: str | None) -> FeatureSet:
        """Features of these samples with their ids, labels and groups.

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
        if self.manifest is None:
            return min(cast("NDArray[np.uint8]", self.images).shape[1:3])
        first, *others = {p: _image_size(p) for p in self.manifest.paths("tactile")}.items()
        for path, size in others:
            if size != first[1]:
                got = f"{first[0].name} of {first[1][0]} x {first[1][1]} and {path.name} of {size[0]} x {size[1]}"
                raise PalpateError(
                    f"All images of {self.source} must have one size for scores of pixels", got,
                    "Resize them, or request other companions", example={"companions": ["fid"]},
                )  # fmt: skip
        return min(first[1])

    def pixels(
        self, size: int, cache: Path, progress: Progress, column: str = "tactile"
    ) -> NDArray[np.uint8]:
        """The images as squares, (n, size, size, 3); many of them memory-mapped from the cache."""
        from palpate.data.images import cached_images, load_images, square

        if self.manifest is None:
            from PIL import Image

            images = cast("NDArray[np.uint8]", self.images)
            return np.stack([square(Image.fromarray(image), size) for image in images])
        if len(self) * size * size * 3 > IN_MEMORY:
            return cached_images(self.manifest, column, size, self.folder(cache, column), progress)
        return load_images(self.manifest.paths(column), size, progress=progress)

    def folder(self, cache: Path, column: str = "tactile") -> Path:
        """A folder of the cache for the content of these images: names, sizes and times of two sources may agree."""
        return cache / short(self.digest_of(column))

    def digest_of(self, column: str = "tactile") -> str:
        """SHA-256 over id and bytes of every image, in any order: the same for a copy of a folder."""
        if self.manifest is None:
            images = cast("NDArray[np.uint8]", self.images)
            digests = [hashlib.sha256(image.tobytes()).hexdigest() for image in images]
        else:
            paths = self.manifest.paths(column)
            digests = [_bytes_digest(path, path.stat().st_ctime_ns) for path in paths]
        return digest_json(sorted([i, digest] for i, digest in zip(self.ids, digests, strict=True)))

    @property
    def digest(self) -> str:
        """Digest of the images, or of the file of features."""
        if self.features is None:
            return self.digest_of()
        return digest_file(self.path) if self.path else self.feature_set(self.features, None).digest


def _picked(column: Sequence[str] | None, at: Sequence[int]) -> list[str] | None:
    return None if column is None else [column[k] for k in at]


@lru_cache(maxsize=1 << 20)
def _bytes_digest(path: Path, _changed: int) -> str:
    """SHA-256 of a file, read once per run unless its time of change differs."""
    return digest_file(path)


def _image_size(path: Path) -> tuple[int, int]:
    from PIL import Image

    from palpate.data.images import read_image

    try:
        with Image.open(path) as image:  # reads the header alone
            return image.size
    except OSError:
        return read_image(path).size  # raises the reason


@dataclass(frozen=True)
class Inputs:
    """Aligned samples.

    Attributes:
        generators: name -> samples.
        reference: the real samples; of a split, its test part.
        train: the train part of the reference, if there is a split and the reference has it.
        group: what groups are.
        notes: what was assumed or skipped.
    """

    generators: dict[str, Samples]
    reference: Samples
    train: Samples | None
    group: str
    notes: list[Note] = field(default_factory=list)


def read_inputs(
    generated: Source,
    reference: Source,
    *,
    names: Sequence[str] | None,
    labels: Source,
    groups: Source,
    group: str,
    split: Split | None,
    reserved: Sequence[str],
) -> Inputs:
    """Read and align everything that is scored; arguments as :func:`palpate.evaluation.score`.

    Raises:
        PalpateError: if a source is not readable, images are mixed with embeddings, or ids, labels or groups
            are known for a part of the samples only.
    """
    sources = name_generators(generated, names, reserved)
    column = (
        group if group != "auto" else str(split.rule.get("group", "video")) if split else "video"
    )
    real = read(reference, REFERENCE, column)
    made = {name: read(source, name, column) for name, source in sources.items()}
    _require_one_kind([real, *made.values()])
    known = _keywords(labels, groups, column, exact=group != "auto")
    given = {i for values in known for i in values.ids}
    real = _complete(real, known)
    made = {name: _complete(_with_ids(s, [*real.ids, *given]), known) for name, s in made.items()}
    if real.numbered:  # row k of a generator is not row k of the reference
        real = replace(real, ids=[f"{REFERENCE} {i}" for i in real.ids])
    made = {name: _from_reference(samples, real) for name, samples in made.items()}
    if known and not any(given & {*samples.ids} for samples in (real, *made.values())):
        raise PalpateError("must hold ids of the samples", "other ids", "Write them by id", argument="labels")  # fmt: skip
    widened = [s for s in (real, *made.values()) if s.widened]
    notes = [Note("widened", {"source": s.source, "type": s.widened}) for s in widened]
    train = None
    if split is not None:
        whole, real, train = real, *_split_parts(real, split)
        for name, samples in made.items():
            made[name], note = _test_part(name, samples, real, whole)
            notes += note
    if not len(real):
        raise PalpateError("The reference must hold samples", "none", "Check the split: is its test part empty?")  # fmt: skip
    kind = _one_group([real, *made.values()], group) or column
    return Inputs(made, real, train, kind, notes)


def name_generators(
    generated: Source, names: Sequence[str] | None, reserved: Sequence[str]
) -> dict[str, Source]:
    """Name -> source of every generator.

    Raises:
        PalpateError: if there is none, or names repeat or are those of a control.
    """
    if isinstance(generated, Mapping):
        sources = dict(cast("Mapping[str, Source]", generated))
    else:
        several = isinstance(generated, list | tuple) and not _is_image_list(generated)
        items: list[Source] = list(cast("Sequence[Source]", generated)) if several else [generated]
        own = [_name_of(item, k, len(items)) for k, item in enumerate(items)]
        if names and len(names) != len(items):
            got = f"{len(names)} for {len(items)}"
            raise PalpateError("must name every generator", got, "Pass one name each", argument="names")  # fmt: skip
        own = list(names or own)
        if len(set(own)) < len(own) or "" in own:
            got = ", ".join(map(repr, own))
            raise PalpateError("must differ from generator to generator", got, "Pass one name each", argument="names")  # fmt: skip
        sources = dict(zip(own, items, strict=True))
    if not sources:
        raise PalpateError("must hold something to score", "nothing", f"Pass {KINDS}", argument="generated")  # fmt: skip
    if used := [name for name in sources if name in reserved]:
        got = f"{sources[used[0]]} as {used[0]!r}"
        fix = "The tables have a row of that name already: pass another one"
        raise PalpateError(f"must not be {' or '.join(map(repr, reserved))}", got, fix, argument="names")  # fmt: skip
    return sources


def _is_image_list(items: Sequence[Any]) -> bool:
    """Whether a list holds the images of one generator: PIL images, arrays (h, w, c), image files."""
    from palpate.data.images import SUFFIXES as IMAGE_SUFFIXES

    def is_image(item: Any) -> bool:
        if isinstance(item, str | Path):
            return Path(item).suffix.lower() in IMAGE_SUFFIXES
        return hasattr(item, "getbands") or getattr(item, "ndim", 0) == 3

    return bool(items) and all(is_image(item) for item in items)


def _name_of(item: Source, k: int, count: int) -> str:
    if not isinstance(item, str | Path):
        return "generated" if count == 1 else f"generated {k + 1}"
    path = Path(item)
    name = path.stem if path.is_file() else path.name
    if name in ("", "touches", "images"):
        name = path.resolve().parent.name if name else path.resolve().name
    return name.encode(errors="surrogateescape").decode(errors="replace")


def read(source: Source, name: str, group: str = "video") -> Samples:
    """Read one source, whatever it is.

    Args:
        source: see the head of this module.
        name: what errors call a source that is no path.
        group: manifest column of the groups.

    Raises:
        PalpateError: if it is nothing that can be scored, or empty.
    """
    if isinstance(source, Samples):
        return source
    if isinstance(source, str | Path):
        samples = _read_path(Path(source), group)
    elif isinstance(source, FeatureSet):
        columns = (list(source.ids), *map(_texts, (source.labels, source.groups)))
        samples = _of_embeddings(Embeddings(source.features, *columns, source.encoder), name)
    elif hasattr(source, "table") and hasattr(source, "root"):
        samples = _of_manifest(source, name, group)
    elif hasattr(source, "columns"):
        samples = _read_frame(source, name, group)
    else:
        samples = _read_array(source, name)
    if not len(samples):
        raise PalpateError(f"There must be samples in {samples.source}", "none", f"Pass {KINDS}")
    return samples


def _texts(column: Sequence[Any] | None) -> list[str] | None:
    return None if column is None else ["" if is_missing(v) else str(v) for v in column]


def _read_path(path: Path, group: str) -> Samples:
    if not path.exists():
        raise PalpateError("What is scored must exist", f"nothing at {path}", f"Pass {KINDS}")
    if path.is_file() and not _is_manifest(path):
        if path.suffix.lower() not in SUFFIXES:
            fix = "Pass one of these; pickles are never loaded"
            raise PalpateError(f"{path} must be {KINDS}", path.suffix or "no suffix", fix)
        return _of_embeddings(read_embeddings(path), str(path), path)
    try:
        str(path.resolve()).encode()
    except UnicodeEncodeError:
        got, fix = ascii(str(path)), "Rename the folder: a page finds its images by path"
        raise PalpateError("Paths of images must be UTF-8", got, fix) from None
    from palpate.data.manifest import Manifest

    if path.is_file() or (path / "manifest.parquet").is_file():
        manifest = Manifest.load(path)
        problems = [
            p
            for p in manifest.problems()
            if "tactile" in p.text or p.kind in ("empty", "null-id", "duplicate-id")
        ]
        if problems:
            raise ProblemsError(problems, "Fix the rows, or import again and skip them")
        return _of_manifest(manifest, str(path), group)
    if _is_generated(path):
        from palpate.diffusion.generation import Generated

        folder = Generated.load(path)
        rows = [{"id": i, "tactile": f"images/{file}"} for i, file in folder.files.items()]
        samples = _of_manifest(Manifest.from_rows(rows, path), str(path), group)
        return replace(samples, generator=folder.settings)
    return _of_manifest(Manifest.from_rows(_folder_rows(path), path), str(path), group)


def _is_manifest(path: Path) -> bool:
    if path.suffix.lower() != ".parquet":
        return False
    try:
        return "palpate.format" in read_parquet(path)[0]
    except Exception:  # not a Parquet file; the reader of embeddings reports it
        return False


def _is_generated(path: Path) -> bool:
    index = path / "index.json"
    content = read_json(index, "index of generated images") if index.is_file() else None
    return isinstance(content, dict) and str(content.get("format")).startswith("palpate-generated/")


def _folder_rows(path: Path) -> list[dict[str, str]]:
    from palpate.data.images import SUFFIXES as IMAGE_SUFFIXES

    rows: dict[str, str] = {}
    for file in sorted(path.rglob("*")):
        relative = file.relative_to(path).as_posix()
        hidden = any(part.startswith(".") for part in relative.split("/"))
        if file.suffix.lower() not in IMAGE_SUFFIXES or hidden or not file.is_file():
            continue
        try:
            relative.encode()
        except UnicodeEncodeError:
            must = f"File names in {path} must be UTF-8"
            raise PalpateError(must, ascii(relative), "Rename the file") from None
        if (name := without_suffix(relative)) in rows:
            must = f"Images in {path} must differ in name, suffixes aside"
            got = f"{rows[name]!r} and {relative!r}"
            raise PalpateError(must, got, "Rename one of them")
        rows[name] = relative
    return [{"id": name, "tactile": file} for name, file in rows.items()]


def without_suffix(name: str) -> str:
    """A relative path without the suffix of an image; another suffix is part of the name."""
    from palpate.data.images import SUFFIXES as IMAGE_SUFFIXES

    suffix = PurePosixPath(name).suffix
    return name[: -len(suffix)] if suffix.lower() in IMAGE_SUFFIXES else name


def _of_manifest(manifest: Manifest, source: str, group: str) -> Samples:
    columns = [
        [v or "" for v in values] if any(values := manifest.column(name)) else None
        for name in ("material", group)
    ]
    kind = group if columns[1] else None
    return Samples(source, manifest.ids, False, *columns, kind, manifest=manifest)


def _of_embeddings(embeddings: Embeddings, source: str, path: Path | None = None) -> Samples:
    ids = embeddings.ids or [str(k) for k in range(len(embeddings.features))]
    return Samples(
        source,
        ids,
        embeddings.ids is None,
        embeddings.labels,
        embeddings.groups,
        "video" if embeddings.groups else None,
        features=embeddings.features,
        encoder=embeddings.encoder,
        path=path,
        widened=embeddings.widened,
    )


def as_polars(frame: Any) -> pl.DataFrame:
    """A polars or pandas frame as polars."""
    import polars as pl

    if isinstance(frame, pl.DataFrame):
        return frame
    return pl.DataFrame({str(name): frame[name].tolist() for name in frame.columns}, strict=False)


def _read_frame(frame: Any, name: str, group: str) -> Samples:
    table = as_polars(frame)
    if "tactile" not in table.columns:
        return _of_embeddings(checked(embeddings_of_table(table, name), name), name)
    from palpate.data.manifest import SCHEMA, Manifest

    rows = table.select(c for c in table.columns if c in SCHEMA).to_dicts()
    return _of_manifest(Manifest.from_rows(rows, Path.cwd()), name, group)


def _read_array(source: Any, name: str) -> Samples:
    """An array or tensor of features or images, or a list of images or image files."""
    items: list[Any] = list(source) if isinstance(source, list | tuple) else []
    if items and isinstance(items[0], str | Path):
        from palpate.data.manifest import Manifest

        paths = [Path(item).absolute() for item in items]
        names = [without_suffix(p.name) for p in paths]
        ids = names if len(set(names)) == len(names) else [without_suffix(str(p)) for p in paths]
        rows = [{"id": i, "tactile": str(p)} for i, p in zip(ids, paths, strict=True)]
        return _of_manifest(Manifest.from_rows(rows, Path.cwd()), name, "video")
    try:
        array = np.stack([_on_host(item) for item in items]) if items else _on_host(source)
    except (TypeError, ValueError) as error:
        fix = f"Pass {KINDS}, an array or tensor, or a list of images of one size"
        raise PalpateError(f"{name} must be something to score", str(error), fix) from None
    if array.ndim == 2:
        return _of_embeddings(checked(Embeddings(array), name), name)
    images = _as_images(array, name)
    return Samples(name, [str(k) for k in range(len(images))], True, images=images)


def _on_host(value: Any) -> NDArray[Any]:
    """An array, a tensor on any device, or a PIL image as an array."""
    return to_numpy(value.convert("RGB") if hasattr(value, "getbands") else value)


def _as_images(array: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """(n, h, w, c) or (n, c, h, w) of uint8, or of floats in [0, 1], as (n, h, w, 3) uint8."""
    if array.ndim == 3:
        array = array[..., None]
    if array.ndim == 4 and array.shape[1] in (1, 3) and array.shape[3] not in (1, 3):
        array = np.moveaxis(array, 1, 3)
    unit = array.dtype.kind == "f" and array.size and 0 <= array.min() and array.max() <= 1
    if array.ndim != 4 or array.shape[3] not in (1, 3) or not (unit or array.dtype == np.uint8):
        raise PalpateError(
            f"{name} must be features (n, d), or images (n, h, w, 3) of uint8 or of floats in [0, 1]",
            f"{array.dtype} of shape {array.shape}",
            "Scale and reshape it",
        )
    array = np.round(array * 255).astype(np.uint8) if unit else array
    return np.ascontiguousarray(np.broadcast_to(array, (*array.shape[:3], 3)))


def _require_one_kind(sets: Sequence[Samples]) -> None:
    """Raise if images are mixed with embeddings, or embeddings of several widths or encoders."""
    if len({s.features is None for s in sets}) > 1:
        got = ", ".join(
            f"{s.source} ({'images' if s.features is None else 'embeddings'})" for s in sets
        )
        must = "Generated and reference must both be images, or both embeddings"
        raise PalpateError(must, got, "Embed the images first, or pass them all")
    fix = "Embed both with the same encoder"
    real = sets[0]
    for s in sets[1:]:
        if s.features is None or real.features is None:
            continue
        if s.features.shape[1] != real.features.shape[1]:
            got = f"{s.features.shape[1]} and {real.features.shape[1]}"
            raise PalpateError(
                f"{s.source} and the reference must have features of one width", got, fix
            )
        if s.encoder and real.encoder and s.encoder != real.encoder:
            got = f"digests {short(s.encoder)} and {short(real.encoder)}"
            raise PalpateError(f"{s.source} and the reference must come from one encoder", got, fix)


@dataclass(frozen=True)
class _Column:
    """Labels or groups by id, from a keyword: ``field`` of :class:`Samples`, name of the column."""

    field: str
    name: str
    values: Mapping[str, str]
    source: str

    @property
    def ids(self) -> list[str]:
        return list(self.values)


def _keywords(labels: Source, groups: Source, group: str, *, exact: bool) -> list[_Column]:
    """The columns of the keywords ``labels`` (which may hold groups as well) and ``groups``."""
    columns: list[_Column] = []
    if labels is not None:
        table, source = _table(labels, "material", "labels")
        names = {"labels": first_of(table.columns, LABELS)}
        if groups is None:
            names["groups"] = first_of(table.columns, (group,) if exact else (group, *GROUPS))
        columns += _columns_of(table, source, names, "labels", group)
    if groups is not None:
        table, source = _table(groups, group, "groups")
        names = {"groups": first_of(table.columns, (group,) if exact else (group, *GROUPS))}
        columns += _columns_of(table, source, names, "groups", group)
    return columns


def _table(source: Source, name: str, argument: str) -> tuple[pl.DataFrame, str]:
    """A CSV or Parquet file, a frame, id -> value, or one value per row, as a table with a column ``id``."""
    import polars as pl

    if isinstance(source, str | Path):
        path = Path(source)
        try:
            if path.suffix.lower() == ".parquet":
                return read_parquet(path)[1], str(path)
            return pl.read_csv(path, infer_schema=False, glob=False), str(path)  # 007 stays a name
        except Exception as error:  # polars raises many kinds
            got = "no such file" if not path.exists() else str(error).splitlines()[0]
            fix = "Write a CSV or Parquet file with the columns id, material, video"
            raise PalpateError(f"{path} must be a CSV or Parquet file", got, fix) from None
    if hasattr(source, "columns"):
        return as_polars(source), f"`{argument}`"
    values = source if isinstance(source, Mapping) else {str(k): v for k, v in enumerate(source)}
    return pl.DataFrame({"id": list(values), name: list(values.values())}), f"`{argument}`"


def _columns_of(
    table: pl.DataFrame, source: str, names: Mapping[str, str | None], argument: str, group: str
) -> list[_Column]:
    wanted = {name: column for name, column in names.items() if column}
    if "id" not in table.columns or not wanted:
        must = (
            f"{source} must have a column id, and {'material or ' * (argument == 'labels')}{group}"
        )
        got = f"the columns {', '.join(table.columns)}"
        raise PalpateError(must, got, "Add the column, or rename it")
    ids = text_column(table, "id", source)
    require_ids(ids, source)
    return [
        _Column(
            name, column, dict(zip(ids, text_column(table, column, source), strict=True)), source
        )
        for name, column in wanted.items()
    ]


def _with_ids(samples: Samples, known: Sequence[str]) -> Samples:
    """Images whose ids are known ids but for the suffix take the known ids."""
    if samples.features is not None or samples.numbered:
        return samples
    exact, short_names = {*known}, {without_suffix(i): i for i in reversed(known)}
    ids = [i if i in exact else short_names.get(without_suffix(i), i) for i in samples.ids]
    if len(set(ids)) < len(ids):  # two names that one id could mean
        return samples
    manifest = samples.manifest
    if manifest is not None:
        import polars as pl

        table = manifest.table.with_columns(pl.Series("id", ids, pl.String))
        manifest = replace(manifest, table=table)
    return replace(samples, ids=ids, manifest=manifest)


def _complete(samples: Samples, columns: Sequence[_Column]) -> Samples:
    """Samples with the labels and groups of the keywords; samples without any id in a column keep theirs."""
    for column in columns:
        if samples.numbered:
            if len(column.values) != len(samples):
                got = f"{len(samples)} and {len(column.values)}"
                must = (
                    f"{samples.source}, which has no ids, must have as many rows as {column.source}"
                )
                raise PalpateError(must, got, "Give the samples ids")
            samples = replace(samples, ids=column.ids, numbered=False)
        missing = [i for i in samples.ids if i not in column.values]
        if len(missing) == len(samples):
            continue
        if missing:
            got = f"{len(missing)} of {len(samples)} of {samples.source} without, first {missing[0]!r}"
            raise PalpateError(f"Every id must be in {column.source}", got, "Add these rows")
        values = [column.values[i] for i in samples.ids]
        kind = column.name if column.field == "groups" else samples.group
        samples = replace(samples, **{column.field: values}, group=kind)
    return samples


def _from_reference(samples: Samples, reference: Samples) -> Samples:
    """Samples with labels and groups of the reference, which hold for images generated for the same ids.

    Raises:
        PalpateError: if the reference has some of the ids only: all samples would lose what it has.
    """
    lacking = [
        name
        for name in ("labels", "groups")
        if getattr(samples, name) is None and getattr(reference, name) is not None
    ]
    row = {i: k for k, i in enumerate(reference.ids)}
    unknown = [i for i in samples.ids if i not in row]
    if samples.numbered or reference.numbered or not lacking or len(unknown) == len(samples):
        return samples
    if unknown:
        raise PalpateError(
            f"{samples.source} must have ids of the reference alone, which gives {' and '.join(lacking)} by id",
            f"{len(unknown)} of {len(samples)} without, first {unknown[0]!r}",
            "Remove these, give them ids of the reference, or pass labels and groups for every id",
        )
    at = [row[i] for i in samples.ids]
    taken: dict[str, Any] = {name: _picked(getattr(reference, name), at) for name in lacking}
    if "groups" in lacking:
        taken["group"] = reference.group
    return replace(samples, **taken)


def _split_parts(real: Samples, split: Split) -> tuple[Samples, Samples | None]:
    """The test part of the reference, and its train part where it has all of it."""
    if real.numbered:
        fix = "Save it with ids, or score without a split"
        raise PalpateError("must go with a reference that has ids", real.source, fix, argument="split")  # fmt: skip
    part_of, known = split.parts, {*real.ids}
    if missing := [i for i in split.ids("test") if i not in known]:
        real.take(missing)  # raises
    test, train = ([i for i in real.ids if part_of.get(i) == part] for part in ("test", "train"))
    whole_train = train and len(train) == len(split.ids("train"))
    return real.take(test), real.take(train) if whole_train else None


def _test_part(
    name: str, samples: Samples, real: Samples, whole: Samples
) -> tuple[Samples, list[Note]]:
    """The generator's samples of the test part; ids that the reference lacks altogether stay as they are."""
    ids, wanted = {*samples.ids}, {*real.ids}
    if samples.numbered or ids.isdisjoint(whole.ids):
        return samples, []
    if missing := [i for i in real.ids if i not in ids]:
        raise PalpateError(
            f"{name!r} must have every sample of the split's test part",
            f"{len(missing)} of {len(wanted)} missing, first {missing[0]!r}",
            "Generate these too, or pass the split it was generated for",
        )
    part = samples.take([i for i in samples.ids if i in wanted])
    if len(part) == len(samples):
        return part, []
    counts = {"skipped": len(samples) - len(part), "n": len(samples)}
    return part, [Note("outside-test-part", {"name": name, **counts})]


def _one_group(sets: Sequence[Samples], requested: str) -> str | None:
    """What the groups are, the same for all; None where no set has groups.

    Raises:
        PalpateError: if sets have groups of two kinds, or lack those requested by name.
    """
    kinds = {s.source: s.group if s.groups else None for s in sets}
    for source, kind in kinds.items():
        if requested != "auto" and kind != requested:
            fix = "Pass groups with that column, or the default group"
            got = f"{requested!r} and {kind or 'no groups'} in {source}"
            raise PalpateError("must be known for every input", got, fix, argument="group")
    if len(named := {kind: source for source, kind in kinds.items() if kind}) > 1:
        got = " and ".join(f"{kind} in {source}" for kind, source in named.items())
        raise PalpateError("All groups must be of one kind", got, "Pass groups for every id", argument=None)  # fmt: skip
    return next(iter(named), None)
