"""Small trees in the true layouts of TaRF, VisGel, ObjectFolder-Real (both) and YCB-Slide; pictures carry numbers of their own.

Also what the tests of these formats ask of an import.
"""

import json
import shutil
from collections import Counter
from itertools import count, product
from pathlib import Path

import numpy as np
from PIL import Image

from data_forge import Forged, number, write_image
from palpate.data.importing import import_dataset

METADATA = "Index,Name,Material\n1,Soup_Spoon,Ceramic\n2,Bowl,Ceramic\n10,Soup_Bowl,Ceramic\n17,8Inch_Skillet,Iron\n"


def write_pictures(root: Path, names: list[str], start: int = 1) -> None:
    for k, name in enumerate(names, start):
        write_image(root / name, k)


def forge_tarf(folder: Path) -> Forged:
    """Two scenes of five touches, 9 to 13 in one (numbers of two lengths), views at two scales, and the list."""
    root = folder / "tarf"
    frames = {"bench": range(5), "office_1": range(9, 14)}
    pairs = [(scene, k) for scene, those in frames.items() for k in those]
    for side in ("touch", "vision"):
        names = [f"{side}/{scene}_40_30/{k}.jpg" for scene, k in pairs]
        write_pictures(root, names, 1 if side == "touch" else 33)
    write_pictures(root, [f"vision/{scene}_80_60/{k}.jpg" for scene, k in pairs], 65)
    write_pictures(
        root, ["touch_bg/bench_outdoor_1_colmap_40_50/bg.jpg", "touch_bg/office_1_40_30/bg.jpg"], 97
    )
    (root / "depth" / "bench_40_30").mkdir(parents=True)
    (root / "depth" / "bench_40_30" / "0.npy").write_bytes(b"never read")
    lists = {
        "train": [["bench_40_30", str(k)] for k in range(4)],
        "val": [["bench_40_30", "4"]],
        "test": [],
    }
    lists["test"] = [["office_1_40_30", str(k)] for k in frames["office_1"]]
    (root / "split_interval.json").write_text(json.dumps(lists))
    return Forged(root, 10)


def visgel_line(place: str, recording: str, k: int, way: str) -> str:
    """One line of a list; a neighbor before the first frame is the first."""

    def path(side, number):
        return f"{place}/{side}/{recording}/frame{number:04d}.jpg"

    source, other = ("vision", "touch") if way == "vision2touch" else ("touch", "vision")
    near = [path(source, max(1, k + step)) for step in (-1, -2, 1, 2)]
    return " ".join([path(source, 0), path(other, 0), path(source, k), path(other, k), *near])


def forge_visgel(folder: Path) -> Forged:
    """Two recordings of seen and one of unseen objects, six frames after the reference, three of them listed, and the four lists."""
    root = folder / "visgel"
    recordings = [
        ("data/data_seen", "1/rec_a"),
        ("data/data_seen", "10/rec_a"),
        ("data/data_unseen", "2/rec_b"),
    ]
    numbers = count(1)
    for (place, recording), side in product(recordings, ("touch", "vision")):
        for k in range(7):
            write_image(root / place / side / recording / f"frame{k:04d}.jpg", next(numbers))
    (root / "data_lst").mkdir()
    for way, (part, those) in product(
        ("vision2touch", "touch2vision"), (("train", recordings[:2]), ("eval", recordings[2:]))
    ):
        lines = [visgel_line(*recording, k, way) for recording in those for k in (2, 3, 4)]
        (root / "data_lst" / f"{part}_{way}.txt").write_text("\n".join(lines))
    return Forged(root, 9)


def forge_visgel_recordings(folder: Path) -> Forged:
    """The tree that T3 reads: touch alone, two recordings of four frames, the first of which is the reference."""
    root = folder / "data_seen"
    write_pictures(
        root, [f"{rec}/frame{k:04d}.jpg" for rec in ("2/rec", "10/rec") for k in range(4)]
    )
    return Forged(root, 6)


def forge_objectfolder(folder: Path) -> Forged:
    """Objects 2, 10 and 17 with trials of five, three and two pictures, and the table of materials."""
    root = folder / "objectfolder"
    trials = {
        "2/tactile_data/1": range(5),
        "2/tactile_data/2": range(9, 12),
        "10/tactile_data/1": range(3),
        "17/tactile_data/3": range(2),
    }
    write_pictures(
        root, [f"{trial}/0/gelsight/{k}.png" for trial, frames in trials.items() for k in frames]
    )
    write_image(root / "2/tactile_data/1/0/gelsight/3.jpg", 99)  # T3's copy
    (root / "objectfolder_real_metadata.csv").write_text(METADATA)
    last = "17/tactile_data/3/0/gelsight"  # a lone missing picture leaves no trace; a missing trial does
    return Forged(root, 9, remove=lambda source: shutil.rmtree(source / last))


def forge_objectfolder_generation(folder: Path) -> Forged:
    """Objects 1, 2 and 10 with four contacts each; one list shares objects, the other does not."""
    root = folder / "generation"
    objects, contacts = (1, 2, 10), (0, 7, 12, 100)
    for side, start in (("touch", 1), ("vision", 33)):
        write_pictures(root, [f"{side}/{o}/{c}.png" for o, c in product(objects, contacts)], start)
    write_pictures(root, ["touch_ref/touch_ref.png", *(f"vision_ref/{o}.png" for o in objects)], 65)
    contact = {
        "train": [[o, c] for o in objects for c in contacts[:2]],
        "val": [[o, 12] for o in objects],
        "test": [[o, 100] for o in objects],
    }
    thing = {
        part: [[o, c] for c in contacts]
        for part, o in zip(("train", "val", "test"), objects, strict=True)
    }
    (root / "cross_contact.json").write_text(json.dumps(contact))
    (root / "cross_object.json").write_text(json.dumps(thing))
    return Forged(root, 12)


def forge_ycb_slide(folder: Path) -> Forged:
    """Two objects with two logs each of three frames, touch and webcam; and a simulated log of two."""
    root = folder / "ycb"
    logs = [f"real/{o}/dataset_{k}" for o, k in product(("004_sugar_box", "055_baseball"), (0, 4))]
    for side, start in (("frames", 1), ("webcam_frames", 33)):
        write_pictures(
            root, [f"{log}/{side}/frame_{k:07d}.jpg" for log in logs for k in (0, 1, 2)], start
        )
    for log in logs:
        (root / log / "digit_data.npy").write_bytes(b"a pickle, never opened")
    write_pictures(root, [f"sim/025_mug/03/tactile_images/{k}.jpg" for k in (0, 1)], 65)
    write_pictures(root, [f"sim/025_mug/03/gt_heightmaps/{k}.jpg" for k in (0, 1)], 65)
    return Forged(root, 12)


def imported(forge, tmp_path, **options):
    forged = forge(tmp_path / "data")
    return import_dataset(forged.source, tmp_path / "out", **options)


def row(found, i):
    return {
        k: v for k, v in found.manifest.take([i]).table.row(0, named=True).items() if v is not None
    }


def drawn(found, column):
    """The numbers drawn in a column's pictures."""
    return [number(np.asarray(Image.open(p).convert("RGB"))) for p in found.manifest.paths(column)]


def kinds(problems):
    return Counter(p.kind for p in problems)


def of_kind(problems, kind):
    (found,) = [p for p in problems if p.kind == kind]
    return found
