"""The audit of two bare lists against the same facts by Python dictionaries and bisection.

    python benchmarks/audit_lists.py ../shared/data/touch_and_go/lists

Prints seconds of work after start-up (median of --repeats, imports done), the ratio, peak memory of
each in a process by itself, and checks that both find the same numbers. Without a folder, lists of
the same size are made up.
"""

import argparse
import bisect
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def make_lists(folder):
    """Two lists of 91,982 and 29,879 rows over 126 videos, in contacts, shuffled."""
    rng = np.random.default_rng(0)
    for part, size in (("train", 91_982), ("test", 29_879)):
        rows = set()
        while len(rows) < size:
            start, video = int(rng.integers(0, 40_000)), int(rng.integers(0, 126))
            name = f"video{video:03d}"
            run = [f"{name}/{start * 100 + k:010d}.jpg,{video % 19}" for k in range(27)]
            rows.update(run[: size - len(rows)])
        lines = sorted(rows)
        rng.shuffle(lines)
        (folder / f"{part}.txt").write_text("\n".join(lines))


def palpate(train, test):
    from palpate.leakage import audit

    result = audit(train, test)
    names = ("test_samples", "groups_shared", "test_samples_in_shared_groups")
    return [getattr(result, name) for name in (*names, "gap_min", "gap_median", "gap_max")]


def reference(train, test):
    """What a careful script does: split each line, collect frames by video, bisect."""

    def read(path):
        rows = []
        for line in path.read_text().splitlines():
            name, _, _ = line.rpartition(",")
            video, _, frame = name.partition("/")
            rows.append((video, int(frame.partition(".")[0])))
        return rows

    frames = {}
    for video, frame in read(train):
        frames.setdefault(video, []).append(frame)
    for numbers in frames.values():
        numbers.sort()
    rows, gaps = read(test), []
    for video, frame in rows:
        if (numbers := frames.get(video)) is not None:
            k = bisect.bisect_left(numbers, frame)
            near = [numbers[j] for j in (k - 1, k) if 0 <= j < len(numbers)]
            gaps.append(min(abs(frame - other) for other in near))
    shared = {v for v, _ in rows} & set(frames)
    return [len(rows), len(shared), len(gaps), min(gaps), statistics.median(gaps), max(gaps)]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lists", nargs="?", type=Path)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--task", choices=["palpate", "reference"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.lists or Path(temporary)
        if args.lists is None:
            make_lists(folder)
        lists = folder / "train.txt", folder / "test.txt"
        tasks = {"palpate": palpate, "reference": reference}
        if args.task:  # in a process by itself; ru_maxrss would carry over the parent's peak
            tasks[args.task](*lists)
            status = Path("/proc/self/status").read_text().splitlines()
            print(next(int(s.split()[1]) for s in status if s.startswith("VmHWM")) / 1024)
            return
        facts, seconds = {}, {}
        for name, task in tasks.items():
            facts[name] = task(*lists)  # imports and first use
            times = []
            for _ in range(args.repeats):
                start = time.perf_counter()
                task(*lists)
                times.append(time.perf_counter() - start)
            seconds[name] = statistics.median(times)
            command = [sys.executable, __file__, str(folder), "--task", name]
            peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            print(f"{name:10} {seconds[name]:.3f} s, peak {float(peak):.0f} MB, {facts[name]}")
        assert facts["palpate"] == facts["reference"], "the two disagree"
        print(f"reference / palpate: {seconds['reference'] / seconds['palpate']:.2f}")


if __name__ == "__main__":
    main()
