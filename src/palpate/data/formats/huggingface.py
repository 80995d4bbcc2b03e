"""Hugging Face data sets, through the library ``datasets`` (the extra ``hf``).

::

    root/  dataset_dict.json  train/ test/ ...      a folder written by ``save_to_disk``, or
           *.parquet  data/*.parquet                Parquet shards, or an image folder;
    user/name                                       or a data set of the hub, of Parquet shards

Columns become manifest columns by their names or by map expressions (:mod:`palpate.data.mapping`);
in an expression an image is its file name, a class label its name. Images are written to
``out/images`` byte for byte as they were stored, equal ones once. A column of texts may name images
too, as paths inside the source. The parts train, validation and test become the split ``Orig``.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, Progress, atomic_path, inside, quiet, require
from palpate.data.formats.huggingface_source import Source, first_line, open_source
from palpate.data.images import Check, Checked, check_image
from palpate.data.manifest import IMAGE_COLUMNS, PART_NAMES, SCHEMA
from palpate.data.mapping import LINE, ColumnMaps, compile_maps, text_of
from palpate.data.rows import manifest_rows, odd_groups, read_classes, records
from palpate.data.scanning import Facts, Format, Into, Scan
from palpate.data.suspicions import evenly, looks_of

LOOKS_FOR = (
    "a folder written by save_to_disk of the library datasets, or of Parquet shards; for a name on "
    "the hub say that the format is hf"
)
FACTS = Facts(
    name="Hugging Face data set",
    url="https://huggingface.co/docs/datasets",
    samples="as many as the data set has rows",
    group="the column video, if there is one",
)
BATCH = 64
Batch = Mapping[str, list[Any]]
#: Suffixes that differ from the name of Pillow's format.
SUFFIXES = {"JPEG": ".jpg", "MPO": ".jpg", "TIFF": ".tif"}


def detect(source: Path) -> bool:
    """Whether a folder was written by ``save_to_disk`` or holds Parquet shards, but no manifest."""
    saved = (("dataset_dict.json",), ("state.json", "dataset_info.json"))
    if any(all((source / name).is_file() for name in names) for names in saved):
        return True
    shards = any(any((source / folder).glob("*.parquet")) for folder in (".", "data"))
    return source.is_dir() and shards and not (source / "manifest.parquet").is_file()


def scan(
    source: Path,
    *,
    columns: Mapping[str, str] | None = None,
    classes: Path | None = None,
    config: str | None = None,
    revision: str | None = None,
    check: Check = "decode",
    into: Into | None = None,
    progress: Progress = quiet,
) -> Scan:
    """Read a data set; without ``into`` nothing is written, and rows carry no paths of images.

    Options:
        columns: manifest column -> map expression over the data set's columns.
        classes: table of classes, for labels that are bare numbers.
        config: which configuration of the data set.
        revision: of a hub data set: branch, tag or commit.
    """
    opened = open_source(source, config, revision)
    maps = compile_maps(columns or {}, opened.names, list(SCHEMA))
    if not {"vision", "tactile"} & set(maps.expressions):
        got = f"no vision and no tactile among {', '.join(opened.names) or 'no columns'}"
        must, example = f"{opened.name} must have a column for the images", {"vision": "COLUMN"}
        raise PalpateError(must, got, "Map your columns", example={"columns": example})
    names = dict(enumerate(opened.labels.get(maps.source("material") or "", ()))) or None
    names = read_classes(classes) or names
    folder, created = (into.out / "images", into.created) if into else (None, list[Path]())
    store = _Store(folder, created, check)
    result = Scan(folder or opened.folder or Path(), dict(opened.facts))
    total = sum(len(data) for data in opened.splits.values() if hasattr(data, "__len__"))
    for split, first, batch in _batches(opened):
        _add(result, opened, maps, store, classes=names, split=split, first=first, batch=batch)
        progress("reading rows", first + len(next(iter(batch.values()))), total)
    parts = sorted(split for split in opened.splits if split in PART_NAMES)
    if len(parts) > 1:
        result.split_rule = {"parts": parts}
    result.state_texts(f"column {maps.texts.get('text', 'text')}")
    result.suspicious = odd_groups(Path(opened.name), result.rows)
    if check == "decode":
        usable = {path: store.checked[digest] for digest, path in store.paths.items()}
        result.looks = looks_of(evenly(row for _, row in result.rows), folder, usable)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    for _, row in result.rows if folder is None else ():
        row |= dict.fromkeys(IMAGE_COLUMNS)
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan, remote=True)


@dataclass
class _Store:
    """Writes images to a folder, equal bytes once; without a folder it only checks them."""

    folder: Path | None
    created: list[Path]
    check: Check
    checked: dict[bytes, Checked] = field(default_factory=dict)
    paths: dict[bytes, str] = field(default_factory=dict)

    def put(self, data: bytes, default: str) -> str | tuple[str, str]:
        """Put an image where its bytes are already, else at ``default`` + suffix.

        Returns:
            Its path below the folder, or what is wrong as (kind, text).
        """
        digest = hashlib.blake2b(data, digest_size=16).digest()
        if digest not in self.checked:
            self.checked[digest] = check_image(io.BytesIO(data), self.check)
        checked = self.checked[digest]
        if checked.problem:
            return "bad-image", checked.problem
        suffix = SUFFIXES.get(checked.form, f".{checked.form.lower()}")
        if digest not in self.paths and self.folder is not None:
            self._write(self.folder / f"{default}{suffix}", data)
        return self.paths.setdefault(digest, default + suffix)

    def _write(self, path: Path, data: bytes) -> None:
        if not path.is_file():
            self.created.append(path)
            with atomic_path(path, flush=False) as part:
                part.write_bytes(data)
        else:
            must, fix = "Images of an earlier import must be the same", "Choose another folder"
            require(path.read_bytes() == data, None, must, f"another one at {path}", fix=fix)


def _batches(source: Source) -> Iterator[tuple[str, int, Batch]]:
    """(part, number of its first row, cells by column)."""
    for split, data in source.splits.items():
        first = 0
        try:
            for batch in data.iter(batch_size=BATCH):
                yield split, first, batch
                first += len(next(iter(batch.values())))
        except PalpateError:
            raise
        except Exception as error:  # of the library, or of Arrow below it
            must = f"{source.name}/{split}".rstrip("/") + " must be readable to its end"
            got = f"{first_line(error)} after row {first}"
            raise PalpateError(must, got, "Fetch it again") from None


def _add(
    result: Scan,
    source: Source,
    maps: ColumnMaps,
    store: _Store,
    *,
    classes: Mapping[int, str] | None,
    split: str,
    first: int,
    batch: Batch,
) -> None:
    """Add the usable rows of a batch from row ``first`` on; ``store`` takes their images."""

    def place(line: int) -> str:
        return f"{source.name}/{split}:{line}".replace("/:", ":")

    images = [target for target in IMAGE_COLUMNS if target in maps.expressions]
    stored = {t: column for t in images if (column := maps.source(t)) in source.images}
    plain, material = maps.without(list(stored)), maps.source("material")
    texts = {
        name: _texts(source, name, batch[name], keep=name == material) for name in plain.columns
    }
    lines = pl.int_range(first, first + len(next(iter(batch.values()))), eager=True).alias(LINE)
    table = pl.DataFrame([lines, *(pl.Series(n, v, pl.String) for n, v in texts.items())])
    rows, inconclusive = manifest_rows(plain.apply(table), place, classes, result.problems)
    result.inconclusive += inconclusive
    for line, (where, row) in zip(rows[LINE], records(rows, place), strict=True):
        if not {"video", "frame"} <= set(row):
            row.setdefault("id", Path(split, f"{line:08d}").as_posix())
        good = True
        for target in images:
            column = stored.get(target)
            cell = batch[column][line - first] if column else row.get(target)
            path = _bytes(source, cell)
            if isinstance(path, bytes):
                default = Path(split or "all", target, f"{line:08d}")
                path = store.put(path, default.as_posix())
            if path is None and target != "background":
                path = "missing-image", "no image"
            if isinstance(path, tuple):
                result.problem(where, path[0], f"{target}: {path[1]}")
                good = False
            row[target] = path
        if good:
            row["split"] = PART_NAMES.get(split)
            result.rows.append((where, row))


def _texts(source: Source, name: str, values: list[Any], *, keep: bool) -> list[str | None]:
    """Cells as texts: an image is its file name, a class label its name.

    With ``keep`` labels that are no class (-1: unclear) stay numbers.
    """
    if name in source.images:
        return [None if v is None else text_of(v["path"]) for v in values]
    if name in source.labels:
        names = dict(enumerate(source.labels[name]))
        return [names.get(v, text_of(v) if keep else None) for v in values]
    if any(isinstance(v, (list, dict, bytes)) for v in values):
        must = f"Columns of {source.name} must hold texts, numbers or images"
        raise PalpateError(must, f"{name} with lists or objects", "Map another column")
    return [text_of(v) for v in values]


def _bytes(source: Source, value: Any) -> bytes | tuple[str, str] | None:
    """The bytes of a stored or named image; else what is wrong, or None where there is none."""
    if isinstance(value, dict) and value.get("bytes") is not None:
        return bytes(value["bytes"])
    path = value.get("path") if isinstance(value, dict) else value
    if not path:
        return None
    inner = None if source.folder is None else inside(source.folder, str(path))
    if inner is None:
        text = f"the path {path!r} leaves the data set, and the image is not stored in it"
        return "outside-root", text
    return inner.read_bytes() if inner.is_file() else ("missing-file", f"no file {path!r}")
