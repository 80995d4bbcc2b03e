"""The manifest: one row a touch of one surface at one instant, as a table with a root and a digest.

=============  =======  ==========================================================================
column         type     meaning (null where the data set has none; never invented)
=============  =======  ==========================================================================
``id``         string   unique; ``video/frame`` for video data
``video``      string   the continuous recording it comes from
``frame``      int      position in both videos of the recording
``contact``    string   the run of consecutive in-contact frames it belongs to, unique across videos
``object``     string   the thing touched
``session``    string   recordings made in one sitting, of which neighbors may share the object
``material``   string   class name
``text``       string   what the touch feels like, in words
``vision``     string   path of the photo, relative to the root
``tactile``    string   path of the tactile image
``background`` string   path of the sensor's image when it touches nothing
``sensor``     string   sensor or gel unit
``domain``     string   recording condition that changes the look (rig, lighting)
=============  =======  ==========================================================================

Paths use ``/`` and may not leave the root. The digest is SHA-256 over the rows in order; it does not
depend on the root, so a data set has one digest on every disk.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import (
    PalpateError,
    Problem,
    ProblemsError,
    SampleRef,
    Split,
    atomic_path,
    digest_lines,
    inside,
)

SCHEMA: dict[str, type[pl.DataType]] = {
    "id": pl.String,
    "video": pl.String,
    "frame": pl.Int64,
    "contact": pl.String,
    "object": pl.String,
    "session": pl.String,
    "material": pl.String,
    "text": pl.String,
    "vision": pl.String,
    "tactile": pl.String,
    "background": pl.String,
    "sensor": pl.String,
    "domain": pl.String,
}
IMAGE_COLUMNS = ("vision", "tactile", "background")
#: Modality -> its image column.
MODALITIES = {"vision": "vision", "tactile": "tactile"}
FORMAT = "palpate-manifest/3"
#: Format 2 called the column ``contact`` ``touch``; it is read and upgraded.
FORMAT_2 = "palpate-manifest/2"
#: Absolute paths, drive letters, and ``..`` as a component.
CLIMBS = r"^[/\\]|^[A-Za-z]:[/\\]|(?:^|[/\\])\.\.(?:[/\\]|$)"


def write_parquet(
    table: pl.DataFrame, path: Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Writes a table as Parquet, whole or not at all.

    polars encodes in memory and Python writes, so that a full disk is the OSError that it is, not an error of polars.

    Raises:
        OSError: if the disk is full.
        PalpateError: if the path cannot be written to.
    """
    data = io.BytesIO()
    table.write_parquet(data, metadata=dict(metadata) if metadata else None)
    with atomic_path(path) as part:
        part.write_bytes(data.getbuffer())


@dataclass(frozen=True)
class Manifest:
    """Samples and where their images lie.

    Attributes:
        table: the rows, with exactly the columns of ``SCHEMA``.
        root: folder that the image paths are relative to.
        facts: JSON facts about the source (``dataset``, ``text_source`` ...), kept in the file, not in the digest.
    """

    table: pl.DataFrame
    root: Path
    facts: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_rows(
        cls, rows: Iterable[Mapping[str, Any]], root: Path, facts: Mapping[str, str] | None = None
    ) -> Manifest:
        """A manifest from dictionaries; absent columns become null.

        Raises:
            PalpateError: on an unknown column.
        """
        rows = list(rows)
        unknown = sorted({name for row in rows for name in row} - set(SCHEMA))
        if unknown:
            raise PalpateError(
                f"Manifest columns must be among {', '.join(SCHEMA)}",
                repr(unknown[0]),
                "Map the column to one of these",
            )
        return cls(
            pl.DataFrame({name: [row.get(name) for row in rows] for name in SCHEMA}, schema=SCHEMA),
            Path(root),
            facts or {},
        )

    def __len__(self) -> int:
        return self.table.height

    @property
    def ids(self) -> list[str]:
        """The ids in row order."""
        return self.table["id"].to_list()

    def column(self, name: str) -> list[Any]:
        """One column as a list, in row order."""
        return self.table[name].to_list()

    @cached_property
    def digest(self) -> str:
        """SHA-256 over all rows in order, columns in the order of ``SCHEMA``."""
        text = self.table.select(
            pl.concat_str(
                [pl.col(c).cast(pl.String).fill_null("\x00") for c in SCHEMA], separator="\x1f"
            )
        )
        return digest_lines(text.to_series().to_list())

    def filled(self) -> pl.DataFrame:
        """The table without the columns that are all null."""
        names = [name for name in SCHEMA if self.table[name].null_count() < len(self)]
        return self.table.select(names)

    def path(self, relative: str) -> Path:
        """The absolute path of an image named in the table."""
        return self.root / relative

    def paths(self, column: str) -> list[Path]:
        """Absolute paths of one image column.

        Raises:
            PalpateError: if a row has no such image.
        """
        values = self.column(column)
        if (missing := sum(v is None for v in values)) > 0:
            first = self.ids[values.index(None)]
            raise PalpateError(
                f"Every sample must have a {column} image here",
                f"{missing} without, first {first!r}",
                f"Leave those samples out, or fill the column {column}",
            )
        return [self.root / v for v in values]

    def take(self, ids: Sequence[str]) -> Manifest:
        """The rows of ``ids``, in that order.

        Raises:
            PalpateError: if an id is not in the manifest.
        """
        row = {name: k for k, name in enumerate(self.ids)}
        missing = [i for i in ids if i not in row]
        if missing:
            raise PalpateError(
                "Every id of the split must be in the manifest",
                f"{len(missing)} that are not, first {missing[0]!r}",
                "Use the split made for this manifest",
            )
        return Manifest(self.table[[row[i] for i in ids]], self.root, self.facts)

    def part(self, split: Split, *parts: str) -> Manifest:
        """The rows in the given parts of a split, in manifest order.

        Raises:
            PalpateError: if the split names ids that the manifest lacks.
        """
        self.take(split.ids(*parts))  # names ids that are missing
        return Manifest(
            self.table.filter(pl.col("id").is_in(split.ids(*parts))), self.root, self.facts
        )

    def prefixed(self, prefix: str) -> Manifest:
        """The same samples with ``prefix`` before their ids, videos, touches and sessions."""
        named = self.table.with_columns(
            (pl.lit(prefix) + pl.col(name)).alias(name)
            for name in ("id", "video", "contact", "session")
        )
        return Manifest(named, self.root, self.facts)

    @classmethod
    def join(cls, *manifests: Manifest) -> Manifest:
        """The samples of several manifests in one, rooted at the folder that holds all their roots.

        Raises:
            PalpateError: if an id stands in two of them.
        """
        root = Path(os.path.commonpath([m.root.resolve() for m in manifests]))
        tables: list[pl.DataFrame] = []
        for m in manifests:
            prefix = m.root.resolve().relative_to(root).as_posix()
            prefix = "" if prefix == "." else prefix + "/"
            tables.append(
                m.table.with_columns(
                    (pl.lit(prefix) + pl.col(name)).alias(name) for name in IMAGE_COLUMNS
                )
            )
        table = pl.concat(tables)
        double = table.filter(pl.col("id").is_duplicated())["id"].unique().sort()
        if len(double):
            raise PalpateError(
                "Joined manifests must not share ids",
                f"{len(double)} shared, first {double[0]!r}",
                "Rename the videos of one of them",
            )
        return cls(
            table, root, {"dataset": " + ".join(m.facts.get("dataset", "?") for m in manifests)}
        )

    def ref(self, row: Mapping[str, Any]) -> SampleRef:
        """A row (a dictionary of the table) as a reference with absolute image paths, for reports."""
        full = lambda name: str(self.path(row[name]).resolve()) if row[name] else None  # noqa: E731
        return SampleRef(
            row["id"], row["video"], row["frame"], row["material"], full("vision"), full("tactile")
        )

    def problems(self, *, files: bool = True) -> list[Problem]:
        """Everything wrong with the table: empty, null or double ids, paths outside the root and, if ``files``, missing files."""
        found = [Problem("manifest", "empty", "there are no samples")] if not len(self) else []
        seen: dict[str, int] = {}
        for line, i in enumerate(self.column("id"), 1):
            if not i:
                found.append(Problem(f"row {line}", "null-id", "the id is empty"))
            elif i in seen:
                found.append(
                    Problem(
                        f"row {line}",
                        "duplicate-id",
                        f"the id {i!r} stands in row {seen[i]} already",
                    )
                )
            else:
                seen[i] = line
        known: dict[str, str | None] = {}
        for name in IMAGE_COLUMNS:
            for line, value in enumerate(self.column(name), 1):
                if value is None:
                    continue
                if value not in known:
                    path = inside(self.root, value)
                    known[value] = (
                        "outside-root"
                        if path is None
                        else "missing-file"
                        if files and not path.is_file()
                        else None
                    )
                if known[value] == "outside-root":
                    found.append(
                        Problem(
                            f"row {line}",
                            "outside-root",
                            f"the {name} path {value!r} leaves the root",
                        )
                    )
                elif known[value] == "missing-file":
                    found.append(
                        Problem(f"row {line}", "missing-file", f"no {name} file {value!r}")
                    )
        return found

    def require_valid(self, *, files: bool = True) -> Manifest:
        """This manifest, if it has no problems.

        Raises:
            ProblemsError: with every problem at once.
        """
        if found := self.problems(files=files):
            raise ProblemsError(found, "Mend the rows, or import again with --skip-bad")
        return self

    def save(self, path: Path) -> None:
        """Writes Parquet, atomically, with format, digest and root (relative to the file) as metadata."""
        path = Path(path)
        root = os.path.relpath(self.root.resolve(), path.parent.resolve())
        facts = {f"palpate.fact.{k}": v for k, v in self.facts.items()}
        write_parquet(
            self.table,
            path,
            {
                "palpate.format": FORMAT,
                "palpate.digest": self.digest,
                "palpate.root": root,
                **facts,
            },
        )

    @classmethod
    def load(cls, path: Path, root: Path | None = None) -> Manifest:
        """Reads a manifest file.

        Args:
            path: a ``.parquet`` file, or the folder that holds ``manifest.parquet``.
            root: where the images lie now; default: where they lay relative to the file.

        Raises:
            PalpateError: if the file is missing, is no manifest, or does not match its digest.
        """
        path = Path(path)
        path = path / "manifest.parquet" if path.is_dir() else path
        fix = "Write one with: palpate import"
        if not path.is_file():
            raise PalpateError("The manifest must exist", f"no file {path}", fix)
        try:
            with open(path, "rb") as file:
                meta = pl.read_parquet_metadata(file)
            table = pl.read_parquet(path, glob=False)  # a path may hold brackets
        except Exception as error:  # polars raises several kinds for a file that is not Parquet
            raise PalpateError(
                f"The manifest {path} must be a Parquet file", str(error).splitlines()[0], fix
            ) from None
        if meta.get("palpate.format") == FORMAT_2 and "touch" in table.columns:
            table = table.rename({"touch": "contact"})
            meta["palpate.format"] = FORMAT
        if meta.get("palpate.format") != FORMAT or list(table.columns) != list(SCHEMA):
            raise PalpateError(
                f"The manifest {path} must have the format {FORMAT}",
                meta.get("palpate.format") or "a foreign Parquet file",
                fix,
            )
        facts = {
            k.removeprefix("palpate.fact."): v
            for k, v in meta.items()
            if k.startswith("palpate.fact.")
        }
        manifest = cls(
            table,
            Path(root) if root else Path(os.path.normpath(path.parent / meta["palpate.root"])),
            facts,
        )
        for name in IMAGE_COLUMNS:
            climbing = table.filter(pl.col(name).str.contains(CLIMBS))[name]
            if len(climbing):
                raise PalpateError(
                    f"Paths in {path} must stay inside the root",
                    f"the {name} path {climbing[0]!r}",
                    "Remove the row, or import again",
                )
        if manifest.digest != meta["palpate.digest"]:
            raise PalpateError(
                f"The digest in {path} must match its rows",
                "rows that were changed by another program",
                fix,
            )
        return manifest
