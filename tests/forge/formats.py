"""A small tree of every data-set format in its true on-disk layout, for the contract test.

To add a format write ``make_<name>(folder) -> Tree`` here and add it to ``TREES``. Rules: at least
six samples; every image at least 32 pixels wide and of its own content; everything below
``folder``; no problems (the contract spoils copies of it); the last sample by manifest order uses
its tactile image alone. Then ``pytest tests/test_data_contract.py -k <name>`` says whether the
format keeps the contract.
"""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image

from forge.pictures import (
    encoded,
    gel,
    number,
    photo,
    picture,
    put,
    write_csv,
    write_image,
    write_images,
)
from palpate.data.importing import import_dataset
from palpate.data.listing import write_list


@dataclass(frozen=True)
class Tree:
    """A small data set, all of it below the folder that its maker was given.

    Attributes:
        source: what a user would name: a folder or a table.
        samples: how many samples an import must give.
        options: options of the import that it needs; paths below the folder follow a copied tree.
        remove: removes what one sample needs, given the source; default: deletes the tactile image
            of the last sample.
        cut: damages it instead; default: cuts that file in half.
    """

    source: Path
    samples: int
    options: Mapping[str, object] = field(default_factory=dict)
    remove: Callable[[Path], None] | None = None
    cut: Callable[[Path], None] | None = None


METADATA = "Index,Name,Material\n1,Soup_Spoon,Ceramic\n2,Bowl,Ceramic\n10,Soup_Bowl,Ceramic\n"
METADATA += "17,8Inch_Skillet,Iron\n"


def make_touch_and_go(folder: Path) -> Tree:
    """Two extracted recordings with two contacts each, the official lists and ``label.txt``."""
    root = folder / "touch_and_go"
    lists: dict[str, list[tuple[str, int]]] = {"train": [], "test": []}
    for v, video in enumerate(("20220601_182052", "20220602_090000")):
        for k, side in product(range(20), ("video_frame", "gelsight_frame")):
            write_image(root / "dataset" / video / side / f"{k:010d}.jpg", 32 * v + k)
        for part, frames in (("train", (6, 7, 8)), ("test", (14, 15, 16))):
            lists[part] += [(f"{video}/{k:010d}.jpg", 3 + v) for k in frames]
    for part, rows in lists.items():
        write_list(root / f"{part}.txt", rows)
    write_list(root / "label.txt", [row for rows in lists.values() for row in rows])
    return Tree(root, 12)


def make_tarf(folder: Path) -> Tree:
    """Two scenes of five touches, 9 to 13 in one (numbers of two lengths), views at two scales."""
    root = folder / "tarf"
    frames = {"bench": range(5), "office_1": range(9, 14)}
    pairs = [(scene, k) for scene, numbers in frames.items() for k in numbers]
    for start, place in ((1, "touch/{}_40_30"), (33, "vision/{}_40_30"), (65, "vision/{}_80_60")):
        write_images(root, [f"{place.format(scene)}/{k}.jpg" for scene, k in pairs], start)
    backgrounds = ["bench_40_30", "office_1_40_30"]
    write_images(root, [f"touch_bg/{name}/bg.jpg" for name in backgrounds], 97)
    (root / "depth" / "bench_40_30").mkdir(parents=True)
    (root / "depth" / "bench_40_30" / "0.npy").write_bytes(b"never read")
    parts = {"train": range(4), "val": [4]}
    lists = {part: [["bench_40_30", str(k)] for k in numbers] for part, numbers in parts.items()}
    lists["test"] = [["office_1_40_30", str(k)] for k in frames["office_1"]]
    (root / "split_interval.json").write_text(json.dumps(lists))
    return Tree(root, 10)


def make_objectfolder(folder: Path) -> Tree:
    """Objects 2, 10 and 17 with trials of two to five images, and the table of materials."""
    root = folder / "objectfolder"
    trials = {"2/tactile_data/1": range(5), "2/tactile_data/2": range(9, 12)}
    trials |= {"10/tactile_data/1": range(3), "17/tactile_data/3": range(2)}
    names = [f"{trial}/0/gelsight/{k}.png" for trial, frames in trials.items() for k in frames]
    write_images(root, names)
    write_image(root / "2/tactile_data/1/0/gelsight/3.jpg", 99)  # T3's copy
    (root / "objectfolder_real_metadata.csv").write_text(METADATA)
    return Tree(root, 10)


def make_objectfolder_generation(folder: Path) -> Tree:
    """Objects 1, 2 and 10 with four contacts each; one list shares objects, the other does not."""
    root = folder / "generation"
    objects, contacts = (1, 2, 10), (0, 7, 12, 100)
    for side, start in (("touch", 1), ("vision", 33)):
        write_images(root, [f"{side}/{o}/{c}.png" for o, c in product(objects, contacts)], start)
    write_images(root, ["touch_ref/touch_ref.png", *(f"vision_ref/{o}.png" for o in objects)], 65)
    parts = {"train": contacts[:2], "val": contacts[2:3], "test": contacts[3:]}
    by_contact = {part: [[o, c] for o in objects for c in some] for part, some in parts.items()}
    by_object = {p: [[o, c] for c in contacts] for p, o in zip(parts, objects, strict=True)}
    (root / "cross_contact.json").write_text(json.dumps(by_contact))
    (root / "cross_object.json").write_text(json.dumps(by_object))
    return Tree(root, 12)


def make_ycb_slide(folder: Path) -> Tree:
    """Two objects with two logs each of three frames, and a simulated log of two."""
    root = folder / "ycb"
    logs = [f"real/{o}/dataset_{k}" for o, k in product(("004_sugar_box", "055_baseball"), (0, 4))]
    for side, start in (("frames", 1), ("webcam_frames", 33)):
        names = [f"{log}/{side}/frame_{k:07d}.jpg" for log in logs for k in range(3)]
        write_images(root, names, start)
    for log in logs:
        (root / log / "digit_data.npy").write_bytes(b"a pickle, never opened")
    for kind in ("tactile_images", "gt_heightmaps"):
        write_images(root, [f"sim/025_mug/03/{kind}/{k}.jpg" for k in range(2)], 65)
    return Tree(root, 12)


def make_intervals(folder: Path) -> Tree:
    """Two extracted recordings and a list; the last contact ends early."""
    root = folder / "mine"
    for v, video in enumerate(("rec 1", "rec,2")):
        for k, side in product(range(22), ("video_frame", "gelsight_frame")):
            write_image(root / video / side / f"{k:010d}.jpg", 32 * v + k)
    lines = ["video,start,end,label,object", "rec 1,6,8,Wood,chair", "rec 1,12,13,,"]
    lines += ['"rec,2",7,8,Rock,wall', '"rec,2",18,19,Rock,wall']
    (root / "contacts.csv").write_text("\r\n".join(lines))
    return Tree(root / "contacts.csv", 9)


def make_pairs(folder: Path) -> Tree:
    """Two folders of equal names, one level deep."""
    root = folder / "mine"
    for k, side in product(range(8), ("vision", "tactile")):
        write_image(root / side / f"rec{k // 4}" / f"{k}.jpg", k + 1)
    return Tree(root, 8)


# --- Hugging Face

HF_MAPS = {
    "vision": "rgb",
    "tactile": "gel",
    "video": "regexp_replace(path, '/[^/]*$', '')",
    "frame": "split_part(gel, '.', 1)",
    "material": "kind",
}


def hf_kinds() -> dict:
    """Features of :func:`hf_rows` that are not texts."""
    import datasets

    labels = datasets.ClassLabel(names=["Wood", "Rock"])
    return {"rgb": datasets.Image(), "gel": datasets.Image(), "kind": labels}


def save_hf(folder: Path, rows: list[dict], **kinds) -> Path:
    """Save rows by their cell ``part``; columns that are not in ``kinds`` are texts."""
    import datasets

    features = datasets.Features({n: kinds.get(n, datasets.Value("string")) for n in rows[0]})
    datasets.disable_progress_bars()
    parts = {part: [r for r in rows if r["part"] == part] for part in {r["part"] for r in rows}}
    make = datasets.Dataset.from_list
    saved = {part: make(parts[part], features=features) for part in sorted(parts)}
    datasets.DatasetDict(saved).save_to_disk(str(folder))
    return folder


def hf_rows() -> list[dict]:
    """Eight rows of two parts, with images, a class label and a path."""
    rows = []
    for k in range(8):
        part = "train" if k < 5 else "validation"
        row = {"part": part, "path": f"data1/0-17.{k // 4}/{k:04d}.jpg", "kind": k % 2}
        for side, suffix in (("rgb", ".png"), ("gel", ".jpg")):
            image = encoded(Image.fromarray(picture(2 * k + (side == "gel"))), suffix)
            row[side] = {"bytes": image, "path": f"{k:04d}{suffix}"}
        rows.append(row)
    return rows


def make_hf(folder: Path) -> Tree:
    """A folder of ``save_to_disk`` with two images a row, class labels and parts."""
    rows = hf_rows()

    def again(change):
        def spoil(source: Path) -> None:
            shutil.rmtree(source)
            last = {**rows[-1], "gel": change(rows[-1]["gel"])}
            save_hf(source, [*rows[:-1], last], **hf_kinds())

        return spoil

    def cut(image):
        return {**image, "bytes": image["bytes"][: len(image["bytes"]) // 2]}

    source = save_hf(folder / "mine", rows, **hf_kinds())
    remove = again(lambda _: None)
    return Tree(source, 8, {"columns": HF_MAPS}, remove=remove, cut=again(cut))


# --- TVL: a gel that looks similar everywhere, photos that do not

TVL_COLUMNS = ("url", "tactile", "tactile_background", "caption")


def name_of(frame: int) -> str:
    return f"{frame}-0.0{frame}2.jpg"


def make_trajectory(
    rig: Path,
    folder: str,
    frames: Sequence[int],
    *,
    swapped: bool = False,
    background: bool = True,
    tactile: Callable[[int], Image.Image] | None = None,
    vision: Callable[[int], Image.Image] = photo,
) -> list[list[str]]:
    """Write one trajectory of HCT; returns its list rows without captions."""
    look = int(rig.name[-1])
    tactile = tactile or (lambda k: gel(k, rig=look))
    first = 100 * (int(float(folder.split("-", 1)[1])) % 1000)
    places = ("tactile", "vision") if swapped else ("vision", "tactile")
    for frame in frames:
        for place, make in zip(places, (vision, tactile), strict=True):
            put(rig / folder / place / name_of(frame), make(first + frame))
    if background:
        put(rig / folder / "background.png", gel(0, rig=look, pressed=False))
    sides = ("vision", "tactile")
    return [
        [*(f"{folder}/{side}/{name_of(k)}" for side in sides), f"{folder}/background.png"]
        for k in frames
    ]


def make_hct(folder: Path) -> Tree:
    """Two rigs of three trajectories with four frames, one of them in test, and two untouched."""
    root = folder / "hct"
    for r, rig in enumerate((root / "data1", root / "data2")):
        parts: dict[str, list[list[str]]] = {"train": [], "test": []}
        rows: list[list[str]] = []
        for k in range(3):
            name = f"{7 + k % 2}-{1702596200 + 3600 * r + 40 * k + 25 * k * k}.5"
            rows += make_trajectory(rig, name, [8, 9, 10, 11, 30, 31])
            for n, row in enumerate(rows[-4:]):
                part = "test" if n == 1 else "train"
                parts[part].append([*row, f"Hard, smooth{' ' * k}, Ridged."])
        for part, listed in parts.items():
            write_csv(rig / f"{part}.csv", TVL_COLUMNS, listed)
    return Tree(root, 24)


def make_ssvtp(folder: Path) -> Tree:
    """Nine samples, the tactile column in the training list only, and a text file each."""
    root = folder / "ssvtp"
    rows: dict[str, list[list[str]]] = {"train": [], "test": []}
    (root / "text").mkdir(parents=True)
    for k in (3, 12, 21, 437, 438, 1000, 1001, 2000, 4210):
        vision, tactile = f"images_rgb/image_{k}_rgb.jpg", f"images_tac/image_{k}_tac.jpg"
        put(root / vision, photo(k))
        put(root / tactile, gel(k))
        text = "Fabric, coarse , deformable.\nsecond line\n"
        (root / "text" / f"labels_{k}.txt").write_text(text)
        part = "train" if k < 2000 else "test"
        rows[part].append([vision, tactile, "fabric, coarse, deformable"])
    write_csv(root / "train.csv", ("url", "tactile", "caption"), rows["train"])
    write_csv(root / "test.csv", ("url", "caption"), [[row[0], row[2]] for row in rows["test"]])
    return Tree(root, 9)


def make_videos(folder: Path) -> Tree:
    """Six recordings as stacks of three frames, of which the first is taken."""
    root = folder / "mine"
    for v in range(6):
        (root / f"v{v}").mkdir(parents=True)
        for side, first in (("rgb", 10 * v), ("gel", 100 + 10 * v)):
            np.save(root / f"v{v}" / f"{side}.npy", [picture(first + k) for k in range(3)])
    last = "v5/gel.npy"

    def cut(source: Path) -> None:
        (source / last).write_bytes((source / last).read_bytes()[:-1000])

    return Tree(root, 6, {"every": 3}, remove=lambda source: (source / last).unlink(), cut=cut)


TREES: dict[str, Callable[[Path], Tree]] = {
    "touch-and-go": make_touch_and_go,
    "hct": make_hct,
    "ssvtp": make_ssvtp,
    "tarf": make_tarf,
    "objectfolder-generation": make_objectfolder_generation,
    "objectfolder": make_objectfolder,
    "ycb-slide": make_ycb_slide,
    "intervals": make_intervals,
    "hf": make_hf,
    "videos": make_videos,
    "pairs": make_pairs,
}


# --- what the tests of formats look at


def imported(make, tmp_path: Path, **options):
    """A fresh tree, imported."""
    return import_dataset(make(tmp_path / "data").source, tmp_path / "out", **options)


def row(result, i: str) -> dict:
    """The cells of a sample that are not null."""
    cells = result.manifest.take([i]).table.row(0, named=True)
    return {name: cell for name, cell in cells.items() if cell is not None}


def drawn(result, column: str) -> list[int]:
    """The numbers drawn in the images of a column."""
    images = (Image.open(path).convert("RGB") for path in result.manifest.paths(column))
    return [number(np.asarray(image)) for image in images]


def kinds(problems) -> Counter:
    return Counter(p.kind for p in problems)


def of_kind(problems, kind: str):
    """The only problem of a kind."""
    (problem,) = [p for p in problems if p.kind == kind]
    return problem
