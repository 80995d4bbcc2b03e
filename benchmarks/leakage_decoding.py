"""CPU time and memory of a near-duplicate audit of many images, decoding included.

    python benchmarks/leakage_decoding.py --files 50000 --size 128

Makes JPEGs (quality 90) of random smooth images, or takes those below --folder, compares a fifth of
them (test) with the others (train, in videos of 50) and prints CPU seconds and peak memory. On
two cores in November 2026: 51 to 58 CPU s, 51 s, 891 MB.
"""

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as `palpate` does on two cores

import numpy as np
from PIL import Image
from scipy import ndimage

from palpate.data.manifest import Manifest
from palpate.leakage.near import near_duplicates


def make_files(folder, count, size):
    rng = np.random.default_rng(0)
    for k in range(count):
        if k % 50 == 0:
            field = ndimage.gaussian_filter(rng.standard_normal((96, 96, 3)), (6, 6, 0))
        field = 0.98 * field + 0.02 * ndimage.gaussian_filter(
            rng.standard_normal(field.shape), (3, 3, 0)
        )
        image = np.clip(128 + 40 * field / field.std(), 0, 255).astype(np.uint8)
        Image.fromarray(image).resize((size, size)).save(folder / f"{k:06d}.jpg", quality=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=50_000)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--folder", type=Path, default=None)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if not any(folder.glob("*.jpg")):
            make_files(folder, options.files, options.size)
        names = sorted(p.name for p in folder.glob("*.jpg"))[: options.files]
        rows = [
            {"id": n, "vision": n, "video": f"v{k // 50}", "frame": k} for k, n in enumerate(names)
        ]
        cut = len(rows) * 4 // 5
        parts = [Manifest.from_rows(r, folder) for r in (rows[:cut], rows[cut:])]
        start, wall = time.process_time(), time.perf_counter()
        flags = near_duplicates(*parts, "vision")
        cpu, wall = time.process_time() - start, time.perf_counter() - wall
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{len(rows)} images, {cpu:.0f} CPU s, {wall:.0f} s, peak {peak:.0f} MB, {flags.verdict}")


if __name__ == "__main__":
    main()
