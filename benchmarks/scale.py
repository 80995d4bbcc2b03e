"""What slices cost: many small frames embedded by one process and by slices, killed and scored.

    python benchmarks/scale.py                  # 100,000 frames of 48 px
    python benchmarks/scale.py --full           # a million

Prints CPU seconds, wall time and peak memory of one process and of two workers, whether the bytes
are equal, what a kill -9 loses, and how far scores from slices are from those of one part. It fails
where slices cost more than 1.1 times the CPU seconds, a process takes 1 GB, or anything differs.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import palpate as pp
from palpate.data.manifest import Manifest
from palpate.data.samples import read_samples

#: Frames of a recording; most CPU seconds of slices over those of one process; GB of a process.
FRAMES, MOST, MEMORY = 100, 1.1, 1.0


def frames(folder: Path, count: int, side: int, seed: int) -> Path:
    """A manifest of so many noisy touches, in recordings of 100, each with one gel."""
    file, rows = folder / "manifest.parquet", []
    if file.is_file() and len(Manifest.load(file)) == count:
        return file
    rng = np.random.default_rng(seed)
    for k in range(count):
        video, frame = divmod(k, FRAMES)
        if frame == 0:
            gel = rng.integers(90, 130, (side, side, 3), np.uint8)
            place = folder / f"v{video}"
            place.mkdir(parents=True, exist_ok=True)
            Image.fromarray(gel).save(place / "gel.png", compress_level=1)
        image = np.clip(gel + rng.normal(0, 10, gel.shape), 0, 255).astype(np.uint8)
        Image.fromarray(image).save(place / f"{frame}.png", compress_level=1)
        names = {"tactile": f"v{video}/{frame}.png", "background": f"v{video}/gel.png"}
        rows.append({"id": f"v{video}/{frame}", "video": f"v{video}", "frame": frame} | names)
    Manifest.from_rows(rows, folder).save(file)
    return file


def started(data: Path, output: Path, encoder: str, part: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "palpate", "embed", str(data), "--encoder", encoder, "-q"]
    command += ["-o", str(output), "--slice", part]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def ended(processes: Sequence[subprocess.Popen]) -> tuple[float, float]:
    """CPU seconds of all, and the largest peak in GB."""
    seconds, peak = 0.0, 0.0
    for process in processes:
        _, status, used = os.wait4(process.pid, 0)
        assert status == 0, f"exit status {status}"
        seconds += used.ru_utime + used.ru_stime
        peak = max(peak, used.ru_maxrss / 1e6)
    return seconds, peak


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--side", type=int, default=48)
    parser.add_argument("--encoder", default="palpate/handcrafted")
    parser.add_argument("--work", type=Path, default=Path("runs/scale"))
    options = parser.parse_args()
    count = 1_000_000 if options.full else options.frames
    work, encoder = options.work, options.encoder
    data = frames(work / "data", count, options.side, 0)
    for name in ("one", "two"):
        shutil.rmtree(work / name, ignore_errors=True)

    start = time.perf_counter()
    one, peak_of_one = ended([started(data, work / "one", encoder, "1/1")])
    wall_of_one = time.perf_counter() - start
    start = time.perf_counter()
    two, peak_of_two = ended([started(data, work / "two", encoder, f"{k}/2") for k in (1, 2)])
    wall_of_two = time.perf_counter() - start

    # A worker is killed with its slice half made: it is made again, and the other one stays.
    shutil.rmtree(work / "two" / "part-2-of-2")
    other = work / "two" / "part-1-of-2" / "features.npy"
    stamp = other.stat().st_mtime_ns
    worker = started(data, work / "two", encoder, "2/2")
    half = work / "two" / ".part-2-of-2.part" / "features.npy"
    while not (half.is_file() and half.stat().st_size):
        assert worker.poll() is None, "it ended before it could be killed"
        time.sleep(0.01)
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    ended([started(data, work / "two", encoder, f"{k}/2") for k in (1, 2)])
    kept = other.stat().st_mtime_ns == stamp

    whole, parts = (read_samples(work / name, name) for name in ("one", "two"))
    equal = whole.ids == parts.ids and np.array_equal(whole.rows, parts.rows)
    drawn = frames(work / "drawn", min(count, 2000), options.side, 1)
    for name, of in (("drawn one", 1), ("drawn two", 2)):
        ended([started(drawn, work / name, encoder, f"{k + 1}/{of}") for k in range(of)])
    few = {"companions": [], "permutations": 0, "sigma": 10, "names": ["drawn"]}
    scores = [
        pp.score(work / f"drawn {name}", work / name, **few).scores for name in ("one", "two")
    ]
    off = max(abs((a.value or 0) - (b.value or 0)) for a, b in zip(*scores, strict=True))

    print(f"{count:,} frames of {options.side} px by {encoder}")
    print(f"one process: {one:.1f} CPU s, {wall_of_one:.1f} s, {peak_of_one:.2f} GB")
    print(f"two workers: {two:.1f} CPU s, {wall_of_two:.1f} s, {peak_of_two:.2f} GB")
    print(f"CPU seconds {two / one:.2f} times, wall {wall_of_one / wall_of_two:.2f} times as fast")
    print(f"frames a CPU second: {count / one:.0f}")
    print(f"bytes equal: {equal}; after kill -9 the other slice stays: {kept}")
    print(f"scores from slices are off by {off:.1e}")
    holds = equal and kept and off <= 1e-12 and two <= MOST * one
    return int(not holds or max(peak_of_one, peak_of_two) > MEMORY)


if __name__ == "__main__":
    sys.exit(main())
