"""Data-set formats, one file each, tried from first to last when a source is to be recognized."""

from __future__ import annotations

from palpate.data.formats import (
    hct,
    huggingface,
    interval_lists,
    intervals,
    objectfolder,
    pairs,
    ssvtp,
    tarf,
    touch_and_go,
    visgel,
    ycb_slide,
)
from palpate.data.formats.base import Facts, Format, Found, Scan, Validation

FORMATS: dict[str, Format] = {
    "touch-and-go": Format(
        touch_and_go.FACTS,
        touch_and_go.detect,
        touch_and_go.LOOKED_FOR,
        touch_and_go.scan,
        touch_and_go.import_touch_and_go,
        touch_and_go.write_lists,
    ),
    "hct": Format(hct.FACTS, hct.detect, hct.LOOKED_FOR, hct.scan, write_lists=hct.write_lists),
    "ssvtp": Format(
        ssvtp.FACTS, ssvtp.detect, ssvtp.LOOKED_FOR, ssvtp.scan, write_lists=ssvtp.write_lists
    ),
    "tarf": Format(
        tarf.FACTS, tarf.detect, tarf.LOOKED_FOR, tarf.scan, write_lists=tarf.write_lists
    ),
    "objectfolder-generation": Format(
        objectfolder.GENERATION_FACTS,
        objectfolder.detect_generation,
        objectfolder.GENERATION_LOOKED_FOR,
        objectfolder.scan_generation,
        write_lists=objectfolder.write_lists,
    ),
    "objectfolder": Format(
        objectfolder.FACTS, objectfolder.detect, objectfolder.LOOKED_FOR, objectfolder.scan
    ),
    "ycb-slide": Format(ycb_slide.FACTS, ycb_slide.detect, ycb_slide.LOOKED_FOR, ycb_slide.scan),
    "visgel": Format(
        visgel.FACTS, visgel.detect, visgel.LOOKED_FOR, visgel.scan, write_lists=visgel.write_lists
    ),
    "intervals": Format(
        intervals.FACTS,
        intervals.detect,
        intervals.LOOKED_FOR,
        intervals.scan,
        intervals.run,
        interval_lists.write_lists,
    ),
    "hf": Format(
        huggingface.FACTS,
        huggingface.detect,
        huggingface.LOOKED_FOR,
        huggingface.scan,
        huggingface.run,
        remote=True,
    ),
    "pairs": Format(pairs.FACTS, pairs.detect, pairs.LOOKED_FOR, pairs.scan),
}

__all__ = ["FORMATS", "Facts", "Format", "Found", "Scan", "Validation"]
