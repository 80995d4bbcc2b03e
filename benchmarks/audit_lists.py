"""The list-only audit against the same facts computed with Python dictionaries and bisection, on the same lists in one run.

    python benchmarks/audit_lists.py ../shared/data/touch_and_go/lists

Prints seconds of work after start-up (median of --repeats, imports done), the ratio, peak memory of each in a process of its own, and
checks that both find the same numbers. Without a folder, lists of the same size are made up.
"""

import argparse
import bisect
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def make_lists(folder):
    """Two lists of 91,982 and 29,879 rows over 126 videos, in touches, shuffled."""
    rng = np.random.default_rng(0)
    parts = {"train": [], "test": []}
    sizes = {"train": 91_982, "test": 29_879}
    while any(len(parts[p]) < sizes[p] for p in parts):
        start, video = int(rng.integers(0, 40_000)), int(rng.integers(0, 126))
        part = (
            "test"
            if len(parts["train"]) >= sizes["train"]
            or (len(parts["test"]) < sizes["test"] and rng.random() < 0.25)
            else "train"
        )
        parts[part] += [
            f"video{video:03d}/{start * 100 + k:010d}.jpg,{video % 19}"
            for k in range(min(27, sizes[part] - len(parts[part])))
        ]
    for part, rows in parts.items():
        rows = sorted(set(rows))
        rng.shuffle(rows)
        (folder / f"{part}.txt").write_text("\n".join(rows))


def ours(train, test):
    from palpate.leakage import audit as audit_lists

    audit = audit_lists(train, test)
    return [
        audit.test_samples,
        audit.groups_shared,
        audit.test_samples_in_shared_groups,
        audit.gap_min,
        audit.gap_median,
        audit.gap_max,
    ]


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
    for found in frames.values():
        found.sort()
    rows, gaps = read(test), []
    for video, frame in rows:
        if (found := frames.get(video)) is not None:
            k = bisect.bisect_left(found, frame)
            gaps.append(min(abs(frame - found[j]) for j in (k - 1, k) if 0 <= j < len(found)))
    shared = {v for v, _ in rows} & set(frames)
    return [len(rows), len(shared), len(gaps), min(gaps), statistics.median(gaps), max(gaps)]


def peak_mb():
    """Peak resident memory of this process alone; ru_maxrss would carry over the parent's."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lists", nargs="?", type=Path)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--one", choices=["ours", "reference"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = args.lists or Path(made)
        if args.lists is None:
            make_lists(folder)
        train, test = folder / "train.txt", folder / "test.txt"
        if args.one:  # in a process of its own: peak memory, start-up included
            (ours if args.one == "ours" else reference)(train, test)
            print(peak_mb())
            return
        rows = sum(1 for p in (train, test) for line in p.read_text().splitlines() if line)
        print(f"{rows:,} rows, Python {platform.python_version()}, {platform.machine()}")
        facts, seconds = {}, {}
        for name, function in (("ours", ours), ("reference", reference)):
            facts[name] = function(train, test)  # imports and first use
            times = []
            for _ in range(args.repeats):
                start = time.perf_counter()
                function(train, test)
                times.append(time.perf_counter() - start)
            seconds[name] = statistics.median(times)
            peak = subprocess.run(
                [sys.executable, __file__, str(folder), "--one", name],
                capture_output=True,
                text=True,
                check=True,
            ).stdout
            print(f"{name:10} {seconds[name]:6.3f} s   peak {float(peak):6.0f} MB   {facts[name]}")
        assert facts["ours"] == facts["reference"], "the two disagree"
        print(
            f"reference / ours: {seconds['reference'] / seconds['ours']:.2f} (ours also checks every line, touches, classes and worst pairs)"
        )


if __name__ == "__main__":
    main()
