"""Decoding and hashing for near-duplicates against Pillow's bare JPEG decoding.

    python benchmarks/leakage_decoding.py --files 3000 --processes 2

Makes 640 x 480 JPEGs (quality 90) of random smooth pictures, or takes the JPEGs below --folder,
and runs, alternating over the same files in pools of the same number of processes that are already
up: bare = open, draft(RGB, 48 x 48), load; ours = thumbnails, band-passed plates and search
vectors. Prints the best of --repeats, the ratio, and peak memory of this process.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from palpate.leakage.background import planar
from palpate.leakage.correlation import band_pass, even
from palpate.leakage.pool import FLOOR, quantized
from palpate.leakage.similarity import search_vectors
from palpate.leakage.thumbnails import DRAFT, thumbnail

CHUNK = 64


def bare(files):
    for file in files:
        with Image.open(file) as image:
            image.draft("RGB", (DRAFT, DRAFT))
            image.load()
    return len(files)


def ours(files):
    pixels = np.stack([thumbnail(file) for file in files])
    plates = quantized(even(band_pass(planar(pixels)), FLOOR["vision"]))
    return pixels, plates, search_vectors(plates)


def make_files(folder, count):
    rng = np.random.default_rng(0)
    small = [
        ndimage.gaussian_filter(rng.standard_normal((120, 160, 3)), (s, s, 0)) for s in (1, 2, 4, 8)
    ]
    for k in range(count):
        field = np.roll(small[k % 4] / small[k % 4].std(), (k * 7 % 120, k * 13 % 160), (0, 1))
        big = Image.fromarray(np.clip(128 + 40 * field, 0, 255).astype(np.uint8)).resize(
            (640, 480), Image.Resampling.BICUBIC
        )
        noisy = np.asarray(big).astype(np.int16) + rng.integers(-6, 7, (480, 640, 1), np.int16)
        Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8)).save(
            folder / f"{k:06d}.jpg", quality=90
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=3000)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as temporary,
        ProcessPoolExecutor(options.processes, multiprocessing.get_context("spawn")) as pool,
    ):
        folder = options.folder or Path(temporary)
        if options.folder is None:
            make_files(folder, options.files)
        files = sorted(folder.rglob("*.jpg"))[: options.files]
        chunks = [files[k : k + CHUNK] for k in range(0, len(files), CHUNK)]
        best = {}
        for _ in range(
            options.repeats + 1
        ):  # the first round starts the processes and warms the disk
            for work in (bare, ours):
                start = time.perf_counter()
                for _ in pool.map(work, chunks):
                    pass
                seconds = time.perf_counter() - start
                best[work.__name__] = min(best.get(work.__name__, np.inf), seconds)
    rate = {name: len(files) / seconds for name, seconds in best.items()}
    print(f"{len(files)} files, {options.processes} processes")
    print(f"bare {rate['bare']:.0f}/s, with hashing {rate['ours']:.0f}/s")
    print(f"time with hashing / bare = {best['ours'] / best['bare']:.3f}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of the parent {peak:.0f} MB")


if __name__ == "__main__":
    main()
