"""Captions from columns, offline: for data with labels where no model is at hand."""

from __future__ import annotations

from string import Formatter

from palpate.captions.units import Units
from palpate.core import PalpateError
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
        if not manifest.table[column].count():
            must, got = "must name columns that have values", f"{column}, which is empty"
            raise PalpateError(must, got, "Choose another column", argument="template")
    first = {unit: row for row, unit in reversed(list(enumerate(units.of)))}
    rows = manifest.table.select("id", *columns).rows(named=True)
    texts: list[str | None] = []
    for unit in range(len(units.described)):
        cells = {column: rows[first[unit]][column] for column in columns}
        if None in cells.values():
            texts.append(None)
        elif template:
            texts.append(template.format(**cells))
        else:
            texts.append(caption(cells["material"], rows[first[unit]]["id"], seed))
    return texts


def _columns(template: str) -> list[str]:
    """The columns that a template names.

    Raises:
        PalpateError: if there is none, or anything else in braces.
    """
    must = "must be a text with columns in braces"
    example = {"template": "{material} of {object}"}
    try:
        parts = list(Formatter().parse(template))
    except ValueError as error:
        raise PalpateError(must, str(error), "", argument="template", example=example) from None
    names = [name for _, name, _, _ in parts if name is not None]
    unknown = [n for _, n, form, how in parts if n is not None and (n not in SCHEMA or form or how)]
    if unknown or not names:
        got = f"{{{unknown[0]}}}" if unknown else f"{template!r}, which names none"
        fix = f"Columns are {', '.join(SCHEMA)}"
        raise PalpateError(must, got, fix, argument="template", example=example)
    return names
