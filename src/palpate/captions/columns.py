"""Captions from columns, offline: for data with labels where no model is at hand."""

from __future__ import annotations

from string import Formatter

import polars as pl

from palpate.captions.units import Units
from palpate.core import PalpateError, require
from palpate.data.captions import caption
from palpate.data.manifest import SCHEMA, Manifest


def template_texts(template: str, manifest: Manifest, units: Units, seed: int) -> list[str | None]:
    """One text a unit, from its first sample; None where a column has no value.

    The template is text with columns in braces; ``""`` takes adjectives of the material, drawn by
    the seed.

    Raises:
        PalpateError: if the template names no column, or one without any value.
    """
    columns = list(dict.fromkeys(_columns(template))) if template else ["material"]
    for column in columns:
        must, got = "must name columns that have values", f"{column}, which is empty"
        values = manifest.table[column].count()
        require(values > 0, "template", must, got, fix="Choose another column")
    units_of_rows = pl.Series("unit", units.numbers)
    first = manifest.table.select("id", *columns).filter(units_of_rows.is_first_distinct())
    texts: list[str | None] = []
    for cells in first.iter_rows(named=True):
        if None in cells.values():
            texts.append(None)
        elif template:
            texts.append(template.format(**cells))
        else:
            texts.append(caption(cells["material"], cells["id"], seed))
    return texts


def _columns(template: str) -> list[str]:
    """The columns that a template names.

    Raises:
        PalpateError: if there is none, or anything else in braces.
    """
    must = "must be a text with columns in braces"
    example, fix = "{material} of {object}", f"Columns are {', '.join(SCHEMA)}"
    try:
        fields = [field[1:] for field in Formatter().parse(template) if field[1] is not None]
    except ValueError as error:
        words = {"template": example}
        raise PalpateError(must, str(error), "", argument="template", example=words) from None
    odd = [str(name) for name, *form in fields if name not in SCHEMA or any(form)]
    got = f"{{{odd[0]}}}" if odd else f"{template!r}, which names none"
    require(bool(fields) and not odd, "template", must, got, example, fix=fix)
    return [str(name) for name, *_ in fields]
