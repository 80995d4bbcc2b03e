"""Data-set formats, one file each, tried from first to last when a source is to be recognized."""

from __future__ import annotations

from palpate.data.formats import (
    hct,
    huggingface,
    intervals,
    objectfolder,
    objectfolder_generation,
    pairs,
    ssvtp,
    tarf,
    touch_and_go,
    videos,
    visgel,
    ycb_slide,
)
from palpate.data.formats.base import Facts, Format, Row, Scan

FORMATS: dict[str, Format] = {
    "touch-and-go": touch_and_go.FORMAT,
    "hct": hct.FORMAT,
    "ssvtp": ssvtp.FORMAT,
    "tarf": tarf.FORMAT,
    "objectfolder-generation": objectfolder_generation.FORMAT,
    "objectfolder": objectfolder.FORMAT,
    "ycb-slide": ycb_slide.FORMAT,
    "visgel": visgel.FORMAT,
    "intervals": intervals.FORMAT,
    "hf": huggingface.FORMAT,
    "videos": videos.FORMAT,
    "pairs": pairs.FORMAT,
}

__all__ = ["FORMATS", "Facts", "Format", "Row", "Scan"]
