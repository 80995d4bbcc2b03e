"""What is described: one photo for a contact, an object, or every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import polars as pl

from palpate.core import require, require_choice
from palpate.data.manifest import Manifest

Per = Literal["frame", "contact", "object"]


@dataclass(frozen=True)
class Units:
    """Groups of samples that share one caption, and the photo that it is written from.

    Attributes:
        numbers: (n samples) number of the unit of each sample.
        described: (n units) row of the sample whose photo goes to the model; None without a photo.
        alone: number of samples without a value in the requested column, each a unit by itself.
    """

    numbers: Sequence[int]
    described: Sequence[int | None]
    alone: int


def units_of(manifest: Manifest, per: Per) -> Units:
    """Group samples by contact, object or frame, and take the middle photo of each group.

    The middle one is that of the samples with a photo, in the order of video and frame.

    Raises:
        PalpateError: if no sample has a value in the requested column.
    """
    require_choice("per", per, get_args(Per))
    table = manifest.table.with_row_index("row")
    column = "id" if per == "frame" else per
    value, alone = pl.col(column), table[column].null_count()
    got = f"{per}, of which none is known"
    require(alone < len(table), "per", "must be what the samples have", got, "frame")
    name = pl.when(value.is_null()).then(pl.struct(pl.lit(""), "id"))
    table = table.with_columns(unit=name.otherwise(pl.struct(value, pl.lit(""))).rank("dense"))
    seen = table.filter(pl.col("vision").is_not_null()).sort("video", "frame", "row")
    middle = pl.col("row").get(pl.len() // 2)
    rows = dict(seen.group_by("unit").agg(middle).iter_rows())
    units = table["unit"].to_list()
    number = {unit: k for k, unit in enumerate(dict.fromkeys(units))}
    return Units([number[u] for u in units], [rows.get(unit) for unit in number], alone)
