"""What is described: one photo for a contact, an object, or every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import polars as pl

from palpate.core import PalpateError, require_choice
from palpate.data.manifest import Manifest

Per = Literal["frame", "contact", "object"]
PER: tuple[Per, ...] = ("frame", "contact", "object")


@dataclass(frozen=True)
class Units:
    """Groups of samples that share one caption, and the photo that it is written from.

    Attributes:
        of: (n samples) number of the unit of each sample.
        described: (n units) row of the sample whose photo goes to the model; None without a photo.
        alone: number of samples without a value in the requested column, each a unit by itself.
    """

    of: Sequence[int]
    described: Sequence[int | None]
    alone: int


def units_of(manifest: Manifest, per: Per) -> Units:
    """Group samples by contact, object or frame, and take the middle photo of each group.

    The middle one is that of the samples with a photo, in the order of video and frame.

    Raises:
        PalpateError: if no sample has a value in the requested column.
    """
    require_choice("per", per, PER)
    table = manifest.table.with_row_index("row")
    column = "id" if per == "frame" else per
    known = pl.col(column)
    alone = table[column].null_count()
    if alone == len(table):
        must, got = "must be what the samples have", f"{per}, of which none is known"
        raise PalpateError(must, got, "", argument="per", example={"per": "frame"})
    name = pl.when(known.is_null()).then(pl.struct(pl.lit(""), "id"))
    table = table.with_columns(unit=name.otherwise(pl.struct(known, pl.lit(""))).rank("dense"))
    seen = table.filter(pl.col("vision").is_not_null()).sort("video", "frame", "row")
    middle = pl.col("row").get(pl.len() // 2)
    rows = dict(seen.group_by("unit").agg(middle).iter_rows())
    units = table["unit"].to_list()
    number = {unit: k for k, unit in enumerate(dict.fromkeys(units))}
    return Units([number[u] for u in units], [rows.get(unit) for unit in number], alone)
