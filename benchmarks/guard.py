"""What the record of seen images costs: time and file size at 100,000 images.

::

    python benchmarks/guard.py [--images 100000] [--side 64]

Images are random bytes in a mapped file, as in training; digests are those that an encoder keeps.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from palpate.encoders.encoder_set import SEEN, load_seen, save_seen
from palpate.encoders.preprocess import digest_images, union


def run() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=100_000)
    parser.add_argument("--side", type=int, default=64)
    options = parser.parse_args()
    n, side = options.images, options.side
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shape = (n, side, side, 3)
        file = folder / "images.npy"
        images = np.lib.format.open_memmap(file, mode="w+", dtype=np.uint8, shape=shape)
        rng = np.random.default_rng(0)
        for start in range(0, n, 1000):
            part = images[start : start + 1000]
            part[:] = rng.integers(0, 256, part.shape, dtype=np.uint8)
        begin = time.process_time()
        seen = union(digest_images(images))
        print(f"digests of {n:,} images of {side} px: {time.process_time() - begin:.2f} CPU-s")
        save_seen(seen, folder)
        print(f"file: {(folder / SEEN).stat().st_size:,} bytes")
        begin = time.process_time()
        again = load_seen(folder, len(seen))
        assert again is not None
        found = np.isin(digest_images(images[:1000]), again)
        print(f"load, and look for 1,000 images: {time.process_time() - begin:.3f} CPU-s")
        assert found.all()


if __name__ == "__main__":
    run()
