"""Blocked MMD against the usual full-matrix float32 formula, on the same features in one run.

    python benchmarks/metrics_blocked.py --n 2000 --m 2000 --d 512

Prints, for the biased estimator (what the full-matrix formula computes): seconds (best of --repeats), peak extra memory of the
NumPy arrays, and the error against float64 with explicit kernel blocks.
"""

import argparse
import platform
import time
import tracemalloc

import numpy as np

from palpate.metrics import mmd2


def features(seed, n, d, shift):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, d)) + 1.0 + shift * np.linspace(-1, 1, d)
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def full_matrices(x, y):
    """The CMMD way: three whole kernel matrices in float32, means over all entries (diagonals included)."""
    gamma = np.float32(1 / 200)

    def k(a, b):
        return np.exp(-gamma * ((a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * (a @ b.T)))

    return float(np.float32(1000) * (k(x, x).mean() + k(y, y).mean() - 2 * k(x, y).mean()))


def truth(x, y, rows=256):
    """Float64 sums of k - 1 over slabs of rows."""
    x, y = x.astype(np.float64), y.astype(np.float64)

    def mean(a, b):
        total = 0.0
        for i in range(0, len(a), rows):
            s = a[i : i + rows]
            total += np.expm1(-((s * s).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * (s @ b.T)) / 200).sum()
        return total / (len(a) * len(b))

    return 1000 * (mean(x, x) + mean(y, y) - 2 * mean(x, y))


def measured(call, repeats):
    best = min(_seconds(call) for _ in range(repeats))
    tracemalloc.start()
    value = call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return value, best, peak / 2**20


def _seconds(call):
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=2000)
    parser.add_argument("--m", type=int, default=2000)
    parser.add_argument("--d", type=int, default=512)
    parser.add_argument("--shift", type=float, default=0.1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    x, y = features(args.seed, args.n, args.d, args.shift), features(args.seed + 1, args.m, args.d, 0.0)
    true = truth(x, y)
    print(f"n={args.n} m={args.m} d={args.d} seed={args.seed} numpy={np.__version__} {platform.machine()}; truth {true:.9f}")
    full = measured(lambda: full_matrices(x, y), args.repeats)
    ours = measured(lambda: mmd2(x, y, estimator="biased"), args.repeats)
    for name, (value, seconds, peak) in (("full float32", full), ("blocked", ours)):
        print(f"{name:13s} {value:.9f}  error {value - true:+.1e}  {seconds:.3f} s  peak {peak:.0f} MiB")
    print(f"time ratio full / blocked {full[1] / ours[1]:.2f}, memory ratio {full[2] / ours[2]:.2f}")


if __name__ == "__main__":
    main()
