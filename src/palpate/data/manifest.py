"""The manifest: a table with one row per sample, a root folder and a digest.

=============  =======  ==========================================================================
column         type     meaning (null where the data set has none; never invented)
=============  =======  ==========================================================================
``id``         string   unique; ``video/frame`` for video data
``video``      string   the continuous recording it comes from
``frame``      int      position in both videos of the recording
``contact``    string   the run of consecutive in-contact frames it belongs to, unique across videos
``object``     string   the object
``session``    string   recordings made in one sitting, of which neighbors may share the object
``material``   string   class name
``text``       string   how the surface feels, in words
``vision``     string   path of the photo, relative to the root
``tactile``    string   path of the tactile image
``background`` string   path of a tactile image without contact
``sensor``     string   sensor or gel unit
``domain``     string   recording condition that changes the look (rig, lighting)
=============  =======  ==========================================================================

What is known of a contact may follow, numbers that condition a generator: ``at_x``, ``at_y`` (its
place in shares of width and height, from the top left), ``area`` (share of the gel), ``strength``
(any unit that rises), ``shear_x``, ``shear_y`` (% of the width, right and down), ``force`` (N),
``depth`` (mm). Then further columns of text, named by the user. Paths use ``/`` and may not leave
the root. The digest is SHA-256 over the rows in order; it does not depend on the root, so a data
set has one digest on every disk.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl

from palpate.core import (
    PARTS,
    PalpateError,
    Problem,
    ProblemsError,
    SampleRef,
    Split,
    atomic_path,
    digest_lines,
    fact_lines,
    got_and_fix,
    inside,
    require,
    require_choice,
)
from palpate.core.files import LARGEST
from palpate.core.images import SUFFIXES
from palpate.core.messages import require_rows
from palpate.core.shown import Shown

if TYPE_CHECKING:
    from palpate.data.dataset import SampleDataset, Transform

IMAGE_COLUMNS = ("vision", "tactile", "background")
_WORDS = ("video", "frame", "contact", "object", "session", "material", "text")
SCHEMA: dict[str, type[pl.DataType]] = {
    **dict.fromkeys(("id", *_WORDS, *IMAGE_COLUMNS, "sensor", "domain"), pl.String),
    "frame": pl.Int64,
}
#: What may be known of a contact.
CONTACT = ("at_x", "at_y", "area", "strength", "shear_x", "shear_y", "force", "depth")
#: The column of the paths that a list names, whose images are not at hand.
PATH = "path"
#: Column -> words that say that an image belongs there.
ROLES = {
    "vision": ("vision", "visual", "rgb", "photo", "photos", "camera", "cam", "color", "webcam"),
    "tactile": ("tactile", "touch", "touches", "tac", "gelsight", "gel", "digit", "gelslim"),
    "background": ("background", "backgrounds", "bg", "nocontact"),
}
ROLE_OF = {word: role for role, words in ROLES.items() for word in words}
#: The images of a pair.
SIDES = ("vision", "tactile")
FORMAT = "palpate-manifest/1"
#: Prefix of the keys of facts in the metadata.
FACT = "palpate.fact."
#: The fact ``links`` where images were met behind links that leave the root.
FOLLOWED = "followed"
#: Digits of a frame number, which has 64 bits; a longer one is none.
DIGITS = 18
#: What tools call the parts of a split.
_SPLIT = {part: part for part in PARTS} | {"training": "train", "testing": "test"}
PART_NAMES = _SPLIT | dict.fromkeys(("validation", "validate", "valid", "dev"), "val")
#: Absolute paths, drive letters, and ``..`` as a component.
CLIMBS = r"^[/\\]|^[A-Za-z]:[/\\]|(?:^|[/\\])\.\.(?:[/\\]|$)"


@dataclass(frozen=True)
class Manifest(Shown):
    """Samples and where their images are.

    Attributes:
        table: the rows: the columns of ``SCHEMA``, then further ones of text.
        root: folder that the image paths are relative to.
        facts: facts about the source (``dataset``, ``text_source`` ...), kept in the file, not in
            the digest.
        guarded: whether links out of the root are refused: in a file of others.
    """

    table: pl.DataFrame
    root: Path
    facts: Mapping[str, str] = field(default_factory=dict)
    guarded: bool = False

    @classmethod
    def from_rows(
        cls,
        rows: Iterable[Mapping[str, Any]],
        root: Path,
        facts: Mapping[str, str] | None = None,
        more: Iterable[str] = (),
    ) -> Manifest:
        """Make a manifest of dictionaries; absent columns become null, ``more`` are further ones.

        Raises:
            PalpateError: on an unknown column.
        """
        rows, schema = list(rows), SCHEMA | {name: _further(name) for name in more}
        if unknown := sorted({name for row in rows for name in row} - set(schema)):
            must, fix = f"must have columns among {', '.join(SCHEMA)}", "Rename or drop the column"
            raise PalpateError(must, repr(unknown[0]), fix, argument="rows")
        table = pl.DataFrame({c: [row.get(c) for row in rows] for c in schema}, schema=schema)
        return cls(table, Path(root), facts or {})

    @classmethod
    def of_table(
        cls, table: pl.DataFrame, root: Path, facts: Mapping[str, str] | None = None
    ) -> Manifest:
        """Make a manifest of a table; absent columns become null, further ones go last."""
        absent = (pl.lit(None).alias(c) for c in SCHEMA if c not in table.columns)
        more = (c for c in table.columns if c not in SCHEMA)
        typed = (pl.col(c).cast(kind) for c, kind in SCHEMA.items())
        more = (pl.col(c).cast(pl.Float64) if c in CONTACT else c for c in more)
        return cls(table.with_columns(*absent).select(*typed, *more), root, facts or {})

    def __len__(self) -> int:
        return self.table.height

    def __str__(self) -> str:
        """How many samples, videos and materials there are, and how many have which image."""
        counts: dict[str, Any] = {"root": str(self.root), "samples": len(self)}
        for name in ("video", "contact", "object", "material"):
            if number := self.table[name].drop_nulls().n_unique():
                counts[f"{name}s"] = number
        with_image = {c: self.table[c].count() for c in IMAGE_COLUMNS if self.table[c].count()}
        return "\n".join(["Manifest", *fact_lines(counts | with_image)])

    @property
    def ids(self) -> list[str]:
        """The ids in row order."""
        return self.table["id"].to_list()

    def column(self, name: str) -> list[Any]:
        """One column as a list, in row order.

        Raises:
            PalpateError: if there is no such column.
        """
        must = f"A column must be one of {', '.join(self.table.columns)}"
        require(name in self.table.columns, None, must, repr(name), fix="Choose one of these")
        return self.table[name].to_list()

    @cached_property
    def digest(self) -> str:
        """SHA-256 over all rows in order, and the names of columns beyond ``SCHEMA``."""
        cells = pl.all().cast(pl.String).fill_null("\x00")
        rows = self.table.select(pl.concat_str(cells, separator="\x1f")).to_series()
        more = self.table.columns[len(SCHEMA) :]
        return digest_lines(chain(["\x1f".join(more)] * bool(more), rows))

    def filled(self) -> pl.DataFrame:
        """The table without the columns that are all null."""
        return self.table.select(c for c in self.table if c.null_count() < len(self))

    def path(self, relative: str) -> Path:
        """The absolute path of an image named in the table.

        Raises:
            PalpateError: if a link leads out of the root, and no import followed one.
        """
        path = self.root / relative
        if self.guarded and not Path(relative).is_absolute():  # no file has those: set in memory
            stays = _stays(self.root, Path(relative).parent)
            stays &= not path.is_symlink() or inside(self.root, relative) is not None
            must, fix = f"Images must stay inside {self.root}, also by links", "Import again"
            require(stays, None, must, repr(relative), fix=fix)
        return path

    def paths(self, column: str) -> list[Path]:
        """Absolute paths of one image column.

        Raises:
            PalpateError: if a row has no such image, or as :meth:`path`.
        """
        values = self.column(column)
        if missing := values.count(None):
            must = f"Every sample must have a {column} image here"
            got = f"{missing} without, first {self.ids[values.index(None)]!r}"
            raise PalpateError(must, got, f"Drop those samples, or fill the column {column}")
        return [self.path(value) for value in values]

    def take(self, ids: Sequence[str]) -> Manifest:
        """The rows of ``ids``, in that order.

        Raises:
            PalpateError: if an id is not in the manifest.
        """
        must, fix = "Every id of the split must be in the manifest", "Use the split made for it"
        return replace(self, table=self.table[require_rows(self.ids, ids, must, fix)])

    def part(self, split: Split, *parts: str) -> Manifest:
        """The rows in the given parts of a split, in manifest order.

        Raises:
            PalpateError: if the split names ids that the manifest lacks.
        """
        ids = split.ids(*parts)
        table = self.table.filter(pl.col("id").is_in(ids))
        return replace(self, table=table if len(table) == len(ids) else self.take(ids).table)

    def dataset(
        self,
        split: Split | str | Path | None = None,
        *parts: str,
        transform: Transform | Mapping[str, Transform] | None = None,
    ) -> SampleDataset:
        """The samples as a map-style data set for PyTorch's ``DataLoader``.

        Args:
            split: a split or its file; None: all samples.
            parts: ``train``, ``val`` or ``test``; default: all of the split.
            transform: of each image, see :class:`palpate.data.dataset.SampleDataset`.

        Raises:
            PalpateError: for another part, if no image column is whole, or as :meth:`part`.
        """
        from palpate.data.dataset import SampleDataset

        for part in parts:
            require_choice("parts", part, PARTS)
        chosen = self if split is None else self.part(Split.load(split), *(parts or PARTS))
        table = chosen.table
        whole = [column.name for column in table if len(table) and not column.null_count()]
        images = [name for name in IMAGE_COLUMNS if name in whole]
        missing = (f"{table[name].null_count():,} {name}" for name in ("vision", "tactile"))
        must = "A data set must have an image column that no sample lacks"
        got = f"{' and '.join(missing)} images missing of {len(table):,} samples"
        fix = "Import the images, or take the samples that have them"
        require(bool(images), None, must, got, fix=fix)
        columns = {name: table[name].to_list() for name in whole}
        paths = {name: chosen.paths(name) for name in images}
        return SampleDataset({**columns, **paths}, images, transform)

    @classmethod
    def join(cls, *manifests: Manifest) -> Manifest:
        """The samples of several manifests in one, whose root is the folder that holds all their
        roots.

        Raises:
            PalpateError: if two of them share an id.
        """
        root = Path(os.path.commonpath([m.root.resolve() for m in manifests]))
        tables: list[pl.DataFrame] = []
        for m in manifests:
            folder = os.path.relpath(m.root.resolve(), root)
            prefix = "" if folder == "." else f"{folder}/"
            paths = ((pl.lit(prefix) + pl.col(name)).alias(name) for name in IMAGE_COLUMNS)
            tables.append(m.table.with_columns(paths))
        table = pl.concat(tables, how="diagonal")
        shared = table.filter(pl.col("id").is_duplicated())["id"].unique().sort()
        if len(shared):
            got = f"{len(shared)} shared, first {shared[0]!r}"
            fix = "Rename the videos of one of them"
            raise PalpateError("Joined manifests must not share ids", got, fix)
        names = " + ".join(m.facts.get("dataset", "?") for m in manifests)
        first, *further = (m.facts for m in manifests)
        same = {k: v for k, v in first.items() if all(facts.get(k) == v for facts in further)}
        guarded = all(m.guarded for m in manifests)
        return cls(table, root, same | {"dataset": names}, guarded)

    @property
    def synthetic(self) -> bool | None:
        """Whether a simulator made the images; None where neither facts nor sensors are known."""
        if {"synthetic", "simulated"} & set(self.facts):
            return True
        sensors = set(self.table["sensor"].drop_nulls())
        return sensors == {"simulated"} if sensors else None

    def ref(self, row: Mapping[str, Any]) -> SampleRef:
        """A row of the table as a reference with absolute image paths, for reports."""
        images = (os.path.realpath(self.path(row[n])) if row[n] else None for n in IMAGE_COLUMNS)
        return SampleRef(row["id"], row["video"], row["frame"], row["material"], *images)

    def problems(self) -> list[Problem]:
        """Everything wrong with the rows: bad ids, paths outside the root, missing files."""
        problems = [] if len(self) else [Problem("manifest", "empty", "there are no samples")]
        seen: dict[str, int] = {}
        for line, i in enumerate(self.column("id"), 1):
            if not i:
                problems.append(Problem(f"row {line}", "null-id", "the id is empty"))
            elif (first := seen.setdefault(i, line)) != line:
                text = f"the id {i!r} is in row {first} already"
                problems.append(Problem(f"row {line}", "duplicate-id", text))

        @cache
        def wrong(value: str) -> tuple[str, str] | None:
            followed = self.facts.get("links") == FOLLOWED and not re.search(CLIMBS, value)
            path = self.root / value if followed else inside(self.root, value)
            if path is None:
                return "outside-root", f"{value!r} leaves the root"
            return None if path.is_file() else ("missing-file", f"no file {value!r}")

        for name in IMAGE_COLUMNS:
            for line, value in enumerate(self.column(name), 1):
                if value is not None and (problem := wrong(value)):
                    problems.append(Problem(f"row {line}", *problem))
        return problems

    def require_valid(self) -> Manifest:
        """Return this manifest, if it has no problems.

        Raises:
            ProblemsError: with every problem at once.
        """
        if problems := self.problems():
            raise ProblemsError(problems, "Correct the rows, or import again and skip the bad ones")
        return self

    def save(self, path: Path) -> None:
        """Write Parquet, atomically, with format, digest and relative root as metadata."""
        path = Path(path)
        metadata = {
            "palpate.format": FORMAT,
            "palpate.digest": self.digest,
            "palpate.root": os.path.relpath(self.root.resolve(), path.parent.resolve()),
            **{f"{FACT}{k}": v for k, v in self.facts.items()},
        }
        write_parquet(self.table, path, metadata)

    @classmethod
    def load(cls, path: Path, root: Path | None = None) -> Manifest:
        """Read a manifest file.

        Args:
            path: a ``.parquet`` file, or the folder that holds ``manifest.parquet``.
            root: where the images are now; default: where they were relative to the file.

        Raises:
            PalpateError: if the file is missing, is no manifest, or does not match its digest.
        """
        path = Path(path)
        path = path / "manifest.parquet" if path.is_dir() else path
        fix = "Write one with: palpate import"
        if not path.is_file():
            raise PalpateError(
                "The manifest must exist", *got_and_fix(path.parent, f"no file {path}", fix)
            )
        try:
            meta = parquet_metadata(path)
            table = read_parquet(path, most=4 * LARGEST)
        except Exception as error:  # polars raises several kinds for a file that is not Parquet
            got = str(error).splitlines()[0]
            raise PalpateError(f"The manifest {path} must be a Parquet file", got, fix) from None
        written = meta.get("palpate.format")
        columns = list(table.schema.items())
        typed = columns[: len(SCHEMA)] == list(SCHEMA.items())
        typed &= all(kind == _further(name) for name, kind in columns[len(SCHEMA) :])
        got = written or "a Parquet file of another program"
        must = f"The manifest {path} must have the format {FORMAT}"
        require(written == FORMAT and typed, None, must, got, fix=fix)
        for name in IMAGE_COLUMNS:
            climbing = table[name].filter(table[name].str.contains(CLIMBS))
            if len(climbing):
                must, got = f"Paths in {path} must stay inside the root", f"{name} {climbing[0]!r}"
                raise PalpateError(must, got, "Remove the row, or import again")
        facts = {k.removeprefix(FACT): v for k, v in meta.items() if k.startswith(FACT)}
        home = Path(root) if root else Path(os.path.normpath(path.parent / meta["palpate.root"]))
        manifest = cls(table, home, facts, facts.get("links") != FOLLOWED)
        must, got = f"The digest in {path} must match its rows", "rows of another program"
        require(manifest.digest == meta["palpate.digest"], None, must, got, fix=fix)
        return manifest


def _further(column: str) -> type[pl.DataType]:
    """The type of a column beyond ``SCHEMA``."""
    return pl.Float64 if column in CONTACT else pl.String


@lru_cache(1 << 16)
def _stays(root: Path, folder: Path) -> bool:
    return inside(root, str(folder)) is not None


@contextmanager
def reading_parquet() -> Generator[None]:
    """Raise a panic of polars over a damaged file, which is no Exception, as ValueError."""
    try:
        yield
    except pl.exceptions.PanicException as error:
        raise ValueError(str(error)) from None


def read_parquet(path: Path, columns: Sequence[str] = ("*",), most: int = LARGEST) -> pl.DataFrame:
    """Read columns of a Parquet file.

    Raises:
        ValueError: if it is damaged, or its cells take more than ``most`` bytes, however few they
            are on the disk.
    """
    with reading_parquet():
        rows = pl.scan_parquet(path, glob=False).select(columns)  # a path may hold brackets
        cells = pl.len().cast(pl.Int64).alias("") * 16 * len(rows.collect_schema())
        texts = pl.col(pl.String).str.len_bytes().cast(pl.Int64).sum()
        size = sum(rows.select(cells, texts).collect(engine="streaming").row(0))
        got = f"{size >> 20:,} MiB of cells, and at most {most >> 20:,} MiB are read at once"
        if size > most:
            raise ValueError(got)
        return rows.collect()


def is_image(name: object) -> bool:
    """Whether a name has the suffix of an image."""
    return str(name).strip().lower().endswith(SUFFIXES)


def is_manifest(path: Path) -> bool:
    """Whether this is a manifest file or a folder that holds one."""
    if path.is_dir():
        return (path / "manifest.parquet").is_file()
    if path.suffix.lower() != ".parquet" or not path.is_file():
        return False
    with suppress(Exception):  # polars raises several kinds for a file that is not Parquet
        return parquet_metadata(path).get("palpate.format", "").startswith("palpate-manifest/")
    return False


def parquet_metadata(path: Path) -> dict[str, str]:
    """The facts that a Parquet file holds besides its rows."""
    with open(path, "rb") as file, reading_parquet():
        return pl.read_parquet_metadata(file)


def write_parquet(
    table: pl.DataFrame, path: Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Write a table as Parquet, whole or not at all.

    Written by Python, so that a full disk is an OSError and no error of polars.

    Raises:
        OSError: if the disk is full.
        PalpateError: if the path cannot be written to.
    """
    data = io.BytesIO()
    table.write_parquet(data, metadata=dict(metadata) if metadata else None)
    with atomic_path(path) as part:
        part.write_bytes(data.getbuffer())
