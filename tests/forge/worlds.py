"""Small manifests with their images, and splits of them."""

from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image

from forge.pictures import encoded
from palpate.core import Split
from palpate.data.manifest import Manifest


@cache
def _six_videos() -> tuple[list[dict[str, object]], dict[str, bytes]]:
    """Rows, and the files by name: they are encoded once."""
    rng, rows, files = np.random.default_rng(0), [], {}
    for v, touch, k in product(range(6), range(2), range(4)):
        frame, material = 100 * touch + k, ("Wood", "Grass", "Brick")[v % 3]
        row = {"id": f"v{v}/{frame}", "video": f"v{v}", "frame": frame, "material": material}
        row["contact"] = f"v{v}#{touch}"
        for side in ("vision", "tactile", "background"):
            row[side] = f"v{v}/{side}/{frame}.png"
            base = 100 if side == "background" else 40 * (v % 3) + 20
            image = (base + rng.integers(0, 30, (32, 32, 3))).astype(np.uint8)
            files[row[side]] = encoded(Image.fromarray(image), ".png")
        rows.append(row)
    return rows, files


def six_videos(root: Path) -> Manifest:
    """Six videos of three materials, two touches of four frames each, with 32-pixel pictures."""
    rows, files = _six_videos()
    for name, data in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return Manifest.from_rows(rows, root)


def by_video(manifest: Manifest, *train: str) -> Split:
    """A split with these videos in train, or the first four, and the others in test."""
    train = train or ("v0", "v1", "v2", "v3")
    ids = list(zip(manifest.ids, manifest.column("video"), strict=True))
    parts = ([i for i, v in ids if (v in train) == part] for part in (True, False))
    return Split.from_ids(train=next(parts), test=next(parts), manifest=manifest.digest)
