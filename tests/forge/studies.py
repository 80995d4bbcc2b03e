"""Studies that tests run: a world in the layout of a data set, and a plan of the smallest size.

``python tests/forge/studies.py FOLDER`` runs the small study.
"""

import json
import shutil
import sys
from collections import defaultdict
from dataclasses import replace
from functools import partial
from pathlib import Path

from PIL import Image

from palpate.data.manifest import Manifest
from palpate.leakage.noleak import load_record, record_split
from palpate.report.results import Results
from palpate.sim import PRESETS as WORLDS
from palpate.sim import Video, World, WorldOptions, plan_world, write_world
from palpate.studies.methods import METHODS, OURS
from palpate.studies.reproduce import Plan, run_study
from palpate.studies.study import PRESETS, Study

# --- the procedural world in a data set's layout, without the files that only a world has


FORGED = {
    "materials": ("Wood", "Brick"),
    "objects_per_material": 6,
    "contacts_per_video": 2,
    "frames_per_contact": 2,
    "seed": 83,
}
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
    """A world."""
    write_world(folder, WorldOptions(**FORGED, **options), workers=1)
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
    root, options = folder / "hct", WorldOptions(look="digit", leak="frame", **FORGED)
    world, plans = World(options), plan_world(options)
    places = {
        p: f"data{p.sensor + 1}/{p.index % 7 + 1}-{1702596295 + 97 * p.index}.{p.index % 100:02d}"
        for p in plans
    }
    for plan, place in places.items():
        video = Video(options, plan)
        for side, render in (("vision", video.vision), ("tactile", video.tactile)):
            (root / place / side).mkdir(parents=True)
            for frame in range(options.video_length):
                image = Image.fromarray(render(frame))
                image.save(root / place / side / f"{frame}-0.0207.jpg", quality=95)
        Image.fromarray(video.background()).save(root / place / "background.png")
    for name, part in world.parts.items():
        for rig in sorted({f"data{plan.sensor + 1}" for plan in plans}):
            lines = ["url,tactile,tactile_background,caption"]
            for row in part:
                place = Path(places[row.video])
                if place.parent.name == rig:
                    frame, text = (
                        f"{row.frame}-0.0207.jpg",
                        Video(options, row.video).text(row.contact),
                    )
                    sides = (f"{place.name}/{side}/{frame}" for side in ("vision", "tactile"))
                    lines.append(f'{",".join(sides)},{place.name}/background.png,"{text}"')
            (root / rig / f"{name}.csv").write_text("\n".join(lines))
    for rig in root.iterdir():
        for name, wanted in (("contact", True), ("not_contact", False)):
            in_contact = {row.frame for row in world.rows}
            frames = [k for k in range(options.video_length) if (k in in_contact) is wanted]
            of_rig = [Path(place).name for place in places.values() if place.startswith(rig.name)]
            lists = {
                side: [f"{video}/{side}/{k}-0.0207.jpg" for video in of_rig for k in frames]
                for side in ("vision", "tactile")
            }
            lists["background"] = [f"{video}/background.png" for video in of_rig for _ in frames]
            (rig / f"{name}.json").write_text(json.dumps(lists))
    return root


def forge_clips(folder: Path) -> Path:
    """Videos with the list of frames in contact, and no lists of train and test."""
    root = forge(folder / "clips", layout="videos")
    remove_marks(root)
    for name in ("train.txt", "test.txt"):
        (root / name).unlink()
    return root


# --- a study of the smallest size


SMOKE = PRESETS["smoke"]
TINY = replace(
    SMOKE,
    name="tiny",
    world=replace(WORLDS["tiny"], materials=("Wood", "Brick"), objects_per_material=6, test=0.4),
    steps=4,
    autoencoder=replace(SMOKE.autoencoder, steps=12),
    permutations=19,
)
STUDY = Study(
    "small",
    "A small study",
    (1, 3),
    {"leak": "contact", "seed": 71},
    methods=(METHODS[OURS], METHODS["GVST"], METHODS["Ours w/ BG"]),
    presets={"tiny": TINY},
)


def plan() -> Plan:
    return Plan(STUDY, preset="tiny", device="cpu")


def run(folder: Path, **options) -> Results:
    return run_study(plan(), folder, **options)


if __name__ == "__main__":
    show = partial(print, flush=True)
    run(Path(sys.argv[1]), print_line=show, progress=lambda *args: show("progress", *args))
