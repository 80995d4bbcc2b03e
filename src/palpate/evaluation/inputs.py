"""What a call of :func:`palpate.evaluation.score` reads: aligned samples, and the encoders.

A source is a folder of images, a manifest, a folder of ``palpate generate``, a file of embeddings
(:mod:`palpate.evaluation.embedding_files`), an array or tensor of images or features, a list of
images or image files, or a :class:`palpate.core.FeatureSet`. The id of an
image in a folder is its path below the folder, with ``/`` and without the suffix. Rows without ids
are numbered.

What a source lacks is completed from the keyword ``labels`` (which also replaces what a source
has), then, for a generator, from the reference, by id. What is known of a part of the
ids only is an error: scores of some of the samples would pass for scores of all.
"""

from __future__ import annotations

import hashlib
import os
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
    quiet,
    read_json,
    require_regular,
    require_rows,
    short,
)
from palpate.core.digest import to_numpy
from palpate.core.features import is_missing
from palpate.evaluation.embedding_files import (
    GROUPS,
    LABELS,
    SUFFIXES,
    Embeddings,
    checked,
    first_of,
    read_embeddings,
    require_ids,
    text_column,
)

if TYPE_CHECKING:
    import polars as pl

    from palpate.data.manifest import Manifest
    from palpate.encoders.encoder_set import EncoderSet, Modality


Source = Any
KINDS = (
    "a folder of images, a manifest, a folder of palpate generate, or embeddings "
    f"({', '.join(SUFFIXES)})"
)
#: Decoded images of more bytes than this are kept in a file of the cache.
IN_MEMORY = 1 << 30


@dataclass(frozen=True)
class Samples:
    """Samples of one generator or the reference: ``features``, ``manifest`` or ``images`` is set.

    Attributes:
        source: path or name, for errors.
        ids: n distinct ids.
        numbered: whether the ids are row numbers, which pair nothing.
        labels, groups: n strings each ('' where unknown), or None.
        group: what the groups are: a column name, ``video`` for groups that came with features.
        manifest: image files (column ``tactile``; a reference may have ``vision``, ``background``).
        images: (n, h, w, 3) uint8.
        features: (n, d), possibly memory-mapped.
        encoder: digest of the encoder that made the features.
        path: file of the features.
        background: one no-contact image for all of a reference.
        generator: settings of ``palpate generate``, for its folders.
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
    background: Samples | None = None
    generator: Mapping[str, Any] | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def has_background(self) -> bool:
        """Whether every sample has its no-contact image, or there is one for all."""
        rows = self.manifest is not None and not self.manifest.table["background"].null_count()
        return rows or self.background is not None

    def take(self, ids: Sequence[str]) -> Samples:
        """The samples of ``ids``, in that order.

        Raises:
            PalpateError: if an id is missing.
        """
        must = f"{self.source} must have every id of the split's test part"
        at = require_rows(self.ids, ids, must, "Use the split that was made for it")
        groups = picked(self.groups, at)
        return replace(
            self,
            ids=list(ids),
            labels=picked(self.labels, at),
            groups=groups if groups and any(groups) else None,
            manifest=self.manifest and self.manifest.take(ids),
            images=None if self.images is None else self.images[at],
            features=None if self.features is None else self.features[at],
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
        sizes = {path: _image_size(path) for path in self.manifest.paths("tactile")}
        first = next(iter(sizes))
        if other := next((p for p, size in sizes.items() if size != sizes[first]), None):
            got = " and ".join("{} of {} x {}".format(p.name, *sizes[p]) for p in (first, other))
            must = f"All images of {self.source} must have one size for scores of pixels"
            fix, example = "Resize them, or request other companions", {"companions": ["fid"]}
            raise PalpateError(must, got, fix, example=example)
        return min(sizes[first])

    def pixels(
        self, size: int, cache: Path, progress: Progress, column: str = "tactile"
    ) -> NDArray[np.uint8]:
        """The images as squares, (n, size, size, 3); many of them memory-mapped from the cache."""
        from palpate.data.images import cached_images, load_images, square

        if column == "background" and self.background is not None:
            gel = self.background.pixels(size, cache, progress)[0]
            return np.broadcast_to(gel, (len(self), *gel.shape))
        if self.manifest is None:
            from PIL import Image

            images = cast("NDArray[np.uint8]", self.images)
            return np.stack([square(Image.fromarray(image), size) for image in images])
        if len(self) * size * size * 3 > IN_MEMORY:
            return cached_images(self.manifest, column, size, self.folder(cache, column), progress)
        return load_images(self.manifest.paths(column), size, progress=progress)

    def folder(self, cache: Path, column: str = "tactile") -> Path:
        """A folder of the cache for the bytes of these images, whatever their names and times."""
        return cache / short(self.image_digest(column))

    def image_digest(self, column: str = "tactile") -> str:
        """SHA-256 over id and bytes of every image, in any order: the same for a copied folder."""
        if self.manifest is None:
            images = cast("NDArray[np.uint8]", self.images)
            digests = [hashlib.sha256(image.tobytes()).hexdigest() for image in images]
        else:
            paths = self.manifest.paths(column)
            digests = [_file_digest(path, path.stat().st_ctime_ns) for path in paths]
        return digest_json(sorted(map(list, zip(self.ids, digests, strict=True))))

    @property
    def digest(self) -> str:
        """Digest of the images, or of the file of features."""
        if self.features is None:
            return self.image_digest()
        return digest_file(self.path) if self.path else self.feature_set(self.features, None).digest


def picked(column: Sequence[str] | None, at: Sequence[int]) -> list[str] | None:
    """Some entries of a column; None stays None."""
    return None if column is None else [column[k] for k in at]


@lru_cache(maxsize=1 << 20)
def _file_digest(path: Path, _changed: int) -> str:
    """SHA-256 of a file, read once per run unless its time of change differs."""
    return digest_file(path)


def _image_size(path: Path) -> tuple[int, int]:
    from palpate.data.images import BROKEN, opened, read_image

    try:
        with opened(path) as image:  # reads the header alone
            return image.size
    except BROKEN:
        return read_image(path).size  # raises the reason


def read(source: Source, name: str, group: str = "video") -> Samples:
    """Read one source, which errors call ``name`` if it is no path; see the head of this module.

    Raises:
        PalpateError: if it is nothing that can be scored, or empty.
    """
    if isinstance(source, str | Path):
        samples = _read_path(Path(source), group)
    elif isinstance(source, FeatureSet):
        labels, groups = map(_strings, (source.labels, source.groups))
        known = Embeddings(source.features, list(source.ids), labels, groups, source.encoder)
        samples = _of_embeddings(known, name)
    elif hasattr(source, "table") and hasattr(source, "root"):
        samples = _of_manifest(source, name, group)
    else:
        samples = _read_array(source, name)
    if not len(samples):
        raise PalpateError(f"There must be samples in {samples.source}", "none", f"Pass {KINDS}")
    return samples


def _strings(column: Sequence[Any] | None) -> list[str] | None:
    return None if column is None else ["" if is_missing(v) else str(v) for v in column]


def _read_path(path: Path, group: str) -> Samples:
    if not path.exists():
        raise PalpateError("What is scored must exist", f"nothing at {path}", f"Pass {KINDS}")
    require_regular(path)
    from palpate.data.manifest import Manifest, is_manifest

    if path.is_file() and not is_manifest(path):
        if path.suffix.lower() not in SUFFIXES:
            fix = "Pass one of these; pickles are never loaded"
            raise PalpateError(f"{path} must be {KINDS}", path.suffix or "no suffix", fix)
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


def require_utf8(what: str, text: str) -> None:
    """Raise if a path or a file name cannot be written down as UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise PalpateError(f"{what} must be UTF-8", ascii(text), "Rename it") from None


def _folder_rows(path: Path) -> list[dict[str, str]]:
    rows: dict[str, str] = {}
    for file in sorted(path.rglob("*")):
        relative = file.relative_to(path).as_posix()
        hidden = any(part.startswith(".") for part in relative.split("/"))
        if hidden or not is_image_file(file) or not file.is_file():
            continue
        require_utf8(f"File names in {path}", relative)
        if (name := without_suffix(relative)) in rows:
            must = f"Images in {path} must differ in name, suffixes aside"
            raise PalpateError(must, f"{rows[name]!r} and {relative!r}", "Rename one of them")
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
    if array.ndim != 4 or array.shape[3] not in (1, 3) or not (unit or array.dtype == np.uint8):
        must = f"{name} must be features (n, d), or images of uint8 or of floats in [0, 1]"
        raise PalpateError(must, f"{array.dtype} of shape {array.shape}", "Scale and reshape it")
    array = np.round(array * 255).astype(np.uint8) if unit else array
    return np.ascontiguousarray(np.broadcast_to(array, (*array.shape[:3], 3)))


#: Name of the reference in tables and errors.
REFERENCE = "reference"


@dataclass(frozen=True)
class Inputs:
    """Aligned samples.

    Attributes:
        generators: name -> samples.
        reference: the real samples; of a split, its test part.
        train: the train part of the reference, if there is a split and the reference has all of it.
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
    group: str,
    background: Source,
    split: Split | None,
    reserved: Sequence[str],
) -> Inputs:
    """Read and align everything that is scored; arguments as :func:`palpate.evaluation.score`.

    Raises:
        PalpateError: if a source is not readable, images are mixed with embeddings, or ids, labels
            or groups are known for a part of the samples only.
    """
    auto = str(split.rule.get("group", "video")) if split else "video"
    column = auto if group == "auto" else group
    sources = named_sources(generated, names, reserved)
    real = read(reference, REFERENCE, column)
    made = {name: read(source, name, column) for name, source in sources.items()}
    _require_one_kind([real, *made.values()])
    if background is not None:
        if real.features is not None:
            must, got = "must go with images", "embeddings"
            raise PalpateError(must, got, "Drop it", argument="background")
        real = replace(real, background=read([background], "background"))
    known = keywords_of(labels, column, exact=group != "auto")
    given = {i for keyword in known for i in keyword.values}
    real = complete(real, known)
    made = {
        name: complete(with_known_ids(s, [*real.ids, *given]), known) for name, s in made.items()
    }
    if known and not any(given & {*samples.ids} for samples in (real, *made.values())):
        raise PalpateError(f"{known[0].source} must hold ids of the samples", "other ids", "")
    if real.numbered:  # row k of a generator is not row k of the reference
        real = replace(real, ids=[f"{REFERENCE} {i}" for i in real.ids])
    made = {name: from_reference(samples, real) for name, samples in made.items()}
    notes: list[Note] = []
    train = None
    if split is not None:
        whole, real, train = real, *_parts(real, split)
        for name, samples in made.items():
            made[name], skipped = _test_part(name, samples, real, whole)
            notes += skipped
    if not len(real):
        fix = "Check the split: is its test part empty?"
        raise PalpateError("The reference must hold samples", "none", fix)
    return Inputs(made, real, train, _common_group([real, *made.values()], group) or column, notes)


def named_sources(
    generated: Source, names: Sequence[str] | None, reserved: Sequence[str]
) -> dict[str, Source]:
    """Name -> source of every generator; names must differ, and must not be those of a control."""
    if isinstance(generated, Mapping):
        sources = dict(cast("Mapping[str, Source]", generated))
    else:
        several = isinstance(generated, list | tuple) and not _is_image_list(generated)
        items: list[Source] = list(cast("Sequence[Source]", generated)) if several else [generated]
        if names and len(names) != len(items):
            must, got = "must name every generator", f"{len(names)} for {len(items)}"
            raise PalpateError(must, got, "Pass one name each", argument="names")
        chosen = list(names or [_name_of(item, k, len(items)) for k, item in enumerate(items)])
        if len(set(chosen)) < len(chosen) or "" in chosen:
            must, got = "must differ from generator to generator", ", ".join(map(repr, chosen))
            raise PalpateError(must, got, "Pass one name each", argument="names")
        sources = dict(zip(chosen, items, strict=True))
    if not sources:
        must = "must hold something to score"
        raise PalpateError(must, "nothing", f"Pass {KINDS}", argument="generated")
    if used := [name for name in sources if name in reserved]:
        must = f"must not be {' or '.join(map(repr, reserved))}, which the tables have already"
        got = f"{used[0]!r} for {sources[used[0]]}"
        raise PalpateError(must, got, "Pass another name", argument="names")
    return sources


def _is_image_list(items: Sequence[Any]) -> bool:
    """Whether a list holds images of one generator: PIL images, arrays (h, w, c), files."""
    return bool(items) and all(
        is_image_file(item)
        if isinstance(item, str | Path)
        else hasattr(item, "getbands") or getattr(item, "ndim", 0) == 3
        for item in items
    )


def _name_of(item: Source, k: int, count: int) -> str:
    if not isinstance(item, str | Path):
        return "generated" if count == 1 else f"generated {k + 1}"
    path = Path(os.path.realpath(item))
    name = path.stem if path.is_file() else path.name
    name = path.parent.name if name in ("touches", "images") else name
    return name.encode(errors="surrogateescape").decode(errors="replace")


def _require_one_kind(sets: Sequence[Samples]) -> None:
    """Raise if images are mixed with embeddings."""
    if len({s.features is None for s in sets}) > 1:
        kinds = {True: "images", False: "embeddings"}
        got = ", ".join(f"{s.source} ({kinds[s.features is None]})" for s in sets)
        must = "Generated and reference must both be images, or both embeddings"
        raise PalpateError(must, got, "Embed the images first, or pass them all")


@dataclass(frozen=True)
class _Keyword:
    """Labels or groups by id: field of :class:`Samples`, column, origin."""

    field: str
    column: str
    values: Mapping[str, str]
    source: str


def keywords_of(source: Source, group: str, *, exact: bool) -> list[_Keyword]:
    """The columns of the keyword ``labels``, which may hold groups as well."""
    if source is None:
        return []
    wanted = {"labels": LABELS, "groups": (group,) if exact else (group, *GROUPS)}
    table, where = _table(source)
    columns = {kind: first_of(table.columns, options) for kind, options in wanted.items()}
    if "id" not in table.columns or not any(columns.values()):
        must = f"{where} must have a column id, and {' or '.join(c[0] for c in wanted.values())}"
        got = f"the columns {', '.join(table.columns)}"
        raise PalpateError(must, got, "Add the column, or rename it")
    ids = text_column(table, "id", where)
    require_ids(ids, where)
    return [
        _Keyword(kind, c, dict(zip(ids, text_column(table, c, where), strict=True)), where)
        for kind, c in columns.items()
        if c
    ]


def _table(source: Source) -> tuple[pl.DataFrame, str]:
    """A CSV or Parquet file, a frame, id -> material, or one material per row, as a table."""
    import polars as pl

    from palpate.data.manifest import reading_parquet

    if isinstance(source, str | Path):
        path = Path(source)
        try:
            if path.suffix.lower() == ".parquet":
                with reading_parquet():
                    return pl.read_parquet(path, glob=False), str(path)
            return pl.read_csv(path, infer_schema=False, glob=False), str(path)  # 007 stays a name
        except Exception as error:  # polars raises many kinds
            got = str(error).splitlines()[0] if path.exists() else "no such file"
            fix = "Write one with the columns id, material, video"
            raise PalpateError(f"{path} must be a CSV or Parquet file", got, fix) from None
    if isinstance(source, pl.DataFrame):
        return source, "`labels`"
    values = source if isinstance(source, Mapping) else {str(k): v for k, v in enumerate(source)}
    columns = {"id": list(values), LABELS[0]: list(values.values())}
    return pl.DataFrame(columns), "`labels`"


def with_known_ids(samples: Samples, known: Sequence[str]) -> Samples:
    """Images whose ids are known ids but for the suffix take the known ids."""
    if samples.manifest is None:
        return samples
    exact, bare = {*known}, {without_suffix(i): i for i in reversed(known)}
    ids = [i if i in exact else bare.get(without_suffix(i), i) for i in samples.ids]
    if len(set(ids)) < len(ids):  # two names that one id could mean
        return samples
    import polars as pl

    table = samples.manifest.table.with_columns(pl.Series("id", ids, pl.String))
    return replace(samples, ids=ids, manifest=replace(samples.manifest, table=table))


def complete(samples: Samples, keywords: Sequence[_Keyword]) -> Samples:
    """Samples with labels and groups of the keywords; those without any id in a keyword stay."""
    for keyword in keywords:
        values, where = keyword.values, keyword.source
        if samples.numbered:
            if len(values) != len(samples):
                must = f"{samples.source}, which has no ids, must have as many rows as {where}"
                raise PalpateError(must, f"{len(samples)} and {len(values)}", "Give them ids")
            samples = replace(samples, ids=list(values), numbered=False)
        missing = [i for i in samples.ids if i not in values]
        if len(missing) == len(samples):
            continue
        if missing:
            got = f"{len(missing)} of {len(samples)} of {samples.source} without, "
            got += f"first {missing[0]!r}"
            raise PalpateError(f"Every id must be in {where}", got, "Add these rows")
        kind = keyword.column if keyword.field == "groups" else samples.group
        column = [values[i] for i in samples.ids]
        samples = replace(samples, **{keyword.field: column}, group=kind)
    return samples


def from_reference(samples: Samples, real: Samples) -> Samples:
    """Samples with labels and groups of the reference, which hold for images of the same ids."""
    lacking = [
        name
        for name in ("labels", "groups")
        if getattr(samples, name) is None and getattr(real, name) is not None
    ]
    row = {i: k for k, i in enumerate(real.ids)}
    unknown = [i for i in samples.ids if i not in row]
    if samples.numbered or not lacking or len(unknown) == len(samples):
        return samples
    if unknown:
        what = " and ".join(lacking)
        must = f"{samples.source} must have ids of the reference alone, which gives {what} by id"
        got = f"{len(unknown)} of {len(samples)} without, first {unknown[0]!r}"
        fix = "Remove these, give them ids of the reference, or pass labels and groups for every id"
        raise PalpateError(must, got, fix)
    at = [row[i] for i in samples.ids]
    taken: dict[str, Any] = {name: picked(getattr(real, name), at) for name in lacking}
    group = real.group if "groups" in lacking else samples.group
    return replace(samples, **taken, group=group)


def _parts(real: Samples, split: Split) -> tuple[Samples, Samples | None]:
    """The test part of the reference, and its train part if it has all of it."""
    if real.numbered:
        must, fix = "must go with a reference that has ids", "Save it with ids"
        raise PalpateError(must, real.source, fix, argument="split")
    known = {*real.ids}
    real.take([i for i in split.ids("test") if i not in known])  # raises for missing ids
    test, train = ([i for i in real.ids if split.parts.get(i) == p] for p in ("test", "train"))
    whole = train and len(train) == len(split.ids("train"))
    return real.take(test), real.take(train) if whole else None


def _test_part(
    name: str, samples: Samples, real: Samples, whole: Samples
) -> tuple[Samples, list[Note]]:
    """The samples of the test part; all of them if the reference has none of their ids."""
    ids, wanted = {*samples.ids}, {*real.ids}
    if samples.numbered or ids.isdisjoint(whole.ids):
        return samples, []
    if missing := [i for i in real.ids if i not in ids]:
        must = f"{name!r} must have every sample of the split's test part"
        got = f"{len(missing)} of {len(wanted)} missing, first {missing[0]!r}"
        fix = "Generate these too, or pass the split it was generated for"
        raise PalpateError(must, got, fix)
    part = samples.take([i for i in samples.ids if i in wanted])
    skipped = {"name": name, "skipped": len(samples) - len(part), "n": len(samples)}
    return part, [Note("outside-test-part", skipped)] if skipped["skipped"] else []


def _common_group(sets: Sequence[Samples], requested: str) -> str | None:
    """What the groups are, the same for all; None where no set has groups."""
    kinds = {s.source: s.group if s.groups else None for s in sets}
    if requested != "auto":
        for source, kind in kinds.items():
            if kind != requested:
                got = f"{requested!r} and {kind or 'no groups'} in {source}"
                fix = "Pass groups with that column, or the default group"
                raise PalpateError("must be known for every input", got, fix, argument="group")
    known = {kind: source for source, kind in kinds.items() if kind}
    if len(known) > 1:
        got = " and ".join(f"{kind} in {source}" for kind, source in known.items())
        raise PalpateError("All groups must be of one kind", got, "Pass groups for every id")
    return next(iter(known), None)


def load_encoders(encoder: Any, progress: Progress) -> Any:
    """An ``EncoderSet``, loaded where it is a name or a folder."""
    if encoder is None or not isinstance(encoder, str | Path):
        return encoder
    progress(f"loading {encoder}", 0, 0)
    from palpate.encoders.models import find_encoder, parts_of

    for part in parts_of(encoder):
        find_encoder(part)  # a wrong name answers at once; torch takes seconds to import
    from palpate.encoders.encoder_set import EncoderSet

    encoders = EncoderSet.load(encoder, device="auto")
    progress(f"loading {encoder}", 1, 1)
    return encoders


def guard(
    encoders: EncoderSet,
    modality: Modality,
    images: Manifest | NDArray[Any],
    *,
    split: Split | None = None,
    allow_seen: bool = False,
    progress: Progress = quiet,
) -> list[Note]:
    """Raise if an encoder was trained on the images that it judges (paper, section 5).

    What it was trained on is known by the decoded pixels or, of public encoders, by the data sets
    that their authors name. Neither depends on the split: an encoder that was trained on another
    split of the same data may judge this one if it has seen none of its images.

    Args:
        encoders: the set.
        modality: whose encoder judges; of a text encoder no image is known.
        images: what is judged: a manifest, or (n, h, w, 3) uint8.
        split: of which ``images`` are the test part.
        allow_seen: add a note where the guard would raise.
        progress: called with the number of images compared.

    Returns:
        What readers must know of every score that the encoder makes of these images.

    Raises:
        PalpateError: if the encoder has seen some of the images, or declares their data set.
    """
    from PIL import Image

    judged: Any = [*map(Image.fromarray, images)] if isinstance(images, np.ndarray) else images
    origin, seen = encoders.origin(modality), encoders.saw(modality, judged, progress=progress)
    dataset = str(getattr(images, "facts", {}).get("dataset") or "").lower()
    declared = [name for name in (origin.trained_on if origin else ()) if name.lower() in dataset]
    notes, got = list[Note](), ""
    if seen.any():
        params: dict[str, Any] = {"modality": modality, "seen": int(seen.sum()), "n": len(seen)}
        notes = [Note("seen-images", params)]
        got = f"{params['seen']:,} of {len(seen):,} that it was trained on"
    elif declared:
        params = {"modality": modality, "dataset": " and ".join(declared)}
        notes = [Note("seen-dataset", params)]
        got = f"images of {params['dataset']}, with which its authors trained it"
    if notes and not allow_seen:
        must = f"The {modality} encoder must judge images that it has not seen"
        fix = "Judge other images or use another encoder, or allow it: every score then says so"
        raise PalpateError(must, got, fix, example={"allow_seen": True})
    if origin:
        params = {"modality": modality, "name": origin.name, "license": origin.license}
        notes.append(Note("encoder-license", params))
        if origin.trained_on and not declared and not getattr(images, "synthetic", False):
            params = {"modality": modality, "sets": ", ".join(origin.trained_on)}
            notes.append(Note("pretraining-sets", params))
    if modality != "tactile":
        return notes
    card, simulated = encoders.card, getattr(images, "synthetic", None)
    if card.get("synthetic") and not simulated:
        notes.append(Note("synthetic-encoder", {"real": simulated is False}))
    unknown = origin is None and not encoders.knows_seen(modality)
    if split is not None and unknown and card.get("split") != split.digest:
        known = card.get("split") is not None
        notes.append(Note("encoder-of-other-split" if known else "encoder-without-split"))
    return notes
