"""Speed and memory of the metrics next to the peers', on the same features in one run.

    python benchmarks/metrics.py                         # n = m = 14,000, d = 768; ten minutes
    python benchmarks/metrics.py --n 4000 --repeats 3    # a first look
    python benchmarks/metrics.py --parts disk --disk-rows 1000000    # 6 GB in a temporary folder
    python benchmarks/metrics.py --parts gpu --device cuda --n 100000
    python benchmarks/metrics.py --write docs/studies/metric_speed.md

Every line runs in a fresh process, which draws the same features from the same seed first; peak
memory is the process's largest resident set minus what it had with the features drawn. Ratios are
of CPU time on one thread (``--threads 1``, the default), which other work on the machine disturbs
least. cmmd-pytorch's formula is written out as published: whole kernel matrices in float32, norms
from the diagonal of n x n products, means over all entries. torchmetrics and torch-fidelity run
where installed.
"""

import argparse
import datetime
import importlib.metadata
import importlib.util
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

VIDEOS, CLASSES = 100, 20


def features(n, d, seed, start=0):
    """Rows ``start`` to ``start + n`` of the set ``seed``: (n, d) float32, unit-norm.

    With a common mean, and effects of class and video.
    """
    out, fixed = np.empty((n, d), np.float32), np.random.default_rng(0)
    base = fixed.normal(size=d) + 1
    classes = 0.4 * fixed.normal(size=(CLASSES, d))
    videos = 0.3 * fixed.normal(size=(VIDEOS, d))
    for k in range(0, n, 10_000):
        rng = np.random.default_rng([seed, start + k])
        video = (start + k + np.arange(min(10_000, n - k))) % VIDEOS
        x = base + classes[video % CLASSES] + videos[video] + 0.3 * rng.normal(size=(len(video), d))
        x += 0.1 * seed * np.linspace(-1, 1, d)
        out[k : k + len(x)] = x / np.linalg.norm(x, axis=1, keepdims=True)
    return out


def bare_products(x, y):
    """Every block of the symmetric pair matrix once, nothing else."""
    z, k = np.concatenate([x, y]), np.empty((1024, 1024), np.float32)
    for i in range(0, len(z), 1024):
        for j in range(i, len(z), 1024):
            a, b = z[i : i + 1024], z[j : j + 1024]
            np.matmul(a, b.T, out=k[: len(a), : len(b)])


def cmmd_formula(x, y):
    """Three whole kernel matrices in float32, as cmmd-pytorch publishes it."""
    gamma = np.float32(1 / 200)
    x_sq, y_sq = np.diag(x @ x.T), np.diag(y @ y.T)
    mean = lambda a, b, p, q: np.mean(np.exp(-gamma * (-2 * (a @ b.T) + p[:, None] + q[None, :])))
    total = mean(x, x, x_sq, x_sq) + mean(y, y, y_sq, y_sq) - 2 * mean(x, y, x_sq, y_sq)
    return float(np.float32(1000) * total)


def palpate(backend):
    def run(x, y):
        from palpate.metrics import distance

        return distance(x, y, backend=backend, estimator="biased", scale=1000.0).value

    return run


def four_metrics(x, y):
    """All four metrics, leave-one-video-out intervals, 1,000 permutations of whole videos."""
    from palpate.core import FeatureSet
    from palpate.metrics import four_scores

    def feature_set(rows):
        video = np.arange(len(rows)) % VIDEOS
        labels, groups = [f"c{v % CLASSES:02d}" for v in video], [f"v{v:03d}" for v in video]
        return FeatureSet([f"{k:06d}" for k in range(len(rows))], rows, labels, groups)

    scores = four_scores(*map(feature_set, (x, y)), permutations=1000, backend="blocked")
    assert all(s.value is not None and s.interval for s in scores)
    return scores[0].value


def torchmetrics_polynomial(x, y):
    import torch
    from torchmetrics.image.kid import poly_mmd

    return float(poly_mmd(torch.from_numpy(x), torch.from_numpy(y)))


def torch_fidelity(kernel):
    def run(x, y):
        from torch_fidelity.metric_kid import kernel_mmd

        names = ("poly_degree", "poly_gamma", "poly_coef0", "rbf_sigma")
        options = zip((f"kid_kernel_{name}" for name in names), (3, None, 1, 10.0), strict=True)
        return float(kernel_mmd(x, y, kid_kernel=kernel, **dict(options)))

    return run


FLOOR, BLOCKED = "bare matrix products (floor)", "palpate, blocked"
RUNS = {  # name -> function, package, whether the value is the biased MMD^2 at scale 1000
    FLOOR: (bare_products, None, False),
    BLOCKED: (palpate("blocked"), None, True),
    "palpate, moments": (palpate("moments"), None, True),
    "palpate, four metrics with intervals and 1,000 permutations": (four_metrics, None, False),
    "cmmd-pytorch's formula": (cmmd_formula, None, True),
    "torchmetrics, polynomial": (torchmetrics_polynomial, "torchmetrics", False),
    "torch-fidelity, polynomial": (torch_fidelity("poly"), "torch_fidelity", False),
    "torch-fidelity, RBF": (torch_fidelity("rbf"), "torch_fidelity", False),
}


def resident():
    """MiB in memory now (Linux)."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20


class Peak:
    """Largest resident set inside, sampled every 5 ms."""

    def __enter__(self):
        self.start = self.most = resident()
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._watch, daemon=True)
        self.thread.start()
        return self

    def _watch(self):
        while not self.over.wait(0.005):
            self.most = max(self.most, resident())

    def __exit__(self, *_):
        self.over.set()
        self.thread.join()
        self.most = max(self.most, resident())


def measure(name, n, m, d, repeats):
    """One line of the table, in this process."""
    run = RUNS[name][0]
    x, y = features(n, d, 0), features(m, d, 1)
    run(x[:600], y[:600])  # imports and first-use costs
    times = []
    with Peak() as peak:
        for _ in range(repeats):
            start = time.process_time(), time.perf_counter()
            value = run(x, y)
            times.append((time.process_time() - start[0], time.perf_counter() - start[1]))
    cpu, wall = np.min(times, axis=0)
    return {"cpu": cpu, "wall": wall, "mib": peak.most - peak.start, "value": value}


def measure_disk(x_path, y_path):
    """The distance of two files that are mapped into memory, in this process."""
    from palpate.metrics import distance

    x, y = (np.load(p, mmap_mode="r") for p in (x_path, y_path))
    with Peak() as peak:
        start = time.perf_counter(), time.process_time()
        result = distance(x, y)
        wall, cpu = time.perf_counter() - start[0], time.process_time() - start[1]
    times = {"rows": len(x), "wall": wall, "cpu": cpu, "mib": peak.most}
    return times | {"value": result.value} | result.details


def in_a_process(threads, *arguments):
    """Run this file again and read its last line."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    env = os.environ | dict.fromkeys(names, str(threads))
    command = [sys.executable, __file__, *map(str, arguments)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return {"error": lines[-1] if lines else f"exit {done.returncode}"}
    return json.loads(done.stdout.strip().splitlines()[-1])


def peers(options):
    """Rows of the table."""
    size = ("--n", options.n, "--m", options.m, "--d", options.d, "--repeats", options.repeats)
    rows = []
    for name, (_, package, _) in RUNS.items():
        if package and importlib.util.find_spec(package) is None:
            row = {"error": "not installed"}
        else:
            row = in_a_process(options.threads, "--one", name, *size)
            if package:
                version = importlib.metadata.version(package.replace("_", "-"))
                row["version"] = f" ({version})"
        rows.append({"name": name} | row)
        print(rows[-1], flush=True)
    return rows


def peers_text(options):
    rows = peers(options)
    exact = exact_value(features(options.n, options.d, 0), features(options.m, options.d, 1))
    base = next(r["cpu"] for r in rows if r["name"] == BLOCKED)
    lines = [
        "| run | CPU s | x blocked | extra MiB | value | error against float64 |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        if "error" in r:
            lines.append(f"| {r['name']} | {r['error']} | | | | |")
            continue
        value = "-" if r["value"] is None else f"{r['value']:.6g}"
        error = f"{r['value'] - exact:+.1e}" if RUNS[r["name"]][2] else "-"
        times = f"{r['cpu']:.2f} | {r['cpu'] / base:.2f} | {r['mib']:.0f}"
        lines.append(f"| {r['name']}{r.get('version', '')} | {times} | {value} | {error} |")
    sizes = f"n = {options.n}, m = {options.m}, d = {options.d}, {VIDEOS} videos, {CLASSES} classes"
    head = f"{sizes}, float32; best of {options.repeats}, each in a fresh process."
    return head + "\n\n" + "\n".join(lines)


def exact_value(x, y, rows=512):
    """The biased value by float64 slabs."""

    def mean(a, b):
        wide, total = b.astype(np.float64), 0.0
        squares = (wide**2).sum(axis=1)
        for i in range(0, len(a), rows):
            s = a[i : i + rows].astype(np.float64)
            distances = (s * s).sum(axis=1)[:, None] + squares - 2 * (s @ wide.T)
            total += np.expm1(-distances / 200).sum()
        return total / (len(a) * len(b))

    return 1000 * (mean(x, x) + mean(y, y) - 2 * mean(x, y))


def disk_text(options):
    """Moments from two files that do not fit: seconds, resident memory, bound."""
    rows, d = options.disk_rows, options.d
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        paths = [Path(folder) / f"{seed}.npy" for seed in (0, 1)]
        for seed, path in enumerate(paths):
            out = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=(rows, d))
            for k in range(0, rows, 50_000):
                out[k : k + 50_000] = features(min(50_000, rows - k), d, seed, k)
            out.flush()
            del out
        r = in_a_process(options.threads, "--one-disk", *paths)
    if "error" in r:
        return f"From disk: {r['error']}"
    return (
        f"From disk, n = m = {r['rows']:,}, d = {d}, float32, {options.threads} thread(s): "
        f"{r['wall']:.0f} s ({r['cpu']:.0f} CPU s), at most {r['mib']:.0f} MiB resident with "
        f"Python included, backend {r['backend']}, value {r['value']:.6g}, bound {r['bound']:.1e}."
    )


def best_time(run, wait, repeats=3):
    times = []
    for _ in range(repeats):
        wait()
        start = time.perf_counter()
        run()
        wait()
        times.append(time.perf_counter() - start)
    return min(times)


def gpu_text(options):
    """Blocked sums on a device: seconds, and share of its measured float32 matrix products."""
    import torch

    from palpate.metrics import distance

    n, d, device, side = options.n, options.d, options.device, 8192
    x, y = (torch.from_numpy(features(n, d, seed)).to(device) for seed in (0, 1))
    cuda = device.startswith("cuda")
    wait, name = (
        (torch.cuda.synchronize, torch.cuda.get_device_name())
        if cuda
        else (lambda: None, platform.processor())
    )
    a = torch.rand(side, side, device=device)
    flops = 5 * 2 * side**3 / best_time(lambda: [a @ a for _ in range(5)], wait)
    seconds = best_time(lambda: distance(x, y, backend="blocked", block=side), wait)
    needed = (2 * n) ** 2 * d  # half of all pairs, two operations each
    return (
        f"On {name}: {n:,} x {d} against as many, blocked, {seconds:.2f} s: "
        f"{100 * needed / seconds / flops:.0f} % of what bare float32 products of {side:,} x "
        f"{side:,} reach there ({flops / 1e12:.1f} TFLOP/s)."
    )


PARTS = {"peers": peers_text, "disk": disk_text, "gpu": gpu_text}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=14_000)
    parser.add_argument("--m", type=int, help="default: as n")
    parser.add_argument("--d", type=int, default=768)
    parser.add_argument("--repeats", type=int, default=2, help="the best counts")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--parts", nargs="+", default=["peers"], choices=tuple(PARTS))
    parser.add_argument("--disk-rows", type=int, default=1_000_000)
    parser.add_argument("--folder", help="where the files of --parts disk go for a while")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    parser.add_argument("--one", choices=tuple(RUNS), help=argparse.SUPPRESS)
    parser.add_argument("--one-disk", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.m = options.m or options.n
    if options.one:
        row = measure(options.one, options.n, options.m, options.d, options.repeats)
        print(json.dumps(row))
        return
    if options.one_disk:
        print(json.dumps(measure_disk(*options.one_disk)))
        return
    arguments = [a for a in sys.argv[1:] if a not in ("--folder", options.folder)]
    text = [
        "# Speed and memory of the metrics",
        "Made by a committed command; do not edit by hand.",
        "    " + " ".join(["python benchmarks/metrics.py", *arguments]),
        f"{platform.machine()}, {options.threads} thread(s), NumPy {np.__version__}, "
        f"{datetime.date.today().isoformat()}.",
        *(PARTS[part](options) for part in options.parts),
    ]
    text = "\n\n".join(text) + "\n"
    print(text)
    if options.write:
        options.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
