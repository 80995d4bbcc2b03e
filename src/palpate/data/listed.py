"""Tables and lists of images: one reader for every verb, whether the images are at hand or not.

=====================================================  =============================================
source                                                 samples
=====================================================  =============================================
lines of one path or two, with or without labels       one a line
a table (:mod:`palpate.data.tables`), a data frame     one a row; nested keys are columns like
                                                       ``image.path``
JSON ``{"train": [[object, contact], ...], ...}``      one an item; a name instead of a number is a
                                                       video, and the second its frame
=====================================================  =============================================

Columns of manifests, and ``split``, are mapped or have their names. Images are those of ``vision``
and ``tactile``. Where neither is a column, the paths are those of the column most of whose cells
name images, one of tactile images by its name before one of photos: they name the samples, and what
they say more is read from those of all lists together (:mod:`palpate.data.recordings`). Paths of
another machine are read by their end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import PalpateError, require
from palpate.data.manifest import IMAGE_COLUMNS, PATH, ROLES, SCHEMA, SIDES
from palpate.data.mapping import compile_maps
from palpate.data.rows import (
    is_there,
    manifest_rows,
    read_classes,
    records,
    relocated,
    some,
    without_repeats,
)
from palpate.data.scanning import Scan
from palpate.data.tables import Table, names_images, open_table, pairings, side_of, table_of

#: Columns of which a table needs at least one, if none names images.
NAMING = ("id", "video", "object", *SIDES)
#: No file system has names of more bytes.
LONGEST_NAME = 255


@dataclass
class Listed:
    """The rows of a table or list, whether their images are at hand or not."""

    table: Table
    scan: Scan  # what is wrong with them; it has no rows yet
    rows: pl.DataFrame  # LINE, columns of a manifest, ``split``, and PATH, of those that there are
    paths: str  # the column of the paths, where it is neither vision nor tactile
    mapped: Mapping[str, str]  # column -> its map expression

    @property
    def sides(self) -> list[str]:
        """The sides that have a column of images."""
        return [side for side in SIDES if side in self.rows.columns]

    @property
    def at_hand(self) -> bool:
        """Whether one of the images, of as many as are looked for, is a file."""
        columns = (name for name in (*self.sides, PATH) if name in self.rows.columns)
        cells = (path for name in columns for path in some(self.rows[name].drop_nulls().to_list()))
        return any(is_there(self.scan.base, path) for path in cells)

    def add_images(self) -> None:
        """Add the rows whose images must be files to the scan.

        Raises:
            PalpateError: if there is no column of images.
        """
        scan, name = self.scan, self.table.name
        if not self.sides and not scan.problems:
            columns = ", ".join(self.table.names)
            got = f"no tactile among {columns}, and no vision" if columns else "an empty file"
            must = f"{name} must have the columns vision and tactile, or one of them"
            fix, example = "Map your columns to them", {"vision": self.paths or "YOUR_COLUMN"}
            choices = [{"columns": pair} for pair in pairings(self.table)]
            if choices:
                raise PalpateError(must, got, "Choose one of these", choices=choices)
            raise PalpateError(must, got, fix, example={"columns": example})
        # A column may be empty.
        sides = [side for side in self.sides if self.rows[side].count()] or self.sides
        for where, row in records(self.rows.drop(PATH, strict=False), self.table.place):
            lacking = " and no ".join(side for side in sides if side not in row)
            names = "/".join(row.get(side, "") for side in sides).split("/")
            if lacking:
                scan.problem(where, "empty-cell", f"no {lacking} path")
            elif any(len(name.encode()) > LONGEST_NAME for name in names):
                text = "a name in a path is longer than file systems allow"
                scan.problem(where, "bad-path", text)
            else:
                scan.rows.append((where, row))


def read_table(
    source: Any,
    *,
    columns: Mapping[str, str] | None = None,
    names: str | None = None,
    classes: Path | None = None,
    root: Path | None = None,
    side: str = "",
    scan: Scan | None = None,
    below: str = "",
) -> Listed:
    """Read a table or list.

    Args:
        source: a file, a polars or pandas frame, or dictionaries.
        columns: manifest column (or ``split``) -> map expression over the columns of the table.
        names: columns of a table without a header line, separated by commas.
        classes: table of classes, whose numbers are the materials.
        root: folder that paths are relative to; default: that of the table.
        side: the side whose paths name the samples; default: tactile, if there are any.
        scan: takes what is wrong, below its own root; default: a new one.
        below: folder in that root that the paths start in.

    Raises:
        PalpateError: if it is none, or a map is wrong.
    """
    if isinstance(source, str | Path):
        own = [name.strip() for name in names.split(",")] if names else None
        table, base = open_table(Path(source), own), Path(source).parent
    else:
        require(names is None, "names", "must be left out for rows in memory", names)
        table, base = table_of(source), Path()
    scan = Scan(base if root is None else Path(root)) if scan is None else scan
    labels = read_classes(classes)
    texts = {"material": "label"} if table.bare and "label" in table.names else {}
    texts |= columns or {}
    broken = bool(table.problems) and not table.names
    maps = compile_maps({} if broken else texts, table.names, (*SCHEMA, "split"))
    wanted = (side,) if side else ("tactile", "vision")
    paths = next((name for name in wanted if name in maps.expressions), "")
    others = [] if paths else [n for n in _by_role(table.names, side) if n not in table.nested]
    cells = table.read(list(dict.fromkeys([*maps.columns, *others])))
    rows = maps.apply(cells)
    column = next((name for name in others if names_images(cells[name])), "")
    if paths or column:
        rows = rows.with_columns((rows[paths] if paths else cells[column]).alias(PATH))
    scan.problems += table.problems
    if not {*NAMING, PATH}.isdisjoint(rows.columns):
        rows = without_repeats(rows, table.place, scan.problems)
    rows, inconclusive = manifest_rows(rows, table.place, labels, scan.problems)
    scan.inconclusive += inconclusive
    scan.suspicious += table.suspicious
    images = [name for name in IMAGE_COLUMNS if name in rows.columns]
    rows = rows.with_columns((pl.lit(below) + pl.col(name)).alias(name) for name in images)
    written = pl.concat([pl.Series(dtype=pl.String), *(rows[name].drop_nulls() for name in images)])
    if places := relocated(written, scan.base):
        rows = rows.with_columns(pl.col(images).replace(places))
        before, below = next(iter(places.items()))
        text = f"{len(places)} paths are read by their end in any spelling: {before!a} is {below!a}"
        scan.suspect(table.name, "other-paths", text)
    return Listed(table, scan, rows, column, texts)


def _by_role(names: Sequence[str], side: str) -> list[str]:
    """Columns that may hold paths: tactile by their name first, then photos, then others.

    With a side, those of the side first, then those that may be of it, then those of the other.
    """
    order = (side, "", *ROLES) if side else ("tactile", "vision", "", "background")
    return sorted(names, key=lambda name: order.index(side_of([name])))
