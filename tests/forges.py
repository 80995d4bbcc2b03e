"""Every format's forge: writes a small data set in the format's true on-disk layout, for the one contract test over all formats.

To add a format: write ``forge_<name>(folder) -> Forged`` (see ``data_forge.Forged``) in ``tests/<name>_forge.py`` or here, and add it to
``FORGES`` under the format's name. Rules for a forge: at least six samples; every image at least 32 pixels wide and of its own content;
everything below ``folder``, nothing beside it; no problems in it (bad trees are made of it by the contract); the last sample by manifest
order uses its touch image alone. Then ``pytest tests/test_data_contract.py -k <name>`` tells whether the format keeps the contract.
"""

from collections.abc import Callable
from pathlib import Path

from data_forge import Forged, write_image
from formats_forge import (
    forge_objectfolder,
    forge_objectfolder_generation,
    forge_tarf,
    forge_visgel,
    forge_ycb_slide,
)
from generic_forge import forge_hf, forge_intervals
from palpate.data.listing import write_list
from tvl_forge import forge_hct, forge_ssvtp


def forge_touch_and_go(folder: Path) -> Forged:
    """Two extracted recordings with two touches each, the official lists and ``label.txt``."""
    root = folder / "touch_and_go"
    lists: dict[str, list[tuple[str, int]]] = {"train": [], "test": []}
    for v, video in enumerate(("20220601_182052", "20220602_090000")):
        for k in range(20):
            for side in ("video_frame", "gelsight_frame"):
                write_image(root / "dataset" / video / side / f"{k:010d}.jpg", 32 * v + k)
        for part, frames in (("train", (6, 7, 8)), ("test", (14, 15, 16))):
            lists[part] += [(f"{video}/{k:010d}.jpg", 3 + v) for k in frames]
    for part, rows in lists.items():
        write_list(root / f"{part}.txt", rows)
    write_list(root / "label.txt", [row for rows in lists.values() for row in rows])
    return Forged(root, 12)


def forge_pairs(folder: Path) -> Forged:
    """Two folders of equal names, one level deep."""
    root = folder / "mine"
    for k in range(8):
        for side in ("vision", "tactile"):
            write_image(root / side / f"rec{k // 4}" / f"{k}.jpg", k + 1)
    return Forged(root, 8)


FORGES: dict[str, Callable[[Path], Forged]] = {
    "touch-and-go": forge_touch_and_go,
    "hct": forge_hct,
    "ssvtp": forge_ssvtp,
    "tarf": forge_tarf,
    "objectfolder-generation": forge_objectfolder_generation,
    "objectfolder": forge_objectfolder,
    "ycb-slide": forge_ycb_slide,
    "visgel": forge_visgel,
    "intervals": forge_intervals,
    "hf": forge_hf,
    "pairs": forge_pairs,
}
