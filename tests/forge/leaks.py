"""A made-up train and test part with planted leaks of every kind among unrelated samples.

Pictures come from the procedural world (many videos of few materials, so that unrelated ones can
be much alike) and, for a fifth of the videos, from smooth random fields. They are rendered with a
margin of 4 pixels and cropped, so that a shifted copy shows what lay beside the crop.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from palpate.data.manifest import Manifest
from palpate.sim import Video, WorldOptions, plan_world

MARGIN = 4
#: Without Glass: the print of a flat thing is the rim of the pad and nothing else, the same
#: wherever it was taken.
MATERIALS = ("Wood", "Brick", "Concrete", "Leather", "Rubber", "Synthetic Fabric", "Tree", "Gravel")
#: What is done to a planted copy: one of these by turns.
CHANGES = ("brightness", "jpeg", "shift", "brightness+jpeg", "jpeg+shift", "brightness+jpeg+shift")
KINDS = ("near-duplicate", "identical sample", "identical bytes", "shared video", "time gap")


@dataclass
class Leaky:
    """Both parts, and the planted test ids by kind (id -> the train id that it leaks from)."""

    train: Manifest
    test: Manifest
    planted: dict[str, dict[str, str]] = field(default_factory=dict)
    change: dict[str, str] = field(default_factory=dict)

    def truth(self, kind: str) -> np.ndarray:
        return np.array([i in self.planted.get(kind, {}) for i in self.test.ids])


def changed(picture: np.ndarray, how: str, rng: np.random.Generator) -> np.ndarray:
    """A crop of an image with margin: brightness times 0.95 to 1.05, moved by up to 4 pixels."""
    steps = range(-MARGIN, MARGIN + 1)
    moves = [(y, x) for y in steps for x in steps if y or x]
    down, right = moves[int(rng.integers(len(moves)))] if "shift" in how else (0, 0)
    out = crop(picture, down, right).astype(np.float32)
    if "brightness" in how:
        out *= 1 + rng.choice([-1, 1]) * rng.uniform(0.02, 0.05)
    return np.clip(out + 0.5, 0, 255).astype(np.uint8)


def crop(picture: np.ndarray, down: int = 0, right: int = 0) -> np.ndarray:
    size = picture.shape[0] - 2 * MARGIN
    return picture[MARGIN + down : MARGIN + down + size, MARGIN + right : MARGIN + right + size]


def save(path: Path, picture: np.ndarray, quality: int = 95) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    chroma = 0 if quality == 95 else 2
    Image.fromarray(picture).save(path, "JPEG", quality=quality, subsampling=chroma)


class NoiseVideo:
    """Smooth random fields: a photo of them, and their relief lit from three sides on a gel."""

    def __init__(self, rng: np.random.Generator, size: int):
        self.rng, self.size = rng, size
        self.gel = 110 + 20 * np.tanh(np.stack([self._field(size / 3) for _ in range(3)], -1))
        self.scale, self.color = rng.uniform(2, 8) * size / 128, rng.uniform(40, 200, 3)
        self.frames: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def _field(self, sigma: float) -> np.ndarray:
        white = self.rng.standard_normal((self.size, self.size))
        x = ndimage.gaussian_filter(white, sigma, mode="wrap")
        return x / x.std()

    def render(self, touch: int) -> tuple[np.ndarray, np.ndarray]:
        if touch not in self.frames:
            coarse, fine = self._field(3 * self.scale), self._field(self.scale)
            photo = self.color * (1 + 0.25 * coarse + 0.15 * fine)[..., None]
            y, x = np.mgrid[-1 : 1 : self.size * 1j, -1 : 1 : self.size * 1j]
            middle = self.rng.uniform(-0.3, 0.3, 2)
            pad = np.clip(3 - 4 * np.hypot(y - middle[0], x - middle[1]), 0, 1)
            slope = np.stack(np.gradient(coarse * 2 + fine))
            slope /= slope.std()
            light = [np.cos(a) * slope[0] + np.sin(a) * slope[1] for a in (0, 2.1, 4.2)]
            self.frames[touch] = photo, self.gel + 15 * (pad * np.stack(light)).transpose(1, 2, 0)
        return self.frames[touch]

    def photo(self, touch: int) -> np.ndarray:
        return self._bytes(self.render(touch)[0])

    def touch(self, touch: int) -> np.ndarray:
        return self._bytes(self.render(touch)[1])

    def background(self) -> np.ndarray:
        return self._bytes(self.gel)

    def _bytes(self, x: np.ndarray) -> np.ndarray:
        return np.clip(x + self.rng.normal(0, 1, x.shape) + 0.5, 0, 255).astype(np.uint8)


def make_leaky(
    root: Path,
    seed: int,
    *,
    size: int = 128,
    objects: int = 6,
    materials: tuple[str, ...] = MATERIALS,
    look: str = "gelsight",
    planted: float = 0.25,
    kinds: tuple[str, ...] = KINDS,
) -> Leaky:
    """Write images below ``root``.

    ``objects`` videos of each material of the world and a quarter as many of noise, 4 contacts
    each; 40 % of the videos are test.
    """
    rng = np.random.default_rng([seed, 7])
    options = WorldOptions(
        seed=seed,
        size=size + 2 * MARGIN,
        materials=materials,
        objects_per_material=objects,
        contacts_per_video=4,
        frames_per_contact=4,
        free_written="background",
        look=look,
        mixed=0.0,
    )
    samples: list[dict] = []
    pictures: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    worlds = [Video(options, plan) for plan in plan_world(options)]
    side = size + 2 * MARGIN
    noises = [NoiseVideo(np.random.default_rng([seed, k]), side) for k in range(len(worlds) // 4)]

    def add(name: str, touch: int, frame: int, images: tuple, material: str) -> dict:
        """The row of a sample whose photo, tactile image and background are written."""
        row = {"id": f"{name}/{frame}", "video": name, "frame": frame, "material": material}
        row |= {"contact": f"{name}#{touch}", "sensor": "gel"}
        for kind, picture in zip(("vision", "tactile", "background"), images, strict=True):
            row[kind] = f"{name}/{kind}/{frame}.jpg"
            save(root / row[kind], crop(picture))
        pictures[row["id"]] = images[:2]
        return row

    for world in worlds:
        for t in range(4):
            first = t * (options.free_frames + 4) + options.free_frames
            background = world.tactile(first - 4)
            images = world.vision(first), world.tactile(first), background
            row = add(world.plan.name, t, first, images, world.plan.objects[0].material)
            samples.append({**row, "later": (world, first + 3, background)})
    for k, noise in enumerate(noises):
        for t in range(4):
            images = noise.photo(t), noise.touch(t), noise.background()
            samples.append(add(f"noise{k:03d}", t, 10 * t, images, "noise"))
    videos = sorted({s["video"] for s in samples})
    in_test = {videos[k] for k in rng.permutation(len(videos))[: round(0.4 * len(videos))]}
    train = [s for s in samples if s["video"] not in in_test]
    test = [s for s in samples if s["video"] in in_test]
    leaks: dict[str, dict[str, str]] = {kind: {} for kind in KINDS}
    change: dict[str, str] = {}
    count = round(planted * len(test))
    free = [int(k) for k in rng.permutation(len(test))]
    sources = [train[int(k)] for k in rng.permutation(len(train))]
    for n in range(count if "near-duplicate" in kinds else 0):
        row, source, how = test[free.pop()], sources.pop(), CHANGES[n % len(CHANGES)]
        for kind, picture in zip(("vision", "tactile"), pictures[source["id"]], strict=True):
            row[kind] = f"{row['video']}/{kind}/copy{row['frame']}.jpg"
            save(root / row[kind], changed(picture, how, rng), 60 if "jpeg" in how else 95)
        row["background"] = source["background"]
        leaks["near-duplicate"][row["id"]], change[row["id"]] = source["id"], how
    for kind in [k for k in KINDS[1:] if k in kinds]:
        for _ in range(max(2, count // 6)):
            at = -1
            if kind == "time gap":
                at = next(k for k, s in enumerate(sources) if "later" in s)
            source = sources.pop(at)
            if kind == "identical sample":
                row = dict(source)
            elif kind == "identical bytes":
                row = test[free.pop()]
                for column in ("vision", "tactile"):
                    row[column] = f"{row['video']}/{column}/same{row['frame']}.jpg"
                    (root / row[column]).write_bytes((root / source[column]).read_bytes())
                row["background"] = source["background"]
            elif kind == "shared video":
                moved = {"video": source["video"], "frame": source["frame"] + 5000}
                row = {**test[free.pop()], **moved}
                test.remove(next(s for s in test if s["id"] == row["id"]))
                used = {i for pairs in leaks.values() for i in pairs}
                free = [k for k in range(len(test)) if test[k]["id"] not in used]
                free = [int(k) for k in rng.permutation(free)]
            else:
                world, frame, background = source["later"]
                images = world.vision(frame), world.tactile(frame), background
                row = add(source["video"], 0, frame, images, source["material"])
            if kind != "identical bytes":
                test.append(row)
                free = [k for k in free if k != len(test) - 1]
            leaks[kind][row["id"]] = source["id"]
    for row in (*train, *test):
        row.pop("later", None)
    return Leaky(Manifest.from_rows(train, root), Manifest.from_rows(test, root), leaks, change)
