"""Data-set formats, one file each, tried from first to last when a source is to be recognised."""

from __future__ import annotations

from palpate.data.formats import pairs, touch_and_go
from palpate.data.formats.base import Facts, Format, Found, Scan, Validation

FORMATS: dict[str, Format] = {
    "touch-and-go": Format(
        touch_and_go.FACTS, touch_and_go.detect, touch_and_go.LOOKED_FOR, touch_and_go.scan,
        touch_and_go.import_touch_and_go, touch_and_go.write_lists,
    ),
    "pairs": Format(pairs.FACTS, pairs.detect, pairs.LOOKED_FOR, pairs.scan),
}  # fmt: skip

__all__ = ["FORMATS", "Facts", "Format", "Found", "Scan", "Validation"]
