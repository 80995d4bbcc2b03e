"""Trees of Touch and Go and of HCT for studies: true layouts and names, rendered pictures.

The tiny trees of ``format_trees.py`` hold too little to train on. These are the procedural world in
the data set's layout, without the files that only a world has.
"""

import shutil
from collections import defaultdict
from pathlib import Path

from palpate.data.manifest import Manifest
from palpate.leakage.noleak import load_record, record_split
from palpate.sim import WorldOptions, write_world

WORLD = {"materials": ("Wood", "Brick", "Grass"), "contacts_per_video": 2, "frames_per_contact": 2}
#: What no data set has.
ONLY_WORLDS = (
    "world.json",
    "manifest.parquet",
    "splits",
    "leak.csv",
    "objects.csv",
    "captions.csv",
)


def forge(folder: Path, **options) -> Path:
    """A world without its mark."""
    world = WorldOptions(objects_per_material=6, seed=83, **WORLD, **options)
    write_world(folder, world, workers=1)
    return folder


def remove_marks(folder: Path) -> None:
    for name in ONLY_WORLDS:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def forge_touch_and_go(folder: Path) -> Path:
    """Frames and lists under names of true videos, of each material some in each published part."""
    root = forge(folder / "touch_and_go", layout="frames", leak="contact")
    known = record_split(load_record(), 0.8, 0.0, 0)
    free = {part: sorted(known.ids(part)) for part in ("train", "test")}
    table = Manifest.load(root).table
    videos = defaultdict(list)
    for video, material in sorted({*zip(table["video"], table["material"], strict=True)}):
        videos[material].append(video)
    remove_marks(root)
    names = {
        video: free["test" if k % 3 == 2 else "train"].pop()
        for of_material in videos.values()
        for k, video in enumerate(of_material)
    }
    for video, name in names.items():
        (root / "dataset" / video).rename(root / "dataset" / name)
    for path in root.glob("*.txt"):
        text = path.read_text()
        for video, name in names.items():
            text = text.replace(f"{video}/", f"{name}/")
        path.write_text(text)
    return root


def forge_hct(folder: Path) -> Path:
    """Rigs with trajectories, lists with captions and no materials."""
    root = forge(folder / "forged", layout="hct", look="digit", leak="frame")
    remove_marks(root)
    return root / "hct"


def forge_clips(folder: Path) -> Path:
    """Videos with the list of frames in contact, and no lists of train and test."""
    root = forge(folder / "clips", layout="videos")
    remove_marks(root)
    for name in ("train.txt", "test.txt"):
        (root / name).unlink()
    return root
