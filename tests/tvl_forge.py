"""Small HCT and SSVTP trees in the layout of TVL's archive: a gel that looks alike everywhere, photos that do not."""

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from data_forge import Forged

#: (width, height) of a touch, upright as a DIGIT's; and of a photo.
TOUCH, PHOTO = (48, 64), (64, 48)
COLUMNS = ("url", "tactile", "tactile_background", "caption")


def gel(
    seed: int, size: tuple[int, int] = TOUCH, rig: int = 0, pressed: bool = True
) -> Image.Image:
    """A gel's shading, of one look for a rig, with a round print somewhere if it is pressed."""
    width, height = size
    y, x = np.mgrid[:height, :width] / height
    out = np.stack([0.25 + 0.2 * y, 0.3 + 0.1 * x + 0.05 * rig, 0.5 - 0.2 * y], axis=2)
    if pressed:
        cx, cy = np.random.default_rng([1, seed]).uniform(0.25, 0.55, 2)
        out += 0.15 * (((x - cx) ** 2 + (y - cy) ** 2) < 0.02)[:, :, None]
    return Image.fromarray((255 * out.clip(0, 1)).astype(np.uint8))


def photo(seed: int, size: tuple[int, int] = PHOTO) -> Image.Image:
    """Coarse patches of any color."""
    small = np.random.default_rng([2, seed]).integers(0, 256, (4, 4, 3)).astype(np.uint8)
    return Image.fromarray(small).resize(size, Image.Resampling.BICUBIC)


def put(path: Path, image: Image.Image) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, quality=90)
    return path


def write_csv(path: Path, columns: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerows([*([columns] if columns else []), *rows])


def name_of(frame: int) -> str:
    return f"{frame}-0.0{frame}2.jpg"


def trajectory(
    rig: Path,
    folder: str,
    frames: Sequence[int],
    *,
    swapped: bool = False,
    background: bool = True,
    touch: Callable[[int], Image.Image] | None = None,
    view: Callable[[int], Image.Image] = photo,
) -> list[list[str]]:
    """Writes one trajectory; returns its list rows without captions."""
    number = int(rig.name[-1])
    start = int(float(folder.split("-", 1)[1])) % 1000
    rows = []
    for frame in frames:
        sides = {
            "vision": view(100 * start + frame),
            "tactile": (touch or (lambda k: gel(k, rig=number)))(100 * start + frame),
        }
        for side, image in sides.items():
            put(
                rig
                / folder
                / ({"vision": "tactile", "tactile": "vision"}[side] if swapped else side)
                / name_of(frame),
                image,
            )
        rows.append(
            [
                f"{folder}/vision/{name_of(frame)}",
                f"{folder}/tactile/{name_of(frame)}",
                f"{folder}/background.png",
            ]
        )
    if background:
        put(rig / folder / "background.png", gel(0, rig=number, pressed=False))
    return rows


def forge_hct(folder: Path) -> Forged:
    """Two rigs; in each three trajectories of four frames, one of each in test, and two untouched frames a trajectory."""
    root = folder / "hct"
    count = 0
    for r, rig in enumerate(("data1", "data2")):
        rows: dict[str, list[list[str]]] = {"train": [], "test": []}
        pairs: dict[str, dict[str, list[str]]] = {
            n: {"tactile": [], "vision": []} for n in ("contact", "not_contact")
        }
        for k in range(3):
            own = trajectory(
                root / rig,
                f"{7 + k % 2}-{1702596200 + 3600 * r + 40 * k + 25 * k * k}.5",
                [8, 9, 10, 11, 30, 31],
            )
            for n, row in enumerate(own):
                kind = "not_contact" if n < 2 else "contact"
                pairs[kind]["vision"].append(row[0])
                pairs[kind]["tactile"].append(row[1])
                if kind == "contact":
                    rows["test" if n == 3 else "train"].append(
                        [*row, f"Hard, smooth{' ' * k}, Ridged."]
                    )
                    count += 1
        for part, listed in rows.items():
            write_csv(root / rig / f"{part}.csv", COLUMNS, listed)
        for name, lists in pairs.items():
            (root / rig / f"{name}.json").write_text(json.dumps(lists))
    return Forged(root, count)


def forge_ssvtp(folder: Path) -> Forged:
    """Nine samples, the touch column in the training list only, and a text file each."""
    root = folder / "ssvtp"
    rows: dict[str, list[list[str]]] = {"train": [], "test": []}
    for k in (3, 12, 21, 437, 438, 1000, 1001, 2000, 4210):
        vision, tactile = f"images_rgb/image_{k}_rgb.jpg", f"images_tac/image_{k}_tac.jpg"
        put(root / vision, photo(k))
        put(root / tactile, gel(k))
        (root / "text").mkdir(exist_ok=True)
        (root / "text" / f"labels_{k}.txt").write_text(
            "Fabric, coarse , deformable.\nsecond line\n"
        )
        rows["train" if k < 2000 else "test"].append(
            [vision, tactile, "fabric, coarse, deformable"]
        )
    write_csv(root / "train.csv", ("url", "tactile", "caption"), rows["train"])
    write_csv(root / "test.csv", ("url", "caption"), [[row[0], row[2]] for row in rows["test"]])
    return Forged(root, 9)
