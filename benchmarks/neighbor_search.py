"""The search for near-duplicate candidates against scikit-learn's brute force, on the same vectors.

    python benchmarks/neighbor_search.py --n 50000 --threads 1 2

The task is the nearest other row of each row, by ``palpate.leakage.neighbors`` (faiss' flat index)
and by ``NearestNeighbors(algorithm="brute")``, each in a process by itself. Vectors:

  videos       unit vectors (d = 64) of 126 slow drifts with a decaying spectrum: recordings
  isotropic    Gaussian directions (d = 64) without any structure

Prints the best of --repeats, the ratio of processor times, how many rows agree, and peak memory of
the whole process.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

KINDS = ("videos", "isotropic")


def vectors(kind, n, rng):
    """(n, d) float32."""
    x = rng.normal(size=(n, 64))
    if kind == "videos":
        steps = -(-n // 126)
        walk = np.cumsum(0.05 * rng.normal(size=(126, steps, 64)), axis=1)
        x = (rng.normal(size=(126, 1, 64)) + walk).reshape(-1, 64)[:n] * np.arange(1, 65) ** -0.75
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def palpate(x):
    from palpate.leakage.neighbors import Apart, nearest

    rows = np.arange(len(x))
    return nearest(x, x, 1, apart=Apart(rows, rows, 0))[:, 0]


def sklearn(x):
    from sklearn.neighbors import NearestNeighbors

    return NearestNeighbors(n_neighbors=1, algorithm="brute").fit(x).kneighbors()[1][:, 0]


def measure(task, file, repeats):
    """In a process by itself: the answer, and the best processor and wall seconds."""
    x, search = np.load(file), {"palpate": palpate, "sklearn": sklearn}[task]
    search(x[:2000])  # imports, first use
    times = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        answer = search(x)
        times.append((time.process_time() - cpu, time.perf_counter() - wall))
    lines = Path("/proc/self/status").read_text().splitlines()
    peak = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
    np.save(file.with_name(f"{task}.npy"), answer)
    print(json.dumps({"cpu": min(times)[0], "wall": min(t[1] for t in times), "peak": peak}))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=50_000)
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--child", nargs=2, metavar=("TASK", "FILE"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        measure(args.child[0], Path(args.child[1]), args.repeats)
        return
    for kind in args.kinds:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "vectors.npy"
            np.save(file, vectors(kind, args.n, np.random.default_rng(0)))
            for threads in args.threads:
                limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
                seen = {}
                for task in ("palpate", "sklearn"):
                    command = [sys.executable, __file__, "--repeats", str(args.repeats)]
                    command += ["--child", task, str(file)]
                    output = subprocess.run(
                        command, env=os.environ | limits, capture_output=True, text=True, check=True
                    ).stdout
                    seen[task] = json.loads(output)
                    numbers = ", ".join(f"{k} {v:.2f}" for k, v in seen[task].items())
                    print(
                        f"{kind}, N = {args.n}, {threads} thread(s), {task}: {numbers}", flush=True
                    )
                same = np.load(file.with_name("palpate.npy")) == np.load(
                    file.with_name("sklearn.npy")
                )
                ratio = seen["sklearn"]["cpu"] / seen["palpate"]["cpu"]
                print(f"  sklearn / palpate {ratio:.2f}; same row {same.mean():.2%}", flush=True)


if __name__ == "__main__":
    main()
