"""Hugging Face data sets, through the library ``datasets`` (the extra ``hf``): folders and names on the hub.

A source is a folder written by ``save_to_disk``, a folder of Parquet shards or an image folder, or (named with the format) a data set
of the hub, ``user/name``, of Parquet shards. Nothing else is opened: no scripts, no pickles. Columns become manifest columns
by their names or by map expressions (:mod:`palpate.data.mapping`); in an expression the value of an image is its file name, that of a
class label its name. Images are written to ``out/images`` byte for byte as they were stored; equal ones once. A column of texts may
name images too, as paths inside the source. The parts train, validation and test become the split ``Orig``.

What ``palpate export --to hf`` wrote comes back whole: the same rows in the same order, the same paths, bytes, facts and digest. It holds,
beside the images ``vision``, ``tactile`` and ``background``, their paths as ``vision_path`` ..., the rows' places as ``palpate_row``, and
in the description JSON with the facts.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars as pl
from PIL import Image

from palpate.core import PalpateError, Problem, Progress, atomic_path, inside, quiet
from palpate.data.formats.base import Facts, Found, Scan, import_scanned
from palpate.data.formats.huggingface_source import ROW, Source, one_line, open_source
from palpate.data.images import BROKEN, Check
from palpate.data.imported import Imported, removing_on_error
from palpate.data.listing import INCONCLUSIVE
from palpate.data.manifest import CLIMBS, IMAGE_COLUMNS, SCHEMA
from palpate.data.mapping import ColumnMaps, compile_maps, text_of
from palpate.data.rows import PART_NAMES, manifest_rows, odd_groups, read_classes
from palpate.data.tables import LINE

LOOKED_FOR = "a folder written by datasets' save_to_disk, or of Parquet shards; a name on the hub with --format hf"
FACTS = Facts(
    "Hugging Face data set",
    "unknown",
    "unknown",
    "https://huggingface.co/docs/datasets",
    "unknown",
    None,
    "as many as the data set has rows",
    "the column video, if there is one",
)
BATCH = 64
SUFFIX_OF = {
    "JPEG": ".jpg",
    "MPO": ".jpg",
    "PNG": ".png",
    "WEBP": ".webp",
    "BMP": ".bmp",
    "TIFF": ".tif",
    "GIF": ".gif",
}


@dataclass
class _Pictures:
    """Writes images to a folder, equal bytes once; with no folder it only looks at them."""

    folder: Path | None
    created: list[Path]
    how: Check
    known: dict[bytes, str] = field(default_factory=dict)
    bad: dict[bytes, str] = field(default_factory=dict)
    taken: dict[str, bytes] = field(default_factory=dict)

    def put(self, data: bytes, path: str | None, otherwise: str) -> str | tuple[str, str]:
        """Puts an image at ``path``, else where its bytes are already, else at ``otherwise`` and a suffix.

        Returns:
            Its path below the folder, or what is wrong as (kind, text).
        """
        mark = hashlib.blake2b(data, digest_size=16).digest()
        if mark not in self.known and mark not in self.bad:
            kind, reason = _looked_at(data, self.how)
            if reason:
                self.bad[mark] = reason
            else:
                self.known[mark] = path or otherwise + SUFFIX_OF.get(kind, f".{kind.lower()}")
        if mark in self.bad:
            return "bad-image", self.bad[mark]
        path = path or self.known[mark]
        if (before := self.taken.setdefault(path, mark)) != mark:
            return "duplicate-path", f"another image of the data set has the path {path!r}"
        if self.folder is not None and before is mark:
            self._write(self.folder / path, data)
        return path

    def _write(self, path: Path, data: bytes) -> None:
        if path.is_file():
            if path.read_bytes() != data:
                raise PalpateError(
                    "Images of an earlier import must be the same",
                    f"another one at {path}",
                    "Choose another folder, or remove it",
                )
            return
        self.created.append(path)
        with atomic_path(path) as part:
            part.write_bytes(data)


def detect(source: Path) -> bool:
    """Whether a folder was written by ``save_to_disk``, or holds Parquet shards (but no manifest)."""
    if not source.is_dir():
        return False
    if (source / "dataset_dict.json").is_file() or all(
        (source / n).is_file() for n in ("state.json", "dataset_info.json")
    ):
        return True
    return not (source / "manifest.parquet").is_file() and any(
        next((source / p).glob("*.parquet"), None) for p in (".", "data")
    )


def scan(
    source: Path,
    *,
    columns: Mapping[str, str] | None = None,
    classes: Path | None = None,
    config: str | None = None,
    revision: str | None = None,
    check: Check = "decode",
    progress: Progress = quiet,
) -> Scan:
    """Looks a data set over without writing anything; rows carry no paths of images.

    Args:
        source: folder, or name on the hub.
        columns: manifest column -> map expression over the data set's columns.
        classes: table of classes, for labels that are bare numbers.
        config: which configuration of the data set.
        revision: of a hub data set: branch, tag or commit.
        check: how images are checked.
        progress: told how many rows are read.

    Raises:
        PalpateError: if the source cannot be opened or lacks a needed column.
        MissingExtraError: if ``datasets`` is not installed.
    """
    found = _scan(
        open_source(source, config, revision),
        columns,
        classes,
        _Pictures(None, [], check),
        progress,
    )
    found.rows = [
        (where, {k: v for k, v in row.items() if k not in IMAGE_COLUMNS})
        for where, row in found.rows
    ]
    return found


def run(
    source: Path,
    out: Path,
    *,
    columns: Mapping[str, str] | None = None,
    classes: Path | None = None,
    config: str | None = None,
    revision: str | None = None,
    skip_bad: bool = False,
    check: Check = "decode",
    progress: Progress = quiet,
) -> Imported:
    """Imports a data set; its images go to ``out/images``, which becomes the manifest's root.

    Args:
        source: folder, or name on the hub.
        out: folder to write to.
        columns: manifest column -> map expression over the data set's columns.
        classes: table of classes, for labels that are bare numbers.
        config: which configuration of the data set.
        revision: of a hub data set: branch, tag or commit.
        skip_bad: leave bad rows out and list them, instead of raising.
        check: how images are checked.
        progress: told how many rows are read.

    Raises:
        PalpateError: if the source cannot be opened or lacks a needed column.
        ProblemsError: with every bad row at once, unless ``skip_bad``; nothing is left behind.
        MissingExtraError: if ``datasets`` is not installed.
    """
    opened = open_source(source, config, revision)
    with removing_on_error(out) as created:
        found = _scan(
            opened, columns, classes, _Pictures(Path(out) / "images", created, check), progress
        )
        found.base.mkdir(parents=True, exist_ok=True)
        return import_scanned(
            found, Path(source), Path(out), {}, skip_bad=skip_bad, check="none", progress=progress
        )


def _scan(
    source: Source,
    columns: Mapping[str, str] | None,
    classes: Path | None,
    pictures: _Pictures,
    progress: Progress,
) -> Scan:
    """Reads all rows, putting their images where ``pictures`` does."""
    expressions = compile_maps(columns or {}, source.names, list(SCHEMA))
    sides = [side for side in IMAGE_COLUMNS[:2] if side in expressions.expressions]
    if not sides:
        got = f"no vision and no tactile among {', '.join(source.names) or 'no columns'}"
        raise PalpateError(
            f"{source.name} must have a column for the images",
            got,
            "Map it: --map vision=YOUR_COLUMN",
        )
    known = None if classes is None else read_classes(Path(classes))
    problems: list[Problem] = []
    places: dict[int, int] = {}
    found = Scan([], pictures.folder or source.folder or Path(), problems, facts=dict(source.facts))
    parts: set[str] = set()
    total = sum(len(data) for data in source.splits.values() if hasattr(data, "__len__"))
    for split, first, batch in _batches(source):
        rows, unclear = _batch_rows(
            source, expressions, split, first, batch, known, pictures, problems
        )
        found.inconclusive += unclear
        for k, (where, row) in rows:
            if ROW in batch:
                places[len(found.rows)] = int(batch[ROW][k - first])
            if split in PART_NAMES:
                row["split"] = PART_NAMES[split]
                parts.add(row["split"])
            found.rows.append((where, row))
        progress("reading rows", first + len(next(iter(batch.values()))), total)
    if len(places) == len(found.rows):
        found.rows = [found.rows[k] for k in sorted(places, key=places.__getitem__)]
    if len(parts) > 1:
        rule = source.about.get("rule") or {
            "method": "official",
            "parts": sorted(s for s in source.splits if s in PART_NAMES),
        }
        found.own, found.rules = "Orig", {"Orig": dict(rule)}
    words = any("text" in row for _, row in found.rows)
    found.facts.setdefault(
        "text_source", f"column {(columns or {}).get('text', 'text')}" if words else "none"
    )
    found.suspicious = odd_groups(Path(source.name), found.rows)
    return found


def _batches(source: Source) -> Iterator[tuple[str, int, Mapping[str, list[Any]]]]:
    """(part, number of its first row, cells by column).

    Raises:
        PalpateError: if a file of the data set breaks off.
    """
    for split, data in source.splits.items():
        first = 0
        try:
            for batch in data.iter(batch_size=BATCH):
                yield split, first, batch
                first += len(next(iter(batch.values())))
        except PalpateError:
            raise
        except Exception as error:  # of the library, or of Arrow below it
            place = f"{source.name}/{split}".rstrip("/")
            raise PalpateError(
                f"{place} must be readable to its end",
                f"{one_line(error)} after row {first}",
                "Fetch it again",
            ) from None


def _batch_rows(
    source: Source,
    maps: ColumnMaps,
    split: str,
    first: int,
    batch: Mapping[str, list[Any]],
    classes: Mapping[int, str] | None,
    pictures: _Pictures,
    problems: list[Problem],
) -> tuple[list[tuple[int, Found]], int]:
    """The usable rows of a batch by their numbers in the part."""
    count = len(next(iter(batch.values())))
    where = lambda k: f"{source.name}/{split}:{first + k}".replace("/:", ":")  # noqa: E731
    inner = {
        target: column
        for target in IMAGE_COLUMNS
        if (column := maps.source(target)) is not None and column in source.images
    }
    plain = maps.without(list(inner))
    texts = {
        name: pl.Series(_texts(source, name, batch[name]), dtype=pl.String)
        for name in plain.columns
    }
    cells = plain.apply(pl.DataFrame({LINE: range(first, first + count), **texts}))
    told: list[Problem] = []
    rows, unclear = manifest_rows(cells, count, where, classes, told)
    inconclusive, unknown = _labels(source, plain, batch)
    left = {where(k) for k in inconclusive | unknown.keys()}
    problems += [p for p in told if p.where not in left]
    problems += [Problem(where(k), "unknown-label", text) for k, text in unknown.items()]
    rows = [(k, row) for k, row in rows if where(k) not in left]
    unclear += len(inconclusive)
    good: list[tuple[int, Found]] = []
    for k, row in rows:
        wrong: list[tuple[str, str]] = []
        row.setdefault(
            "id",
            f"{row['video']}/{row['frame']}"
            if "video" in row and "frame" in row
            else f"{split}/{first + k:08d}".lstrip("/"),
        )
        for target in (t for t in IMAGE_COLUMNS if t in maps.expressions):
            column = inner.get(target)
            data = _bytes(source, row.get(target) if column is None else batch[column][k])
            if isinstance(data, bytes):
                given = (
                    batch[f"{target}_path"][k]
                    if source.about and f"{target}_path" in batch
                    else None
                )
                safe = given if given and not re.search(CLIMBS, given) else None
                data = pictures.put(data, safe, f"{split or 'all'}/{target}/{first + k:08d}")
            if isinstance(data, tuple):
                wrong.append((data[0], f"{target}: {data[1]}"))
            elif data is not None:
                row[target] = data
            elif target != "background":
                wrong.append(("missing-image", f"no {target} image"))
        problems += [Problem(where(k), *w) for w in wrong]
        if not wrong:
            good.append((first + k, (where(k), row)))
    return good, unclear


def _labels(
    source: Source, plain: ColumnMaps, batch: Mapping[str, list[Any]]
) -> tuple[set[int], dict[int, str]]:
    """Rows whose material is the class -1, which is inconclusive, and row -> what is wrong with its number of a class."""
    inconclusive: set[int] = set()
    unknown: dict[int, str] = {}
    for target, name in (
        (target, name)
        for target, expression in plain.expressions.items()
        for name in expression.meta.root_names()
        if name in source.labels
    ):
        count = len(source.labels[name])
        for k, v in enumerate(batch[name]):
            if v == INCONCLUSIVE and target == "material":
                inconclusive.add(k)
            elif v is not None and v != INCONCLUSIVE and not 0 <= v < count:
                unknown[k] = (
                    f"the column {name} has {count} classes, counted from 0, and none of the number {v}"
                )
    return inconclusive - unknown.keys(), unknown


def _texts(source: Source, name: str, values: Sequence[Any]) -> list[str | None]:
    """Cells as texts: an image is its file name, a class label its name.

    Raises:
        PalpateError: if the column holds lists or objects.
    """
    if name in source.images:
        return [None if v is None else text_of(v["path"]) for v in values]
    if name in source.labels:
        classes = source.labels[name]
        return [
            classes[v] if isinstance(v, int) and 0 <= v < len(classes) else None for v in values
        ]
    if any(isinstance(v, (list, dict, bytes)) for v in values):
        raise PalpateError(
            f"Columns of {source.name} must hold texts, numbers or images",
            f"{name} with lists or objects",
            "Map another column",
        )
    return [text_of(v) for v in values]


def _bytes(source: Source, value: Any) -> bytes | tuple[str, str] | None:
    """The stored bytes of an image, or those of the file that it names; else what is wrong, or None where there is none."""
    if isinstance(value, dict) and value.get("bytes") is not None:
        return bytes(value["bytes"])
    path = value.get("path") if isinstance(value, dict) else value
    if not path:
        return None
    place = None if source.folder is None else inside(source.folder, str(path))
    if place is None:
        return (
            "outside-root",
            f"the path {path!r} leaves the data set, and the image is not stored in it",
        )
    return place.read_bytes() if place.is_file() else ("missing-file", f"no file {path!r}")


def _looked_at(data: bytes, how: Check) -> tuple[str, str | None]:
    """(format of an image, why it is unusable or None)."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            kind = str(image.format)
            if how == "decode":
                image.draft("L", (max(1, image.width // 8), max(1, image.height // 8)))
                image.load()
            return kind, None
    except Image.UnidentifiedImageError:
        return "", "not an image" if data else "an empty file (0 bytes)"
    except BROKEN as error:
        return "", str(error) or type(error).__name__
